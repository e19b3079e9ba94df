"""Two ways to make one step of the flow: plain torch (any device, any coefficients) and fused."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from curvafit.generation.parametrization import DivergenceForm
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy

#: The number that Adam adds to its root, as published; not the usual 1e-8, and it matters.
ADAM_EPS = 1e-2


class Statistics(NamedTuple):
    """F_ε, and max and mean of |∂F_ε/∂A| over the voxels that are free."""

    energy: float
    gradient_max: float
    gradient_mean: float


class Stepper(Protocol):
    """The state of a flow, stepped in place."""

    def step(self, rate: float | None) -> None:
        """Compute u and the gradient, then step by `rate`; for None A stays, and no step may follow."""
        ...

    def statistics(self) -> Statistics:
        """What the last step saw, before it moved."""
        ...

    def field(self) -> Tensor:
        """The u last computed, float32 `(Z, Y, X)` on the processor; the next step may overwrite it."""
        ...

    def mass(self) -> float:
        """Its mean, in float64."""
        ...


def stepper(
    start: Tensor,
    form: DivergenceForm,
    coefficients: Coefficients,
    epsilon: float,
    betas: tuple[float, float],
    frozen: Tensor | None,
    backend: str,
    device: torch.device | str,
) -> Stepper:
    """The stepper of that name, or for `"auto"` the fused one where there is one.

    Raises
    ------
    ValueError
        If the name is unknown or there is no fused step for the coefficients or the device.
    """
    if backend not in ("auto", "torch", "fused"):
        raise ValueError(f"expected a backend 'auto', 'torch' or 'fused', got {backend!r}")
    able = kernels.fused(device, coefficients)
    if backend == "fused" and not able:
        raise ValueError(f"expected numbers as coefficients, the processor and numba for the fused step, got {device}")
    if backend != "torch" and able:
        return FusedStepper(start, form, coefficients, epsilon, betas, frozen)
    return TorchStepper(start, form, coefficients, epsilon, betas, frozen, device)


class TorchStepper:
    """Autograd and `torch.optim.Adam`: the definition."""

    def __init__(self, start, form: DivergenceForm, coefficients, epsilon: float, betas, frozen, device) -> None:
        base = form.base.to(device) if isinstance(form.base, Tensor) else form.base
        self._form = DivergenceForm(form.grid, form.width, base)
        self._coefficients = Coefficients(*(v.to(device) if isinstance(v, Tensor) else v for v in coefficients))
        self._epsilon = epsilon
        self._vector = start.to(device).clone().requires_grad_()
        self._free = None if frozen is None else ~torch.as_tensor(frozen, dtype=torch.bool, device=device)
        self._adam = torch.optim.Adam([self._vector], betas=betas, eps=ADAM_EPS)
        self._u = self._value = self._slope = self._vector.detach()[0]

    def step(self, rate: float | None) -> None:
        self._adam.zero_grad()
        u = self._form.field(self._vector)
        value = energy(u, self._coefficients, self._form.grid, self._epsilon)
        value.backward()
        assert self._vector.grad is not None
        self._u, self._value, self._slope = u.detach(), value.detach(), self._vector.grad
        if self._free is not None:
            self._slope *= self._free
        if rate is not None:
            self._adam.param_groups[0]["lr"] = rate
            self._adam.step()

    def statistics(self) -> Statistics:
        size = self._slope.abs()
        count = size.numel() if self._free is None else 3 * int(self._free.sum())
        return Statistics(float(self._value), float(size.max()), float(size.double().sum()) / max(1, count))

    def field(self) -> Tensor:
        return self._u.to("cpu", torch.float32)

    def mass(self) -> float:
        return float(self._u.double().mean())


class FusedStepper:
    """The hand-derived step for processors. A step of None still advances Adam's moments."""

    def __init__(self, start, form: DivergenceForm, coefficients, epsilon: float, betas, frozen) -> None:
        from curvafit.priors.kernels.cpu import FusedFlow

        base = form.base.numpy() if isinstance(form.base, Tensor) else form.base
        a = [float(value) for value in coefficients]
        held = None if frozen is None else torch.as_tensor(frozen).numpy()
        self._flow = FusedFlow(
            start.numpy(), base, a, form.grid, epsilon, form.width, held, betas=betas, adam_eps=ADAM_EPS
        )
        self._seen = Statistics(0.0, 0.0, 0.0)

    def step(self, rate: float | None) -> None:
        self._seen = Statistics(self._flow.evaluate(), *self._flow.update(rate or 0.0))

    def statistics(self) -> Statistics:
        return self._seen

    def field(self) -> Tensor:
        return torch.from_numpy(self._flow.field.copy())

    def mass(self) -> float:
        return float(self._flow.field.mean(dtype="float64"))
