"""Parameters read back from shapes whose parameters are known: R², errors, widths and calibration of each method.

`--table TABLE.npz` is made by `curvafit atlas describe`. Each shape is answered for by what was trained on the other
folds alone, all its views being in one fold. Methods: `match`, the nearest training shape by the curvature block;
`process`, a Gaussian process for each parameter on principal components; `posterior`, the ensemble of flows.

- R²: 1 - mean square error / variance of a parameter. Error: median |error| in deviations of the prior.
- in 90: part of the true values in the central 90 % intervals; width: their mean width in deviations of the prior.
- ranks: p that ranks of the truth among draws are uniform (SBC: χ² of 10 bins, the least of six, times six).
- TARP: greatest difference of expected and stated coverage of balls around random points (Lemos et al. 2023), and its
  p: the part of as many exact draws that differ by more.

`--gallery` ($CURVAFIT_DATA) asks the packaged posterior, and its emulator's best fit, for the author's
volumes as masks; the deviations are those of its box.

`--unseen STORE…` asks the packaged posterior for laws that no choice has seen: shapes of 64³ as masks, crops and scans
(or `--views`), and of larger stores as windows. Intervals are of the bootstrap over laws. Combinations of parameters
are the directions of least error against the prior's variance, found on every second law and tested on the others.
"""

from __future__ import annotations

import argparse
import os
import re
import warnings
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy import linalg, stats

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.data_synth.design import INTERVALS
from curvafit.data_synth.store import Store, find_well_formed
from curvafit.geometry.descriptors import BLOCKS, descriptors
from curvafit.geometry.diagram import FAMILIES, diagram, family_shares, half_thickness, leading_family
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.emulator import best_parameters
from curvafit.inference.posterior import Architecture, Posterior, load_posterior
from curvafit.inference.table import (
    PARAMETERS,
    VIEWS,
    Table,
    View,
    column_names,
    compression_of,
    load_table,
    parameters_of,
)
from curvafit.inference.training import train_posterior
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.volumes.field import ScanError

DRAWS, STARTS, MEMBERS, FOLDS = 400, 16, 4, 5


class Answers(NamedTuple):
    """What a method says of N queries: means `(N, 6)`; draws `(N, DRAWS, 6)`, none of a method without width."""

    mean: np.ndarray
    draws: np.ndarray | None


Method = Callable[[Table, Table], Answers]


# ---- methods ---------------------------------------------------------------------------------------------------------


