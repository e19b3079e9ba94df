"""What in a scan is structure, how blurred it is and how noisy.

`find_structure` decides the kind of a scan and splits structure from background. `Quality` is how the scan blurs and
how noisy it is, measured from its grey levels (`measure_quality`), and images a grown shape alike (`Quality.image`).

Two rooms split grey levels otherwise, on purpose. `segmentation.evidence` needs the noise of each voxel: it smooths as
far as the noise asks, and splits half way between the means of the raw levels. `data_synth.imaging` follows brightness
that varies along a structure. Here thin structures must not grow fat: smoothed levels are split at the raw ones'
threshold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from curvafit.core.checks import SEEDS, check_choice, check_float, check_int
from curvafit.scan.grids import boxes_by_surface, centre_distance, resample, surface_voxels
from curvafit.volumes.boxes import Box, Crop
from curvafit.volumes.place import lay
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import ScanError, Volume, round_labels

Kind = Literal["field", "mask", "image"]

#: Median third difference of neighbours from which values are noisy; fields rounded to 1/100 reach 0.02.
JITTER = 0.045
#: The share of a phase field's voxels that lie in its plateaus, further from 0 than this.
PLATEAUS, PLATEAU = 0.6, 0.35
#: Offsets in scan voxels, beyond the reach of smoothing, and the correlation that noise stays below there.
LAGS, UNCORRELATED = (4, 5, 6, 7, 8), 0.06
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
_DEEP, _FEWEST, _UNEVEN = 3.5, 500, 4.0
#: Voxels that smoothing grey levels reaches.
SMOOTHED = 3
#: Median of the absolute value of a normal number.
_NORMAL_MEDIAN = 0.6745
#: Smoothed noise over contrast, and slices' thickness over the finest edge, from which on a scan is worse than a mask.
NOISY, SLICED = 0.02, 1.5
#: The least share of neighbours with labels that have the same one.
_ALIKE = 0.25
#: The most values of labels: grey levels of four bits have more.
_FEW = 12
#: About so many voxels tell, first, whether a volume has more values.
_SAMPLED = 4096
#: What structure is in a mask of several values.
SEVERAL = (
    "Taken for a mask or labels: the structure is where they are positive. Naming a label (label) measures it alone, "
    "and kind image splits grey levels."
)
#: A constant may be padding where it fills more than the first share of the scan, and the second share of it is reached
#: from the ends of rows. Other levels have two phases from this bimodality on.
PADDED, REACHED, TWO_PHASES = 0.1, 0.95, 0.45
#: A field of a few thousand values was rounded.
_ROUNDED_VALUES = 4096


def find_structure(
    field: Volume,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    region: np.ndarray | None = None,
    periodic: bool = False,
    extremes: tuple[float, float] | None = None,
) -> tuple[Kind, Volume]:
    """Return the kind of a scan, and the scan as float32 values that are above 0 in its structure, with notes on how.

    The parameters are as in `prepare.prepare`; `extremes` are the lowest and highest value of the whole that `field` is
    a part of: they tell a mask's two values. Raises ScanError if the threshold splits nothing or a phase is empty.
    """
    values = field.values
    lowest, highest = (values.min(), values.max()) if extremes is None else extremes
    two = bool(np.all((values == lowest) | (values == highest)))
    seen = _guess_kind(values, threshold, two) if kind == "auto" else kind
    if seen == "field":
        note = f"Taken for a phase field: values {values.min():.3g} to {values.max():.3g}."
        values = (-values if dark else values).astype(np.float32)
    elif seen == "mask":
        note = f"Taken for a mask of the values {float(lowest):g} and {float(highest):g}." if two else SEVERAL
        mask = values == highest if two and lowest < highest else values > 0
        values = np.where(mask != dark, np.float32(1), np.float32(-1))
    else:
        padding, corner = None, values[0, 0, 0]
        if np.count_nonzero(values == corner) > PADDED * values.size:
            padding = judge_padding(corner, count_constant(values, corner))
        values, note = _split_image(field, threshold, dark, region, periodic, padding)
        note = " ".join([*describe_padding(padding, threshold == "otsu", region is not None), note])
    counted = values > 0 if region is None else values[region] > 0
    if not counted.any():
        raise ScanError("expected a structure in the scan, got none: every voxel is background")
    if counted.all():
        raise ScanError("expected background in the scan, got none: every voxel is structure")
    return seen, replace(field, array=values, notes=(*field.notes, note))


def check_options(kind: str, threshold: float | str, label: int | None = None) -> None:
    """Raise ValueError where a kind, threshold or label is none, or contradicts another."""
    check_choice(kind, ("auto", "field", "mask", "image"), "kind auto, field, mask or image")
    otsu = isinstance(threshold, str) and threshold == "otsu"
    level = "otsu" if otsu else check_float(threshold, "a threshold that is a number or 'otsu'")
    if label is not None:
        check_int(label, "a label that is a whole number", -SEEDS, 2 * SEEDS - 1)
        if kind in ("field", "image") or level != "otsu":
            raise ValueError("a label states the structure: leave out kind and threshold, got both")
    if kind in ("field", "mask") and level != "otsu":
        raise ValueError(f"a threshold splits grey levels: leave it out for kind {kind}")


def read_region(
    roi: Source, field: Volume, scan: Source | None = None, crop: Crop | None = None, **reading: Any
) -> tuple[Volume, tuple[str, ...]]:
    """Return a region of interest on the voxels of a field, and a note on how it was laid.

    A field that is a crop of a scan names that, and its reading: without a place, the region is cropped alike. Raises
    ScanError where the region is empty, and as `lay`.
    """
    region, on = load(roi), field if crop is None or scan is None else load(scan, **reading, lazy=True)
    if region.affine is not None and on.affine is not None:
        on, crop = field, None
    region, notes = lay(region, on, "the region of interest", "the scan")
    values = region.values if crop is None else region.crop(crop).values
    if not values.any():
        raise ScanError("expected a region of interest with voxels in it, got an empty one")
    return replace(field, array=values, notes=notes), notes


def read_labels(labels: Volume, what: str) -> np.ndarray:
    """Return a volume's labels, whole numbers (Z, Y, X); ScanError if all are 0, or the values are grey levels."""
    rounded = round_labels(labels.values)
    values = rounded.astype(np.int64) if rounded.dtype.kind == "f" else rounded
    left, right = values[..., :-1], values[..., 1:]
    pairs = (left != 0) & (right != 0)
    if not values.any():
        raise ScanError(f"expected {what}, got none: every voxel is 0")
    alike = np.count_nonzero(pairs & (left == right)) >= _ALIKE * np.count_nonzero(pairs)
    if not alike or (values != rounded).any():
        raise ScanError(f"expected {what}, whole numbers that neighbours share, got grey levels")
    return values


