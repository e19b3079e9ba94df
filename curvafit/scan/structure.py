"""What in a scan is structure: its kind, and how structure and background are split, from blocks of any number.

Two rooms split grey levels otherwise, on purpose. `segmentation.evidence` needs the noise of each voxel: it smooths as
far as the noise asks, and splits half way between the means of the raw levels. `data_synth.imaging` follows brightness
that varies along a structure. Here thin structures must not grow fat: smoothed levels are split at the raw ones'
threshold.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from curvafit.core.checks import SEEDS, check_choice, check_float, check_int
from curvafit.core.units import format_percent
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Record, Run
from curvafit.volumes.volume import Box, Crop, ScanError, Volume, cut_boxes, grow, lay, round_labels, within

#: What a scan is; `auto` until it is found.
Kind = Literal["auto", "field", "mask", "image"]
#: Voxels that the first passes read at once.
PIECE = 2**24
#: The most grey levels of a volume of whole numbers whose threshold is found.
_MOST_LEVELS = 2**22
#: Median third difference of neighbours from which values are noisy; fields rounded to 1/100 reach 0.02.
JITTER = 0.045
#: The share of a phase field's voxels that lie in its plateaus, further from 0 than this.
PLATEAUS, PLATEAU = 0.6, 0.35
#: Offsets in scan voxels, beyond the reach of smoothing, and the correlation that noise stays below there.
LAGS, UNCORRELATED = (4, 5, 6, 7, 8), 0.06
#: Voxels that smoothing grey levels reaches.
SMOOTHED = 3
#: The least fraction of labelled neighbours with one label; noise and grey levels have fewer.
_LEAST_SHARED = 0.25
#: The most values of labels (grey levels of four bits have more), and the voxels of a first sample for more values.
_MOST_LABELS, _SAMPLED = 12, 4096
#: What structure is in a mask of several values.
SEVERAL = (
    "Taken for a mask or labels: the structure is where they are positive. Naming a label (label) measures it alone, "
    "and kind image splits grey levels."
)
#: A constant may be padding where it fills more than the first share of the scan, and the second share of it is reached
#: from the ends of rows. Other levels have two phases from this bimodality on.
PADDED, REACHED, TWO_PHASES = 0.1, 0.95, 0.45
#: A threshold is moved by so much of the contrast to see what that changes, and is weak where that is so much of the
#: structure.
MOVED, WEAK = 0.1, 0.1
#: Otsu's threshold in the note of `describe_image`.
OTSU = re.compile(r"split at Otsu's threshold of ([^:]+):")
#: A field of a few thousand values was rounded.
_ROUNDED_VALUES = 4096
#: Values of a box that count for a threshold.
Levels = Callable[[Box], np.ndarray]


@dataclass(frozen=True)
class Structure:
    """What in a volume is structure: the caller's options, completed by `find_split`.

    The threshold of a padded scan is taken where `region` is not 0; with `alone`, that of any scan. `find_split` sets
    the kind, the extremes, whether they are the only `two` values, and the threshold (`level`) and padding of an image,
    and of Otsu's threshold the `contrast`: the difference of the means of the levels on its sides.
    """

    volume: Volume
    kind: Kind = "auto"
    threshold: Literal["otsu"] | float = "otsu"
    dark: bool = False
    region: Volume | None = None
    alone: bool = False
    lowest: float = 0.0
    highest: float = 0.0
    two: bool = False
    level: float = 0.0
    contrast: float = 0.0
    padding: Padding | None = None

    def read(self, box: Box) -> np.ndarray:
        """Return the values of a box."""
        values = self.volume.read(box)
        return values.view(np.uint8) if values.dtype.kind == "b" else values


class Padding(NamedTuple):
    """A constant value around what was imaged, the share of the scan that has it, the standard deviation of the other
    levels, and whether it is `sure` that the constant is no background."""

    value: float
    share: float
    deviation: float
    sure: bool


def find_structure(
    field: Volume,
    *,
    kind: Kind = "auto",
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    region: np.ndarray | None = None,
    periodic: bool = False,
    extremes: tuple[float, float] | None = None,
) -> tuple[Kind, Volume]:
    """Return the kind of a scan in memory, and the scan as float32 values above 0 in its structure, with notes.

    The parameters are as in `preparation.prepare`; `extremes` are the lowest and highest value of the whole scan that
    `field` is cropped from: a mask's values. Raises ScanError if the threshold splits nothing or a phase is empty.
    """
    inside = None if region is None else replace(field, array=region)
    structure, note = find_split(Structure(field, kind, threshold, dark, inside, alone=True), Run(), extremes)
    z, y, x = (slice(0, n) for n in field.shape)
    values = find_levels(structure, (z, y, x), periodic)
    counted = values if region is None else values[region]
    if structure.kind == "image":
        note = describe_image(structure, count_levels(structure, counted))
    check_phases(int(np.count_nonzero(counted > 0)), counted.size)
    return structure.kind, replace(field, array=values, notes=(*field.notes, note))


def check_phases(inside: int, count: int) -> None:
    """Raise ScanError unless some of a scan's voxels are in the structure, and others in the background."""
    if inside in (0, count):
        what, other = ("background", "structure") if inside else ("a structure", "background")
        raise ScanError(f"expected {what} in the scan, got none: every voxel is {other}")


