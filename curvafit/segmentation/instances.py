"""Instances: labels of one kind, such as cells, which an image tells from the background but not from each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from skimage import measure

#: Share of a label's area that is in one piece in each slice, share of labels of which that holds, and greatest share
#: of the variance of grey levels that is due to which label they have, if labels are instances.
WHOLE, MOST, ALIKE = 0.9, 0.9, 0.5


def are_instances(labels: np.ndarray, levels: np.ndarray, count: int) -> bool:
    """Return whether labels from 1 to `count` in slices (N, Y, X) are instances, as they are drawn and by grey levels
    there: nine in ten are, but for a tenth of their area, one piece in each slice, and grey levels vary more within
    labels than between them."""
    own, grey = labels[labels > 0], levels[labels > 0].astype(np.float64)
    total, largest = np.bincount(own, minlength=count + 1), np.zeros(count + 1)
    for plane in labels:
        pieces = np.asarray(measure.label(plane, connectivity=2))
        owner = np.zeros(pieces.max() + 1, dtype=np.intp)
        owner[pieces] = plane
        best = np.zeros(count + 1)
        np.maximum.at(best, owner, np.bincount(pieces.ravel()))
        largest += best
    means = np.bincount(own, grey, minlength=count + 1) / np.maximum(total, 1)
    whole = (largest >= WHOLE * total)[1:].mean() >= MOST
    return bool(whole and means[own].var() <= ALIKE * grey.var())


def split_structure(mask: np.ndarray, labels: np.ndarray, known: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
    """Return labels of a structure's mask (Z, Y, X): each voxel has the nearest of the `labels` (Z, Y, X), which are 0
    where there is none, and those of `known` voxels stay.

    Each label is kept in one piece: of the pieces that it has, those without a known voxel go to the label that they
    touch most, or to the background.
    """
    near = ndimage.distance_transform_edt(labels == 0, spacing, return_distances=False, return_indices=True)
    found = np.where(known, labels, np.where(mask, labels[tuple(near)], 0))  # type: ignore[arg-type]
    pieces = np.asarray(measure.label(found, connectivity=3))
    owner, stays = np.zeros(pieces.max() + 1, dtype=found.dtype), np.zeros(pieces.max() + 1, dtype=bool)
    owner[pieces], stays[pieces[known]], stays[0] = found, True, True
    row = np.cumsum(~stays) - 1
    touched = np.zeros((np.count_nonzero(~stays), int(labels.max()) + 1), dtype=np.intp)
    for axis in range(3):
        turned = np.moveaxis(pieces, axis, 0)
        for one, other in ((turned[1:], turned[:-1]), (turned[:-1], turned[1:])):
            meet = ~stays[one] & stays[other] & (other > 0)
            np.add.at(touched, (row[one[meet]], owner[other[meet]]), 1)
    owner[~stays] = touched.argmax(1)  # that is 0 where nothing is touched
    return owner[pieces]
