"""The choice between plain interpolations and priors by slices whose content is known: left out, or an example's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.slices import WAYS, Slices

__all__ = ["ODDS", "Choice", "Setting", "Task", "choice", "left_out"]

#: The way of `odds.Odds`, beside those of `slices.WAYS`.
ODDS = "odds"
#: Edge of the tiles of a slice whose counts are taken to be independent, in voxels.
TILE = 16
#: Standard errors by which a setting must be better than a simpler one.
BEYOND = 1.0


@dataclass(frozen=True)
class Setting:
    """A way to fill a volume: an interpolation, and a law that is lowered from there, or none.

    Attributes
    ----------
    way
        One of `slices.WAYS`, or `ODDS`.
    law
        Coefficients with lengths in the scan's unit.
    stiffness, steps
        Stiffness of the springs on known voxels, and steps of the flow.
    pull
        Stiffness of the springs on the others for each nat of an example's odds.
    """

    way: str
    law: Coefficients | None = None
    stiffness: float = 0.0
    steps: int = 0
    pull: float = 0.0


@dataclass(frozen=True, eq=False)
class Task:
    """Slices to fill a volume from, and others to compare it with.

    Attributes
    ----------
    slices
        What is given.
    truth
        Other masks, bool (N, Y, X).
    places
        Their numbers in the volume.
    """

    slices: Slices
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
        Dice of the best prior and of the best plain interpolation on the task's slices.
    noise
        Standard error of the difference.
    """

    setting: Setting
    dice: float
    plain: float
    noise: float


def left_out(slices: Slices) -> Task | None:
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
    task: Task,
    lowered: Callable[[str], Sequence[Setting]],
    filled: Callable[[Slices, Setting], np.ndarray],
    ways: Sequence[str] = WAYS,
) -> Choice:
    """Return the setting with the best Dice on a task: a prior where it is better than plain beyond the noise.

    Parameters
    ----------
    lowered
        Returns the settings with a law that are lowered from a way: the best of the plain ones.
    ways
        Plain interpolations to compare with. Slices left out double the gap, at which the nearest slice may win by much
        that loses by more at the gap itself: there only what is lowered and its start are to be compared.
    filled
        Fills the volume between slices by a setting: a mask (Z, Y, X).
    """

    def counts(setting: Setting) -> np.ndarray:
        return _tallies(filled(task.slices, setting)[list(task.places)], task.truth)

    start, before = Setting(ways[0]), counts(Setting(ways[0]))
    for each in map(Setting, ways[1:]):
        start, before = _better((each, counts(each)), (start, before))
    tried = [(each, counts(each)) for each in lowered(start.way)]
    best, after = max(tried, key=lambda each: float(_dice(each[1].sum(0))))
    with_prior, without = (float(_dice(each.sum(0))) for each in (after, before))
    return Choice(_better((best, after), (start, before))[0], with_prior, without, _difference(after, before)[1])


def _better(new: tuple[Setting, np.ndarray], old: tuple[Setting, np.ndarray]) -> tuple[Setting, np.ndarray]:
    """Return the new setting and its counts where they are better beyond the noise, else the old ones."""
    gain, noise = _difference(new[1], old[1])
    return new if gain > BEYOND * noise else old


def _tallies(masks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the voxels in both of two stacks of slices, and the sum of the voxels in each, for each tile: (T, 2)."""
    edges = [np.arange(0, n, TILE) for n in truth.shape[1:]]
    pair = np.stack([masks & truth, masks.astype(np.uint8) + truth.astype(np.uint8)], axis=-1).astype(np.int64)
    return np.add.reduceat(np.add.reduceat(pair, edges[0], axis=1), edges[1], axis=2).reshape(-1, 2)


def _dice(counts: np.ndarray) -> np.ndarray:
    """Return the Dice coefficients of counts (..., 2), 1 where nothing is inside."""
    both, sizes = np.moveaxis(counts, -1, 0)
    return np.where(sizes == 0, 1.0, 2 * both / np.maximum(sizes, 1))


def _difference(after: np.ndarray, before: np.ndarray) -> tuple[float, float]:
    """Return the difference of two Dice coefficients and its standard error, the jackknife's over tiles."""
    whole = _dice(after.sum(0)) - _dice(before.sum(0))
    each = _dice(after.sum(0) - after) - _dice(before.sum(0) - before)
    return float(whole), float(np.sqrt((len(each) - 1) * each.var()))
