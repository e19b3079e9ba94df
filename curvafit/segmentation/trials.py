"""A law and its weight chosen by voxels left out: by how well the others tell their grey levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from scipy import ndimage

from curvafit.core.runtime import Progress, silent
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.engine import HALO, WorkingGrid, weighed
from curvafit.segmentation.evidence import LEAST_NOISE, Classes, VoxelEvidence, of_classes
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box

__all__ = [
    "BEYOND",
    "ODDS",
    "Choice",
    "Setting",
    "Task",
    "Weighing",
    "busiest",
    "choice",
    "climbed",
    "densest",
    "left_out",
    "plainest",
    "trial_steps",
    "weighing",
]

#: Longest edge in voxels of the part on which laws and weights are tried.
EDGE = 64
#: Part of its voxels that is left out, in blocks, and times that others are; longest edge of a block, and correlation
#: of noise that it outlasts.
LEFT_OUT, TIMES, LONGEST_BLOCK, CORRELATED = 0.25, 2, 6, 0.15
#: Weights that are tried, in nats of a unit of the Willmore energy, and the first of them.
WEIGHTS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
FIRST = WEIGHTS.index(1.0)
#: Times that the classes are measured again, as long as that makes so many nats more likely what was left out.
ROUNDS, ENOUGH = 4, 3.0
#: Fewest voxels of a class that are measured.
FEWEST = 100
#: Edge of the cubes whose gains are taken to be independent, in voxels.
TILE = 8


@dataclass(frozen=True)
class Weighing:
    """What voxels left out say of a prior.

    Attributes
    ----------
    law
        Coefficients with lengths in the scan's unit; None where none helps.
    nats
        Its weight, in nats of a unit of the Willmore energy.
    gain, noise
        By which part more of the voxels left out the best law finds on their side of the surface than the start does,
        and its standard error.
    classes
        The grey levels of the two phases, as measured again; as they were given where no law helps.
    """

    law: Coefficients | None
    nats: float
    gain: float
    noise: float
    classes: Classes


def weighing(
    values: np.ndarray,
    scan: Field,
    classes: Classes,
    laws: Sequence[Coefficients],
    *,
    epsilon: float | None = None,
    steps: int,
    measured: bool = True,
    progress: Progress = silent,
) -> Weighing:
    """Return the law, and its weight, that leave the fewest voxels on the wrong side.

    A quarter of the voxels of a part of the scan is left out, in blocks, and then another; from the evidence of the
    others the surface is found by each law. The log-likelihood ratios of the voxels left out, summed over what is
    inside, are in the mean (c₁ - c₀)² / 2σ² times the voxels that are rightly inside less those that are not, whatever
    the law. Where the classes themselves are to be measured, the sides are worth what their own means explain of the
    levels left out, whatever the classes they came from. The best law at the first weight is tried at others; then with
    the classes of the voxels on its sides, as long as that explains more; and at last the other laws with these.

    Parameters
    ----------
    values
        Grey levels (Z, Y, X), as `grey_levels` returns them.
    classes
        A first guess of the classes, which overlapping phases bring together.
    laws
        Coefficients with lengths in the scan's unit.
    steps
        Steps of each flow.
    measured
        Whether the classes are measured again, of the voxels left out on either side; else they stay.

    Raises
    ------
    ScanError
        If the start has one phase only.
    """
    inside = of_classes(values, scan, classes).level > 0
    where = densest(inside, (EDGE, EDGE, EDGE))
    part = replace(scan.crop(where), values=values[where])
    outs = hold_out_masks(part.shape, block_edge(part.values, inside[where]))
    place = WorkingGrid.of(part, epsilon, halo=HALO)
    judge = Judge(part.values, outs, classes, measured)

    def found(known: VoxelEvidence, law: Coefficients, nats: float) -> np.ndarray:
        return place.back(weighed(known, law, nats, place, steps).field) > 0

    trials = _Trials(part, judge, found, _expected(len(laws), measured), progress)
    chosen = trials.best(laws, FIRST, classes)
    for _ in range(ROUNDS if measured else 0):
        apart = measure_classes(part.values, chosen.phases, chosen.classes)
        other = trials.best([chosen.law], chosen.number, apart)
        if other.worth < chosen.worth + ENOUGH:
            break
        chosen = other
    if chosen.classes != classes:
        chosen = trials.best(laws, chosen.number, chosen.classes)
    gain, noise = judge.gain(chosen.phases, predict_sides(part, outs, classes, lambda known: known.level > 0))
    if np.isfinite(chosen.worth) and gain > BEYOND * noise:
        return Weighing(chosen.law, WEIGHTS[chosen.number], gain, noise, chosen.classes)
    return Weighing(None, WEIGHTS[chosen.number], gain, noise, classes)


def busiest(values: np.ndarray, scan: Field, classes: Classes, blocks: Sequence[Box]) -> Box:
    """Return the block, of several of a sample's, that holds most of the surface of its first guess."""
    inside = of_classes(values, scan, classes).level > 0
    return max(blocks, key=lambda block: int(_surface(inside[block]).sum()))


