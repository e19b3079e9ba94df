"""Shapes regrown from inferred laws against the shape that was read, beside the truth regrown and a null.

    python -m benchmarks.closure_regrown STORE [--posterior FILE] [--cache FOLDER] [--queries 60] [--few 10]
                                         [--views field,mask,scan] [--methods refined,…] [--minutes 3]

The queries are STORE's first well-formed shapes, which neither the posterior nor the packaged atlas must have learnt
from. Each is seen through each view (`inference.views`), and each method reads a law from the view, as
`benchmarks.closure_laws` says. Two shapes of the law are grown, in the query's box, by the store's schedule and with
the same seeds for all methods, and seen through the same view, cropped and degraded by other random numbers. A run ends
after some minutes with the table so far, and the next one goes on; what is kept is a file for each query, view and
method, named after the posterior or the atlas that the method knows. The slow methods are asked on the first `--few`
queries alone; with as many `--queries`, the table has all methods on the same ones. A query takes some 85 s of a core
(AMD EPYC, Zen 5), and 8 min more by the slow methods.

A distance is a mean over the shapes that grew, infinite where none did; it is measured in two ways:

- diagram: between curvature diagrams, as `infer` compares twins with a scan.
- numbers: what no method fits by itself: logarithms of quantiles of local thickness in the structure and in the
  background (diameters of the largest balls, of the window), and √ of the numbers of pieces, tunnels and cavities; in
  deviations between seeds of one law, pooled over the queries; root mean square over the three kinds.

Floor: the truth's, regrown from the query's own law and mass. Null: of level cuts of Gaussian random fields with the
whole shape's volume fraction and two-point function (`benchmarks.level_cut`), seen through the view; it needs no law.

`posterior as full` is the posterior's law grown to fill as much of its box as the view shows, as `infer` grows twins of
masks and images. `chosen` is the law of posterior, optimum or match whose first shape is nearest in the diagram, judged
by its second alone.

- n, grew: queries that were asked, and the part of which a shape grew.
- /floor: median over queries of distance over floor, with quartiles. /null: the part of queries that are nearer to the
  query than the null is.
- error by parameter: median |error| in deviations of the prior, uniform in the posterior's box.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.closure_trials import METHODS, NUMBERS, Bench, Trial, jobs, proceed, queries_of
from curvafit.data_synth import open_store
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import PARAMETERS

#: Greatest median of /floor, by view.
BARS = {"field": 1.25, "mask": 1.35, "scan": 1.8}
#: Methods among which the nearest is chosen.
CHOICE = ("posterior", "optimum", "match")


def deviations(families: Sequence[np.ndarray]) -> np.ndarray:
    """Deviations `(13,)` between seeds of one law, pooled over laws of which numbers `(n, 13)` are known, at least the
    least ones."""
    rows = [each[np.isfinite(each).all(1)] for each in families]
    squares = sum(np.square(each - each.mean(0)).sum(0) for each in rows if len(each))
    least = np.concatenate([np.full(count, low) for count, low in NUMBERS.values()])
    return np.maximum(np.sqrt(squares / max(1, sum(len(each) - 1 for each in rows if len(each)))), least)


def apart(one: np.ndarray, many: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Distances `(n,)` of numbers `(13,)` to others `(n, 13)`: root mean squares over kinds; infinite where NaN."""
    squares = np.split(np.square((many - one) / deviation), np.cumsum([count for count, _ in NUMBERS.values()])[:-1], 1)
    distance = np.sqrt(np.mean([each.mean(1) for each in squares], axis=0))
    return np.where(np.isfinite(distance), distance, np.inf)


def mean_of_grown(distances: np.ndarray) -> float:
    """The mean of those that are finite, infinite where none is."""
    finite = distances[np.isfinite(distances)]
    return float(finite.mean()) if len(finite) else np.inf


def quartiles(ratios: np.ndarray) -> np.ndarray:
    """Median and quartiles of numbers that may be infinite: between two of them, their mean."""
    if not len(ratios):
        return np.full(3, np.nan)
    low, high = (np.quantile(ratios, (0.5, 0.25, 0.75), method=method) for method in ("lower", "higher"))
    return (low + high) / 2


#: Trials by query.
Trials = dict[int, Trial]


def load_trials(bench: Bench, queries: Sequence[int], view: str) -> tuple[Trials, dict[str, Trials]]:
    """The queries whose view shows a surface, in a trial's form; and the trials of them, by method."""
    own = {k: each for k in queries if (each := load(bench.path(k, view, "itself"))) is not None}
    own = {k: each for k, each in own.items() if len(each.distances)}
    by_method = {
        name: {k: each for k in own if (each := load(bench.trial_path(k, view, name))) is not None} for name in METHODS
    }
    return own, by_method | {"chosen": chosen(by_method)}


