"""The well-formed shapes of stores measured, as the atlas that inference searches."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.runtime import Progress, silent
from curvafit.data_synth.atlas import versions
from curvafit.data_synth.design import boxed
from curvafit.data_synth.store import Record, Store, open_store
from curvafit.generation.schedule import SCHEDULES, present_name
from curvafit.generation.viability import FORMED, well_formed
from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE, Diagram, diagrams
from curvafit.inference.atlas import Atlas
from curvafit.priors.grid import Grid

#: What is measured of a draw: volume fraction of {u > 0}, diagram of the field, diagram of its mask.
Measured = tuple[float, Diagram, Diagram]


def extract(
    stores: Sequence[str | Path | Store],
    command: Sequence[str] = (),
    measure: Callable[[Store, Record], Measured] | None = None,
    progress: Progress = silent,
) -> Atlas:
    """Measure every well-formed shape of stores (`generation.viability.well_formed`), as field and as mask.

    Parameters
    ----------
    stores
        Open stores, or their folders.
    command
        Command lines for the provenance, after those that make the stores.
    measure
        What to call in place of `measured`: one that remembers.
    progress
        Called before each shape with a sentence and the share of the shapes that are measured.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such store, one is of another version or grid, two have one name, or none holds a well-formed
        shape.
    """
    sources = [store if isinstance(store, Store) else open_store(store) for store in stores]
    _check_alike(sources)
    draws = [[store.record(index) for index in store.indices()] for store in sources]
    shapes = [
        (store, record)
        for store, records in zip(sources, draws, strict=True)
        for record in records
        if well_formed(record.viability)
    ]
    if not shapes:
        places, count = " or ".join(str(store.path) for store in sources), sum(map(len, draws))
        raise ValueError(f"expected at least one well-formed shape in {places}, got none in {count} draws")
    fractions, field_diagrams, mask_diagrams = zip(*_measures(shapes, measure or measured, progress), strict=True)
    return Atlas(
        ids=tuple(shape_id(store, record) for store, record in shapes),
        coefficients=np.array([list(record.coefficients) for _, record in shapes], dtype=np.float64),
        masses=np.array([record.mass for _, record in shapes]),
        seeds=np.array([record.seed for _, record in shapes], dtype=np.int64),
        volume_fractions=np.array(fractions),
        field_diagrams=field_diagrams,
        mask_diagrams=mask_diagrams,
        provenance=_provenance(sources, draws, command),
    )


def _check_alike(stores: Sequence[Store]) -> None:
    """Raise ValueError where two stores have one name, or grids or ε that differ."""
    names = [store.name for store in stores]
    if len(set(names)) < len(names):
        raise ValueError(f"expected stores with names of their own, got {', '.join(names)}")
    grids = {(store.settings.shape, store.settings.spacing, store.settings.epsilon) for store in stores}
    if len(grids) > 1:
        sizes = ", ".join(" x ".join(map(str, shape)) for shape, _, _ in sorted(grids))
        raise ValueError(f"expected stores of one grid and ε, got {len(grids)}: {sizes} voxels")


def _measures(
    shapes: Sequence[tuple[Store, Record]], measure: Callable[[Store, Record], Measured], progress: Progress
) -> Iterator[Measured]:
    for done, (store, record) in enumerate(shapes):
        progress(f"measuring {len(shapes)} shapes", done / len(shapes))
        yield measure(store, record)


def shape_id(store: Store, record: Record) -> str:
    """Return the name of a draw in an atlas: the store's name and the index of the draw."""
    return f"{store.name}-{record.index:05d}"


def measured(store: Store, record: Record) -> Measured:
    """Return the volume fraction of {u > 0}, and the diagrams of field and mask, of one viable draw."""
    field = torch.from_numpy(store.field(record.index))
    grid = Grid(store.settings.shape, store.settings.spacing)
    return float((field > 0).double().mean()), *diagrams(field, grid, store.settings.epsilon)


def _provenance(stores: Sequence[Store], draws: Sequence[list[Record]], command: Sequence[str]) -> dict[str, Any]:
    accounts = {store.name: _account(store, records) for store, records in zip(stores, draws, strict=True)}
    builds = (_build_command(store, accounts[store.name]["viable"]) for store in stores)
    return {
        "command": [*builds, *command],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "selection": {"extent_of_both_phases": FORMED},
        "settings": {name: getattr(stores[0].settings, name) for name in ("shape", "spacing", "epsilon")},
        "stores": accounts,
        "diagrams": {
            "curvature": "geometric",
            "bin_width": BIN_WIDTH,
            "tail_share": TAIL_SHARE,
            "unit": "1/working unit",
        },
        "measured_with": versions(),
    }


def _account(store: Store, records: Sequence[Record]) -> dict[str, Any]:
    """Return how a store was made."""
    generators = sorted({json.dumps(record.versions, sort_keys=True) for record in records})
    return {
        "draws": len(records),
        "viable": sum(record.viability.viable for record in records),
        "settings": dataclasses.asdict(store.settings),
        "generated_with": [json.loads(text) for text in generators],
    }


def _build_command(store: Store, viable: int) -> str:
    """Return the command that makes the same store: building stops at its last viable draw."""
    settings = store.settings
    shape, name = ",".join(map(str, settings.shape)), present_name(settings.schedule)
    known = {json.dumps(boxed(law).as_dict()): law for law in ("random", "sobol")}
    design = known.get(json.dumps(settings.design), f"{store.name}.yaml")
    options = f"--count {viable} --shape {shape} --seed {settings.seed} --design {design} --schedule {name}"
    if name in SCHEDULES and settings.schedule["steps"] != SCHEDULES[name].steps:
        options += f" --steps {settings.schedule['steps']}"
    return f"curvafit atlas build {store.path.name} {options}"
