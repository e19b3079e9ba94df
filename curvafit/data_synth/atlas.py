"""Build an atlas: draw parameters, generate, keep what is viable, and measure the fields and their masks."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

from curvafit.core.checks import check_int, check_type, seed_of
from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Here, Workers
from curvafit.data_synth.design import Design, boxed
from curvafit.data_synth.draws import make
from curvafit.data_synth.store import Settings, Store, open_store
from curvafit.generation.flow import WORKING_BLUR
from curvafit.generation.memory import FILE, FLOW, check_memory
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.priors.grid import WORKING_EPSILON, Grid

#: A design is given up when none of its first so many draws was viable, or fewer than one in so many.
BARREN = 200
#: Shapes that a store may be asked for.
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
    workers: Workers | None = None,
) -> Store:
    """Generate draws 0, 1, 2 … of a design until `count` are viable; resumes a store that has some already.

    Draw i depends on (design, seed, i) alone, so however often it is stopped and resumed, and by however many workers
    it is made, the store ends with the same draws: the last of them is the `count`-th viable one.

    Parameters
    ----------
    store_path
        Folder of the store, created where missing.
    count
        Viable shapes to end with.
    shape
        Voxels (z, y, x), or one number for a cube; the box is periodic, in working units.
    progress
        Called after every new draw with a sentence and the share of the viable shapes that are there.
    design
        Experiment 4's random law by default.
    workers
        Whoever makes the draws (`cluster`); this process by default.

    Raises
    ------
    ValueError
        If `count` is not positive or over 10 million, a shape does not fit into memory, the store was made with other
        settings or by another format version, or hardly any draw of the design is viable.
    OSError
        If the store can't be written, or the workers are gone. What was made is kept.
    """
    check_count(count, 1)
    if workers is None:
        check_memory(Grid(shape).shape, FLOW, "a shape")  # type: ignore[arg-type]
    settings = settings_of(shape, seed, schedule, design)
    return _filled(open_store(store_path, settings), count, workers or Here(), progress)


def extend(store_path: str | Path, count: int, progress: Progress = silent, *, workers: Workers | None = None) -> Store:
    """Go on with a store, by its own settings, until it has `count` more viable shapes than were asked of it so far.

    With 0, what was stopped is brought to its end.

    Raises
    ------
    FileNotFoundError, ValueError, OSError
        If there is no store, or as `build`.
    """
    check_count(count, 0)
    store = open_store(store_path)
    return _filled(store, store.wanted + count, workers or Here(), progress)


def check_count(count: int, least: int) -> None:
    """Raise ValueError where a number of shapes is none, under the least or over 10 million."""
    check_int(count, "a count of at least 1 shape" if least else "a count of shapes from 0", least, MOST)


def settings_of(
    shape: int | Sequence[int], seed: int = 0, schedule: str | Schedule = "fast", design: Design | None = None
) -> Settings:
    """Return the settings of the store that `build` makes of these."""
    grid = Grid(shape)  # type: ignore[arg-type]
    check_memory(grid.shape, FILE, "a shape")
    if design is not None:
        check_type(design, Design, "a Design")
    plan, law = named_schedule(schedule).as_dict(), design or boxed()
    law.draw(seed, 0)  # refuses a wrong seed, before a store is made
    return Settings(grid.shape, grid.spacing, WORKING_EPSILON, WORKING_BLUR, law.as_dict(), seed_of(seed), plan)


def _filled(store: Store, count: int, workers: Workers, progress: Progress) -> Store:
    """Ask for draws in order, never for more than may still be wanted: nothing is made beyond the last viable one."""
    store.want(count)
    viable = {index: store.viable(index) for index in store.indices()}
    pending = 0
    todo = (index for index in itertools.count() if index not in viable)
    while (total := sum(viable.values())) < count:
        while chunk := _chunk(todo, min(workers.chunk, count - total - pending), pending, workers):
            workers.submit(make, store.path, chunk)
            pending += len(chunk)
        for record in workers.done():
            pending -= 1
            viable[record.index] = record.viability.viable
            progress(f"{sum(viable.values())} viable of {len(viable)} draws", sum(viable.values()) / count)
        if len(viable) > BARREN * (1 + sum(viable.values())):
            raise ValueError(
                f"expected a design with viable shapes, got {sum(viable.values())} of {len(viable)} draws: "
                f"the last was not, as {record.status}"
            )
    return store


def _chunk(todo: Iterator[int], most: int, pending: int, workers: Workers) -> list[int]:
    """Return the next indices to ask for; none where the workers have enough."""
    return list(itertools.islice(todo, most)) if most > 0 and pending < workers.places * workers.chunk else []
