"""The flows of the paper: from noise at constant mass (Algorithm 1), and from a field (Algorithm 2 and others)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import check_choice, check_seed, quoted
from curvafit.generation.cost import Cost
from curvafit.generation.data import Data
from curvafit.generation.initial import white_noise
from curvafit.generation.loop import Orders, run
from curvafit.generation.forms import FORMS, DivergenceForm
from curvafit.generation.result import RECORD_EVERY, Callback, Flow, History, State
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.setup import Execution, base_of
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import Law, LawLike
from curvafit.priors.shapes import Bool, Float

__all__ = ["RECORD_EVERY", "WORKING_BLUR", "Flow", "History", "State", "descend", "generate", "relax"]

#: Standard deviation of the published blur, in working units (two voxels).
WORKING_BLUR = 0.02
#: Seconds between two checkpoints by default.
CHECKPOINT_EVERY = 60.0

Backend = Literal["auto", "torch", "fused", "compiled"]


def generate(
    law: LawLike,
    mass: float | Tensor | None = None,
    grid: Grid | int | tuple[int, int, int] = 100,
    *,
    volume_fraction: float | None = None,
    schedule: str | Schedule = "fast",
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
        mass beside it is the one to begin with; a law may make few large bodies from one and many small from another.
    schedule
        `"fast"`, `"paper"`, `"deep"`, `"cosine"` (see `SCHEDULES`), or a `Schedule`.
    seed
        Seed of the start. The same seed, grid and number of threads make the same field, bit for bit.
    orientation
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x; see `priors.energy.orientation`.
    snapshots
        Numbers of steps after which `Flow.snapshots` keeps the field.
    callbacks
        See `Callback`.
    reject_early
        Stop as soon as a viability check fails (see `Schedule.checks`) instead of after the last step.
    checkpoint, checkpoint_every
        A file in which the run is saved at intervals of that many seconds, and from which it resumes where the file
        exists: the result is the same bit for bit on one machine and number of threads. The file is removed at the end,
        but stays where a callback stopped the flow.
    keep_checkpoint
        Whether the file stays at the end too, for the caller to remove once the result is safe.
    backend
        `"auto"` takes the fused step on processors and plain torch elsewhere; `"torch"` and `"fused"` take only that
        step. `"compiled"` passes the plain step through `torch.compile`; where that fails, a warning says so and the
        step stays plain.
    device
        Where torch runs, such as `"cpu"` or `"cuda"`.

    Returns
    -------
    Flow
        Its `viability.viable` is False, and its `status` holds the reason, where the field is not a shape or the energy
        diverged.

    Raises
    ------
    ValueError
        If the mass is outside (-1, 1), ε is not positive or the blur negative, a tensor does not broadcast with the
        voxels, a name is unknown, a file is not this run's checkpoint, or there is no fused step for the device.
    """
    known = Law.of(law)
    mass = known.mass if mass is None and volume_fraction is None else mass
    grid, seed = grid if isinstance(grid, Grid) else Grid(grid), check_seed(seed)  # type: ignore[arg-type]
    execution = Execution(backend, device, checkpoint, checkpoint_every, keep_checkpoint)
    plan = named_schedule(schedule)
    cost = Cost(known.coefficients, grid, epsilon, orientation, blur)
    orders = Orders(cost, plan, callbacks, snapshots, reject_early, volume_fraction)
    orders.check_memory(device)
    base = base_of(mass, volume_fraction, grid)
    form = DivergenceForm.of(grid, cost.blur, base, execution.blur)
    stepper = execution.stepper(white_noise(grid, seed), form, cost, plan, "adam", None)
    checkpoint_file = execution.checkpoint_file(stepper, cost, orders, seed=seed, mass=base)
    return run(stepper, [orders], [seed], checkpoint_file)[0]


