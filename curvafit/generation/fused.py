"""Algorithm 1's step in fused kernels: for processors, and for many shapes at once on NVIDIA devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curvafit.generation.cost import Cost
from curvafit.generation.parametrization import DivergenceForm
from curvafit.generation.stepper import ADAM_EPS, ShapeView, Statistics, Stepper
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid


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


class CudaStepper(Stepper):
    """The step on NVIDIA devices, for shapes that differ only in their starts, masses and coefficients.

    Parameters
    ----------
    starts, bases
        A `(3, Z, Y, X)` and k ∗ base, for each shape.
    cost, coefficients
        The functional, which all shapes share but for the coefficients, and one set of these for each shape.
    betas, frozen, device
        As in `relax`, for all shapes.
    """

    def __init__(
        self,
        starts: Sequence[Tensor],
        bases: Sequence[float | Tensor],
        cost: Cost,
        coefficients: Sequence[Coefficients],
        betas: tuple[float, float],
        frozen: Tensor | None,
        device: torch.device | str,
    ) -> None:
        from curvafit.priors.kernels.cuda import CudaFlow

        fields = (torch.as_tensor(base, dtype=torch.float32) for base in bases)
        base = torch.stack(torch.broadcast_tensors(*fields))
        self._flow = CudaFlow(
            torch.stack(list(starts)), base, together(coefficients, cost.grid), cost.grid, cost.epsilon, cost.blur,
            frozen,
            orientation=cost.orientation, betas=betas, adam_eps=ADAM_EPS, device=device,
        )  # fmt: skip
        self._shapes = tuple(_CudaShape(self, k) for k in range(len(starts)))
        self._statistics: list[Statistics] | None = None
        self._masses: list[float] | None = None

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return self._shapes

    def step(self, rate: float | None) -> None:
        self._statistics = self._masses = None
        if rate is None:
            self._flow.observe()
        else:
            self._flow.run([rate], observe=True)

    def run(self, rates: Sequence[float]) -> int:
        self._flow.run(rates)
        return len(rates)

    def set_betas(self, betas: tuple[float, float]) -> None:
        self._flow.betas = betas

    def statistics(self) -> list[Statistics]:
        """Return the statistics of each shape before the last `step` moved it."""
        if self._statistics is None:
            columns = (column.tolist() for column in self._flow.statistics())
            self._statistics = [Statistics(*row) for row in zip(*columns, strict=True)]
        return self._statistics

    def masses(self) -> list[float]:
        """Return the mean of each field."""
        if self._masses is None:
            self._masses = self._flow.field.mean((1, 2, 3), dtype=torch.float64).tolist()
        return self._masses

    def u(self, k: int) -> Tensor:
        """Return the field of shape `k`."""
        return self._flow.field[k].cpu()

    def shift(self, k: int, amount: float) -> None:
        """Add a constant to the field of shape `k` from the next step on."""
        self._flow.shift(k, amount)

    def state(self) -> dict[str, Any]:
        return self._flow.state()._asdict()

    def restore(self, state: dict[str, Any]) -> None:
        from curvafit.priors.kernels.cuda import State

        self._flow.restore(State(**state))


def together(coefficients: Sequence[Coefficients], grid: Grid) -> Tensor:
    """Stack the coefficients of all shapes: `(B, 6)`, or `(B, 6, Z, Y, X)` where any of them varies in space."""
    sets = [kernels.stacked(a, grid) for a in coefficients]
    if any(a.dim() > 1 for a in sets):
        sets = [a.reshape(6, 1, 1, 1) if a.dim() == 1 else a for a in sets]
    return torch.stack(torch.broadcast_tensors(*sets))


class _CudaShape:
    """One shape of a `CudaStepper`."""

    def __init__(self, stepper: CudaStepper, k: int) -> None:
        self._stepper, self._k = stepper, k

    def statistics(self) -> Statistics:
        return self._stepper.statistics()[self._k]

    def field(self) -> Tensor:
        return self._stepper.u(self._k)

    def mass(self) -> float:
        return self._stepper.masses()[self._k]

    def shift(self, amount: float) -> None:
        self._stepper.shift(self._k, amount)
