"""Known slices of a volume, plain interpolations between them, and checks of known masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from curvafit.core.units import format_sampling
from curvafit.scan.grids import centre_distance
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Box, ScanError, Volume, round_labels

#: Plain interpolations, the usual one first: signed distances on a cubic spline and on lines; the nearest slice.
WAYS = ("spline", "linear", "nearest")
#: Most values of a mask; more are grey levels. So are more than `FEW` where most neighbours differ: of labels that are
#: cut from shapes a few in a hundred do, of images of eight bits three in four.
LABELS, FEW = 256, 16
#: The greatest label, of 64 bits.
IDS = 2**64 - 1
#: Share by which the voxel sizes of two files may differ.
SAME = 1e-3
#: The box that is all of a volume.
WHOLE: Box = (slice(0, None), slice(0, None), slice(0, None))


@dataclass(frozen=True, eq=False)
class Slices:
    """The known slices across the first axis of a volume of `length` slices: their masks, bool (N, Y, X), which may be
    read from a file where they are asked for, and their numbers, ascending. In a `periodic` volume the first slice
    follows the last. `marks` say what is known in the other slices, int8 (length, Y, X): 1 inside, -1 outside, 0
    unknown; None if nothing is."""

    inside: np.ndarray
    places: tuple[int, ...]
    length: int
    spacing: tuple[float, float, float]
    unit: str = "voxel"
    periodic: bool = False
    marks: np.ndarray | None = None

    def crop(self, box: Box) -> Slices:
        """Return what is known in a box, whose first edge begins and ends with known slices."""
        rows, inside = self.known(box)
        marks, length = None if self.marks is None else self.marks[box], box[0].stop - box[0].start
        return replace(self, inside=inside, places=tuple(rows), length=length, periodic=False, marks=marks)

    def keep_known(self, mask: np.ndarray, box: Box = WHOLE) -> np.ndarray:
        """Return a mask (Z, Y, X) of a box, with the known voxels as they are."""
        rows, inside = self.known(box)
        kept = mask.copy()
        kept[rows] = inside
        if self.marks is not None:
            marks = self.marks[np.ix_(*self.numbers(box))]
            kept = np.where(marks == 0, kept, marks > 0)
        return kept

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the volume."""
        return (self.length, *self.inside.shape[1:])  # type: ignore[return-value]

    @property
    def frame(self) -> Volume:
        """A field of zeros, without memory of its own, with the volume's shape and spacing."""
        return Volume(np.broadcast_to(np.float32(0), self.shape), self.spacing, self.unit)

    @property
    def areas(self) -> np.ndarray:
        """The share of each known slice that is inside, (N,)."""
        return np.array([self.inside[k].mean() for k in range(len(self.places))])

    def numbers(self, box: Box) -> list[np.ndarray]:
        """Return the indices of a box's voxels along each axis; in a periodic volume a box may cross the ends."""
        edges = zip(box, self.shape, strict=True)
        return [np.arange(edge.start, n if edge.stop is None else edge.stop) % n for edge, n in edges]

    @property
    def outside(self) -> np.ndarray:
        """Whether each slice lies so far beyond the known ones that it is not filled (`reach_of`), bool (length,)."""
        far = np.full(self.length, not self.periodic)
        far[reach_of(self.places, self.length)] = False
        return far

    def known(self, box: Box) -> tuple[list[int], np.ndarray]:
        """Return the positions, within a box, of its known slices, and their masks there, bool (N, Y, X)."""
        numbers, ys, xs = self.numbers(box)
        index_of_place = {place: k for k, place in enumerate(self.places)}
        positions = [k for k, place in enumerate(numbers) if place in index_of_place]
        return positions, self.inside[[index_of_place[int(numbers[k])] for k in positions]][:, ys][:, :, xs]

    def level(self, way: str) -> np.ndarray:
        """Return an interpolation by one of `WAYS`, float32 (length, Y, X), positive inside. At a known slice it is the
        signed distance within the plane. Before the first slice and beyond the last it has the value of the nearest; in
        a periodic volume it goes around. An empty mask has minus the largest gap between slices, a full one plus this
        gap."""
        numbers, places = np.arange(self.length), np.array(self.places)
        distances = plane_distances(self.inside, self.spacing[1:], self.gap * self.spacing[0])
        where = numbers.clip(places[0], places[-1])
        if self.periodic:
            places, distances = np.append(places, places[0] + self.length), np.concatenate([distances, distances[:1]])
            where = (numbers - places[0]) % self.length + places[0]
        if way == "spline":
            curve = CubicSpline(places, distances, bc_type="periodic" if self.periodic else "natural")
        elif way == "linear":
            curve = make_interp_spline(places, distances, k=1)
        else:
            nearest = np.abs(where[:, None] - places).argmin(axis=1)
            return distances[nearest].astype(np.float32)
        return curve(where).astype(np.float32)

    @property
    def gap(self) -> int:
        """The largest distance, in slices, between a known slice and the next."""
        steps = np.diff(self.places)
        return int(max(*steps, self.places[0] + self.length - self.places[-1]) if self.periodic else steps.max())

    @property
    def between(self) -> np.ndarray:
        """Whether each slice of the volume lies between two known ones, bool (length,)."""
        unknown = np.ones(self.length, dtype=bool)
        unknown[list(self.places)] = False
        if not self.periodic:
            unknown[: self.places[0]] = unknown[self.places[-1] :] = False
        return unknown


