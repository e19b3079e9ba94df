"""The shapes of stores, each in several views, as the table of descriptors that a posterior is trained on."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import ThisProcess, Workers
from curvafit.data_synth.atlas import versions
from curvafit.data_synth.store import Store, open_store
from curvafit.generation.viability import well_formed
from curvafit.geometry.descriptors import Descriptors, descriptors
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.table import VIEWS, Table, load_table, parameters_of, save_table, to_row
from curvafit.priors.grid import Grid
from curvafit.volumes.field import ScanError

#: Seconds between two writings of a table that grows.
PAUSE = 60.0


def describe(
    stores: Sequence[str | Path],
    out: str | Path,
    views: Sequence[str] = tuple(VIEWS),
    progress: Progress = silent,
    *,
    workers: Workers | None = None,
    command: Sequence[str] = (),
    overwrite: bool = False,
) -> Table:
    """Measure the well-formed shapes of stores in each view, and write the table; views that the file has stay.

    A view depends on the shape, its seed and the view's name alone, so a table that was stopped ends as one that was
    not, but for the order of its rows. Stores may change meanwhile: what they have at the start is measured,
    but for what is removed before its turn.

    Parameters
    ----------
    stores
        Folders of stores.
    out
        The table (.npz), written every minute.
    views
        Names in `VIEWS`.
    progress
        Called after each shape with a sentence and the share of the shapes that are measured.
    workers
        Whoever measures (`data_synth.cluster`); this process by default.
    command
        Command line for the provenance.
    overwrite
        Whether to begin anew where `out` exists.

    Raises
    ------
    FileNotFoundError, ValueError
        If a store is none, two have one name, `out` is no table, a view has another name, or there is nothing to
        measure.
    """
    unknown = [name for name in views if name not in VIEWS]
    if unknown or not views:
        raise ValueError(f"expected views among {', '.join(VIEWS)}, got {', '.join(unknown) or 'none'}")
    sources = [open_store(path) for path in stores]
    names = [store.name for store in sources]
    if len(set(names)) < len(names):
        raise ValueError(f"expected stores with names of their own, got {', '.join(names)}")
    path, crew = Path(out), workers or ThisProcess()
    rows = _Rows(load_table(path) if path.exists() and not overwrite else None, sources, command)
    jobs = [job for store in sources for job in _jobs(store, views, rows)]
    if not jobs and not rows.shapes:
        raise ValueError(f"expected a well-formed shape in {', '.join(names)}, got none")
    queue, count, pending, last_save = iter(jobs), 0, 0, time.monotonic()
    try:
        while count < len(jobs):
            while pending < crew.places and (job := next(queue, None)) is not None:
                store, index, missing = job
                crew.submit(partial(measure, views=missing), store.path, [index])
                pending += 1
            for shape in crew.collect():
                rows.add(shape)
                count, pending = count + 1, pending - 1
                progress(f"measured {count} of {len(jobs)} shapes", count / len(jobs))
            if time.monotonic() - last_save > PAUSE:
                save_table(rows.table(), path)
                last_save = time.monotonic()
    finally:
        if rows.shapes:
            save_table(rows.table(), path)
    return rows.table()


def measure(path: Path, indices: Sequence[int], views: Sequence[str]) -> list[dict[str, Any]]:
    """Measure some shapes of a store in some views: their parameters and descriptors by view, None without a surface.

    A shape that is no longer in the store has no views.

    Raises
    ------
    ValueError
        If a shape is damaged, or its law has a20 or a02 that is not above 0.
    """
    store = open_store(path)
    grid, epsilon = Grid(store.settings.shape, store.settings.spacing), store.settings.epsilon
    rows = []
    for index in indices:
        rows.append({"shape": _shape(store, index), "views": {}})
        try:
            record, u = store.record(index), store.field(index)
        except KeyError:
            continue
        rows[-1]["parameters"] = parameters_of(record.coefficients, record.mass)
        rows[-1]["views"] = {name: _view_descriptors(u, grid, epsilon, name, record.seed) for name in views}
    return rows


def _view_descriptors(u: np.ndarray, grid: Grid, epsilon: float, name: str, seed: int) -> Descriptors | None:
    """Return the descriptors of a field in one view, None where that shows no surface."""
    rng = np.random.default_rng([seed, *name.encode()])
    try:
        view = VIEWS[name](u, grid, rng)
        return descriptors(view.shape, view.grid, epsilon)
    except (NoSurface, ScanError):
        return None


class _Rows:
    """The rows of a table that grows."""

    def __init__(self, table: Table | None, stores: Sequence[Store], command: Sequence[str]) -> None:
        self.shapes: list[str] = [] if table is None else table.shapes.tolist()
        self.views: list[str] = [] if table is None else table.views.tolist()
        self.parameters = [] if table is None else list(table.parameters)
        self.descriptors = [] if table is None else list(table.descriptors)
        before = {} if table is None else table.provenance
        settings = {store.name: json.loads(json.dumps(dataclasses.asdict(store.settings))) for store in stores}
        for name, now in settings.items():
            if before.get("stores", {}).get(name, now) != now:
                raise ValueError(f"expected the store {name} that the table was begun with, got one made otherwise")
        self.provenance = {
            "stores": before.get("stores", {}) | settings,
            "command": [*before.get("command", []), *command],
            "measured_with": versions(),
        }
        self.keys = set(zip(self.shapes, self.views, strict=True))

    def add(self, shape: dict[str, Any]) -> None:
        """Add a row for each view of a shape, as `measure` returns it."""
        for view, blocks in shape["views"].items():
            self.shapes.append(shape["shape"])
            self.views.append(view)
            self.parameters.append(shape["parameters"])
            self.descriptors.append(to_row(blocks).astype(np.float32))

    def table(self) -> Table:
        """Return the rows as a table."""
        shapes, views = np.array(self.shapes, dtype=str), np.array(self.views, dtype=str)
        return Table(shapes, views, np.array(self.parameters), np.array(self.descriptors), self.provenance)


def _jobs(store: Store, views: Sequence[str], rows: _Rows) -> list[tuple[Store, int, tuple[str, ...]]]:
    """Return the shapes of a store with the views of each that are missing."""
    jobs = []
    for index in store.indices():
        shape = _shape(store, index)
        missing = tuple(name for name in views if (shape, name) not in rows.keys)
        with suppress(KeyError):  # a draw that was removed since it was listed
            if missing and store.viable(index) and well_formed(store.record(index).viability):
                jobs.append((store, index, missing))
    return jobs


def _shape(store: Store, index: int) -> str:
    """Return a shape's name in a table: the store's folder and the draw."""
    return f"{store.name}/{index:06d}"
