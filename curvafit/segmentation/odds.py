"""How likely a voxel between two known slices is inside by its distances from their outlines, counted on an example."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.segmentation.slices import Slices

__all__ = ["Odds"]

#: Signed distances from an outline at which a bin begins, in voxels: structures are some voxels thick.
EDGES = np.array([-22, -17, -13, -10, -8, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22])
#: Deviation by which counts are shared among bins, and voxels that each bin has besides, of the example's share inside.
SHARED, BESIDES = 0.7, 1.0


@dataclass(frozen=True, eq=False)
class Odds:
    """Voxels of an example by their signed distances within the plane from the outlines in the two known slices.

    Attributes
    ----------
    counts
        Voxels inside, and all voxels, of the example's two halves along its last axis: (half, distance from the nearer
        slice in slices, bin of the distance from its outline, bin of that of the other slice's, 2).
    """

    counts: np.ndarray

    @classmethod
    def of(cls, slices: Slices, truth: np.ndarray, places: Sequence[int]) -> Odds:
        """Count the voxels of an example between its known slices.

        Parameters
        ----------
        truth
            Other masks, bool (N, Y, X).
        places
            Their numbers in the volume.
        """
        shape = (2, slices.gap // 2 + 1, len(EDGES) + 1, len(EDGES) + 1)
        bins = (np.broadcast_to(_half(truth.shape), truth.shape), *(each[list(places)] for each in _bins(slices)))
        numbers, size = np.ravel_multi_index(bins, shape), int(np.prod(shape))
        both = [np.bincount(each.ravel(), minlength=size) for each in (numbers[truth], numbers)]
        return cls(np.stack(both, axis=-1).reshape(*shape, 2).astype(np.float64))

    def level(self, slices: Slices, *, crossed: bool = False) -> np.ndarray:
        """Return log odds of the inside, float32 (length, Y, X), above those at which the example's Dice is best.

        A nat counts for a voxel's edge. In the known slices, before the first and beyond the last it is the signed
        distance from the outline in the nearest.

        Parameters
        ----------
        crossed
            The slices are the example's own: each half of it is judged by the counts of the other.
        """
        away, near, far = _bins(slices)
        away = np.minimum(away, self.counts.shape[1] - 1)
        if crossed:
            odds = np.stack([_log_odds(half) for half in self.counts[::-1]])[_half(near.shape), away, near, far]
        else:
            odds = _log_odds(self.counts.sum(0))[away, near, far]
        between = slices.between[:, None, None]
        return np.where(between, odds * min(slices.spacing[1:]), slices.level("nearest")).astype(np.float32)


def _half(shape: tuple[int, ...]) -> np.ndarray:
    """Return the half of each voxel along the last axis, 0 or 1."""
    return np.arange(shape[-1]) * 2 // shape[-1]


def _bins(slices: Slices) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each voxel's distance from the nearer known slice, and the bins of the distances from both outlines."""
    away, near, far = slices.neighbours
    bins = np.digitize(slices.distances(np.inf) / min(slices.spacing[1:]), EDGES)
    return np.broadcast_to(away[:, None, None], (slices.length, *bins.shape[1:])), bins[near], bins[far]


def _log_odds(counts: np.ndarray) -> np.ndarray:
    """Return each bin's log odds of the inside, above those at which the Dice of the bins above them is best."""
    inside, voxels = np.moveaxis(counts, -1, 0)
    share = (inside.sum() + 0.5) / (voxels.sum() + 1)
    smooth = [ndimage.gaussian_filter(each, (0, SHARED, SHARED)) for each in (inside, voxels)]
    likely = (smooth[0] + BESIDES * share) / (smooth[1] + BESIDES)
    odds = np.log(likely / (1 - likely))
    order = np.argsort(-likely, axis=None)
    both, predicted = (np.cumsum(each.ravel()[order]) for each in (inside, voxels))
    best = int(np.argmax(both / (predicted + inside.sum() + 0.5)))
    least = odds.ravel()[order][min(best + 1, len(order) - 1)]
    return odds - (odds.ravel()[order][best] + least) / 2
