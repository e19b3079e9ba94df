"""Train a posterior of one's own: describe shapes of stores as scans show them, and learn what made them.

python examples/train.py describe store -o table.npz           # several stores may be named; a killed run goes on
python examples/train.py train table.npz -o posterior.npz      # minutes; of some views by `--views mask`
curvafit infer scan.tif --posterior posterior.npz -o out

Stores are made by `curvafit atlas build`; it takes shapes of 128 laws or more. A table holds 351 descriptors of each
shape in each view, as its field, its mask and a bad scan, with the parameters that made it.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import itertools
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
import typer
from scipy import linalg, ndimage
from torch import Tensor, nn

from curvafit.cli.console import plain_errors, resumable, say, show_stages
from curvafit.core.checks import check_int, check_seed
from curvafit.core.records import Format, can_write, encode_json
from curvafit.core.runtime import Progress, listen, silent, sub_progress
from curvafit.core.workers import Cluster, cluster, run_jobs
from curvafit.data_synth.atlas import open_all, versions
from curvafit.data_synth.store import Store, open_store
from curvafit.generation.result import is_well_formed
from curvafit.geometry.description import BLOCKS, LEVELS
from curvafit.inference.emulator import FAINTEST, Emulator, Layer, forward, misfits
from curvafit.inference.posterior import (
    MASS,
    MOST,
    POSTERIOR_FILE,
    Architecture,
    Combinations,
    Member,
    Posterior,
)
from curvafit.inference.stationary import call_in_double
from curvafit.inference.table import LEAST, PARAMETERS, TARGETS, Compression, column_names, columns_of, parameters_of
from curvafit.scan.measures import Reading, read_texture
from curvafit.scan.preparation import prepare, thinner_thickness
from curvafit.scan.quality import sample_mask
from curvafit.volumes.volume import ScanError, Volume

_REMEDY = "describe the stores into another file, or with --overwrite"
TABLE_FILE = Format("curvafit descriptors", 2, "a table of descriptors", _REMEDY, {"blocks": BLOCKS})
#: Range of a shape's thickness in the voxels of a mask's scanner, and range of these in voxels of the field.
SAMPLED, SCALES = (4.0, 16.0), (0.5, 2.0)
#: A degraded scan: deviation of the blur in voxels, contrast over the noise's deviation, and thickness of slices.
BLUR, SNR, SLICE = 1.0, 5.0, 2
#: Least deviation by which a column is scaled: what hardly varies, as the least depths do, says little.
LEAST_SCALE = 0.03
#: Weights of blocks in the compression, 1 where none is named.
WEIGHTS = {"curvature": 3.0}
#: Fraction of the laws that a member does not learn from: their likelihood says when to stop.
VALIDATION = 0.1
#: Ridge penalty of the straight lines that fit the mass, in rows.
RIDGE = 3.0
#: Most steps of a flow, which bound the time that a large table takes.
STEPS = 12_000
#: Fraction of the progress that the emulator takes.
EMULATOR_PART = 0.2
#: Folds of the laws; the emulator has as many networks of the mean, and of the deviations: each leaves out one fold.
FOLDS = 5
#: One law of so many teaches no network of the emulator: misfits are ranked among those of its shapes.
KEPT = 10
#: Widths of the hidden layers.
HIDDEN = (96, 96)
#: Least and most rows of a step, and steps that an epoch has between the two.
BATCH, PACE = (64, 512), 100
#: Draws of a flow whose mean is compared with the truth.
DRAWS = 200
#: Features by which shapes differ, with words for low and high values; and how many features describe an end.
LOOKS = {
    "filled": ("sparse", "full"),
    "roundness": ("flat", "round"),
    "bend": ("hollow", "bulging"),
    "bodies": ("joined by tunnels", "in separate bodies"),
    "thickness": ("even in thickness", "uneven in thickness"),
    "gaps": ("even in spacing", "uneven in spacing"),
}
NAMED = 2
#: Least correlation with a combination of a feature that describes its ends.
FAINT = 0.18

Network = TypeVar("Network", bound=nn.Module)
Cost = Callable[[nn.Module, Tensor, Tensor], Tensor]
#: A row of a table: its columns in their order.
Row = tuple[str, str, np.ndarray, float, np.ndarray, float]


# ---- tables ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Table:
    """Readings of N views of shapes, and what made the shapes.

    `shapes` and `views` name them (str, `(N,)`); `parameters` is `(N, 6)` (`PARAMETERS`), `thickness` `(N,)` that of a
    shape in its own voxels; `descriptors` `(N, 351)` has the blocks of `Descriptors` in their order, NaN where a view
    shows no surface, and `amount` `(N,)` says how much was seen (`Reading`).
    """

    shapes: np.ndarray
    views: np.ndarray
    parameters: np.ndarray
    thickness: np.ndarray
    descriptors: np.ndarray
    amount: np.ndarray
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        n = len(self.shapes)
        expected: dict[str, tuple[int, ...]] = dict.fromkeys(("views", "thickness", "amount"), (n,))
        expected |= {"parameters": (n, len(PARAMETERS)), "descriptors": (n, sum(BLOCKS.values()))}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: np.ndarray) -> Table:
        """Return some rows, by their indices or a mask."""
        columns = fields(self)[:-1]  # all but the provenance
        return replace(self, **{column.name: getattr(self, column.name)[np.asarray(chosen)] for column in columns})

    def select_views(self, views: Sequence[str]) -> Table:
        """Return the rows of some views, by name; raise ValueError if a view has no row."""
        kinds = set(self.views.tolist())
        if missing := [view for view in views if view not in kinds]:
            raise ValueError(f"expected views among {', '.join(sorted(kinds))}, got {', '.join(missing)}")
        return self.rows(np.isin(self.views, list(views)))

    @property
    def targets(self) -> np.ndarray:
        """Return the numbers to infer `(N, 7)` (`TARGETS`)."""
        return np.column_stack([self.parameters, np.log(self.thickness)])

    @property
    def visible(self) -> Table:
        """Return the rows whose view shows a surface."""
        return self.rows(np.asarray(np.isfinite(self.descriptors).all(1)))

    @property
    def laws(self) -> np.ndarray:
        """Return the index of each row's law, from 0 `(N,)`."""
        return np.unique(np.round(self.parameters, 9), axis=0, return_inverse=True)[1].ravel()

    @property
    def pooled(self) -> Table:
        """Return the rows, and with them a row for each 2, 4, 8, … shapes of one law in one view, as if one scan had
        shown them all: the means of their descriptors, and the sum of their amounts."""
        groups, laws = [[k] for k in range(len(self))], self.laws
        for law, view in product(np.unique(laws), np.unique(self.views)):
            group = np.flatnonzero((laws == law) & (self.views == view)).tolist()
            for size in (2**k for k in range(1, len(group).bit_length())):
                groups += [group[start : start + size] for start in range(0, len(group) - size + 1, size)]
        pooled = self.rows(np.array([rows[0] for rows in groups]))
        descriptors = np.array([self.descriptors[rows].mean(0) for rows in groups])
        thickness = np.array([self.thickness[rows].mean() for rows in groups])
        amount = np.array([self.amount[rows].sum() for rows in groups])
        return replace(pooled, descriptors=descriptors, thickness=thickness, amount=amount)