def trial_steps(laws: int, steps: int, voxels: int) -> float:
    """Return about how many steps of a flow on so many voxels it takes to try laws out."""
    return TIMES * _expected(laws, True) * steps * min(1.0, (EDGE + 2 * HALO) ** 3 / voxels)


def _expected(laws: int, measured: bool) -> int:
    """Return about how many laws and weights are tried."""
    return (laws + 2) * (1 + measured)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A law, the number of its weight, the classes by which it was tried; the voxels left out on either side of its
    surface, bool (2, Z, Y, X), and what that is worth, in nats."""

    law: Coefficients
    number: int
    classes: Classes
    phases: np.ndarray
    worth: float


@dataclass(frozen=True, eq=False)
class Judge:
    """What the levels (Z, Y, X) of voxels left out say of two sides, bool (2, Z, Y, X).

    With classes that are known their log-likelihood ratios are summed over the inside; with classes that are to be
    measured the sides are worth what their own means explain, whatever the classes by which they came about.
    """

    levels: np.ndarray
    outs: Sequence[np.ndarray]
    classes: Classes
    measured: bool

    def worth(self, phases: np.ndarray) -> float:
        """Return the log-likelihood of the sides, in nats, but for a constant."""
        classes = self.classes
        if self.measured:
            return float(np.sign(classes.contrast)) * _explained(self.levels, phases) / (2 * classes.noise**2)
        inside = self.levels[phases[1]].astype(np.float64)
        return float((inside - classes.middle).sum() * classes.contrast / classes.noise**2)

    def gain(self, phases: np.ndarray, start: np.ndarray) -> tuple[float, float]:
        """Return by which part more of the voxels are on their side than in other sides, and its standard error."""
        classes = measure_classes(self.levels, phases, self.classes) if self.measured else self.classes
        change = (phases[1].astype(np.int8) - start[1]) * (self.levels - classes.middle).astype(np.float64)
        for axis, n in enumerate(change.shape):
            change = np.add.reduceat(change, np.arange(0, n, TILE), axis=axis)
        right = 2 / classes.contrast / sum(int(out.sum()) for out in self.outs)
        nats = self.worth(phases) - self.worth(start)
        error = abs(right) * float(np.sqrt(np.square(change).sum()))
        return nats * self.classes.noise**2 / classes.contrast * right, error


class _Trials:
    """Trials on a part of a scan by what finds a mask (Z, Y, X) from evidence, by a law and its weight: each is made
    once."""

    def __init__(
        self,
        part: Field,
        judge: Judge,
        found: Callable[[VoxelEvidence, Coefficients, float], np.ndarray],
        expected: int,
        progress: Progress,
    ) -> None:
        self._part, self._judge, self._found = part, judge, found
        self._expected, self._progress = expected, progress
        self._made: dict[tuple[Coefficients, int, Classes], _Trial] = {}

    def best(self, laws: Sequence[Coefficients], number: int, classes: Classes) -> _Trial:
        """Return the best law at the weight of a number, or at the weights on either side of it while they are better
        still."""

        def neighbour(trial: _Trial, step: int) -> _Trial | None:
            further = trial.number + step
            return self._trial(trial.law, further, classes) if 0 <= further < len(WEIGHTS) else None

        first = max((self._trial(law, number, classes) for law in laws), key=_worth)
        return climbed(first, neighbour, _worth)

    def _trial(self, law: Coefficients, number: int, classes: Classes) -> _Trial:
        if (law, number, classes) not in self._made:
            self._progress("trying the prior out", min((len(self._made) + 1) / self._expected, 1.0))
            self._made[law, number, classes] = self._tried(law, number, classes)
        return self._made[law, number, classes]

    def _tried(self, law: Coefficients, number: int, classes: Classes) -> _Trial:
        """Return a trial, one that is worth nothing where the flow fails."""
        try:
            phases = predict_sides(
                self._part, self._judge.outs, classes, lambda known: self._found(known, law, WEIGHTS[number])
            )
        except ScanError:
            return _Trial(law, number, classes, np.zeros((2, *self._part.shape), dtype=bool), -np.inf)
        return _Trial(law, number, classes, phases, self._judge.worth(phases))


def _worth(trial: _Trial) -> float:
    return trial.worth


def predict_sides(
    part: Field, outs: Sequence[np.ndarray], classes: Classes, found: Callable[[VoxelEvidence], np.ndarray]
) -> np.ndarray:
    """Return the voxels left out, bool (2, Z, Y, X), that are outside and inside of what is found of the others."""
    phases = np.zeros((2, *part.shape), dtype=bool)
    for out in outs:
        mask = found(of_classes(part.values, part, classes, ~out))
        phases |= np.stack([out & ~mask, out & mask])
    return phases


def _explained(levels: np.ndarray, phases: np.ndarray) -> float:
    """Return the sum of squares of the levels in two phases `(2, Z, Y, X)` that the phases' means explain, negative
    where the second is the darker one."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if not len(outside) or not len(inside):
        return 0.0
    weight = len(outside) * len(inside) / (len(outside) + len(inside))
    contrast = float(inside.mean() - outside.mean())
    return weight * contrast * abs(contrast)


