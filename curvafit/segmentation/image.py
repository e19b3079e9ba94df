"""The evidence of an image: log-odds of the inside by boosted trees, which learn from the volume's own known slices."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations_with_replacement, product
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import require
from curvafit.core.runtime import Progress, silent
from curvafit.priors import kernels
from curvafit.priors.grid import Grid
from curvafit.priors.kernels.threads import map_threads
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.uncertainty import entropy, fit_weights

#: Deviations of the Gaussians, in edges of a voxel, and the least one along an axis in its own voxels.
WIDTHS, LEAST = (0.7, 1.2, 2.0, 3.4, 5.6), 0.5
#: Deviation of a second Gaussian before derivatives are taken.
SMOOTH = 0.7
#: Most voxels that trees learn from; the number of trees, their learning rate and most leaves.
LEARNT, TREES, RATE, LEAVES = 200_000, 80, 0.15, 255
#: Voxels whose features are computed at once; most voxels of an image whose features are kept for the second reading.
HELD, KEPT = 4_000_000, 20_000_000
#: By less than this fraction voxels' edges differ where they are cubes.
CUBIC = 0.01


def read_image(values: np.ndarray, slices: Slices, progress: Progress = silent) -> tuple[np.ndarray, float]:
    """Return the log-odds of the inside by an image (Z, Y, X) whose known slices are given, float32 (Z, Y, X), 0 in the
    known slices; and the fraction of the entropy of held-out known slices that they explain. Raises ImportError without
    scikit-learn.

    Trees learn from the known slices which voxels are inside, by grey levels, slopes and Hessians at several widths.
    They first learn from every second known slice: the others calibrate the log-odds, and give the fraction. Where one
    half has no inside or no outside, log-odds stay as they are, and the fraction is NaN.
    """
    known, slope, constant, gain = slices.inside, 1.0, 0.0, math.nan
    progress("learning from the image", 0.0)
    levels = ((values - values.mean()) / max(float(values.std()), 1e-12)).astype(np.float32)
    compute_features = partial(_features, levels, slices.spacing)
    cached = list(compute_features()) if values.size <= KEPT else None
    blocks = cached or compute_features()
    features = np.concatenate([block[np.isin(rows, slices.places)] for rows, block in blocks])
    progress("learning from the image", 0.2)
    if all(half.any() and not half.all() for half in (known[::2], known[1::2])):
        slope, constant, gain = _hold_out(features, known)
    progress("learning from the image", 0.35)
    trees = _train_trees(features, known)
    evidence, asked = np.zeros(values.shape, dtype=np.float32), ~np.isin(np.arange(len(values)), slices.places)
    for rows, block in cached or compute_features():
        progress("reading the image", 0.6 + 0.4 * rows[0] / len(values))
        for row in rows[asked[rows]]:
            logits = trees.decision_function(block[row - rows[0]].reshape(-1, block.shape[-1]))
            evidence[row] = (slope * logits + constant).reshape(evidence[row].shape)
    progress("reading the image", 1.0)
    return evidence, gain


def _hold_out(features: np.ndarray, inside: np.ndarray) -> tuple[float, float, float]:
    """Train trees on every second known slice. Return the weight and the constant that calibrate their log-odds on the
    others, and the fraction of the entropy of those that they explain."""
    trees, truth = _train_trees(features[::2], inside[::2]), inside[1::2].ravel()
    logits = trees.decision_function(features[1::2].reshape(-1, features.shape[-1]))
    slope, constant = fit_weights(logits[:, None], truth)
    loss = float(np.logaddexp(0, np.where(truth, -1, 1) * (slope * logits + constant)).mean())
    return slope, constant, 1 - loss / float(entropy(truth.mean()))


def _train_trees(features: np.ndarray, inside: np.ndarray) -> Any:
    """Train a classifier of the inside (N, Y, X) by features (N, Y, X, F), on a sample of the voxels."""
    ensemble = require("sklearn.ensemble", "image", "reading an image")
    table, truth = features.reshape(-1, features.shape[-1]), inside.ravel()
    rows = np.random.default_rng(0).permutation(len(table))[:LEARNT]
    if len(np.unique(truth[rows])) == 1:  # a rare class is missing in the sample: take all of it
        rows = np.append(rows, np.flatnonzero(truth != truth[rows[0]]))
    options = {"max_iter": TREES, "learning_rate": RATE, "max_leaf_nodes": LEAVES, "l2_regularization": 1.0}
    return ensemble.HistGradientBoostingClassifier(**options, early_stopping=False, random_state=0).fit(
        table[rows], truth[rows]
    )


def _features(levels: np.ndarray, spacing: Sequence[float]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the indices (n,) of some slices at a time with their features (n, Y, X, F), float16: the level, and at each
    width the smoothed level, its slope, and the eigenvalues of its Hessian. Blocks are computed in parallel threads.

    Widths are lengths, as optics blur; and where voxels are not cubes they are also numbers of voxels, as people draw.
    """
    lengths = np.array(spacing) / min(spacing)
    metrics = [lengths] if np.ptp(lengths) < CUBIC else [lengths, np.ones(3)]
    # Gaussians are cut at 4 deviations, and each of two derivatives reads one more slice.
    halo, depth = int(4 * (max(WIDTHS) + SMOOTH)) + 4, len(levels)
    thickness = max(1, HELD // levels[0].size)

    def compute_block(start: int) -> tuple[np.ndarray, np.ndarray]:
        rows, low = np.arange(start, min(start + thickness, depth)), max(start - halo, 0)
        slab = levels[low : rows[-1] + halo + 1]
        inner, features = slice(rows[0] - low, rows[-1] - low + 1), [levels[rows].astype(np.float16)]
        for edges, width in product(metrics, WIDTHS):
            features += [values.astype(np.float16) for values in _describe_at(slab, inner, edges, width)]
        return rows, np.stack(features, axis=-1)

    starts, count = range(0, depth, thickness), torch.get_num_threads()
    for k in range(0, len(starts), count):  # all at once would compute all blocks ahead, and hold them
        yield from map_threads(compute_block, starts[k : k + count])


def _describe_at(levels: np.ndarray, inner: slice, edges: np.ndarray, width: float) -> Iterator[np.ndarray]:
    """Yield levels smoothed by a Gaussian, their slope, and the eigenvalues of their Hessian, of the slices `inner`."""
    smooth = _blur(levels, np.maximum(width / edges, LEAST))
    yield smooth[inner]
    near = slice(max(inner.start - 2, 0), inner.stop + 2)
    gradient = np.gradient(_blur(smooth, np.maximum(SMOOTH / edges, LEAST))[near], *edges)
    pairs = combinations_with_replacement(range(3), 2)
    hessian = [np.gradient(gradient[i], edges[j], axis=j) for i, j in pairs]
    for values in (np.sqrt(sum(component**2 for component in gradient)), *_eigenvalues(*hessian)):
        yield values[inner.start - near.start : inner.stop - near.start]


def _blur(values: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Blur by a Gaussian of a deviation along each axis (3,), in voxels; beyond the image its border's values go on."""
    reach = np.ceil(4 * deviations).astype(int).tolist()
    padded = np.pad(values, [(n, n) for n in reach], mode="edge")
    blurred = kernels.gaussian_blur(torch.from_numpy(padded), Grid(padded.shape, tuple(1 / deviations)), 1.0).numpy()
    return blurred[tuple(slice(n, -n) for n in reach)]


def _eigenvalues(
    zz: np.ndarray, zy: np.ndarray, zx: np.ndarray, yy: np.ndarray, yx: np.ndarray, xx: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the eigenvalues of symmetric 3 × 3 matrices, the greatest first, by the trigonometric solution of the
    cubic: ten times as fast as LAPACK, and as exact as features of 16 bits need."""
    mean = (zz + yy + xx) / 3
    a, b, c = zz - mean, yy - mean, xx - mean
    scale = np.sqrt((a * a + b * b + c * c + 2 * (zy * zy + zx * zx + yx * yx)) / 6)
    determinant = a * (b * c - yx * yx) - zy * (zy * c - yx * zx) + zx * (zy * yx - b * zx)
    angle = np.arccos(np.clip(determinant / (2 * np.maximum(scale, 1e-12) ** 3), -1, 1)) / 3
    most, least = mean + 2 * scale * np.cos(angle), mean + 2 * scale * np.cos(angle + 2 * math.pi / 3)
    return most, 3 * mean - most - least, least