def find_levels(structure: Structure, box: Box, periodic: bool = False) -> np.ndarray:
    """Return the values of a box (the whole volume if `periodic`) as float32, above 0 in the structure.

    Those of an image are its grey levels, smoothed by one voxel of the finest axis, minus the raw levels' threshold.
    """
    # Smoothing lowers the grey of thin structures: a threshold of smoothed levels would be too low, and they too fat.
    if structure.kind == "image":
        around, padding = grow(box, SMOOTHED, structure.volume.shape), structure.padding
        smooth = _smooth_levels(structure.read(around), structure.volume.spacing, periodic, padding)
        signed = smooth[within(box, around)]
        signed -= np.float32(structure.level)
        if structure.dark:
            np.negative(signed, out=signed)
        if padding is not None and padding.sure:
            signed[np.isnan(signed)] = -padding.deviation  # background; padding that is doubted stays NaN
        return signed
    values = structure.read(box)
    if structure.kind == "field":
        return (-values if structure.dark else values).astype(np.float32)
    mask = values == structure.highest if structure.two else values > 0
    return np.where(mask != structure.dark, np.float32(1), np.float32(-1))


def _smooth_levels(
    values: np.ndarray, spacing: tuple[float, float, float], periodic: bool, padding: Padding | None
) -> np.ndarray:
    """Return grey levels (Z, Y, X) smoothed by one voxel of the finest axis, float32; sure padding is NaN."""
    width = [min(spacing) / h for h in spacing]
    smooth = partial(ndimage.gaussian_filter, sigma=width, mode="wrap" if periodic else "nearest", truncate=3.0)
    if padding is None or not padding.sure:
        return smooth(values.astype(np.float32))
    imaged = values != padding.value
    weights = smooth(imaged.astype(np.float32))  # dividing by them makes a mean over imaged voxels alone
    return smooth(np.where(imaged, values, 0).astype(np.float32)) / np.where(imaged, weights, np.nan)


def check_options(kind: str, threshold: float | str, label: int | None = None) -> None:
    """Raise ValueError where a kind, threshold or label is not valid, or contradicts another."""
    check_choice(kind, ("auto", "field", "mask", "image"), "kind auto, field, mask or image")
    otsu = isinstance(threshold, str) and threshold == "otsu"
    level = "otsu" if otsu else check_float(threshold, "a threshold that is a number or 'otsu'")
    if label is not None:
        check_int(label, "a label that is a whole number", -SEEDS, 2 * SEEDS - 1)
        if kind in ("field", "image") or level != "otsu":
            raise ValueError("a label states the structure: leave out kind and threshold, got both")
    if kind in ("field", "mask") and level != "otsu":
        raise ValueError(f"a threshold splits grey levels: leave it out for kind {kind}")


# ---- regions, labels, noise ------------------------------------------------------------------------------------------


def read_region(
    roi: Source, field: Volume, scan: Source | None = None, crop: Crop | None = None, **reading: Any
) -> tuple[Volume, tuple[str, ...]]:
    """Return a region of interest on the voxels of a field, and notes on how it was laid.

    If the field is a `crop` of a scan, `scan` and `reading` name the scan: a region without an affine lies on all of
    it, and is cropped in the same way. Raises ScanError where the region is empty, and as `lay`.
    """
    region = load(roi)
    target = field if crop is None or scan is None else load(scan, **reading, lazy=True)
    if region.affine is not None and target.affine is not None:  # affines put it on the field: nothing is cropped
        target, crop = field, None
    region, notes = lay(region, target, "the region of interest", "the scan")
    values = region.values if crop is None else region.crop(crop).values
    if not values.any():
        raise ScanError("expected a region of interest with voxels in it, got an empty one")
    return replace(field, array=values, notes=notes), notes


