"""What an image says of a volume: boosted trees on its grey levels, learnt from the volume's own known slices."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from curvafit.core.checks import require
from curvafit.core.runtime import Progress, silent
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.uncertainty import entropy, fit_weights

#: Widths of the Gaussians in voxels of the shortest edge, and the least one along an axis in its own voxels. Along a
#: longer edge they shrink by its root: optics ask for its ratio, and outlines that are drawn voxel by voxel for none.
WIDTHS, LEAST = (0.7, 1.2, 2.0, 3.4, 5.6), 0.5
#: Width of a second Gaussian before derivatives are taken.
SMOOTH = 0.7
#: Most voxels that trees learn from, trees, their rate and leaves.
LEARNT, TREES, RATE, LEAVES = 200_000, 120, 0.1, 31
#: Furthest shift of an image that is looked for, in voxels, and the width of the mean that its levels are taken from;
#: the least shift that is told, by what part the image must fit the slices better there, and how many times better than
#: anywhere (root mean square).
FURTHEST, LOCAL, NEAREST, BETTER, CLEAR = 12, 61, 2, 0.1, 5.0
#: Voxels whose features are computed at once, and most of which they are kept for the second reading.
HELD, KEPT = 4_000_000, 20_000_000


def read_image(values: np.ndarray, slices: Slices, progress: Progress = silent) -> tuple[np.ndarray, float]:
    """Return what an image (Z, Y, X) says of a volume of which some slices are known: log-odds, float32 (Z, Y, X), and
    the share of the entropy of slices held out that it takes away.

    Trees learn, from the known slices, which levels are inside, by the slopes and Hessians about them at several
    widths. First they learn from every second slice, and the others say how sure they may be, if both have an inside;
    else the share is NaN.

    Raises ImportError where scikit-learn is not installed.
    """
    known, slope, shift, gain = slices.inside, 1.0, 0.0, math.nan
    progress("learning from the image", 0.0)
    levels = ((values - values.mean()) / max(float(values.std()), 1e-12)).astype(np.float32)
    describe = partial(_features, levels, slices.spacing)
    kept = list(describe()) if values.size <= KEPT else None
    features = np.concatenate([part[np.isin(rows, slices.places)] for rows, part in kept or describe()])
    progress("learning from the image", 0.2)
    if all(half.any() and not half.all() for half in (known[::2], known[1::2])):
        trees = _learn(features[::2], known[::2])
        logits = trees.decision_function(features[1::2].reshape(-1, features.shape[-1]))
        truth = known[1::2].ravel()
        slope, shift = fit_weights(logits[:, None], truth)
        loss = float(np.logaddexp(0, np.where(truth, -1, 1) * (slope * logits + shift)).mean())
        gain = 1 - loss / float(entropy(truth.mean()))
    progress("learning from the image", 0.35)
    trees = _learn(features, known)
    evidence = np.empty(values.shape, dtype=np.float32)
    for rows, part in kept or describe():
        progress("reading the image", 0.6 + 0.4 * rows[0] / len(values))
        for row, plane in zip(rows, part, strict=True):
            logits = trees.decision_function(plane.reshape(-1, plane.shape[-1]))
            evidence[row] = (slope * logits + shift).reshape(plane.shape[:2])
    progress("reading the image", 1.0)
    return evidence, gain


def find_shift(values: np.ndarray, slices: Slices) -> tuple[int, int]:
    """Return by how many voxels (y, x) an image (Z, Y, X) lies off the known slices; (0, 0) where it lies on them.

    The correlation of slices with grey levels, whichever of the two is brighter, is greatest at the shift.
    """
    correlation = np.zeros(slices.inside.shape[1:])
    for place, inside in zip(slices.places, slices.inside, strict=True):
        plane = values[place].astype(np.float64)
        plane -= ndimage.uniform_filter(plane, LOCAL, mode="nearest")
        mask, grey = np.fft.rfft2(inside - inside.mean()), np.fft.rfft2(plane / max(plane.std(), 1e-12))
        correlation += np.fft.irfft2(mask.conj() * grey, correlation.shape)
    reach = [min(FURTHEST, n // 4) for n in correlation.shape]
    around = np.abs(np.roll(correlation, reach, (0, 1))[: 2 * reach[0] + 1, : 2 * reach[1] + 1])
    y, x = (int(k) - r for k, r in zip(np.unravel_index(around.argmax(), around.shape), reach, strict=True))
    threshold = max((1 + BETTER) * around[reach[0], reach[1]], CLEAR * float(np.sqrt(np.square(correlation).mean())))
    return (y, x) if max(abs(y), abs(x)) >= NEAREST and around.max() > threshold else (0, 0)


def _learn(features: np.ndarray, inside: np.ndarray) -> Any:
    """Return trees that tell the inside by features (N, Y, X, F)."""
    ensemble = require("sklearn.ensemble", "image", "reading an image")
    table, truth = features.reshape(-1, features.shape[-1]), inside.ravel()
    rows = np.random.default_rng(0).permutation(len(table))[:LEARNT]
    if len(np.unique(truth[rows])) == 1:
        rows = np.append(rows, np.flatnonzero(truth != truth[rows[0]]))
    options = {"max_iter": TREES, "learning_rate": RATE, "max_leaf_nodes": LEAVES, "l2_regularization": 1.0}
    return ensemble.HistGradientBoostingClassifier(**options, early_stopping=False, random_state=0).fit(
        table[rows], truth[rows]
    )


def _features(levels: np.ndarray, spacing: Sequence[float]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield numbers of slices and their features (n, Y, X, F), float16: smoothed levels, their slopes, and the
    eigenvalues of their Hessians; as many slices at once as may be held, by as many threads as torch has."""
    edges = [math.sqrt(edge / min(spacing)) for edge in spacing]
    halo, depth = int(4 * (max(WIDTHS) + SMOOTH) / edges[0]) + 3, len(levels)
    most = max(1, HELD // levels[0].size)
    pairs = list(combinations_with_replacement(range(3), 2))

    def blur(values: np.ndarray, width: float) -> np.ndarray:
        deviations = [max(width / edge, LEAST) for edge in edges]
        return ndimage.gaussian_filter(values, deviations, mode="nearest")

    def describe(start: int) -> tuple[np.ndarray, np.ndarray]:
        rows, low = np.arange(start, min(start + most, depth)), max(start - halo, 0)
        slab, found = levels[low : rows[-1] + halo + 1], []
        for width in WIDTHS:
            smooth = blur(slab, width)
            slopes = np.gradient(blur(smooth, SMOOTH), *edges)
            curved = [np.gradient(slopes[i], edges[j], axis=j) for i, j in pairs]
            each = [smooth, np.sqrt(sum(slope**2 for slope in slopes)), *_eigenvalues(*curved)]
            found += [values[rows - low].astype(np.float16) for values in each]
        return rows, np.stack(found, axis=-1)

    starts, crew = range(0, depth, most), torch.get_num_threads()
    with ThreadPoolExecutor(crew) as threads:
        for k in range(0, len(starts), crew):
            yield from threads.map(describe, starts[k : k + crew])


def _eigenvalues(
    zz: np.ndarray, zy: np.ndarray, zx: np.ndarray, yy: np.ndarray, yx: np.ndarray, xx: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the eigenvalues of symmetric 3 × 3 matrices, the greatest first, by the cosines that solve their cubic.
    Ten times as fast as LAPACK, and as exact as features of 16 bits need."""
    mean = (zz + yy + xx) / 3
    a, b, c = zz - mean, yy - mean, xx - mean
    scale = np.sqrt((a * a + b * b + c * c + 2 * (zy * zy + zx * zx + yx * yx)) / 6)
    determinant = a * (b * c - yx * yx) - zy * (zy * c - yx * zx) + zx * (zy * yx - b * zx)
    angle = np.arccos(np.clip(determinant / (2 * np.maximum(scale, 1e-12) ** 3), -1, 1)) / 3
    most, least = mean + 2 * scale * np.cos(angle), mean + 2 * scale * np.cos(angle + 2 * math.pi / 3)
    return most, 3 * mean - most - least, least