def to_row(reading: Reading | None) -> np.ndarray:
    """Return the descriptors of a reading; NaN where there is none."""
    return np.full(sum(BLOCKS.values()), np.nan) if reading is None else reading.descriptors


def save_table(table: Table, path: str | Path) -> None:
    """Write a table as one compressed `.npz`: arrays (descriptors in float32) and a JSON header."""
    arrays = {
        "names": encode_json([table.shapes.tolist(), table.views.tolist()]),
        **{name: getattr(table, name) for name in ("parameters", "thickness", "amount")},
        "descriptors": table.descriptors.astype(np.float32),
    }
    TABLE_FILE.write(path, {"provenance": table.provenance}, arrays)


def load_table(path: str | Path) -> Table:
    """Read a table of descriptors.

    Raises FileNotFoundError if there is no such file, and ValueError if it is not a table, is damaged, or has another
    format version or other blocks.
    """
    return TABLE_FILE.read(path, _from_arrays)


def _from_arrays(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Table:
    """Return the table of a file's header and arrays; descriptors may be `steps`, scaled to each column's range."""
    shapes, views = (np.array(names, dtype=str) for names in json.loads(arrays["names"].tobytes()))
    if not np.isfinite(arrays["parameters"]).all():
        raise ValueError("parameters that are not finite")
    scaled = "steps" in arrays
    descriptors = _from_steps(arrays["steps"]) * arrays["span"] + arrays["least"] if scaled else arrays["descriptors"]
    if descriptors.dtype.kind != "f" or not isinstance(header["provenance"], dict):
        raise ValueError("descriptors that are no numbers, or no provenance")
    parameters, thickness, amount = (arrays[name] for name in ("parameters", "thickness", "amount"))
    return Table(shapes, views, parameters, thickness, descriptors, amount, header["provenance"])


def _from_steps(steps: np.ndarray) -> np.ndarray:
    """Return rows in half precision by their bits' steps from number to number, low bytes before high: so they pack."""
    low, high = steps.astype(np.uint16)
    return np.cumsum(low + 256 * high, dtype=np.uint16).view(np.float16).reshape(low.shape)


def describe(
    stores: Sequence[str | Path],
    out: str | Path,
    progress: Progress = silent,
    *,
    workers: Cluster | None = None,
    command: Sequence[str] = (),
    overwrite: bool = False,
) -> Table:
    """Measure the well-formed shapes of stores in each view (`VIEWS`), and add them to a table, whose own rows stay.

    The table `out` (.npz) is written every minute; with `overwrite` it is begun anew. A view depends only on the shape,
    its seed and the view's name: a resumed table has the same rows, possibly in another order. Shapes that a build adds
    or removes meanwhile are left out. `workers` (see `cluster`) measure, or this process; `command` is for provenance.

    Raises FileNotFoundError or ValueError where a store is missing, two have one name, `out` is no table, or no shape
    is well-formed.
    """
    sources, path = open_all(stores), Path(out)
    table = load_table(path) if path.exists() and not overwrite else None
    provenance, rows = _provenance(table, sources, command), []
    if table is not None:
        columns = dataclasses.fields(table)[:-1]  # the last is the provenance
        rows += zip(*(getattr(table, column.name) for column in columns), strict=True)
    present = {row[:2] for row in rows}
    jobs: list[tuple[Path, int, tuple[str, ...]]] = []  # shapes that lack views in the table
    for store, index in ((source, k) for source in sources for k in source.indices()):
        missing = tuple(name for name in VIEWS if (f"{store.name}/{index:06d}", name) not in present)
        with suppress(KeyError):  # a draw that was removed since it was listed
            if missing and store.viable(index) and is_well_formed(store.record(index).viability):
                jobs.append((store.path.resolve(), index, missing))
    last_save = time.monotonic()
    try:
        for count, measured in enumerate(run_jobs(measure, jobs, workers), 1):
            rows += measured
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
    return [(f"{store.name}/{index:06d}", name, *numbers, *measure_view(u, name, record.seed)) for name in views]


def measure_view(u: np.ndarray, name: str, seed: int) -> tuple[np.ndarray, float]:
    """Return descriptors and amount of a field in one view, read as `infer` reads a scan; NaN without a surface."""
    reading: Reading | None = None
    with suppress(ScanError):
        view = VIEWS[name](u, np.random.default_rng([seed, *name.encode()]))
        reading = read_texture(prepare(view.scan, kind=view.kind, periodic=view.periodic, one_scale=True))
    return to_row(reading).astype(np.float32), math.nan if reading is None else reading.amount


def _provenance(table: Table | None, stores: Sequence[Store], command: Sequence[str]) -> dict[str, Any]:
    """Return the provenance of what is measured of stores, or of a table with stores added; ValueError where the table
    has another store of such a name."""
    previous = {} if table is None else table.provenance
    settings = {store.name: json.loads(json.dumps(dataclasses.asdict(store.settings))) for store in stores}
    for name, current in settings.items():
        if previous.get("stores", {}).get(name, current) != current:
            raise ValueError(f"the table was begun with another store {name}: choose another name, or overwrite it")
    return {
        "stores": previous.get("stores", {}) | settings,
        "command": [*previous.get("command", []), *command],
        "measured_with": versions(),
    }


def _to_table(rows: Sequence[Row], provenance: dict[str, Any]) -> Table:
    return Table(*map(np.array, zip(*rows, strict=True)), provenance=provenance)


# ---- views -----------------------------------------------------------------------------------------------------------


class Scanned(NamedTuple):
    """A simulated scan of a shape, and the options with which it is prepared: its kind, and whether it is periodic."""

    scan: Volume
    kind: Literal["field", "mask", "image"]
    periodic: bool = False


def see_field(u: np.ndarray, rng: np.random.Generator) -> Scanned:
    """Return the phase field itself."""
    return Scanned(Volume(u), "field", periodic=True)


def see_mask(u: np.ndarray, rng: np.random.Generator) -> Scanned:
    """Return {u > 0}, cut open at random, on coarser or finer voxels with which it is 4 to 16 thick."""
    inside = _open(u, rng)
    voxel = float(np.clip(thinner_thickness(inside) / math.exp(rng.uniform(*np.log(SAMPLED))), *SCALES))
    coarse = sample_mask(inside, [voxel] * 3, periodic=False)
    return Scanned(Volume(coarse.astype(np.uint8)), "mask")


def see_scan(
    u: np.ndarray, rng: np.random.Generator, blur: float = BLUR, thick: int = SLICE, snr: float = SNR
) -> Scanned:
    """Return {u > 0}, cut open at random, as a bad scan: `blur` in voxels, slices so many voxels `thick`, and noise of
    contrast / `snr`."""
    grey = ndimage.gaussian_filter(_open(u, rng).astype(np.float32), blur, mode="nearest")
    padded = np.pad(grey, ((0, -len(grey) % thick), (0, 0), (0, 0)), mode="edge")
    grey = padded.reshape(-1, thick, *grey.shape[1:]).mean(1)
    grey += rng.standard_normal(grey.shape, dtype=np.float32) / snr
    return Scanned(Volume(grey, (float(thick), 1.0, 1.0), "voxel"), "image")


#: Views by name.
VIEWS: dict[str, Callable[[np.ndarray, np.random.Generator], Scanned]]
VIEWS = {"field": see_field, "mask": see_mask, "scan": see_scan}


def _open(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return {u > 0} of a periodic box, rolled by a random shift, so that its sides cut the structure anywhere."""
    return np.roll(u > 0, [int(rng.integers(n)) for n in u.shape], (0, 1, 2))


# ---- compression -----------------------------------------------------------------------------------------------------


def compression_of(descriptors: np.ndarray, components: int) -> Compression:
    """Return the compression to the principal components of descriptors `(N, 351)`.

    Columns are scaled to deviation 1 (those of the curvature block by one factor, which keeps distances), and blocks
    weighted by `WEIGHTS`. Components are half whitened: one of deviation σ is divided by √σ, so that the first do not
    drown the others. The components' mean square is 1.
    """
    names, columns = np.array(column_names()), columns_of(descriptors)
    mean, scale = columns.mean(0), np.maximum(columns.std(0), LEAST_SCALE)
    weight = np.ones(len(names))
    for block in BLOCKS:
        in_block = names == block
        weight[in_block] = WEIGHTS.get(block, 1.0) / np.sqrt(in_block.sum())
        if block == "curvature":
            scale[in_block] = np.sqrt((scale[in_block] ** 2).mean())
    uncompressed = Compression(mean, scale, np.diag(weight))
    weighted = uncompressed(descriptors)
    values, vectors = np.linalg.eigh(weighted.T @ weighted / len(weighted))
    order = np.argsort(-values)[:components]
    # An eigenvalue is σ², so its fourth root is √σ.
    basis = (vectors[:, order] / (values[order] + 1e-12) ** (1 / 4)).T * weight
    basis /= np.sqrt(np.mean(np.sqrt(values[order])))
    return Compression(mean, scale, basis)


# ---- training --------------------------------------------------------------------------------------------------------


class Plan(NamedTuple):
    """First learning rate, weight decay, most epochs, and most epochs in a row without a better validation."""

    rate: float
    decay: float
    epochs: int
    patience: int


#: How the flows of a posterior learn, and how the networks of its emulator do.
PLANS = (Plan(1e-3, 1e-3, 300, 20), Plan(3e-3, 1e-2, 200, 15))


def train_posterior(
    table: Table,
    architecture: Architecture | None = None,
    *,
    members: int = 8,
    seed: int = 0,
    plans: tuple[Plan, Plan] | None = None,
    progress: Progress = silent,
) -> Posterior:
    """Fit an ensemble of flows to the parameters of a table's rows, and an emulator to the descriptors.

    Each member starts from other weights, and stops where the likelihood of a tenth of the laws, from none of whose
    shapes it learns, is highest. Raises ValueError if the table has too few shapes, or a parameter that does not vary,
    or an argument is out of range.

    Parameters
    ----------
    table
        Rows without a surface are left out.
    architecture
        Sizes of the flows.
    members
        Number of flows.
    plans
        How the flows and the emulator's networks learn; by default `PLANS`.
    progress
        Called after each epoch with a sentence and the share of the epochs that are done at most.
    """
    members, seed = check_int(members, "a number of flows", 1, MOST), check_seed(seed)
    architecture, table = architecture or Architecture(), table.visible.pooled
    law_of_row, laws = table.laws, len(np.unique(table.laws))
    if laws < 2 * architecture.components:
        raise ValueError(f"expected shapes of {2 * architecture.components} laws or more to train on, got {laws}")
    views = tuple(sorted(set(table.views.tolist())))
    box = np.stack([table.targets.min(0), table.targets.max(0)], axis=1)
    if fixed := [name for name, (low, high) in zip(TARGETS, box, strict=True) if low == high]:
        raise ValueError(f"expected shapes whose parameters all vary, got {', '.join(fixed)} the same in all")
    compression = compression_of(table.descriptors, architecture.components)
    flow_plan, emulator_plan = plans or PLANS
    options = {"seed": seed, "plan": emulator_plan, "progress": sub_progress(progress, 0.0, EMULATOR_PART)}
    emulator, misfits_by_view = train_emulator(table, compression, box[: len(PARAMETERS)], **options)
    counts = {"shapes": len(np.unique(table.shapes)), "laws": laws, "rows": len(table), "members": members}
    provenance = {"table": table.provenance, **counts, "seed": seed}
    # Members, the scaling of the parameters and combinations are replaced below.
    posterior = Posterior(
        architecture, (), compression, views, box, np.zeros(len(TARGETS)), np.ones(len(TARGETS)), emulator,
        misfits_by_view, Combinations(np.eye(6), np.zeros(6), ()), provenance, {},
    )  # fmt: skip
    logits = posterior.to_logits(table.targets)
    posterior = dataclasses.replace(posterior, centre=logits.mean(0), spread=logits.std(0))
    target = torch.from_numpy(posterior.standardise(table.targets)).float()
    context = posterior.context(table.descriptors, table.views, table.amount)
    flows, held_out, errors = [], [], []
    for k in range(members):
        rng = np.random.default_rng([seed, k])
        holdout = rng.permutation(laws)[: max(1, round(VALIDATION * laws))]
        validation = torch.from_numpy(np.isin(law_of_row, holdout))
        stage = sub_progress(progress, *(EMULATOR_PART + (1 - EMULATOR_PART) * end / members for end in (k, k + 1)))
        with torch.random.fork_rng():
            torch.manual_seed(int(rng.integers(2**31)))
            flow = Member(architecture, len(views))
            flows.append(_fit(flow, context, target, validation, flow_plan, f"member {k + 1} of {members}", stage))
        # Combinations are found from the flow's errors on rows that it has not learnt from.
        held_out.append(np.flatnonzero(validation.numpy()))
        single, rows = dataclasses.replace(posterior, members=(flow,)), table.rows(held_out[-1])
        draws = single.sample(rows.descriptors, rows.views, rows.amount, DRAWS)
        errors.append(draws[..., : len(PARAMETERS)].mean(1) - rows.parameters)
    rows = table.rows(np.concatenate(held_out))
    combinations = find_combinations(np.concatenate(errors), rows.parameters, rows.descriptors)
    return dataclasses.replace(posterior, members=tuple(flows), combinations=combinations)


def _fit(
    member: Member, context: Tensor, target: Tensor, validation: Tensor, plan: Plan, name: str, progress: Progress
) -> Member:
    """Fit a flow to the rows outside `validation`, and return it as it was when those within were likeliest."""
    _fit_lines(member, context[~validation], target[~validation, MASS])
    rows = int((~validation).sum())
    epochs = min(plan.epochs, STEPS * batch_size(rows) // rows + 1)

    def nats(member: Member, context: Tensor, target: Tensor) -> Tensor:
        return -member(context).log_prob(target).mean()

    def report(epoch: int, best: float) -> None:
        progress(f"{name}: epoch {epoch}, {best:.3f} nats", epoch / epochs)

    return learn(member, (context, target), validation, nats, plan._replace(epochs=epochs), report)


def _fit_lines(member: Member, context: Tensor, mass: Tensor) -> None:
    """Fit the mass as a straight line of the context by ridge regression, for each view, and store it in a flow."""
    for view in range(len(member.width)):
        in_view = context[:, view - len(member.width)] == 1  # the last columns are 1 for the row's view
        x, y = context[in_view].double(), mass[in_view].double()
        slope = torch.linalg.solve(x.T @ x + RIDGE * torch.eye(x.shape[1]), x.T @ y)
        member.slope[view], member.width[view] = slope, (y - x @ slope).std()


def train_emulator(
    table: Table,
    compression: Compression,
    box: np.ndarray,
    *,
    seed: int = 0,
    plan: Plan = PLANS[1],
    progress: Progress = silent,
) -> tuple[Emulator, dict[str, np.ndarray]]:
    """Fit networks to the compressed descriptors of a table's rows, given their parameters.

    One ensemble of networks learns the mean. A second one learns the deviations of the first one's errors on shapes
    held out. Returns the emulator and, by view, the misfits (`emulator.misfits`) of laws that no network has learnt
    from (`keep_laws`), with which the misfit of a scan is compared.
    """
    views = tuple(sorted(set(table.views.tolist())))
    kept = keep_laws(table, seed)
    if few := [view for view in views if not (kept & (table.views == view)).any()]:
        raise ValueError(f"expected many shapes in each of the views {', '.join(views)}, got few in {', '.join(few)}")
    references, table = table.rows(kept), table.rows(~kept)
    target = compression(table.descriptors)
    law_of_row = table.laws
    fold = np.random.default_rng(seed).permutation(law_of_row.max() + 1)[law_of_row] % FOLDS
    untrained = Emulator(compression, views, box, (), (), np.eye(target.shape[1]), 1.0)
    inputs = untrained.inputs(table.parameters, table.views, table.amount)
    x, y = torch.from_numpy(inputs).float(), torch.from_numpy(target).float()

    first, second = sub_progress(progress, 0.0, 0.5), sub_progress(progress, 0.5, 1.0)
    means = _train_ensemble(x, y, fold, lambda net, x, y: (net(x) - y).square().mean(), plan, seed, first)
    errors = y - _predict_held_out(means, x, fold)
    values, vectors = np.linalg.eigh(np.cov(errors.double().numpy().T))
    # Rows are the principal directions of the errors, greatest variance first, scaled so that theirs along each is 1.
    basis = (vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))).T[::-1].astype(np.float32)
    whitened = errors @ torch.from_numpy(basis).T
    spreads = _train_ensemble(x, whitened, fold, _normal_nats, plan, seed, second)
    deviation = torch.exp(_predict_held_out(spreads, x, fold)).clamp(min=FAINTEST)
    emulator = Emulator(compression, views, box, _layers(means), _layers(spreads), basis, 1.0)
    residuals = (whitened / deviation).double().numpy()
    emulator = dataclasses.replace(emulator, inflation=_inflation(emulator, table, residuals))
    columns = (references.descriptors, references.views, references.amount)
    unexplained = misfits(emulator, *columns, references.parameters[:, None])
    return emulator, {view: np.sort(unexplained[references.views == view]) for view in views}


def save_posterior(posterior: Posterior, path: str | Path) -> None:
    """Write a posterior as one compressed `.npz`: arrays and a JSON header, nothing that runs when it is read."""
    arrays = {name: getattr(posterior, name) for name in ("box", "centre", "spread")}
    arrays |= {name: getattr(posterior.compression, name) for name in ("mean", "scale", "basis")}
    for k, member in enumerate(posterior.members):
        arrays |= {f"{k}.{name}": value.numpy() for name, value in member.state_dict().items()}
    for name, layers in (("mean", posterior.emulator.mean), ("spread", posterior.emulator.spread)):
        for k, layer in enumerate(layers):
            arrays |= {f"emulator.{name}.{k}.{field}": value for field, value in layer._asdict().items()}
    arrays["emulator.basis"] = posterior.emulator.basis.astype(np.float32)
    arrays |= {f"misfits.{view}": values.astype(np.float32) for view, values in posterior.misfits.items()}
    for view, fisher in posterior.discriminants.items():
        arrays |= {f"{name}.{view}": values.astype(np.float32) for name, values in fisher._asdict().items()}
    arrays |= {f"combinations.{name}": getattr(posterior.combinations, name) for name in ("weights", "centre")}
    header = {
        "architecture": dataclasses.asdict(posterior.architecture),
        "members": len(posterior.members),
        "inflation": posterior.emulator.inflation,
        "views": posterior.views,
        "ends": posterior.combinations.ends,
        "provenance": posterior.provenance,
    }
    POSTERIOR_FILE.write(path, header, arrays)


def keep_laws(table: Table, seed: int) -> np.ndarray:
    """Return which rows `(N,)` are of the laws from which the emulator does not learn: one of `KEPT`, by the seed."""
    laws = table.laws
    return np.random.default_rng([seed, KEPT]).permutation(laws.max() + 1)[laws] % KEPT == 0


def _inflation(emulator: Emulator, table: Table, residuals: np.ndarray) -> float:
    """Return the mean square by which whitened residuals `(N, k)` move the best parameters, over its expectation if
    they were independent of variance 1."""
    # A Gauss-Newton step moves parameters by covariance · slopesᵀ residuals, here squared in units of that covariance:
    # gradientᵀ covariance gradient. Their prior has deviation 1.
    squared, expected = 0.0, 0.0
    for view in emulator.views:
        in_view = table.views == view
        slopes = find_slopes(emulator, table.parameters[in_view], table.views[in_view], table.amount[in_view])
        gradients = np.einsum("nkd,nk->nd", slopes, residuals[in_view])
        information = np.einsum("nkd,nke->nde", slopes, slopes)
        covariance = np.linalg.inv(information + np.eye(len(PARAMETERS)))
        squared += np.einsum("nd,nde,ne->", gradients, covariance, gradients)
        expected += np.einsum("nde,ned->", covariance, information)
    return float(squared / expected)


def find_slopes(emulator: Emulator, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Return the derivatives `(N, k, 6)` of the whitened mean by parameters `(N, 6)` in deviations of the prior."""

    def differentiate() -> Callable[..., Any]:
        import jax

        def mean(layers, inputs):
            return forward(layers, inputs[None])[:, 0].mean(0)

        return jax.jit(jax.vmap(jax.jacfwd(mean, 1), (None, 0)))

    inputs = emulator.inputs(parameters, views, amount)
    slopes = call_in_double(differentiate, emulator.mean, inputs)[..., : len(PARAMETERS)]
    return (emulator.basis @ slopes) / emulator(parameters, views, amount).deviation[..., None]


def decorrelate(emulator: Emulator, descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors `(N, 351)` along the rows of an emulator's basis, `(N, k)`: seeds differ independently."""
    return emulator.compression(descriptors) @ emulator.basis.T


def _normal_nats(network: nn.Module, x: Tensor, target: Tensor) -> Tensor:
    """Return the mean negative logarithm of normal densities whose deviations' logarithms are a network's outputs."""
    output = network(x).clamp(min=float(np.log(FAINTEST)))
    return (0.5 * (target * torch.exp(-output)).square() + output).mean()


def _train_ensemble(
    x: Tensor, y: Tensor, fold: np.ndarray, cost: Cost, plan: Plan, seed: int, progress: Progress
) -> list[nn.Sequential]:
    """Return `FOLDS` networks; each learns from all folds of the rows but one, and stops where that one is fit best."""
    sizes, networks = (x.shape[1], *HIDDEN), []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for k in range(FOLDS):

            def report(epoch: int, _: float, k: int = k) -> None:
                progress(f"emulator, epoch {epoch}", (k + epoch / plan.epochs) / FOLDS)

            layers = [layer for n, m in itertools.pairwise(sizes) for layer in (nn.Linear(n, m), nn.SiLU())]
            network = nn.Sequential(*layers, nn.Linear(HIDDEN[-1], y.shape[1]))
            networks.append(learn(network, (x, y), torch.from_numpy(fold == k), cost, plan, report))
    return networks


def _predict_held_out(networks: list[nn.Sequential], x: Tensor, fold: np.ndarray) -> Tensor:
    """Return each row's outputs by the network that did not learn from it."""
    with torch.no_grad():
        outputs = torch.stack([network(x) for network in networks])
    return outputs[torch.from_numpy(fold), torch.arange(len(x))]


def _layers(networks: list[nn.Sequential]) -> tuple[Layer, ...]:
    """Return the linear layers of networks of one shape, each stacked over the networks."""
    linear = [[layer for layer in network if isinstance(layer, nn.Linear)] for network in networks]
    return tuple(
        Layer(*(np.stack([getattr(layer, name).detach().numpy() for layer in level]) for name in ("weight", "bias")))
        for level in zip(*linear, strict=True)
    )


def batch_size(rows: int) -> int:
    """Return the number of rows of a step: `PACE` steps to an epoch, within `BATCH`."""
    return min(max(rows // PACE, BATCH[0]), BATCH[1])


def learn(
    network: Network, rows: tuple[Tensor, Tensor], validation: Tensor,
    cost: Callable[[Network, Tensor, Tensor], Tensor], plan: Plan, report: Callable[[int, float], object],
) -> Network:  # fmt: skip
    """Fit a network by AdamW to the rows (inputs, targets) outside `validation`. Return it with its weights after the
    epoch in which the rows of `validation` cost least; `report` is called with the number of each epoch, from 1, and
    the least cost so far."""
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=plan.decay)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=plan.patience // 3)
    x, y = (column[~validation] for column in rows)
    held_out = [column[validation] for column in rows]
    best, state, waited = np.inf, copy.deepcopy(network.state_dict()), 0
    for epoch in range(1, plan.epochs + 1):
        network.train()
        for batch in torch.randperm(len(x)).split(batch_size(len(x))):
            optimiser.zero_grad()
            cost(network, x[batch], y[batch]).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
        network.eval()
        with torch.no_grad():
            value = float(cost(network, *held_out))
        scheduler.step(value)
        waited += 1
        if value < best:
            best, state, waited = value, copy.deepcopy(network.state_dict()), 0
        report(epoch, best)
        if waited > plan.patience:
            break
    network.load_state_dict(state)
    return network.eval()


# ---- combinations ----------------------------------------------------------------------------------------------------


def find_combinations(errors: np.ndarray, parameters: np.ndarray, descriptors: np.ndarray) -> Combinations:
    """Find uncorrelated sums of parameters, by increasing mean square error over variance among laws.

    `errors` `(N, 6)` are those of a posterior's means for laws that it has not learnt from, `parameters` `(N, 6)` and
    `descriptors` `(N, 351)` are the laws' and their shapes'.
    """
    centre = parameters.mean(0)
    deviations = parameters - centre
    # The generalised eigenvectors of both covariances, by increasing eigenvalue.
    weights = linalg.eigh(errors.T @ errors / len(errors), deviations.T @ deviations / len(deviations))[1].T
    sums, features = deviations @ weights.T, _measure_looks(descriptors)
    correlations = sums.T @ ((features - features.mean(0)) / np.maximum(features.std(0), 1e-9)) / len(sums)
    # A sum's sign is free: it is chosen so that the feature that goes with it most increases.
    signs = np.sign(np.take_along_axis(correlations, np.abs(correlations).argmax(1)[:, None], 1))
    words, ends = list(LOOKS.values()), []
    for row in signs * correlations:
        chosen = [k for k in np.argsort(-np.abs(row))[:NAMED] if np.abs(row[k]) >= FAINT]
        ends.append(tuple(", ".join(words[k][int((row[k] > 0) == high)] for k in chosen) for high in (False, True)))
    return Combinations(signs * weights, centre, tuple(ends))


def _measure_looks(descriptors: np.ndarray) -> np.ndarray:
    """Return the features `(N, 6)` of `LOOKS` of descriptors `(N, 351)`."""
    names = np.array(column_names())
    fraction, (area, bend, euler), depths, gaps = (
        np.maximum(descriptors[:, names == name].T, LEAST if name != "densities" else -np.inf)
        for name in ("fraction", "densities", "depths", "clearances")
    )

    def spread(quantiles: np.ndarray) -> np.ndarray:
        return np.log(quantiles[LEVELS.index(0.9)] / quantiles[LEVELS.index(0.5)])

    area = np.maximum(area, LEAST)
    return np.column_stack([
        np.log(fraction[0]), np.log(area / fraction[0]), np.arcsinh(bend / area / 10), np.arcsinh(euler / area),
        spread(depths), spread(gaps),
    ])  # fmt: skip


# ---- command ---------------------------------------------------------------------------------------------------------


def main() -> None:
    listen()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(required=True)
    first = parts.add_parser("describe", help="describe shapes of stores in a table, which goes on if it exists")
    first.add_argument("stores", nargs="+", help="stores made by `curvafit atlas build`")
    first.add_argument("--workers", type=int, default=0, help="processes that describe; 0 is this one")
    second = parts.add_parser("train", help="train a posterior on a table")
    second.add_argument("table", type=Path, help="a table that `describe` wrote")
    second.add_argument("--views", help="views to learn from, between commas; by default all")
    second.add_argument("--seed", type=int, default=0, help="seed of the training")
    for part, run in ((first, run_describe), (second, run_train)):
        part.add_argument("-o", "--output", type=Path, required=True, help="file (.npz) to write")
        part.add_argument("--overwrite", action="store_true", help="replace a file of another origin, or begin anew")
        part.set_defaults(run=run)
    options = parser.parse_args()
    try:
        with (
            plain_errors(),
            resumable(options.output if options.run is run_describe else None),
            show_stages() as progress,
        ):
            if options.output.suffix != ".npz":
                raise ValueError(f"the output's name must end in .npz, got {options.output.name!r}")
            options.run(options, progress)
            say(str(options.output))
    except typer.Exit as end:
        sys.exit(end.exit_code)


def run_describe(options: argparse.Namespace, progress: Progress) -> None:
    can_write(options.output, TABLE_FILE, inputs=options.stores, overwrite=options.overwrite)
    more: dict[str, Any] = {"command": [shlex.join(sys.argv)], "overwrite": options.overwrite}
    with cluster(options.workers) as workers:
        describe(options.stores, options.output, progress, workers=workers, **more)


def run_train(options: argparse.Namespace, progress: Progress) -> None:
    can_write(options.output, POSTERIOR_FILE, inputs=[options.table], overwrite=options.overwrite)
    table = load_table(options.table)
    table = table if options.views is None else table.select_views(options.views.split(","))
    save_posterior(train_posterior(table, seed=options.seed, progress=progress), options.output)


if __name__ == "__main__":
    main()
