"""How far apart two laws must be before windows of 64³ tell their textures apart.

From each law (eight presets, and random ones of `completion`) a step is made in a random direction of the box, of so
many deviations (root mean square over the six parameters). Of each end shapes of 64³ are grown by `deep`, each from a
seed of its own, and read as masks. `d2` is the squared distance of their means in the emulator's uncorrelated
directions, each in the deviation between seeds, without the seeds' own share (the product of different pairs). A
likelihood names a window rightly with probability Φ(√d2 / 2), and n windows of one law with Φ(√(n d2) / 2); `named` is
measured: the part of shapes of either end that are named rightly by the means of three others of each.

`resolution.windows_n` is the distance at which n windows are named rightly 19 times of 20, from the medians of d2.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import numpy as np
from scipy import stats

from benchmarks.closure import ENDS, PRIOR
from benchmarks.completion import DRAWN, LAWS
from benchmarks.harness import RESULTS, Cases, Figure, Values, show
from benchmarks.reading import law_of
from curvafit.generation.flow import generate
from curvafit.generation.result import is_well_formed
from curvafit.inference.emulator import Emulator
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import law_of as coefficients_of
from examples.train import decorrelate, load_table, measure_view

SEED, EDGE, SHAPES, VIEW = 70, 64, 4, "mask"
STEPS = (0.05, 0.1, 0.2)
WINDOWS, RIGHT = (1, 8, 64), 0.95


def spread_of_seeds(emulator: Emulator) -> np.ndarray:
    """Return the deviation `(k,)` between shapes of one law in each uncorrelated direction, from the table."""
    table = load_table(RESULTS / "table.npz").visible.select_views([VIEW])
    _, law, count = np.unique(table.parameters, axis=0, return_inverse=True, return_counts=True)
    rows, law = decorrelate(emulator, table.descriptors), law.ravel()
    means = np.stack([np.bincount(law, column) / count for column in rows.T], axis=1)
    return np.sqrt(np.square(rows - means[law]).sum(0) / (count - 1).sum())


def step_from(name: str, length: float) -> np.ndarray:
    """Return the parameters `(6,)` at a distance from a law, in its random direction, within the box."""
    here, random = law_of(name)[0], np.random.default_rng([SEED, *name.encode()])
    low, high = ENDS.T
    while True:
        way = random.standard_normal(6)
        way *= np.sqrt(6) / np.linalg.norm(way) * PRIOR
        furthest = here + max(STEPS) * way
        if ((low <= furthest) & (furthest <= high)).all():
            return here + length * way


def grow(name: str, length: float) -> np.ndarray:
    """Return the descriptors of shapes `(n, 351)`, SHAPES of them if so many of twice as many are well formed."""
    parameters, rows = step_from(name, length), list[np.ndarray]()
    for number in range(2 * SHAPES):
        if len(rows) == SHAPES:
            break
        seed = int(np.random.default_rng([SEED, *name.encode(), round(1000 * length), number]).integers(2**31))
        flow = generate(*coefficients_of(parameters), EDGE, schedule="deep", seed=seed, reject_early=True)
        if is_well_formed(flow.viability):
            row, _ = measure_view(flow.field.numpy(), VIEW, seed)
            rows += [] if np.isnan(row).any() else [row]
    return np.reshape(rows, (-1, 351))


def pair(name: str, length: float, cases: Cases) -> Values:
    """Return how well shapes of a law and of one at a distance are told apart."""
    emulator = load_posterior().emulator
    spread = spread_of_seeds(emulator)
    first, second = (
        decorrelate(emulator, cases.array(f"{name}-{step}", partial(grow, name, step))) / spread for step in (0, length)
    )
    if min(len(first), len(second)) < SHAPES:
        return {"grown": [len(first), len(second)]}
    away = first - second
    distance = (np.square(away.sum(0)).sum() - np.square(away).sum()) / (SHAPES * (SHAPES - 1))
    right = []
    for k in range(SHAPES):
        a, b = (np.delete(each, k, axis=0).mean(0) for each in (first, second))
        right += [bool((shape - (a + b) / 2) @ (a - b) * side > 0) for shape, side in ((first[k], 1), (second[k], -1))]
    return {"d2": round(float(distance), 2), "named": float(np.mean(right))}


def resolve(lengths: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Return the distance at which so many windows are named rightly, from d2 `(laws, steps)`: of laws so close, means
    grow apart in proportion."""
    slope = np.exp(np.mean(np.log(np.maximum(np.median(distances, 0), 1e-3)) - 2 * np.log(lengths)))
    return np.sqrt(4 * stats.norm.ppf(RIGHT) ** 2 / np.array(WINDOWS) / slope)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--share", default="0/1", help="of the laws, for several processes")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    share, shares = map(int, options.share.split("/"))
    laws = (*LAWS, *DRAWN)[: 1 if options.quick else None][share::shares]
    names = {(law, step): f"{law}-{step}" for law, step in product(laws, STEPS)}
    found = cases.all({name: partial(pair, *key, cases) for key, name in names.items()}, SEED)
    if options.quick or shares > 1:
        return {}
    whole = [law for law in laws if all("d2" in found.get(names[law, step], {}) for step in STEPS)]
    rows = np.array([[[found[names[law, step]][key] for step in STEPS] for law in whole] for key in ("d2", "named")])
    random, figures = np.random.default_rng(0), dict[str, Figure]()
    drawn = random.integers(len(whole), size=(2000, len(whole)))
    steps = np.array(STEPS)
    low, high = np.quantile([resolve(steps, rows[0][each]) for each in drawn], (0.025, 0.975), axis=0)
    for name, *each in zip([f"windows_{n}" for n in WINDOWS], resolve(steps, rows[0]), low, high, strict=True):
        figures[f"resolution.{name}"] = Figure(*map(float, each))
    for key, values, middle in (("d2", rows[0], np.median), ("named", rows[1], np.mean)):
        ends = np.quantile([middle(values[each], axis=0) for each in drawn], (0.025, 0.975), axis=0)
        for step, *each in zip(STEPS, middle(values, axis=0), *ends, strict=True):
            figures[f"resolution.{round(100 * step):02d}.{key}"] = Figure(*map(float, each))
    show(["", ""], list(figures.items()), f"{len(whole)} laws")
    return figures
