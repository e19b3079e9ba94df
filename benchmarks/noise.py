"""Masks from noise, on generated shapes of 64³: grey levels, and with `--on probabilities` a network's.

Grey levels 0 and 1 under Gaussian noise of so many contrasts. `start` is what `segment` starts from; `smoothing`, `TV`
and `walker` take the best setting *in hindsight*; `law` and `Willmore` are `segment`, blind, with the shape's own law
and without a prior. Its weight was chosen on tubes, sponge, trabec and pearls of seed 1, 48³. Probabilities are of
a random forest that learns from three slices of another seed's scan, made as sure as networks are. `half` is p > 1/2;
`fit` and `Willmore` are `segment`, whose law and weight an example (another seed) chooses.
"""

from __future__ import annotations

import argparse
import warnings
from functools import partial
from itertools import product

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.restoration import denoise_tv_chambolle
from skimage.segmentation import random_walker

from benchmarks.completion import EDGE, LAWS, fitted, shape
from benchmarks.harness import Cases, Figure, Values, best, bootstrap, scores, show
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.evidence import estimate_classes, grey_bounds, grey_evidence
from curvafit.segmentation.segmentation import segment
from curvafit.volumes.volume import Volume

#: Laws and ways of the grey levels (bilayers do not finish), and of the probabilities.
ALL = {"grey": LAWS[:7], "probabilities": ("tubes", "trabec", "sponge", "metatubes")}
RIVALS = ("smoothing", "TV", "walker")
WAYS = {"grey": ("start", *RIVALS, "Willmore", "law"), "probabilities": ("half", *RIVALS, "Willmore", "fit")}
#: Widths in voxels, weights in contrasts, and β among which hindsight chooses.
WIDTHS = {"grey": (1.0, 1.5, 2.0, 2.5, 3.0), "probabilities": (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)}
WEIGHTS = {"grey": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0), "probabilities": (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)}
BETAS = {"grey": (1, 130), "probabilities": (1, 10, 130, 1000)}
#: Of the forest's scans noise in contrasts and blur in voxels, widths of features and slices that it learns from; and
#: the distance of p from 0 and 1 that makes a seed of the random walker.
NOISE, BLUR, FEATURES, LEARNT, SURE = 2.5, 0.7, (0.7, 1.0, 1.6, 2.5, 4.0), (16, 32, 48), 0.1


def level_seeds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where smoothed levels are within a quarter of the bright mean, and of the dark one."""
    smooth = ndimage.gaussian_filter(values, 1.0)
    bright = smooth > threshold_otsu(smooth)
    low, high = float(smooth[~bright].mean()), float(smooth[bright].mean())
    return smooth > high - (high - low) / 4, smooth < low + (high - low) / 4


def walked(values: np.ndarray, inside: np.ndarray, outside: np.ndarray, beta: float) -> np.ndarray:
    """Return skimage's random walker's mask, from seeds inside and outside."""
    seeds = np.where(inside, 1, np.where(outside, 2, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of probabilities a little beyond [0, 1]
        return random_walker(values, seeds, beta=beta, mode="cg_j", tol=1e-3) == 1


def rival(way: str, kind: str, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mask of a rival, at its best setting in hindsight."""

    def split(smooth: np.ndarray) -> np.ndarray:
        return smooth > (threshold_otsu(smooth) if kind == "grey" else 0.5)

    if way == "smoothing":
        return best((split(ndimage.gaussian_filter(values, width)) for width in WIDTHS[kind]), truth)
    if way == "TV":
        return best((split(denoise_tv_chambolle(values, weight=weight)) for weight in WEIGHTS[kind]), truth)
    seeds = level_seeds(values) if kind == "grey" else (values > 1 - SURE, values < SURE)
    return best((walked(values, *seeds, beta) for beta in BETAS[kind]), truth)


def grey_case(way: str, law: str, seed: int, noise: float, cases: Cases) -> Values:
    truth, status = shape(law, seed, cases), ""
    values = (truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)).astype(np.float32)
    scan = Volume(values, (1.0, 1.0, 1.0))
    if way == "start":
        levels = values.clip(*grey_bounds(values))
        mask = grey_evidence(levels, scan, estimate_classes(levels, scan)).level > 0
    elif way in RIVALS:
        mask = rival(way, "grey", values, truth)
    else:
        found = segment(scan, law if way == "law" else None)
        mask, status = found.mask.values, found.status
    return {**scores(mask, truth), "status": status}


