"""What all tiles of a volume must have in common: its kind, threshold, noise and thickness, found box by box.

Three passes read the volume. The first finds its extremes and kind; the second, of images alone, Otsu's threshold, and
before it padding where one value fills much of them; the third counts the structure, and where it has most surface.
There the thickness is measured that sets the working grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from skimage.filters import threshold_otsu

from curvafit.geometry.balls import ball_radii
from curvafit.scan import prepare, structure
from curvafit.scan.grids import MEASURED, candidate_boxes, order_boxes, surface_voxels, thickness_beneath
from curvafit.volumes.boxes import Box, cut_boxes, grow, within
from curvafit.volumes.run import Record, Run
from curvafit.volumes.volume import ScanError, Volume

#: Voxels that the first passes read at once.
PIECE = 2**24
#: The most grey levels of a volume of whole numbers whose threshold is found.
_MOST_LEVELS = 2**22


#: Values of a box that count for a threshold.
Levels = Callable[[Box], np.ndarray]


@dataclass(frozen=True)
class Request:
    """A volume, and what the caller says of it."""

    volume: Volume
    label: int | None
    kind: Literal["auto", "field", "mask", "image"]
    threshold: Literal["otsu"] | float
    dark: bool
    region: Volume | None = None  # labels on its voxels; of a padded scan they say where the threshold is taken

    def read(self, box: Box) -> np.ndarray:
        """Return the values of a box; of a label, where it is."""
        values = self.volume.read(box)
        values = values if self.label is None else values == self.label
        return values.view(np.uint8) if values.dtype.kind == "b" else values


@dataclass(frozen=True)
class Split:
    """How a volume's structure is told from its background: the kind, the extremes, and the threshold of an image."""

    kind: structure.Kind
    lowest: float
    highest: float
    two: bool
    level: float = 0.0
    padding: structure.Padding | None = None


@dataclass(frozen=True)
class Plan:
    """What the tiles of a volume have in common.

    `smallest` is the fewest voxels of a piece of an image's structure that is no speck, 0 where all pieces count; a
    working voxel has `scale` of the volume's voxels and the edge `edge`, and there are `working` along (z, y, x);
    `reach` is the radius of the largest ball where the thickness was measured. Lengths are in the volume's unit.
    """

    request: Request
    split: Split
    noise: bool
    notes: tuple[str, ...]
    smallest: float = 0.0
    thickness: float = 0.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    working: tuple[int, int, int] = (0, 0, 0)
    edge: float = 1.0
    reach: float = 0.0
    working_notes: tuple[str, ...] = ()

    @property
    def volume(self) -> Volume:
        """The volume that is measured."""
        return self.request.volume

    def levels(self, box: Box) -> np.ndarray:
        """Return a box of the volume as float32 values that are above 0 in its structure."""
        return find_levels(self.request, self.split, box)


def find_levels(request: Request, split: Split, box: Box) -> np.ndarray:
    """Return a box of a volume as float32 values that are above 0 in its structure, as `structure.find_structure`."""
    if split.kind == "image":
        around, volume = grow(box, structure.SMOOTHED, request.volume.shape), request.volume
        smooth = structure.smooth_levels(request.read(around), volume.spacing, padding=split.padding)
        return structure.sign_levels(smooth[within(box, around)], split.level, request.dark, split.padding)
    values = request.read(box)
    if split.kind == "field":
        return (-values if request.dark else values).astype(np.float32)
    mask = values == split.highest if split.two else values > 0
    return np.where(mask != request.dark, np.float32(1), np.float32(-1))


