"""Parameters read back from shapes whose parameters are known: errors, widths and calibration of each method.

    python -m benchmarks.closure TABLE.npz [--cache FOLDER] [--views field,mask,crop,scan] [--folds 5]
    python -m benchmarks.closure TABLE.npz --curve 100,200,400          # R² by number of training shapes
    python -m benchmarks.closure TABLE.npz --ablation                   # R² without each block, and with it alone
    CURVAFIT_DATA=… python -m benchmarks.closure TABLE.npz --gallery    # the author's volumes, as masks
    python -m benchmarks.closure TABLE.npz --misfit                     # how often the check alarms at p < .05

TABLE is made by `curvafit atlas describe`. Each shape is answered for by what was trained on the other folds alone, all
its views being in one fold. Answers are kept in the cache's folder, so that a stopped run goes on.

Methods: `match`, the nearest training shape by the curvature block; `ridge`, linear regression on all columns;
`process`, a Gaussian process for each parameter on principal components; `posterior`, the ensemble of flows; `refined`,
the emulator's best parameters from the posterior's draws, with the covariance there.

- error: median |error| in deviations of the prior; R²: 1 - mean square error / variance.
- in 50, in 90: part of the true values in the central 50 and 90 % intervals; wide 90: their mean width in deviations of
  the prior (a uniform prior's is 3.1).
- ranks: p-value that the ranks of the truth among draws are uniform (SBC: χ² of 10 bins, the least of six times six).
- TARP: greatest difference of expected and stated coverage of balls around random points (Lemos et al. 2023):
  about 0.05 for exact draws and 400 queries, 0.1 for intervals a fifth too wide.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import time
import warnings
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import nibabel
import numpy as np
from scipy import stats

from curvafit.geometry.descriptors import BLOCKS, descriptors
from curvafit.inference.check import amortised_p
from curvafit.inference.compression import compression_of
from curvafit.inference.emulator import optimum
from curvafit.inference.posterior import Architecture, Posterior, load_posterior, save_posterior
from curvafit.inference.posterior_training import train_posterior
from curvafit.inference.table import PARAMETERS, Table, column_names, load_table, parameters_of
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid

DRAWS = 400
#: Draws from which the best parameters are looked for.
STARTS = 16
#: Flows of a posterior; in curve and ablation, which compare, a single one.
MEMBERS = 4


class Answers(NamedTuple):
    """What a method says of N queries: means `(N, 6)`, draws `(N, DRAWS, 6)`, none of a method without width."""

    mean: np.ndarray
    draws: np.ndarray | None


Method = Callable[[Table, Table], Answers]


def match(training: Table, queries: Table) -> Answers:
    """The parameters of the training row of the same view whose curvature block is nearest."""
    columns = np.array(column_names()) == "curvature"
    mean = np.empty((len(queries), len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine, rows = queries.views == view, training.of([view])
        apart = rows.descriptors[None, :, columns] - queries.descriptors[mine][:, None, columns]
        mean[mine] = rows.parameters[np.square(apart).sum(-1).argmin(1)]
    return Answers(mean, None)


def ridge(training: Table, queries: Table) -> Answers:
    from sklearn.linear_model import RidgeCV
    from sklearn.preprocessing import StandardScaler

    mean = np.empty((len(queries), len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine, rows = queries.views == view, training.of([view])
        scaler = StandardScaler().fit(rows.descriptors)
        model = RidgeCV(np.logspace(0, 5, 16)).fit(scaler.transform(rows.descriptors), rows.parameters)
        mean[mine] = model.predict(np.clip(scaler.transform(queries.descriptors[mine]), -6, 6))
    return Answers(mean, None)


def process(training: Table, queries: Table) -> Answers:
    """Independent Gaussian processes for the six parameters, one for each view."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    mean, spread = np.empty((2, len(queries), len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine, rows = queries.views == view, training.of([view])
        compression = compression_of(rows.descriptors, Architecture().components)
        x, asked = compression(rows.descriptors), compression(queries.descriptors[mine])
        for k, y in enumerate(rows.parameters.T):
            kernel = ConstantKernel(1.0) * RBF(5.0, (0.3, 1e3)) + WhiteKernel(0.1)
            model = GaussianProcessRegressor(kernel).fit(x, (y - y.mean()) / y.std())
            told, width = model.predict(asked, return_std=True)
            mean[mine, k], spread[mine, k] = told * y.std() + y.mean(), width * y.std()
    noise = np.random.default_rng(0).standard_normal((len(queries), DRAWS, len(PARAMETERS)))
    return Answers(mean, mean[:, None] + spread[:, None] * noise)