def turn_axes(numbers: Sequence[Any], axis: int) -> tuple[Any, Any, Any]:
    """Return what there is along each axis, that of `axis` first."""
    first, second, third = (numbers[k] for k in (axis, *(k for k in range(3) if k != axis)))
    return first, second, third


def index_labels(values: np.ndarray, numbers: Sequence[int], ignore: int | None = None) -> np.ndarray:
    """Return the place of each value among some labels, from 1 on, int16; 0 of other values, -1 of `ignore`. Labels of
    64 bits are compared as they are: NumPy joins signed and unsigned ones as floats, which merges some."""
    found = np.zeros(values.shape, dtype=np.int16)
    for place, number in enumerate(numbers, 1):
        found[values == number] = place
    if ignore is not None:
        found[values == ignore] = -1
    return found


def reach_of(places: Sequence[int], length: int) -> slice:
    """Return the slices that are filled: those between known ones, and beyond each end half the gap next to it."""
    before, beyond = (places[1] - places[0]) // 2, (places[-1] - places[-2]) // 2
    return slice(max(places[0] - before, 0), min(places[-1] + beyond + 1, length))


def mark_known(shape: Sequence[int], places: Sequence[int], marks: np.ndarray | None) -> np.ndarray:
    """Return which voxels are known of a volume (Z, Y, X): those of the slices at `places`, and those with a mark."""
    known = np.zeros(shape, dtype=bool) if marks is None else marks != 0
    known[list(places)] = True
    return known


def harmonic_distance(places: Sequence[int], length: int, periodic: bool = False) -> np.ndarray:
    """Return d e / (d + e) for each slice, float64 (length,), where d and e are the distances to the known slices
    before and after it. The error of an interpolation grows in proportion. It is 0 at a known slice and a quarter of
    the gap in the middle; with a known slice on one side only, it is the distance to that one."""
    known, every = np.array(places), np.arange(length)
    if periodic:
        known = np.concatenate([known - length, known, known + length])
    ends = np.concatenate([[-np.inf], known, [np.inf]])
    before, after = every - ends[ends.searchsorted(every, "right") - 1], ends[ends.searchsorted(every)] - every
    near, far = np.minimum(before, after), np.maximum(before, after)
    return near / (1 + near / np.maximum(far, 1))


def plane_distances(masks: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    """Return signed distances within each of the planes (N, Y, X) with voxel edges (y, x), positive inside. An empty
    plane has minus the gap everywhere, a full one plus the gap."""
    distances = np.stack([centre_distance(mask, spacing, dtype=np.float64) for mask in masks])
    return np.where(np.isinf(distances), np.copysign(gap, distances), distances)


def require_labels(values: np.ndarray, name: str, most: float = LABELS) -> np.ndarray:
    """Return the values, or raise ScanError where they are grey levels, or more than `most`; the message calls them
    `name`."""
    values = round_labels(values)
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError(f"{name} must be a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > most:
        raise ScanError(f"{name} must be a mask or have at most {most} labels, got {count} values")
    differ = np.count_nonzero(values[..., 1:] != values[..., :-1])
    if 2 * differ > values.size and (count := len(np.unique(values))) > FEW:
        raise ScanError(
            f"{name} must be a mask or labels, got a grey image: {count} values, and most neighbours differ"
        )
    return values


def require_outline(inside: int, count: int, name: str) -> None:
    """Raise ScanError where of so many voxels none or all are inside; the message calls them `name`."""
    if inside in (0, count):
        raise ScanError(
            f"{name} must have voxels inside and outside, but all are {'full' if inside else 'empty'}; is another "
            "slice the first, is there a label that nobody annotated, or are there several labels?"
        )


def load_with(source: Source, reading: Mapping[str, Any], *more: str, label: int | None = None) -> Volume:
    """Load what goes with another volume: a file or an array with that one's spacing and unit, and `more` of its
    options of reading."""
    names = () if isinstance(source, Volume) else ("spacing", "unit", *more)
    options: dict[str, Any] = {name: reading.get(name) for name in names}
    return load(source, label=label, **options)


def check_spacing(example: Volume, volume: Volume, name: str) -> None:
    """Raise ScanError where an example's voxels differ in size from the volume's; the message calls that `name`."""
    if example.unit != volume.unit or not np.allclose(example.spacing, volume.spacing, rtol=SAME):
        expected, given = (format_sampling(field.shape, field.spacing, field.unit) for field in (volume, example))
        raise ScanError(f"the example must have the spacing of {name} ({expected}), got {given}")