def read_labels(labels: Volume, what: str) -> np.ndarray:
    """Return a volume's labels, whole numbers (Z, Y, X); ScanError if all are 0, or the values are grey levels."""
    values = whole_labels(labels.values, what)
    judge_labels(count_alike(values), what)
    return values


def whole_labels(values: np.ndarray, what: str) -> np.ndarray:
    """Return labels that are nearly whole numbers as integers; raise ScanError if some are not."""
    rounded = round_labels(values.astype(np.uint8) if values.dtype == bool else values)
    whole = rounded.astype(np.int64) if rounded.dtype.kind == "f" else rounded
    if (whole != rounded).any():
        raise ScanError(f"expected {what}, whole numbers that neighbours share, got grey levels")
    return whole


def count_alike(labels: np.ndarray) -> np.ndarray:
    """Return three counts: labelled voxels, pairs of labelled neighbours along x, and those pairs with one label."""
    pairs = (labels[..., :-1] != 0) & (labels[..., 1:] != 0)
    equal = pairs & (labels[..., :-1] == labels[..., 1:])
    return np.array([np.count_nonzero(voxels) for voxels in (labels, pairs, equal)])


def judge_labels(counts: np.ndarray, what: str) -> None:
    """Raise ScanError where by `count_alike` there are no labels, or too few neighbours share theirs."""
    labelled, pairs, equal = counts.tolist()
    if not labelled:
        raise ScanError(f"expected {what}, got none: every voxel is 0")
    if equal < _LEAST_SHARED * pairs:
        raise ScanError(f"expected {what}, whole numbers that neighbours share, got grey levels")


def is_noise(mask: np.ndarray) -> bool:
    """Return whether voxels a few apart along an axis are uncorrelated, for all axes."""
    z, y, x = (slice(0, n) for n in mask.shape)
    return pairs_of_noise(mask.shape, float(mask.mean()), count_pairs(mask, (z, y, x), (z, y, x), mask.shape))


def count_pairs(mask: np.ndarray, inner: Box, core: Box, shape: Sequence[int]) -> np.ndarray:
    """Count the voxel pairs a lag apart that begin in a core (`inner` in the mask) of a volume: for each axis and each
    of `LAGS`, those with both voxels, with the first, and with the last in the mask, (3, `LAGS`, 3)."""
    counts = np.zeros((3, len(LAGS), 3), dtype=np.int64)
    for axis, (edge, n) in enumerate(zip(inner, shape, strict=True)):
        for k, lag in enumerate(LAGS):
            stop = edge.start + max(0, min(core[axis].stop, n - lag) - core[axis].start)  # pairs end in the volume
            ranges = (slice(edge.start + shift, stop + shift) for shift in (0, lag))
            first, last = (mask[(*inner[:axis], voxels, *inner[axis + 1 :])] for voxels in ranges)
            counts[axis, k] = [np.count_nonzero(first & last), np.count_nonzero(first), np.count_nonzero(last)]
    return counts


def pairs_of_noise(shape: Sequence[int], share: float, pairs: np.ndarray) -> bool:
    """Return whether a mask is noise: its pairs (`count_pairs`) are uncorrelated, given the share that is inside."""
    for axis, n in enumerate(shape):
        for k, lag in enumerate(LAGS):
            if n <= 2 * lag:
                continue
            both, first, last = pairs[axis, k] / (math.prod(shape) / n * (n - lag))
            if abs(both - first * last) > UNCORRELATED * share * (1 - share):
                return False
    return True


