"""Parameters read back from shapes whose parameters are known: errors, intervals and R² of each method.

`--unseen STORE…` asks for laws that no choice has seen: shapes of any size, as masks and as degraded scans (or
`--views`). Errors are medians, in deviations of the box of `curvafit atlas build`; R² is 1 - mean square error /
variance of a parameter; intervals are of the bootstrap over laws.

Methods: `posterior`, the packaged one; and from the rows that taught it `match`, the nearest shape by the curvature
block, and `process`, a Gaussian process for each parameter on principal components. `--before FILE` is another
posterior: `gain` is by how much the packaged one errs less, the mean over parameters, paired by laws.

Of the posterior also: `sum_k`, the median error of its combinations of parameters, the least first, in deviations among
laws; `tarp`, how far the part of laws that lie in regions around random centres is at most from the regions'
credibility (Lemos et al. 2023), and `chance`, what it is at most, 19 times of 20, where a posterior is right.
"""

from __future__ import annotations

import argparse
import warnings
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from benchmarks.teaching import gather
from curvafit.data_synth.design import INTERVALS
from curvafit.data_synth.store import Store, find_well_formed, open_store
from curvafit.inference.posterior import Posterior, load_posterior
from curvafit.inference.table import PARAMETERS, column_names, parameters_of
from curvafit.scan.measures import read_texture
from curvafit.scan.preparation import prepare, thinner_thickness
from curvafit.volumes.volume import ScanError
from examples.train import VIEWS, Table, compression_of, to_row

DRAWS = 400
#: Components that the Gaussian process sees.
COMPONENTS = 32
#: Edge of the shapes that posteriors learn from, in voxels.
UNIT = 64
#: Names of the parameters in the ledger.
SLUGS = ("a11", "log_a02", "a10", "a01", "a00", "m0")
#: Ends, middle and deviation of each parameter in the box.
ENDS = np.array([np.log(ends) if name == "a02" else ends for name, ends in INTERVALS.items()], dtype=float)
MIDDLE, PRIOR = ENDS.mean(1), np.ptp(ENDS, axis=1) / np.sqrt(12)


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

    compression = compression_of(training.descriptors, COMPONENTS)
    x, at, found = compression(training.descriptors), compression(queries.descriptors), []
    for y in training.parameters.T:
        kernel = ConstantKernel(1.0) * RBF(5.0, (0.3, 1e3)) + WhiteKernel(0.1)
        model = GaussianProcessRegressor(kernel).fit(x, (y - y.mean()) / y.std())
        found.append(model.predict(at) * y.std() + y.mean())
    return Answers(np.stack(found, 1), None)


def asked(trained: Posterior, queries: Table) -> Answers:
    draws = trained.sample(queries.descriptors, queries.views, queries.amount, DRAWS)[..., : len(PARAMETERS)]
    return Answers(np.median(draws, axis=1), draws)


def methods(view: str) -> dict[str, Callable[[Table], Answers]]:
    """Return the methods by name."""
    trained, training = load_posterior(), gather().visible.select_views([view])
    return {
        "posterior": partial(asked, trained),
        "match": partial(match, training),
        "process": partial(process, training),
    }


# ---- figures ---------------------------------------------------------------------------------------------------------


def over_laws(values: np.ndarray, laws: np.ndarray, statistic: Callable[..., np.ndarray]) -> list[Figure]:
    """Return a statistic of queries' values (N, k), by column, with the intervals of the bootstrap over laws."""
    rows, random = [values[laws == law] for law in np.unique(laws)], np.random.default_rng(0)
    drawn = [statistic(np.concatenate([rows[k] for k in random.integers(len(rows), size=len(rows))]), axis=0)
             for _ in range(1000)]  # fmt: skip
    return list(map(Figure, statistic(values, axis=0), *np.quantile(drawn, (0.025, 0.975), axis=0)))


def judge(queries: Table, method: Callable[[Table], Answers]) -> Values:
    """Return laws, errors and truths in deviations of the box; and of draws whether their 90 % intervals hold."""
    truth, (best, draws) = queries.parameters, method(queries)
    found: Values = {
        "law": [f"{zlib.crc32(np.round(row, 6).tobytes()):08x}" for row in truth],
        "error": np.round((best - truth) / PRIOR, 3).tolist(),
        "truth": np.round((truth - MIDDLE) / PRIOR, 3).tolist(),
    }
    if draws is not None:
        least, most = np.quantile(draws, (0.05, 0.95), axis=1)
        found["in 90"] = ((least <= truth) & (truth <= most)).tolist()
        sums = load_posterior().combinations
        found["sums"] = np.round(np.median(sums(draws), axis=1) - sums(truth), 3).tolist()
        found["credibility"] = np.round(credibility_of(truth, draws), 4).tolist()
    return found