def features(law: str, seed: int, cases: Cases) -> np.ndarray:
    """Return smoothed levels, gradients and Laplacians of a shape's scan at each width, (voxels, features)."""
    clear = ndimage.gaussian_filter(shape(law, seed, cases).astype(np.float32), BLUR, mode="nearest")
    values = clear + NOISE * np.random.default_rng(1000 + seed).standard_normal(clear.shape).astype(np.float32)
    filters = (ndimage.gaussian_filter, ndimage.gaussian_gradient_magnitude, ndimage.gaussian_laplace)
    return np.stack([each(values, width).ravel() for width, each in product(FEATURES, filters)], axis=1)


def forest(law: str, seed: int, trained: int, cases: Cases) -> np.ndarray:
    """Return the forest's probabilities (Z, Y, X) for a seed's scan, learnt from another's."""
    from sklearn.ensemble import RandomForestClassifier

    def make() -> np.ndarray:
        known = np.zeros((EDGE,) * 3, dtype=bool)
        known[list(LEARNT)] = True
        trees = RandomForestClassifier(60, min_samples_leaf=3, random_state=0)
        trees.fit(features(law, trained, cases)[known.ravel()], shape(law, trained, cases)[known])
        p = np.asarray(trees.predict_proba(features(law, seed, cases)))[:, 1].reshape(known.shape)
        odds = (p / np.maximum(1 - p, 1e-6)).clip(1e-6, 1e6) ** 3  # as sure as networks are
        return (odds / (1 + odds)).astype(np.float16)

    return cases.array(f"p-{law}-{seed}-{trained}", make).astype(np.float32)


def probability_case(way: str, law: str, seed: int, _: float, cases: Cases) -> Values:
    """Return the scores of a way; the example has the next seed, and the network learns from the one after."""
    p, truth, status = forest(law, seed, seed + 2, cases), shape(law, seed, cases), ""
    if way == "half":
        mask = p > 0.5
    elif way in RIVALS:
        mask = rival(way, "probabilities", p, truth)
    else:
        prior = Coefficients.willmore() if way == "Willmore" else fitted(law, seed + 1, cases)
        example = (forest(law, seed + 1, seed + 2, cases), shape(law, seed + 1, cases).astype(np.uint8))
        found = segment(p, prior, probabilities=True, example=example)
        mask, status = found.mask.values, found.status
    return {**scores(mask, truth), "status": status}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--on", choices=tuple(WAYS), default="grey")
    parser.add_argument("--noise", default="1.5,3,4.5", help="of grey levels, in contrasts")
    parser.add_argument("--target", type=int, default=4, help="seed of the shapes; others' are next")
    parser.add_argument("--ways", default="", help="by default all")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    kind, seed = options.on, options.target
    ways = options.ways.split(",") if options.ways else list(WAYS[kind])
    laws, levels = ALL[kind], options.noise.split(",") if kind == "grey" else ["p"]
    if options.quick:
        laws, ways, levels = laws[:1], ways[:2], levels[:1]
    make, figures = grey_case if kind == "grey" else probability_case, {}
    for level in levels:
        noise = NOISE if level == "p" else float(level)
        jobs = {f"{way}-{law}-{seed}-{level}": partial(make, way, law, seed, noise, cases)
                for law, way in product(laws, ways)}  # fmt: skip
        found, rows = cases.all(jobs, seed), []
        for way in ways:
            mine = {law: found[name] for law in laws if (name := f"{way}-{law}-{seed}-{level}") in found}
            dice, betti = ([row[key] for row in mine.values()] for key in ("dice", "betti"))
            if len(mine) < len(laws):
                continue
            rows.append([way, float(np.mean(dice)), float(np.median(dice)), float(np.median(betti)), *dice])
            name = f"{way.lower()}.at_{level.replace('.', '_')}"
            figures |= {f"noise.{name}": bootstrap(dice, np.mean), f"noise_median.{name}": bootstrap(dice)}
            if level == "p":
                figures |= {f"probabilities.{way.lower()}.{law}": Figure(row["dice"]) for law, row in mine.items()}
                figures |= {f"probability_betti.{way.lower()}.{law}": Figure(row["betti"]) for law, row in mine.items()}
        show(["way", "mean", "median", "Betti", *laws], rows, f"{kind}, noise {level}, seed {seed}")
    return figures if seed == 4 else {}
