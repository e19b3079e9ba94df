"""Does a series of shapes come back? A path between two laws, grown step by step, and its steps put in another order.

The coefficients and the mass go from `sponge` to `tubes` in five steps. Two shapes of each, of different noise, are
measured: the first make the series; how many numbers of the second differ from them by less than the interval of a
change says how often that interval holds.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.generation.flow import generate
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset
from curvafit.studies.trajectory import trajectory

#: Ends of the path, its steps, voxels along an edge, and an order of the steps that does not go with time.
ENDS, STEPS, EDGE, OTHER = ("sponge", "tubes"), 5, 64, (2, 0, 4, 1, 3)


def step(k: int, seed: int, cases: Cases) -> np.ndarray:
    """Return a mask of the path's law number k, grown once."""

    def grow() -> np.ndarray:
        a, b = (np.array([*law.coefficients, law.mass], dtype=float) for law in map(preset, ENDS))
        *numbers, mass = a + (b - a) * k / (STEPS - 1)
        flow = generate(Coefficients(*numbers), float(mass), grid=EDGE, schedule="fast", seed=seed)
        return np.packbits(flow.field.numpy() > 0)

    packed = cases.array(f"step-{k}-{seed}", grow)
    return np.unpackbits(packed).reshape((EDGE,) * 3)


def case(seed: int, cases: Cases) -> Values:
    series, again = ([step(k, 10 * own + k, cases) for k in range(STEPS)] for own in (2 * seed, 2 * seed + 1))
    found = trajectory(series, kind="mask", periodic=True)
    twins = [trajectory(pair, kind="mask", periodic=True).changes for pair in zip(found.measures, again, strict=True)]
    other = trajectory([found.measures[k] for k in OTHER])
    known = [each for changes in twins for each in changes if np.isfinite(each.half)]
    return {
        "p": found.p,
        "order": float((np.diff(found.distances) > 0).mean()),
        "moves": sum(each.moves for each in found.changes),
        "other_p": other.p,
        "other_moves": sum(each.moves for each in other.changes),
        "held": 1 - sum(each.significant for each in known) / max(len(known), 1),
        "known": len(known),
    }


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=1, help="paths, each of other noise")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    found = cases.all({f"path-{seed}": partial(case, seed, cases) for seed in range(options.seeds)})
    figures = {
        f"trajectory.path.{name}": Figure(float(np.mean([row[name] for row in found.values()])))
        for name in ("p", "order", "moves", "other_p", "other_moves", "held")
    }
    show(["path", "mean"], list(figures.items()), f"{len(found)} paths of {STEPS} steps")
    return figures