def credibility_of(truth: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Return the part `(N,)` of draws `(N, n, 6)` nearer to a random law of the box than the truth `(N, 6)`."""
    centres = np.random.default_rng(0).uniform(*ENDS.T, truth.shape)
    own = np.linalg.norm((truth - centres) / PRIOR, axis=-1)
    return (np.linalg.norm((draws - centres[:, None]) / PRIOR, axis=-1) < own[:, None]).mean(1)


def report(name: str, group: str, row: Values) -> dict[str, Figure]:
    """Show what a method says of queries; return its figures for the ledger."""
    laws, error, truth = np.array(row["law"]), *(np.array(row[key], dtype=float) for key in ("error", "truth"))
    found = {"error": over_laws(np.abs(error), laws, np.median)}
    if "in 90" in row:
        found["in90"] = over_laws(np.array(row["in 90"], dtype=float), laws, np.mean)
    found["r2"] = list(map(Figure, 1 - np.square(error).mean(0) / truth.var(0)))
    show([name, *PARAMETERS], [[key, *values] for key, values in found.items()], f"{group}: {len(laws)} queries")
    figures = {f"{group}_{key}.{name}.{slug}": value for key, values in found.items()
               for slug, value in zip(SLUGS, values, strict=True)}  # fmt: skip
    if "sums" in row:
        errors = sorted(over_laws(np.abs(np.array(row["sums"])), laws, np.median))
        figures |= {f"{group}_{name}.sum_{k}": each for k, each in enumerate(errors, 1)}
        figures[f"{group}_{name}.tarp"] = Figure(float(stats.kstest(row["credibility"], "uniform").statistic))
        figures[f"{group}_{name}.chance"] = Figure(float(stats.kstwo.ppf(0.95, len(laws))))
    return figures


def unseen_table(paths: list[Path], view: str, cases: Cases) -> Table:
    """Return what is read in a view of the well-formed shapes of stores."""
    rows, laws, names = [], [], []

    def measured(store: Store, index: int) -> np.ndarray:
        """Return descriptors, how much was seen, and thickness in a row."""
        field = store.field(index)
        scan, kind, periodic = VIEWS[view](field, np.random.default_rng([zlib.crc32(view.encode()), index]))
        try:
            reading = read_texture(prepare(scan, kind=kind, periodic=periodic, one_scale=True))
        except ScanError:
            reading = None
        amount = np.nan if reading is None else reading.amount
        return np.array([*to_row(reading), amount, thinner_thickness(field > 0)])

    for store, index in find_well_formed(tuple(paths)):
        names.append(f"{store.name}-{index}")
        rows.append(cases.array(f"read-{names[-1]}-{view}", partial(measured, store, index)))
        laws.append(parameters_of(store.record(index).coefficients, store.record(index).mass))
    found, views = np.array(rows), np.array([view] * len(rows))
    table = Table(np.array(names), views, np.array(laws), found[:, -1], found[:, :-2], found[:, -2], {})
    return table.rows(np.isfinite(found).all(1))


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--unseen", type=Path, nargs="+", required=True, help="stores of laws that no choice has seen")
    parser.add_argument("--views", default="mask,scan")
    parser.add_argument("--before", type=Path, help="a posterior to compare with")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    warnings.filterwarnings("ignore", module="sklearn")
    edge = open_store(options.unseen[0]).settings.shape[0]
    group, figures = "unseen" + (str(edge) if edge != UNIT else ""), dict[str, Figure]()
    for view in options.views.split(","):
        queries = unseen_table(options.unseen, view, cases)
        if options.before is not None:
            answers = (asked(load_posterior(path), queries).best for path in (options.before, None))
            before, after = (np.abs(best - queries.parameters) / PRIOR for best in answers)
            figures[f"{group}_gain.{view}"] = bootstrap((before - after).mean(1), np.mean)
        for name, method in methods(view).items():
            case = f"{group}-{view}-{name}"
            row = cases.all({case: partial(judge, queries, method)})[case]
            figures |= report(f"{view}_{name}", group, row)
    return {} if options.quick else figures