def posterior(training: Table, queries: Table, cache: Path) -> Answers:
    return asked(learnt(training, cache), queries)


def refined(training: Table, queries: Table, cache: Path) -> Answers:
    """The best parameters by the emulator, with normal draws about them, cut at the box."""
    trained, rng = learnt(training, cache), np.random.default_rng(0)
    mean, draws = np.empty((len(queries), len(PARAMETERS))), np.empty((len(queries), DRAWS, len(PARAMETERS)))
    for k, (row, view) in enumerate(zip(queries.descriptors, queries.views.tolist(), strict=True)):
        best = optimum(trained.emulator, row, view, trained.sample(row, view, STARTS))
        mean[k] = best.parameters
        draws[k] = np.clip(rng.multivariate_normal(best.parameters, best.covariance, DRAWS), *trained.box.T)
    return Answers(mean, draws)


def learnt(training: Table, cache: Path) -> Posterior:
    """The posterior of a table, trained once for all that ask it."""
    path = cache / f"{key_of(training)}-posterior{MEMBERS}.npz"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        save_posterior(train_posterior(training, members=MEMBERS), path)
    return load_posterior(path)


def lone(training: Table, queries: Table) -> Answers:
    """The posterior as one flow."""
    return asked(train_posterior(training, members=1), queries)


def asked(trained: Posterior, queries: Table) -> Answers:
    draws = np.empty((len(queries), DRAWS, len(PARAMETERS)))
    for view in set(queries.views.tolist()):
        mine = queries.views == view
        draws[mine] = trained.sample(queries.descriptors[mine], view, DRAWS)
    return Answers(draws.mean(1), draws)


def methods(cache: Path) -> dict[str, Method]:
    trained = {"posterior": partial(posterior, cache=cache), "refined": partial(refined, cache=cache)}
    return {"match": match, "ridge": ridge, "process": process} | trained


# ---- folds -----------------------------------------------------------------------------------------------------------


def fold_of(table: Table, folds: int) -> np.ndarray:
    """The fold of each row, by its shape's name: a shape stays in its fold as a table grows."""
    return np.array([zlib.crc32(shape.encode()) % folds for shape in table.shapes])


def cross_answers(table: Table, method: Method, folds: int, cache: Path | None = None, name: str = "") -> Answers:
    """What a method says of each row, trained on the shapes of the other folds."""
    fold, parts = fold_of(table, folds), {}
    for k in range(folds):
        queries, training = table.rows(fold == k), table.rows(fold != k)
        path = cache / f"{key_of(table)}-{name}-{k}of{folds}.npz" if cache else None
        if path is not None and path.exists():
            content = np.load(path)
            parts[k] = Answers(content["mean"], content.get("draws"))
            continue
        parts[k] = method(training, queries)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, **{n: v for n, v in parts[k]._asdict().items() if v is not None})
    mean = np.empty((len(table), len(PARAMETERS)))
    draws = None if parts[0].draws is None else np.empty((len(table), DRAWS, len(PARAMETERS)))
    for k, part in parts.items():
        mean[fold == k] = part.mean
        if draws is not None:
            draws[fold == k] = part.draws
    return Answers(mean, draws)


def key_of(table: Table) -> str:
    names = "\n".join(f"{shape} {view}" for shape, view in zip(table.shapes, table.views, strict=True))
    return hashlib.sha256(names.encode() + table.descriptors.tobytes()).hexdigest()[:12]


# ---- figures ---------------------------------------------------------------------------------------------------------


