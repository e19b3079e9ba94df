"""Moves that leave a shape's texture as it is: the cube's 48 symmetries, and crops of a periodic box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Rotations and reflections of the cube: orders of the three axes times their directions.
SYMMETRIES = 48
_ORDERS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


def turned(values: np.ndarray, symmetry: int) -> np.ndarray:
    """A volume (…, Z, Y, X) under one of the cube's symmetries, 0 to 47; 0 leaves it as it is. A view.

    Raises
    ------
    ValueError
        If there is no such symmetry.
    """
    if not 0 <= symmetry < SYMMETRIES:
        raise ValueError(f"expected a symmetry from 0 to {SYMMETRIES - 1}, got {symmetry}")
    order, flips = divmod(symmetry, 8)
    lead = values.ndim - 3
    axes = (*range(lead), *(lead + axis for axis in _ORDERS[order]))
    moved = values.transpose(axes)
    return moved[(..., *(slice(None, None, -1 if flips >> axis & 1 else 1) for axis in range(3)))]


def cropped(values: np.ndarray, corner: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """The part (z, y, x) of a periodic volume (Z, Y, X) that begins at a corner, across its faces where need be.

    Raises
    ------
    ValueError
        If the part is larger than the volume.
    """
    if any(part > whole for part, whole in zip(shape, values.shape, strict=True)):
        raise ValueError(f"expected a crop within the shape's {values.shape} voxels, got {tuple(shape)}")
    for axis, (first, part) in enumerate(zip(corner, shape, strict=True)):
        whole = values.shape[axis]
        places = np.arange(first, first + part) % whole
        values = np.take(values, places, axis)
    return values


def any_crop(
    values: np.ndarray, shape: Sequence[int], rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, list[int] | int]]:
    """A crop of a periodic volume, turned, both at random and all alike; and which."""
    symmetry = int(rng.integers(SYMMETRIES))
    moved = turned(values, symmetry)
    corner = [int(rng.integers(whole)) for whole in moved.shape]
    return np.ascontiguousarray(cropped(moved, corner, shape)), {"symmetry": symmetry, "corner": corner}
