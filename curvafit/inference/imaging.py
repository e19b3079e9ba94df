"""How a scan blurs and how noisy it is, measured from its grey levels, and a shape as such a scan shows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.inference.phases import find_level
from curvafit.inference.regrid import centre_distance, resample, rich_boxes, surface_voxels, without_specks
from curvafit.volumes.scan import Field, ScanError

#: Blurs that are tried, in voxels of the finest axis.
_BLURS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
#: Edge of the box in which a scan's noise and blur are measured.
_MEASURED = 96
#: Voxels this far from the surface lie deep within their phase; the least number of them; and the width beyond which
#: grey levels vary by their lighting, in voxels of the finest axis.
_DEEP, _FEWEST, _UNEVEN = 3.5, 500, 4.0
#: Median of the absolute value of a normal number.
_NORMAL_MEDIAN = 0.6745
#: Smoothed noise over contrast, and slices' thickness over the finest edge, from which on a scan is worse than a mask.
NOISY, SLICED = 0.02, 1.5
#: What smoothing by a voxel leaves of white noise's deviation: (2 √π)^(-3/2).
_WHITE = (2 * math.sqrt(math.pi)) ** -1.5


@dataclass(frozen=True)
class Imaging:
    """A scan's noise and blur.

    Attributes
    ----------
    blur
        Deviation of the Gaussian that blurs the structure, in voxels of the finest axis.
    noise, smoothed
        Deviation of the noise over the contrast of the two phases: as it is, and smoothed by a voxel of the finest axis
        as an image is before it is split. Of white noise that leaves 0.15.
    spacing
        Voxel edges (z, y, x) of the scan.
    """

    blur: float
    noise: float
    smoothed: float
    spacing: tuple[float, float, float]

    @property
    def grain(self) -> float:
        """Return the width of the Gaussian that makes such noise of white noise, in voxels of the finest axis.

        Smoothing by a voxel leaves (w² / (w² + 1))^(3/4) of the deviation of noise of width w.
        """
        left = min(self.smoothed / self.noise, 0.9) ** (4 / 3) if self.noise > 0 else 0.0
        return math.sqrt(left / (1 - left)) if left > 1.5 * _WHITE ** (4 / 3) else 0.0

    @property
    def degraded(self) -> bool:
        """Return whether a texture is harder to read from the scan than from a mask."""
        return self.smoothed > NOISY or max(self.spacing) > SLICED * min(self.spacing)

    def seen(self, mask: np.ndarray, scale: Sequence[float], smallest: float, seed: int) -> np.ndarray:
        """Return a periodic mask as it would come from such a scan.

        It is blurred, sampled on the scan's voxels, made noisy, and prepared as an image is: smoothed, split by Otsu's
        threshold, brought back to its own grid, cleared of specks.

        Parameters
        ----------
        mask
            Bool `(Z, Y, X)`, on the working grid.
        scale
            Working voxel in scan voxels (z, y, x).
        smallest
            Volume, in working voxels, of the smallest piece that is kept.
        seed
            Of the noise.

        Raises
        ------
        ScanError
            If nothing is left to be split.
        """
        shape, voxel = _sampling(mask.shape, scale)
        filled = np.clip(centre_distance(mask, (1.0, 1.0, 1.0), 2.0, periodic=True) + 0.5, 0, 1)
        grey = resample(filled, voxel, (0, 0, 0), shape, periodic=True)
        grey = ndimage.gaussian_filter(grey, [self.blur * min(voxel) / h for h in voxel], mode="wrap")
        noise = np.random.default_rng(seed).standard_normal(grey.shape, dtype=np.float32)
        noise = ndimage.gaussian_filter(noise, [self.grain * min(voxel) / h for h in voxel], mode="wrap")
        grey += np.float32(self.noise) * noise / noise.std()
        edges = (voxel[0], voxel[1], voxel[2])
        values = find_level(Field(grey, edges, "voxel"), kind="image", periodic=True).values
        inside = resample(values, [1 / h for h in voxel], (0, 0, 0), mask.shape, periodic=True) > 0
        return without_specks(inside, smallest, True)[0]


def voxelised(mask: np.ndarray, scale: Sequence[float], smallest: float) -> np.ndarray:
    """Return a periodic mask `(Z, Y, X)` as it would come from a mask on a scan's voxels, of which a working voxel is
    `scale` long (z, y, x): by signed distances there and back, without pieces of under `smallest` working voxels."""
    shape, voxel = _sampling(mask.shape, scale)
    distance = centre_distance(mask, (1.0, 1.0, 1.0), 4 * max(voxel), periodic=True)
    coarse = resample(distance, voxel, (0, 0, 0), shape, periodic=True) > 0
    distance = centre_distance(coarse, voxel, 4 * max(1.0, *voxel), periodic=True)
    inside = resample(distance, [1 / h for h in voxel], (0, 0, 0), mask.shape, periodic=True) > 0
    return without_specks(inside, smallest, True)[0]


def _sampling(shape: Sequence[int], scale: Sequence[float]) -> tuple[list[int], list[float]]:
    """Return the scan's voxels in a box of working voxels, and their edges in working voxels."""
    voxels = [max(4, round(n * s)) for n, s in zip(shape, scale, strict=True)]
    return voxels, [n / m for n, m in zip(shape, voxels, strict=True)]


