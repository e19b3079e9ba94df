"""Whether the posterior is calibrated where a query lies, and not only on average: local classifier tests.

    python -m benchmarks.closure_local TABLE.npz --cache FOLDER [--views mask,crop,scan] [--folds 5] [--asked 100]

TABLE and the cache are those of `benchmarks.closure`, whose answers are taken from there or made. A random forest
learns on half of the queries to tell (parameters, descriptors) from (a draw of the posterior, descriptors); of each of
the other half's first queries, what it says of the draws is compared with what 100 forests say that learnt shuffled
labels (L-C2ST, Linhart et al. 2023, by the package sbi). Descriptors are compressed as for the flows. sbi's perceptrons
stop too early on so few queries to see what is plainly wrong.

- p < .05, p < .10: part of the queries at which the draws can be told from the truth: some .05 and .10 where none can
  (the forests are the same for all, so these parts vary together). median: of p.
"""

from __future__ import annotations

import argparse
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.closure import cross_answers, posterior
from curvafit.inference.compression import compression_of
from curvafit.inference.posterior import Architecture
from curvafit.inference.table import load_table


def local_p(
    truth: np.ndarray, context: np.ndarray, draws: np.ndarray, asked: int, *, trials: int = 100, seed: int = 0
) -> np.ndarray:
    """p-values `(asked,)` that draws `(N, DRAWS, 6)` are of the law of the truth `(N, 6)`, given a context `(N, K)`, at
    the first queries of the half that no classifier sees."""
    from sbi.diagnostics import LC2ST

    shuffled = np.random.default_rng(seed).permutation(len(truth))
    known, others = np.array_split(shuffled, 2)
    test = LC2ST(
        prior_samples=_tensor(truth[known]),
        xs=_tensor(context[known]),
        posterior_samples=_tensor(draws[known, 0]),
        seed=seed,
        classifier="random_forest",
        num_trials_null=trials,
    )
    test.train_under_null_hypothesis(verbosity=0)
    test.train_on_observed_data(verbosity=0)
    return np.array([test.p_value(_tensor(draws[k]), _tensor(context[k : k + 1])) for k in others[:asked]])


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("--cache", type=Path, default=Path("closure_cache"))
    parser.add_argument("--views", default="mask,crop,scan")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--asked", type=int, default=100)
    options = parser.parse_args()
    warnings.filterwarnings("ignore", module="sklearn")
    views = options.views.split(",")
    table = load_table(options.table).visible.of(views)
    learn = partial(posterior, cache=options.cache)
    answers = cross_answers(table, learn, options.folds, options.cache, f"posterior-{options.views.replace(',', '-')}")
    assert answers.draws is not None
    print(f"{'view':8} {'queries':>7} {'p < .05':>8} {'p < .10':>8} {'median':>8}")
    for view in views:
        mine = table.views == view
        rows = table.descriptors[mine]
        context = compression_of(rows, Architecture().components)(rows)
        p = local_p(table.parameters[mine], context, answers.draws[mine], options.asked)
        parts = [(p < 0.05).mean(), (p < 0.10).mean(), np.median(p)]
        print(f"{view:8} {len(p):7} " + " ".join(f"{each:8.3f}" for each in parts), flush=True)


if __name__ == "__main__":
    main()
