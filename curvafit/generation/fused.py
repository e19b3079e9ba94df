"""Algorithm 1's step in fused kernels, for processors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curvafit.generation.cost import Cost
from curvafit.generation.forms import DivergenceForm
from curvafit.generation.stepper import ADAM_EPS, ShapeView, Statistics, Stepper
from curvafit.priors import kernels


class FusedStepper(Stepper):
    """The step on processors; a step of None advances Adam's moments all the same."""

    def __init__(
        self,
        start: Tensor,
        form: DivergenceForm,
        cost: Cost,
        betas: tuple[float, float],
        frozen: Tensor | None,
    ) -> None:
        from curvafit.priors.kernels.cpu import FusedFlow

        base = form.base.numpy() if isinstance(form.base, Tensor) else form.base
        a, epsilon, Q = kernels.on_processor(cost.coefficients, cost.grid, cost.epsilon, cost.orientation)
        fixed = None if frozen is None else torch.as_tensor(frozen).numpy()
        self._flow = FusedFlow(
            start.numpy(), base, a, cost.grid, epsilon, cost.blur, fixed,
            betas=betas, adam_eps=ADAM_EPS, orientation=Q,
        )  # fmt: skip
        self._statistics = Statistics(0.0, 0.0, 0.0)

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return (self,)

    def step(self, rate: float | None) -> None:
        self._statistics = Statistics(self._flow.evaluate(), *self._flow.update(rate or 0.0))

    def set_betas(self, betas: tuple[float, float]) -> None:
        self._flow.betas = betas

    def statistics(self) -> Statistics:
        return self._statistics

    def field(self) -> Tensor:
        return torch.from_numpy(self._flow.field.copy())

    def mass(self) -> float:
        return float(self._flow.field.mean(dtype="float64"))

    def shift(self, amount: float) -> None:
        self._flow.shift(amount)

    def state(self) -> dict[str, Any]:
        state = self._flow.state()
        return {name: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for name, v in state.items()}

    def restore(self, state: dict[str, Any]) -> None:
        self._flow.restore(state)