def is_noise(mask: np.ndarray) -> bool:
    """Return whether voxels a few apart have nothing to do with each other, along each axis."""
    z, y, x = (slice(0, n) for n in mask.shape)
    return pairs_of_noise(mask.shape, float(mask.mean()), count_pairs(mask, (z, y, x), (z, y, x), mask.shape))


def count_pairs(mask: np.ndarray, inner: Box, core: Box, shape: Sequence[int]) -> np.ndarray:
    """Return, for each axis and each of `LAGS`, how many pairs a lag apart, that begin in a core of a volume, are
    inside, how many first and last ones; the core lies at `inner` in the mask."""
    counts = np.zeros((3, len(LAGS), 3), dtype=np.int64)
    for axis, (edge, n) in enumerate(zip(inner, shape, strict=True)):
        start = core[axis].start
        for k, lag in enumerate(LAGS):
            stop = edge.start + max(0, min(core[axis].stop, n - lag) - start)
            here = [*inner]
            here[axis] = slice(edge.start, stop)
            there = [*inner]
            there[axis] = slice(edge.start + lag, stop + lag)
            first, last = mask[tuple(here)], mask[tuple(there)]
            counts[axis, k] = [np.count_nonzero(first & last), np.count_nonzero(first), np.count_nonzero(last)]
    return counts


def pairs_of_noise(shape: Sequence[int], share: float, pairs: np.ndarray) -> bool:
    """Return whether `count_pairs` of a volume of a shape, of which a share is inside, are those of noise."""
    for axis, n in enumerate(shape):
        for k, lag in enumerate(LAGS):
            if n <= 2 * lag:
                continue
            both, first, last = pairs[axis, k] / (math.prod(shape) / n * (n - lag))
            if abs(both - first * last) > UNCORRELATED * share * (1 - share):
                return False
    return True


