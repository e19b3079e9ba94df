"""How many laws a posterior must be taught: errors on laws left out, by the number of laws that it learns from.

Of five folds of the laws of `results/table.npz` one is asked for, and of the others so many teach a posterior of one
flow with its emulator, as `curvafit atlas train` does, on masks and degraded scans. Errors are those of the medians of
its draws of one mask of each law that was left out, in deviations of the box, the mean over six parameters of the
medians over laws; `emulator` is the part of the variance of descriptors between laws that the emulator misses, over the
same laws. `learning.doubling` is what twice the laws take off the error, by a line through the four numbers of laws.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import numpy as np

from benchmarks.closure import PRIOR, TABLE
from benchmarks.harness import Cases, Figure, Values, show
from curvafit.inference.table import PARAMETERS, Table, load_table
from curvafit.inference.training import train_posterior

SEED, FOLDS, DRAWS, VIEW = 70, 5, 400, "mask"
COUNTS = (88, 177, 354, 708)
VIEWS = ("mask", "scan")


def split(table: Table, fold: int, count: int) -> tuple[Table, Table]:
    """Return rows of so many laws to learn from, and one mask of each law that is left out."""
    _, law = np.unique(table.parameters, axis=0, return_inverse=True)
    law, laws = law.ravel(), np.random.default_rng(SEED).permutation(law.max() + 1)
    asked = laws[fold::FOLDS]
    taught = np.setdiff1d(laws, asked, assume_unique=True)
    taught = np.random.default_rng([SEED, fold]).permutation(taught)[:count]
    seen = table.views == VIEW
    first = [np.flatnonzero((law == each) & seen)[:1] for each in asked]
    return table.rows(np.isin(law, taught)), table.rows(np.concatenate(first))


def learn(fold: int, count: int) -> Values:
    table = load_table(TABLE).visible.select_views(VIEWS)
    taught, asked = split(table, fold, count)
    posterior = train_posterior(taught, members=1, seed=fold)
    drawn = posterior.sample(asked.descriptors, asked.views, asked.amount, DRAWS)[..., : len(PARAMETERS)]
    least, median, most = np.quantile(drawn, (0.05, 0.5, 0.95), axis=1)
    emulator = posterior.emulator
    rows = emulator.decorrelate(asked.descriptors)
    emulated = emulator(asked.parameters, asked.views, asked.amount).mean @ emulator.basis.T
    missed = np.square(rows - emulated).sum() / np.square(rows - rows.mean(0)).sum()
    covered = (least <= asked.parameters) & (asked.parameters <= most)
    away = np.abs(median - asked.parameters) / PRIOR
    return {"error": np.median(away, 0).round(4).tolist(), "in90": round(float(covered.mean()), 3),
            "missed": round(float(missed), 4)}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folds", type=int, default=2, help="how many of five")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    counts = COUNTS[:1] if options.quick else COUNTS
    names = {(fold, count): f"{fold}-{count}" for fold, count in product(range(options.folds), counts)}
    found = cases.all({name: partial(learn, *key) for key, name in names.items()}, SEED)
    figures = dict[str, Figure]()
    for count in counts:
        rows = [found[names[fold, count]] for fold in range(options.folds) if names[fold, count] in found]
        for key in ("error", "in90", "missed") if rows else ():
            each = [float(np.mean(row[key])) for row in rows]
            figures[f"learning.{count}.{key}"] = Figure(float(np.mean(each)), min(each), max(each))
    errors = [figures[key].value for count in counts if (key := f"learning.{count}.error") in figures]
    if len(errors) == len(COUNTS):
        figures["learning.doubling"] = Figure(float(-np.polyfit(np.log2(COUNTS), errors, 1)[0]))
    show(["", ""], list(figures.items()), "intervals are the folds' least and most")
    return {} if options.quick else figures
