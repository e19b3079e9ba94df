"""How blurred a scan is and how noisy, measured from its grey levels; and images of grown shapes that are as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.scan.grids import boxes_by_surface, centre_distance, resample, resample_mask, surface_voxels
from curvafit.volumes.volume import ScanError

#: Blurs that are tried, in voxels of the finest axis.
_BLURS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
#: Shifts of the boundary that are tried, in voxels of the finest axis.
_SHIFTS = (-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
#: Grains that are tried, in voxels of the finest axis.
_GRAINS = (0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0)
#: Edge of the box in which a scan's noise and blur are measured.
_MEASURED = 64
#: Voxels this far from the surface lie deep within their phase; the least number of them; and the width beyond which
#: grey levels vary by their lighting, in voxels of the finest axis.
_DEEP, _FEWEST, _UNEVEN = 3.0, 500, 4.0
#: Median of the absolute value of a normal number.
_NORMAL_MEDIAN = 0.6745
#: Smoothed noise over contrast, and slices' thickness over the finest edge, from which on a scan is worse than a mask.
NOISY, SLICED = 0.02, 1.5


@dataclass(frozen=True)
class Quality:
    """Blur and noise of a scan.

    Attributes
    ----------
    blur
        Deviation of the Gaussian that blurs the structure, in voxels of the finest axis.
    noise
        Deviation of the noise over the contrast of the two phases.
    grain
        Deviation of the Gaussian that correlates the noise, in voxels of the finest axis; 0 of white noise.
    boundary_shift
        How far the split structure reaches beyond the true one, in voxels of the finest axis.
    spacing
        Voxel edges (z, y, x) of the scan.
    """

    blur: float
    noise: float
    grain: float
    boundary_shift: float
    spacing: tuple[float, float, float]

    @property
    def smoothed(self) -> float:
        """Return the noise, over the contrast, that is left after smoothing by a voxel of the finest axis."""
        return self.noise * _smoothing_factor(self.grain, self.spacing)

    @property
    def degraded(self) -> bool:
        """Return whether a texture is harder to read from the scan than from a mask."""
        return self.smoothed > NOISY or max(self.spacing) > SLICED * min(self.spacing)

    def image(self, mask: np.ndarray, step: Sequence[float], seed: int) -> np.ndarray:
        """Return grey levels of a periodic mask `(Z, Y, X)` as this scan would show it: blurred, sampled on voxels of
        `step` of the mask's (z, y, x), and made noisy with noise of a seed."""
        filled = np.clip(centre_distance(mask, (1.0, 1.0, 1.0), 2.0, periodic=True) + 0.5, 0, 1)
        grey = resample(filled, step, (0, 0, 0), sampled_shape(mask.shape, step), periodic=True)
        widths = [min(self.spacing) / h for h in self.spacing]
        grey = ndimage.gaussian_filter(grey, [self.blur * width for width in widths], mode="wrap")
        noise = np.random.default_rng(seed).standard_normal(grey.shape, dtype=np.float32)
        noise = ndimage.gaussian_filter(noise, [self.grain * width for width in widths], mode="wrap")
        return grey + np.float32(self.noise) * noise / noise.std()


def sample_mask(
    mask: np.ndarray, step: Sequence[float], periodic: bool = True, *, keep_volume: bool = False
) -> np.ndarray:
    """Return a mask `(Z, Y, X)` on voxels of `step` of its own (z, y, x), by signed distances: a thin structure loses
    some per cent of its volume, unless `keep_volume` moves its surface outwards by as much."""
    shape = sampled_shape(mask.shape, step)
    sampled = resample_mask(mask, (1.0, 1.0, 1.0), step, (0, 0, 0), shape, periodic=periodic)
    return sampled > (np.quantile(sampled, 1 - mask.mean()) if keep_volume else 0)


def sampled_shape(shape: Sequence[int], step: Sequence[float]) -> tuple[int, ...]:
    """Return how many voxels of `step` lie along the axes of a box of voxels of 1."""
    return tuple(max(4, int(n / h)) for n, h in zip(shape, step, strict=True))


