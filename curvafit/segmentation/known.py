"""Masks that are known: whether they are masks, and have the voxels and the place of another volume."""

from __future__ import annotations

from itertools import product

import numpy as np

from curvafit.core.units import METRES, sampling
from curvafit.volumes.field import Field, ScanError

__all__ = ["check_place", "check_spacing", "labels"]

#: Most values of a mask; more are grey levels.
LABELS = 256
#: Share by which the voxels of two files may differ in size, and voxels by which the same place may differ.
SAME, ASTRAY = 1e-3, 0.1


def labels(values: np.ndarray, name: str) -> np.ndarray:
    """Return the values of a mask or of labels, which an error calls by a name.

    Raises
    ------
    ScanError
        If they are grey levels.
    """
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError(f"expected {name} with a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > LABELS:
        raise ScanError(f"expected {name} with a mask or at most {LABELS} labels, got {count} values")
    return values


def check_spacing(example: Field, volume: Field, name: str) -> None:
    """Raise ScanError where an example's voxels differ in size from those of a volume, which the error calls `name`."""
    if example.unit != volume.unit or not np.allclose(example.spacing, volume.spacing, rtol=SAME):
        one, two = (sampling(each.shape, each.spacing, each.unit) for each in (volume, example))
        raise ScanError(f"expected an example with the spacing of {name} ({one}), got {two}")


def check_place(mask: Field, probability: Field) -> None:
    """Raise ScanError where a mask does not lie in the voxels of a probability map.

    The affines count where both exist; their units are converted.
    """
    if mask.shape != probability.shape:
        raise ScanError(f"expected a mask of the probabilities' shape {probability.shape}, got {mask.shape}")
    if mask.affine is None or probability.affine is None:
        return
    factor = METRES[mask.unit] / METRES[probability.unit] if {mask.unit, probability.unit} <= METRES.keys() else 1.0
    corners = np.array(list(product(*((0, n - 1) for n in mask.shape[::-1]))))
    one, two = (corners @ affine[:3, :3].T + affine[:3, 3] for affine in (probability.affine, mask.affine))
    far = float(np.linalg.norm(factor * two - one, axis=1).max()) / min(probability.spacing)
    if not far < ASTRAY:
        raise ScanError(f"expected a mask with the probabilities' affine, got one {far:.3g} voxels away")
