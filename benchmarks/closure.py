"""Parameters read back from shapes whose parameters are known: errors, calibration and R² of each method.

`--unseen STORE…` asks for laws that no choice has seen: shapes of any size, as masks and as degraded scans (or
`--views`). Intervals are of the bootstrap over laws. `--gallery` ($CURVAFIT_DATA) asks for the author's volumes as
masks. Errors are medians, in deviations of the box of `curvafit atlas build`. `--less` asks beside the packaged
posterior what it were without a change: of the box (trained on Experiment 4's alone), of pooling (trained on single
shapes), of scale (scans read on their own voxels); and what every second law had taught (`laws`). `--part` shows a
corner of each shape.

Methods: `posterior`, the packaged one; `fit`, its emulator's best fit; and from a `--table` (`curvafit atlas
describe`), by default that of the packaged posterior, `match`, the nearest shape by the curvature block, and `process`,
a Gaussian process for each parameter on principal components.

- R²: 1 - mean square error / variance of a parameter. Combinations of parameters are the directions of least error
  against the prior's variance, found on every second law and tested on the others.
- in 90: part of the true values in the central 90 % intervals; width: their mean width.
- TARP: greatest difference of expected and stated coverage of balls around random points (Lemos et al. 2023), and its
  p: the part of as many exact draws that differ by more.
"""

from __future__ import annotations

import argparse
import os
import re
import warnings
import zlib
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy import linalg

from benchmarks.harness import RESULTS, Cases, Figure, Values, show
from curvafit.data_synth.design import INTERVALS
from curvafit.data_synth.store import Store, find_well_formed, open_store
from curvafit.geometry.diagram import FAMILIES, diagram, family_shares, half_thickness, leading_family
from curvafit.inference.emulator import best_parameters
from curvafit.inference.posterior import Architecture, Posterior, load_posterior, save_posterior
from curvafit.inference.table import (
    PARAMETERS,
    VIEWS,
    Table,
    column_names,
    compression_of,
    load_table,
    parameters_of,
    to_row,
)
from curvafit.inference.training import train_posterior
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.scan.measure import Reading, read_texture
from curvafit.scan.prepare import prepare, thinner_thickness
from curvafit.volumes.field import Field, ScanError

DRAWS, STARTS = 400, 16
#: What the packaged posterior was trained on.
TABLE = RESULTS / "table.npz"
#: Edge of the shapes that posteriors learn from, in voxels.
UNIT = 64
#: Names of the parameters in the ledger.
SLUGS = ("a11", "log_a02", "a10", "a01", "a00", "m0")
#: Middle and deviation of each parameter in the box.
_ENDS = np.array([np.log(ends) if name == "a02" else ends for name, ends in INTERVALS.items()], dtype=float)
MIDDLE, PRIOR = _ENDS.mean(1), np.ptp(_ENDS, axis=1) / np.sqrt(12)
#: Intervals of the corner of the box in which the presets lie.
CORNER = {"log a02": (np.log(0.25), np.log(15)), "a10": (-80, 80), "a01": (-80, 80), "a00": (-500, 1000)}


class Answers(NamedTuple):
    """What a method says of N queries: the best parameters `(N, 6)`; draws `(N, DRAWS, 6)`, or none."""

    best: np.ndarray
    draws: np.ndarray | None


# ---- methods ---------------------------------------------------------------------------------------------------------


def match(training: Table, queries: Table) -> Answers:
    columns = np.array(column_names()) == "curvature"
    apart = training.descriptors[None, :, columns] - queries.descriptors[:, None, columns]
    return Answers(training.parameters[np.square(apart).sum(-1).argmin(1)], None)


def process(training: Table, queries: Table) -> Answers:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    compression = compression_of(training.descriptors, Architecture().components)
    x, at, found = compression(training.descriptors), compression(queries.descriptors), []
    for y in training.parameters.T:
        kernel = ConstantKernel(1.0) * RBF(5.0, (0.3, 1e3)) + WhiteKernel(0.1)
        model = GaussianProcessRegressor(kernel).fit(x, (y - y.mean()) / y.std())
        found.append(model.predict(at) * y.std() + y.mean())
    return Answers(np.stack(found, 1), None)


def asked(trained: Posterior, queries: Table) -> Answers:
    draws = trained.sample(queries.descriptors, queries.views, queries.amount, DRAWS)[..., : len(PARAMETERS)]
    return Answers(np.median(draws, axis=1), draws)