def is_rounded(u: np.ndarray) -> bool:
    """Return whether a field holds so few values that it was rounded: its second differences are then noise."""
    return len(np.unique(np.asarray(u))) <= min(_ROUNDED_VALUES, math.prod(u.shape) // 16)


def count_levels(structure: Structure, levels: np.ndarray) -> dict[str, Any]:
    """Return the extremes of levels as `find_levels` gives them, and how many are above 0, and would be if the
    threshold were `MOVED` contrasts lower, and higher."""
    moved = MOVED * structure.contrast
    above = np.array([np.count_nonzero(levels > level) for level in (0, -moved, moved)])
    return {"lowest": levels.min(), "highest": levels.max(), "above": above}


def describe_image(structure: Structure, total: Record) -> str:
    """Return the note on padding and threshold, given `count_levels` of all that counts; raise ScanError where the
    threshold is not within the range of the smoothed levels."""
    otsu, level = structure.threshold == "otsu", structure.level
    lowest, highest = float(total["lowest"]), float(total["highest"])
    low, high = (level - highest, level - lowest) if structure.dark else (level + lowest, level + highest)
    if not low < level < high:
        raise ScanError(f"expected a threshold within the smoothed scan's {low:.4g} to {high:.4g}, got {level:.4g}")
    source, side = "Otsu's" if otsu else "the given", "dark" if structure.dark else "bright"
    padding = structure.padding
    note = "" if padding is None else _describe_padding(padding, otsu, structure.region is not None)
    note += f"Smoothed by one voxel, split at {source} threshold of {level:.4g}: the {side} phase is the structure."
    inside, *moved = total["above"].tolist()
    more, less = (count / max(inside, 1) - 1 for count in moved)
    if more - less > 2 * WEAK:
        changes = f"{format_percent(more)} more structure, or {format_percent(-less)} less"
        note += f" A threshold off by a tenth of the contrast gives {changes}: look at the outline."
    return note


def _describe_padding(padding: Padding, otsu: bool, has_region: bool) -> str:
    """Return a note on padding, and on the levels of which Otsu's threshold is taken."""
    text = f"{padding.share:.0%} of the voxels, reached from the borders, are exactly {padding.value:g}"
    text += ", and count as background" * padding.sure
    text += "" if has_region else ": if nothing was imaged there, a region of interest leaves them out"
    levels = " without them" * padding.sure + " inside the region" * has_region
    return f"{text}; the threshold is taken{levels}. " if levels and otsu else f"{text}. "


# ---- kind and threshold ----------------------------------------------------------------------------------------------


def find_split(structure: Structure, run: Run, extremes: tuple[Any, Any] | None = None) -> tuple[Structure, str]:
    """Find how structure and background are split; return the completed structure, and a note for fields and masks.

    Two values are a mask, as are labels; floats from about -1 to about 1, without noise and mostly far from 0, are a
    phase field; anything else is an image. `extremes` are those of `find_structure`.
    """
    volume = structure.volume
    side = max(1, math.isqrt(PIECE // volume.shape[2]))
    bars = cut_boxes(volume.shape, (side, side, volume.shape[2]))
    value = structure.read((slice(0, 1), slice(0, 1), slice(0, 1)))[0, 0, 0]  # padding would have it
    records = run("reading", partial(_look_at_values, structure, bars, value), len(bars))
    total = add_records({name: record[name] for name in record if name not in ("two", "values")} for record in records)
    if faults := int(total["faults"]):
        raise ScanError(f"a volume must be finite, got {faults} values that are not in {volume.source}")
    lowest, highest = total["lowest"], total["highest"]
    low, high = (lowest, highest) if extremes is None else extremes
    if low == high and volume.in_file and (label := volume.array.label) is not None:
        raise ScanError(f"label {label} is no label of the scan, or the only one")
    if low == high and volume.source:
        raise ScanError(f"every voxel of {volume.source} is {lowest}: a volume must vary")
    ends = {float(low), float(high)}
    two_values = all(bar["two"] and {float(bar["lowest"]), float(bar["highest"])} <= ends for bar in records)
    kind = structure.kind
    if kind == "auto":
        values = np.unique(np.concatenate([record["values"] for record in records]))
        kind = _guess_kind(structure, total, values, two_values)
    two = two_values and bool(low < high)
    structure = replace(structure, kind=kind, lowest=float(low), highest=float(high), two=two)
    if kind == "field":
        return structure, f"Taken for a phase field: values {float(lowest):.3g} to {float(highest):.3g}."
    if kind == "mask":
        note = f"Taken for a mask of the values {structure.lowest:g} and {structure.highest:g}."
        return structure, note if two_values else SEVERAL
    return _split_image(structure, bars, total, value, run), ""


def _guess_kind(structure: Structure, total: Record, values: np.ndarray, two: bool) -> Kind:
    """Return the kind of a scan from the sums and the distinct values of `_look_at_values`."""
    lowest, highest, otsu = float(total["lowest"]), float(total["highest"]), structure.threshold == "otsu"
    if two or (otsu and 2 < len(values) <= _MOST_LABELS and values[0] >= 0 and (values == np.rint(values)).all()):
        return "mask"
    if not (structure.volume.dtype.kind == "f" and otsu and -2 <= lowest <= -0.7 and 0.3 <= highest <= 2):
        return "image"
    smooth = 2 * total["steady"] > total["steps"] or not total["steps"]
    return "field" if smooth and total["plateau"] > PLATEAUS * math.prod(structure.volume.shape) else "image"


def _split_image(structure: Structure, bars: Sequence[Box], total: Record, value: Any, run: Run) -> Structure:
    """Return the structure with the padding and the threshold of an image; `total` are sums of `_look_at_values`."""
    levels, extremes = partial(_read_levels, structure, None, False), (total["lowest"], total["highest"])
    if total["constant"] > PADDED * math.prod(structure.volume.shape):
        counted = add_records(run("looking for padding", partial(_count_padding, structure, bars, value), len(bars)))
        structure = replace(structure, padding=_judge_padding(value, counted["padding"]))
    padding = structure.padding
    if structure.threshold != "otsu":
        return replace(structure, level=float(structure.threshold))
    skips_padding = padding is not None and padding.sure
    in_region = structure.region is not None and (padding is not None or structure.alone)
    if skips_padding or in_region:
        levels = partial(_read_levels, structure, value if skips_padding else None, in_region)
        counted = add_records(run("looking at levels", partial(_look_at_levels, levels, bars), len(bars)))
        if not counted or counted["lowest"] == counted["highest"]:
            raise ScanError("expected grey levels that differ where they count, got one of them only")
        extremes = (counted["lowest"], counted["highest"])
    level, contrast = _find_threshold(levels, bars, *extremes, run)
    return replace(structure, level=level, contrast=contrast)


def _look_at_values(structure: Structure, bars: Sequence[Box], value: Any, number: int) -> Record:
    """Return the extremes of a bar, its distinct values (or some), whether there are two at most, how many voxels are
    `value` and how many not finite; of values that may be a phase field's, also how many are smooth and in plateaus."""
    values = structure.read(bars[number])
    lowest, highest = values.min(), values.max()
    two = np.all((values == lowest) | (values == highest))
    distinct = np.array([lowest, highest]) if two else np.unique(values.ravel()[:: 1 + values.size // _SAMPLED])
    if not two and len(distinct) <= _MOST_LABELS:  # the sample has so few values that all voxels must be sorted
        distinct = np.unique(values)
    record = {"lowest": lowest, "highest": highest, "two": two, "values": distinct[: _MOST_LABELS + 1]}
    record["constant"] = np.int64(np.count_nonzero(values == value))
    if values.dtype.kind != "f":
        return {**record, "faults": np.int64(0)}
    record["faults"] = np.int64(values.size - np.count_nonzero(np.isfinite(values)))
    if structure.kind == "auto" and not record["faults"] and lowest >= -2 and highest <= 2:
        third = np.abs(np.diff(values, 3, axis=2)) if values.shape[2] > 3 else np.empty(0)
        record |= {"steady": np.count_nonzero(third < JITTER), "steps": np.int64(third.size)}
        record["plateau"] = np.count_nonzero(np.abs(values) > PLATEAU)
    return {name: np.asarray(figure) for name, figure in record.items()}


def _count_padding(structure: Structure, bars: Sequence[Box], value: Any, number: int) -> Record:
    """Return what `_judge_padding` needs of a bar of whole rows, (12,): how many voxels are `value`, how many are in
    runs of it from the ends of rows; then sums of powers 0 to 4 of the levels next to those runs, and of all levels but
    `value`. From these follow means, variances, and the skewness and kurtosis of Sarle's test."""
    values = structure.read(bars[number])
    constant = values == value
    from_start = np.logical_and.accumulate(constant, axis=2)
    from_end = np.logical_and.accumulate(constant[..., ::-1], axis=2)[..., ::-1]
    rim = np.zeros_like(constant)
    rim[..., 1:] = from_start[..., :-1]
    rim[..., :-1] |= from_end[..., 1:]
    sums = [np.count_nonzero(constant), np.count_nonzero(from_start | from_end)]
    with np.errstate(all="ignore"):  # where powers of huge levels overflow, padding is not sure
        for voxels in (rim & ~constant, ~constant):
            levels = values[voxels].astype(np.float64)
            squares = np.square(levels)
            sums += [levels.size, levels.sum(), squares.sum(), np.dot(squares, levels), np.dot(squares, squares)]
    return {"padding": np.array(sums, dtype=np.float64)}


def _judge_padding(value: Any, counts: np.ndarray) -> Padding | None:
    """Return the padding of a scan by its `_count_padding`; None where there is none.

    It is sure where the other levels have two phases (Sarle's coefficient; 1/3 of a normal distribution), and the rim,
    the levels next to the constant, is similar to them (the rim of a background has low levels, of blurred edges) or
    far from a constant below 0 (no background is clipped at such a value).
    """
    constant, reached, size = counts[0], counts[1], counts[0] + counts[7]
    if constant <= PADDED * size or reached < REACHED * constant or constant == size:
        return None
    rim_mean, rim_square = counts[3:5] / max(counts[2], 1)
    m, p2, p3, p4 = counts[8:] / counts[7]  # means of powers
    with np.errstate(all="ignore"):
        rim_variance, variance = rim_square - rim_mean**2, max(p2 - m**2, 0.0)
        third, fourth = p3 - 3 * m * p2 + 2 * m**3, p4 - 4 * m * p3 + 6 * m**2 * p2 - 3 * m**4
        similar = 4 * (rim_mean - m) ** 2 < variance < 4 * rim_variance
        far = value < 0 and (rim_mean - float(value)) ** 2 > variance
        two_phases = third**2 + variance**3 > TWO_PHASES * fourth * variance
    return Padding(float(value), constant / size, math.sqrt(variance), bool(two_phases and (similar or far)))


def _read_levels(structure: Structure, skipped: float | None, inside: bool, box: Box) -> np.ndarray:
    """Return the values of a box (flat) other than `skipped`; those `inside` the region alone, if there is one."""
    values = structure.read(box)
    counted = np.ones(values.shape, dtype=bool) if skipped is None else values != skipped
    if inside and structure.region is not None:
        counted &= structure.region.read(box) != 0
    return values[counted]


def _look_at_levels(levels: Levels, bars: Sequence[Box], number: int) -> Record:
    """Return the extremes of a bar's values that count."""
    values = levels(bars[number])
    return {"lowest": values.min(), "highest": values.max()} if values.size else {}


def _find_threshold(levels: Levels, bars: Sequence[Box], lowest: Any, highest: Any, run: Run) -> tuple[float, float]:
    """Return the middle between the means of the levels on the two sides of Otsu's threshold, and their difference."""
    lowest, highest = lowest[()], highest[()]  # scalars of arrays without axes
    integers = lowest.dtype.kind in "iu"
    if integers and int(highest) - int(lowest) >= _MOST_LEVELS:
        raise ScanError(f"expected at most {_MOST_LEVELS} grey levels, got {lowest} to {highest}: give a threshold")
    name = "finding the threshold"
    counts = add_records(run(name, partial(_count_levels, levels, bars, lowest, highest), len(bars)))["counts"]
    if integers:
        centres = np.arange(int(lowest), int(highest) + 1)
        high = centres > threshold_otsu(hist=(counts, centres))
        means = [np.dot(counts[side], centres[side].astype(np.float64)) / counts[side].sum() for side in (high, ~high)]
        return float(sum(means)) / 2, float(means[0] - means[1])
    edges = np.histogram_bin_edges(np.empty(0, lowest.dtype), 256, (lowest, highest))
    otsu = threshold_otsu(hist=(counts, (edges[1:] + edges[:-1]) / 2))
    sums = add_records(run(f"{name}'s sides", partial(_sum_sides, levels, bars, otsu), len(bars)))["sums"]
    bright, dark = (sums[:, 1] / sums[:, 0]).tolist()
    return (bright + dark) / 2, bright - dark


def _count_levels(levels: Levels, bars: Sequence[Box], lowest: Any, highest: Any, number: int) -> Record:
    """Return the histogram of a bar: a bin for each whole number, or 256 bins for floats."""
    values = levels(bars[number])
    if values.dtype.kind not in "iu":
        return {"counts": np.histogram(values, 256, (lowest, highest))[0]}
    return {"counts": np.bincount(values.astype(np.int64) - int(lowest), minlength=int(highest) - int(lowest) + 1)}


def _sum_sides(levels: Levels, bars: Sequence[Box], level: float, number: int) -> Record:
    """Return how many values of a bar are above a level and their sum, and the same of the others, (2, 2)."""
    values = levels(bars[number])
    high = values > level
    sides = [(values[side].size, values[side].sum(dtype=np.float64)) for side in (high, ~high)]
    return {"sums": np.array(sides, dtype=np.float64)}


def add_records(records: Iterable[Record]) -> dict[str, np.ndarray]:
    """Return records summed by name; of those named lowest and highest, the minimum and the maximum."""
    total: dict[str, np.ndarray] = {}
    for record in records:
        for name, value in record.items():
            join = {"lowest": np.minimum, "highest": np.maximum}.get(name, np.add)
            total[name] = join(total[name], value) if name in total else value
    return total
