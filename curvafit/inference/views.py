"""How a generated shape may meet inference: as its field, as a mask, cropped, scanned.

The scale of a view is the shape's own: a working voxel is the voxel on which the shape was generated, with ε two of
them, so the parameters of a view are the shape's. A scan whose working voxel is chosen otherwise, λ times as long, has
the coefficients λ a10, λ a01, λ² a00 in its working units and ε = 2 / λ voxels (`Coefficients.in_unit`): another
model than the one with the same coefficients and ε of two voxels. No view does that; a posterior asks instead which
parameters, with ε two working voxels, make such a texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from curvafit.priors.grid import Grid
from curvafit.scan.imaging import split
from curvafit.scan.prepare import KEPT_THICKNESS, THINNEST, smallest_piece
from curvafit.scan.regrid import centre_distance, median_thickness, resample, without_specks
from curvafit.volumes.scan import Field, ScanError

#: Part of each side that a crop keeps.
WINDOW = 0.75
#: Least and greatest voxel of a resampled shape, in voxels of the field.
SCALES = (0.5, 2.0)
#: A degraded scan: deviation of the blur in voxels, contrast over the noise's deviation, and voxels a slice is thick.
BLUR, SNR, SLICE = 1.0, 5.0, 2


class View(NamedTuple):
    """A phase field (float32) or a mask (bool) `(Z, Y, X)`, and its grid: not periodic where it is a part."""

    shape: np.ndarray
    grid: Grid


def field(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return the phase field itself."""
    return View(u, grid)


def mask(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return {u > 0} on the field's own voxels."""
    return View(u > 0, grid)


def crop(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return {u > 0} in a window of three quarters of each side, anywhere in the repeated box."""
    turned = np.roll(u > 0, [int(rng.integers(n)) for n in u.shape], (0, 1, 2))
    nz, ny, nx = (round(WINDOW * n) for n in u.shape)
    part = np.ascontiguousarray(turned[:nz, :ny, :nx])
    if part.all() or not part.any():
        raise ScanError("expected a window with an inside and an outside, got one of them only")
    return View(part, Grid((nz, ny, nx), grid.spacing, "replicate"))


def resampled(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return a crop that was a mask on other voxels, on which it was 5 to 16 thick, brought back by signed distances.

    Back on the voxels of the field, as a scan's mask is brought to the working grid.
    """
    part, window = crop(u, grid, rng)
    thickness = _thickness(part)
    scale = float(np.clip(thickness / math.exp(rng.uniform(*np.log(KEPT_THICKNESS))), *SCALES))
    coarse = [round(n / scale) for n in part.shape]
    zoom = [n / m for n, m in zip(part.shape, coarse, strict=True)]
    other = resample(centre_distance(part, (1.0,) * 3, 8.0), zoom, (0, 0, 0), coarse) > 0
    distance = centre_distance(other, zoom, 8.0)
    back = resample(distance, [1 / z for z in zoom], (0, 0, 0), part.shape) > 0
    return View(without_specks(back, smallest_piece(thickness), False)[0], window)


def scan(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return a crop scanned badly, split by Otsu's threshold: blurred, slices two voxels thick, noise at SNR 5.

    Prepared as `infer` prepares an image: smoothed by a voxel, split, interpolated to cubic voxels, cleared of specks.
    """
    part, window = crop(u, grid, rng)
    inside = split(degraded(part, rng), part.shape)
    return View(without_specks(inside, smallest_piece(_thickness(inside)), False)[0], window)


def degraded(part: np.ndarray, rng: np.random.Generator) -> Field:
    """Return a mask as a bad scan shows it: blurred, slices two voxels thick, noise at SNR 5."""
    grey = ndimage.gaussian_filter(part.astype(np.float32), BLUR, mode="nearest")
    whole = np.pad(grey, ((0, -len(grey) % SLICE), (0, 0), (0, 0)), mode="edge")
    grey = whole.reshape(-1, SLICE, *grey.shape[1:]).mean(1)
    grey += rng.standard_normal(grey.shape, dtype=np.float32) / SNR
    return Field(grey, (float(SLICE), 1.0, 1.0), "voxel")


def _thickness(part: np.ndarray) -> float:
    """Return the median thickness in voxels, or raise ScanError where `infer` refuses a structure as too thin."""
    if not part.any():
        raise ScanError("expected a structure in the window, got none")
    thickness, thick = median_thickness(part, (1.0, 1.0, 1.0), False)
    if thick < THINNEST - 0.5:
        raise ScanError(f"expected a structure {THINNEST:g} voxels thick, got one of {thick:.2g}")
    return thickness


#: Views by name.
VIEWS: dict[str, Callable[[np.ndarray, Grid, np.random.Generator], View]] = {
    "field": field,
    "mask": mask,
    "crop": crop,
    "resampled": resampled,
    "scan": scan,
}
