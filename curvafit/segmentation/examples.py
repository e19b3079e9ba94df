"""Another volume of the same kind, known whole: two thirds of it teach, and the rest judges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.trials import Task
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

#: Longest edge, in voxels, of the box of an example that is read, and of the one on which laws are lowered.
LARGEST, PART = 256, 96
#: The fewest known slices of a box.
FEWEST = 5


@dataclass(frozen=True, eq=False)
class Example:
    """An example, cut in two along the longer axis of its slices.

    Attributes
    ----------
    lesson
        Two thirds of it, of which every slice is known.
    task
        The rest, known in slices as far apart as those of the volume to fill.
    notes
        A sentence where only a box of the example is read.
    """

    lesson: Slices
    task: Task[Slices]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, volume: Field, places: Sequence[int], axis: int) -> Example:
        """Cut an example for a volume whose known slices have these places.

        Raises `ScanError` if it is not longer than a gap, is no mask, or has a part without a surface.
        """
        gap, length = int(np.diff(places).max()), volume.shape[axis]
        if not 1 < gap < length:
            raise ScanError(
                "expected known slices with others between them, and an example longer than their distance, got slices "
                f"{gap} apart and an example of {length}"
            )
        whole = Slices.of(volume, range(length), axis, name="the example's slices")
        inside = whole.inside[box_with_most_surface(whole.inside, LARGEST)]
        notes = (f"Of the example {' x '.join(map(str, inside.shape))} voxels are read, where most of its surface is.",)
        cut = inside.size < whole.inside.size
        side = 1 + int(np.argmax(inside.shape[1:]))
        lesson, rest = np.array_split(inside, [2 * inside.shape[side] // 3], axis=side)
        known = range(0, len(inside), gap)
        between = [n for n in range(known[-1]) if n % gap]
        given = replace(whole, inside=rest[known], places=tuple(known), length=len(inside))
        every = replace(whole, inside=lesson, places=tuple(range(len(inside))), length=len(inside))
        if not between or any(not part.any() or part.all() for part in (given.inside, lesson)):
            raise ScanError(f"expected an example with a surface in both its parts, longer than {gap} slices")
        return cls(every, Task(given, rest[between], between), notes if cut else ())

    @property
    def part(self) -> Task[Slices]:
        """A box of the task, on which laws are lowered."""
        given, box = crop_to_surface(self.task.given, PART)
        kept = [k for k, place in enumerate(self.task.places) if box[0].start < place < box[0].stop]
        places = [self.task.places[k] - box[0].start for k in kept]
        return Task(given, self.task.truth[kept][:, box[1], box[2]], places)


def crop_to_surface(slices: Slices, edge: int) -> tuple[Slices, Box]:
    """Return the known slices in a box that holds most of their surface, at most so many voxels a side but for
    `FEWEST` slices, and its place in the volume."""
    count = max(FEWEST, edge // slices.gap + 1)
    rows, ys, xs = box_with_most_surface(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    box = (slice(first, last + 1), ys, xs)
    return slices.crop(box), box