def by_view(training: Table, queries: Table, answer: Callable[[Table, Table], np.ndarray]) -> np.ndarray:
    """Return a method's means, of each view by the training rows of that view."""
    mean = np.empty((len(queries), len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine = queries.views == view
        mean[mine] = answer(training.select_views([view]), queries.rows(mine))
    return mean


def match(training: Table, queries: Table) -> Answers:
    columns = np.array(column_names()) == "curvature"

    def nearest(rows: Table, asked: Table) -> np.ndarray:
        apart = rows.descriptors[None, :, columns] - asked.descriptors[:, None, columns]
        return rows.parameters[np.square(apart).sum(-1).argmin(1)]

    return Answers(by_view(training, queries, nearest), None)


def process(training: Table, queries: Table) -> Answers:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    spread = np.empty((len(queries), len(PARAMETERS)))

    def predict(rows: Table, asked: Table) -> np.ndarray:
        compression = compression_of(rows.descriptors, Architecture().components)
        x, at, found = compression(rows.descriptors), compression(asked.descriptors), []
        for k, y in enumerate(rows.parameters.T):
            kernel = ConstantKernel(1.0) * RBF(5.0, (0.3, 1e3)) + WhiteKernel(0.1)
            model = GaussianProcessRegressor(kernel).fit(x, (y - y.mean()) / y.std())
            mean, width = model.predict(at, return_std=True)
            found.append(mean * y.std() + y.mean())
            spread[queries.views == asked.views[0], k] = width * y.std()
        return np.stack(found, 1)

    mean = by_view(training, queries, predict)
    noise = np.random.default_rng(0).standard_normal((len(queries), DRAWS, len(PARAMETERS)))
    return Answers(mean, mean[:, None] + spread[:, None] * noise)


def posterior(training: Table, queries: Table) -> Answers:
    return asked(train_posterior(training, members=MEMBERS), queries)


def asked(trained: Posterior, queries: Table) -> Answers:
    draws = np.empty((len(queries), DRAWS, len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine = queries.views == view
        draws[mine] = trained.sample(queries.descriptors[mine], view, DRAWS)
    return Answers(draws.mean(1), draws)


def best_fits(trained: Posterior, queries: Table) -> Answers:
    """Return the emulator's best parameters, with normal draws about them, cut at the box."""
    random, shape = np.random.default_rng(0), (len(queries), DRAWS, len(PARAMETERS))
    mean, draws = np.empty(shape[::2]), np.empty(shape)
    for k, (row, view) in enumerate(zip(queries.descriptors, queries.views.tolist(), strict=True)):
        mean[k], covariance = best_parameters(trained.emulator, row, view, trained.sample(row, view, STARTS))
        draws[k] = np.clip(random.multivariate_normal(mean[k], covariance, DRAWS), *trained.box.T)
    return Answers(mean, draws)


METHODS: dict[str, Method] = {"match": match, "process": process, "posterior": posterior}


def cross_answers(table: Table, name: str, folds: int, cases: Cases) -> Answers:
    """Return what a method says of each row, trained on the shapes of the other folds; a shape keeps its fold."""
    fold = np.array([zlib.crc32(shape.encode()) % folds for shape in table.shapes])
    mean, draws = np.empty((len(table), len(PARAMETERS))), None
    key = f"{zlib.crc32(table.descriptors.tobytes()):08x}"
    for k in range(folds):

        def make(k: int = k) -> np.ndarray:
            found = METHODS[name](table.rows(fold != k), table.rows(fold == k))
            return found.mean[:, None] if found.draws is None else found.draws

        part = cases.array(f"{name}-{key}-{k}of{folds}", make)
        mean[fold == k] = part.mean(1)
        if part.shape[1] > 1:
            draws = np.empty((len(table), *part.shape[1:])) if draws is None else draws
            draws[fold == k] = part
    return Answers(mean, draws)


# ---- figures ---------------------------------------------------------------------------------------------------------


def judged(truth: np.ndarray, answers: Answers, prior: np.ndarray) -> Values:
    """Return the figures of a method on queries of one view."""
    error = answers.mean - truth
    found: Values = {"R²": (1 - np.square(error).mean(0) / truth.var(0)).tolist()}
    found["error"] = (np.median(np.abs(error), axis=0) / prior).tolist()
    if answers.draws is not None:
        ranks = (answers.draws < truth[:, None]).mean(1)
        low, high = np.quantile(answers.draws, (0.05, 0.95), axis=1)
        found["in 90"] = (np.abs(ranks - 0.5) <= 0.45).mean(0).tolist()
        found["width"] = ((high - low).mean(0) / prior).tolist()
        counts = [np.histogram(column, 10, (0, 1 + 1e-9))[0] for column in ranks.T]
        found["ranks p"] = min(1.0, 6 * min(stats.chisquare(each).pvalue for each in counts))
        found["TARP"], found["TARP p"] = tarp(truth, answers.draws)
    return found


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


# ---- the author's volumes --------------------------------------------------------------------------------------------


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
        mask = np.ascontiguousarray(author_values(path) > 0)
        return descriptors(mask, Grid(mask.shape)).vector()

    rows = [cases.array(f"author-{name}", lambda path=path: row(path)) for name, path in paths.items()]
    parameters = np.array([parameters_of(*truth_of(path)) for path in paths.values()])
    return Table(np.array(names), np.array(["mask"] * len(names)), parameters, np.array(rows), {})


def on_gallery(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names = list(author_paths())[: 2 if options.quick else None]
    queries, trained = author_table(cases, names), load_posterior()
    prior = trained.emulator.deviation
    jobs = {
        "gallery-posterior": lambda: judged(queries.parameters, asked(trained, queries), prior),
        "gallery-refined": lambda: judged(queries.parameters, best_fits(trained, queries), prior),
    }
    found = cases.all(jobs)
    rows = [[f"{name}, {key}", *row[key]] for name, row in found.items() for key in ("error", "in 90")]
    show(["", *PARAMETERS], rows, f"{len(names)} of the author's volumes, as masks")
    return {f"gallery.{name.partition('-')[2]}.{parameter}": Figure(value) for name, row in found.items()
            for parameter, value in zip(SLUGS, row["error"], strict=True)}  # fmt: skip


# ---- laws that no choice has seen ------------------------------------------------------------------------------------

#: Intervals of the corner of the box in which the presets lie.
CORNER = {"log a02": (np.log(0.25), np.log(15)), "a10": (-80, 80), "a01": (-80, 80), "a00": (-500, 1000)}


def see_window(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return {u > 0}, not told that it repeats: `infer` sees a larger scan so."""
    return View(u > 0, Grid(grid.shape, grid.spacing, "replicate"))


def unseen_table(paths: list[Path], view: str, cases: Cases) -> tuple[Table, np.ndarray]:
    """Return the descriptors of the well-formed shapes of stores in a view, and the families of the shapes."""
    see, rows, laws, names = {**VIEWS, "window": see_window}[view], [], [], []

    def measured(store: Store, index: int) -> np.ndarray:
        field, grid = store.field(index), Grid(store.settings.shape)
        own = diagram(torch.from_numpy(field), grid, store.settings.epsilon)
        shares = family_shares(own, half_thickness(own, float((field > 0).mean()) * grid.volume))
        try:
            seen = see(field, grid, np.random.default_rng([zlib.crc32(view.encode()), index]))
            return np.append(descriptors(*seen).vector(), FAMILIES.index(leading_family(shares)))
        except (ScanError, NoSurface):
            return np.full(sum(BLOCKS.values()) + 1, np.nan)

    for store, index in find_well_formed(tuple(paths)):
        names.append(f"{store.name}-{index}")
        rows.append(cases.array(f"unseen-{names[-1]}-{view}", partial(measured, store, index)))
        laws.append(parameters_of(store.record(index).coefficients, store.record(index).mass))
    found, shown = np.array(rows), np.isfinite(rows).all(1)
    table = Table(np.array(names), np.array([view] * len(rows)), np.array(laws), found[:, :-1], {})
    return table.rows(shown), np.array(FAMILIES)[found[shown, -1].astype(int)]


def unseen_answers(paths: list[Path], view: str, cases: Cases) -> Values:
    """Return laws, families, errors, truths and widths in deviations of the paper's box, and whether intervals hold."""
    (table, families), trained = unseen_table(paths, view, cases), load_posterior()
    truth, (low, high) = table.parameters, np.array([np.log(i) if n == "a02" else i for n, i in INTERVALS.items()]).T
    middle, prior = (low + high) / 2, (high - low) / np.sqrt(12)
    draws = trained.sample(table.descriptors, "crop" if view == "window" else view, DRAWS)
    least, most = np.quantile(draws, (0.05, 0.95), axis=1)
    laws = [f"{zlib.crc32(np.round(row, 6).tobytes()):08x}" for row in truth]
    columns = ((truth[:, PARAMETERS.index(name)], interval) for name, interval in CORNER.items())
    inside = [(a <= column) & (column <= b) for column, (a, b) in columns]
    one = np.unique(laws, return_index=True)[1]  # queries of one law are not independent
    return {
        "law": laws,
        "family": families.tolist(),
        "corner": np.logical_and.reduce(inside).tolist(),
        "error": np.round((np.median(draws, axis=1) - truth) / prior, 3).tolist(),
        "truth": np.round((truth - middle) / prior, 3).tolist(),
        "width": np.round((most - least) / prior, 3).tolist(),
        "in 90": ((least <= truth) & (truth <= most)).tolist(),
        "TARP": list(tarp(truth[one], draws[one])),
    }


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


def on_unseen(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    views, figures = options.views.split(","), {}
    found = cases.all({f"unseen-{view}": partial(unseen_answers, options.unseen, view, cases) for view in views})
    for view, row in ((name.removeprefix("unseen-"), row) for name, row in found.items()):
        laws, families, corner = (np.array(row[key]) for key in ("law", "family", "corner"))
        error, truth, inside = (np.array(row[key], dtype=float) for key in ("error", "truth", "in 90"))
        table, off = [], np.abs(error)
        parts = {"all": laws != "", "corner": corner, **{name: families == name for name in np.unique(families)}}
        for name, part in parts.items():
            if len(np.unique(laws[part])) < 2:
                continue
            median, held = over_laws(off[part], laws[part], np.median), over_laws(inside[part], laws[part], np.mean)
            table += [[f"{name}: error", *median], ["in 90", *held]]
            if name == "all":
                figures |= {f"unseen.{view}_error.{slug}": each for slug, each in zip(SLUGS, median, strict=True)}
                figures |= {f"unseen.{view}_in90.{slug}": each for slug, each in zip(SLUGS, held, strict=True)}
        known = combinations_known(error, truth, laws)
        figures |= {f"unseen_known.{view}.{k + 1}": Figure(value) for k, value in enumerate(known)}
        figures |= {f"unseen_known.{view}.tarp_p": Figure(row["TARP"][1])}
        table += [["width", *np.mean(row["width"], axis=0)], ["R² of combinations", *known]]
        show([view, *PARAMETERS], table, f"{len(laws)} queries of {len(np.unique(laws))} laws; TARP {row['TARP']}")
    return figures


# ---- runs ------------------------------------------------------------------------------------------------------------

#: Names of the parameters in the ledger.
SLUGS = ("a11", "log_a02", "a10", "a01", "a00", "m0")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--table", type=Path)
    parser.add_argument("--views", default="mask,crop,scan")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--gallery", action="store_true")
    parser.add_argument("--unseen", type=Path, nargs="+", help="stores of laws that no choice has seen")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    warnings.filterwarnings("ignore", module="sklearn")
    if options.gallery:
        return on_gallery(options, cases)
    if options.unseen:
        return on_unseen(options, cases)
    if options.table is None:
        raise SystemExit("name a table with --table (curvafit atlas describe makes one), --gallery or --unseen")
    views, folds = options.views.split(","), 2 if options.quick else FOLDS
    table = load_table(options.table).visible.select_views(views)
    figures: dict[str, Figure] = {}
    for name in ["match"] if options.quick else options.methods.split(","):
        answers = cross_answers(table, name, folds, cases)
        jobs = {}
        for view in views:
            mine = table.views == view
            part = Answers(answers.mean[mine], None if answers.draws is None else answers.draws[mine])
            truth = table.parameters[mine]
            jobs[f"{name}-{view}-{folds}"] = lambda t=truth, p=part: judged(t, p, table.parameters.std(0))
        found = cases.all(jobs)
        rows = [[f"{view}: {key}", *row[key]] for view, row in zip(views, found.values(), strict=True)
                for key in ("R²", "error", "in 90", "width") if key in row]  # fmt: skip
        show([name, *PARAMETERS], rows, f"{len(np.unique(table.shapes))} shapes, {folds} folds")
        for view, row in zip(views, found.values(), strict=True):
            figures |= {f"r2_{view}.{name}.{slug}": Figure(value) for slug, value in zip(SLUGS, row["R²"], strict=True)}
            if "TARP" in row:
                print(f"  {view}: ranks p {row['ranks p']:.2g}; TARP {row['TARP']:.3f}, p {row['TARP p']:.3f}")
                figures |= {f"calibrated.{name}_{view}.{key}": Figure(value) for key, value in
                            (("in90", float(np.mean(row["in 90"]))), ("tarp", row["TARP"]), ("tarp_p", row["TARP p"]),
                             ("ranks_p", row["ranks p"]))}  # fmt: skip
    return figures
