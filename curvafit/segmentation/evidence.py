"""The log-likelihood ratio of inside to outside in each voxel of a scan or probability map, and a first guess.

The noise of single voxels sets how far grey levels are smoothed before they are split. `scan.structure` splits them
otherwise, on purpose: see there.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.special import expit
from skimage.filters import threshold_otsu

from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Box, Crop, ScanError, Volume, cut_boxes, digest_of

#: Percentiles to which grey levels are clipped for Otsu's threshold.
TAILS = (0.1, 99.9)
#: Most noise of a smoothed scan, as a fraction of the contrast; least and greatest width of the smoothing, in voxels.
QUIET, WIDTHS = 1 / 16, (0.7, 3.0)
#: Least noise, as a fraction of the contrast; least distance of a probability from 0 and 1.
LEAST_NOISE, CERTAIN = 0.05, 1e-4
#: Probabilities may lie so far beyond 0 and 1.
_STRAY = 1e-3
#: Contrast, in units of the noise, below which the classes of Otsu's threshold may be noise.
FAINT = 1.0
#: Contrast, in units of the noise, below which classes are measured again; voxels from the surface at which that is
#: done, and the fewest voxels of a class there.
OVERLAP, DEEP, FEWEST = 0.5, 2, 100
#: A sample has at most so many runs of neighbouring voxels along each axis, each so long.
RUNS, LONG = 4, 64
#: Endings of an image beside an NPZ file of the same name, which says where the voxels are.
IMAGES = (".nii.gz", ".nii", ".nrrd", ".mha", ".mhd", ".tif", ".tiff")


@dataclass(frozen=True, eq=False)
class VoxelEvidence:
    """The log-likelihood `ratio` of inside to outside, in nats, and a smooth `level`, positive inside the first guess:
    both float32 (Z, Y, X)."""

    ratio: np.ndarray
    level: np.ndarray

    def of_box(self, box: Box) -> VoxelEvidence:
        """Return the evidence of a box of voxels."""
        return VoxelEvidence(self.ratio[box], self.level[box])

    @cached_property
    def digest(self) -> str:
        """A text that changes with the content."""
        return digest_of(self.ratio)


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


@dataclass(frozen=True, eq=False)
class GreyEvidence:
    """The evidence of a scan of grey levels, computed box by box: levels are clipped to `bounds`, split by the classes
    `first` for the first guess, and weighed by the `classes`."""

    volume: Volume
    bounds: tuple[float, float]
    first: Classes
    classes: Classes

    @classmethod
    def of(
        cls, volume: Volume, threshold: float | str = "otsu", dark: bool = False, apart: bool = False
    ) -> GreyEvidence:
        """Measure a scan's classes on a sample of it; with `apart`, measure classes that overlap a second time. A
        threshold of noisy levels leaves some of each phase on either side, which brings the two means together: at
        `DEEP` voxels from the first guess of the surface few voxels are on the wrong side."""
        sample, _ = subsample(volume)
        levels = sample.values.astype(np.float32)
        bounds = grey_bounds(levels, threshold)
        levels = levels.clip(*bounds)
        first = classes = estimate_classes(levels, sample, threshold, dark)
        if apart and threshold == "otsu" and abs(classes.contrast) < OVERLAP * classes.noise:
            inside = grey_evidence(levels, sample, classes).level > 0
            erode = partial(ndimage.binary_erosion, iterations=DEEP, border_value=1)
            cores = [levels[np.asarray(erode(phase), dtype=bool)] for phase in (~inside, inside)]
            if min(map(len, cores)) >= FEWEST:
                outer, inner = (float(core.mean(dtype=np.float64)) for core in cores)
                classes = replace(classes, outside=outer, inside=inner, middle=(outer + inner) / 2)
        return cls(volume, bounds, first, classes)

    def of_box(self, box: Box) -> VoxelEvidence:
        """Return the evidence of a box of voxels."""
        values = self.volume.read(box).astype(np.float32).clip(*self.bounds)
        level = grey_evidence(values, self.volume, self.first).level / np.float32(abs(self.first.contrast))
        return VoxelEvidence(grey_ratio(values, self.classes), level)

    @property
    def digest(self) -> str:
        """A text that changes with the content."""
        return f"{self.volume.digest}, {self.first}, {self.classes}"


#: The evidence of a volume, in memory or computed box by box.
VolumeEvidence = VoxelEvidence | GreyEvidence


def grey_bounds(values: np.ndarray, threshold: float | str = "otsu") -> tuple[float, float]:
    """Return the bounds to which grey levels are clipped before Otsu's threshold; infinite for a given threshold."""
    if threshold == "otsu" and not np.all((values == values.min()) | (values == values.max())):
        low, high = np.percentile(values, TAILS)  # a mask's rarer value is no tail
        return float(low), float(high)
    return -math.inf, math.inf


def estimate_classes(values: np.ndarray, scan: Volume, threshold: float | str = "otsu", dark: bool = False) -> Classes:
    """Split the smoothed scan at a threshold, and measure the raw levels on either side: means and pooled deviation.
    The second time, the noise of the first sets the width of the smoothing. With `"otsu"` the classes are split half
    way between their means. A structure of less than 0.1 % of the volume needs a given threshold, since Otsu's takes it
    for a tail of the noise."""
    means, noise = _split(values, _smooth(values, scan, WIDTHS[0] + 0.3), threshold)
    width = _smoothing_width(noise / (means[1] - means[0]))
    means, noise = _split(values, _smooth(values, scan, width), threshold)
    middle = sum(means) / 2 if threshold == "otsu" else float(threshold)
    outside, inside = means[::-1] if dark else means
    return Classes(outside, inside, max(noise, LEAST_NOISE * (means[1] - means[0])), middle)


