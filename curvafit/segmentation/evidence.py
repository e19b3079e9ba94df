"""What each voxel of a scan or a probability map says of being inside, and a first guess of the surface.

The noise of single voxels decides how far grey levels are smoothed before they are split. `scan.structure` splits them
otherwise, on purpose: see there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from curvafit.volumes.field import Field, ScanError

#: Percentiles to which grey levels are clipped for Otsu's threshold.
TAILS = (0.1, 99.9)
#: Most noise of a smoothed scan, as a share of the contrast; least and greatest deviation of the smoothing, in voxels.
QUIET, WIDTHS = 1 / 16, (0.7, 3.0)
#: Least noise, as a share of the contrast; least distance of a probability from 0 and 1.
LEAST_NOISE, CERTAIN = 0.05, 1e-4
#: Probabilities may lie so far beyond 0 and 1.
_STRAY = 1e-3
#: Contrast, in units of the noise, below which the classes of Otsu's threshold may be noise.
FAINT = 1.0


@dataclass(frozen=True, eq=False)
class VoxelEvidence:
    """The log-likelihood `ratio` of inside to outside, in nats, and a smooth `level`, positive inside the first guess:
    both float32 (Z, Y, X)."""

    ratio: np.ndarray
    level: np.ndarray


@dataclass(frozen=True)
class Classes:
    """The mean grey levels outside and inside, the deviation of the noise, and the level that splits the phases."""

    outside: float
    inside: float
    noise: float
    middle: float

    @property
    def contrast(self) -> float:
        """The difference of the means, negative where the structure is dark."""
        return self.inside - self.outside

    @property
    def faint(self) -> bool:
        """Whether the means differ by so little that the classes may be noise."""
        return abs(self.contrast) < FAINT * self.noise

    def __str__(self) -> str:
        low, high = sorted((self.outside, self.inside))
        return f"classes at {low:.4g} and {high:.4g}, noise {self.noise:.3g}, split at {self.middle:.4g}"


def grey_levels(scan: Field, threshold: float | str = "otsu") -> np.ndarray:
    """Return a scan's grey levels as float32, clipped to `grey_bounds`."""
    values = scan.values.astype(np.float32)
    return values.clip(*grey_bounds(values, threshold))


def grey_bounds(values: np.ndarray, threshold: float | str = "otsu") -> tuple[float, float]:
    """Return the levels to which grey levels are clipped before Otsu's threshold splits them; infinite for a given
    threshold."""
    if threshold == "otsu" and not np.all((values == values.min()) | (values == values.max())):
        low, high = np.percentile(values, TAILS)  # a mask's rarer value is no tail
        return float(low), float(high)
    return -math.inf, math.inf


def estimate_classes(values: np.ndarray, scan: Field, threshold: float | str = "otsu", dark: bool = False) -> Classes:
    """Split the smoothed scan at a threshold, and measure the raw levels on either side: means and pooled deviation.

    This is done twice: the noise found first sets the width of the smoothing then. With `"otsu"` the classes are split
    half way between their means. A structure of less than 0.1 % of the volume needs a given threshold, since Otsu's
    takes it for a tail of the noise.
    """
    means, noise = _split(values, _smooth(values, scan, WIDTHS[0] + 0.3), threshold)
    width = _smoothing_width(noise / (means[1] - means[0]))
    means, noise = _split(values, _smooth(values, scan, width), threshold)
    middle = sum(means) / 2 if threshold == "otsu" else float(threshold)
    outside, inside = means[::-1] if dark else means
    return Classes(outside, inside, max(noise, LEAST_NOISE * (means[1] - means[0])), middle)


def grey_evidence(values: np.ndarray, scan: Field, classes: Classes, known: np.ndarray | None = None) -> VoxelEvidence:
    """Return the log-likelihood ratio, inside to outside, of grey levels (Z, Y, X), and smoothed levels to start from.

    r = (g - t) (c₁ - c₀) / σ² with grey level g, middle t, means c₁ inside and c₀ outside, and noise σ. Voxels outside
    `known`, bool (Z, Y, X), have the ratio 0, and a level smoothed in from their neighbours.
    """
    steep, sign = np.float32(classes.contrast / classes.noise**2), -1 if classes.contrast < 0 else 1
    ratio, width = (
        (values - np.float32(classes.middle)) * steep,
        _smoothing_width(classes.noise / abs(classes.contrast)),
    )
    if known is None:
        level = _smooth(values, scan, width) - np.float32(classes.middle)
    else:
        ratio = np.where(known, ratio, np.float32(0))
        weight = np.maximum(_smooth(known.astype(np.float32), scan, width), np.float32(1e-6))
        level = _smooth(np.where(known, values - np.float32(classes.middle), np.float32(0)), scan, width) / weight
    return VoxelEvidence(ratio, sign * level)


def probability_evidence(probability: Field) -> VoxelEvidence:
    """Return the evidence of probabilities (Z, Y, X): r = log p / (1 - p), and p - 1/2 as level.

    Values within 1e-3 of [0, 1], as resampling leaves them, are cut to it; raises `ScanError` if one lies farther off.
    """
    values = probability.values.astype(np.float32)
    lowest, highest = float(values.min()), float(values.max())
    if not -_STRAY <= lowest <= highest <= 1 + _STRAY:
        source = f" in {probability.source}" if probability.source else ""
        raise ScanError(f"probabilities must lie in [0, 1], got {lowest:g} to {highest:g}{source}")
    p = values.clip(CERTAIN, 1 - CERTAIN)
    return VoxelEvidence(np.log(p / (1 - p)), values.clip(0, 1) - np.float32(0.5))


def _smooth(values: np.ndarray, scan: Field, width: float) -> np.ndarray:
    """Smooth by a Gaussian whose deviation is `width` voxels of the finest axis."""
    finest = min(scan.spacing)
    return ndimage.gaussian_filter(values, [width * finest / h for h in scan.spacing], mode="nearest", truncate=3.0)


def _smoothing_width(noise: float) -> float:
    """Return the deviation w of the Gaussian, in voxels, that lowers white noise to `QUIET`: it divides it by
    (4π)^¾ w^1.5."""
    return float(np.clip((noise / QUIET / (4 * math.pi) ** 0.75) ** (2 / 3), *WIDTHS))


def _split(values: np.ndarray, smooth: np.ndarray, threshold: float | str) -> tuple[tuple[float, float], float]:
    """Return the means of the levels below and above a threshold of the smoothed ones, and their pooled deviation."""
    level = float(threshold_otsu(smooth)) if threshold == "otsu" else float(threshold)
    bright = smooth > level
    share = float(bright.mean())
    if share in (0.0, 1.0):
        lowest, highest = smooth.min(), smooth.max()
        raise ScanError(
            f"the threshold must lie within the smoothed scan's {lowest:.4g} to {highest:.4g}, got {level:.4g}"
        )
    inside, outside = values[bright], values[~bright]
    pooled = share * inside.var(dtype=np.float64) + (1 - share) * outside.var(dtype=np.float64)
    means = float(outside.mean(dtype=np.float64)), float(inside.mean(dtype=np.float64))
    return means, math.sqrt(pooled)
