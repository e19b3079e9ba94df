"""Another volume, known whole: it judges ways to fill a volume between slices, and tells how likely voxels are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from curvafit.segmentation.calibration import ODDS, Task
from curvafit.segmentation.known import labels
from curvafit.segmentation.odds import Odds
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.weighing import densest
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

__all__ = ["Example", "slices_of", "within"]

#: Longest edge, in voxels, of the box of an example that is read, and of the one on which laws are lowered.
LARGEST, PART = 256, 96
#: The fewest known slices of a box.
FEWEST = 5


@dataclass(frozen=True, eq=False)
class Example:
    """An example in the known slices of a volume.

    Attributes
    ----------
    whole, part
        The tasks to fill all of it, by which plain ways are compared, and a box of it, where laws are lowered.
    box
        The part's place in the whole.
    odds
        Of all of it.
    notes
        A sentence where only a box of the example is read.
    """

    whole: Task[Slices]
    part: Task[Slices]
    box: Box
    odds: Odds
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, volume: Field, places: Sequence[int], axis: int) -> Example:
        """Know an example in slices that are as far apart as those of the volume at most.

        Raises
        ------
        ScanError
            If it is no mask, the slices are all empty or all full, or none would lie between them.
        """
        gap, length = int(np.diff(places).max()), volume.shape[axis]
        if not 1 < gap < length:
            raise ScanError(
                "expected known slices with others between them, and an example longer than their distance, got slices "
                f"{gap} apart and an example of {length}"
            )
        given = range(0, length, gap)
        inside = np.moveaxis(volume.values, axis, 0)
        between = [n for n in range(given[-1]) if n % gap]
        every = Task(slices_of(volume, given, axis), labels(inside[between], "an example") > 0, between)
        whole, _ = _cut(every, LARGEST)
        part, box = _cut(whole, PART)
        read = " x ".join(map(str, whole.given.shape))
        notes = (f"Of the example {read} voxels are read, where most of its surface is.",)
        cut = whole.given.inside.size < every.given.inside.size
        return cls(whole, part, box, Odds.of(whole.given, whole.truth, whole.places), notes if cut else ())

    def level(self, slices: Slices, way: str) -> np.ndarray:
        """Return an interpolation of a volume, or of the example's own slices; `ODDS` is the example's."""
        if way != ODDS:
            return slices.level(way)
        if slices is self.whole.given:
            return self._judged
        return self._judged[self.box] if slices is self.part.given else self.odds.level(slices)

    @cached_property
    def _judged(self) -> np.ndarray:
        """The log odds of the inside of all of it, each half by the counts of the other."""
        return self.odds.level(self.whole.given, crossed=True)


def slices_of(volume: Field, places: Sequence[int], axis: int, periodic: bool = False) -> Slices:
    """Return the known slices of a volume across an axis, which comes first.

    Raises
    ------
    ScanError
        If they are grey levels, or all empty, or all full.
    """
    inside = labels(np.moveaxis(volume.values, axis, 0)[list(places)], "known slices") > 0
    if inside.all() or not inside.any():
        raise ScanError(
            f"expected known slices with voxels inside and outside, got {'full' if inside.all() else 'empty'} ones"
        )
    edges = [volume.spacing[k] for k in (axis, *(k for k in range(3) if k != axis))]
    return Slices(inside, tuple(places), volume.shape[axis], (edges[0], edges[1], edges[2]), volume.unit, periodic)


def within(slices: Slices, edge: int = PART) -> tuple[Slices, Box]:
    """Return the known slices in a box that holds most of their surface, at most so many voxels a side but for
    `FEWEST` slices, and its place in the volume."""
    count = max(FEWEST, edge // slices.gap + 1)
    rows, ys, xs = densest(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    places = tuple(place - first for place in slices.places[rows])
    part = replace(slices, inside=slices.inside[rows, ys, xs], places=places, length=places[-1] + 1, periodic=False)
    return part, (slice(first, last + 1), ys, xs)


def _cut(task: Task[Slices], edge: int) -> tuple[Task[Slices], Box]:
    """Return a task within the box of `within`, and the box."""
    given, box = within(task.given, edge)
    kept = [k for k, place in enumerate(task.places) if box[0].start < place < box[0].stop]
    places = [task.places[k] - box[0].start for k in kept]
    return Task(given, task.truth[kept][:, box[1], box[2]], places), box
