"""The flows of the paper: from noise at constant mass (Algorithm 1); from a field (Algorithm 2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import check_choice, check_float, check_open_interval, check_seed, check_type, quoted
from curvafit.generation.loop import Checkpoint, FlowOptions, first_mass, identity, run
from curvafit.generation.problem import FORMS, Blur, Cost, Data, DivergenceForm, Form, check_shape, white_noise
from curvafit.generation.result import Flow, Watch
from curvafit.generation.schedule import Schedule, choose_schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.stepper import FusedStepper, LbfgsStepper, Stepper, TorchStepper
from curvafit.priors import kernels, stencils
from curvafit.priors.grid import WORKING_EPSILON, Bool, Float, Grid
from curvafit.priors.law import Law, LawLike

#: Standard deviation of the published blur, in working units (two voxels).
WORKING_BLUR = 0.02
#: The ways to run a flow: see `Execution`.
Backend = Literal["auto", "torch", "fused"]
BACKENDS = get_args(Backend)


@dataclass(frozen=True)
class Execution:
    """How a flow is computed and saved.

    Parameters
    ----------
    backend
        `"auto"` takes the fused step on processors and plain torch elsewhere; `"torch"` and `"fused"` take only that
        step.
    device
        Where torch runs, such as `"cpu"` or `"cuda"`.
    checkpoint, checkpoint_every
        A file in which the run is saved at intervals of that many seconds, and from which it resumes where the file
        exists: the result is the same bit for bit on one machine and number of threads. The file is removed at the end
        unless `keep_checkpoint`, but stays where a callback stopped the flow.

    Raises ValueError if a value is out of range, or torch cannot compute on the device.
    """

    backend: Backend = "auto"
    device: torch.device | str = "cpu"
    checkpoint: str | Path | None = None
    checkpoint_every: float = 60.0
    keep_checkpoint: bool = False

    def __post_init__(self) -> None:
        check_choice(self.backend, BACKENDS, f"a backend among {', '.join(BACKENDS)}")
        try:
            usable = self.device is not None and torch.zeros(1, device=self.device).add(1).item() == 1
        except (RuntimeError, TypeError, ValueError, AssertionError):
            usable = False
        if not usable:
            device = quoted(self.device)
            raise ValueError(f"torch cannot compute on the device {device} here: take 'cpu', or a GPU that is there")
        check_type(self.checkpoint, (str, Path, type(None)), "a path for the checkpoint")
        check_float(self.checkpoint_every, "a finite number of seconds between checkpoints, at least 0", 0)


@dataclass(frozen=True)
class Optimiser:
    """The steps of `descend`: their method, their number, and the schedule of their lengths.

    Parameters
    ----------
    method
        `"lbfgs"` (a history of 10, and a strong Wolfe line search from length 1) or `"adam"`.
    steps
        Number of steps. A step of L-BFGS is one iteration with its line search.
    schedule
        Step lengths of Adam; `steps` replaces the schedule's number of steps.

    Raises ValueError if a value is out of range.
    """

    method: Literal["lbfgs", "adam"] = "lbfgs"
    steps: int = 200
    schedule: str | Schedule = "cosine"

    def __post_init__(self) -> None:
        check_choice(self.method, ("adam", "lbfgs"), "an optimiser 'adam' or 'lbfgs'")
        named_schedule(self.schedule, self.steps)

    @property
    def plan(self) -> Schedule:
        """The schedule of the method."""
        if self.method == "lbfgs":
            return Schedule("lbfgs", self.steps, 1.0, 1.0, "constant")
        return named_schedule(self.schedule, self.steps)


def generate(
    law: LawLike,
    mass: float | Tensor | None = None,
    grid: Grid | int | tuple[int, int, int] = 100,
    *,
    volume_fraction: float | None = None,
    schedule: str | Schedule | None = None,
    seed: int = 0,
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    orientation: Float[Tensor, "3 3"] | None = None,
    watch: Watch = Watch(),
    reject_early: bool = False,
    execution: Execution = Execution(),
) -> Flow:
    """Make a shape: lower F_ε from white noise at constant mass (paper, Algorithm 1).

    Parameters
    ----------
    law
        `Coefficients`: numbers, or tensors that broadcast with the voxels `(Z, Y, X)` and vary in space. Or a `Law`, a
        preset's name, the path of a `fit.json`, or a fit, all in working units.
    mass
        m₀, the mean of u, in (-1, 1), exact to 1e-6 at every step. A tensor is m(x): u = k ∗ (div A + m). None takes
        the law's mass, or the mass that the volume fraction needs.
    grid, epsilon, blur
        The sampling, or the number of voxels along (z, y, x), or along each axis, of a periodic box in working units.
        ε is a number or a tensor that broadcasts with the voxels; ε and the blur's standard deviation are in spacing's
        unit.
    volume_fraction
        Share of voxels with u > 0, instead of a mass. Corrections of the mass approach the share while the flow runs,
        and a small constant makes it exact at the end; where that fails, `status` says so. `Flow.mass` is the mass. A
        mass given as well is the one to begin with; a law may make few large bodies from one and many small from
        another.
    schedule
        `"fast"`, `"paper"`, `"deep"`, `"cosine"` (see `SCHEDULES`), or a `Schedule`. None takes the law's: `"deep"` of
        a fit, which was read from such shapes, else `"fast"`.
    seed
        Seed of the start. The same seed, grid and number of threads make the same field, bit for bit.
    orientation
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x; see `priors.orientation`.
    watch
        What is taken from the flow while it runs: snapshots, and calls of functions.
    reject_early
        Stop as soon as a viability check fails (see `Schedule.checks`) instead of after the last step.
    execution
        How the flow is computed and saved: backend, device, checkpoint.

    Where the field is not a shape, or the energy diverged, `Flow.viability.viable` is False and `Flow.status` says why.
    Raises ValueError if an argument is out of range or does not fit the voxels, a file is not this run's checkpoint, or
    the device has no fused step.
    """
    check_type(execution, Execution, "an Execution")
    law = Law.of(law)
    mass = law.mass if mass is None and volume_fraction is None else mass
    grid, seed = grid if isinstance(grid, Grid) else Grid(grid), check_seed(seed)  # type: ignore[arg-type]
    cost = Cost(law.coefficients, grid, epsilon, orientation, blur)
    options = FlowOptions(cost, choose_schedule([law], schedule), watch, reject_early, volume_fraction)
    options.check_memory(execution.device)
    base = choose_base(mass, volume_fraction, grid)
    form = DivergenceForm.of(grid, cost.blur, base, _choose_blur(execution))
    stepper = _make_stepper(execution, white_noise(grid, seed), form, options)
    return run(stepper, options, seed, _open_checkpoint(execution, stepper, options, seed=seed, mass=base))


def descend(
    field: Float[Tensor, "z y x"],
    law: LawLike,
    grid: Grid,
    *,
    flow: Literal["l2", "h-1"] = "l2",
    optimiser: Optimiser = Optimiser(),
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float | None = None,
    orientation: Float[Tensor, "3 3"] | None = None,
    data: Data | None = None,
    frozen: Bool[Tensor, "z y x"] | None = None,
    watch: Watch = Watch(),
    execution: Execution = Execution(),
) -> Flow:
    """Lower F_ε, or F_ε + D, from a field v₀ to a minimum near it (paper, Algorithm 2: the L² flow under L-BFGS).

    u starts at k ∗ v₀: sharpen v₀ first where the interface's width matters. The other arguments are those of
    `generate`.

    Parameters
    ----------
    field
        v₀, `(Z, Y, X)`.
    flow
        `"l2"`: u = k ∗ v with v free. Algorithm 2 blurs u at each iteration; here the blur is part of this map, so that
        the energy is one function of v. `"h-1"`: u = k ∗ (div A + v₀) from A = 0, the flow of `generate`, at constant
        mass.
    optimiser
        L-BFGS or Adam, and its steps. The flow stops earlier where a line search finds no lower energy.
    blur
        Standard deviation of k; None takes a voxel's shortest edge, as published.
    data
        A term D(u) that is added to F_ε, such as `generation.Evidence`; the history's energies include it.
    frozen
        Voxels whose v, or A, stays.

    Raises ValueError as `generate` does, and if the field or the mask is not of the grid's shape or not finite.
    """
    check_choice(flow, FORMS, f"a flow among {', '.join(FORMS)}")
    check_type(optimiser, Optimiser, "an Optimiser")
    check_type(execution, Execution, "an Execution")
    blur = min(grid.spacing) if blur is None and isinstance(grid, Grid) else blur
    cost = Cost(Law.of(law).coefficients, grid, epsilon, orientation, blur, data)  # type: ignore[arg-type]
    options = FlowOptions(cost, optimiser.plan, watch)
    _check_voxels("field", field, grid)
    if frozen is not None:
        _check_voxels("frozen mask", frozen, grid)
    options.check_memory(execution.device)
    field = torch.as_tensor(field).detach().to("cpu", torch.float32).contiguous()
    if not bool(torch.isfinite(field).all()):
        raise ValueError("the field must be finite, got NaN or infinity")
    form, start = FORMS[flow].start_at(field, grid, cost.blur, _choose_blur(execution))
    stepper = _make_stepper(execution, start, form, options, optimiser.method, frozen)
    checkpoint = _open_checkpoint(execution, stepper, options, flow=flow, field=field, frozen=frozen)
    return run(stepper, options, None, checkpoint)


def _check_voxels(name: str, values: Tensor, grid: Grid) -> None:
    check_type(values, (Tensor, np.ndarray), f"a {name} of shape {grid.shape}")
    if tuple(values.shape) != grid.shape:
        raise ValueError(f"the {name} must have the grid's shape {grid.shape}, got {tuple(values.shape)}")


def _choose_blur(execution: Execution) -> Blur:
    return stencils.gaussian_blur if execution.backend == "torch" else kernels.gaussian_blur


def _make_stepper(
    execution: Execution, start: Tensor, form: Form, options: FlowOptions, method: str = "adam",
    frozen: Tensor | None = None,
) -> Stepper:  # fmt: skip
    """Return the stepper of a flow from `start`: fused where there is a kernel, unless the backend is plain torch."""
    cost, betas, device = options.cost, options.plan.betas_at(0), execution.device
    has_kernel, plain = kernels.has_kernel(device), execution.backend == "torch"
    if execution.backend == "fused" and not has_kernel:
        raise ValueError(f"the device {device} has no fused step: take backend='torch', or the device 'cpu'")
    if method == "adam" and cost.data is None and not plain and has_kernel and isinstance(form, DivergenceForm):
        return FusedStepper(start, form, cost, betas, frozen)
    stepper = LbfgsStepper if method == "lbfgs" else TorchStepper
    return stepper(start, form, cost, betas, frozen, device, fused=not plain)


def _open_checkpoint(
    execution: Execution, stepper: Stepper, options: FlowOptions, **start: object
) -> Checkpoint | None:
    """Return the checkpoint of a run from `start`, its initial values by name; None where no file is asked for."""
    if execution.checkpoint is None:
        return None
    settings = {**vars(options.cost), "schedule": options.plan, "volume_fraction": options.volume_fraction, **start}
    settings |= {"snapshots": [*options.watch.snapshots], "device": execution.device}
    settings |= {"stepper": type(stepper).__name__, "backend": execution.backend}
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
    if not bool((mass.abs() < 1).all()):
        raise ValueError(f"the mass must be in (-1, 1), got {float(mass.min())} to {float(mass.max())}")
    return mass.detach().to("cpu", torch.float32).expand(grid.shape).contiguous()
