"""Known slices of a volume, plain interpolations between them, and checks of masks that are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.ndimage import uniform_filter1d

from curvafit.core.checks import check_float
from curvafit.core.units import METRES, format_sampling
from curvafit.scan.grids import centre_distance
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

#: Plain interpolations, the usual one first: signed distances on a cubic spline and on lines; the nearest slice.
WAYS = ("spline", "linear", "nearest")
#: Most values of a mask; more are grey levels.
LABELS = 256
#: Share by which the voxels of two files may differ in size, and voxels by which the same place may differ.
SAME, ASTRAY = 1e-3, 0.1


@dataclass(frozen=True, eq=False)
class Slices:
    """Known masks across the first axis of a volume.

    Attributes
    ----------
    inside
        The masks, bool (N, Y, X).
    places
        Their numbers along the axis, ascending, N of them.
    length
        Number of slices of the volume.
    spacing, unit
        Voxel edges (z, y, x), and their unit.
    periodic
        Whether the last slice of the volume is followed by the first.
    """

    inside: np.ndarray
    places: tuple[int, ...]
    length: int
    spacing: tuple[float, float, float]
    unit: str = "voxel"
    periodic: bool = False

    @classmethod
    def of(cls, volume: Field, places: Sequence[int], axis: int, periodic: bool = False) -> Slices:
        """Return the known slices of a volume across an axis, which comes first.

        Raises
        ------
        ScanError
            If they are grey levels, or all empty, or all full.
        """
        inside = require_labels(np.moveaxis(volume.values, axis, 0)[list(places)], "known slices") > 0
        if inside.all() or not inside.any():
            state = "full" if inside.all() else "empty"
            raise ScanError(f"expected known slices with voxels inside and outside, got {state} ones")
        edges = [volume.spacing[k] for k in (axis, *(k for k in range(3) if k != axis))]
        return cls(inside, tuple(places), volume.shape[axis], (edges[0], edges[1], edges[2]), volume.unit, periodic)

    def select(self, rows: Sequence[int]) -> Slices:
        """Return some of the known slices, by their rows in `inside`."""
        return replace(self, inside=self.inside[list(rows)], places=tuple(self.places[k] for k in rows))

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the volume."""
        return (self.length, *self.inside.shape[1:])  # type: ignore[return-value]

    @property
    def frame(self) -> Field:
        """A volume of zeros that has the place of the whole."""
        return Field(np.broadcast_to(np.float32(0), self.shape), self.spacing, self.unit)

    def numbers(self, box: Box) -> list[np.ndarray]:
        """Return the numbers of a box's voxels along each axis; a box may lie around a volume that repeats."""
        edges = zip(box, self.shape, strict=True)
        return [np.arange(edge.start, n if edge.stop is None else edge.stop) % n for edge, n in edges]

    def known(self, box: Box) -> tuple[list[int], np.ndarray]:
        """Return the numbers, within a box, of the known slices there, and the masks in the box, bool (N, Y, X)."""
        numbers, ys, xs = self.numbers(box)
        row = {place: k for k, place in enumerate(self.places)}
        rows = [k for k, place in enumerate(numbers) if place in row]
        return rows, self.inside[[row[int(numbers[k])] for k in rows]][:, ys][:, :, xs]

    def level(self, way: str, box: Box | None = None) -> np.ndarray:
        """Return an interpolation, float32 (length, Y, X), positive inside, or a box of it.

        At a known slice it is the signed distance within the plane. Before the first slice and beyond the last it has
        the value of the nearest; in a volume that repeats it goes around. An empty mask has minus the largest gap
        between slices, a full one plus this gap.

        Parameters
        ----------
        way
            One of `WAYS`; the spline is natural, or periodic, and a line between two slices.
        box
            Voxels; of a volume that repeats they may lie around it.
        """
        numbers, ys, xs = self.numbers((slice(0, self.length), slice(0, None), slice(0, None)) if box is None else box)
        places, distances = np.array(self.places), self.distances(self.gap * self.spacing[0])[:, ys][:, :, xs]
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

    def distances(self, gap: float) -> np.ndarray:
        """Return the known slices' signed distances within the plane; see `plane_distances`."""
        return plane_distances(self.inside, self.spacing[1:], gap)

    @property
    def gap(self) -> int:
        """The largest distance of two slices that follow each other, in slices."""
        steps = np.diff(self.places)
        return int(max(*steps, self.places[0] + self.length - self.places[-1]) if self.periodic else steps.max())

    @property
    def harmonic_distance(self) -> np.ndarray:
        """How far each slice is from the known ones, (length,), in the unit of the spacing; see `harmonic_distance`."""
        return self.spacing[0] * harmonic_distance(self.places, self.length, self.periodic)

    @property
    def neighbours(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For each slice of the volume: its distance in slices from the nearer of the known slices around it, and the
        rows in `inside` of this one and of the other; both are the same before the first and beyond the last.
        """
        places, where, count = np.array(self.places), np.arange(self.length), len(self.places)
        before, after = np.searchsorted(places, where, "right") - 1, np.searchsorted(places, where, "left")
        if not self.periodic:
            before, after = before.clip(0), after.clip(max=count - 1)
        down, up = where - places[before % count], places[after % count] - where
        if self.periodic:
            down, up = down % self.length, up % self.length
        before, after, down, up = before % count, after % count, np.abs(down), np.abs(up)
        return np.minimum(down, up), np.where(down <= up, before, after), np.where(down <= up, after, before)

    @property
    def between(self) -> np.ndarray:
        """Which slices of the volume lie between two known ones, bool (length,)."""
        away, near, far = self.neighbours
        return (away > 0) & (near != far)


def known_places(length: int, every: int | None, first: int, known: Sequence[int] | None) -> list[int]:
    """Return the numbers of the known slices, ascending: each `every`-th from `first` on, or those that are listed.

    Raises
    ------
    ScanError
        If both or neither are given, or they are not two or more whole numbers within the volume.
    """
    if (every is None) == (known is None):
        raise ScanError("expected either every how many slices are known, or their numbers")
    numbers = [check_float(n, "whole numbers of slices") for n in ((every, first) if known is None else known)]
    if not all(number == int(number) for number in numbers):
        raise ScanError(f"expected whole numbers of slices, got {', '.join(map(str, numbers))}")
    if every is not None and (every < 1 or first < 0):
        raise ScanError(f"expected every from 1 and first from 0, got {every} and {first}")
    places = sorted({int(n) for n in (known if known is not None else range(int(first), length, int(every or 1)))})
    if len(places) < 2 or places[0] < 0 or places[-1] >= length:
        raise ScanError(f"expected two or more known slices within 0 to {length - 1}, got {places}")
    return places


def harmonic_distance(places: Sequence[int], length: int, periodic: bool = False) -> np.ndarray:
    """Return d e / (d + e) of every slice, float64 (length,), d and e the distances to the known slices on either side.

    The error of an interpolation grows in proportion to it: it is 0 at a known slice, a quarter of the gap in its
    middle. Where there is none on one side, it is the distance to the other.
    """
    known, every = np.array(places), np.arange(length)
    if periodic:
        known = np.concatenate([known - length, known, known + length])
    ends = np.concatenate([[-np.inf], known, [np.inf]])
    before, after = every - ends[ends.searchsorted(every, "right") - 1], ends[ends.searchsorted(every)] - every
    near, far = np.minimum(before, after), np.maximum(before, after)
    return near / (1 + near / np.maximum(far, 1))


def plane_distances(masks: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    """Return signed distances within planes (N, Y, X) with voxel edges (y, x), positive inside; empty and full planes
    have minus and plus the gap.
    """
    distances = np.stack([centre_distance(mask, spacing, dtype=np.float64) for mask in masks])
    return np.where(np.isinf(distances), np.copysign(gap, distances), distances)


def box_with_most_surface(inside: np.ndarray, edges: Sequence[int]) -> Box:
    """Return the box, of at most these edges, that holds most of a mask's surface, wherever it lies."""
    box = [min(n, edge) for n, edge in zip(inside.shape, edges, strict=True)]
    held = count_faces(inside).astype(np.float32)
    for axis, edge in enumerate(box):
        held = uniform_filter1d(held, edge, axis, mode="constant")
    inner = tuple(slice(b // 2, n - (b - 1) // 2) for n, b in zip(inside.shape, box, strict=True))
    z, y, x = (int(k) for k in np.unravel_index(int(held[inner].argmax()), held[inner].shape))
    return slice(z, z + box[0]), slice(y, y + box[1]), slice(x, x + box[2])


def count_faces(inside: np.ndarray) -> np.ndarray:
    """Return how many of a voxel's next neighbours along the axes are on the other side."""
    sides = inside.astype(np.int8)
    z, y, x = (np.abs(np.diff(sides, axis=axis, append=0)) for axis in range(3))
    return z + y + x


# ---- checks ----------------------------------------------------------------------------------------------------------


def require_labels(values: np.ndarray, name: str) -> np.ndarray:
    """Return the values of a mask or of labels; raise ScanError, which calls them by `name`, where they are grey."""
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError(f"expected {name} with a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > LABELS:
        raise ScanError(f"expected {name} with a mask or at most {LABELS} labels, got {count} values")
    return values


def check_spacing(example: Field, volume: Field, name: str) -> None:
    """Raise ScanError where an example's voxels differ in size from those of a volume, which the error calls `name`."""
    if example.unit != volume.unit or not np.allclose(example.spacing, volume.spacing, rtol=SAME):
        expected, given = (format_sampling(field.shape, field.spacing, field.unit) for field in (volume, example))
        raise ScanError(f"expected an example with the spacing of {name} ({expected}), got {given}")


def check_place(mask: Field, probability: Field) -> None:
    """Raise ScanError where a mask does not lie in the voxels of a probability map.

    The affines count where both exist; their units are converted.
    """
    if mask.shape != probability.shape:
        raise ScanError(f"expected a mask of the probabilities' shape {probability.shape}, got {mask.shape}")
    if mask.affine is None or probability.affine is None:
        return
    factor = METRES[mask.unit] / METRES[probability.unit] if {mask.unit, probability.unit} <= METRES.keys() else 1.0
    corners = np.array(list(product(*((0, n - 1) for n in mask.shape[::-1]))))
    one, two = (corners @ affine[:3, :3].T + affine[:3, 3] for affine in (probability.affine, mask.affine))
    far = float(np.linalg.norm(factor * two - one, axis=1).max()) / min(probability.spacing)
    if not far < ASTRAY:
        raise ScanError(f"expected a mask with the probabilities' affine, got one {far:.3g} voxels away")
