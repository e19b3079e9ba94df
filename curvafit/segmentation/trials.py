"""The choice of a law and its strength by data: known masks, or voxels left out.

Each law is tried at one strength, then the best law at stronger and weaker ones as long as it gets better. A law is
chosen only where it beats the plain way by more than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from typing import Generic, TypeVar

import numpy as np

from curvafit.core.runtime import Progress, silent
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.engine import HALO, WorkingGrid, likelihood, lower_energy
from curvafit.segmentation.evidence import LEAST_NOISE, Classes, VoxelEvidence, grey_evidence
from curvafit.segmentation.slices import Slices
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

#: The known part of a volume.
Given = TypeVar("Given")
#: Longest edge, in voxels, of the box of an example that is read, and of the one on which laws are lowered.
LARGEST, PART = 256, 96
#: The fewest known slices of a box.
FEWEST_SLICES = 5
#: Standard errors by which a trial must be better than a simpler one.
BEYOND = 1.0
#: Edges in voxels of cubes whose errors are taken to be independent: for the Dice of masks, and for grey levels.
CUBE, TILE = 16, 8
#: Longest edge in voxels of the part of a scan on which laws and weights are tried.
EDGE = 64
#: Share of its voxels that is left out at a time, in blocks, and how many times; longest edge of a block, in voxels,
#: and the correlation of the noise below which voxels count as independent.
LEFT_OUT, TIMES, LONGEST_BLOCK, CORRELATED = 0.25, 2, 6, 0.15
#: Weights that are tried, in nats of a unit of F_ε, and the first of them.
WEIGHTS, FIRST = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0), 1.0
#: Most times that the classes are measured again, and the gain in nats below which that ends.
ROUNDS, ENOUGH = 4, 3.0
#: Fewest voxels of a class that is measured again.
FEWEST = 100


@dataclass(frozen=True)
class Trial:
    """A way to find or fill a structure: the start as it is, or a law lowered from there; and its score, once chosen.

    Attributes
    ----------
    law
        Coefficients with lengths in the scan's unit; None where the start stays as it is.
    strength, steps
        Stiffness of the springs on known voxels, or nats of a unit of F_ε; and steps of the flow.
    pull
        Stiffness of the springs on the other voxels for each nat of their log-odds.
    score, plain, noise
        Of the chosen trial: the score of the best law, that of the start, and the standard error of the difference.
        Scores are Dice on known masks, or the share of voxels left out that the law brings to their side (plain: 0).
    """

    law: Coefficients | None = None
    strength: float = 0.0
    steps: int = 0
    pull: float = 0.0
    score: float = 0.0
    plain: float = 0.0
    noise: float = 0.0


def search(trials: Sequence[Trial], strengths: Sequence[float], worth: Callable[[Trial], float]) -> Trial:
    """Return the best of some trials, then climb from it to stronger and weaker strengths as long as they are better.

    `strengths` ascend; a trial whose own strength is not among them stays as it is.
    """
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


# ---- by masks that are known -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Task(Generic[Given]):
    """The given part of a volume, slices or evidence, and the slices that a filled volume is compared with.

    `truth` holds the true masks of these slices, bool (N, Y, X), and `places` their numbers in the volume, ascending.
    """

    given: Given
    truth: np.ndarray
    places: Sequence[int]


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
    `FEWEST_SLICES` slices, and its place in the volume."""
    count = max(FEWEST_SLICES, edge // slices.gap + 1)
    rows, ys, xs = box_with_most_surface(slices.inside, (count, edge, edge))
    first, *_, last = slices.places[rows]
    box = (slice(first, last + 1), ys, xs)
    return slices.crop(box), box


def leave_out_slices(slices: Slices) -> Task[Slices] | None:
    """Return the task to predict every second known slice from the others; None where there are too few.

    The first and the last slice are not left out, unless the volume is periodic.
    """
    number = len(slices.places)
    out = range(1, number - (0 if slices.periodic and number % 2 == 0 else 1), 2)
    rest = [k for k in range(number) if k not in out]
    given = slices.select(rest)
    if not out or len(rest) < 2 or given.inside.all() or not given.inside.any():
        return None
    return Task(given, slices.inside[list(out)], [slices.places[k] for k in out])


def choose_by_masks(
    task: Task[Given],
    trials: Sequence[Trial],
    fill: Callable[[Given, Trial], np.ndarray],
    strengths: Sequence[float] = (),
) -> Trial:
    """Return the trial with the best Dice on a task: a law where it beats the start by more than the noise.

    Parameters
    ----------
    trials
        Trials of laws. The best of them is tried at other strengths, and then the others at the best strength.
    fill
        Fills the task's volume by a trial: a mask (Z, Y, X).
    strengths
        Strengths to try, ascending, the trials' own among them; by default only their own.
    """

    @cache
    def counts(trial: Trial) -> np.ndarray:
        return tally(fill(task.given, trial)[list(task.places)], task.truth, task.places)

    def worth(trial: Trial) -> float:
        return float(dice_of(counts(trial).sum(0)))

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

    The errors of neighbouring voxels are correlated, those of cubes hardly.
    """
    whole = dice_of(after.sum(0)) - dice_of(before.sum(0))
    without = dice_of(after.sum(0) - after) - dice_of(before.sum(0) - before)
    return float(whole), float(np.sqrt((len(without) - 1) * without.var()))


# ---- by voxels that are left out -------------------------------------------------------------------------------------


def choose_by_voxels(
    values: np.ndarray,
    scan: Field,
    classes: Classes,
    laws: Sequence[Coefficients],
    *,
    epsilon: float | None = None,
    steps: int,
    remeasure: bool = True,
    progress: Progress = silent,
) -> tuple[Trial, Classes]:
    """Return the law and weight that predict voxels left out best, and the classes of grey levels to use with them.

    A quarter of the voxels of a part of the scan is left out, in blocks, and then another quarter; each law finds the
    surface from the evidence of the others. `Judge` says what a surface is worth. The best law at the first weight is
    tried at other weights; then with the classes measured again on either side of its surface, as long as that explains
    more; and at last the other laws are tried with these classes.

    Parameters
    ----------
    values
        Grey levels (Z, Y, X), as `grey_levels` returns them.
    classes
        A first guess, whose means are too near to each other where the phases overlap. Returned where no law helps.
    laws
        Coefficients with lengths in the scan's unit.
    remeasure
        Whether the classes are measured again.
    """
    inside = grey_evidence(values, scan, classes).level > 0
    where = box_with_most_surface(inside, EDGE)
    part = replace(scan.crop(where), values=values[where])
    outs = hold_out_masks(part.shape, block_edge(part.values, inside[where]))
    place = WorkingGrid.of(part, epsilon, halo=HALO)
    judge = Judge(part.values, outs, classes, remeasure)
    numbers, expected = count(1), (len(laws) + 2) * (1 + remeasure)

    @cache
    def sides(trial: Trial, classes: Classes) -> np.ndarray | None:
        """Return `predict_sides` under a trial's law; None where the flow fails."""
        progress("trying the prior out", min(next(numbers) / expected, 1.0))

        def find(known: VoxelEvidence) -> np.ndarray:
            term = likelihood(known, trial.strength, place)
            flow = lower_energy(known.level, trial.law, term, place, steps)  # type: ignore[arg-type]
            return place.to_scan(flow.field) > 0

        try:
            return predict_sides(part, outs, classes, find)
        except ScanError:
            return None

    def worth(trial: Trial, classes: Classes) -> float:
        phases = sides(trial, classes)
        return -np.inf if phases is None else judge.worth(phases)

    def best(laws: Sequence[Coefficients | None], strength: float, classes: Classes) -> Trial:
        trials = [Trial(law, strength, steps) for law in laws]
        return search(trials, WEIGHTS, lambda trial: worth(trial, classes))

    # Measuring the classes anew moves the surface, and the surface moves the classes: a few rounds settle both.
    chosen, used = best(laws, FIRST, classes), classes
    for _ in range(ROUNDS if remeasure else 0):
        phases = sides(chosen, used)
        apart = used if phases is None else measure_classes(part.values, phases, used)
        other = best([chosen.law], chosen.strength, apart)
        if worth(other, apart) < worth(chosen, used) + ENOUGH:
            break
        chosen, used = other, apart
    if used != classes:
        chosen = best(laws, chosen.strength, used)
    phases, start = sides(chosen, used), predict_sides(part, outs, classes, lambda known: known.level > 0)
    gain, noise = judge.gain(np.zeros_like(start) if phases is None else phases, start)
    if phases is not None and gain > BEYOND * noise:
        return replace(chosen, score=gain, noise=noise), used
    return replace(chosen, law=None, score=gain, noise=noise), classes


@dataclass(frozen=True, eq=False)
class Judge:
    """Rates two sides, bool (2, Z, Y, X): outside and inside, by the levels (Z, Y, X) of the voxels left out.

    With known classes (`remeasure` false) the worth is the log-likelihood ratio summed over the inside: on average
    (c₁ - c₀)² / 2σ² times the voxels rightly inside less those wrongly inside, whatever the law. Otherwise the worth
    is the variance that the sides' own means explain, whatever classes led to the sides: a mask that grows fat brings
    its classes together, and would win by the classes it made.
    """

    levels: np.ndarray
    outs: Sequence[np.ndarray]
    classes: Classes
    remeasure: bool

    def worth(self, phases: np.ndarray) -> float:
        """Return the log-likelihood of the sides in nats, up to a constant."""
        classes = self.classes
        if self.remeasure:
            return float(np.sign(classes.contrast)) * _explained(self.levels, phases) / (2 * classes.noise**2)
        inside = self.levels[phases[1]].astype(np.float64)
        return float((inside - classes.middle).sum() * classes.contrast / classes.noise**2)

    def gain(self, phases: np.ndarray, start: np.ndarray) -> tuple[float, float]:
        """Return the share of voxels that these sides place better than a start's, and its standard error."""
        classes = measure_classes(self.levels, phases, self.classes) if self.remeasure else self.classes
        change = (phases[1].astype(np.int8) - start[1]) * (self.levels - classes.middle).astype(np.float64)
        for axis, n in enumerate(change.shape):
            change = np.add.reduceat(change, np.arange(0, n, TILE), axis=axis)
        # A voxel that moves to its right side adds (c₁ - c₀) / 2 to this sum on average.
        share = 2 / classes.contrast / sum(int(out.sum()) for out in self.outs)
        nats = self.worth(phases) - self.worth(start)
        error = abs(share) * float(np.sqrt(np.square(change).sum()))
        return nats * self.classes.noise**2 / classes.contrast * share, error


def predict_sides(
    part: Field, outs: Sequence[np.ndarray], classes: Classes, find: Callable[[VoxelEvidence], np.ndarray]
) -> np.ndarray:
    """Return the voxels left out that fall outside and inside the masks found from the others, bool (2, Z, Y, X)."""
    phases = np.zeros((2, *part.shape), dtype=bool)
    for out in outs:
        mask = find(grey_evidence(part.values, part, classes, ~out))
        phases |= np.stack([out & ~mask, out & mask])
    return phases


def measure_classes(levels: np.ndarray, phases: np.ndarray, classes: Classes) -> Classes:
    """Measure the classes of two phases (2, Z, Y, X) anew; keep the old ones where voxels are few or phases swapped."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if min(len(outside), len(inside)) < FEWEST or (inside.mean() - outside.mean()) * classes.contrast <= 0:
        return classes
    low, high = float(outside.mean()), float(inside.mean())
    squares = len(outside) * outside.var() + len(inside) * inside.var()
    noise = max(float(np.sqrt(squares / (len(outside) + len(inside)))), LEAST_NOISE * abs(high - low))
    return Classes(low, high, noise, (low + high) / 2)


def _explained(levels: np.ndarray, phases: np.ndarray) -> float:
    """Return the sum of squares between the means of two phases (2, Z, Y, X), negative where the second is darker."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if not len(outside) or not len(inside):
        return 0.0
    weight = len(outside) * len(inside) / (len(outside) + len(inside))
    contrast = float(inside.mean() - outside.mean())
    return weight * contrast * abs(contrast)


def block_edge(values: np.ndarray, inside: np.ndarray) -> int:
    """Return the edge, in voxels, of the blocks that are left out together when a prior is tried.

    It is twice the first lag at which the noise's correlation is below `CORRELATED` along every axis: in a smaller
    block the noise of the neighbours would tell a voxel's own.
    """
    residual = values - np.where(inside, values[inside].mean(), values[~inside].mean())
    square = float(np.square(residual).mean())
    for reach in range(1, LONGEST_BLOCK // 2):
        turned = (np.moveaxis(residual, axis, 0) for axis in range(3))
        if max(float((rows[reach:] * rows[:-reach]).mean()) for rows in turned) < CORRELATED * square:
            return 2 * reach
    return LONGEST_BLOCK


def hold_out_masks(shape: Sequence[int], edge: int) -> list[np.ndarray]:
    """Return `TIMES` disjoint masks, each of a share `LEFT_OUT` of the voxels, in random blocks."""
    coarse = np.random.default_rng(0).random([-(-n // edge) for n in shape])
    for axis, n in enumerate(shape):
        coarse = np.repeat(coarse, edge, axis=axis).take(range(n), axis=axis)
    return [(LEFT_OUT * k <= coarse) & (coarse < LEFT_OUT * (k + 1)) for k in range(TIMES)]
