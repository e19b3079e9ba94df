"""Algorithm 1's step, written by hand: for processors, and for many shapes at once on NVIDIA devices."""

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
    """The step on processors. A step of None still advances Adam's moments."""

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
        held = None if frozen is None else torch.as_tensor(frozen).numpy()
        self._flow = FusedFlow(
            start.numpy(), base, a, cost.grid, epsilon, cost.blur, held,
            betas=betas, adam_eps=ADAM_EPS, orientation=Q,
        )  # fmt: skip
        self._seen = Statistics(0.0, 0.0, 0.0)

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return (self,)

    def step(self, rate: float | None) -> None:
        self._seen = Statistics(self._flow.evaluate(), *self._flow.update(rate or 0.0))

    def statistics(self) -> Statistics:
        return self._seen

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
    """The step on NVIDIA devices, of shapes that share all but their starts, masses and coefficients.

    Parameters
    ----------
    starts, bases
        A `(3, Z, Y, X)` and k ∗ base of each shape.
    cost, coefficients
        What is lowered, the same for all but for the coefficients, which are one set a shape.
    betas, frozen, device
        As in `relax`, the same for all.
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

        base = torch.stack(torch.broadcast_tensors(*(torch.as_tensor(each, dtype=torch.float32) for each in bases)))
        self._flow = CudaFlow(
            torch.stack(list(starts)), base, together(coefficients, cost.grid), cost.grid, cost.epsilon, cost.blur,
            frozen,
            orientation=cost.orientation, betas=betas, adam_eps=ADAM_EPS, device=device,
        )  # fmt: skip
        self._shapes = tuple(_CudaShape(self, k) for k in range(len(starts)))
        self._seen: list[Statistics] | None = None
        self._masses: list[float] | None = None

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return self._shapes

    def step(self, rate: float | None) -> None:
        self._seen = self._masses = None
        if rate is None:
            self._flow.observe()
        else:
            self._flow.run([rate], observe=True)

    def run(self, rates: Sequence[float]) -> int:
        self._flow.run(rates)
        return len(rates)

    def seen(self) -> list[Statistics]:
        """What the last `step` saw of each shape."""
        if self._seen is None:
            figures = (each.tolist() for each in self._flow.statistics())
            self._seen = [Statistics(*row) for row in zip(*figures, strict=True)]
        return self._seen

    def masses(self) -> list[float]:
        """The mean of each field."""
        if self._masses is None:
            self._masses = self._flow.field.mean((1, 2, 3), dtype=torch.float64).tolist()
        return self._masses

    def u(self, k: int) -> Tensor:
        """The field of one shape."""
        return self._flow.field[k].cpu()

    def shift(self, k: int, amount: float) -> None:
        """Add a constant to the field of one shape from the next step on."""
        self._flow.shift(k, amount)

    def state(self) -> dict[str, Any]:
        return self._flow.state()._asdict()

    def restore(self, state: dict[str, Any]) -> None:
        from curvafit.priors.kernels.cuda import State

        self._flow.restore(State(**state))


def together(coefficients: Sequence[Coefficients], grid: Grid) -> Tensor:
    """One set a shape: `(B, 6)`, or `(B, 6, Z, Y, X)` where any of them varies."""
    a = [kernels.stacked(each, grid) for each in coefficients]
    if any(each.dim() > 1 for each in a):
        a = [each.reshape(6, 1, 1, 1) if each.dim() == 1 else each for each in a]
    return torch.stack(torch.broadcast_tensors(*a))


class _CudaShape:
    """One of a stepper's shapes."""

    def __init__(self, stepper: CudaStepper, k: int) -> None:
        self._stepper, self._k = stepper, k

    def statistics(self) -> Statistics:
        return self._stepper.seen()[self._k]

    def field(self) -> Tensor:
        return self._stepper.u(self._k)

    def mass(self) -> float:
        return self._stepper.masses()[self._k]

    def shift(self, amount: float) -> None:
        self._stepper.shift(self._k, amount)
