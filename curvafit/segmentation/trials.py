"""The law that a prior states, and the choice among laws and their strengths by true masks.

Each law is tried at one strength, then the best law at stronger and weaker ones as long as it gets better. A law is
chosen only where it beats the result without a law by more than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Generic, TypeVar

import numpy as np

from curvafit.core.units import METRES, unit_name
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import Law, LawLike
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.known import Known
from curvafit.segmentation.slices import Slices
from curvafit.volumes.run import Run
from curvafit.volumes.volume import Box, ScanError, Volume

#: The known part of a volume.
Given = TypeVar("Given")
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
    notes = ()
    if law.length_unit not in (None, scan.unit):
        notes = (f"The prior's lengths, in {unit_name(law.length_unit)}, are converted to {unit_name(scan.unit)}.",)
    return coefficients, (*notes, f"{law.doubt} Compare the mask with the scan.") if law.doubt else notes


@dataclass(frozen=True)
class Trial:
    """One way to find or fill a structure: the start as it is, or a law lowered from it, with lengths in the scan's
    unit. `strength` is the stiffness of springs on known voxels, or the nats per unit of F_ε; `pull` the stiffness of
    springs on other voxels per nat of their log-odds. A chosen trial has scores: `score`, the Dice of the best law;
    `plain`, that of the start; and `noise`, the standard error of their difference."""

    law: Coefficients | None = None
    strength: float = 0.0
    steps: int = 0
    pull: float = 0.0
    score: float = 0.0
    plain: float = 0.0
    noise: float = 0.0


def search(trials: Sequence[Trial], strengths: Sequence[float], worth: Callable[[Trial], float]) -> Trial:
    """Climb from the best trial to stronger and weaker `strengths`, which ascend, as long as `worth` grows; return the
    best. A trial whose own strength is not among them stays as it is."""
    # A trial takes long, and Dice over the strength has one hump: too weak changes nothing, too strong destroys. So a
    # climb may stop at the first fall, and what lies beyond is not tried.
    first = max(trials, key=worth)
    best = first
    for step in (1, -1):
        current = first
        while current.strength in strengths:
            index = [*strengths].index(current.strength) + step
            following = replace(current, strength=strengths[index]) if 0 <= index < len(strengths) else current
            if following == current or worth(following) <= worth(current):
                break
            current = following
        best = max(best, current, key=worth)
    return best


@dataclass(frozen=True, eq=False)
class Task(Generic[Given]):
    """A volume to fill whose answer is known in part: `given` is the input, slices or evidence; `truth` holds the true
    masks of some slices of the volume, bool (N, Y, X), and `places` their indices, ascending."""

    given: Given
    truth: np.ndarray
    places: Sequence[int]


@dataclass(frozen=True, eq=False)
class Example:
    """An example, cut in two along the longer axis of its slices. In `lesson`, two thirds, every slice is known; in
    `task`, the rest, slices with the gap of the volume to fill. A note says if only a box of the example is read."""

    lesson: Slices
    task: Task[Slices]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, volume: Volume, places: Sequence[int], axis: int) -> Example:
        """Cut an example's mask, `volume`, for another volume with known slices at `places` across `axis`. Raises
        `ScanError` if it is not longer than a gap, is no mask, or has a part without a surface."""
        gap, length = int(np.diff(places).max()), volume.shape[axis]
        if not 1 < gap < length:
            raise ScanError(
                "expected known slices with others between them, and an example longer than their distance, got slices "
                f"{gap} apart and an example of {length}"
            )
        whole, _ = Known(volume, axis, tuple(range(length))).read(Run(), name="the example's slices")
        inside = whole.inside[box_with_most_surface(whole.inside, LARGEST)]
        size = " x ".join(map(str, inside.shape))
        note = f"Of the example {size} voxels are read, where most of its surface is."
        longer = 1 + int(np.argmax(inside.shape[1:]))
        first, rest = np.array_split(inside, [2 * inside.shape[longer] // 3], axis=longer)
        known = range(0, len(inside), gap)
        between = [n for n in range(known[-1]) if n % gap]
        lesson = replace(whole, inside=first, places=tuple(range(len(inside))), length=len(inside))
        given = replace(whole, inside=rest[known], places=tuple(known), length=len(inside))
        if not between or any(not masks.any() or masks.all() for masks in (given.inside, first)):
            raise ScanError(f"expected an example with a surface in both its parts, longer than {gap} slices")
        notes = (note,) if inside.size < whole.inside.size else ()
        return cls(lesson, Task(given, rest[between], between), notes)

    @property
    def part(self) -> Task[Slices]:
        """The task in a box, on which laws are lowered."""
        given, (rows, ys, xs) = crop_to_surface(self.task.given, PART)
        kept = [k for k, place in enumerate(self.task.places) if rows.start < place < rows.stop]
        places = [self.task.places[k] - rows.start for k in kept]
        return Task(given, self.task.truth[kept][:, ys, xs], places)


def crop_to_surface(slices: Slices, edge: int) -> tuple[Slices, Box]:
    """Return the known slices in a box that holds most of their surface, and the box in the volume. Its sides have at
    most `edge` voxels, or more across the slices, where it has `FEWEST_SLICES` known ones."""
    count = max(FEWEST_SLICES, edge // slices.gap + 1)
    rows, ys, xs = box_with_most_surface(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    box = (slice(first, last + 1), ys, xs)
    return slices.crop(box), box


def leave_out_slices(slices: Slices) -> Task[Slices] | None:
    """Return the task to predict every second known slice from the others; None where there are too few, or the others
    have no surface. The ends stay known."""
    count = len(slices.places)
    left_out = range(1, count - 1, 2)
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
    """Return the trial with the best Dice on a task, or the start unless a law beats it by more than the noise. `fill`
    makes a mask (Z, Y, X) of the task's volume by a trial. With `strengths`, which ascend, the best of the trials is
    also tried at stronger and weaker ones (`search`), and the others at its best strength."""

    @cache
    def counts(trial: Trial) -> np.ndarray:
        return tally(fill(task.given, trial)[list(task.places)], task.truth, task.places)

    def worth(trial: Trial) -> float:
        return float(dice_of(counts(trial).sum(0)))

    # The best of several trials scores too well by chance: for a handful of similar ones, by about a standard error of
    # the difference. So a law must beat the start by more than that (`BEYOND`).
    start, best = Trial(), search(trials, strengths, worth)
    best = max((best, *(replace(trial, strength=best.strength) for trial in trials)), key=worth)
    gain, noise = gain_of(counts(best), counts(start))
    chosen = best if gain > BEYOND * noise else start
    return replace(chosen, score=worth(best), plain=worth(start), noise=noise)


def tally(masks: np.ndarray, truth: np.ndarray, places: Sequence[int]) -> np.ndarray:
    """Return the counts for `dice_of` in each of T cubes, (T, 2): the voxels inside both stacks of slices (N, Y, X) at
    `places`, and the sum of those inside one and inside the other."""
    counts = np.stack([masks & truth, masks.astype(np.uint8) + truth.astype(np.uint8)], axis=-1).astype(np.int64)
    for axis, positions in enumerate((places, *map(range, truth.shape[1:]))):
        starts = np.unique(np.asarray(positions) // CUBE, return_index=True)[1]
        counts = np.add.reduceat(counts, starts, axis=axis)
    return counts.reshape(-1, 2)


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    """Return the Dice coefficient of two masks of one shape; 1 where both are empty."""
    return float(dice_of(np.array([np.count_nonzero(mask & truth), np.count_nonzero(mask) + np.count_nonzero(truth)])))


def dice_of(counts: np.ndarray) -> np.ndarray:
    """Return the Dice coefficients of counts (..., 2), as `tally` makes them; 1 where nothing is inside."""
    both, sizes = np.moveaxis(counts, -1, 0)
    return np.where(sizes == 0, 1.0, 2 * both / np.maximum(sizes, 1))


def gain_of(after: np.ndarray, before: np.ndarray) -> tuple[float, float]:
    """Return the difference of the Dice coefficients of two counts (T, 2), and its standard error by a jackknife over
    the cubes. The errors of neighbouring voxels are correlated, those of cubes hardly."""
    # Dice is a ratio of sums, so its error follows from leaving out one cube at a time: (T - 1) / T times the sum of
    # squares of what that changes, which is (T - 1) times their variance.
    whole = dice_of(after.sum(0)) - dice_of(before.sum(0))
    without = dice_of(after.sum(0) - after) - dice_of(before.sum(0) - before)
    return float(whole), float(np.sqrt((len(without) - 1) * without.var()))