def best_fits(trained: Posterior, queries: Table) -> Answers:
    """Return the emulator's best parameters."""
    best = []
    for row in zip(queries.descriptors[:, None], queries.views.tolist(), queries.amount, strict=True):
        reading = Reading(*row)
        starts = trained.draw(reading, STARTS)[:, : len(PARAMETERS)]
        best.append(best_parameters(trained.emulator, reading, starts)[0])
    return Answers(np.array(best), None)


def methods(path: Path, view: str) -> dict[str, Callable[[Table], Answers]]:
    """Return the methods by name; the last two learn from a table."""
    trained, training = load_posterior(), load_table(path).visible.select_views([view])
    return {
        "posterior": partial(asked, trained),
        "fit": partial(best_fits, trained),
        "match": partial(match, training),
        "process": partial(process, training),
    }


class Apart(Table):
    """A table whose shapes are never pooled."""

    @property
    def pooled(self) -> Table:
        return self


def train_less(change: str, table: Path, cases: Cases) -> Posterior:
    """Return the packaged posterior, or one that learned without a change, or of every second law."""
    if change not in ("box", "pooling", "laws"):
        return load_posterior()
    if not (path := cases.folder / f"less-{change}.npz").exists():
        training = load_table(table)
        least, most = _ENDS.T
        if change == "pooling":
            training = Apart(**vars(training))
        elif change == "box":
            training = training.rows(((least <= training.parameters) & (training.parameters <= most)).all(1))
        else:
            training = training.rows(training.laws % 2 == 0)
        save_posterior(train_posterior(training), path)
    return load_posterior(path)


# ---- figures ---------------------------------------------------------------------------------------------------------


def tarp(truth: np.ndarray, draws: np.ndarray) -> tuple[float, float]:
    """Return the greatest difference between the part of truths nearer to random points than a part of the draws, and
    that part; and the part of as many exact queries whose difference is greater."""
    random, levels = np.random.default_rng(0), np.linspace(0.05, 0.95, 19)
    points, scale = random.uniform(truth.min(0), truth.max(0), truth.shape), truth.std(0)
    away = np.linalg.norm((truth - points) / scale, axis=-1)
    nearer = (np.linalg.norm((draws - points[:, None]) / scale, axis=-1) < away[:, None]).mean(1)

    def greatest(parts: np.ndarray) -> float:
        return float(np.abs((parts[:, None] < levels).mean(0) - levels).max())

    exact = [greatest(random.integers(0, draws.shape[1] + 1, len(truth)) / draws.shape[1]) for _ in range(1000)]
    return greatest(nearer), float(np.mean(np.array(exact) > greatest(nearer)))


def over_laws(values: np.ndarray, laws: np.ndarray, statistic: Callable[..., np.ndarray]) -> list[Figure]:
    """Return a statistic of queries' values (N, k), by column, with the intervals of the bootstrap over laws."""
    rows, random = [values[laws == law] for law in np.unique(laws)], np.random.default_rng(0)
    drawn = [statistic(np.concatenate([rows[k] for k in random.integers(len(rows), size=len(rows))]), axis=0)
             for _ in range(1000)]  # fmt: skip
    return list(map(Figure, statistic(values, axis=0), *np.quantile(drawn, (0.025, 0.975), axis=0)))


def combinations_known(error: np.ndarray, truth: np.ndarray, laws: np.ndarray) -> np.ndarray:
    """Return the R² of the six combinations that are known best, found on every second law and tested on the others."""
    half, found = np.isin(laws, np.unique(laws)[::2]), []
    for learnt, tested in ((half, ~half), (~half, half)):
        directions = linalg.eigh(np.cov(error[learnt].T), np.cov(truth[learnt].T))[1]
        left, whole = error[tested] @ directions, truth[tested] @ directions
        found.append(1 - np.square(left).mean(0) / whole.var(0))
    return np.mean(found, axis=0)


def judge(queries: Table, families: np.ndarray, method: Callable[[Table], Answers]) -> Values:
    """Return laws, families, errors and truths in deviations of the box; of draws, widths and whether they hold."""
    truth, (best, draws) = queries.parameters, method(queries)
    laws = [f"{zlib.crc32(np.round(row, 6).tobytes()):08x}" for row in truth]
    columns = ((truth[:, PARAMETERS.index(name)], interval) for name, interval in CORNER.items())
    found: Values = {
        "law": laws,
        "family": families.tolist(),
        "corner": np.logical_and.reduce([(a <= column) & (column <= b) for column, (a, b) in columns]).tolist(),
        "error": np.round((best - truth) / PRIOR, 3).tolist(),
        "truth": np.round((truth - MIDDLE) / PRIOR, 3).tolist(),
    }
    if draws is not None:
        least, most = np.quantile(draws, (0.05, 0.95), axis=1)
        one = np.unique(laws, return_index=True)[1]  # queries of one law are not independent
        found |= {
            "width": np.round((most - least) / PRIOR, 3).tolist(),
            "in 90": ((least <= truth) & (truth <= most)).tolist(),
            "TARP": list(tarp(truth[one], draws[one])),
        }
    return found


