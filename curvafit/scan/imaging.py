"""How a scan blurs and how noisy it is, measured from its grey levels, and a shape as such a scan shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.scan.phases import find_level
from curvafit.scan.regrid import centre_distance, resample, rich_boxes, surface_voxels, without_specks
from curvafit.volumes.scan import Field, ScanError

#: Blurs that are tried, in voxels of the finest axis.
_BLURS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
#: Fat that is tried, in voxels of the finest axis.
_FAT = (-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
#: Grains that are tried, in voxels of the finest axis.
_GRAINS = (0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0)
#: Edge of the box in which a scan's noise and blur are measured.
_MEASURED = 64
#: Voxels this far from the surface lie deep within their phase; the least number of them; and the width beyond which
#: grey levels vary by their lighting, in voxels of the finest axis.
_DEEP, _FEWEST, _UNEVEN = 3.5, 500, 4.0
#: Median of the absolute value of a normal number.
_NORMAL_MEDIAN = 0.6745
#: Smoothed noise over contrast, and slices' thickness over the finest edge, from which on a scan is worse than a mask.
NOISY, SLICED = 0.02, 1.5


@dataclass(frozen=True)
class Imaging:
    """A scan's noise and blur.

    Attributes
    ----------
    blur
        Deviation of the Gaussian that blurs the structure, in voxels of the finest axis.
    noise
        Deviation of the noise over the contrast of the two phases.
    grain
        Deviation of the Gaussian that makes such noise of white noise, in voxels of the finest axis.
    fat
        How far the structure that was split off reaches beyond what was blurred, in voxels of the finest axis.
    spacing
        Voxel edges (z, y, x) of the scan.
    """

    blur: float
    noise: float
    grain: float
    fat: float
    spacing: tuple[float, float, float]

    @property
    def smoothed(self) -> float:
        """Return the noise that is left by the smoothing by a voxel of the finest axis with which an image is split; of
        white noise on cubic voxels it leaves 0.15."""
        return self.noise * _left(self.grain, self.spacing)

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
        return without_specks(split(Field(grey, edges, "voxel"), mask.shape, periodic=True), smallest, True)[0]


def split(scan: Field, shape: Sequence[int], *, periodic: bool = False) -> np.ndarray:
    """Return the structure of grey levels, split as an image is, on cubic voxels of edge 1 `(Z, Y, X)`."""
    values = find_level(scan, kind="image", periodic=periodic).values
    return resample(values, [1 / h for h in scan.spacing], (0, 0, 0), shape, periodic=periodic) > 0


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

    The blur, with the contrast, is the one of `_BLURS` with which the structure, blurred, explains the grey levels best
    (least squares); with it is found by how much the structure that was split off is too fat, as thin ones are where
    noise shifts the threshold. The noise is what grey levels vary by deep within the phases, where uneven lighting is
    taken off.
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
    blur, contrast, fat = _blur_of(levels, mask, edges)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    noise, left = _deep_noise(levels, mask, edges) or (_white_noise(levels), 0.0)
    grain = min(_GRAINS, key=lambda width: abs(_left(width, spacing) - left))
    return Imaging(blur, noise / contrast, grain, fat, spacing)


def _blur_of(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float, float]:
    """Return the blur, the contrast, and by how much the structure is fatter than what was blurred, of levels of mean 0
    on voxels with edges in units of the finest."""
    distance = centre_distance(mask, edges, 4.0)
    explained = []
    for fat in _FAT:
        filled = np.clip(distance - fat + 0.5, 0, 1)
        for blur in _BLURS:
            model = ndimage.gaussian_filter(filled, [blur / h for h in edges])
            model -= model.mean()
            product, square = float((model * levels).mean()), float(np.square(model).mean())
            if square > 0:
                explained.append((product * abs(product) / square, blur, product / square, fat))
    return max(explained)[1:]


def _deep_noise(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float] | None:
    """Return the deviation of levels deep within the phases, and the part of it that smoothing leaves; None where too
    little lies deep."""
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
    return float(noise), float(smoothed / max(noise, 1e-30))


def _white_noise(levels: np.ndarray) -> float:
    """Return the deviation of white noise in levels."""
    for axis in range(3):
        levels = np.diff(levels, 2, axis)
    return float(np.median(np.abs(levels))) / _NORMAL_MEDIAN / 6**1.5


def _left(grain: float, spacing: Sequence[float]) -> float:
    """Return the part of the deviation of noise of a grain that smoothing by a voxel of the finest axis leaves."""
    spike, left = np.eye(1, 65, 32)[0], 1.0
    for edge in spacing:
        width = min(spacing) / edge
        noise = ndimage.gaussian_filter(spike, grain * width)
        left *= float(np.linalg.norm(ndimage.gaussian_filter(noise, width)) / np.linalg.norm(noise))
    return left
