"""A training loss with the curvature prior beside it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from curvafit.core.checks import check_float, check_int


class CombinedLoss(nn.Module):
    """base(input, target) + weight × prior(input, target), where the prior's weight grows over the first calls.

    Parameters
    ----------
    base
        Any loss of an input and a target, a module or a function.
    prior
        A `CurvaturePrior` that takes the same input.
    weight
        See `CurvaturePrior.suggest_weight`.
    warmup
        Number of calls over which the weight grows linearly to its full value. Calls in evaluation mode or without a
        gradient do not count. The count is a buffer, so that a resumed training goes on from it.

    Attributes
    ----------
    parts
        The terms of the last call, to log: `base`, `prior` before weighting, and the prior's `weight`, as tensors
        without a gradient on the device of the loss. Empty before the first call.

    Raises
    ------
    ValueError
        If the weight is not a finite number from 0, or the warm-up is not a whole number from 0.
    """

    calls: Tensor

    def __init__(
        self, base: Callable[[Tensor, Tensor], Tensor], prior: nn.Module, weight: float = 1.0, warmup: int = 0
    ) -> None:
        super().__init__()
        self.weight = check_float(weight, "a finite weight from 0", 0)
        self.warmup = check_int(warmup, "a warm-up of a whole number of calls from 0", 0, 2**53)
        self.base, self.prior = base, prior
        self.parts: dict[str, Tensor] = {}
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the weighted sum; `mask` is passed to the prior."""
        if self.training and torch.is_grad_enabled():
            self.calls += 1
        weight = self.weight
        if self.warmup:
            weight = weight * (self.calls / self.warmup).clamp(max=1)
        base, prior = self.base(input, target), self.prior(input, target, mask)
        self.parts = {"base": base.detach(), "prior": prior.detach(), "weight": torch.as_tensor(weight)}
        return base + weight * prior
