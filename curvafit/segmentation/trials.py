"""The laws that a prior offers, and the choice among them and their strengths by masks that are known.

Each law is tried at one strength, then the best law at stronger and weaker ones as long as it gets better. A law is
chosen only where it beats the plain way by more than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Generic, TypeVar

import numpy as np

from curvafit.core.units import METRES
from curvafit.inference.candidates import load_candidates
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import Law, LawLike
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.known import Known
from curvafit.segmentation.slices import Slices
from curvafit.volumes.run import Run
from curvafit.volumes.volume import Box, ScanError, Volume

#: The known part of a volume.
Given = TypeVar("Given")
#: Candidates of a fit that are laws of their own: the nearest match's destroys.
TRUSTED = ("refined", "posterior", "simulation", "optimum")
#: Longest edge, in voxels, of the box of an example that is read, and of the one on which laws are lowered.
LARGEST, PART = 256, 96
#: The fewest known slices of a box.
FEWEST_SLICES = 5
#: Standard errors by which a trial must be better than a simpler one.
BEYOND = 1.0
#: Edge in voxels of cubes whose errors are taken to be independent.
CUBE = 16


def law_of(prior: LawLike, scan: Volume) -> tuple[Coefficients, tuple[str, ...]]:
    """Return a law's coefficients with lengths in the scan's unit, and sentences on their origin. Raises `ValueError`
    if there is no such preset, or the units of a `fit.json` and the scan cannot be compared."""
    law = Law.of(prior)
    try:
        coefficients = law.in_unit(scan.unit, min(scan.spacing))
    except ValueError as reason:
        mend = ": give --spacing and --unit" if law.fitted and law.length_unit in METRES else ""
        raise ScanError(f"{reason}{mend}") from None
    if not law.fitted:
        note = f"The {law.origin}, at a working voxel of one scan voxel."
        return coefficients, (note,) if law.working else ()
    note = f"The prior's lengths, in {law.length_unit}, are converted to {scan.unit}."
    notes = () if law.length_unit == scan.unit else (note,)
    return coefficients, (*notes, f"{law.doubt} Compare the mask with the scan.") if law.doubt else notes


def laws_of(prior: LawLike, scan: Volume) -> tuple[tuple[Coefficients, ...], tuple[str, ...]]:
    """Return the laws to try for a prior, with lengths in the scan's unit, and sentences on their origin. The first is
    that of `law_of`; of a fit the candidates in `TRUSTED` follow."""
    first, notes = law_of(prior, scan)
    law = Law.of(prior)
    others = [each.coefficients for each in load_candidates(prior) if each.name in TRUSTED] if law.fitted else []
    tried = (replace(law, coefficients=other) for other in others if other != law.coefficients)
    return (first, *(law_of(other, scan)[0] for other in tried)), notes


@dataclass(frozen=True)
class Trial:
    """A way to find or fill a structure: the start as it is, or a law lowered from it, with lengths in the scan's unit.
    `strength` is the stiffness of the springs on known voxels, or the nats of a unit of F_ε; `pull` that of the springs
    on the others for each nat of their log-odds. Once chosen it has the Dice of the best law, `plain`, that of the
    start, and the standard error of their difference, `noise`."""

    law: Coefficients | None = None
    strength: float = 0.0
    steps: int = 0
    pull: float = 0.0
    score: float = 0.0
    plain: float = 0.0
    noise: float = 0.0


def search(trials: Sequence[Trial], strengths: Sequence[float], worth: Callable[[Trial], float]) -> Trial:
    """Return the best of some trials, then climb from it to stronger and weaker strengths as long as they are better.
    `strengths` ascend; a trial whose own strength is not among them stays as it is."""
    # A trial takes long, and Dice over the strength has one hump: too weak changes nothing, too strong destroys. So a
    # climb may stop at the first fall, and what lies beyond is not tried.
    first = max(trials, key=worth)
    best = first
    for step in (1, -1):
        last = first
        while last.strength in strengths:
            number = [*strengths].index(last.strength) + step
            further = replace(last, strength=strengths[number]) if 0 <= number < len(strengths) else last
            if further == last or worth(further) <= worth(last):
                break
            last = further
        best = max(best, last, key=worth)
    return best


@dataclass(frozen=True, eq=False)
class Task(Generic[Given]):
    """The given part of a volume, slices or evidence, and the slices that a filled volume is compared with. `truth`
    holds the true masks of these slices, bool (N, Y, X), and `places` their numbers in the volume, ascending."""

    given: Given
    truth: np.ndarray
    places: Sequence[int]


@dataclass(frozen=True, eq=False)
class Example:
    """An example, cut in two along the longer axis of its slices. Of `lesson`, two thirds, every slice is known; of
    `task`, the rest, slices as far apart as those of the volume to fill. A note says where only a box of the example is
    read."""

    lesson: Slices
    task: Task[Slices]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, volume: Volume, places: Sequence[int], axis: int) -> Example:
        """Cut an example for a volume whose known slices have these places.

        Raises `ScanError` if it is not longer than a gap, is no mask, or has a part without a surface.
        """
        gap, length = int(np.diff(places).max()), volume.shape[axis]
        if not 1 < gap < length:
            raise ScanError(
                "expected known slices with others between them, and an example longer than their distance, got slices "
                f"{gap} apart and an example of {length}"
            )
        whole, *_ = Known(volume, axis, tuple(range(length))).read(Run(), name="the example's slices")
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
    `FEWEST_SLICES` slices, and its place in the volume."""
    count = max(FEWEST_SLICES, edge // slices.gap + 1)
    rows, ys, xs = box_with_most_surface(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    box = (slice(first, last + 1), ys, xs)
    return slices.crop(box), box


def leave_out_slices(slices: Slices) -> Task[Slices] | None:
    """Return the task to predict every second known slice from the others; None where there are too few. The first and
    the last slice are not left out, unless the volume is periodic."""
    count = len(slices.places)
    # In a periodic volume the first slice follows the last, which may go if its neighbours then stay.
    last_may_go = slices.periodic and count % 2 == 0
    left_out = range(1, count if last_may_go else count - 1, 2)
    kept = [k for k in range(count) if k not in left_out]
    given = replace(slices, inside=slices.inside[kept], places=tuple(slices.places[k] for k in kept))
    if not left_out or len(kept) < 2 or given.inside.all() or not given.inside.any():
        return None
    return Task(given, slices.inside[list(left_out)], [slices.places[k] for k in left_out])


def choose_by_masks(
    task: Task[Given],
    trials: Sequence[Trial],
    fill: Callable[[Given, Trial], np.ndarray],
    strengths: Sequence[float] = (),
) -> Trial:
    """Return the trial with the best Dice on a task: a law where it beats the start by more than the noise. `fill`
    fills the task's volume by a trial: a mask (Z, Y, X). The best of the trials is tried at other `strengths`,
    ascending, its own among them, and then the others at the best strength; by default only at their own."""

    @cache
    def counts(trial: Trial) -> np.ndarray:
        return tally(fill(task.given, trial)[list(task.places)], task.truth, task.places)

    def worth(trial: Trial) -> float:
        return float(dice_of(counts(trial).sum(0)))

    # The best of several trials is better than it deserves, by about a standard error of the difference for a handful
    # of trials that are alike; so a law must beat the start by more than that (`BEYOND`).
    start, best = Trial(), search(trials, strengths, worth)
    best = max((best, *(replace(trial, strength=best.strength) for trial in trials)), key=worth)
    gain, noise = gain_of(counts(best), counts(start))
    chosen = best if gain > BEYOND * noise else start
    return replace(chosen, score=worth(best), plain=worth(start), noise=noise)


def tally(masks: np.ndarray, truth: np.ndarray, places: Sequence[int]) -> np.ndarray:
    """Count, in each of T cubes, the voxels inside both stacks of slices, and those inside either added up: (T, 2)."""
    pair = np.stack([masks & truth, masks.astype(np.uint8) + truth.astype(np.uint8)], axis=-1).astype(np.int64)
    for axis, where in enumerate((places, *map(range, truth.shape[1:]))):
        starts = np.unique(np.asarray(where) // CUBE, return_index=True)[1]
        pair = np.add.reduceat(pair, starts, axis=axis)
    return pair.reshape(-1, 2)


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    """Return the Dice coefficient of two masks of one shape; 1 where both are empty."""
    return float(dice_of(np.array([np.count_nonzero(mask & truth), np.count_nonzero(mask) + np.count_nonzero(truth)])))


def dice_of(counts: np.ndarray) -> np.ndarray:
    """Return the Dice coefficients of counts (..., 2), 1 where nothing is inside."""
    both, sizes = np.moveaxis(counts, -1, 0)
    return np.where(sizes == 0, 1.0, 2 * both / np.maximum(sizes, 1))


def gain_of(after: np.ndarray, before: np.ndarray) -> tuple[float, float]:
    """Return the difference of the Dice coefficients of two counts (T, 2), and its error by a jackknife over the cubes.
    The errors of neighbouring voxels are correlated, those of cubes hardly."""
    # Dice is a ratio of sums, so its error follows from leaving out one cube at a time: (T - 1) / T times the sum of
    # squares of what that changes, which is (T - 1) times their variance.
    whole = dice_of(after.sum(0)) - dice_of(before.sum(0))
    without = dice_of(after.sum(0) - after) - dice_of(before.sum(0) - before)
    return float(whole), float(np.sqrt((len(without) - 1) * without.var()))
