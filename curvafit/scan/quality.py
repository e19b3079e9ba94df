"""How blurred and how noisy a scan is, measured from its grey levels; and images of simulated shapes made like it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.scan.grids import box_by_surface, centre_distance, resample, resample_mask, surface_voxels
from curvafit.volumes.volume import ScanError

#: Blurs, shifts of the boundary and grains that are tried, in voxels of the finest axis.
_BLURS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
_SHIFTS = (-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
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
        """Return the noise over the contrast after smoothing by one voxel of the finest axis."""
        return self.noise * _smoothing_factor(self.grain, self.spacing)

    @property
    def degraded(self) -> bool:
        """Return whether a texture is harder to read from the scan than from a mask."""
        return self.smoothed > NOISY or max(self.spacing) > SLICED * min(self.spacing)

    def image(self, mask: np.ndarray, step: Sequence[float], seed: int) -> np.ndarray:
        """Return grey levels of a periodic mask `(Z, Y, X)` as this scan would show it: sampled on voxels with edges
        `step` in the mask's voxels, blurred, and with noise from `seed`; structure is about 1, background 0."""
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
    """Resample a mask `(Z, Y, X)` by signed distances to voxels with edges `step` in its own voxels (z, y, x). A thin
    structure loses some per cent of its volume, unless `keep_volume` moves its surface outwards to restore it."""
    shape = sampled_shape(mask.shape, step)
    sampled = resample_mask(mask, (1.0, 1.0, 1.0), step, (0, 0, 0), shape, periodic=periodic)
    return sampled > (np.quantile(sampled, 1 - mask.mean()) if keep_volume else 0)


def sampled_shape(shape: Sequence[int], step: Sequence[float]) -> tuple[int, ...]:
    """Return how many voxels with edges `step` fit along each axis of a box of `shape` unit voxels, 4 or more."""
    return tuple(max(4, int(n / h)) for n, h in zip(shape, step, strict=True))


def measure_quality(image: np.ndarray, mask: np.ndarray, spacing: tuple[float, float, float]) -> Quality:
    """Measure blur and noise of a scan from its structure.

    Blur, contrast and shift of the boundary are those with which the blurred structure fits the grey levels best (least
    squares over `_BLURS` and `_SHIFTS`); thin structures come out too fat where noise shifts the threshold. The noise
    is the deviation of grey levels deep within the phases, after uneven lighting is subtracted. Without deep voxels,
    the noise is assumed to be white and estimated from second differences along three axes, which remove structure and
    lighting (Immerkær 1996). The mask of the structure is bool, of the image's shape `(Z, Y, X)`. Raises ScanError if
    the grey levels have no contrast between structure and background.
    """
    box = box_by_surface(surface_voxels(mask), _MEASURED) or (slice(None),) * 3
    image, mask = image[box].astype(np.float32), mask[box]
    levels = image - image.mean()
    edges = [h / min(spacing) for h in spacing]
    distance = centre_distance(mask, edges, dtype=np.float64)
    blur, contrast, shift = _fit_blur(levels, distance.astype(np.float32), edges)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    noise, ratio = _measure_deep_noise(levels, distance, edges) or (_measure_white_noise(levels), 0.0)
    grain = min(_GRAINS, key=lambda width: abs(_smoothing_factor(width, spacing) - ratio))
    return Quality(blur, noise / contrast, grain, shift, spacing)


def _fit_blur(levels: np.ndarray, distance: np.ndarray, edges: Sequence[float]) -> tuple[float, float, float]:
    """Return the blur, contrast and boundary shift that fit levels of mean 0 best; lengths are in the finest edge."""
    fits = []
    for shift in _SHIFTS:
        filled = np.clip(distance - shift + 0.5, 0, 1)
        for blur in _BLURS:
            model = ndimage.gaussian_filter(filled, [blur / h for h in edges])
            model -= model.mean()
            product, square = float((model * levels).mean()), float(np.square(model).mean())
            if square > 0:  # the variance that the model explains has the sign of the contrast: inverted ones come last
                fits.append((product * abs(product) / square, blur, product / square, shift))
    return max(fits)[1:]


def _measure_deep_noise(levels: np.ndarray, distance: np.ndarray, edges: Sequence[float]) -> tuple[float, float] | None:
    """Return the deviation of levels deep within the phases and the fraction of it left after smoothing, or None."""
    smoothing, uneven = ([width / h for h in edges] for width in (1.0, _UNEVEN))
    images = (levels, ndimage.gaussian_filter(levels, smoothing))
    squares, count = np.zeros(2), 0
    for deep in (distance >= _DEEP, distance <= -_DEEP):
        weights = np.maximum(ndimage.gaussian_filter(deep.astype(np.float32), uneven), 1e-6)
        for k, image in enumerate(images):
            lighting = ndimage.gaussian_filter(np.where(deep, image, 0), uneven) / weights  # mean over deep voxels
            squares[k] += float(np.square((image - lighting)[deep], dtype=np.float64).sum())
        count += int(np.count_nonzero(deep))
    if count < _FEWEST:
        return None
    noise, smoothed = np.sqrt(squares / count)
    return float(noise), float(smoothed / max(noise, 1e-30))


def _measure_white_noise(levels: np.ndarray) -> float:
    """Return the deviation of white noise in levels."""
    for axis in range(3):
        levels = np.diff(levels, 2, axis)
    return float(np.median(np.abs(levels))) / _NORMAL_MEDIAN / 6**1.5  # (1, -2, 1) multiplies the deviation by √6


def _smoothing_factor(grain: float, spacing: Sequence[float]) -> float:
    """Return the factor by which smoothing by a voxel of the finest axis lowers the deviation of noise, which is white
    noise that was smoothed by `grain` such voxels."""
    # White noise that is filtered has a deviation proportional to the norm of the filter's response to an impulse.
    impulse, factor = np.eye(1, 65, 32)[0], 1.0
    for edge in spacing:
        width = min(spacing) / edge
        response = ndimage.gaussian_filter(impulse, grain * width)
        factor *= float(np.linalg.norm(ndimage.gaussian_filter(response, width)) / np.linalg.norm(response))
    return factor
