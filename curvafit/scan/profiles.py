"""The phase field of a large mask, by compiled loops: `priors.phase_field` without what torch needs."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from curvafit.geometry.distance_transform import square_face_distances
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.kernels.cpu import gaussian_blur
from curvafit.priors.profile import PULL, PULL_WIDTH, STAIRS, SWEEPS


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
    squares = square_face_distances(mask, reach)
    return np.copysign(np.sqrt(np.abs(squares)), squares)


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
