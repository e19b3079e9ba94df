"""The flows of the paper: from noise at constant mass (Algorithm 1); from a field (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import (
    as_tuple,
    check_choice,
    check_float,
    check_open_interval,
    check_seed,
    check_type,
    quoted,
)
from curvafit.core.runtime import FLOW, check_memory
from curvafit.generation.loop import Checkpoint, Run, first_mass, identity
from curvafit.generation.problem import Cost, Data, DirectForm, DivergenceForm, check_shape, white_noise
from curvafit.generation.result import Callback, Flow
from curvafit.generation.schedule import Schedule, choose_schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.stepper import FusedStepper, LbfgsStepper, TorchStepper
from curvafit.priors import kernels
from curvafit.priors.grid import WORKING_EPSILON, Float, Grid
from curvafit.priors.law import Law, LawLike

#: Standard deviation of the published blur, in working units (two voxels).
WORKING_BLUR = 0.02


@dataclass(frozen=True)
class Execution:
    """How a flow is computed and saved.

    Parameters
    ----------
    device
        Where the flow runs, such as `"cpu"` or `"cuda"`. On processors `generate` takes a fused step where the law is
        six numbers; all else is torch.
    checkpoint, checkpoint_every
        A file in which the run is saved at intervals of that many seconds, and from which it resumes where the file
        exists: the result is the same bit for bit on one machine and number of threads. The file is removed at the end
        unless `keep_checkpoint`, but stays where a callback stopped the flow.

    Raises ValueError if a value is out of range, or torch cannot compute on the device.
    """

    device: torch.device | str = "cpu"
    checkpoint: str | Path | None = None
    checkpoint_every: float = 60.0
    keep_checkpoint: bool = False

    def __post_init__(self) -> None:
        try:
            usable = self.device is not None and torch.zeros(1, device=self.device).add(1).item() == 1
        except (RuntimeError, TypeError, ValueError, AssertionError):
            usable = False
        if not usable:
            device = quoted(self.device)
            raise ValueError(f"torch cannot compute on the device {device} here: take 'cpu', or a GPU that is there")
        check_type(self.checkpoint, (str, Path, type(None)), "a path for the checkpoint")
        check_float(self.checkpoint_every, "a finite number of seconds between checkpoints, at least 0", 0)


def generate(
    law: LawLike,
    mass: float | Tensor | None = None,
    grid: Grid | int | tuple[int, int, int] = 100,
    *,
    volume_fraction: float | None = None,
    schedule: str | Schedule | None = None,
    seed: int | None = 0,
    epsilon: float = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    orientation: Float[Tensor, "3 3 *zyx"] | None = None,
    callbacks: Sequence[Callback] = (),
    reject_early: bool = False,
    execution: Execution = Execution(),
) -> Flow:
    """Make a shape: lower F_ε at constant mass, from white noise or from a field (paper, Algorithm 1).

    Parameters
    ----------
    law
        `Coefficients`: numbers, or tensors that broadcast with the voxels `(Z, Y, X)` and vary in space. Or a `Law`, a
        preset's name, the path of a `fit.json`, or a fit, all in working units.
    mass
        m₀, the mean of u, in (-1, 1), exact to 1e-6 at every step. A tensor `(Z, Y, X)` is m(x), whose mean is m₀: u =
        k ∗ (div A + m). None takes the law's mass, or the mass that the volume fraction needs.
    grid, epsilon, blur
        The sampling, or the number of voxels along (z, y, x), or along each axis, of a periodic box in working units.
        ε and the blur's standard deviation are in spacing's unit.
    volume_fraction
        Share of voxels with u > 0, instead of a mass. Corrections of the mass approach the share while the flow runs,
        and a small constant makes it exact at the end; where that fails, `status` says so. `Flow.mass` is the mass. A
        mass given as well is the one to begin with; a law may make few large bodies from one and many small from
        another.
    schedule
        `"fast"`, `"paper"`, `"deep"`, `"cosine"` (see `SCHEDULES`), or a `Schedule`. None takes the law's: `"deep"` of
        a fit, which was read from such shapes, else `"fast"`.
    seed
        Seed of A's noise at the start. The same seed, grid and number of threads make the same field, bit for bit. None
        starts from A = 0, so that u begins as k ∗ m: the flow of a field m, such as a scan's, which keeps its mass.
    orientation
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x, or a matrix for each voxel; see `priors.orientation`.
    callbacks
        Functions that are called while the flow runs, and may stop it; see `Callback`.
    reject_early
        Stop as soon as a viability check fails (see `Schedule.checks`) instead of after the last step.
    execution
        How the flow is computed and saved: device, checkpoint.

    Where the field is not a shape, or the energy diverged, `Flow.viability.viable` is False and `Flow.status` says why.
    Raises ValueError if an argument is out of range or does not fit the voxels, or a file is not this run's checkpoint.
    """
    check_type(execution, Execution, "an Execution")
    law = Law.of(law)
    mass = law.mass if mass is None and volume_fraction is None else mass
    grid = grid if isinstance(grid, Grid) else Grid(grid)  # type: ignore[arg-type]
    seed = None if seed is None else check_seed(seed)
    cost = Cost(law.coefficients, grid, epsilon, orientation, blur)
    plan, callbacks = choose_schedule([law], schedule), _check_callbacks(callbacks)
    check_memory(grid.shape, FLOW, "a box", execution.device)
    base = choose_base(mass, volume_fraction, grid)
    form = DivergenceForm.of(grid, cost.blur, base)
    start = torch.zeros(3, *grid.shape) if seed is None else white_noise(grid, seed)
    if kernels.has_kernel(execution.device) and cost.fused:
        stepper = FusedStepper(start, form, cost, plan.betas_at(0))
    else:
        stepper = TorchStepper(start, form, cost, plan.betas_at(0), execution.device)
    run = Run(stepper, cost, plan, callbacks, reject_early, volume_fraction, seed)
    return run.flow(_open_checkpoint(execution, run, mass=base))


def descend(
    field: Float[Tensor, "z y x"],
    law: LawLike,
    grid: Grid,
    *,
    method: Literal["lbfgs", "adam"] = "lbfgs",
    steps: int = 200,
    schedule: str | Schedule = "cosine",
    epsilon: float = WORKING_EPSILON,
    blur: float | None = None,
    data: Data | None = None,
    callbacks: Sequence[Callback] = (),
    execution: Execution = Execution(),
) -> Flow:
    """Lower F_ε, or F_ε + D, from a field v₀ to a minimum near it (paper, Algorithm 2: the L² flow under L-BFGS).

    The unknown is v, in u = k ∗ v, and u starts at k ∗ v₀: sharpen v₀ first where the interface's width matters.
    Algorithm 2 blurs u at each iteration; here the blur is part of this map, so that the energy is one function of v.
    The other arguments are those of `generate`.

    Parameters
    ----------
    field
        v₀, `(Z, Y, X)`.
    method
        `"lbfgs"` (a history of 10, and a strong Wolfe line search from length 1) or `"adam"`.
    steps
        Number of steps, of which one of L-BFGS is an iteration with its line search. The flow stops earlier where a
        line search finds no lower energy.
    schedule
        Step lengths of Adam; `steps` replaces the schedule's number of steps.
    blur
        Standard deviation of k; None takes a voxel's shortest edge, as published.
    data
        A term D(u) that is added to F_ε, such as `generation.Evidence`; the history's energies include it.

    Raises ValueError as `generate` does, and if the field is not of the grid's shape or not finite.
    """
    check_choice(method, ("adam", "lbfgs"), "a method 'adam' or 'lbfgs'")
    check_type(execution, Execution, "an Execution")
    blur = min(grid.spacing) if blur is None and isinstance(grid, Grid) else blur
    cost = Cost(Law.of(law).coefficients, grid, epsilon, None, blur, data)  # type: ignore[arg-type]
    plan, callbacks = named_schedule(schedule, steps), _check_callbacks(callbacks)
    if method == "lbfgs":
        plan = Schedule("lbfgs", plan.steps, 1.0, 1.0, "constant")
    field = _check_field(field, grid)
    check_memory(grid.shape, FLOW, "a box", execution.device)
    stepper_class = LbfgsStepper if method == "lbfgs" else TorchStepper
    stepper = stepper_class(field, DirectForm(grid, cost.blur), cost, plan.betas_at(0), execution.device)
    run = Run(stepper, cost, plan, callbacks)
    return run.flow(_open_checkpoint(execution, run, field=field))


def _check_callbacks(callbacks: Sequence[Callback]) -> tuple[Callback, ...]:
    callbacks = as_tuple(callbacks, "callbacks")
    if invalid := [callback for callback in callbacks if not callable(callback)]:
        raise ValueError(f"expected callbacks that can be called, got {quoted(invalid[0])}")
    return callbacks


def _check_field(field: Tensor, grid: Grid) -> Tensor:
    """Return a field of the grid's shape in float32, on the processor."""
    check_type(field, (Tensor, np.ndarray), f"a field of shape {grid.shape}")
    if tuple(field.shape) != grid.shape:
        raise ValueError(f"the field must have the grid's shape {grid.shape}, got {tuple(field.shape)}")
    field = torch.as_tensor(field).detach().to("cpu", torch.float32).contiguous()
    if not bool(torch.isfinite(field).all()):
        raise ValueError("the field must be finite, got NaN or infinity")
    return field


