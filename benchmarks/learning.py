"""How many laws a posterior must be taught: errors on laws left out, by the number of laws that it learns from.

Of five folds of the laws of `results/table.npz` one is asked for, and of the others so many teach a posterior of one
flow with its emulator, as `examples/train.py` does, on masks and degraded scans; beside the most of them all laws
of `teaching`, a shape each, teach `all`. Errors are those of the medians of
its draws of one mask of each law that was left out, in deviations of the box, the mean over six parameters of the
medians over laws; `emulator` is the part of the variance of descriptors between laws that the emulator misses, over the
same laws. `learning.doubling` is what twice the laws take off the error, by a line through the four numbers of laws.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import numpy as np

from benchmarks.closure import PRIOR
from benchmarks.harness import Cases, Figure, Values, show
from benchmarks.teaching import VIEWS, gather
from curvafit.inference.posterior import Architecture
from curvafit.inference.table import PARAMETERS
from examples.train import Table, decorrelate, train_posterior

SEED, FOLDS, DRAWS, VIEW = 70, 5, 400, "mask"
COUNTS: dict[str, int] = {"88": 88, "177": 177, "354": 354, "708": 708, "all": 708}
#: Of 64 components 88 laws are too few to learn.
SMALL = Architecture(components=32)


def split(table: Table, fold: int, name: str) -> tuple[Table, Table]:
    """Return rows of so many laws to learn from, and one mask of each law that is left out."""
    law, added = table.laws, np.char.startswith(table.shapes, "teaching/")
    laws = np.random.default_rng(SEED).permutation(np.unique(law[~added]))
    asked = laws[fold::FOLDS]
    taught = np.setdiff1d(laws, asked, assume_unique=True)
    taught = np.random.default_rng([SEED, fold]).permutation(taught)[: COUNTS[name]]
    seen = table.views == VIEW
    first = [np.flatnonzero((law == each) & seen)[:1] for each in asked]
    return table.rows(np.isin(law, taught) | (added & (name == "all"))), table.rows(np.concatenate(first))


def learn(fold: int, name: str) -> Values:
    taught, asked = split(gather().visible.select_views(VIEWS), fold, name)
    posterior = train_posterior(taught, SMALL, members=1, seed=fold)
    drawn = posterior.sample(asked.descriptors, asked.views, asked.amount, DRAWS)[..., : len(PARAMETERS)]
    least, median, most = np.quantile(drawn, (0.05, 0.5, 0.95), axis=1)
    emulator = posterior.emulator
    rows = decorrelate(emulator, asked.descriptors)
    emulated = emulator(asked.parameters, asked.views, asked.amount).mean @ emulator.basis.T
    missed = np.square(rows - emulated).sum() / np.square(rows - rows.mean(0)).sum()
    covered = (least <= asked.parameters) & (asked.parameters <= most)
    away = np.abs(median - asked.parameters) / PRIOR
    return {"error": np.median(away, 0).round(4).tolist(), "in90": round(float(covered.mean()), 3),
            "missed": round(float(missed), 4)}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folds", type=int, default=2, help="how many of five")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    counts = ["88"] if options.quick else [*COUNTS]
    names = {(fold, count): f"{fold}-{count}" for fold, count in product(range(options.folds), counts)}
    found = cases.all({name: partial(learn, *key) for key, name in names.items()}, SEED)
    figures = dict[str, Figure]()
    for count in counts:
        rows = [found[names[fold, count]] for fold in range(options.folds) if names[fold, count] in found]
        for key in ("error", "in90", "missed") if rows else ():
            each = [float(np.mean(row[key])) for row in rows]
            figures[f"learning.{count}.{key}"] = Figure(float(np.mean(each)), min(each), max(each))
    numbers = [name for name in COUNTS if name != "all"]
    errors = [figures[key].value for name in numbers if (key := f"learning.{name}.error") in figures]
    if len(errors) == len(numbers):
        slope = np.polyfit(np.log2([COUNTS[name] for name in numbers]), errors, 1)[0]
        figures["learning.doubling"] = Figure(float(-slope))
    show(["", ""], list(figures.items()), "intervals are the folds' least and most")
    return {} if options.quick else figures
