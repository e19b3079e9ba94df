"""Build an atlas, a store of generated shapes; summarise and verify it."""

from __future__ import annotations

import itertools
import math
import platform
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path

import numpy as np
from llvmlite import binding

from curvafit.core.checks import check_int, check_seed, check_type
from curvafit.core.runtime import FILE, FLOW, Progress, check_memory, silent
from curvafit.core.workers import Cluster, run_jobs
from curvafit.data_synth.design import Design, design_box
from curvafit.data_synth.store import Record, Settings, Store, open_store
from curvafit.generation.flow import WORKING_BLUR, generate
from curvafit.generation.schedule import Schedule, present_name
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.threads import one_thread

#: A build ends with an error where fewer than one draw in so many is viable.
BARREN = 200
#: Viable shapes that a store may be asked for.
MOST = 10**7


def build(
    store_path: str | Path,
    count: int,
    shape: int | Sequence[int],
    seed: int = 0,
    schedule: str | Schedule = "fast",
    progress: Progress = silent,
    *,
    design: Design | None = None,
    workers: Cluster | None = None,
) -> Store:
    """Generate draws 0, 1, 2 … of a design until `count` are viable; a store that has some already is resumed.

    Draw i depends on (design, seed, i) alone: stopped, resumed and with any number of workers, a store ends with the
    same draws, of which the last is the `count`-th viable one.

    The shape is voxels (z, y, x), or one number for a cube; the box is periodic, in working units. `progress` is called
    after every new draw. By default the design is Experiment 4's random law, and this process makes the draws, else
    `workers` (see `cluster`).

    Raises ValueError where the store was made with other settings, a shape does not fit into memory, or hardly any draw
    is viable; OSError where the store can't be written or the workers are gone. Finished draws are kept.
    """
    check_int(count, "a count of shapes from 1", 1, MOST)
    if workers is None:
        check_memory(Grid(shape).shape, FLOW, "a shape")  # type: ignore[arg-type]
    settings = make_settings(shape, seed, schedule, design)
    return _fill(open_store(store_path, settings), count, workers, progress)


def extend(store_path: str | Path, count: int, progress: Progress = silent, *, workers: Cluster | None = None) -> Store:
    """Continue a store, by its own settings, until it has `count` more viable shapes than were wanted so far.

    A count of 0 finishes a build that was stopped. Raises FileNotFoundError where there is no store, and as `build`.
    """
    check_int(count, "a count of shapes from 0", 0, MOST)
    store = open_store(store_path)
    return _fill(store, store.wanted + count, workers, progress)


def make_settings(
    shape: int | Sequence[int], seed: int = 0, schedule: str | Schedule = "fast", design: Design | None = None
) -> Settings:
    """Return the settings of the store that `build` makes from these arguments, or raise ValueError."""
    grid = Grid(shape)  # type: ignore[arg-type]
    check_memory(grid.shape, FILE, "a shape")
    if design is not None:
        check_type(design, Design, "a Design")
    plan, design = named_schedule(schedule).as_dict(), design or design_box()
    return Settings(grid.shape, grid.spacing, WORKING_EPSILON, WORKING_BLUR, design.as_dict(), check_seed(seed), plan)


def _fill(store: Store, count: int, workers: Cluster | None, progress: Progress) -> Store:
    """Make draws in order, in rounds of as many as are needed at least, so that the last draw is viable."""
    store.want(count)
    viable = {index: store.viable(index) for index in store.indices()}
    rest = (index for index in itertools.count() if index not in viable)
    while (missing := count - sum(viable.values())) > 0:
        for record in run_jobs(partial(make_draw, store.path.resolve()), islice(rest, missing), workers):
            viable[record.index] = record.viability.viable
            made = sum(viable.values())
            progress(f"{made} viable of {len(viable)} draws", made / count)
            if len(viable) > BARREN * (1 + made):
                what = f"hardly any draw of this design is viable: {made} of {len(viable)}"
                raise ValueError(f"{what}; the last was not, as {record.status}")
    return store


