"""A training loss with the curvature prior beside it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn


class CombinedLoss(nn.Module):
    """base(input, target) + weight × prior(input, target), the second faded in over the first calls.

    Parameters
    ----------
    base
        Any loss of an input and a target, a module or a function.
    prior
        A `CurvaturePrior` that takes the same input.
    weight
        See `CurvaturePrior.suggest_weight`.
    warmup
        Calls over which the weight grows linearly to its full value; those without a gradient or in evaluation mode do
        not count. The count is a buffer, so that a resumed training goes on.

    Raises
    ------
    ValueError
        If the weight or the warm-up is negative.
    """

    calls: Tensor

    def __init__(
        self, base: Callable[[Tensor, Tensor], Tensor], prior: nn.Module, weight: float = 1.0, warmup: int = 0
    ) -> None:
        super().__init__()
        if weight is None or not weight >= 0 or warmup < 0:
            raise ValueError(f"expected a weight and a warm-up from 0, got {weight} and {warmup}")
        self.base, self.prior, self.weight, self.warmup = base, prior, float(weight), int(warmup)
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """The sum; `mask` goes to the prior."""
        if self.training and torch.is_grad_enabled():
            self.calls += 1
        strength = self.weight
        if self.warmup:
            strength = strength * (self.calls / self.warmup).clamp(max=1)
        return self.base(input, target) + strength * self.prior(input, target, mask)
