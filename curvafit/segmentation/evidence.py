"""What a scan, a probability map or a few slices say of the inside, and where a surface may start from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline
from skimage.filters import threshold_otsu

from curvafit.units import METRES
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Crop

__all__ = ["VoxelEvidence", "cropped_map", "interpolated_distance", "of_intensities", "of_probability"]

#: Where Otsu's threshold is to be found, grey levels beyond these percentiles count as these.
TAILS = (0.1, 99.9)
#: Contrast between the classes that a smoothed scan's noise may have, as a share; its deviation in voxels, from and to.
QUIET, WIDTHS = 1 / 16, (0.7, 3.0)
#: The least noise that is believed, as a share of the contrast, and the most that a probability is.
LEAST_NOISE, CERTAIN = 0.05, 1e-4
#: Voxels between what is the same place in two files.
ASTRAY = 0.1
#: Classes that Otsu's threshold found with less contrast than so many times the noise may be the noise's own.
FAINT = 1.0


@dataclass(frozen=True, eq=False)
class VoxelEvidence:
    """What each voxel says, and a first guess.

    Attributes
    ----------
    ratio
        float32 (Z, Y, X): log-likelihood ratio of inside to outside, in nats.
    level
        float32, same shape: smooth, positive where the first guess is inside.
    note
        A sentence on what was found.
    """

    ratio: np.ndarray
    level: np.ndarray
    note: str


def of_intensities(scan: Field, threshold: float | str = "otsu", dark: bool = False) -> VoxelEvidence:
    """Two classes of grey levels with one Gaussian noise: r = (g - t) (c₁ - c₀) / σ².

    The scan is smoothed and split by Otsu's threshold; c₀, c₁ and σ are the raw levels' means and pooled deviation on
    either side, t is half way between the means. It is then smoothed anew, as far as the noise asks for. A structure of
    less than 0.1 % of the volume asks for a threshold: Otsu's takes it for a tail of the noise.

    Parameters
    ----------
    threshold
        t, instead; or `"otsu"`.
    dark
        The inside is the dark phase.

    Raises
    ------
    ScanError
        If a value is not finite, or a threshold leaves nothing on one side.
    """
    values = scan.values.astype(np.float32)
    if not np.isfinite(values).all():
        raise ScanError(f"expected finite values, got {np.count_nonzero(~np.isfinite(values))} that are not")
    if isinstance(threshold, str) and threshold != "otsu":
        raise ScanError(f"expected a threshold that is a number or 'otsu', got {threshold!r}")
    found = threshold == "otsu"
    if found and not np.all((values == values.min()) | (values == values.max())):  # a mask's rarer value is no tail
        values = np.clip(values, *np.percentile(values, TAILS))
    smooth = _smoothed(values, scan, WIDTHS[0] + 0.3)
    means, noise = _classes(values, smooth, threshold)
    smooth = _smoothed(values, scan, _width(noise / (means[1] - means[0])))
    means, noise = _classes(values, smooth, threshold)
    contrast = means[1] - means[0]
    middle, sign = sum(means) / 2 if found else float(threshold), -1 if dark else 1
    noise = max(noise, LEAST_NOISE * contrast)
    said = f"classes at {means[0]:.4g} and {means[1]:.4g}, noise {noise:.3g}, split at {middle:.4g}"
    if found and contrast < FAINT * noise:
        said += "; they differ by less than the noise, as where the structure is rare: better give a threshold"
    return VoxelEvidence(sign * (values - middle) * np.float32(contrast / noise**2), sign * (smooth - middle), said)


def of_probability(probability: Field, scan: Field) -> VoxelEvidence:
    """r = log p / (1 - p) of a map (Z, Y, X) in [0, 1].

    Raises
    ------
    ScanError
        If its shape or place is not the scan's or it leaves [0, 1].
    """
    if probability.shape != scan.shape:
        raise ScanError(f"expected a probability map of the scan's shape {scan.shape}, got {probability.shape}")
    _check_place(probability, scan)
    values = probability.values.astype(np.float32)
    lowest, highest = float(values.min()), float(values.max())
    if not 0 <= lowest <= highest <= 1:
        raise ScanError(f"expected probabilities in [0, 1], got {lowest:g} to {highest:g}")
    p = values.clip(CERTAIN, 1 - CERTAIN)
    said = f"probabilities from {lowest:.3g} to {highest:.3g}"
    return VoxelEvidence(np.log(p / (1 - p)), _smoothed(values, scan, WIDTHS[0]) - 0.5, said)


def cropped_map(probability: Field, crop: Crop | None) -> Field:
    """Return a map's part that belongs to the same crop of its scan; a map without a place stays one without."""
    if crop is None:
        return probability
    part = probability.crop(crop)
    return part if probability.affine is not None else replace(part, affine=None)


def _check_place(other: Field, scan: Field) -> None:
    """Raise if the affines, where both have one, part by more than `ASTRAY` at a corner."""
    if scan.affine is None or other.affine is None:
        return
    factor = METRES[other.unit] / METRES[scan.unit] if {other.unit, scan.unit} <= METRES.keys() else 1.0
    corners = np.array(list(product(*((0, n - 1) for n in scan.shape[::-1]))))
    one, two = (corners @ affine[:3, :3].T + affine[:3, 3] for affine in (scan.affine, other.affine))
    far = float(np.linalg.norm(factor * two - one, axis=1).max()) / min(scan.spacing)
    if not far < ASTRAY:
        raise ScanError(f"expected a probability map with the scan's affine, got one {far:.3g} voxels away")


def interpolated_distance(
    slices: np.ndarray, places: Sequence[int], length: int, spacing: Sequence[float]
) -> np.ndarray:
    """Signed distance (length, Y, X) between known masks (N, Y, X) at `places` along the first axis.

    Each mask's own distance within its plane, positive inside; between them the natural cubic spline (a line between
    two), beyond the first and last the nearest. An empty mask is outside by the largest gap between slices.
    """
    gap = float(np.diff(places).max()) * spacing[0]
    known = np.stack([_plane_distance(mask, spacing[1:], gap) for mask in slices])
    where = np.arange(length).clip(places[0], places[-1])
    return CubicSpline(places, known, bc_type="natural")(where).astype(np.float32)


def _plane_distance(mask: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    if not mask.any() or mask.all():
        return np.full(mask.shape, gap if mask.any() else -gap)
    inner, outer = (np.asarray(ndimage.distance_transform_edt(side, sampling=spacing)) for side in (mask, ~mask))
    half = min(spacing) / 2
    return np.where(mask, inner - half, half - outer)


def _smoothed(values: np.ndarray, scan: Field, width: float) -> np.ndarray:
    """By so many voxels of the finest axis, truncated at three deviations."""
    finest = min(scan.spacing)
    return ndimage.gaussian_filter(values, [width * finest / h for h in scan.spacing], mode="nearest", truncate=3.0)


def _width(noise: float) -> float:
    """Deviation in voxels of the Gaussian that lowers white noise to `QUIET`: by (4π)^¾ w^1.5."""
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