def make_draw(path: str | Path, index: int) -> Record:
    """Make a draw of a store, unless it is there, and return its record: a worker's part of `build`.

    It is made on one thread, so that a field depends on nothing but its store's settings, its index and the kind of
    processor.
    """
    store, began = open_store(path), time.perf_counter()
    if store.has(index):
        return store.record(index)
    settings = store.settings
    draw = Design.from_dict(settings.design).draw(settings.seed, index)
    grid, plan = Grid(settings.shape, settings.spacing), Schedule(**settings.schedule)
    how = {"epsilon": settings.epsilon, "blur": settings.blur, "reject_early": True}
    with one_thread():
        flow = generate(draw.coefficients, draw.mass, grid, seed=draw.seed, schedule=plan, **how)
    history = flow.history
    record = Record(
        index=index,
        **draw._asdict(),
        steps=int(history.step[-1]) if len(history.step) else 0,
        viability=flow.viability,
        energy=float(history.energy[-1]) if len(history.energy) else math.nan,
        status=flow.status,
        versions=versions(),
        seconds=time.perf_counter() - began,
    )
    try:
        store.write(record, flow.field.numpy().astype("float32") if record.viability.viable else None)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or str(store.path)) from error
    return store.record(index)


def versions() -> dict[str, str]:
    """Return the versions that a generated field's bits depend on: Python, libraries, processor."""
    here = {"python": platform.python_version(), "processor": binding.get_host_cpu_name()}
    return here | {name: version(name) for name in ("curvafit", "torch", "numpy", "numba")}


@dataclass(frozen=True)
class Verdict:
    """The outcome of `verify`: problems and notes, a sentence each, and a `status` in one sentence."""

    problems: tuple[str, ...]
    notes: tuple[str, ...]
    status: str


def verify(path: str | Path, progress: Progress = silent) -> Verdict:
    """Check that every draw of a store is there and matches its checksum.

    Missing draws are a problem of a finished store, and a note on one whose build was stopped. Raises FileNotFoundError
    or ValueError where there is no store of this version.
    """
    store = open_store(path)
    indices, problems, notes, viable = store.indices(), [], [], 0
    for k, index in enumerate(indices):
        progress(f"{k} of {len(indices)} draws checked", k / len(indices))
        viable += store.viable(index)
        if not store.intact(index):
            mend = f"delete draws/{index:06d}, and a build makes it again"
            problems.append(f"draw {index} does not match its checksum: {mend}")
    there = {int(entry.name) for entry in (store.path / "draws").iterdir() if entry.name.isdigit()}
    torn = sorted(index for index in there - set(indices) if not store.has(index))  # a build may add some meanwhile
    problems += [f"draw {index} is torn: a part is missing, or it is another draw" for index in torn]
    missing = sorted(set(range(max(there, default=-1) + 1)) - there)
    lost = f"{len(missing)} draws are missing: {', '.join(map(str, missing[:9]))}"
    if missing and viable >= store.wanted:
        problems.append(lost)
    elif viable < store.wanted:
        notes.append(f"{viable} of {store.wanted} shapes are made" + f"; {lost}" * bool(missing))
    finding = "nothing is wrong" if not problems else f"{len(problems)} things are wrong"
    return Verdict(tuple(problems), tuple(notes), f"{len(indices)} draws, {viable} shapes checked: {finding}")


def summarise(store: Store) -> dict[str, str]:
    """Return the facts about a store, in words, by name."""
    records = [store.record(index) for index in store.indices()]
    settings, viable = store.settings, sum(record.viability.viable for record in records)
    makers = Counter(", ".join(f"{name} {version}" for name, version in record.versions.items()) for record in records)
    return {
        "shapes": str(viable),
        "wanted": str(store.wanted),
        "draws": str(len(records)),
        "voxels": " x ".join(map(str, settings.shape)),
        "epsilon": f"{settings.epsilon:g} (voxel edges {', '.join(f'{edge:g}' for edge in settings.spacing)})",
        "design": str(Design.from_dict(settings.design)),
        "seed": str(settings.seed),
        "schedule": f"{present_name(settings.schedule)}, {settings.schedule['steps']} steps",
        "made with": "; ".join(f"{text} ({count})" for text, count in makers.items()),
        "seconds a draw": f"{np.mean([record.seconds for record in records]):.2f}" if records else "none",
    }
