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

#: Plain interpolations: signed distances on a cubic spline or on lines (the default is the first), or nearest slices.
WAYS = ("spline", "linear", "nearest")
#: Most values of a mask; more are grey levels. So are more than `FEW` where most neighbours differ: of labels that are
#: cut from shapes a few in a hundred do, of images of eight bits three in four.
LABELS, FEW = 256, 16
#: The greatest label, of 64 bits.
IDS = 2**64 - 1
#: Relative difference of voxel sizes that count as equal.
SAME = 1e-3
#: The box that is all of a volume.
WHOLE: Box = (slice(0, None), slice(0, None), slice(0, None))


@dataclass(frozen=True, eq=False)
class Slices:
    """The known slices across the first axis of a volume of `length` slices. `inside` holds their masks, bool
    (N, Y, X), in memory or in a file, and `places` their indices, ascending. `marks` holds known voxels of the other
    slices, int8 (length, Y, X): 1 inside, -1 outside, 0 unknown; None if there are none."""

    inside: np.ndarray
    places: tuple[int, ...]
    length: int
    spacing: tuple[float, float, float]
    unit: str = "voxel"
    marks: np.ndarray | None = None

    def crop(self, box: Box) -> Slices:
        """Return what is known in a box of the volume, whose first and last slices must be known."""
        positions, inside = self.known(box)
        marks = None if self.marks is None else self.marks[box]
        length = box[0].stop - box[0].start
        return replace(self, inside=inside, places=tuple(positions), length=length, marks=marks)

    def keep_known(self, mask: np.ndarray, box: Box = WHOLE) -> np.ndarray:
        """Return a copy of the mask (Z, Y, X) of a box in which all known voxels have their known value."""
        positions, inside = self.known(box)
        corrected = mask.copy()
        corrected[positions] = inside
        if self.marks is not None:
            marks = self.marks[box]
            corrected = np.where(marks == 0, corrected, marks > 0)
        return corrected

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
        """The fraction of each known slice that is inside, (N,)."""
        return np.array([self.inside[k].mean() for k in range(len(self.places))])

    @property
    def unfilled(self) -> np.ndarray:
        """Whether each slice is too far beyond the known ones to be filled (`filled_range`), bool (length,)."""
        unfilled = np.ones(self.length, dtype=bool)
        unfilled[filled_range(self.places, self.length)] = False
        return unfilled

    def known(self, box: Box) -> tuple[list[int], np.ndarray]:
        """Return the known slices of a box: their positions, counted from its first slice, and their masks within the
        box, bool (N, Y, X)."""
        start, stop, _ = box[0].indices(self.length)
        rows = [row for row, place in enumerate(self.places) if start <= place < stop]
        return [self.places[row] - start for row in rows], self.inside[rows][:, box[1], box[2]]

    def level(self, way: str) -> np.ndarray:
        """Interpolate signed distances between the known slices by one of `WAYS`: float32 (length, Y, X), positive
        inside. Before the first known slice and beyond the last, the distances of the nearest are repeated. An empty
        slice has minus the largest gap, a full one plus this gap."""
        places = np.array(self.places)
        distances = plane_distances(self.inside, self.spacing[1:], self.gap * self.spacing[0])
        positions = np.arange(self.length).clip(places[0], places[-1])
        if way == "spline":
            curve = CubicSpline(places, distances, bc_type="natural")
        elif way == "linear":
            curve = make_interp_spline(places, distances, k=1)
        else:
            nearest = np.abs(positions[:, None] - places).argmin(axis=1)
            return distances[nearest].astype(np.float32)
        return curve(positions).astype(np.float32)

    @property
    def gap(self) -> int:
        """The largest distance, in slices, between a known slice and the next."""
        return int(np.diff(self.places).max())

    @property
    def between(self) -> np.ndarray:
        """Whether each slice of the volume lies between two known ones, bool (length,)."""
        return mark_between(self.places, self.length)


