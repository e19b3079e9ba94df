"""The exact Euclidean distance transform of a mask: how far each voxel is from the other side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

#: Columns whose distances are found together.
_COLUMNS = 16


def square_distances(mask: np.ndarray, steps: Sequence[float] | np.ndarray, reach: float) -> np.ndarray:
    """Return the squared distance of each voxel of a mask to the nearest voxel outside, from centre to centre.

    `steps` are the voxel's edges along z, y and x, `reach` is in their unit, and squares are at most its own. Outside
    they are 0; float32 (Z, Y, X).
    """
    return _transform(mask, steps, reach, 0.0, False)


def square_face_distances(mask: np.ndarray, reach: float) -> np.ndarray:
    """Return the squared distance of each voxel's centre to the faces between a mask and the rest, negative outside.

    In voxels, with squares of at most `reach`²; float32 (Z, Y, X).
    """
    return _transform(mask, (1.0, 1.0, 1.0), reach, 0.5, True)


def _transform(
    mask: np.ndarray, steps: Sequence[float] | np.ndarray, reach: float, offset: float, both: bool
) -> np.ndarray:
    squares = np.empty(mask.shape, dtype=np.float32)
    scratch = np.empty((max(mask.shape), _COLUMNS), dtype=np.float32)
    edges = np.asarray(steps, dtype=np.float32)
    _square_distances(np.ascontiguousarray(mask), edges, np.float32(reach), np.float32(offset), both, squares, scratch)
    return squares


@njit(cache=True)
def _square_distances(mask, steps, reach, offset, both, squares, scratch):  # pragma: no cover
    """Fill squared distances along x, then y, then z; the other side begins `offset` voxels before its centres."""
    nz, ny, nx = mask.shape
    hz, hy, hx = steps
    for z in range(nz):
        for y in range(ny):
            _fill_row(mask[z, y], hx, reach, offset, both, squares[z, y])
    for z in range(nz):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[z, :, first : first + _COLUMNS], hy, offset, scratch)
    for y in range(ny):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[:, y, first : first + _COLUMNS], hz, offset, scratch)


@njit(cache=True)
def _fill_row(mask, step, reach, offset, both, squares):  # pragma: no cover
    """Fill the squared distances within a row; outside they are negative, or 0 where only one side is wanted."""
    n, most, one = len(mask), reach * reach, np.float32(1)
    since = reach / step + one
    for x in range(n):
        since = one - offset if x > 0 and mask[x] != mask[x - 1] else since + one
        squares[x] = min((since * step) ** 2, most)
    since = reach / step + one
    for x in range(n - 1, -1, -1):
        since = one - offset if x < n - 1 and mask[x] != mask[x + 1] else since + one
        square = min((since * step) ** 2, squares[x])
        squares[x] = square if mask[x] else -square if both else np.float32(0)


@njit(cache=True)
def _lower_columns(squares, step, offset, scratch):  # pragma: no cover
    """Lower squares, (n, columns), to the least that k voxels along the columns offer, plus ((k - offset) step)²."""
    n, width = squares.shape
    zero, one = np.float32(0), np.float32(1)
    for at in range(n):
        for i in range(width):
            scratch[at, i] = squares[at, i]
    for at in range(n):
        for i in range(width):
            sign = -one if scratch[at, i] < 0 else one
            best, k, cost = sign * scratch[at, i], 1, ((one - offset) * step) ** 2
            while cost < best and (at - k >= 0 or at + k < n):
                if at - k >= 0:  # a voxel of the other side is at distance 0
                    best = min(best, cost + max(sign * scratch[at - k, i], zero))
                if at + k < n:
                    best = min(best, cost + max(sign * scratch[at + k, i], zero))
                k += 1
                cost = ((np.float32(k) - offset) * step) ** 2
            squares[at, i] = sign * best