def is_rounded(u: np.ndarray) -> bool:
    """Return whether a field holds so few values that it was quantised: second differences of it are then noise."""
    return len(np.unique(np.asarray(u))) <= min(_ROUNDED_VALUES, math.prod(u.shape) // 16)


def _guess_kind(values: np.ndarray, threshold: Literal["otsu"] | float, two: bool) -> Kind:
    """Guess the kind: two values are a mask, as are labels; floats from about -1 to about 1, without noise and mostly
    far from 0, are a phase field; anything else is an image."""
    if two or (threshold == "otsu" and are_labels(list_values(values))):
        return "mask"
    if may_be_field(values.dtype, threshold, values.min(), values.max()):
        jitter = float(np.median(np.abs(np.diff(values, 3, axis=2)))) if values.shape[2] > 3 else 0.0
        if jitter < JITTER and np.count_nonzero(np.abs(values) > PLATEAU) > PLATEAUS * values.size:
            return "field"
    return "image"


def may_be_field(dtype: np.dtype, threshold: Literal["otsu"] | float, lowest: float, highest: float) -> bool:
    """Return whether a phase field may have this type of numbers and these extremes."""
    return dtype.kind == "f" and threshold == "otsu" and -2 <= lowest <= -0.7 and 0.3 <= highest <= 2


def list_values(values: np.ndarray) -> np.ndarray:
    """Return the values of a volume, ascending, or some of them where they are more than labels have."""
    some = np.unique(values.ravel()[:: 1 + values.size // _SAMPLED])
    return (some if len(some) > _FEW else np.unique(values))[: _FEW + 1]


def are_labels(found: np.ndarray) -> bool:
    """Return whether `list_values` of a volume are those of labels: few whole numbers from 0."""
    return 2 < len(found) <= _FEW and bool(found[0] >= 0 and (found == np.rint(found)).all())


class Padding(NamedTuple):
    """A constant around what was imaged, its share of the scan, the deviation of the other levels, and whether it is
    `sure` that it is no background."""

    value: float
    share: float
    deviation: float
    sure: bool


def count_constant(values: np.ndarray, value: Any) -> np.ndarray:
    """Return sums that tell padding with a value, from whole rows (Z, Y, X): how many voxels have it, and how many in
    runs from the ends of rows; then sums of powers 0 to 4 of the levels next to those runs, and of all others."""
    constant = values == value
    ahead = np.logical_and.accumulate(constant, axis=2)
    behind = np.logical_and.accumulate(constant[..., ::-1], axis=2)[..., ::-1]
    rim = np.zeros_like(constant)
    rim[..., 1:] = ahead[..., :-1]
    rim[..., :-1] |= behind[..., 1:]
    levels = [values[part].astype(np.float64) for part in (rim & ~constant, ~constant)]
    sums = [np.count_nonzero(constant), np.count_nonzero(ahead | behind)]
    with np.errstate(all="ignore"):  # huge numbers tell nothing
        for each in levels:
            squares = np.square(each)
            sums += [each.size, each.sum(), squares.sum(), np.dot(squares, each), np.dot(squares, squares)]
    return np.array(sums, dtype=np.float64)


def judge_padding(value: Any, counts: np.ndarray) -> Padding | None:
    """Return the padding of a scan by its `count_constant`; None where there is none.

    It is sure where the other levels have two phases (Sarle's coefficient; of a normal distribution it is 1/3), and
    what lies next to it is like them; or is far from it, and it is below 0, to which no background is cut. A background
    ends in the low levels of blurred edges.
    """
    total, reached, size = counts[0], counts[1], counts[0] + counts[7]
    if total <= PADDED * size or reached < REACHED * total or total == size:
        return None
    near, m, (p2, p3, p4) = counts[3] / max(counts[2], 1), counts[8] / counts[7], counts[9:] / counts[7]
    with np.errstate(all="ignore"):
        spread, variance = counts[4] / max(counts[2], 1) - near**2, max(p2 - m**2, 0.0)
        third, fourth = p3 - 3 * m * p2 + 2 * m**3, p4 - 4 * m * p3 + 6 * m**2 * p2 - 3 * m**4
        alike = 4 * (near - m) ** 2 < variance < 4 * spread
        far = value < 0 and (near - float(value)) ** 2 > variance
        phases = third**2 + variance**3 > TWO_PHASES * fourth * variance
    return Padding(float(value), total / size, math.sqrt(variance), bool(phases and (alike or far)))


def describe_padding(padding: Padding | None, otsu: bool, inside: bool = False) -> tuple[str, ...]:
    """Return a note on padding; `inside` says whether Otsu's threshold is taken inside of a region."""
    if padding is None:
        return ()
    told = f"{padding.share:.0%} of the voxels, reached from the borders, are exactly {padding.value:g}"
    told += ", and count as background" * padding.sure
    told += "" if inside else ": if nothing was imaged there, a region of interest leaves them out"
    how = " without them" * padding.sure + " inside the region" * inside
    return (f"{told}; the threshold is taken{how}." if how and otsu else f"{told}.",)


def _find_threshold(values: np.ndarray) -> float:
    """Return the middle of the means of the two phases that Otsu's threshold splits."""
    # Between two sharp levels all thresholds split alike and Otsu's is the lowest; else the two agree.
    high = values > threshold_otsu(values)
    return float(values[high].mean(dtype=np.float64) + values[~high].mean(dtype=np.float64)) / 2


def smooth_levels(
    values: np.ndarray, spacing: tuple[float, float, float], periodic: bool = False, padding: Padding | None = None
) -> np.ndarray:
    """Return grey levels (Z, Y, X) smoothed by one voxel of the finest axis, float32; sure padding is NaN."""
    width = [min(spacing) / h for h in spacing]
    smooth = partial(ndimage.gaussian_filter, sigma=width, mode="wrap" if periodic else "nearest", truncate=3.0)
    if padding is None or not padding.sure:
        return smooth(values.astype(np.float32))
    known = values != padding.value
    weights = smooth(known.astype(np.float32))
    return smooth(np.where(known, values, 0).astype(np.float32)) / np.where(known, weights, np.nan)


def sign_levels(smooth: np.ndarray, level: float, dark: bool, padding: Padding | None) -> np.ndarray:
    """Return smoothed levels less a threshold, above 0 in the structure; padding is background."""
    signed = level - smooth if dark else smooth - level
    if padding is not None and padding.sure:
        signed[np.isnan(signed)] = -padding.deviation
    return signed


def describe_split(level: float, otsu: bool, dark: bool, lowest: float, highest: float) -> str:
    """Return the note on a threshold; raise ScanError where it is not between the extremes of the smoothed levels."""
    if not lowest < level < highest:
        levels = f"{lowest:.4g} to {highest:.4g}"
        raise ScanError(f"expected a threshold within the smoothed scan's {levels}, got {level:.4g}")
    how, side = "Otsu's" if otsu else "the given", "dark" if dark else "bright"
    return f"Smoothed by one voxel, split at {how} threshold of {level:.4g}: the {side} phase is the structure."


def _split_image(
    field: Volume, threshold: Literal["otsu"] | float, dark: bool, region: Any, periodic: bool, padding: Padding | None
) -> tuple[np.ndarray, str]:
    """Return grey levels smoothed by one voxel of the finest axis, less the raw levels' threshold, and a note."""
    # Smoothing lowers thin structures' grey: a threshold of the smoothed levels would sink and make them fat.
    smooth = smooth_levels(field.values, field.spacing, periodic, padding)
    counted = ... if region is None else region
    if padding is not None and padding.sure:
        counted = np.isfinite(smooth) & (True if region is None else region)
    levels, raw = smooth[counted], field.values[counted]
    if not raw.size or raw.min() == raw.max():
        raise ScanError("expected grey levels that differ where they count, got one of them only")
    level = _find_threshold(raw) if threshold == "otsu" else float(threshold)
    note = describe_split(level, threshold == "otsu", dark, float(levels.min()), float(levels.max()))
    return sign_levels(smooth, level, dark, padding), note


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
    distance = centre_distance(mask, (1.0, 1.0, 1.0), 4 * max(1.0, *step), periodic)
    sampled = resample(distance, step, (0, 0, 0), sampled_shape(mask.shape, step), periodic=periodic)
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
    blur, contrast, shift = _fit_blur(levels, mask, edges)
    if not contrast > 0:
        raise ScanError("expected grey levels that tell structure from background, got none that do")
    noise, left = _measure_deep_noise(levels, mask, edges) or (_measure_white_noise(levels), 0.0)
    grain = min(_GRAINS, key=lambda width: abs(_smoothing_factor(width, spacing) - left))
    return Quality(blur, noise / contrast, grain, shift, spacing)


def _fit_blur(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float, float]:
    """Return blur, contrast and boundary shift of levels of mean 0 on voxels with edges in units of the finest."""
    distance = centre_distance(mask, edges, 4.0)
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


def _measure_deep_noise(levels: np.ndarray, mask: np.ndarray, edges: Sequence[float]) -> tuple[float, float] | None:
    """Return the deviation of levels deep within the phases and the share of it that smoothing leaves, or None."""
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


def _measure_white_noise(levels: np.ndarray) -> float:
    """Return the deviation of white noise in levels."""
    for axis in range(3):
        levels = np.diff(levels, 2, axis)
    return float(np.median(np.abs(levels))) / _NORMAL_MEDIAN / 6**1.5


def _smoothing_factor(grain: float, spacing: Sequence[float]) -> float:
    """Return the factor by which smoothing by a voxel of the finest axis lowers the deviation of noise of a grain."""
    spike, left = np.eye(1, 65, 32)[0], 1.0
    for edge in spacing:
        width = min(spacing) / edge
        noise = ndimage.gaussian_filter(spike, grain * width)
        left *= float(np.linalg.norm(ndimage.gaussian_filter(noise, width)) / np.linalg.norm(noise))
    return left
