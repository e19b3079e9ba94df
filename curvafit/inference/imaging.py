"""How a scan blurs and how noisy it is, measured from its grey levels, and a shape as such a scan shows it."""

from __future__ import annotations

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
#: Median of the absolute value of a normal number.
_NORMAL_MEDIAN = 0.6745
#: Noise over contrast, and slices' thickness over the finest edge, from which on a scan is worse than a mask.
NOISY, SLICED = 0.15, 1.5


@dataclass(frozen=True)
class Imaging:
    """A scan's noise and blur.

    Attributes
    ----------
    blur
        Deviation of the Gaussian that blurs the structure, in voxels of the finest axis.
    noise
        Deviation of white noise, a voxel of the scan, over the contrast of the two phases.
    spacing
        Voxel edges (z, y, x) of the scan.
    """

    blur: float
    noise: float
    spacing: tuple[float, float, float]

    @property
    def degraded(self) -> bool:
        """Return whether a texture is harder to read from the scan than from a mask."""
        return self.noise > NOISY or max(self.spacing) > SLICED * min(self.spacing)

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
        rng = np.random.default_rng(seed)
        grey += np.float32(self.noise) * rng.standard_normal(grey.shape, dtype=np.float32)
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
    (least squares). The noise is read from third-order differences that neither the structure nor uneven lighting
    passes (Immerkær 1996, along three axes): noise that neighbours share is understated.

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
    finest = min(spacing)
    filled = np.clip(centre_distance(mask, spacing, 2 * finest) / finest + 0.5, 0, 1)
    levels = image - image.mean()
    explained = []
    for blur in _BLURS:
        model = ndimage.gaussian_filter(filled, [blur * finest / h for h in spacing])
        model -= model.mean()
        product, square = float((model * levels).mean()), float(np.square(model).mean())
        explained.append((product * abs(product) / square, blur, product / square))
    _, blur, contrast = max(explained)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    rough = levels
    for axis in range(3):
        rough = np.diff(rough, 2, axis)
    noise = float(np.median(np.abs(rough))) / _NORMAL_MEDIAN / 6**1.5
    return Imaging(blur, noise / contrast, spacing)