def chosen(by_method: dict[str, Trials]) -> Trials:
    """Of each query the trial of the method, among `CHOICE`, whose first shape is nearest in the diagram, without that
    shape."""
    trials = {}
    for k in set.intersection(*(set(by_method[name]) for name in CHOICE)):
        best = min((by_method[name][k] for name in CHOICE), key=lambda each: each.distances[0])
        trials[k] = Trial(best.parameters, best.distances[1:], best.numbers[1:])
    return trials


def load(path: Path) -> Trial | None:
    """A trial from its file, None where there is none."""
    return Trial(**np.load(path)) if path.exists() else None


class Measured(NamedTuple):
    """A method's mean distances by query, in the diagram and in numbers."""

    diagram: dict[int, float]
    numbers: dict[int, float]


def measured(own: Trials, by_method: dict[str, Trials]) -> dict[str, Measured]:
    deviation = deviations([np.vstack([own[k].numbers, each.numbers]) for k, each in by_method["truth"].items()])
    return {
        name: Measured(
            {k: mean_of_grown(each.distances) for k, each in trials.items()},
            {k: mean_of_grown(apart(own[k].numbers[0], each.numbers, deviation)) for k, each in trials.items()},
        )
        for name, trials in by_method.items()
    }


def against(mine: dict[int, float], floor: dict[int, float], null: dict[int, float]) -> np.ndarray:
    """Median and quartiles of distances over the floor, and the part of queries below the null `(4,)`: of queries whose
    truth regrew and that have a null."""
    shared = [k for k in mine if np.isfinite(floor.get(k, np.inf)) and k in null]
    ratios = np.array([mine[k] / floor[k] for k in shared])
    below = np.array([mine[k] < null[k] for k in shared])
    return np.append(quartiles(ratios), below.mean() if len(below) else np.nan)


def show(view: str, own: Trials, by_method: dict[str, Trials], prior: np.ndarray) -> None:
    """Print the table of a view; `prior` `(6,)` is the parameters' deviations."""
    told = measured(own, by_method)
    floor, null = told["truth"], told["null"]
    texts = [
        "{:.2f} ({:.2f}, {:.2f})".format(*quartiles(np.array([d for d in each.values() if np.isfinite(d)])))
        for each in floor
    ]
    print(f"{view}: floor {texts[0]} in the diagram, {texts[1]} in numbers; bar {BARS.get(view, np.nan):g}")
    wide = " ".join(f"{each + ' /floor':>18} {'/null':>5}" for each in floor._fields)
    print(f"  {'method':17} {'n':>3} {'grew':>4} {wide} " + " ".join(f"{name:>7}" for name in PARAMETERS))
    for name, trials in by_method.items():
        if not trials:
            continue
        ratios = " ".join(
            "{:6.2f} ({:4.2f}, {:4.2f}) {:5.2f}".format(*against(*parts))
            for parts in zip(told[name], floor, null, strict=True)
        )
        errors = np.array([each.parameters - own[k].parameters for k, each in trials.items()]) / prior
        grew = np.mean([np.isfinite(each.distances).any() for each in trials.values()])
        error = " ".join(f"{value:7.2f}" for value in np.median(np.abs(errors), axis=0))
        print(f"  {name:17} {len(trials):3} {grew:4.2f} {ratios} {'' if name == 'null' else error}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--posterior", type=Path, default=None)
    parser.add_argument("--cache", type=Path, default=Path("closure_regrown"))
    parser.add_argument("--queries", type=int, default=60)
    parser.add_argument("--few", type=int, default=10)
    parser.add_argument("--views", default=",".join(BARS))
    parser.add_argument("--methods", default=",".join(METHODS), help="those that are run; all that is kept is shown")
    parser.add_argument("--minutes", type=float, default=3.0)
    options = parser.parse_args()
    store = open_store(options.store)
    views = tuple(options.views.split(","))
    bench = Bench(store, load_posterior(options.posterior), options.cache, views)
    options.cache.mkdir(parents=True, exist_ok=True)
    queries = queries_of(store, options.queries)
    left = proceed(jobs(bench, queries, options.few, options.methods.split(",")), options.minutes)
    for view in views:
        show(view, *load_trials(bench, queries, view), bench.posterior.emulator.deviation)
    print(f"{left} files left: run again" if left else "all done")


if __name__ == "__main__":
    main()
