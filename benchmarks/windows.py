"""What maps of windows say of volumes whose local size is known.

White noise, blurred by a Gaussian whose width is another in each slice, is cut at its 70 % quantile. The width is
the only length there: thickness goes with it, surface per volume and curvedness with its inverse. The width goes from
2.5 to 4.5 voxels along z. A window holds few periods: what R² lacks is mostly chance.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter

from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from curvafit.studies.windowed import windows

#: Voxels along z, y, x; the widths at both ends; windows; and seeds.
SHAPE, ENDS, SIZE, STRIDE, SEEDS = (128, 80, 80), (2.5, 4.5), 32, 16, 4
POWERS = {"thickness": 1, "spacing": 1, "surface density": -1, "curvedness": -1}


def textured(widths: np.ndarray, seed: int) -> np.ndarray:
    """Return a level set, uint8, whose Gaussian field has a width of its own in each slice."""
    noise, field = np.random.default_rng(seed).standard_normal(SHAPE), np.empty(SHAPE)
    for width in np.unique(widths):
        blurred = gaussian_filter(noise, width, mode="wrap")
        field[widths == width] = (blurred / blurred.std())[widths == width]
    return (field > np.quantile(field, 0.7)).astype(np.uint8)


def case(seed: int) -> Values:
    steps = np.linspace(*ENDS, 17)
    widths = steps[np.arange(SHAPE[0]) * len(steps) // SHAPE[0]]
    maps = windows(textured(widths, seed), SIZE, STRIDE, kind="mask")
    known = maps.known
    local = np.lib.stride_tricks.sliding_window_view(widths, SIZE)[::STRIDE]
    truth = np.broadcast_to(local.mean(1)[:, None, None], known.shape)
    return {
        name: float(np.corrcoef(truth[known] ** power, maps[name].values[known])[0, 1] ** 2)
        for name, power in POWERS.items()
    }


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    seeds = range(1 if options.quick else SEEDS)
    found = cases.all({f"graded-{seed}": partial(case, seed) for seed in seeds})
    figures = {}
    for name in POWERS:
        figures[f"windows.{name.replace(' ', '_')}"] = bootstrap([row[name] for row in found.values()], np.mean)
    show(["R² of the map with the truth", "mean"], list(figures.items()))
    return figures
