"""Shapes of stores, measured: `extract` makes an atlas to search, `describe` a table to train a posterior on."""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Cluster, run_jobs
from curvafit.data_synth.atlas import versions
from curvafit.data_synth.design import design_box
from curvafit.data_synth.store import Record, Store, open_store
from curvafit.generation.result import FORMED, is_well_formed
from curvafit.generation.schedule import SCHEDULES, present_name
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram, diagram
from curvafit.inference.atlas import Atlas
from curvafit.inference.table import VIEWS, Table, load_table, parameters_of, save_table, to_row
from curvafit.priors.grid import Grid
from curvafit.scan.measures import Reading, read_texture, scan_diagram
from curvafit.scan.preparation import prepare, thinner_thickness
from curvafit.volumes.volume import ScanError, Volume

#: A row of a table: its columns in their order.
Row = tuple[str, str, np.ndarray, float, np.ndarray, float]


def extract(stores: Sequence[str | Path | Store], command: Sequence[str] = (), progress: Progress = silent) -> Atlas:
    """Measure every well-formed shape of stores (`generation.result.is_well_formed`), as field and as mask.

    `command` is command lines for the provenance, after those that make the stores. Raises FileNotFoundError or
    ValueError where a store is missing or of another version or grid, two have one name, or none holds such a shape.
    """
    sources = open_all(stores)
    grids = {(store.settings.shape, store.settings.spacing, store.settings.epsilon) for store in sources}
    if len(grids) > 1:
        sizes = ", ".join(" x ".join(map(str, shape)) for shape, _, _ in sorted(grids))
        raise ValueError(f"stores must have one grid and one ε, got {len(grids)}: {sizes} voxels")
    draws = [(store, store.record(index)) for store in sources for index in store.indices()]
    shapes = [(store, record) for store, record in draws if is_well_formed(record.viability)]
    if not shapes:
        places = " or ".join(str(store.path) for store in sources)
        raise ValueError(f"no well-formed shape in {places}, of {len(draws)} draws")
    measured = []
    for done, (store, record) in enumerate(shapes):
        progress(f"measuring {len(shapes)} shapes", done / len(shapes))
        measured.append(_measure_shape(store, record))
    fractions, thicknesses, field_diagrams, mask_diagrams = zip(*measured, strict=True)
    return Atlas(
        ids=tuple(shape_id(store, record.index) for store, record in shapes),
        coefficients=np.array([list(record.coefficients) for _, record in shapes], dtype=np.float64),
        masses=np.array([record.mass for _, record in shapes]),
        seeds=np.array([record.seed for _, record in shapes], dtype=np.int64),
        volume_fractions=np.array(fractions),
        thicknesses=np.array(thicknesses),
        field_diagrams=field_diagrams,
        mask_diagrams=mask_diagrams,
        provenance=_provenance(draws, command),
    )


def open_all(stores: Sequence[str | Path | Store]) -> list[Store]:
    """Open stores; raise ValueError where two have one name."""
    sources = [store if isinstance(store, Store) else open_store(store) for store in stores]
    names = [store.name for store in sources]
    if len(set(names)) < len(names):
        raise ValueError(f"stores must have different names, got {', '.join(names)}")
    return sources


def shape_id(store: Store, index: int) -> str:
    """Return the name of a draw in an atlas: the store's name and the index of the draw."""
    return f"{store.name}-{index:05d}"


def _measure_shape(store: Store, record: Record) -> tuple[float, float, Diagram, Diagram]:
    """Return the volume fraction, the thickness in voxels, and the diagrams of the field and of its mask as a scan."""
    u, settings = store.field(record.index), store.settings
    whole = diagram(torch.from_numpy(u), Grid(settings.shape, settings.spacing), settings.epsilon)
    mask = prepare(Volume((u > 0).astype(np.uint8)), kind="mask", periodic=True, one_scale=True)
    as_field, as_mask = (one.thin(BIN_WIDTH, TAIL_SHARE) for one in (whole, scan_diagram(mask)))
    return float((u > 0).mean()), thinner_thickness(u > 0), as_field, as_mask


def _provenance(draws: Sequence[tuple[Store, Record]], command: Sequence[str]) -> dict[str, Any]:
    stores = list({store.name: store for store, _ in draws}.values())
    accounts = {}
    for store in stores:
        records = [record for own, record in draws if own is store]
        generators = sorted({json.dumps(record.versions, sort_keys=True) for record in records})
        accounts[store.name] = {
            "draws": len(records),
            "viable": sum(record.viability.viable for record in records),
            "settings": dataclasses.asdict(store.settings),
            "generated_with": [json.loads(text) for text in generators],
        }
    return {
        "command": [*(_build_command(store, accounts[store.name]["viable"]) for store in stores), *command],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "selection": {"extent_of_both_phases": FORMED},
        "settings": {name: getattr(stores[0].settings, name) for name in ("shape", "spacing", "epsilon")},
        "stores": accounts,
        "diagrams": {"curvature": "geometric", "bin_width": BIN_WIDTH, "tail_share": TAIL_SHARE, "unit": Diagram.unit},
        "measured_with": versions(),
    }


