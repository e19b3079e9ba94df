"""Another volume, known whole, or a shape grown in its place: it judges ways to fill a volume between slices.

An example also tells the odds of the inside: how likely a voxel between two known slices is inside by its distances
from their outlines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from curvafit.core.runtime import Progress, silent
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.engine import WorkingGrid, normalise_bending
from curvafit.segmentation.slices import Slices, require_labels
from curvafit.segmentation.trials import ODDS, Task
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

#: Longest edge, in voxels, of the box of an example that is read, and of the one on which laws are lowered.
LARGEST, PART = 256, 96
#: The fewest known slices of a box.
FEWEST = 5
#: Signed distances from an outline at which a bin begins, in voxels: structures are some voxels thick.
EDGES = np.array([-22, -17, -13, -10, -8, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22])
#: Deviation by which counts are shared among bins, and voxels that each bin has besides, of the example's share inside.
SHARED, BESIDES = 0.7, 1.0
#: Largest edge of a grown shape's slices, in working voxels.
EDGE = 64
#: Seed of a grown shape.
SEED = 0


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
        """Know an example in slices that are as far apart as those of the volume at most."""
        gap, length = int(np.diff(places).max()), volume.shape[axis]
        if not 1 < gap < length:
            raise ScanError(
                "expected known slices with others between them, and an example longer than their distance, got slices "
                f"{gap} apart and an example of {length}"
            )
        given = range(0, length, gap)
        inside = np.moveaxis(volume.values, axis, 0)
        between = [n for n in range(given[-1]) if n % gap]
        every = Task(Slices.of(volume, given, axis), require_labels(inside[between], "an example") > 0, between)
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


def crop_to_surface(slices: Slices, edge: int = PART) -> tuple[Slices, Box]:
    """Return the known slices in a box that holds most of their surface, at most so many voxels a side but for
    `FEWEST` slices, and its place in the volume."""
    count = max(FEWEST, edge // slices.gap + 1)
    rows, ys, xs = box_with_most_surface(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    places = tuple(place - first for place in slices.places[rows])
    part = replace(slices, inside=slices.inside[rows, ys, xs], places=places, length=places[-1] + 1, periodic=False)
    return part, (slice(first, last + 1), ys, xs)


def _cut(task: Task[Slices], edge: int) -> tuple[Task[Slices], Box]:
    """Return a task within the box of `crop_to_surface`, and the box."""
    given, box = crop_to_surface(task.given, edge)
    kept = [k for k, place in enumerate(task.places) if box[0].start < place < box[0].stop]
    places = [task.places[k] - box[0].start for k in kept]
    return Task(given, task.truth[kept][:, box[1], box[2]], places), box


@dataclass(frozen=True, eq=False)
class Odds:
    """Voxels of an example by their signed distances within the plane from the outlines in the two known slices.

    Attributes
    ----------
    counts
        Voxels inside, and all voxels, of the example's two halves along its last axis: (half, distance from the nearer
        slice in slices, bin of the distance from its outline, bin of that of the other slice's, 2).
    """

    counts: np.ndarray

    @classmethod
    def of(cls, slices: Slices, truth: np.ndarray, places: Sequence[int]) -> Odds:
        """Count, for every bin of distances, the example's voxels between known slices, and those of them inside.

        Parameters
        ----------
        slices
            The example's known slices.
        truth
            The true masks of slices between them, bool (N, Y, X).
        places
            The indices of these slices in the example.
        """
        # Each voxel has the number of its bin in `counts`; counting numbers counts all bins in one pass.
        shape = (2, slices.gap // 2 + 1, len(EDGES) + 1, len(EDGES) + 1)
        bins = (np.broadcast_to(_half(truth.shape), truth.shape), *(each[list(places)] for each in _bins(slices)))
        numbers, size = np.ravel_multi_index(bins, shape), int(np.prod(shape))
        both = [np.bincount(each.ravel(), minlength=size) for each in (numbers[truth], numbers)]
        return cls(np.stack(both, axis=-1).reshape(*shape, 2).astype(np.float64))

    def level(self, slices: Slices, *, crossed: bool = False) -> np.ndarray:
        """Return log odds of the inside, float32 (length, Y, X), above those at which the example's Dice is best.

        A nat counts for a voxel's edge. In the known slices, before the first and beyond the last it is the signed
        distance from the outline in the nearest.

        Parameters
        ----------
        crossed
            The slices are the example's own: each half of it is judged by the counts of the other.
        """
        away, near, far = _bins(slices)
        away = np.minimum(away, self.counts.shape[1] - 1)
        if crossed:
            odds = np.stack([_log_odds(half) for half in self.counts[::-1]])[_half(near.shape), away, near, far]
        else:
            odds = _log_odds(self.counts.sum(0))[away, near, far]
        between = slices.between[:, None, None]
        return np.where(between, odds * min(slices.spacing[1:]), slices.level("nearest")).astype(np.float32)


def _half(shape: tuple[int, ...]) -> np.ndarray:
    """Return the half of each voxel along the last axis, 0 or 1."""
    return np.arange(shape[-1]) * 2 // shape[-1]


def _bins(slices: Slices) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each voxel's distance from the nearer known slice, and the bins of the distances from both outlines."""
    away, near, far = slices.neighbours
    bins = np.digitize(slices.distances(np.inf) / min(slices.spacing[1:]), EDGES)
    return np.broadcast_to(away[:, None, None], (slices.length, *bins.shape[1:])), bins[near], bins[far]


