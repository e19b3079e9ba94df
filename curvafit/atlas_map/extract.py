"""A store's well-formed shapes measured, as the atlas that inference searches."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.data_synth.atlas.design import boxed
from curvafit.data_synth.atlas.draws import versions
from curvafit.data_synth.atlas.store import Record, Store, open_store
from curvafit.generation.schedule import SCHEDULES, present_name
from curvafit.generation.viability import FORMED, well_formed
from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE, Diagram, diagrams
from curvafit.inference.atlas import Atlas
from curvafit.priors.grid import Grid
from curvafit.progress import Progress, silent

#: What is measured of a draw: volume fraction of {u > 0}, diagram of the field, diagram of its mask.
Measured = tuple[float, Diagram, Diagram]


def extract(
    store: str | Path | Store,
    command: Sequence[str] = (),
    measure: Callable[[Store, Record], Measured] | None = None,
    progress: Progress = silent,
) -> Atlas:
    """Measure every well-formed shape of a store (`generation.viability.well_formed`), as field and as mask.

    Parameters
    ----------
    store
        An open store, or its folder.
    command
        Command lines for the provenance, after the one that makes the store.
    measure
        What to call in place of `measured`: one that remembers.
    progress
        Called before each shape with a sentence and the share of the shapes that are measured.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such store, it is of another version, or holds no well-formed shape.
    """
    store = store if isinstance(store, Store) else open_store(store)
    records = [store.record(index) for index in store.indices()]
    formed = [record for record in records if well_formed(record.viability)]
    if not formed:
        raise ValueError(f"expected at least one well-formed shape in {store.path}, got none in {len(records)} draws")
    fractions, field_diagrams, mask_diagrams = zip(
        *_measures(store, formed, measure or measured, progress), strict=True
    )
    return Atlas(
        ids=tuple(shape_id(store, record) for record in formed),
        coefficients=np.array([list(record.coefficients) for record in formed], dtype=np.float64),
        masses=np.array([record.mass for record in formed]),
        seeds=np.array([record.seed for record in formed], dtype=np.int64),
        volume_fractions=np.array(fractions),
        field_diagrams=field_diagrams,
        mask_diagrams=mask_diagrams,
        provenance=_provenance(store, records, command),
    )


def _measures(
    store: Store, records: list[Record], measure: Callable[[Store, Record], Measured], progress: Progress
) -> Iterator[Measured]:
    for done, record in enumerate(records):
        progress(f"measuring {len(records)} shapes", done / len(records))
        yield measure(store, record)


def shape_id(store: Store, record: Record) -> str:
    """Return the name of a draw in an atlas: the seed of the design and the index of the draw."""
    return f"{store.settings.seed}-{record.index:05d}"


def measured(store: Store, record: Record) -> Measured:
    """Return the volume fraction of {u > 0}, and the diagrams of field and mask, of one viable draw."""
    field = torch.from_numpy(store.field(record.index))
    grid = Grid(store.settings.shape, store.settings.spacing)
    return float((field > 0).double().mean()), *diagrams(field, grid, store.settings.epsilon)


def _provenance(store: Store, records: list[Record], command: Sequence[str]) -> dict[str, Any]:
    viable = sum(record.viability.viable for record in records)
    generators = sorted({json.dumps(record.versions, sort_keys=True) for record in records})
    return {
        "command": [_build_command(store, viable), *command],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "draws": len(records),
        "viable": viable,
        "selection": {"extent_of_both_phases": FORMED},
        "settings": dataclasses.asdict(store.settings),
        "diagrams": {
            "curvature": "geometric",
            "bin_width": BIN_WIDTH,
            "tail_share": TAIL_SHARE,
            "unit": "1/working unit",
        },
        "generated_with": [json.loads(text) for text in generators],
        "measured_with": versions(),
    }


def _build_command(store: Store, viable: int) -> str:
    """Return the command that makes the same store: building stops at its last viable draw."""
    settings = store.settings
    shape, name = ",".join(map(str, settings.shape)), present_name(settings.schedule)
    known = {json.dumps(boxed(law).as_dict()): law for law in ("random", "sobol")}
    design = known.get(json.dumps(settings.design), "design.yaml")
    options = f"--count {viable} --shape {shape} --seed {settings.seed} --design {design} --schedule {name}"
    if name in SCHEDULES and settings.schedule["steps"] != SCHEDULES[name].steps:
        options += f" --steps {settings.schedule['steps']}"
    return f"curvafit atlas build {store.path.name} {options}"
