"""A law and its weight chosen by voxels left out: by how well the others tell their grey levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import ndimage

from curvafit.priors.coefficients import Coefficients
from curvafit.progress import Progress, silent
from curvafit.segmentation.calibration import BEYOND
from curvafit.segmentation.engine import HALO, weighed
from curvafit.segmentation.evidence import LEAST_NOISE, Classes, VoxelEvidence, of_classes
from curvafit.segmentation.working import WorkingGrid
from curvafit.volumes.field import Field, ScanError

__all__ = ["Weighing", "trial_steps", "weighing"]

#: Longest edge in voxels of the part on which laws and weights are tried.
EDGE = 64
#: Part of its voxels that is left out, in blocks, and times that others are; longest edge of a block, and correlation
#: of noise that it outlasts.
LEFT_OUT, TIMES, LONGEST_BLOCK, CORRELATED = 0.25, 2, 6, 0.15
#: Weights that are tried, in nats of a unit of the Willmore energy, and the first of them.
WEIGHTS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
FIRST = WEIGHTS.index(1.0)
#: Times that the classes are measured again. All laws are tried in the first round and the last.
ROUNDS = 3
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
    the law. The best law at the first weight is tried at others.

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
        Whether the classes are measured again, of the voxels left out on either side, where these sides explain more of
        their levels than those of the start; else they stay.

    Raises
    ------
    ScanError
        If the start has one phase only.
    """
    given, inside = classes, of_classes(values, scan, classes).level > 0
    where = _busiest(inside)
    part = replace(scan.crop(where), values=values[where])
    outs = _blocks(part.shape, _outlasting(part.values, inside[where]))
    place = WorkingGrid.of(part, epsilon, halo=HALO)
    rounds, count = ROUNDS if measured else 1, 0

    @cache
    def trial(law: Coefficients, nats: float, classes: Classes) -> _Trial:
        nonlocal count
        count += 1
        progress("trying the prior out", min(count / _trials(len(laws), rounds), 1.0))
        return _tried(part, outs, classes, lambda known: place.back(weighed(known, law, nats, place, steps).field) > 0)

    best = laws[0]
    for number in range(rounds):
        asked = laws if number in (0, rounds - 1) else [best]
        trials = [trial(law, WEIGHTS[FIRST], classes) for law in asked]
        best, first = max(zip(asked, trials, strict=True), key=lambda each: each[1].worth)
        if measured:
            classes = first.classes
    tried = {FIRST: trial(best, WEIGHTS[FIRST], classes)}
    for step in (1, -1):
        number = FIRST + step
        while 0 <= number < len(WEIGHTS):
            tried[number] = trial(best, WEIGHTS[number], classes)
            if tried[number].worth <= tried[number - step].worth:
                break
            number += step
    number = max(tried, key=lambda each: tried[each].worth)
    gain, noise = tried[number].gain, tried[number].noise
    if gain > BEYOND * noise:
        return Weighing(best, WEIGHTS[number], gain, noise, classes)
    return Weighing(None, WEIGHTS[number], gain, noise, given)


def trial_steps(laws: int, steps: int, voxels: int) -> float:
    """Return about how many steps of a flow on so many voxels it takes to try laws out."""
    return TIMES * _trials(laws, ROUNDS) * steps * min(1.0, (EDGE + 2 * HALO) ** 3 / voxels)


def _trials(laws: int, rounds: int) -> int:
    """Return about how many laws and weights are tried."""
    return laws + (rounds > 1) * (laws + rounds - 2) + 3


@dataclass(frozen=True)
class _Trial:
    """What a law and a weight make of voxels left out: the sum of the log-likelihood ratios of those inside, in nats;
    gain and standard error, as in `Weighing`; and the classes on either side."""

    worth: float
    gain: float
    noise: float
    classes: Classes


