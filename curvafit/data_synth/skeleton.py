"""Curve skeletons with the mask's own topology, in a box that ends or one that repeats."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from skimage.morphology import skeletonize

from curvafit.priors.grid import Grid

#: Of 27 voxels, numbered along x, y, z: the middle; as bits the 6 and the 18 nearest to it, and those that touch each,
#: the middle aside, by a corner at least, or by a side and among the 18.
MIDDLE = 13
_PLACES = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), 1)
_STEPS = np.abs(_PLACES[:, None] - _PLACES)


def _bits(chosen: np.ndarray) -> np.ndarray:
    return chosen @ (1 << np.arange(27))


FACES = int(_bits(_STEPS[MIDDLE].sum(1) == 1))
EIGHTEEN = int(_bits((_STEPS[MIDDLE].sum(1) > 0) & (_STEPS[MIDDLE].sum(1) < 3)))
CORNERS = _bits(_STEPS.max(2) == 1) & ~(1 << MIDDLE)
SIDES = _bits(_STEPS.sum(2) == 1) & EIGHTEEN


def skeleton_of(distance: np.ndarray, grid: Grid) -> np.ndarray:
    """Return one-voxel wide curves in the middle of {distance > 0}, bool (Z, Y, X), with its pieces, tunnels and
    cavities.

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
    _thin(left, lines & mask, order.copy(), grid.periodic)
    _thin(left, np.zeros_like(mask), order[left.ravel()[order] > 0], grid.periodic)
    return left.astype(bool)


@njit(cache=True)
def _thin(left, fixed, order, periodic):  # pragma: no cover
    """Take away simple voxels in the given order, again and again; ends (of one neighbour) and `fixed` ones stay."""
    nz, ny, nx = left.shape
    changed = True
    while changed:
        changed, kept = False, 0
        for i in order:
            z, y, x = i // (ny * nx), i // nx % ny, i % nx
            if fixed[z, y, x]:
                continue
            around, count = 0, 0
            for k in range(27):
                a, b, c = z + k // 9 - 1, y + k // 3 % 3 - 1, x + k % 3 - 1
                if a < 0 or b < 0 or c < 0 or a >= nz or b >= ny or c >= nx:
                    if not periodic:
                        continue
                    a, b, c = a % nz, b % ny, c % nx
                if k != MIDDLE and left[a, b, c]:
                    around |= 1 << k
                    count += 1
            if count > 1 and _simple(around):
                left[z, y, x] = 0
                changed = True
            else:
                order[kept] = i
                kept += 1
        order = order[:kept]


@njit(cache=True)
def _simple(around):  # pragma: no cover
    """Return whether the middle of 27 voxels can go, given those of the mask around it as bits: they are one
    26-connected piece, and what is outside and next to it is one 6-connected piece within its 18-neighbourhood
    (Bertrand and Malandain 1994)."""
    outside = ~around & EIGHTEEN
    return outside & FACES != 0 and _joined(around, around, CORNERS) and _joined(outside, outside & FACES, SIDES)


@njit(cache=True)
def _joined(bits, wanted, touching):  # pragma: no cover
    """Return whether all of the `wanted` ones among the bits are in one piece."""
    piece, grown = 0, wanted & -wanted
    while grown != piece:
        piece = grown
        for k in range(27):
            if piece >> k & 1:
                grown |= touching[k] & bits
    return wanted & ~piece == 0
