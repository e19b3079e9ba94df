"""Euler numbers of a mask, in a box that is a window or periodic, and its pieces, tunnels and cavities."""

from __future__ import annotations

from itertools import chain, combinations, product

import numpy as np
from scipy import ndimage
from skimage import measure

#: Whether a part of a window begins, and ends, with it, along z, y and x.
Ends = tuple[tuple[bool, bool], ...]


def euler_number(mask: np.ndarray, *, periodic: bool = False) -> int:
    """Return χ of the union of the closed voxels (26-connected); a periodic box's is that on the torus."""
    if not periodic:
        return int(measure.euler_number(mask, connectivity=3))
    return int(euler_shares(mask, periodic=True).sum(dtype=np.int64))


def euler_shares(mask: np.ndarray, *, periodic: bool = False) -> np.ndarray:
    """Return what each voxel adds to χ of the union of the closed voxels (26-connected), int8 of the mask's shape.

    In three dimensions a voxel counts itself (-1) and those of its low faces (1 each), low edges (-1 each) and low
    corner (1) that belong to the union. In a window the first layers count nothing: their neighbours are unknown. Sums
    over boxes are shares of χ.
    """
    total = np.zeros(mask.shape, dtype=np.int8)
    for axes in chain.from_iterable(combinations(range(mask.ndim), k) for k in range(mask.ndim + 1)):
        cells = mask  # voxels, or their low faces, edges or corners across `axes`
        for axis in axes:
            cells = cells | np.roll(cells, 1, axis)
        total += ((-1) ** (mask.ndim - len(axes)) * cells.astype(np.int8)).astype(np.int8)
    if not periodic:
        for axis in range(mask.ndim):
            total[(slice(None),) * axis + (0,)] = 0
    return total


def euler_of_window(mask: np.ndarray, ends: Ends = ((True, True),) * 3) -> float:
    """Return what a window of a larger structure adds to χ, on average over windows.

    From χ of the structure in the window, half of χ of each outer layer is subtracted, a quarter of that of each outer
    row added, and an eighth of each corner subtracted (Odgaard & Gundersen 1993; BoneJ's Δχ). On average a window of n
    voxels a side then has the share of (n - 1)³ voxels, and a structure that touches no face has its own χ.

    For a box of a window, `ends` say along which axes it begins, and ends, with the window; where it does not begin
    with it, its first layer belongs to the box before. The sum over boxes is the window's.
    """
    padded, total = np.pad(mask, [(int(first), int(last)) for first, last in ends]), 0.0
    for layers in product((None, 0, 1), repeat=3):
        if all(layer is None or end[layer] for layer, end in zip(layers, ends, strict=True)):
            # All of an axis, or its first or last layer, which are at 1 and -2 after padding.
            outer = padded[tuple({None: slice(None), 0: 1, 1: -2}[layer] for layer in layers)]
            total += (-0.5) ** (3 - outer.ndim) * int(euler_shares(outer).sum(dtype=np.int64))
    return total


def betti_numbers(mask: np.ndarray) -> tuple[int, int, int]:
    """Return b0 pieces (26-connected), b1 tunnels, b2 cavities (6-connected).

    Beyond the box all is outside: a hollow that opens to a face is no cavity. b1 = b0 + b2 - χ.
    """
    inside = np.asarray(mask, dtype=bool)
    if not inside.any():
        return 0, 0, 0
    pieces = ndimage.label(inside, np.ones((3, 3, 3)))[1]  # type: ignore[index]
    cavities = ndimage.label(~np.pad(inside, 1))[1] - 1  # type: ignore[index]
    return pieces, pieces + cavities - euler_number(inside), cavities