def imaging_of(image: np.ndarray, mask: np.ndarray, spacing: tuple[float, float, float]) -> Imaging:
    """Measure the noise and blur of a scan from its structure.

    The blur, with the contrast, is the one of `_BLURS` with which the blurred structure explains the grey levels best
    (least squares). The noise is what grey levels vary by deep within the phases, where uneven lighting is taken off.
    Where nothing lies deep it is taken for white and read from third-order differences, which neither the structure nor
    the lighting passes (Immerkær 1996, along three axes).

    Parameters
    ----------
    image
        `(Z, Y, X)`: grey levels.
    mask
        Bool, same shape: the structure.

    Raises
    ------
    ScanError
        If the grey levels have no contrast between structure and background.
    """
    box = next(iter(rich_boxes(surface_voxels(mask), _MEASURED)), (slice(None),) * 3)
    image, mask = image[box].astype(np.float32), mask[box]
    levels = image - image.mean()
    edges = [h / min(spacing) for h in spacing]
    blur, contrast = _blur_of(levels, mask, edges)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    noise, smoothed = _deep_noise(levels, mask, edges) or _white_noise(levels)
    return Imaging(blur, noise / contrast, smoothed / contrast, spacing)


def _blur_of(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float]:
    """Return the blur and the contrast of levels of mean 0, on voxels with edges in units of the finest."""
    filled = np.clip(centre_distance(mask, edges, 2.0) + 0.5, 0, 1)
    explained = []
    for blur in _BLURS:
        model = ndimage.gaussian_filter(filled, [blur / h for h in edges])
        model -= model.mean()
        product, square = float((model * levels).mean()), float(np.square(model).mean())
        explained.append((product * abs(product) / square, blur, product / square))
    _, blur, contrast = max(explained)
    return blur, contrast


def _deep_noise(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float] | None:
    """Return the deviation of levels, as they are and smoothed, deep within the phases; None where too little is."""
    smoothing, uneven = ([width / h for h in edges] for width in (1.0, _UNEVEN))
    both = (levels, ndimage.gaussian_filter(levels, smoothing))
    squares, count = np.zeros(2), 0
    for phase in (mask, ~mask):
        deep = np.asarray(ndimage.distance_transform_edt(phase, sampling=edges)) >= _DEEP
        around = np.maximum(ndimage.gaussian_filter(deep.astype(np.float32), uneven), 1e-6)
        for k, each in enumerate(both):
            mean = ndimage.gaussian_filter(np.where(deep, each, 0), uneven) / around
            squares[k] += float(np.square((each - mean)[deep], dtype=np.float64).sum())
        count += int(np.count_nonzero(deep))
    if count < _FEWEST:
        return None
    noise, smoothed = np.sqrt(squares / count)
    return float(noise), float(smoothed)


def _white_noise(levels: np.ndarray) -> tuple[float, float]:
    """Return the deviation of white noise in levels, and what smoothing leaves of it."""
    for axis in range(3):
        levels = np.diff(levels, 2, axis)
    noise = float(np.median(np.abs(levels))) / _NORMAL_MEDIAN / 6**1.5
    return noise, _WHITE * noise