def survey(request: Request, run: Run) -> Plan:
    """Find what the tiles of a volume have in common; raise ScanError as `measure.measure`."""
    volume = request.volume
    split, note = _find_split(request, run)
    pieces = cut_boxes(volume.shape, round(PIECE ** (1 / 3)))
    total = _add(run("counting the structure", partial(_count_structure, request, split, pieces), len(pieces)))
    if split.kind == "image":
        otsu, inside = request.threshold == "otsu", request.region is not None
        ends = [float(e) for e in (total["lowest"], total["highest"])]
        low, high = sorted(split.level - e for e in ends) if request.dark else [split.level + e for e in ends]
        note = structure.describe_split(split.level, otsu, request.dark, low, high)
        note = " ".join([*structure.describe_padding(split.padding, otsu, inside), note])
    size, filled = math.prod(volume.shape), int(total["filled"])
    if filled in (0, size):
        what, other = ("background", "structure") if filled else ("a structure", "background")
        raise ScanError(f"expected {what} in the scan, got none: every voxel is {other}")
    labelled = () if request.label is None else (f"The structure is label {request.label}.",)
    noise = split.kind != "field" and structure.pairs_of_noise(volume.shape, filled / size, total["pairs"])
    plan = Plan(request, split, noise, (*volume.notes, *labelled, note))
    thinner = filled <= prepare.HALF * size
    candidates = candidate_boxes(volume.shape, MEASURED)
    median, thick, plan = _measure_thickness(plan, order_boxes(candidates, total["surface"].tolist()), True)
    if split.kind == "image":
        plan = replace(plan, smallest=prepare.smallest_piece(median) / math.prod(volume.spacing))
    if not thinner:
        order = order_boxes(candidates, total["other surface"].tolist())
        median, thick, plan = _measure_thickness(plan, order, False)
    return _choose_grid(plan, median, thick, "structure" if thinner else "background")


def _choose_grid(plan: Plan, median: float, thick: float, name: str) -> Plan:
    """Return the plan with its working grid, as `prepare.prepare` chooses it."""
    kind, volume = plan.split.kind, plan.volume
    note = prepare.judge_thickness(name, median, thick, volume.spacing, kind == "field" or plan.noise)
    scale, why = prepare.choose_scale(kind, volume, plan.noise, median)
    return replace(
        plan,
        thickness=median,
        scale=scale,
        working=prepare.count_voxels(volume.shape, scale) if min(volume.shape) > 3 else (0, 0, 0),  # no curvature
        edge=prepare.working_edge(scale, volume.spacing),
        working_notes=(note, *why),
    )


def _measure_thickness(plan: Plan, order: Sequence[Box], inside: bool) -> tuple[float, float, Plan]:
    """Return median and 95th percentile of a phase's thickness, as `grids.median_thickness`, and the plan's reach."""
    spacing, box = plan.volume.spacing, order[0]
    around = grow(box, 1, plan.volume.shape)
    mask = (plan.levels(around) > 0) == inside
    part, surface = (each[within(box, around)] for each in (mask, surface_voxels(mask)))
    median, thick = thickness_beneath(part, surface, spacing)
    half = max(n * h for n, h in zip(part.shape, spacing, strict=True)) / 2
    finite = [float(ball_radii(each, spacing, half).max()) for each in (part, ~part) if each.any()]
    return median, thick, replace(plan, reach=max(plan.reach, *finite))


def _add(found: Iterable[Record]) -> dict[str, np.ndarray]:
    """Return the sums over pieces; of what is called lowest and highest the extremes."""
    total: dict[str, np.ndarray] = {}
    for each in found:
        for name, value in each.items():
            join = {"lowest": np.minimum, "highest": np.maximum}.get(name, np.add)
            total[name] = join(total[name], value) if name in total else value
    return total


# ---- kind and threshold ----------------------------------------------------------------------------------------------