def axis_first(values: Sequence[Any], axis: int) -> tuple[Any, Any, Any]:
    """Return three values, one for each axis, with that of `axis` moved to the front."""
    others = [value for k, value in enumerate(values) if k != axis]
    return values[axis], others[0], others[1]


def index_labels(values: np.ndarray, labels: Sequence[int], ignore: int | None = None) -> np.ndarray:
    """Replace each value by its index in `labels`, counted from 1; other values by 0, and `ignore` by -1: int16."""
    indices = np.zeros(values.shape, dtype=np.int16)
    for index, label in enumerate(labels, 1):  # not np.isin, which compares int64 with uint64 as floats and merges some
        indices[values == label] = index
    if ignore is not None:
        indices[values == ignore] = -1
    return indices


def filled_range(places: Sequence[int], length: int) -> slice:
    """Return the slices that are filled: those between known ones, and half the nearest gap beyond each end."""
    before, beyond = (places[1] - places[0]) // 2, (places[-1] - places[-2]) // 2
    return slice(max(places[0] - before, 0), min(places[-1] + beyond + 1, length))


def mark_between(places: Sequence[int], length: int) -> np.ndarray:
    """Return whether each slice lies between two known ones, bool (length,)."""
    between = np.zeros(length, dtype=bool)
    between[places[0] : places[-1]] = True
    between[list(places)] = False
    return between


def harmonic_distance(places: Sequence[int], length: int) -> np.ndarray:
    """Return d e / (d + e) for each slice, float64 (length,), where d and e are the distances to the known slices
    before and after it. The error of an interpolation grows in proportion. It is 0 at a known slice and a quarter of
    the gap in the middle; with a known slice on one side only, it is the distance to that one."""
    known, positions = np.array([-np.inf, *places, np.inf]), np.arange(length)
    before = positions - known[known.searchsorted(positions, "right") - 1]
    after = known[known.searchsorted(positions)] - positions
    d, e = np.minimum(before, after), np.maximum(before, after)
    return d / (1 + d / np.maximum(e, 1))  # d e / (d + e), also where d is 0 or e infinite


def plane_distances(masks: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    """Return signed distances within each of the planes (N, Y, X) with voxel edges (y, x), positive inside. An empty
    plane has minus the gap everywhere, a full one plus the gap."""
    distances = np.stack([centre_distance(mask, spacing, dtype=np.float64) for mask in masks])
    return np.where(np.isinf(distances), np.copysign(gap, distances), distances)


def require_labels(values: np.ndarray, name: str, most: float = LABELS) -> np.ndarray:
    """Return a mask or labels with whole numbers as integers; raise ScanError where they are grey levels, or have more
    than `most` different values. The message calls them `name`."""
    values = round_labels(values)
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError(f"{name} must be a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > most:
        raise ScanError(f"{name} must be a mask or have at most {most} labels, got {count} values")
    changes = np.count_nonzero(values[..., 1:] != values[..., :-1])
    if 2 * changes > values.size and (count := len(np.unique(values))) > FEW:
        raise ScanError(
            f"{name} must be a mask or labels, got a grey image: {count} values, and most neighbours differ"
        )
    return values


def load_with(source: Source, reading: Mapping[str, Any], *more: str, label: int | None = None) -> Volume:
    """Load an image, a mask or an example that goes with another volume. A file or an array is read with the `spacing`
    and `unit` in that volume's options of `reading`, and the options named in `more`."""
    names = () if isinstance(source, Volume) else ("spacing", "unit", *more)
    options: dict[str, Any] = {name: reading.get(name) for name in names}
    return load(source, label=label, **options)


def check_spacing(example: Volume, volume: Volume, name: str) -> None:
    """Raise ScanError where an example's voxel size is not that of a volume, which the message calls `name`."""
    if example.unit != volume.unit or not np.allclose(example.spacing, volume.spacing, rtol=SAME):
        expected, actual = (format_sampling(field.shape, field.spacing, field.unit) for field in (volume, example))
        raise ScanError(f"the example must have the spacing of {name} ({expected}), got {actual}")
