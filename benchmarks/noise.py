"""A mask from grey levels under noise: smoothing, TV, the random walker, and F_ε, on generated shapes.

A shape of 64³ has levels 0 and 1 and Gaussian noise of so many contrasts; its box is not told to repeat. The law is
inferred by `infer --fast` from the mask of another seed.

- `start`: smoothed by as much as the noise wants, Otsu's threshold: what `segment` starts from, blind.
- `smoothing`, `TV`: then Otsu's threshold; `walker`: the random walker; at the best width, weight or β *in hindsight*.
- `segment`: the inferred fit, law and weight and classes chosen blind. `Willmore`: the same with the Willmore energy
  in place of a fit, blind.
"""

from __future__ import annotations

import argparse
import warnings
from itertools import product

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.restoration import denoise_tv_chambolle
from skimage.segmentation import random_walker

from benchmarks.completion import LAWS, fitted, shape
from benchmarks.harness import Cases, Figure, Values, best, bootstrap, scores, show
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.evidence import estimate_classes, grey_evidence, grey_levels
from curvafit.segmentation.segment import segment
from curvafit.volumes.field import Field

WAYS = ("start", "smoothing", "TV", "walker", "Willmore", "segment")
#: Widths in voxels, weights in contrasts, and β among which hindsight chooses.
WIDTHS, WEIGHTS, BETAS = (1.0, 1.5, 2.0, 2.5, 3.0), (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0), (1, 130)


def grey(law: str, seed: int, noise: float, cases: Cases) -> tuple[np.ndarray, np.ndarray]:
    """Return a shape, and its grey levels."""
    truth = shape(law, seed, cases)
    values = truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)
    return truth, values.astype(np.float32)


def split(values: np.ndarray) -> np.ndarray:
    return values > threshold_otsu(values)


def level_seeds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where smoothed levels are within a quarter of the bright mean, and of the dark one."""
    smooth = ndimage.gaussian_filter(values, 1.0)
    bright = split(smooth)
    low, high = float(smooth[~bright].mean()), float(smooth[bright].mean())
    return smooth > high - (high - low) / 4, smooth < low + (high - low) / 4


def walked(values: np.ndarray, inside: np.ndarray, outside: np.ndarray, beta: float) -> np.ndarray:
    """Return skimage's random walker's mask, from seeds inside and outside."""
    seeds = np.where(inside, 1, np.where(outside, 2, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of probabilities a little beyond [0, 1]
        return random_walker(values, seeds, beta=beta, mode="cg_j", tol=1e-3) == 1


def case(way: str, law: str, seed: int, noise: float, cases: Cases) -> Values:
    """Return the scores of a way."""
    truth, values = grey(law, seed, noise, cases)
    status = ""
    if way == "start":
        scan = Field(values, (1.0, 1.0, 1.0))
        levels = grey_levels(scan)
        mask = grey_evidence(levels, scan, estimate_classes(levels, scan)).level > 0
    elif way == "smoothing":
        mask = best((split(ndimage.gaussian_filter(values, width)) for width in WIDTHS), truth)
    elif way == "TV":
        mask = best((split(denoise_tv_chambolle(values, weight=weight)) for weight in WEIGHTS), truth)
    elif way == "walker":
        mask = best((walked(values, *level_seeds(values), beta) for beta in BETAS), truth)
    else:
        prior = Coefficients.willmore() if way == "Willmore" else fitted(law, seed + 1, cases)
        found = segment(Field(values, (1.0, 1.0, 1.0)), prior)
        mask, status = found.mask.values > 0, found.status
    return {**scores(mask, truth), "status": status}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laws", default=",".join(LAWS))
    parser.add_argument("--noise", type=float, default=3, help="in contrasts")
    parser.add_argument("--target", type=int, default=4, help="seed of the shapes; the next one's masks tell the laws")
    parser.add_argument("--ways", default=",".join(WAYS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    laws, ways, seed, noise = options.laws.split(","), options.ways.split(","), options.target, options.noise
    if options.quick:
        laws, ways = laws[:1], ["start", "smoothing"]
    jobs = {
        f"{way}-{law}-{seed}-{noise:g}": lambda w=way, a=law: case(w, a, seed, noise, cases)
        for law, way in product(laws, ways)
    }
    found, rows, figures = cases.all(jobs, seed), [], {}
    for way in ways:
        mine = {law: found[name] for law in laws if (name := f"{way}-{law}-{seed}-{noise:g}") in found}
        if not mine:
            continue
        pairs = [
            (found[name]["dice"], row["dice"])
            for law, row in mine.items()
            if (name := f"segment-{law}-{seed}-{noise:g}") in found
        ]
        gain = bootstrap([100 * (a - b) for a, b in pairs]) if pairs and way != "segment" else None
        least = min((100 * (a - b) for a, b in pairs), default=0.0)
        dice, betti = (float(np.median([row[key] for row in mine.values()])) for key in ("dice", "betti"))
        rows.append([way, len(mine), dice, betti, gain or "", least if gain else ""])
        name = f"noise.{way.lower()}"
        figures |= {f"{name}.dice": bootstrap([row["dice"] for row in mine.values()]), f"{name}.betti": Figure(betti)}
        figures |= {f"{name}.gain": gain, f"{name}.least": Figure(least)} if gain else {}
    columns = ["way", "shapes", "Dice", "Betti", "segment's gain, points", "least"]
    show(columns, rows, f"noise of {noise:g} contrasts, seed {seed}")
    return figures if (noise, seed) == (3, 4) else {}
