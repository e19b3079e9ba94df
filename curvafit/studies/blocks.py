"""Sums over the blocks of a volume, and the errors of what is computed from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

__all__ = ["LEAST", "Blocks", "errors"]

#: The fewest blocks, and the most along an axis; the length of a block in periods of the structure.
LEAST, MOST, PERIODS = 8, 6, 1.0
#: How sure intervals are.
SURE = 0.95


@dataclass(frozen=True)
class Blocks:
    """A division of a volume (Z, Y, X) into blocks: the first voxel of each along (z, y, x)."""

    shape: tuple[int, int, int]
    starts: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]

    @classmethod
    def of(cls, shape: Sequence[int], spacing: Sequence[float], period: float) -> Blocks:
        """Divide a volume into blocks of `PERIODS` periods of its structure, and at most `MOST` along an axis."""
        counts = [min(max(int(n * h / (PERIODS * period)), 1), MOST) for n, h in zip(shape, spacing, strict=True)]
        starts = [tuple(n * k // count for k in range(count)) for n, count in zip(shape, counts, strict=True)]
        return cls((shape[0], shape[1], shape[2]), (starts[0], starts[1], starts[2]))

    @property
    def counts(self) -> tuple[int, int, int]:
        """Return the number of blocks along each axis."""
        z, y, x = map(len, self.starts)
        return z, y, x

    @property
    def count(self) -> int:
        """Return the number of blocks."""
        return math.prod(self.counts)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of a volume (Z, Y, X) over each block, float64 (N,)."""
        kind = np.float64 if values.dtype.kind == "f" else np.int64
        for axis, starts in enumerate(self.starts):
            values = np.add.reduceat(values, starts, axis=axis, dtype=kind)
        return values.ravel().astype(np.float64)

    def gathered(self, places: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return sums over each block, (N, …), of weights (M, …) at places (M, 3) in voxels from the first centre."""
        numbers = np.zeros(len(places), dtype=np.int64)
        for axis, starts in enumerate(self.starts):
            voxels = np.clip(np.rint(places[:, axis]), 0, self.shape[axis] - 1)
            numbers = numbers * len(starts) + np.searchsorted(starts, voxels, side="right") - 1
        columns = weights.reshape(len(weights), -1)
        sums = [np.bincount(numbers, column, minlength=self.count) for column in columns.T]
        return np.stack(sums, axis=1).reshape(self.count, *weights.shape[1:])


def errors(sums: np.ndarray, blocks: Blocks, figures: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return half the width of the `SURE` interval of each figure, (K,), by a jackknife over neighbours that correlate.

    With ψ the change of a figure when a block is left out, the variance is ψᵀ W ψ: W has 1 on its diagonal, and ½ for
    each axis along which two blocks are neighbours (Bartlett's kernel, as Newey & West 1987 for series). Were blocks
    independent, ψᵀ W ψ would be σ² tr(P W P) / n², P taking the mean off: that sets its scale, and with tr² / tr(·²)
    the degrees of freedom of Student's t. A bootstrap over single blocks would take neighbours for independent.

    Parameters
    ----------
    sums
        Sums over each block, (N, C), of what is additive.
    figures
        Returns figures (…, K) of sums (…, C).
    """
    count = len(sums)
    kernel = np.ones((1, 1))
    for n in blocks.counts:
        kernel = np.kron(kernel, np.eye(n) + (np.eye(n, k=1) + np.eye(n, k=-1)) / 2)
    centred = np.eye(count) - 1 / count
    form = centred @ kernel @ centred
    freedom = np.trace(form) ** 2 / (form**2).sum()
    total = sums.sum(0)
    change = (figures(total) - figures(total - sums)) * (count - 1) / count
    variance = (change * (kernel @ change)).sum(0) * count / np.trace(form)
    return float(stats.t.ppf((1 + SURE) / 2, freedom)) * np.sqrt(np.maximum(variance, 0))