def _log_odds(counts: np.ndarray) -> np.ndarray:
    """Return each bin's log odds of the inside, above those at which the Dice of the bins above them is best."""
    inside, voxels = np.moveaxis(counts, -1, 0)
    share = (inside.sum() + 0.5) / (voxels.sum() + 1)
    smooth = [ndimage.gaussian_filter(each, (0, SHARED, SHARED)) for each in (inside, voxels)]
    likely = (smooth[0] + BESIDES * share) / (smooth[1] + BESIDES)
    odds = np.log(likely / (1 - likely))
    order = np.argsort(-likely, axis=None)
    both, predicted = (np.cumsum(each.ravel()[order]) for each in (inside, voxels))
    best = int(np.argmax(both / (predicted + inside.sum() + 0.5)))
    least = odds.ravel()[order][min(best + 1, len(order) - 1)]
    return odds - (odds.ravel()[order][best] + least) / 2


def grow_task(slices: Slices, law: Coefficients, epsilon: float | None, progress: Progress = silent) -> Task[Slices]:
    """Return the task to fill a shape of a law between the same slices; its slices are cut to `EDGE`.

    The shape has the volume fraction of the known slices.
    """
    times = WorkingGrid.of(slices.frame, epsilon, periodic=True).times
    planes = [min(n, max(4, EDGE // part)) for n, part in zip(slices.inside.shape[1:], times[1:], strict=True)]
    frame = Field(np.broadcast_to(np.float32(0), (slices.length, *planes)), slices.spacing, slices.unit)
    place = WorkingGrid.of(frame, epsilon, periodic=True)
    share = float(slices.inside.mean())
    flow = generate(
        normalise_bending(law).in_unit(place.unit),
        grid=place.grid,
        schedule=LEARNED,
        volume_fraction=share,
        seed=SEED,
        callbacks=[lambda step, total, state: progress("growing a shape of the law", step / total)],
    )
    mask = place.to_scan(flow.field) > 0
    known, rest = list(slices.places), np.setdiff1d(np.arange(slices.length), slices.places)
    inside = mask[known]
    if not flow.finite or inside.all() or not inside.any():
        raise ScanError(
            f"expected a law of which a shape with volume fraction {share:.2g} grows, got none: give an example, or "
            "ask for no runs"
        )
    given = Slices(inside, slices.places, slices.length, slices.spacing, slices.unit, slices.periodic)
    return Task(given, mask[rest], [int(n) for n in rest])
