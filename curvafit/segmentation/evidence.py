"""Evidence of the inside in a scan or a probability map, and a first guess of the surface."""

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
#: Contrast, in units of the noise, below which the classes of Otsu's threshold may be noise.
FAINT = 1.0


@dataclass(frozen=True, eq=False)
class VoxelEvidence:
    """Evidence of each voxel, and a first guess.

    Attributes
    ----------
    ratio
        float32 (Z, Y, X): log-likelihood ratio of inside to outside, in nats.
    level
        float32 (Z, Y, X): smooth, positive inside the first guess.
    note
        A sentence on the classes.
    """

    ratio: np.ndarray
    level: np.ndarray
    note: str


@dataclass(frozen=True)
class Classes:
    """Two phases of a scan: mean grey levels outside and inside, one Gaussian noise, and the level that splits them."""

    outside: float
    inside: float
    noise: float
    middle: float

    @property
    def contrast(self) -> float:
        """Return the difference of the means, negative where the structure is dark."""
        return self.inside - self.outside

    @property
    def faint(self) -> bool:
        """Return whether the means differ by so little that they may be noise."""
        return abs(self.contrast) < FAINT * self.noise

    def __str__(self) -> str:
        low, high = sorted((self.outside, self.inside))
        return f"classes at {low:.4g} and {high:.4g}, noise {self.noise:.3g}, split at {self.middle:.4g}"


def grey_levels(scan: Field, threshold: float | str = "otsu") -> np.ndarray:
    """Return a scan's grey levels, float32, without its tails where Otsu's threshold is to split them."""
    values = scan.values.astype(np.float32)
    return values.clip(*grey_bounds(values, threshold))


def grey_bounds(values: np.ndarray, threshold: float | str = "otsu") -> tuple[float, float]:
    """Return the levels between which Otsu's threshold takes grey levels as they are; infinite ones for a number."""
    if threshold == "otsu" and not np.all((values == values.min()) | (values == values.max())):
        low, high = np.percentile(values, TAILS)  # a mask's rarer value is no tail
        return float(low), float(high)
    return -math.inf, math.inf


def estimate_classes(values: np.ndarray, scan: Field, threshold: float | str = "otsu", dark: bool = False) -> Classes:
    """Return the classes of grey levels on either side of Otsu's threshold of the smoothed scan: means and pooled
    deviation of the raw levels, and the split half way between the means.

    The scan is then smoothed again, by a width that depends on the noise. A structure of less than 0.1 % of the volume
    needs a threshold: Otsu's takes such a structure for a tail of the noise.

    Parameters
    ----------
    threshold
        The split, or `"otsu"`.
    dark
        Whether the inside is the dark phase.
    """
    means, noise = _classes(values, _smoothed(values, scan, WIDTHS[0] + 0.3), threshold)
    means, noise = _classes(values, _smoothed(values, scan, _width(noise / (means[1] - means[0]))), threshold)
    middle = sum(means) / 2 if threshold == "otsu" else float(threshold)
    outside, inside = means[::-1] if dark else means
    return Classes(outside, inside, max(noise, LEAST_NOISE * (means[1] - means[0])), middle)


def grey_evidence(values: np.ndarray, scan: Field, classes: Classes, known: np.ndarray | None = None) -> VoxelEvidence:
    """Return the evidence of grey levels (Z, Y, X) with known classes: r = (g - t) (c₁ - c₀) / σ².

    Parameters
    ----------
    known
        Voxels whose grey levels count, bool (Z, Y, X), all by default: others have no evidence.
    """
    steep, sign = np.float32(classes.contrast / classes.noise**2), -1 if classes.contrast < 0 else 1
    ratio, width = (values - np.float32(classes.middle)) * steep, _width(classes.noise / abs(classes.contrast))
    if known is None:
        level = _smoothed(values, scan, width) - np.float32(classes.middle)
    else:
        ratio = np.where(known, ratio, np.float32(0))
        weight = np.maximum(_smoothed(known.astype(np.float32), scan, width), np.float32(1e-6))
        level = _smoothed(np.where(known, values - np.float32(classes.middle), np.float32(0)), scan, width) / weight
    return VoxelEvidence(ratio, sign * level, str(classes))


def probability_evidence(probability: Field) -> VoxelEvidence:
    """Return the evidence of a probability map (Z, Y, X) in [0, 1]: r = log p / (1 - p), and p - 1/2 as first guess.

    Raises
    ------
    ScanError
        If a value lies outside [0, 1].
    """
    values = probability.values.astype(np.float32)
    lowest, highest = float(values.min()), float(values.max())
    if not 0 <= lowest <= highest <= 1:
        source = f" in {probability.source}" if probability.source else ""
        raise ScanError(f"expected probabilities in [0, 1], got {lowest:g} to {highest:g}{source}")
    p = values.clip(CERTAIN, 1 - CERTAIN)
    note = f"probabilities from {lowest:.3g} to {highest:.3g}"
    return VoxelEvidence(np.log(p / (1 - p)), values - np.float32(0.5), note)


def _smoothed(values: np.ndarray, scan: Field, width: float) -> np.ndarray:
    """Return the values after a Gaussian of a width in voxels of the finest axis, truncated at three deviations."""
    finest = min(scan.spacing)
    return ndimage.gaussian_filter(values, [width * finest / h for h in scan.spacing], mode="nearest", truncate=3.0)


def _width(noise: float) -> float:
    """Return the deviation w, in voxels, of the Gaussian that lowers white noise to `QUIET`: by (4π)^¾ w^1.5."""
    return float(np.clip((noise / QUIET / (4 * math.pi) ** 0.75) ** (2 / 3), *WIDTHS))


def _classes(values: np.ndarray, smooth: np.ndarray, threshold: float | str) -> tuple[tuple[float, float], float]:
    level = float(threshold_otsu(smooth)) if threshold == "otsu" else float(threshold)
    bright = smooth > level
    share = float(bright.mean())
    if share in (0.0, 1.0):
        raise ScanError(
            f"expected a threshold within the smoothed scan's {smooth.min():.4g} to {smooth.max():.4g}, got {level:.4g}"
        )
    inside, outside = values[bright], values[~bright]
    pooled = share * inside.var(dtype=np.float64) + (1 - share) * outside.var(dtype=np.float64)
    means = float(outside.mean(dtype=np.float64)), float(inside.mean(dtype=np.float64))
    return means, math.sqrt(pooled)