def _build_command(store: Store, viable: int) -> str:
    """Return the command that makes the same store: building stops at its last viable draw."""
    settings = store.settings
    shape, name = ",".join(map(str, settings.shape)), present_name(settings.schedule)
    known = {json.dumps(design_box(law).as_dict()): law for law in ("random", "sobol")}
    design = known.get(json.dumps(settings.design), f"{store.name}.yaml")
    options = f"--count {viable} --shape {shape} --seed {settings.seed} --design {design} --schedule {name}"
    if name in SCHEDULES and settings.schedule["steps"] != SCHEDULES[name].steps:
        options += f" --steps {settings.schedule['steps']}"
    return f"curvafit atlas build {store.path.name} {options}"


def describe(
    stores: Sequence[str | Path],
    out: str | Path,
    views: Sequence[str] = tuple(VIEWS),
    progress: Progress = silent,
    *,
    workers: Cluster | None = None,
    command: Sequence[str] = (),
    overwrite: bool = False,
) -> Table:
    """Measure the well-formed shapes of stores in each view (`VIEWS`), and add them to a table, whose own rows stay.

    The table `out` (.npz) is written every minute; with `overwrite` it is begun anew. A view depends only on the shape,
    its seed and the view's name: a resumed table has the same rows, possibly in another order. Shapes that a build adds
    or removes meanwhile are left out. `workers` measure (`core.workers.cluster`), else this process; `command` is for
    the provenance.

    Raises FileNotFoundError or ValueError where a store is missing, two have one name, `out` is no table, a view is
    unknown, or no shape is well-formed.
    """
    unknown = [name for name in views if name not in VIEWS]
    if unknown or not views:
        raise ValueError(f"views must be some of {', '.join(VIEWS)}, got {', '.join(unknown) or 'none'}")
    sources, path = open_all(stores), Path(out)
    begun = load_table(path) if path.exists() and not overwrite else None
    provenance, rows = _table_provenance(begun, sources, command), []
    if begun is not None:
        rows += zip(*(getattr(begun, column.name) for column in dataclasses.fields(begun)[:-1]), strict=True)
    present = {row[:2] for row in rows}
    jobs: list[tuple[Path, int, tuple[str, ...]]] = []  # shapes that lack views in the table
    for store, index in ((own, k) for own in sources for k in own.indices()):
        missing = tuple(name for name in views if (f"{store.name}/{index:06d}", name) not in present)
        with suppress(KeyError):  # a draw that was removed since it was listed
            if missing and store.viable(index) and is_well_formed(store.record(index).viability):
                jobs.append((store.path.resolve(), index, missing))
    last_save = time.monotonic()
    try:
        for count, found in enumerate(run_jobs(measure, jobs, workers), 1):
            rows += found
            progress(f"measured {count} of {len(jobs)} shapes", count / len(jobs))
            if time.monotonic() - last_save > 60:
                save_table(_to_table(rows, provenance), path)
                last_save = time.monotonic()
    finally:
        if rows:
            save_table(_to_table(rows, provenance), path)
    if not rows:
        raise ValueError(f"no well-formed shape in {', '.join(store.name for store in sources)}")
    return _to_table(rows, provenance)


def measure(job: tuple[Path, int, Sequence[str]]) -> list[Row]:
    """Measure a shape, by its store, index and views; return no row where it is no longer in the store."""
    path, index, views = job
    store = open_store(path)
    try:
        record, u = store.record(index), store.field(index)
    except KeyError:
        return []
    numbers = parameters_of(record.coefficients, record.mass), thinner_thickness(u > 0)
    return [(f"{store.name}/{index:06d}", name, *numbers, *_measure_view(u, name, record.seed)) for name in views]


def _measure_view(u: np.ndarray, name: str, seed: int) -> tuple[np.ndarray, float]:
    """Return descriptors and amount of a field in one view, as `infer` reads a scan; NaN where that has no surface."""
    reading: Reading | None = None
    with suppress(ScanError):
        seen = VIEWS[name](u, np.random.default_rng([seed, *name.encode()]))
        reading = read_texture(prepare(seen.scan, kind=seen.kind, periodic=seen.periodic, one_scale=True))
    return to_row(reading).astype(np.float32), math.nan if reading is None else reading.amount


def _table_provenance(table: Table | None, stores: Sequence[Store], command: Sequence[str]) -> dict[str, Any]:
    """Return the provenance of a table, begun or new, to which shapes of stores are added."""
    before = {} if table is None else table.provenance
    settings = {store.name: json.loads(json.dumps(dataclasses.asdict(store.settings))) for store in stores}
    for name, now in settings.items():
        if before.get("stores", {}).get(name, now) != now:
            raise ValueError(f"the table was begun with another store {name}: choose another name, or overwrite it")
    return {
        "stores": before.get("stores", {}) | settings,
        "command": [*before.get("command", []), *command],
        "measured_with": versions(),
    }


def _to_table(rows: Sequence[Row], provenance: dict[str, Any]) -> Table:
    return Table(*map(np.array, zip(*rows, strict=True)), provenance=provenance)
