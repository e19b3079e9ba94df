"""Two ways to make one step of the flow: plain torch (any device, any coefficients) and fused."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from curvafit.generation.parametrization import DivergenceForm
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy

#: Adam's constants as published; eps is not the usual 1e-8, and it matters.
BETAS, ADAM_EPS = (0.9, 0.999), 1e-2


class Statistics(NamedTuple):
    """F_ε, and max and mean of |∂F_ε/∂A| over the voxels that are free."""

    energy: float
    gradient_max: float
    gradient_mean: float


class Stepper(Protocol):
    """The state of a flow, stepped in place."""

    def step(self, rate: float | None, look: bool) -> Statistics | None:
        """Compute u and the gradient, then step by `rate` (not at all for None). Returns what was seen if `look`."""

    def field(self) -> Tensor:
        """The u last computed, float32 `(Z, Y, X)` on the processor; the next step may overwrite it."""

    def mass(self) -> float:
        """Its mean, in float64."""


def stepper(
    start: Tensor,
    form: DivergenceForm,
    coefficients: Coefficients,
    epsilon: float,
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
        return FusedStepper(start, form, coefficients, epsilon, frozen)
    return TorchStepper(start, form, coefficients, epsilon, frozen, device)


class TorchStepper:
    """Autograd and `torch.optim.Adam`: the definition."""

    def __init__(self, start, form: DivergenceForm, coefficients, epsilon: float, frozen, device) -> None:
        base = form.base.to(device) if isinstance(form.base, Tensor) else form.base
        self._form = DivergenceForm(form.grid, form.width, base)
        self._coefficients = Coefficients(*(v.to(device) if isinstance(v, Tensor) else v for v in coefficients))
        self._epsilon = epsilon
        self._vector = start.to(device).clone().requires_grad_()
        self._free = None if frozen is None else ~torch.as_tensor(frozen, dtype=torch.bool, device=device)
        self._adam = torch.optim.Adam([self._vector], betas=BETAS, eps=ADAM_EPS)
        self._u = self._vector.detach()[0]

    def step(self, rate: float | None, look: bool) -> Statistics | None:
        self._adam.zero_grad()
        u = self._form.field(self._vector)
        value = energy(u, self._coefficients, self._form.grid, self._epsilon)
        value.backward()
        self._u = u.detach()
        slope = self._vector.grad
        if self._free is not None:
            slope *= self._free
        seen = self._statistics(value.detach(), slope) if look else None
        if rate is not None:
            self._adam.param_groups[0]["lr"] = rate
            self._adam.step()
        return seen

    def field(self) -> Tensor:
        return self._u.to("cpu", torch.float32)

    def mass(self) -> float:
        return float(self._u.double().mean())

    def _statistics(self, value: Tensor, slope: Tensor) -> Statistics:
        size = slope.abs()
        count = size.numel() if self._free is None else 3 * int(self._free.sum())
        return Statistics(float(value), float(size.max()), float(size.double().sum()) / max(1, count))


class FusedStepper:
    """The hand-derived step for processors. A step of None still advances Adam's moments: it is a flow's last look."""

    def __init__(self, start, form: DivergenceForm, coefficients, epsilon: float, frozen) -> None:
        from curvafit.priors.kernels.cpu import FusedFlow

        base = form.base.numpy() if isinstance(form.base, Tensor) else form.base
        a = [float(value) for value in coefficients]
        held = None if frozen is None else torch.as_tensor(frozen).numpy()
        self._flow = FusedFlow(start.numpy(), base, a, form.grid, epsilon, form.width, held, betas=BETAS, adam_eps=ADAM_EPS)

    def step(self, rate: float | None, look: bool) -> Statistics | None:
        value = self._flow.evaluate()
        return Statistics(value, *self._flow.update(rate or 0.0))

    def field(self) -> Tensor:
        return torch.from_numpy(self._flow.field.copy())

    def mass(self) -> float:
        return float(self._flow.field.mean(dtype="float64"))
