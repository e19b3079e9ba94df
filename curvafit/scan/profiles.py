"""The phase field of a large mask, by compiled loops: `priors.phase_field` without what torch needs."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.kernels.cpu import gaussian_blur
from curvafit.priors.profile import PULL, PULL_WIDTH, STAIRS, SWEEPS

#: Columns whose distances are found together.
_COLUMNS = 16


def profile_mask(mask: np.ndarray) -> np.ndarray:
    """Return the phase field of a mask (Z, Y, X) on the working grid, float32, as `priors.phase_field` does.

    The mask is neither empty nor full, and continues as a mirror image beyond its box.
    """
    voxels = Grid(mask.shape, (1.0, 1.0, 1.0), "replicate")  # type: ignore[arg-type]
    reach = 6 * WORKING_EPSILON / WORKING_SPACING + math.ceil(4 * STAIRS)
    distance = _sign_distances(mask, reach)
    once = gaussian_blur(distance, voxels, STAIRS)
    np.multiply(once, 2, out=distance)
    distance -= gaussian_blur(once, voxels, STAIRS)
    error = once
    for _ in range(SWEEPS):
        if not _find_errors(distance, mask, error):
            break
        distance -= np.float32(PULL) * gaussian_blur(error, voxels, PULL_WIDTH)
    distance *= np.float32(WORKING_SPACING / (math.sqrt(2) * WORKING_EPSILON))
    return np.tanh(distance, out=distance)


def _sign_distances(mask: np.ndarray, reach: float) -> np.ndarray:
    """Return the signed distance to the faces of a mask in voxels, positive inside, at most `reach`."""
    squares = np.empty(mask.shape, dtype=np.float32)
    scratch = np.empty((max(mask.shape), _COLUMNS), dtype=np.float32)
    _square_distances(np.ascontiguousarray(mask), np.float32(reach**2), squares, scratch)
    return np.copysign(np.sqrt(np.abs(squares)), squares)


@njit(cache=True)
def _square_distances(mask, most, squares, scratch):  # pragma: no cover
    """Fill squared distances to the faces between a mask and the rest, negative outside: along x, then y, then z."""
    nz, ny, nx = mask.shape
    for z in range(nz):
        for y in range(ny):
            _fill_row(mask[z, y], most, squares[z, y])
    for z in range(nz):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[z, :, first : first + _COLUMNS], scratch)
    for y in range(ny):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[:, y, first : first + _COLUMNS], scratch)


@njit(cache=True)
def _fill_row(mask, most, squares):  # pragma: no cover
    """Fill the squared distances within a row."""
    n = len(mask)
    since = np.float32(n) + np.sqrt(most)
    for x in range(n):
        since = np.float32(0.5) if x > 0 and mask[x] != mask[x - 1] else since + np.float32(1)
        squares[x] = min(since * since, most)
    since = np.float32(n) + np.sqrt(most)
    for x in range(n - 1, -1, -1):
        since = np.float32(0.5) if x < n - 1 and mask[x] != mask[x + 1] else since + np.float32(1)
        square = min(since * since, squares[x])
        squares[x] = square if mask[x] else -square


@njit(cache=True)
def _lower_columns(squares, scratch):  # pragma: no cover
    """Lower squares, (n, columns), to the least that k voxels along the columns offer, plus (k - ½)²."""
    n, width = squares.shape
    for at in range(n):
        for i in range(width):
            scratch[at, i] = squares[at, i]
    for at in range(n):
        for i in range(width):
            sign = np.float32(1) if scratch[at, i] > 0 else np.float32(-1)
            best, k, cost = sign * scratch[at, i], 1, np.float32(0.25)
            while cost < best and (at - k >= 0 or at + k < n):
                if at - k >= 0:  # a voxel of the other side is at distance 0
                    best = min(best, cost + max(sign * scratch[at - k, i], np.float32(0)))
                if at + k < n:
                    best = min(best, cost + max(sign * scratch[at + k, i], np.float32(0)))
                k += 1
                cost = (np.float32(k) - np.float32(0.5)) ** 2
            squares[at, i] = sign * best


@njit(cache=True)
def _find_errors(distance, mask, error):  # pragma: no cover
    """Fill the distances whose sign is not the mask's, 0 elsewhere; return whether there are any."""
    found = False
    values, inside, wrong = distance.ravel(), mask.ravel(), error.ravel()
    for i in range(len(values)):
        value = min(values[i], np.float32(0)) if inside[i] else max(values[i], np.float32(0))
        wrong[i] = value
        if value != 0:
            found = True
    return found