def _find_split(request: Request, run: Run) -> tuple[Split, str]:
    """Return how structure and background are split, and a note for fields and masks."""
    volume = request.volume
    side = max(1, math.isqrt(PIECE // volume.shape[2]))
    bars = cut_boxes(volume.shape, (side, side, volume.shape[2]))
    value = request.read((slice(0, 1), slice(0, 1), slice(0, 1)))[0, 0, 0]
    found = list(run("reading", partial(_look_at_values, request, bars, value), len(bars)))
    total = _add({name: each[name] for name in each if name not in ("two", "values")} for each in found)
    if faults := int(total["faults"]):
        raise ScanError(f"a volume must be finite, got {faults} values that are not in {volume.source}")
    lowest, highest = total["lowest"], total["highest"]
    if lowest == highest:
        if request.label is not None:
            raise ScanError(f"label {request.label} is no label of the scan, or the only one")
        raise ScanError(f"every voxel of {volume.source} is {lowest}: a volume must vary")
    ends = {float(lowest), float(highest)}
    two = all(bool(each["two"]) and {float(each["lowest"]), float(each["highest"])} <= ends for each in found)
    kind, values = request.kind, np.unique(np.concatenate([each["values"] for each in found]))
    if kind == "auto":
        kind = "mask" if two or (request.threshold == "otsu" and structure.are_labels(values)) else "image"
        if kind == "image" and structure.may_be_field(volume.dtype, request.threshold, float(lowest), float(highest)):
            steady = 2 * total["steady"] > total["steps"] or not total["steps"]
            kind = "field" if steady and total["plateau"] > structure.PLATEAUS * math.prod(volume.shape) else "image"
    split = Split(kind, float(lowest), float(highest), two)
    if kind == "field":
        return split, f"Taken for a phase field: values {float(lowest):.3g} to {float(highest):.3g}."
    if kind == "mask":
        note = f"Taken for a mask of the values {float(lowest):g} and {float(highest):g}."
        return split, note if two else structure.SEVERAL
    size = math.prod(volume.shape)
    return _split_image(request, bars, split, total, value, size, run), ""


def _split_image(
    request: Request, bars: Sequence[Box], split: Split, total: Record, value: Any, size: int, run: Run
) -> Split:
    """Return the split with the padding and the threshold of an image of so many voxels, of which `total` is known."""
    levels, ends = partial(_read_levels, request, None, False), (total["lowest"], total["highest"])
    if total["constant"] > structure.PADDED * size:
        counted = _add(run("looking for padding", partial(_count_padding, request, bars, value), len(bars)))
        split = replace(split, padding=structure.judge_padding(value, counted["padding"]))
    if request.threshold != "otsu":
        return replace(split, level=float(request.threshold))
    if split.padding is not None and (split.padding.sure or request.region is not None):
        levels = partial(_read_levels, request, split.padding.value if split.padding.sure else None, True)
        counted = _add(run("looking at levels", partial(_look_at_levels, levels, bars), len(bars)))
        if not counted or counted["lowest"] == counted["highest"]:
            raise ScanError("expected grey levels that differ where they count, got one of them only")
        ends = (counted["lowest"], counted["highest"])
    return replace(split, level=_find_threshold(levels, bars, *ends, run))


def _look_at_values(request: Request, bars: Sequence[Box], value: Any, number: int) -> Record:
    """Return the extremes of a bar, how many voxels have a value, whether it has two values at most, and what tells
    labels and a phase field."""
    values = request.read(bars[number])
    lowest, highest = values.min(), values.max()
    found = {"lowest": lowest, "highest": highest, "two": np.all((values == lowest) | (values == highest))}
    found["values"] = np.array([lowest, highest]) if found["two"] else structure.list_values(values)
    found["constant"] = np.int64(np.count_nonzero(values == value))
    if values.dtype.kind != "f":
        return {**found, "faults": np.int64(0)}
    found["faults"] = np.int64(values.size - np.count_nonzero(np.isfinite(values)))
    if request.kind == "auto" and not found["faults"] and lowest >= -2 and highest <= 2:
        steps = np.abs(np.diff(values, 3, axis=2)) if values.shape[2] > 3 else np.empty(0)
        found |= {"steady": np.count_nonzero(steps < structure.JITTER), "steps": np.int64(steps.size)}
        found["plateau"] = np.count_nonzero(np.abs(values) > structure.PLATEAU)
    return {name: np.asarray(value) for name, value in found.items()}


def _count_padding(request: Request, bars: Sequence[Box], value: Any, number: int) -> Record:
    """Return what tells padding with a value in a bar."""
    return {"padding": structure.count_constant(request.read(bars[number]), value)}


def _read_levels(request: Request, left: float | None, inside: bool, box: Box) -> np.ndarray:
    """Return the values of a box but one that is left out, `inside` of the region, if there is one."""
    values = request.read(box)
    counted = np.ones(values.shape, dtype=bool) if left is None else values != left
    if inside and request.region is not None:
        counted &= request.region.read(box) != 0
    return values[counted]


def _look_at_levels(levels: Levels, bars: Sequence[Box], number: int) -> Record:
    """Return the extremes of a bar's values that count."""
    values = levels(bars[number])
    return {"lowest": values.min(), "highest": values.max()} if values.size else {}


def _find_threshold(levels: Levels, bars: Sequence[Box], lowest: Any, highest: Any, run: Run) -> float:
    """Return the threshold of the levels that count, as `structure.find_structure` finds it."""
    lowest, highest = lowest[()], highest[()]
    whole = lowest.dtype.kind in "iu"
    if whole and int(highest) - int(lowest) >= _MOST_LEVELS:
        raise ScanError(f"expected at most {_MOST_LEVELS} grey levels, got {lowest} to {highest}: give a threshold")
    name = "finding the threshold"
    counts = _add(run(name, partial(_count_levels, levels, bars, lowest, highest), len(bars)))["counts"]
    if whole:
        centres = np.arange(int(lowest), int(highest) + 1)
        high = centres > threshold_otsu(hist=(counts, centres))
        means = [np.dot(counts[side], centres[side].astype(np.float64)) / counts[side].sum() for side in (high, ~high)]
        return float(sum(means)) / 2
    edges = np.histogram_bin_edges(np.empty(0, lowest.dtype), 256, (lowest, highest))
    otsu = threshold_otsu(hist=(counts, (edges[1:] + edges[:-1]) / 2))
    sums = _add(run(f"{name}'s sides", partial(_sum_sides, levels, bars, otsu), len(bars)))["sums"]
    return float(sums[0, 1] / sums[0, 0] + sums[1, 1] / sums[1, 0]) / 2


def _count_levels(levels: Levels, bars: Sequence[Box], lowest: Any, highest: Any, number: int) -> Record:
    """Return a histogram of a bar: of each whole number, or of 256 bins."""
    values = levels(bars[number])
    if values.dtype.kind not in "iu":
        return {"counts": np.histogram(values, 256, (lowest, highest))[0]}
    return {"counts": np.bincount(values.astype(np.int64) - int(lowest), minlength=int(highest) - int(lowest) + 1)}


def _sum_sides(levels: Levels, bars: Sequence[Box], level: float, number: int) -> Record:
    """Return the numbers and sums of the values above a level, and of the others."""
    values = levels(bars[number])
    high = values > level
    sides = [(values[side].size, values[side].sum(dtype=np.float64)) for side in (high, ~high)]
    return {"sums": np.array(sides, dtype=np.float64)}


# ---- structure -------------------------------------------------------------------------------------------------------


def _count_structure(request: Request, split: Split, pieces: Sequence[Box], number: int) -> Record:
    """Return the structure's voxels in a piece, its surface in boxes that may be measured, and `count_pairs`."""
    core, shape = pieces[number], request.volume.shape
    box = grow(core, max(structure.LAGS), shape)
    levels = find_levels(request, split, box)
    inner = within(core, box)
    found = {"lowest": levels[inner].min(), "highest": levels[inner].max()}
    mask = levels > 0
    found["filled"] = np.int64(np.count_nonzero(mask[inner]))
    for name, phase in (("surface", mask), ("other surface", ~mask)):
        surface = surface_voxels(phase)[inner]
        shared = [_overlap(core, each) for each in candidate_boxes(shape, MEASURED)]
        counts = [0 if each is None else np.count_nonzero(surface[within(each, core)]) for each in shared]
        found[name] = np.array(counts, dtype=np.int64)
    found["pairs"] = structure.count_pairs(mask, inner, core, shape)
    return {name: np.asarray(value) for name, value in found.items()}


def _overlap(one: Box, other: Box) -> Box | None:
    """Return what two boxes share."""
    z, y, x = (slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one, other, strict=True))
    return (z, y, x) if all(edge.start < edge.stop for edge in (z, y, x)) else None
