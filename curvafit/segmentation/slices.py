"""Known slices of a volume, and plain interpolations between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline, make_interp_spline

from curvafit.core.units import METRES, format_sampling
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

__all__ = ["WAYS", "Slices", "check_place", "check_spacing", "labels", "plane_distances", "reach"]

#: Plain interpolations, the usual one first: signed distances on a cubic spline and on lines; the nearest slice.
WAYS = ("spline", "linear", "nearest")


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
    spacing
        Voxel edges (z, y, x).
    unit
        The unit of the spacing.
    periodic
        Whether the last slice of the volume is followed by the first.
    """

    inside: np.ndarray
    places: tuple[int, ...]
    length: int
    spacing: tuple[float, float, float]
    unit: str = "voxel"
    periodic: bool = False

    @property
    def frame(self) -> Field:
        """A volume of zeros that has the place of the whole."""
        return Field(np.broadcast_to(np.float32(0), (self.length, *self.inside.shape[1:])), self.spacing, self.unit)

    def among(self, numbers: Sequence[int]) -> Slices:
        """Return the slices of these numbers in `places`' order, 0 to N - 1."""
        return replace(self, inside=self.inside[list(numbers)], places=tuple(self.places[k] for k in numbers))

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the volume."""
        return (self.length, *self.inside.shape[1:])  # type: ignore[return-value]

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

    @property
    def reach(self) -> np.ndarray:
        """How far each slice is from the known ones, (length,), in the unit of the spacing; see `reach`."""
        return self.spacing[0] * reach(self.places, self.length, self.periodic)

    @property
    def gap(self) -> int:
        """The largest distance of two slices that follow each other, in slices."""
        steps = np.diff(self.places)
        return int(max(*steps, self.places[0] + self.length - self.places[-1]) if self.periodic else steps.max())

    def numbers(self, box: Box) -> list[np.ndarray]:
        """Return the numbers of a box's voxels along each axis."""
        edges = zip(box, self.shape, strict=True)
        return [np.arange(edge.start, n if edge.stop is None else edge.stop) % n for edge, n in edges]

    @property
    def neighbours(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For each slice of the volume: its distance in slices from the nearer of the known slices around it, and the
        numbers of this one and of the other, 0 to N - 1; both are the same before the first and beyond the last.
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

    def distances(self, gap: float) -> np.ndarray:
        """Return the known slices' signed distances within the plane, positive inside: minus `gap` in an empty mask,
        plus `gap` in a full one.
        """
        return plane_distances(self.inside, self.spacing[1:], gap)


def reach(places: Sequence[int], length: int, periodic: bool = False) -> np.ndarray:
    """Return how far slices are from the known ones, float64 (length,), in slices: the error of an interpolation grows
    in proportion.

    With the distances d and e to the known slices before and after it is d e / (d + e): 0 at a known slice, a quarter
    of the gap in its middle. Where there is none on one side, it is the distance to the other.

    Parameters
    ----------
    places
        Numbers of the known slices, ascending.
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
    return np.stack([_plane_distance(mask, spacing, gap) for mask in masks])


def _plane_distance(mask: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    if not mask.any() or mask.all():
        return np.full(mask.shape, gap if mask.any() else -gap)
    inner, outer = (np.asarray(ndimage.distance_transform_edt(side, sampling=spacing)) for side in (mask, ~mask))
    half = min(spacing) / 2
    return np.where(mask, inner - half, half - outer)


#: Most values of a mask; more are grey levels.
LABELS = 256
#: Share by which the voxels of two files may differ in size, and voxels by which the same place may differ.
SAME, ASTRAY = 1e-3, 0.1


def labels(values: np.ndarray, name: str) -> np.ndarray:
    """Return the values of a mask or of labels, which an error calls by a name.

    Raises
    ------
    ScanError
        If they are grey levels.
    """
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError(f"expected {name} with a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > LABELS:
        raise ScanError(f"expected {name} with a mask or at most {LABELS} labels, got {count} values")
    return values


def check_spacing(example: Field, volume: Field, name: str) -> None:
    """Raise ScanError where an example's voxels differ in size from those of a volume, which the error calls `name`."""
    if example.unit != volume.unit or not np.allclose(example.spacing, volume.spacing, rtol=SAME):
        one, two = (format_sampling(each.shape, each.spacing, each.unit) for each in (volume, example))
        raise ScanError(f"expected an example with the spacing of {name} ({one}), got {two}")


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
