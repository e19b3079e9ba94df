"""Curve skeletons with the mask's own topology, in a box that ends or one that repeats."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from skimage.morphology import skeletonize

from curvafit.priors.grid import Grid


def skeleton_of(distance: np.ndarray, grid: Grid) -> np.ndarray:
    """One-voxel wide curves in the middle of {distance > 0}, bool (Z, Y, X), with its pieces, tunnels and cavities.

    Lee's thinning (scikit-image) of the box continued beyond its faces (periodic, or by its outermost layers, so that
    what is cut by a face is followed up to it) says where the curves go. As what is cut off with that continuation may
    hold the pieces together, the whole mask is then thinned in the box itself (a torus where it is periodic) around
    those curves: voxels go in the order of their distance where that changes no piece, tunnel or cavity. In a periodic
    box the curves so run on from face to face. A cavity keeps a closed sheet around it.

    Parameters
    ----------
    distance
        Signed distance (Z, Y, X) as `field_distance` gives it.
    """
    mask = distance > 0
    width = math.ceil(float(distance.max()) / min(grid.spacing)) + 2
    margin = [(min(n // 2, width),) * 2 for n in mask.shape]
    padded = np.pad(mask, margin, mode="wrap" if grid.periodic else "edge")
    inner = tuple(slice(m, m + n) for (m, _), n in zip(margin, mask.shape, strict=True))
    lines = skeletonize(padded)[inner].astype(bool)
    order = np.flatnonzero(mask)
    order = order[np.argsort(distance.ravel()[order], kind="stable")]
    left = mask.astype(np.uint8)
    _thin(left, lines & mask, order, grid.periodic)
    _thin(left, np.zeros_like(mask), order[left.ravel()[order] > 0], grid.periodic)
    return left.astype(bool)


@njit(cache=True)
def _thin(left, fixed, order, periodic):  # pragma: no cover
    """Take away simple voxels in the given order, again and again; ends (of one neighbour) and `fixed` ones stay."""
    nz, ny, nx = left.shape
    around = np.zeros(27, dtype=np.uint8)
    changed = True
    while changed:
        changed = False
        for i in order:
            z, y, x = i // (ny * nx), i // nx % ny, i % nx
            if not left[z, y, x] or fixed[z, y, x]:
                continue
            count = 0
            for k in range(27):
                a, b, c = z + k // 9 - 1, y + k // 3 % 3 - 1, x + k % 3 - 1
                if periodic:
                    a, b, c = a % nz, b % ny, c % nx
                within = 0 <= a < nz and 0 <= b < ny and 0 <= c < nx
                around[k] = left[a, b, c] if within else 0
                count += around[k]
            if count > 2 and _simple(around):
                left[z, y, x] = 0
                changed = True


@njit(cache=True)
def _simple(around):  # pragma: no cover
    """Whether the middle of 27 voxels can go: one 26-connected piece of the mask around it, and one 6-connected piece,
    within its 18-neighbourhood, of what is outside and next to it (Bertrand and Malandain 1994)."""
    return _pieces(around, 1) == 1 and _pieces(around, 0) == 1


@njit(cache=True)
def _pieces(around, value):  # pragma: no cover
    """26-connected pieces of ones, or those 6-connected pieces of zeros in the 18-neighbourhood that touch a face."""
    seen = np.zeros(27, dtype=np.bool_)
    stack = np.zeros(27, dtype=np.int64)
    seen[13] = True
    pieces = 0
    for start in range(27):
        off = abs(start // 9 - 1) + abs(start // 3 % 3 - 1) + abs(start % 3 - 1)
        if seen[start] or around[start] != value or (value == 0 and off != 1):
            continue
        pieces += 1
        stack[0], top = start, 1
        seen[start] = True
        while top:
            top -= 1
            here = stack[top]
            for other in range(27):
                if seen[other] or around[other] != value:
                    continue
                dz, dy, dx = abs(other // 9 - here // 9), abs(other // 3 % 3 - here // 3 % 3), abs(other % 3 - here % 3)
                if value == 1:
                    joined = max(dz, dy, dx) == 1
                else:
                    corner = abs(other // 9 - 1) + abs(other // 3 % 3 - 1) + abs(other % 3 - 1) == 3
                    joined = dz + dy + dx == 1 and not corner
                if joined:
                    seen[other] = True
                    stack[top] = other
                    top += 1
    return pieces
