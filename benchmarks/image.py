"""The volume between annotated slices of a real image, every eighth known: the filler with the image, and its rival.

Needs $CURVAFIT_DATA, and scikit-learn. All ways know the same slices, and the image of the whole volume.

- `ours`: `reconstruct(image=…)`; `alone`: without the image; `trees`: its reading of the image, at the threshold of
  the greatest expected Dice.
- `forest`: a random forest on smoothed levels, edges and Hessian eigenvalues, as ilastik has them: of `FORESTS` and of
  thresholds the best in hindsight.

Dice counts unknown slices alone. Intervals: a jackknife over slabs between slices times 32² pixels. VesselExpress, the
membranes and Poon's first half chose features and trees, and shapes the mix; on the second half and bone none chose.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from benchmarks.completion import STRUCTURES, mask_of
from benchmarks.harness import Cases, Figure, Values, data, show
from curvafit.segmentation.image import read_image
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.trials import dice, dice_of, gain_of, tally
from curvafit.segmentation.uncertainty import best_log_odds, calibration_error, near_surface
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume

WAYS = ("ours", "alone", "trees", "forest")
EVERY = 8
#: The trees of a forest, the least samples of a leaf, and its widest Gaussian: a small one, and one of ilastik's size.
FORESTS = ((60, 3, 6.0), (100, 1, 10.0))
#: Thresholds of the forest.
THRESHOLDS = np.linspace(0.2, 0.6, 17)


class Scan(NamedTuple):
    """An image, the structure of `completion` that is its mask, a box of both, the axis across slices, the noise that
    is added, in contrasts, and the known slices if they are not every eighth."""

    image: str
    mask: str
    box: tuple[slice, slice, slice]
    axis: int = 0
    noise: float = 0.0
    reading: Mapping[str, Any] = {}
    known: tuple[int, ...] = ()


_ALL = (slice(None),) * 3
_BONE = ("lhdl_trabecular_200.tif", "bone", (slice(0, 97), slice(44, 156), slice(44, 156)))
_POON = "vesselNN/poon2015_BBB_noLeakage_img.tif"
SCANS = {
    "vesselexpress": Scan("vesselexpress_000.tif", "vesselexpress", _ALL),
    "vesselexpress-3": Scan("vesselexpress_000.tif", "vesselexpress", _ALL, known=(16, 50, 83)),
    "poon-0": Scan(_POON, "poon", (slice(None), slice(0, 249), slice(0, 240)), 1),
    "poon-1": Scan(_POON, "poon", (slice(None), slice(256, 505), slice(272, 512)), 1),
    "bone": Scan(*_BONE),
    "bone-noise-1": Scan(*_BONE, noise=1.0),
    "bone-noise-2": Scan(*_BONE, noise=2.0),
    "membranes": Scan("plantseg_sample_ovule.h5", "membranes", _ALL, 1, reading={"key": "raw"}),
}


def read(name: str) -> tuple[Volume, Volume]:
    """Return the image and the mask of a scan."""
    scan, structure = SCANS[name], STRUCTURES[SCANS[name].mask]
    mask = mask_of(load(data("scans", structure.files[0]), **structure.reading), structure).crop(scan.box)
    grey = load(data("scans", scan.image), **scan.reading).crop(scan.box).values.astype(np.float32)
    inside = mask.values > 0
    contrast = abs(float(grey[inside].mean()) - float(grey[~inside].mean()))
    grey = grey + scan.noise * contrast * np.random.default_rng(0).standard_normal(grey.shape, dtype=np.float32)
    return Volume(grey, mask.spacing, mask.unit), mask


def forest(grey: np.ndarray, truth: np.ndarray, places: list[int], trees: int, leaf: int, widest: float) -> np.ndarray:
    """Return the probabilities of a random forest that learns from the known slices."""
    from skimage.feature import multiscale_basic_features
    from sklearn.ensemble import RandomForestClassifier

    features = multiscale_basic_features(grey, sigma_min=0.7, sigma_max=widest, workers=1)
    random = np.random.default_rng(0)
    table, inside = features[places].reshape(-1, features.shape[-1]), truth[places].ravel()
    rows = random.permutation(len(table))[:200_000]
    learner = RandomForestClassifier(trees, min_samples_leaf=leaf, n_jobs=-1, random_state=0)
    learner.fit(table[rows], inside[rows])
    return np.stack([learner.predict_proba(each.reshape(-1, each.shape[-1]))[:, 1] for each in features]).reshape(
        grey.shape
    )


def case(name: str, way: str) -> Values:
    """Return the scores of a way, and its counts in cells."""
    (image, mask), axis, known = read(name), SCANS[name].axis, SCANS[name].known
    begun, places = time.perf_counter(), list(known or range(0, mask.shape[axis], EVERY))
    grey, truth = (np.moveaxis(each.values, axis, 0) for each in (image, mask))
    truth, status = truth > 0, ""
    unknown = [n for n in range(len(truth) if known else places[-1]) if n not in places]
    if way in ("ours", "alone"):
        found = reconstruct(mask, known=places, axis=axis, image=image if way == "ours" else None)
        inside, likely = (np.moveaxis(each.values, axis, 0) for each in (found.mask, found.probability))
        inside, status = inside > 0, found.status
    elif way == "forest":
        forests = (forest(grey, truth, places, *settings) for settings in FORESTS)
        likely, least = max(
            product(forests, THRESHOLDS), key=lambda pair: dice(pair[0][unknown] > pair[1], truth[unknown])
        )
        inside = likely > least
    else:
        edges = (mask.spacing[axis], *(h for k, h in enumerate(mask.spacing) if k != axis))
        logits = read_image(grey, Slices(truth[places], tuple(places), len(truth), edges, mask.unit))[0]
        likely, inside = expit(logits), logits > best_log_odds(logits[unknown])
    counts, near = tally(inside[unknown], truth[unknown], [n // EVERY * 32 for n in unknown]), near_surface(inside)
    return {
        "dice": float(dice_of(counts.sum(0))),
        "seconds": time.perf_counter() - begun,
        "status": status,
        "calibration": calibration_error(likely[unknown][near[unknown]], truth[unknown][near[unknown]]),
        "counts": counts.tolist(),
    }


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names, ways = (["vesselexpress"], ("ours", "trees")) if options.quick else ([*SCANS], WAYS)
    jobs = {f"{name}-{way}": partial(case, name, way) for name, way in product(names, ways)}
    found, figures = cases.all(jobs), dict[str, Figure]()
    groups = {"poon": [name for name in names if name.startswith("poon")]} | {n: [n] for n in names if n[:4] != "poon"}
    for group, members in groups.items():
        if not members or any(f"{name}-{way}" not in found for name, way in product(members, ways)):
            continue
        counts = {way: np.concatenate([found[f"{name}-{way}"]["counts"] for name in members]) for way in ways}
        figures |= {f"image.{group}.{way}": Figure(float(dice_of(counts[way].sum(0)))) for way in ways}
        if "ours" in ways and "forest" in ways:
            gain, noise = (100 * each for each in gain_of(counts["ours"], counts["forest"]))
            figures[f"image.{group}.gain"] = Figure(gain, gain - 1.96 * noise, gain + 1.96 * noise)
            errors = [found[f"{name}-ours"]["calibration"] for name in members]
            figures[f"image.{group}.calibration"] = Figure(float(np.mean(errors)))
    show(["scan", "figure"], list(figures.items()), f"every {EVERY}")
    return figures
