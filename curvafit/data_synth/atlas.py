"""Build an atlas: draw parameters, generate, keep what is viable, and measure the fields and their masks."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from curvafit.data_synth.design import LAW, random_law, start_seed
from curvafit.data_synth.store import Record, Settings, Store, open_store
from curvafit.diagram import Diagram, diagram
from curvafit.generation.flow import WORKING_BLUR, generate
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.transport import TAIL_SHARE

#: Progress(record, viable so far, draws so far), called after every new draw.
Progress = Callable[[Record, int, int], None]
#: Edge of the bins in the (κ1, κ2) plane, in 1 / working unit: the one that distances are taken with.
BIN_WIDTH = 2.0


def build(
    store_path: str | Path,
    count: int,
    shape: int | Sequence[int],
    seed: int = 0,
    schedule: str | Schedule = "fast",
    progress: Progress | None = None,
) -> Store:
    """Generate draws 0, 1, 2 … of the random law until `count` are viable; resumes a store that has some already.

    Draw i depends on (seed, i) alone, so however often it is stopped and resumed, the store ends with the same draws.

    Parameters
    ----------
    store_path
        Folder of the store, created where missing.
    count
        Viable shapes to end with.
    shape
        Voxels (z, y, x), or one number for a cube; the box is periodic, in working units.
    progress
        Called after every new draw with its record, the number of viable draws and of all draws.

    Raises
    ------
    ValueError
        If `count` is not positive, or the store was made with other settings or by another format version.
    """
    if count < 1:
        raise ValueError(f"expected a count of at least 1 shape, got {count}")
    z, y, x = (shape,) * 3 if isinstance(shape, int) else shape
    grid = Grid((z, y, x))
    plan = named_schedule(schedule)
    settings = Settings(
        grid.shape, grid.spacing, WORKING_EPSILON, WORKING_BLUR, LAW, int(seed), dataclasses.asdict(plan)
    )
    store = open_store(store_path, settings)
    done = {index: store.record(index).viability.viable for index in store.indices()}
    index = 0
    while sum(done.values()) < count:
        if index not in done:
            record = _draw(store, index, grid, plan)
            done[index] = record.viability.viable
            if progress is not None:
                progress(record, sum(done.values()), len(done))
        index += 1
    return store


def diagrams(field: torch.Tensor, grid: Grid, epsilon: float) -> tuple[Diagram, Diagram]:
    """Geometric diagrams of a phase field (Z, Y, X) and of its mask {u > 0}, re-profiled as a scan's mask is.

    Thinned with the bins that `transport.wasserstein` uses, so that a distance to them is the one to the whole diagram.
    """
    profile = phase_field(field > 0, grid, epsilon)
    seen = (diagram(u, grid, epsilon, curvature="geometric") for u in (field, profile))
    of_field, of_mask = (measure.thinned(BIN_WIDTH, TAIL_SHARE) for measure in seen)
    return of_field, of_mask


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that a generated field depends on."""
    names = ("curvafit", "torch", "numpy", "numba")
    return {"python": platform.python_version()} | {name: _version(name) for name in names}


def _draw(store: Store, index: int, grid: Grid, plan: Schedule) -> Record:
    """Generate one draw and store it."""
    settings = store.settings
    coefficients, mass = random_law(settings.seed, index)
    seed = start_seed(settings.seed, index)
    began = time.perf_counter()
    flow = generate(
        coefficients,
        mass,
        grid,
        schedule=plan,
        seed=seed,
        epsilon=settings.epsilon,
        blur=settings.blur,
        reject_early=True,
    )
    record = Record(
        index=index,
        coefficients=coefficients,
        mass=mass,
        seed=seed,
        steps=int(flow.history.step[-1]) if len(flow.history.step) else 0,
        viability=flow.viability,
        energy=float(flow.history.energy[-1]) if len(flow.history.energy) else math.nan,
        status=flow.status,
        versions=versions(),
        seconds=time.perf_counter() - began,
    )
    store.write(record, flow.field.cpu().numpy().astype("float32") if record.viability.viable else None)
    return record


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