def report(name: str, title: str, row: Values) -> dict[str, Figure]:
    """Show what a method says of queries; return its figures for the ledger, by what follows the group's name."""
    laws, families, corner = (np.array(row[key]) for key in ("law", "family", "corner"))
    error, truth = (np.array(row[key], dtype=float) for key in ("error", "truth"))
    inside = np.array(row["in 90"], dtype=float) if "in 90" in row else None
    table, off, figures = [], np.abs(error), {}
    parts = {"all": laws != "", "corner": corner, **{name: families == name for name in np.unique(families)}}
    for part, chosen in parts.items():
        if len(np.unique(laws[chosen])) < 2:
            continue
        figures[part] = {"error": over_laws(off[chosen], laws[chosen], np.median)}
        if inside is not None:
            figures[part]["in90"] = over_laws(inside[chosen], laws[chosen], np.mean)
        table += [[f"{part}: {key}", *values] for key, values in figures[part].items()]
    shares = 1 - np.square(error).mean(0) / truth.var(0)
    table.append(["R²", *shares])
    title += f"; mean error {off.mean():.3f}"
    found = {
        f"{key}.{slug}": value
        for key, values in figures["all"].items()
        for slug, value in zip(SLUGS, values, strict=True)
    }
    found |= {f"r2.{slug}": Figure(value) for slug, value in zip(SLUGS, shares, strict=True)}
    if inside is not None and len(np.unique(laws)) > len(PARAMETERS) * 4:
        known = combinations_known(error, truth, laws)
        widths = np.mean(row["width"], axis=0)
        table += [["width", *widths], ["R² of combinations", *known]]
        found |= {f"width.{slug}": Figure(value) for slug, value in zip(SLUGS, widths, strict=True)}
        found |= {f"known.{k + 1}": Figure(value) for k, value in enumerate(known)}
        found["known.tarp_p"] = Figure(row["TARP"][1])
        title += f"; TARP {row['TARP'][0]:.3f}, p {row['TARP'][1]:.3f}"
    show([name, *PARAMETERS], table, f"{title}: {len(laws)} queries of {len(np.unique(laws))} laws")
    return found


# ---- queries ---------------------------------------------------------------------------------------------------------


def author_paths() -> dict[str, Path]:
    folder = Path(os.environ["CURVAFIT_DATA"]) / "gallery"
    return {path.name.partition(" coeffs")[0].replace(" ", ""): path for path in sorted(folder.glob("*coeffs*.nii.gz"))}


def truth_of(path: Path) -> tuple[Coefficients, float]:
    """Return the law and mass in an author's file's name."""
    law, mass = re.search(r"\[(.*?)\]", path.name), re.search(r" m (-?[\d.]+)\.nii", path.name)
    assert law is not None
    assert mass is not None
    return Coefficients(*map(float, law[1].split())), float(mass[1])


def author_values(path: Path) -> np.ndarray:
    import nibabel

    return np.asarray(nibabel.Nifti1Image.from_filename(path).dataobj, dtype=np.float32)


def author_table(cases: Cases, names: list[str]) -> Table:
    """Return the author's volumes, measured as masks."""
    paths = {name: author_paths()[name] for name in names}

    def row(path: Path) -> np.ndarray:
        mask = author_values(path) > 0
        reading = read_texture(prepare(Field(mask.astype(np.uint8)), kind="mask", periodic=True, one_scale=True))
        return np.array([*to_row(reading), reading.amount if reading else np.nan, thinner_thickness(mask)])

    rows = np.array([cases.array(f"author-{name}", lambda path=path: row(path)) for name, path in paths.items()])
    parameters = np.array([parameters_of(*truth_of(path)) for path in paths.values()])
    views = np.array(["mask"] * len(names))
    return Table(np.array(names), views, parameters, rows[:, -1], rows[:, :-2], rows[:, -2], {})