def measure_quality(image: np.ndarray, mask: np.ndarray, spacing: tuple[float, float, float]) -> Quality:
    """Measure blur and noise of a scan from its structure.

    Blur, contrast and shift of the boundary are those with which the structure, blurred, explains the grey levels best
    (least squares over `_BLURS` and `_SHIFTS`); thin structures come out too fat where noise shifts the threshold. The
    noise is the deviation of grey levels deep within the phases, less uneven lighting. Where nothing lies deep, the
    noise is taken for white and read from second differences along three axes, which neither structure nor lighting
    passes (Immerkær 1996). The mask of the structure is bool, of the image's shape `(Z, Y, X)`. Raises ScanError if the
    grey levels have no contrast between structure and background.
    """
    box = next(iter(boxes_by_surface(surface_voxels(mask), _MEASURED)), (slice(None),) * 3)
    image, mask = image[box].astype(np.float32), mask[box]
    levels = image - image.mean()
    edges = [h / min(spacing) for h in spacing]
    distance = centre_distance(mask, edges, dtype=np.float64)
    blur, contrast, shift = _fit_blur(levels, distance.astype(np.float32), edges)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    noise, rest = _measure_deep_noise(levels, distance, edges) or (_measure_white_noise(levels), 0.0)
    grain = min(_GRAINS, key=lambda width: abs(_smoothing_factor(width, spacing) - rest))
    return Quality(blur, noise / contrast, grain, shift, spacing)


def _fit_blur(levels: np.ndarray, distance: np.ndarray, edges: Sequence[float]) -> tuple[float, float, float]:
    """Return blur, contrast and boundary shift of levels of mean 0 on voxels with edges in units of the finest."""
    explained = []
    for shift in _SHIFTS:
        filled = np.clip(distance - shift + 0.5, 0, 1)
        for blur in _BLURS:
            model = ndimage.gaussian_filter(filled, [blur / h for h in edges])
            model -= model.mean()
            product, square = float((model * levels).mean()), float(np.square(model).mean())
            if square > 0:
                explained.append((product * abs(product) / square, blur, product / square, shift))
    return max(explained)[1:]


def _measure_deep_noise(levels: np.ndarray, distance: np.ndarray, edges: Sequence[float]) -> tuple[float, float] | None:
    """Return the deviation of levels deep within the phases and the share of it that smoothing leaves, or None."""
    smoothing, uneven = ([width / h for h in edges] for width in (1.0, _UNEVEN))
    both = (levels, ndimage.gaussian_filter(levels, smoothing))
    squares, count = np.zeros(2), 0
    for deep in (distance >= _DEEP, distance <= -_DEEP):
        around = np.maximum(ndimage.gaussian_filter(deep.astype(np.float32), uneven), 1e-6)
        for k, each in enumerate(both):
            mean = ndimage.gaussian_filter(np.where(deep, each, 0), uneven) / around
            squares[k] += float(np.square((each - mean)[deep], dtype=np.float64).sum())
        count += int(np.count_nonzero(deep))
    if count < _FEWEST:
        return None
    noise, smoothed = np.sqrt(squares / count)
    return float(noise), float(smoothed / max(noise, 1e-30))


def _measure_white_noise(levels: np.ndarray) -> float:
    """Return the deviation of white noise in levels."""
    for axis in range(3):
        levels = np.diff(levels, 2, axis)
    return float(np.median(np.abs(levels))) / _NORMAL_MEDIAN / 6**1.5


def _smoothing_factor(grain: float, spacing: Sequence[float]) -> float:
    """Return the factor by which smoothing by a voxel of the finest axis lowers the deviation of noise of a grain."""
    spike, factor = np.eye(1, 65, 32)[0], 1.0
    for edge in spacing:
        width = min(spacing) / edge
        noise = ndimage.gaussian_filter(spike, grain * width)
        factor *= float(np.linalg.norm(ndimage.gaussian_filter(noise, width)) / np.linalg.norm(noise))
    return factor
