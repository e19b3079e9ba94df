"""The flows of the paper: from noise at constant mass (Algorithm 1); from a field (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import check_choice, check_float, check_open_interval, check_seed, check_type, quoted
from curvafit.generation.loop import Checkpoint, FlowOptions, first_mass, identity, run
from curvafit.generation.problem import FORMS, Blur, Cost, Data, DivergenceForm, Form, check_shape, white_noise
from curvafit.generation.result import Callback, Flow
from curvafit.generation.schedule import Schedule, choose_schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.slabs import SlabStepper
from curvafit.generation.stepper import FusedStepper, LbfgsStepper, Stepper, TorchStepper
from curvafit.priors import kernels, stencils
from curvafit.priors.grid import WORKING_EPSILON, Bool, Float, Grid
from curvafit.priors.law import Law, LawLike

#: Standard deviation of the published blur, in working units (two voxels).
WORKING_BLUR = 0.02
#: Seconds between two checkpoints by default.
CHECKPOINT_EVERY = 60.0
#: The ways to run a flow: see `generate`.
Backend = Literal["auto", "torch", "fused", "slabs"]
BACKENDS = get_args(Backend)


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
    snapshots: Sequence[int] = (),
    callbacks: Sequence[Callback] = (),
    reject_early: bool = False,
    checkpoint: str | Path | None = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    keep_checkpoint: bool = False,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
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
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x; see `priors.energy.orientation`.
    snapshots, callbacks
        Numbers of steps after which `Flow.snapshots` keeps the field; functions as `Callback` describes them.
    reject_early
        Stop as soon as a viability check fails (see `Schedule.checks`) instead of after the last step.
    checkpoint, checkpoint_every
        A file in which the run is saved at intervals of that many seconds, and from which it resumes where the file
        exists: the result is the same bit for bit on one machine and number of threads. The file is removed at the end
        unless `keep_checkpoint`, but stays where a callback stopped the flow.
    backend
        `"auto"` takes the fused step on processors and plain torch elsewhere; `"torch"` and `"fused"` take only that
        step. `"slabs"` is the fused step over the processes of `slabs.lead`.
    device
        Where torch runs, such as `"cpu"` or `"cuda"`.

    Where the field is not a shape, or the energy diverged, `Flow.viability.viable` is False and `Flow.status` says why.
    Raises ValueError if an argument is out of range or does not fit the voxels, a file is not this run's checkpoint, or
    the device has no fused step.
    """
    known = Law.of(law)
    mass = known.mass if mass is None and volume_fraction is None else mass
    grid, seed = grid if isinstance(grid, Grid) else Grid(grid), check_seed(seed)  # type: ignore[arg-type]
    execution = _Execution(backend, device, checkpoint, checkpoint_every, keep_checkpoint)
    plan = choose_schedule([known], schedule)
    cost = Cost(known.coefficients, grid, epsilon, orientation, blur)
    options = FlowOptions(cost, plan, callbacks, snapshots, reject_early, volume_fraction)
    options.check_memory(device)
    base = choose_base(mass, volume_fraction, grid)
    form = DivergenceForm.of(grid, cost.blur, base, execution.blur)
    stepper = execution.stepper(white_noise(grid, seed), form, options)
    return run(stepper, options, seed, execution.checkpoint_file(stepper, options, seed=seed, mass=base))