def measure_classes(levels: np.ndarray, phases: np.ndarray, classes: Classes) -> Classes:
    """Return the classes of the voxels of two phases `(2, Z, Y, X)`; the old ones where these are few, or the other way
    round."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if min(len(outside), len(inside)) < FEWEST or (inside.mean() - outside.mean()) * classes.contrast <= 0:
        return classes
    low, high = float(outside.mean()), float(inside.mean())
    squares = len(outside) * outside.var() + len(inside) * inside.var()
    noise = max(float(np.sqrt(squares / (len(outside) + len(inside)))), LEAST_NOISE * abs(high - low))
    return Classes(low, high, noise, (low + high) / 2)


def densest(inside: np.ndarray, edges: tuple[int, int, int]) -> Box:
    """Return the box, of at most these edges, that holds most of a mask's surface."""
    box = [min(n, edge) for n, edge in zip(inside.shape, edges, strict=True)]
    held = _surface(inside).astype(np.float32)
    for axis, edge in enumerate(box):
        held = ndimage.uniform_filter1d(held, edge, axis, mode="constant")
    inner = tuple(slice(b // 2, n - (b - 1) // 2) for n, b in zip(inside.shape, box, strict=True))
    z, y, x = (int(k) for k in np.unravel_index(int(held[inner].argmax()), held[inner].shape))
    return slice(z, z + box[0]), slice(y, y + box[1]), slice(x, x + box[2])


def _surface(inside: np.ndarray) -> np.ndarray:
    """Return how many of a voxel's next neighbours along the axes are on the other side."""
    sides = inside.astype(np.int8)
    z, y, x = (np.abs(np.diff(sides, axis=axis, append=0)) for axis in range(3))
    return z + y + x


def block_edge(values: np.ndarray, inside: np.ndarray) -> int:
    """Return the edge of a block within which the noise of grey levels may be alike."""
    residual = values - np.where(inside, values[inside].mean(), values[~inside].mean())
    square = float(np.square(residual).mean())
    for reach in range(1, LONGEST_BLOCK // 2):
        products = [float((residual[reach:] * residual[:-reach]).mean()) for residual in _turned(residual)]
        if max(products) < CORRELATED * square:
            return 2 * reach
    return LONGEST_BLOCK


def _turned(values: np.ndarray) -> list[np.ndarray]:
    """Return a volume with each of its axes first."""
    return [np.moveaxis(values, axis, 0) for axis in range(3)]


def hold_out_masks(shape: Sequence[int], edge: int) -> list[np.ndarray]:
    """Return the voxels that are left out, in blocks chosen at random, and those that are left out then: bool of a
    shape."""
    coarse = np.random.default_rng(0).random([-(-n // edge) for n in shape])
    for axis, n in enumerate(shape):
        coarse = np.repeat(coarse, edge, axis=axis).take(range(n), axis=axis)
    return [(LEFT_OUT * k <= coarse) & (coarse < LEFT_OUT * (k + 1)) for k in range(TIMES)]


#: What is given of a volume, and what is tried of it.
Given = TypeVar("Given")
Trial = TypeVar("Trial")
#: The way of `odds.Odds`, beside those of `slices.WAYS`.
ODDS = "odds"
#: Edge of the cubes whose counts are taken to be independent, in voxels.
CUBE = 16
#: Standard errors by which a setting must be better than a simpler one.
BEYOND = 1.0


@dataclass(frozen=True)
class Setting:
    """A way to fill a volume: a plain one, and a law that is lowered from there, or none.

    Attributes
    ----------
    way
        One of `slices.WAYS`, `ODDS` or another plain way.
    law
        Coefficients with lengths in the scan's unit.
    strength, steps
        Stiffness of the springs on known voxels, or nats of a unit of the Willmore energy; and steps of the flow.
    pull
        Stiffness of the springs on the others for each nat of an example's odds.
    """

    way: str
    law: Coefficients | None = None
    strength: float = 0.0
    steps: int = 0
    pull: float = 0.0


@dataclass(frozen=True, eq=False)
class Task(Generic[Given]):
    """What is given of a volume, and masks to compare the volume with.

    Attributes
    ----------
    given
        Slices, or evidence.
    truth
        Known masks, bool (N, Y, X), which are not given.
    places
        Their numbers in the volume, ascending.
    """

    given: Given
    truth: np.ndarray
    places: Sequence[int]


@dataclass(frozen=True)
class Choice:
    """The chosen setting and how it did.

    Attributes
    ----------
    setting
        The setting.
    dice, plain
        Dice of the best prior and of the best plain way on the task's masks.
    noise
        Standard error of the difference.
    """

    setting: Setting
    dice: float
    plain: float
    noise: float


def left_out(slices: Slices) -> Task[Slices] | None:
    """Return the task to predict every second known slice from the others; None where there are too few.

    The first and the last slice are not left out, unless the volume repeats.
    """
    count = len(slices.places)
    out = range(1, count - (0 if slices.periodic and count % 2 == 0 else 1), 2)
    rest = [k for k in range(count) if k not in out]
    given = slices.among(rest)
    if not out or len(rest) < 2 or given.inside.all() or not given.inside.any():
        return None
    return Task(given, slices.inside[list(out)], [slices.places[k] for k in out])


def choice(
    task: Task[Given],
    lowered: Callable[[str], Sequence[Setting]],
    filled: Callable[[Given, Setting], np.ndarray],
    ways: Sequence[str] = WAYS,
    strengths: Sequence[float] = (),
) -> Choice:
    """Return the setting with the best Dice on a task: a prior where it is better than plain beyond the noise.

    Parameters
    ----------
    lowered
        Returns the settings with a law that are lowered from a way: the best of the plain ones. The best is tried at
        the strengths on either side as long as they are better, and the others at the strength that is best then.
    filled
        Fills the volume of what is given by a setting: a mask (Z, Y, X).
    ways
        Plain ways to compare with. Slices left out double the gap, at which the nearest slice may win by much that
        loses by more at the gap itself: there only what is lowered and its start are to be compared.
    strengths
        Strengths to try, ascending, the settings' own among them; by default none but their own.
    """

    @cache
    def counts(setting: Setting) -> np.ndarray:
        return _tallies(filled(task.given, setting)[list(task.places)], task.truth, task.places)

    def worth(setting: Setting) -> float:
        return float(_dice(counts(setting).sum(0)))

    def stronger(setting: Setting, step: int) -> Setting | None:
        number = [*strengths, setting.strength].index(setting.strength) + step
        return replace(setting, strength=strengths[number]) if 0 <= number < len(strengths) else None

    start = Setting(plainest(task, filled, ways))
    settings = lowered(start.way)
    best = climbed(max(settings, key=worth), stronger, worth)
    best = max((best, *(replace(each, strength=best.strength) for each in settings)), key=worth)
    gain = _difference(counts(best), counts(start))
    return Choice(start if gain.within else best, worth(best), worth(start), gain.noise)


def plainest(task: Task[Given], filled: Callable[[Given, Setting], np.ndarray], ways: Sequence[str] = WAYS) -> str:
    """Return the plain way with the best Dice on a task: a later one where it is better beyond the noise."""
    if len(ways) == 1:
        return ways[0]
    places = list(task.places)
    counts = {way: _tallies(filled(task.given, Setting(way))[places], task.truth, places) for way in ways}
    best = ways[0]
    for way in ways[1:]:
        best = best if _difference(counts[way], counts[best]).within else way
    return best


def climbed(first: Trial, neighbour: Callable[[Trial, int], Trial | None], worth: Callable[[Trial], float]) -> Trial:
    """Return the best of a trial and its neighbours on either side, each as long as the last is better than before.

    `neighbour` returns the next trial towards 1 or -1, None beyond the end.
    """
    best = first
    for step in (1, -1):
        last = first
        while (further := neighbour(last, step)) is not None and worth(further) > worth(last):
            last = further
        best = max(best, last, key=worth)
    return best


@dataclass(frozen=True)
class _Difference:
    """The difference of two Dice coefficients and its standard error."""

    gain: float
    noise: float

    @property
    def within(self) -> bool:
        """Return whether the gain is within the noise."""
        return not self.gain > BEYOND * self.noise


def _tallies(masks: np.ndarray, truth: np.ndarray, places: Sequence[int]) -> np.ndarray:
    """Return the voxels in both of two stacks of slices, and the sum of the voxels in each, for each cube: (T, 2)."""
    pair = np.stack([masks & truth, masks.astype(np.uint8) + truth.astype(np.uint8)], axis=-1).astype(np.int64)
    for axis, where in enumerate((places, *map(range, truth.shape[1:]))):
        starts = np.unique(np.asarray(where) // CUBE, return_index=True)[1]
        pair = np.add.reduceat(pair, starts, axis=axis)
    return pair.reshape(-1, 2)


def _dice(counts: np.ndarray) -> np.ndarray:
    """Return the Dice coefficients of counts (..., 2), 1 where nothing is inside."""
    both, sizes = np.moveaxis(counts, -1, 0)
    return np.where(sizes == 0, 1.0, 2 * both / np.maximum(sizes, 1))


def _difference(after: np.ndarray, before: np.ndarray) -> _Difference:
    """Return the difference of two Dice coefficients of counts (T, 2), with the jackknife's error over the cubes."""
    whole = _dice(after.sum(0)) - _dice(before.sum(0))
    each = _dice(after.sum(0) - after) - _dice(before.sum(0) - before)
    return _Difference(float(whole), float(np.sqrt((len(each) - 1) * each.var())))
