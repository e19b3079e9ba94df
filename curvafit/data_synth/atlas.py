"""Stores of generated shapes: built, summarised, verified; and measured, for an atlas to search."""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import json
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
import torch
from llvmlite import binding

from curvafit.core.checks import check_int, check_seed, check_type
from curvafit.core.runtime import FILE, FLOW, Progress, check_memory, silent
from curvafit.core.workers import Cluster, run_jobs
from curvafit.data_synth.design import Design, design_box
from curvafit.data_synth.store import Record, Settings, Store, open_store
from curvafit.generation.flow import WORKING_BLUR, generate
from curvafit.generation.result import is_well_formed
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram, diagram
from curvafit.inference.atlas import Atlas
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.threads import one_thread
from curvafit.scan.measures import scan_diagram
from curvafit.scan.preparation import prepare, thinner_thickness
from curvafit.volumes.volume import Volume

#: A build ends with an error where fewer than one draw in this many is viable.
BARREN = 200
#: Viable shapes that a store may be asked for.
MOST = 10**7

# ---- builds ----------------------------------------------------------------------------------------------------------


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
    grid = Grid(shape)  # type: ignore[arg-type]
    check_memory(grid.shape, FLOW if workers is None else FILE, "a shape")
    if design is not None:
        check_type(design, Design, "a Design")
    plan, rule = named_schedule(schedule).as_dict(), (design or design_box()).as_dict()
    settings = Settings(grid.shape, grid.spacing, WORKING_EPSILON, WORKING_BLUR, rule, check_seed(seed), plan)
    store = open_store(store_path, settings)
    viable = {index: store.viable(index) for index in store.indices()}
    indices = (index for index in itertools.count() if index not in viable)
    while (missing := count - sum(viable.values())) > 0:  # in rounds of as many as are missing: so the last is viable
        for record in run_jobs(partial(make_draw, store.path.resolve()), islice(indices, missing), workers):
            viable[record.index] = record.viability.viable
            shapes = sum(viable.values())
            progress(f"{shapes} viable of {len(viable)} draws", shapes / count)
            if len(viable) > BARREN * (1 + shapes):
                message = f"hardly any draw of this design is viable: {shapes} of {len(viable)}"
                raise ValueError(f"{message}; the last was not, as {record.status}")
    return store


def make_draw(path: str | Path, index: int) -> Record:
    """Make a draw of a store, unless it exists, and return its record: a worker's part of `build`.

    It is made on one thread, so that a field depends only on its store's settings, its index and the processor.
    """
    store, began = open_store(path), time.perf_counter()
    if store.has(index):
        return store.record(index)
    settings = store.settings
    draw = Design.from_dict(settings.design).draw(settings.seed, index)
    grid, plan = Grid(settings.shape, settings.spacing), Schedule(**settings.schedule)
    options = {"epsilon": settings.epsilon, "blur": settings.blur, "reject_early": True}
    with one_thread():
        flow = generate(draw.coefficients, draw.mass, grid, seed=draw.seed, schedule=plan, **options)
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
    machine = {"python": platform.python_version(), "processor": binding.get_host_cpu_name()}
    return machine | {name: version(name) for name in ("curvafit", "torch", "numpy", "numba")}


@dataclass(frozen=True)
class Verdict:
    """The outcome of `verify`: problems, a sentence each, and a `status` in one sentence."""

    problems: tuple[str, ...]
    status: str


def verify(path: str | Path, progress: Progress = silent) -> Verdict:
    """Check that every draw of a store up to the last is there, can be read and matches its checksums.

    Raises FileNotFoundError or ValueError where there is no store of this version.
    """
    store = open_store(path)
    indices, viable, problems = store.indices(), 0, []
    for checked, index in enumerate(indices):
        progress(f"{checked} of {len(indices)} draws checked", checked / len(indices))
        if store.intact(index):
            viable += store.viable(index)
        else:
            remedy = f"delete {index:06d}.npz, and a build makes it again"
            problems.append(f"draw {index} is damaged, or another draw: {remedy}")
    if missing := sorted(set(range(max(indices, default=-1))) - set(indices)):
        names = ", ".join(map(str, missing[:9]))
        problems.append(f"{len(missing)} draws are missing ({names}): run the build again")
    outcome = "nothing is wrong" if not problems else f"{len(problems)} things are wrong"
    return Verdict(tuple(problems), f"{len(indices)} draws, {viable} shapes checked: {outcome}")


def summarise(store: Store) -> dict[str, str]:
    """Return the facts about a store, in words, by name."""
    records = [store.record(index) for index in store.indices()]
    settings, viable = store.settings, sum(record.viability.viable for record in records)
    makers = Counter(", ".join(f"{name} {version}" for name, version in record.versions.items()) for record in records)
    return {
        "shapes": str(viable),
        "draws": str(len(records)),
        "voxels": " x ".join(map(str, settings.shape)),
        "epsilon": f"{settings.epsilon:g} (voxel edges {', '.join(f'{edge:g}' for edge in settings.spacing)})",
        "design": str(Design.from_dict(settings.design)),
        "seed": str(settings.seed),
        "schedule": "{name}, {steps} steps".format(**settings.schedule),
        "made with": "; ".join(f"{text} ({count})" for text, count in makers.items()),
        "seconds a draw": f"{np.mean([record.seconds for record in records]):.2f}" if records else "none",
    }


# ---- measurements ----------------------------------------------------------------------------------------------------


def extract(stores: Sequence[str | Path | Store], command: Sequence[str] = (), progress: Progress = silent) -> Atlas:
    """Measure every well-formed shape of stores (`generation.result.is_well_formed`), as field and as mask.

    `command` is command lines for the provenance. Raises FileNotFoundError or ValueError where a store is missing or of
    another version or grid, two have one name, or none holds such a shape.
    """
    sources = open_all(stores)
    grids = {(store.settings.shape, store.settings.spacing, store.settings.epsilon) for store in sources}
    if len(grids) > 1:
        sizes = ", ".join(" x ".join(map(str, shape)) for shape, _, _ in sorted(grids))
        raise ValueError(f"stores must have one grid and one ε, got {len(grids)}: {sizes} voxels")
    draws = [(store, store.record(index)) for store in sources for index in store.indices()]
    shapes = [(store, record) for store, record in draws if is_well_formed(record.viability)]
    if not shapes:
        paths = " or ".join(str(store.path) for store in sources)
        raise ValueError(f"no well-formed shape in {paths}, of {len(draws)} draws")
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
        provenance={
            "stores": {store.name: json.loads(json.dumps(dataclasses.asdict(store.settings))) for store in sources},
            "command": list(command),
            "measured_with": versions(),
            "settings": {name: getattr(sources[0].settings, name) for name in ("shape", "spacing", "epsilon")},
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        },
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
    field_diagram = diagram(torch.from_numpy(u), Grid(settings.shape, settings.spacing), settings.epsilon)
    mask = prepare(Volume((u > 0).astype(np.uint8)), kind="mask", periodic=True, one_scale=True)
    field_diagram, mask_diagram = (full.thin(BIN_WIDTH, TAIL_SHARE) for full in (field_diagram, scan_diagram(mask)))
    return float((u > 0).mean()), thinner_thickness(u > 0), field_diagram, mask_diagram
