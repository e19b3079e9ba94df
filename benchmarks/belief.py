"""The test of a law: how often it rejects shapes of the model, and how often what only looks like them.

Shapes of stores (`--shapes STORE…`), laws that no choice has seen, as masks cut open, go through the whole of `infer`,
which tests the law that it found itself. So do their level cuts: cuts of a Gaussian field with the same volume
fraction and two-point function, which no law made. The p of each is the rank of its departure (`Misfit.departure`)
among those of the shapes in three quarters of the laws, of which its own is none. `size` is the part of shapes with p
at most .05, `power` the part of level cuts. `--calibrate FILE` writes the packaged posterior with the departures of
all shapes, by which `infer` ranks a scan's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.harness import Cases, Figure, Values, show
from benchmarks.nulls import level_cut
from curvafit.data_synth.store import Store, find_well_formed
from curvafit.inference.estimate import tail_probability
from curvafit.inference.infer import infer
from curvafit.inference.posterior import load_posterior, save_posterior
from curvafit.priors.grid import Grid
from curvafit.volumes.field import Field

LEVEL = 0.05
#: Parts of the laws, each of which is ranked among the others.
PARTS = 4


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
    parser.add_argument("--calibrate", type=Path, help="write the packaged posterior with the departures found")


def rank(found: dict[str, dict[int, float]]) -> dict[str, np.ndarray]:
    """Return p by kind, of departures by kind and number of the law."""
    laws = sorted(found["shape"].keys() | found["cut"].keys())
    part = {law: k % PARTS for k, law in enumerate(laws)}
    others = [np.array([d for law, d in found["shape"].items() if part[law] != k]) for k in range(PARTS)]
    return {
        kind: np.array([tail_probability(others[part[law]], d) for law, d in departures.items()])
        for kind, departures in found.items()
    }


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.quick and options.calibrate is not None:
        raise SystemExit("--quick makes two shapes only: no test is calibrated by them")
    found: dict[str, dict[int, float]] = {"shape": {}, "cut": {}}
    edge = 0
    for number, (store, index) in enumerate(
        find_well_formed(tuple(options.shapes))[: 2 if options.quick else options.count]
    ):
        edge = store.settings.shape[0]
        for kind, departures in found.items():
            name = f"{edge}-{store.name}-{index}-{kind}"
            for values in cases.all({name: partial(case, store, index, kind == "cut")}, seed=index).values():
                if "departure" in values:
                    departures[number] = values["departure"]
    figures, rows = {}, []
    for (kind, p), title in zip(rank(found).items(), ("size", "power"), strict=True):
        hits = int(np.sum(p <= LEVEL))
        interval = stats.binomtest(hits, len(p)).proportion_ci(method="wilson") if len(p) else (np.nan, np.nan)
        figures[f"belief.{edge}.{title}"] = Figure(hits / max(len(p), 1), *map(float, interval))
        middle = np.median([*found[kind].values()]) if len(p) else np.nan
        rows.append([title, figures[f"belief.{edge}.{title}"], len(p), float(middle)])
    show(["", f"p at most {LEVEL}", "queries", "median departure"], rows, f"{edge} voxels a side")
    if options.calibrate is not None:
        departures = np.sort(np.array([*found["shape"].values()], dtype=np.float32))
        save_posterior(replace(load_posterior(), departures=departures), options.calibrate)
    return {} if options.quick else figures
