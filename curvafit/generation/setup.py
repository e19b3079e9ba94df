"""Steppers, checkpoints and bases from the arguments of a flow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from curvafit.core.checks import check_choice, check_float, check_open_interval, check_type, quoted
from curvafit.generation import fraction
from curvafit.generation.checkpoint import Checkpoint, identity
from curvafit.generation.cost import Cost, check_shape
from curvafit.generation.fused import FusedStepper
from curvafit.generation.loop import Orders
from curvafit.generation.forms import Blur, DivergenceForm, Form
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import LbfgsStepper, Stepper, TorchStepper
from curvafit.priors import kernels, stencils
from curvafit.priors.grid import Grid

#: The ways to run a flow: see `generate`.
BACKENDS = ("auto", "torch", "fused", "compiled")


@dataclass(frozen=True)
class Execution:
    """Backend, device and checkpoint of a flow.

    Raises
    ------
    ValueError
        If the backend or the device is unknown, or the seconds between checkpoints are negative or not finite.
    """

    backend: str
    device: torch.device | str
    checkpoint: str | Path | None
    every: float
    keep: bool = False

    def __post_init__(self) -> None:
        check_choice(self.backend, BACKENDS, f"a backend among {', '.join(BACKENDS)}")
        check_device(self.device)
        if self.checkpoint is not None:
            check_type(self.checkpoint, (str, Path), "a path for the checkpoint")
        check_float(self.every, "a finite number of seconds between checkpoints, at least 0", 0)

    @property
    def blur(self) -> Blur:
        """The function that blurs in forms."""
        plain = self.backend in ("torch", "compiled")
        return stencils.gaussian_blur if plain else kernels.gaussian_blur

    def stepper(
        self, start: Tensor, form: Form, cost: Cost, plan: Schedule, optimiser: str, frozen: Tensor | None
    ) -> Stepper:
        """Return the stepper of one shape: fused where there is a kernel, unless the backend is plain torch.

        Raises
        ------
        ValueError
            If the optimiser is unknown, or the backend is `"fused"` and there is no fused kernel.
        """
        check_choice(optimiser, ("adam", "lbfgs"), "an optimiser 'adam' or 'lbfgs'")
        able, betas = kernels.fused(self.device), plan.betas
        if self.backend == "fused" and not able:
            raise ValueError(f"expected a device with fused kernels (a processor, with numba), got {self.device}")
        plain = self.backend in ("torch", "compiled")
        if able and not plain and cost.data is None and optimiser == "adam" and isinstance(form, DivergenceForm):
            return FusedStepper(start, form, cost, betas, frozen)
        kind = LbfgsStepper if optimiser == "lbfgs" else TorchStepper
        options = {"orientation": cost.orientation, "fused": not plain, "data": cost.data}
        options["compiled"] = self.backend == "compiled"
        return kind(start, form, cost.coefficients, cost.epsilon, betas, frozen, self.device, **options)

    def checkpoint_file(self, stepper: Stepper, cost: Cost, orders: Orders, **start: object) -> Checkpoint | None:
        """Return the checkpoint of a run, or None where the run has none."""
        if self.checkpoint is None:
            return None
        job = {"schedule": orders.plan, "volume_fraction": orders.volume_fraction, "snapshots": [*orders.snapshots]}
        place = {"stepper": type(stepper).__name__, "backend": self.backend, "device": self.device}
        return Checkpoint(self.checkpoint, self.every, identity(**vars(cost), **job, **place, **start), self.keep)


def check_device(device: torch.device | str) -> None:
    """Raise ValueError where torch cannot compute on a device."""
    try:
        usable = device is not None and torch.zeros(1, device=device).add(1).item() == 1
    except (RuntimeError, TypeError, ValueError, AssertionError):
        usable = False
    if not usable:
        raise ValueError(f"expected a device that torch computes on, such as 'cpu' or 'cuda', got {quoted(device)}")


def base_of(mass: float | Tensor | None, share: float | None, grid: Grid) -> float | Tensor:
    """Return the base of div A: the mass, a field of masses `(Z, Y, X)`, or the first one for a share of volume.

    Raises
    ------
    ValueError
        If mass and share are both None, or one is out of range or has another shape, or the mass beside a share is not
        one number.
    """
    if share is not None:
        return fraction.first_mass(
            share, None if mass is None else check_open_interval(mass, "a mass in (-1, 1)", -1, 1)
        )
    if mass is None:
        raise ValueError("expected a mass or a volume fraction, got neither")
    if not isinstance(mass, Tensor) or mass.dim() == 0:
        return check_open_interval(mass, "a mass in (-1, 1)", -1, 1)
    check_shape("mass", mass, grid)
    if not bool((mass.abs() < 1).all()):
        raise ValueError(f"expected a mass in (-1, 1), got {float(mass.min())} to {float(mass.max())}")
    return mass.detach().to("cpu", torch.float32).expand(grid.shape).contiguous()