def _open_checkpoint(execution: Execution, run: Run, **start: object) -> Checkpoint | None:
    """Return the checkpoint of a run from `start`, its initial values by name; None where no file is asked for."""
    if execution.checkpoint is None:
        return None
    settings = {**vars(run.cost), "schedule": run.plan, "volume_fraction": run.volume_fraction, "seed": run.seed}
    settings |= {"stepper": type(run.stepper).__name__, "device": execution.device, **start}
    return Checkpoint(execution.checkpoint, execution.checkpoint_every, identity(**settings), execution.keep_checkpoint)


def choose_base(mass: float | Tensor | None, share: float | None, grid: Grid) -> float | Tensor:
    """Return what is added to div A: the mass, a field of masses `(Z, Y, X)`, or the first mass for a volume share."""
    if share is not None:
        return first_mass(share, None if mass is None else check_open_interval(mass, "a mass in (-1, 1)", -1, 1))
    if mass is None:
        raise ValueError("give a mass or a volume fraction, got neither")
    if not isinstance(mass, Tensor) or mass.dim() == 0:
        return check_open_interval(mass, "a mass in (-1, 1)", -1, 1)
    check_shape("mass", mass, grid)
    check_open_interval(float(mass.mean(dtype=torch.float64)), "a mass of finite numbers with a mean in (-1, 1)", -1, 1)
    return mass.detach().to("cpu", torch.float32).expand(grid.shape).contiguous()
