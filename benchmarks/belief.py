"""The test of a law: how often it rejects shapes of the model, and how often what only looks like them.

Shapes of stores (`--shapes STORE…`), laws that no choice has seen, as masks cut open, go through the whole of `infer`:
its p is of the law that it found itself. So do their level cuts: cuts of a Gaussian field with the same volume
fraction and two-point function, which no law made. `size` is the part of shapes with p at most .05, `power` the part
of level cuts.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.harness import Cases, Figure, Values, show
from benchmarks.nulls import level_cut
from curvafit.data_synth.store import Store, find_well_formed
from curvafit.inference.infer import infer
from curvafit.priors.grid import Grid
from curvafit.volumes.field import Field

LEVEL = 0.05


def case(store: Store, index: int, cut: bool) -> Values:
    """Return p, of all descriptors and by block, the departure and the verdict of a shape or of its level cut."""
    mask, random = store.field(index) > 0, np.random.default_rng(index)
    if cut:
        mask = level_cut(mask, Grid(mask.shape), index) > 0
    opened = np.roll(mask, random.integers(mask.shape[0], size=3), (0, 1, 2))
    fit = infer(Field(opened.astype(np.uint8)), kind="mask", seed=index).fit
    found: Values = {"status": fit.status.partition(":")[0]}
    if (misfit := fit.misfit) is not None:
        found |= {"p": misfit.probability, "departure": misfit.departure, **misfit.blocks}
    return found


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shapes", type=Path, nargs="+", required=True, help="stores of laws that no choice has seen")
    parser.add_argument("--count", type=int, default=100, help="shapes, and as many level cuts")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    found, edge = {}, 0
    for store, index in find_well_formed(tuple(options.shapes))[: 1 if options.quick else options.count]:
        edge = store.settings.shape[0]
        for cut in (False, True):
            name = f"{edge}-{store.name}-{index}-{'cut' if cut else 'shape'}"
            found |= cases.all({name: partial(case, store, index, cut)}, seed=index)
    figures, rows = {}, []
    for kind, title in (("shape", "size"), ("cut", "power")):
        p = [row["p"] for name, row in found.items() if name.endswith(kind) and "p" in row]
        hits = int(np.sum(np.array(p) <= LEVEL))
        interval = stats.binomtest(hits, len(p)).proportion_ci(method="wilson") if p else (np.nan, np.nan)
        figures[f"belief.{edge}.{title}"] = Figure(hits / max(len(p), 1), *map(float, interval))
        rows.append([title, figures[f"belief.{edge}.{title}"], len(p), float(np.median(p)) if p else ""])
    show(["", f"p at most {LEVEL}", "queries", "median p"], rows, f"{edge} voxels a side")
    return {} if options.quick else figures