def relax(
    field: Float[Tensor, "z y x"],
    law: LawLike,
    grid: Grid,
    *,
    schedule: str | Schedule,
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    orientation: Float[Tensor, "3 3"] | None = None,
    frozen: Bool[Tensor, "z y x"] | None = None,
    snapshots: Sequence[int] = (),
    callbacks: Sequence[Callback] = (),
    checkpoint: str | Path | None = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
) -> Flow:
    """Lower F_ε from a field v₀ at constant mass: the flow of `generate` with u = k ∗ (div A + v₀), from A = 0.

    Voxels where `frozen` is True keep their A; the other arguments are those of `generate`. u starts at k ∗ v₀, not at
    v₀: sharpen v₀ first where the interface's width matters.

    Raises
    ------
    ValueError
        If the field or the mask does not have the grid's shape, or the field is not finite; otherwise as `generate`
        does.
    """
    cost = Cost(Law.of(law).coefficients, grid, epsilon, orientation, blur)
    execution = Execution(backend, device, checkpoint, checkpoint_every)
    orders = Orders(cost, named_schedule(schedule), callbacks, snapshots)
    return _from_field(field, cost, execution, "h-1", "adam", frozen, orders)


def descend(
    field: Float[Tensor, "z y x"],
    law: LawLike,
    grid: Grid,
    *,
    flow: Literal["l2", "mass", "h-1"] = "l2",
    optimiser: Literal["lbfgs", "adam"] = "lbfgs",
    steps: int = 200,
    schedule: str | Schedule = "cosine",
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float | None = None,
    orientation: Float[Tensor, "3 3"] | None = None,
    data: Data | None = None,
    snapshots: Sequence[int] = (),
    callbacks: Sequence[Callback] = (),
    checkpoint: str | Path | None = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
) -> Flow:
    """Lower F_ε, or F_ε + D, from a field v₀ to a minimum near it (paper, Algorithm 2: the L² flow under L-BFGS).

    u starts at k ∗ v₀. The other arguments are those of `generate`.

    Parameters
    ----------
    field
        v₀, `(Z, Y, X)`.
    flow
        `"l2"`: u = k ∗ v with v free. Algorithm 2 blurs u at each iteration; here the blur is part of this map, so that
        the energy is one function of v. `"mass"`: u = k ∗ (v - mean v) + m₀, the L² flow at constant mass. `"h-1"`: the
        flow of `relax`.
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
        A term D(u) that is added to F_ε, such as `generation.data.Evidence`; the history's energies include it.

    Raises
    ------
    ValueError
        If the flow or the optimiser has another name; otherwise as `relax` does.
    """
    check_choice(flow, FORMS, f"a flow among {', '.join(FORMS)}")
    plan = named_schedule(schedule, steps)
    if isinstance(optimiser, str) and optimiser == "lbfgs":
        plan = Schedule("lbfgs", steps, 1.0, 1.0, "constant")
    width = min(grid.spacing) if blur is None and isinstance(grid, Grid) else blur
    cost = Cost(Law.of(law).coefficients, grid, epsilon, orientation, width, data)  # type: ignore[arg-type]
    execution = Execution(backend, device, checkpoint, checkpoint_every)
    orders = Orders(cost, plan, callbacks, snapshots)
    return _from_field(field, cost, execution, flow, optimiser, None, orders)


def _from_field(
    field: Tensor, cost: Cost, execution: Execution, flow: str, optimiser: str, frozen: Tensor | None, orders: Orders
) -> Flow:
    """Check a field and a frozen mask, and run a flow from the field."""
    grid, plan = cost.grid, orders.plan
    for name, values in (("field", field), ("frozen mask", frozen)):
        if name == "field" or values is not None:
            if not isinstance(values, (Tensor, np.ndarray)):
                raise ValueError(f"expected a {name} of shape {grid.shape}, got {quoted(values)}")
            if tuple(values.shape) != grid.shape:
                raise ValueError(f"expected a {name} of shape {grid.shape}, got {tuple(values.shape)}")
    orders.check_memory(execution.device)
    field = torch.as_tensor(field).detach().to("cpu", torch.float32).contiguous()
    if not bool(torch.isfinite(field).all()):
        raise ValueError("expected a finite field, got NaN or infinity")
    form, start = FORMS[flow].at(field, grid, cost.blur, execution.blur)
    stepper = execution.stepper(start, form, cost, plan, optimiser, frozen)
    checkpoint_file = execution.checkpoint_file(stepper, cost, orders, flow=flow, field=field, frozen=frozen)
    return run(stepper, [orders], [None], checkpoint_file)[0]