def grey_evidence(values: np.ndarray, scan: Volume, classes: Classes) -> VoxelEvidence:
    """Return the evidence of grey levels (Z, Y, X): `grey_ratio`, and smoothed levels to start from."""
    level = _smooth(values, scan, _smoothing_width(classes.noise / abs(classes.contrast))) - np.float32(classes.middle)
    return VoxelEvidence(grey_ratio(values, classes), -level if classes.contrast < 0 else level)


def grey_ratio(values: np.ndarray, classes: Classes) -> np.ndarray:
    """Return the log-likelihood ratio of inside to outside: (g - t) (c₁ - c₀) / σ² of grey levels g with the middle t,
    means c₁ inside and c₀ outside, and noise σ."""
    return (values - np.float32(classes.middle)) * np.float32(classes.contrast / classes.noise**2)


def probability_evidence(probability: Volume) -> VoxelEvidence:
    """Return the evidence of probabilities (Z, Y, X): r = log p / (1 - p), and p - 1/2 as level. Values within 1e-3 of
    [0, 1], as resampling leaves them, are cut to it; raises `ScanError` if one lies farther off."""
    values = probability.values.astype(np.float32)
    lowest, highest = float(values.min()), float(values.max())
    if not -_STRAY <= lowest <= highest <= 1 + _STRAY:
        source = f" in {probability.source}" if probability.source else ""
        raise ScanError(f"probabilities must lie in [0, 1], got {lowest:g} to {highest:g}{source}")
    p = values.clip(CERTAIN, 1 - CERTAIN)
    return VoxelEvidence(np.log(p / (1 - p)), values.clip(0, 1) - np.float32(0.5))


def _smooth(values: np.ndarray, scan: Volume, width: float) -> np.ndarray:
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
    fraction = float(bright.mean())
    if fraction in (0.0, 1.0):
        lowest, highest = smooth.min(), smooth.max()
        raise ScanError(
            f"the threshold must lie within the smoothed scan's {lowest:.4g} to {highest:.4g}, got {level:.4g}"
        )
    above, below = values[bright], values[~bright]
    variance = fraction * above.var(dtype=np.float64) + (1 - fraction) * below.var(dtype=np.float64)
    means = float(below.mean(dtype=np.float64)), float(above.mean(dtype=np.float64))
    return means, math.sqrt(variance)


def subsample(volume: Volume) -> tuple[Volume, list[Box]]:
    """Return a sample of a volume, without an affine, and the boxes of the sample in which voxels are neighbours. Along
    an axis of more than `RUNS` x `LONG` voxels, the sample has `RUNS` runs of `LONG` voxels, from the middles of equal
    parts; along a shorter one it has all voxels."""
    runs = []
    for n in volume.shape:
        starts = [(2 * k + 1) * n // (2 * RUNS) - LONG // 2 for k in range(RUNS)]
        runs.append([slice(start, start + LONG) for start in starts] if n > RUNS * LONG else [slice(0, n)])
    # The runs, which are of one length along an axis, lie end to end in the sample.
    shape = [sum(run.stop - run.start for run in axis) for axis in runs]
    sample = np.empty(shape, volume.dtype)
    boxes = cut_boxes(shape, [axis[0].stop - axis[0].start for axis in runs])
    for box, (z, y, x) in zip(boxes, product(*runs), strict=True):
        sample[box] = volume.read((z, y, x))
    return replace(volume, array=sample, affine=None), boxes


def load_probabilities(
    source: Source,
    *,
    like: str | os.PathLike[str] | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    crop: Crop | None = None,
    logits: bool = False,
    **reading: Any,
) -> Volume:
    """Load a network's probabilities, with spacing and affine of `like`, an image of the same voxels, if there is one.
    See `segment` for the parameters. Raises `ScanError` if the image has another shape, or both an image and a spacing
    or unit are given."""
    stated = spacing is not None or unit is not None
    if like is not None and stated:
        raise ScanError("give either an image that says where the voxels are, or a spacing and unit, got both")
    image = find_image(source) if like is None and not stated else like
    if image is None:
        field = load(source, spacing=spacing, unit=unit, crop=crop, **reading)
    else:
        grid = load(image, lazy=True)
        field = load(source, spacing=grid.spacing, unit=grid.unit, **reading)
        if field.shape != grid.shape:
            raise ScanError(f"the probabilities must have the shape {grid.shape} of {image}, got {field.shape}")
        field = replace(field, affine=grid.affine, notes=(*field.notes, f"The voxels are those of {image}."))
        field = field if crop is None else field.crop(crop)
    return replace(field, array=expit(field.values.astype(np.float32))) if logits else field


def find_image(source: Source) -> Path | None:
    """Return the image of the same name beside an NPZ file; None where there is none, or for another source."""
    if not isinstance(source, str | os.PathLike) or not os.fspath(source).lower().endswith(".npz"):
        return None
    stem = os.fspath(source)[: -len(".npz")]
    paths = (Path(stem + suffix) for suffix in IMAGES)
    return next((path for path in paths if path.is_file()), None)
