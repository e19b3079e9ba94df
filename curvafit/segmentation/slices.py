"""Known slices of a volume, and plain interpolations between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline, make_interp_spline

from curvafit.volumes.field import Field
from curvafit.volumes.formats.part import Box

__all__ = ["WAYS", "Slices"]

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
        numbers, ys, xs = self._numbers(box)
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
        numbers, ys, xs = self._numbers((slice(0, self.length), slice(0, None), slice(0, None)) if box is None else box)
        places, distances = np.array(self.places), self._distances(ys, xs)
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
        """The largest distance of two slices that follow each other, in slices."""
        steps = np.diff(self.places)
        return int(max(*steps, self.places[0] + self.length - self.places[-1]) if self.periodic else steps.max())

    def _numbers(self, box: Box) -> list[np.ndarray]:
        """Return the numbers of a box's voxels along each axis."""
        edges = zip(box, self.shape, strict=True)
        return [np.arange(edge.start, n if edge.stop is None else edge.stop) % n for edge, n in edges]

    def _distances(self, ys: np.ndarray, xs: np.ndarray) -> np.ndarray:
        """Return the signed distances within the known planes, at these rows and columns."""
        edges, gap = self.spacing[1:], self.gap * self.spacing[0]
        return np.stack([_plane_distance(mask, edges, gap)[np.ix_(ys, xs)] for mask in self.inside])


def _plane_distance(mask: np.ndarray, spacing: Sequence[float], gap: float) -> np.ndarray:
    if not mask.any() or mask.all():
        return np.full(mask.shape, gap if mask.any() else -gap)
    inner, outer = (np.asarray(ndimage.distance_transform_edt(side, sampling=spacing)) for side in (mask, ~mask))
    half = min(spacing) / 2
    return np.where(mask, inner - half, half - outer)