def _tried(
    part: Field, outs: Sequence[np.ndarray], classes: Classes, found: Callable[[VoxelEvidence], np.ndarray]
) -> _Trial:
    """Return the trial of what finds a mask (Z, Y, X) from evidence, on a part of which some voxels are left out, and
    then others."""
    levels = part.values
    ratio = of_classes(levels, part, classes).ratio.astype(np.float64)
    worth, change = 0.0, np.zeros(levels.shape)
    phases, starts = np.zeros((2, 2, *levels.shape), dtype=bool)
    for out in outs:
        known = of_classes(levels, part, classes, ~out)
        try:
            mask = found(known)
        except ScanError:
            return _Trial(-np.inf, -1.0, 0.0, classes)
        worth += float(ratio[out & mask].sum())
        change += np.where(out, (mask.astype(np.int8) - (known.level > 0)) * ratio, 0)
        phases |= np.stack([out & ~mask, out & mask])
        starts |= np.stack([out & (known.level <= 0), out & (known.level > 0)])
    for axis, n in enumerate(levels.shape):
        change = np.add.reduceat(change, np.arange(0, n, TILE), axis=axis)
    right = 2 * (classes.noise / classes.contrast) ** 2 / sum(int(out.sum()) for out in outs)
    error = float(np.sqrt(np.square(change).sum()))
    explains = _explained(levels, phases) > _explained(levels, starts)
    measured = _measured(levels, phases, classes) if explains else classes
    return _Trial(worth, right * float(change.sum()), right * error, measured)


def _explained(levels: np.ndarray, phases: np.ndarray) -> float:
    """Return the sum of squares of the levels in two phases `(2, Z, Y, X)` that the phases' means explain."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if not len(outside) or not len(inside):
        return 0.0
    weight = len(outside) * len(inside) / (len(outside) + len(inside))
    return float(weight * (inside.mean() - outside.mean()) ** 2)


def _measured(levels: np.ndarray, phases: np.ndarray, classes: Classes) -> Classes:
    """Return the classes of the voxels of two phases `(2, Z, Y, X)`; the old ones where these are few, or the other way
    round."""
    outside, inside = (levels[phase].astype(np.float64) for phase in phases)
    if min(len(outside), len(inside)) < FEWEST or (inside.mean() - outside.mean()) * classes.contrast <= 0:
        return classes
    low, high = float(outside.mean()), float(inside.mean())
    squares = len(outside) * outside.var() + len(inside) * inside.var()
    noise = max(float(np.sqrt(squares / (len(outside) + len(inside)))), LEAST_NOISE * abs(high - low))
    return Classes(low, high, noise, (low + high) / 2)


def _busiest(inside: np.ndarray) -> tuple[slice, slice, slice]:
    """Return the box, of edges up to `EDGE`, that holds most of a mask's surface."""
    surface = sum(np.abs(np.diff(inside.astype(np.int8), axis=axis, append=0)) for axis in range(3))
    box = [min(n, EDGE) for n in inside.shape]
    held = np.asarray(surface, dtype=np.float32)
    for axis, edge in enumerate(box):
        held = ndimage.uniform_filter1d(held, edge, axis, mode="constant")
    inner = tuple(slice(b // 2, n - (b - 1) // 2) for n, b in zip(inside.shape, box, strict=True))
    z, y, x = (int(k) for k in np.unravel_index(int(held[inner].argmax()), held[inner].shape))
    return slice(z, z + box[0]), slice(y, y + box[1]), slice(x, x + box[2])


def _outlasting(values: np.ndarray, inside: np.ndarray) -> int:
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


def _blocks(shape: Sequence[int], edge: int) -> list[np.ndarray]:
    """Return the voxels that are left out, in blocks chosen at random, and those that are left out then: bool of a
    shape."""
    coarse = np.random.default_rng(0).random([-(-n // edge) for n in shape])
    for axis, n in enumerate(shape):
        coarse = np.repeat(coarse, edge, axis=axis).take(range(n), axis=axis)
    return [(LEFT_OUT * k <= coarse) & (coarse < LEFT_OUT * (k + 1)) for k in range(TIMES)]