def descend(
    field: Float[Tensor, "z y x"],
    law: LawLike,
    grid: Grid,
    *,
    flow: Literal["l2", "h-1"] = "l2",
    optimiser: Literal["lbfgs", "adam"] = "lbfgs",
    steps: int = 200,
    schedule: str | Schedule = "cosine",
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float | None = None,
    orientation: Float[Tensor, "3 3"] | None = None,
    data: Data | None = None,
    frozen: Bool[Tensor, "z y x"] | None = None,
    callbacks: Sequence[Callback] = (),
    checkpoint: str | Path | None = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
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
        `"lbfgs"` (a history of 10, and a strong Wolfe line search from length 1) or `"adam"`.
    steps
        Number of steps. A step of L-BFGS is one iteration with its line search, and the flow stops earlier where the
        line search finds no lower energy.
    schedule
        Step lengths of Adam; `steps` replaces the schedule's number of steps.
    blur
        Standard deviation of k; None takes a voxel's shortest edge, as published.
    data
        A term D(u) that is added to F_ε, such as `generation.problem.Evidence`; the history's energies include it.
    frozen
        Voxels whose v, or A, stays.

    Raises ValueError as `generate` does, and if the field or the mask is not of the grid's shape or not finite.
    """
    check_choice(flow, FORMS, f"a flow among {', '.join(FORMS)}")
    check_choice(optimiser, ("adam", "lbfgs"), "an optimiser 'adam' or 'lbfgs'")
    plan = named_schedule(schedule, steps)
    if optimiser == "lbfgs":
        plan = Schedule("lbfgs", steps, 1.0, 1.0, "constant")
    width = min(grid.spacing) if blur is None and isinstance(grid, Grid) else blur
    cost = Cost(Law.of(law).coefficients, grid, epsilon, orientation, width, data)  # type: ignore[arg-type]
    execution = _Execution(backend, device, checkpoint, checkpoint_every)
    options = FlowOptions(cost, plan, callbacks)
    _check_voxels("field", field, grid)
    if frozen is not None:
        _check_voxels("frozen mask", frozen, grid)
    options.check_memory(execution.device)
    field = torch.as_tensor(field).detach().to("cpu", torch.float32).contiguous()
    if not bool(torch.isfinite(field).all()):
        raise ValueError("the field must be finite, got NaN or infinity")
    form, start = FORMS[flow].start_at(field, grid, cost.blur, execution.blur)
    stepper = execution.stepper(start, form, options, optimiser, frozen)
    checkpoint_file = execution.checkpoint_file(stepper, options, flow=flow, field=field, frozen=frozen)
    return run(stepper, options, None, checkpoint_file)


def _check_voxels(name: str, values: Tensor, grid: Grid) -> None:
    check_type(values, (Tensor, np.ndarray), f"a {name} of shape {grid.shape}")
    if tuple(values.shape) != grid.shape:
        raise ValueError(f"the {name} must have the grid's shape {grid.shape}, got {tuple(values.shape)}")


@dataclass(frozen=True)
class _Execution:
    """How a flow is computed and saved: the arguments of `generate`, which are checked here."""

    backend: str
    device: torch.device | str
    checkpoint: str | Path | None
    every: float
    keep: bool = False

    def __post_init__(self) -> None:
        check_choice(self.backend, BACKENDS, f"a backend among {', '.join(BACKENDS)}")
        check_device(self.device)
        check_type(self.checkpoint, (str, Path, type(None)), "a path for the checkpoint")
        check_float(self.every, "a finite number of seconds between checkpoints, at least 0", 0)

    @property
    def plain(self) -> bool:
        """Whether the step is plain torch wherever it runs."""
        return self.backend == "torch"

    @property
    def blur(self) -> Blur:
        """The function that blurs in forms."""
        return stencils.gaussian_blur if self.plain else kernels.gaussian_blur

    def stepper(
        self, start: Tensor, form: Form, options: FlowOptions, optimiser: str = "adam", frozen: Tensor | None = None
    ) -> Stepper:
        """Return the stepper of one shape: fused where there is a kernel, unless the backend is plain torch."""
        cost, betas = options.cost, options.plan.betas_at(0)
        has_kernel = kernels.has_kernel(self.device)
        if self.backend == "fused" and not has_kernel:
            raise ValueError(f"the device {self.device} has no fused step: take backend='torch', or the device 'cpu'")
        if self.backend == "slabs":
            if not has_kernel or not isinstance(form, DivergenceForm) or optimiser != "adam" or frozen is not None:
                raise ValueError("slabs are for a flow of `generate` on processors: leave the backend out")
            return SlabStepper(start, form, cost, betas)
        fusible = optimiser == "adam" and cost.data is None and not self.plain
        if fusible and has_kernel and isinstance(form, DivergenceForm):
            return FusedStepper(start, form, cost, betas, frozen)
        kind = LbfgsStepper if optimiser == "lbfgs" else TorchStepper
        return kind(start, form, cost, betas, frozen, self.device, fused=not self.plain)

    def checkpoint_file(self, stepper: Stepper, options: FlowOptions, **start: object) -> Checkpoint | None:
        """Return the checkpoint of a run from a start, or None where the run has none."""
        if self.checkpoint is None:
            return None
        plan, share, snapshots = options.plan, options.volume_fraction, [*options.snapshots]
        job = {**vars(options.cost), "schedule": plan, "volume_fraction": share, "snapshots": snapshots, **start}
        # Slabs go on from what one process saved, and the other way round.
        name = FusedStepper.__name__ if isinstance(stepper, SlabStepper) else type(stepper).__name__
        place = {"stepper": name, "backend": self.backend.replace("slabs", "auto"), "device": self.device}
        return Checkpoint(self.checkpoint, self.every, identity(**job, **place), self.keep)


def check_device(device: torch.device | str) -> None:
    """Raise ValueError where torch cannot compute on a device."""
    try:
        usable = device is not None and torch.zeros(1, device=device).add(1).item() == 1
    except (RuntimeError, TypeError, ValueError, AssertionError):
        usable = False
    if not usable:
        raise ValueError(
            f"torch cannot compute on the device {quoted(device)} here: take 'cpu', or a GPU that is there"
        )


def choose_base(mass: float | Tensor | None, share: float | None, grid: Grid) -> float | Tensor:
    """Return the base of div A: the mass, a field of masses `(Z, Y, X)`, or the first mass for a share of volume."""
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