def unseen_table(
    paths: list[Path], view: str, cases: Cases, part: int = 0, one_scale: bool = True
) -> tuple[Table, np.ndarray]:
    """Return what is read in a view of the well-formed shapes of stores, or of a corner of `part` voxels a side of
    each, on voxels of one scale or their own; and the families of the shapes."""
    rows, laws, names = [], [], []

    def measured(store: Store, index: int) -> np.ndarray:
        """Return descriptors, how much was seen, thickness and family in a row."""
        field, grid = store.field(index), Grid(store.settings.shape)
        own = diagram(torch.from_numpy(field), grid, store.settings.epsilon)
        shares = family_shares(own, half_thickness(own, float((field > 0).mean()) * grid.volume))
        scan, kind, periodic = VIEWS[view](field, np.random.default_rng([zlib.crc32(view.encode()), index]))
        if part:
            edges = zip(scan.shape, field.shape, strict=True)
            scan, periodic = scan.crop(",".join(f":{part * n // edge}" for n, edge in edges)), False
        try:
            reading = read_texture(prepare(scan, kind=kind, periodic=periodic, one_scale=one_scale))
        except ScanError:
            reading = None
        amount = np.nan if reading is None else reading.amount
        return np.array(
            [*to_row(reading), amount, thinner_thickness(field > 0), FAMILIES.index(leading_family(shares))]
        )

    how = view + (f"-{part}" if part else "") + ("" if one_scale else "-own")
    for store, index in find_well_formed(tuple(paths)):
        names.append(f"{store.name}-{index}")
        rows.append(cases.array(f"unseen-{names[-1]}-{how}", partial(measured, store, index)))
        laws.append(parameters_of(store.record(index).coefficients, store.record(index).mass))
    found = np.array(rows)
    shown, views = np.isfinite(found).all(1), np.array([view] * len(rows))
    table = Table(np.array(names), views, np.array(laws), found[:, -2], found[:, :-3], found[:, -3], {})
    return table.rows(shown), np.array(FAMILIES)[found[shown, -1].astype(int)]


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--unseen", type=Path, nargs="+", help="stores of laws that no choice has seen")
    parser.add_argument("--gallery", action="store_true", help="the author's volumes")
    parser.add_argument("--views", default="mask,scan")
    parser.add_argument("--table", type=Path, default=TABLE, help="what `match` and `process` learn from")
    parser.add_argument("--less", help="ask the posterior alone, and without: box,pooling,scale,laws")
    parser.add_argument(
        "--part", type=int, default=0, help="with --less, a corner of so many voxels a side of each shape"
    )


def run_less(options: argparse.Namespace, cases: Cases, edge: int) -> dict[str, Figure]:
    """Ask the packaged posterior of unseen laws, and what it were without each change."""
    figures, part = {}, options.part
    group = f"less{part or edge}"
    for view, change in product(options.views.split(","), ("nothing", *filter(None, options.less.split(",")))):
        queries, families = unseen_table(options.unseen, view, cases, part, one_scale=change != "scale")
        trained = train_less(change, options.table, cases)
        case = f"{group}-{view}-{change}"
        row = cases.all({case: partial(judge, queries, families, partial(asked, trained))})[case]
        for key, value in report(f"less {change}, {view}", group, row).items():
            kind, _, column = key.partition(".")
            figures[f"{group}_{kind}.{view}_{change}.{column}"] = value
    return {} if options.quick else figures


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    warnings.filterwarnings("ignore", module="sklearn")
    if not options.unseen and not options.gallery:
        raise SystemExit("name stores with --unseen, or the author's volumes with --gallery")
    if options.part and options.less is None:
        raise SystemExit("--part shows a corner to the posterior alone: it goes with --less")
    figures: dict[str, Figure] = {}
    edge = 0 if options.gallery else open_store(options.unseen[0]).settings.shape[0]
    if options.less is not None:
        return run_less(options, cases, edge)
    group = "gallery" if options.gallery else "unseen" + (str(edge) if edge != UNIT else "")
    for view in ["mask"] if options.gallery else options.views.split(","):
        if options.gallery:
            queries = author_table(cases, list(author_paths())[: 3 if options.quick else None])
            families = np.array(["author's"] * len(queries))
        else:
            queries, families = unseen_table(options.unseen, view, cases)
        for name, method in methods(options.table, view).items():
            case = f"{group}-{view}-{name}"
            found = report(f"{name}, {view}", group, cases.all({case: partial(judge, queries, families, method)})[case])
            for key, value in found.items():
                kind, _, column = key.partition(".")
                figures[f"{group}_{kind}.{view}_{name}.{column}"] = value
    return {} if options.quick else figures