def r_squared(truth: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return 1 - np.square(mean - truth).mean(0) / truth.var(0)


def ranks(truth: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """The part of the draws below the truth, `(N, 6)`."""
    return (draws < truth[:, None]).mean(1)


def coverage(truth: np.ndarray, draws: np.ndarray, level: float) -> np.ndarray:
    return (np.abs(ranks(truth, draws) - 0.5) <= level / 2).mean(0)


def width(draws: np.ndarray, level: float) -> np.ndarray:
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=1)
    return (high - low).mean(0)


def rank_p(truth: np.ndarray, draws: np.ndarray, bins: int = 10) -> np.ndarray:
    """p-values that ranks are uniform."""
    counts = [np.histogram(column, bins, (0, 1 + 1e-9))[0] for column in ranks(truth, draws).T]
    return np.array([stats.chisquare(each).pvalue for each in counts])


def tarp(truth: np.ndarray, draws: np.ndarray, seed: int = 0) -> float:
    """Greatest difference between the part of truths nearer to random points than a part of the draws, and that."""
    low, high = truth.min(0), truth.max(0)
    points = np.random.default_rng(seed).uniform(low, high, truth.shape)
    scale = truth.std(0)
    apart = np.linalg.norm((draws - points[:, None]) / scale, axis=-1)
    true = np.linalg.norm((truth - points) / scale, axis=-1)
    nearer = (apart < true[:, None]).mean(1)
    levels = np.linspace(0.05, 0.95, 19)
    return float(np.abs([(nearer < level).mean() - level for level in levels]).max())


def show(label: str, values: Sequence[float] | np.ndarray, extra: str = "") -> None:
    print(f"    {label:10} " + " ".join(f"{value:8.2f}" for value in values) + f"  {extra}", flush=True)


def show_answers(name: str, truth: np.ndarray, answers: Answers, prior: np.ndarray) -> None:
    print(f"  {name}")
    show("R²", r_squared(truth, answers.mean))
    show("error", np.median(np.abs(answers.mean - truth), axis=0) / prior)
    if answers.draws is not None:
        show("in 50", coverage(truth, answers.draws, 0.5))
        show("in 90", coverage(truth, answers.draws, 0.9), f"all {coverage(truth, answers.draws, 0.9).mean():.3f}")
        show("wide 90", width(answers.draws, 0.9) / prior)
        least = min(1.0, len(PARAMETERS) * rank_p(truth, answers.draws).min())
        print(f"    ranks: p {least:.2g}; TARP {tarp(truth, answers.draws):.3f}", flush=True)


# ---- runs ------------------------------------------------------------------------------------------------------------


def closure(table: Table, views: Sequence[str], folds: int, cache: Path) -> None:
    for name, method in methods(cache).items():
        begun = time.perf_counter()
        answers = cross_answers(table, method, folds, cache, f"{name}-{'-'.join(views)}")
        print(f"{name}: {time.perf_counter() - begun:.0f} s")
        for view in views:
            mine = table.views == view
            part = Answers(answers.mean[mine], None if answers.draws is None else answers.draws[mine])
            show_answers(view, table.parameters[mine], part, table.parameters.std(0))


def curve(table: Table, counts: Sequence[int], folds: int, cache: Path) -> None:
    """R² by the number of training shapes, of the process and of one flow."""
    for count in counts:

        def fewer(method: Method, count: int = count) -> Method:
            def learn(training: Table, queries: Table) -> Answers:
                shapes = np.unique(training.shapes)
                chosen = np.random.default_rng(0).permutation(shapes)[:count]
                return method(training.rows(np.isin(training.shapes, chosen)), queries)

            return learn

        for name, method in (("process", process), ("flow", lone)):
            answers = cross_answers(table, fewer(method), folds, cache, f"{name}-first{count}")
            for view in sorted(set(table.views.tolist())):
                mine = table.views == view
                values = r_squared(table.parameters[mine], answers.mean[mine])
                show(f"{count} {view}", values, f"mean {values.mean():.3f}, {name}")


def ablation(table: Table, folds: int, cache: Path) -> None:
    """R² of one flow from all blocks, without each, and from the curvature block with each alone."""
    every = tuple(BLOCKS)
    cases = {"all": every} | {f"no {name}": tuple(b for b in every if b != name) for name in every}
    cases["curvature"] = ("curvature",)
    cases |= {f"+ {name}": ("curvature", name) for name in every if name != "curvature"}
    for label, blocks in cases.items():

        def learn(training: Table, queries: Table, blocks: tuple[str, ...] = blocks) -> Answers:
            return asked(train_posterior(training, Architecture(blocks=blocks), members=1), queries)

        answers = cross_answers(table, learn, folds, cache, f"flow-{label.replace(' ', '_')}")
        values = r_squared(table.parameters, answers.mean)
        print(f"  {label:16} " + " ".join(f"{v:6.2f}" for v in values) + f"   mean {values.mean():.3f}", flush=True)


def misfit(table: Table, folds: int, cache: Path) -> None:
    """How often shapes of the model raise an alarm, by view: the p-values of each fold by what the others taught."""
    fold, p = fold_of(table, folds), np.empty(len(table))
    for k in range(folds):
        path, mine = cache / f"{key_of(table)}-misfit-{k}of{folds}.npy", np.flatnonzero(fold == k)
        if not path.exists():
            trained = learnt(table.rows(fold != k), cache)
            cache.mkdir(parents=True, exist_ok=True)
            np.save(path, [p_of(trained, table, row) for row in mine])
        p[mine] = np.load(path)
    for view in sorted(set(table.views.tolist())):
        mine = p[table.views == view]
        print(
            f"  {view:10} alarms at .05: {(mine < 0.05).mean():.3f}, at .01: {(mine < 0.01).mean():.3f}, of {len(mine)}"
        )


def p_of(trained: Posterior, table: Table, row: int | np.integer) -> float:
    descriptors, view = table.descriptors[row], str(table.views[row])
    starts = trained.sample(descriptors, view, STARTS)
    return amortised_p(trained, view, optimum(trained.emulator, descriptors, view, starts).misfit)


def gallery(table: Table, folder: Path, cache: Path) -> None:
    """The author's volumes as masks, by what was trained on the whole table."""
    queries = author_table(folder, cache)
    trained = learnt(table, cache)
    prior = table.parameters.std(0)
    answers = {name: method(table, queries) for name, method in methods(cache).items() if name != "ridge"}
    alarms = [p_of(trained, queries, k) for k in range(len(queries))]
    print("misfit: " + ", ".join(f"{n} {p:.3f}" for n, p in zip(queries.shapes, alarms, strict=True)))
    for name, each in answers.items():
        error = (each.mean - queries.parameters) / prior
        print(f"{name}: error in deviations of the prior")
        for shape, row in zip(queries.shapes, error, strict=True):
            show(shape[:10], row)
        show("median", np.median(np.abs(error), axis=0))
        if each.draws is not None:
            show("in 90", coverage(queries.parameters, each.draws, 0.9))
            show("wide 90", width(each.draws, 0.9) / prior)


def truth_of(path: Path) -> np.ndarray:
    """The parameters in an author's file's name."""
    law, mass = re.search(r"\[(.*?)\]", path.name), re.search(r" m (-?[\d.]+)\.nii", path.name)
    assert law is not None
    assert mass is not None
    return parameters_of(Coefficients(*map(float, law[1].split())), float(mass[1]))


def author_table(folder: Path, cache: Path) -> Table:
    """The author's volumes, measured as masks; the parameters are in the names of the files."""
    names, parameters, rows = [], [], []
    for path in sorted(folder.glob("*coeffs*.nii.gz")):
        names.append(path.name.partition(" coeffs")[0].replace(" ", ""))
        parameters.append(truth_of(path))
        kept = cache / f"author-{names[-1]}.npy"
        if not kept.exists():
            mask = np.ascontiguousarray(np.asarray(nibabel.load(path).dataobj) > 0)  # type: ignore[attr-defined]
            cache.mkdir(parents=True, exist_ok=True)
            np.save(kept, descriptors(mask, Grid(mask.shape)).vector())
        rows.append(np.load(kept))
    return Table(np.array(names), np.array(["mask"] * len(names)), np.array(parameters), np.array(rows), {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("--cache", type=Path, default=Path("closure_cache"))
    parser.add_argument("--views", default=None)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--curve", default=None)
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--gallery", action="store_true")
    parser.add_argument("--misfit", action="store_true")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", module="sklearn")
    table = load_table(options.table).visible
    views = sorted(set(table.views.tolist())) if options.views is None else options.views.split(",")
    table = table.of(views)
    print(f"{len(np.unique(table.shapes))} shapes; columns: {', '.join(PARAMETERS)}", flush=True)
    if options.curve is not None:
        curve(table, [int(n) for n in options.curve.split(",")], options.folds, options.cache)
    elif options.ablation:
        ablation(table, options.folds, options.cache)
    elif options.misfit:
        misfit(table, options.folds, options.cache)
    elif options.gallery:
        gallery(table, Path(os.environ["CURVAFIT_DATA"]) / "gallery", options.cache)
    else:
        closure(table, views, options.folds, options.cache)


if __name__ == "__main__":
    main()
