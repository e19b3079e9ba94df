"""The choice between plain ways and priors by masks that are known: slices left out, or an example."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Generic, TypeVar

import numpy as np

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.slices import WAYS, Slices

__all__ = ["BEYOND", "ODDS", "Choice", "Setting", "Task", "choice", "climbed", "left_out", "plainest"]

#: What is given of a volume, and what is tried of it.
Given = TypeVar("Given")
Trial = TypeVar("Trial")
#: The way of `odds.Odds`, beside those of `slices.WAYS`.
ODDS = "odds"
#: Edge of the cubes whose counts are taken to be independent, in voxels.
TILE = 16
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
        starts = np.unique(np.asarray(where) // TILE, return_index=True)[1]
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
