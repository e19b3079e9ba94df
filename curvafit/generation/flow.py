"""The H⁻¹ flow of Algorithm 1: Adam on A, u = k ∗ (div A + base). One loop, two ways to make a step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from curvafit.generation.initial import white_noise
from curvafit.generation.parametrization import DivergenceForm
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.stepper import Stepper, stepper
from curvafit.generation.viability import Viability, viability
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.shapes import Bool, Float

#: Standard deviation of the published blur, in working units (two voxels).
WORKING_BLUR = 0.02
#: Steps between two entries of the history (and two calls of the callbacks).
RECORD_EVERY = 10
#: A flow whose energy falls by less than this share over its last tenth is called converged.
SETTLED = 0.01

Backend = Literal["auto", "torch", "fused"]


@dataclass(frozen=True)
class History:
    """Figures every `RECORD_EVERY` steps and at the end, arrays `(N,)`: the number of steps made, F_ε, max and mean of
    |∂F_ε/∂A| over free voxels, the mean of u."""

    step: np.ndarray
    energy: np.ndarray
    gradient_max: np.ndarray
    gradient_mean: np.ndarray
    mass: np.ndarray


@dataclass(frozen=True)
class State:
    """What a callback sees: the figures of the history's newest entry, and the field, `(Z, Y, X)`, which the next step
    overwrites (clone it to keep it)."""

    field: Tensor
    energy: float
    gradient_max: float
    gradient_mean: float
    mass: float


class Callback(Protocol):
    def __call__(self, step: int, total: int, state: State, /) -> bool | None:
        """Called every `RECORD_EVERY` steps with the number made, and at the end; returning True stops the flow."""
        ...


@dataclass(frozen=True)
class Flow:
    """The end of a flow: the field, float32 `(Z, Y, X)`, how it came there, and whether it is a shape.

    `status` is a sentence; `seed` is None where the flow started from a given field.
    """

    field: Tensor
    history: History
    status: str
    grid: Grid
    viability: Viability
    schedule: Schedule
    seed: int | None


def generate(
    coefficients: Coefficients,
    mass: float,
    grid: Grid,
    *,
    schedule: str | Schedule = "fast",
    seed: int = 0,
    epsilon: float = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    callbacks: Sequence[Callback] = (),
    reject_early: bool = False,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
) -> Flow:
    """Make a shape: lower F_ε from white noise at constant mass (paper, Algorithm 1).

    Parameters
    ----------
    coefficients
        The six numbers, or tensors that broadcast with the voxels (then in plain torch).
    mass
        m₀, the mean of u, in (-1, 1); exact to 1e-6 at every step.
    grid, epsilon, blur
        The sampling; ε and the blur's standard deviation in spacing's unit.
    schedule
        `"fast"`, `"paper"`, or a `Schedule`.
    seed
        Of the start. The same seed, grid and number of threads make the same field, bit for bit.
    callbacks
        See `Callback`.
    reject_early
        Stop as soon as a viability check fails (see `Schedule.checks`) instead of after the last step.
    backend
        `"auto"` takes the fused step where there is one; `"torch"` and `"fused"` insist.
    device
        Where plain torch runs.

    Returns
    -------
    Flow
        With `viability.viable` False, and the reason in `status`, where no shape came out or the energy ran away.

    Raises
    ------
    ValueError
        If the mass is outside (-1, 1), ε is not positive or the blur negative, a name is unknown, or there is no fused
        step for the coefficients or device.
    """
    if not -1 < mass < 1:
        raise ValueError(f"expected a mass in (-1, 1), got {mass}")
    _check_lengths(epsilon, blur)
    plan = named_schedule(schedule)
    form = DivergenceForm.of(grid, blur, mass)
    moved = stepper(white_noise(grid, seed), form, coefficients, epsilon, plan.betas, None, backend, device)
    return _run(moved, grid, epsilon, plan, callbacks, reject_early, seed)


def relax(
    field: Float[Tensor, "z y x"],
    coefficients: Coefficients,
    grid: Grid,
    *,
    schedule: str | Schedule,
    epsilon: float = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    frozen: Bool[Tensor, "z y x"] | None = None,
    callbacks: Sequence[Callback] = (),
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
) -> Flow:
    """The same flow, started at a field v₀: A = 0, u = k ∗ (div A + v₀), so that its mass is kept.

    `frozen` voxels (True) keep their A; the other arguments are `generate`'s. u starts at k ∗ v₀, not at v₀: sharpen
    v₀ first where the interface's width matters.

    Raises
    ------
    ValueError
        If the field or the mask does not have the grid's shape, or is not finite.
    """
    field = torch.as_tensor(field).detach().to("cpu", torch.float32)
    for name, values in (("field", field), ("frozen mask", frozen)):
        if values is not None and tuple(values.shape) != grid.shape:
            raise ValueError(f"expected a {name} of shape {grid.shape}, got {tuple(values.shape)}")
    if not bool(torch.isfinite(field).all()):
        raise ValueError("expected a finite field, got NaN or infinity in it")
    _check_lengths(epsilon, blur)
    plan = named_schedule(schedule)
    form = DivergenceForm.of(grid, blur, field)
    start = torch.zeros((3, *grid.shape))
    moved = stepper(start, form, coefficients, epsilon, plan.betas, frozen, backend, device)
    return _run(moved, grid, epsilon, plan, callbacks, False, None)


def _check_lengths(epsilon: float, blur: float) -> None:
    if not (0 < epsilon < math.inf and 0 <= blur < math.inf):
        raise ValueError(f"expected epsilon > 0 and blur >= 0 in the spacing's unit, got {epsilon} and {blur}")


def _run(
    moved: Stepper,
    grid: Grid,
    epsilon: float,
    plan: Schedule,
    callbacks: Sequence[Callback],
    reject_early: bool,
    seed: int | None,
) -> Flow:
    """The loop: look, then step, until a reason to stop."""
    rows: list[tuple[float, ...]] = []
    stop = ""
    for made in range(plan.steps + 1):
        looking = made % RECORD_EVERY == 0 or made == plan.steps
        moved.step(plan.rate(made) if made < plan.steps else None)
        if looking:
            rows.append((made, *moved.statistics(), moved.mass()))
            stop = _look(moved, made, plan, rows[-1], callbacks)
        if not stop and reject_early and made in plan.checks:
            failed = viability(moved.field(), grid, epsilon)
            stop = "" if failed.viable else f"stopped after {made} of {plan.steps} steps: {failed.reason}"
        if stop:
            break
    field = moved.field().clone()
    end = viability(field, grid, epsilon)
    history = History(*np.array(rows, dtype=np.float64).T)
    return Flow(field, history, _status(stop, end, history), grid, end, plan, seed)


def _look(moved: Stepper, made: int, plan: Schedule, row: tuple[float, ...], callbacks: Sequence[Callback]) -> str:
    """The NaN guard and the callbacks; a sentence where the flow is to stop."""
    if not math.isfinite(row[1]):
        return f"stopped after {made} of {plan.steps} steps: the energy is not finite"
    state = State(moved.field(), *row[1:])
    asked = [bool(callback(made, plan.steps, state)) for callback in callbacks]
    return f"stopped by a callback after {made} of {plan.steps} steps" if any(asked) else ""


def _status(stop: str, end: Viability, history: History) -> str:
    if stop:
        return stop
    made = int(history.step[-1])
    if not end.viable:
        return f"no shape after {made} steps: {end.reason}"
    before = history.energy[np.searchsorted(history.step, 0.9 * made, side="right") - 1]
    fall = (before - history.energy[-1]) / max(abs(before), 1e-30)
    word = "converged" if abs(fall) < SETTLED else "still moving"
    return f"{word} after {made} steps: the energy fell by {100 * fall:.2f} % over the last tenth"
