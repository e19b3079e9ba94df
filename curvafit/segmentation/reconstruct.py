"""A volume between known slices: plain interpolation, or F_ε lowered from there with the slices held."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from curvafit.core.checks import SEEDS, check_float, check_int
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation import data
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.engine import STEPS, LawLike, WorkingGrid, drawn_laws, laws_of
from curvafit.segmentation.examples import Example, grown, slices_of, within
from curvafit.segmentation.result import Segmentation, Uncertainty, ending, filled, result_of
from curvafit.segmentation.slices import WAYS, Slices, check_spacing, labels
from curvafit.segmentation.tiles import Tiling, lowered
from curvafit.segmentation.trials import ODDS, Choice, Setting, Task, choice, left_out, plainest
from curvafit.segmentation.uncertainty import RUNS, Chances, chances, entropy, suggestions
from curvafit.volumes.boxes import digest_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box
from curvafit.volumes.read import Source, field_of

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference

__all__ = ["SlicesProblem", "known_places", "labels_of", "reconstruct", "reconstruct_labels"]

#: Stiffness of the springs on known voxels, in working units: a tenth of it gives way, ten times as much stalls.
STIFFNESS = 1e7
#: Margin of the springs: u of the optimal profile half a voxel from the surface, as known voxels next to it are.
MARGIN = math.tanh(WORKING_SPACING / 2 / (math.sqrt(2) * WORKING_EPSILON))
#: Least and greatest stiffness.
STIFFEST = (1e-9, 1e12)
#: Most runs.
MOST = 1000
#: Stiffness of the springs on other voxels, in working units, for each nat of an example's odds: one is tried after the
#: other.
PULLS = (1e4, 3e4)


def reconstruct(
    slices: Source,
    prior: LawLike,
    *,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    axis: int = 0,
    example: Source | None = None,
    stiffness: float | None = None,
    periodic: bool = False,
    runs: int = 0,
    suggest: int = 0,
    epsilon: float | None = None,
    steps: int = STEPS,
    tile: int | None = None,
    store: str | PathLike[str] | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Fill a volume between known slices: lower F_ε from an interpolation if that is better than the interpolation.

    What is better is tried out on an example that is degraded as the volume is, or else on every second known slice,
    which the others predict. The example also tells how likely voxels between two slices are inside, by their distances
    from both outlines: where that is the best interpolation, these odds hold the surface while F_ε is lowered. Known
    slices stay as they are. Where the volume ends, the surface goes on freely.

    Parameters
    ----------
    slices
        A mask, or labels, of the whole volume's shape, positive inside, as a path, a `Field`, an array or a tensor;
        only the known slices count.
    prior
        As in `segment`. Each law that a fit trusts is tried.
    every, first
        Slices `first`, `first + every`, … along `axis` are known. The volume is extrapolated before the first known
        slice and beyond the last.
    known
        The numbers of the known slices, two or more, in place of `every` and `first`.
    axis
        The axis of the array, 0, 1 or 2, that is z, y or x.
    example
        A mask of another volume of the same kind, known whole. A file or an array has the slices' `spacing` and `unit`.
    stiffness
        Stiffness of the springs on known voxels, in working units: nothing is tried out, and the first law is lowered
        from the spline.
    periodic
        Whether the volume repeats, as generated ones do.
    runs
        Number of further runs, from other starts and under laws drawn from a fit's posterior. How probable the inside
        is where they agree is learned from the example, or else from a shape grown from the law: two flows a run.
    suggest
        Number of slices to suggest: those to annotate next; needs `runs`, by default 8.
    epsilon, steps, tile, store, workers, progress, reading
        As in `segment`.

    Raises
    ------
    ValueError
        As `segment`; or if fewer than two slices are known, or too few to try the prior out on and there is neither an
        example nor a stiffness; or if known slices are all empty, all full or grey levels, the example's
        spacing is another one, or more slices are to be suggested than are unknown.
    FileNotFoundError
        If there is no such `fit.json`.
    """
    volume = field_of(slices, **reading)
    axis = check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    places = known_places(volume.shape[axis], every, first, known)
    target = slices_of(volume, places, axis, periodic)
    tiling = Tiling.of(target.frame, epsilon, tile, periodic=periodic)
    if stiffness is not None:
        stiffness = check_float(stiffness, "a positive stiffness", *STIFFEST)
    suggest = check_int(suggest, "a number of slices from 0", 0, volume.shape[axis] - len(places))
    runs = check_int(runs, "a number of runs from 0", 0, MOST)
    other = None if example is None else Example.of(_like(example, volume, reading), places, axis)
    laws, notes = laws_of(prior, volume)
    if suggest and not runs:
        runs, notes = RUNS, (*notes, f"Suggestions need runs: {RUNS} are made.")
    firm = STIFFNESS if stiffness is None else stiffness
    level = Slices.level if other is None else other.level

    def settings(way: str) -> list[Setting]:
        pulls = PULLS if way == ODDS else (0.0,)
        return [Setting(way, law, firm, steps, pull) for law, pull in product(laws, pulls)]

    def start(slices: Slices, setting: Setting) -> np.ndarray | None:
        return level(slices, ODDS) if setting.way == ODDS else None

    def fill(slices: Slices, setting: Setting) -> np.ndarray:
        if setting.law is None:
            return level(slices, setting.way) > 0
        step: Progress = lambda _, share: progress("trying the prior out", share)  # noqa: E731
        return _filled(SlicesProblem(slices, setting, start(slices, setting)), epsilon, None, step)[0]

    def again(slices: Slices, setting: Setting, moved: np.ndarray, step: Progress) -> tuple[np.ndarray, float]:
        steps: Progress = lambda _, share: step("running again", share)  # noqa: E731
        return _filled(SlicesProblem(slices, setting, moved), epsilon, tile, steps)[1], tiling.place.epsilon

    chosen, tried, uncertain = settings("spline")[0], "", None
    fair = (grown(target, laws[0], epsilon, progress) if other is None else other.part) if runs else None
    if stiffness is None:
        task = left_out(target if tiling.count == 1 else within(target)[0]) if other is None else other.part
        way = "spline" if other is None else plainest(other.whole, fill, (*WAYS, ODDS))
        best = choice(_sure(task, len(places)), settings, fill, (way,))
        chosen, tried = best.setting, _gain(best, "left out" if other is None else "of the example")
    between = SlicesProblem(target, chosen, start(target, chosen))
    mask, u, end = _filled(between, epsilon, tile, progress, store=store, workers=workers)
    if fair is not None:
        drawn = () if chosen.law is None else drawn_laws(prior, volume, runs)
        likely = chances(fair, target, chosen, drawn or (chosen.law,), runs, level=level, flow=again, progress=progress)
        uncertain = _uncertainty(likely, target, volume, axis, range(runs), suggest)
        end = f"{end}; {_learned(uncertain, 'a shape of the law' if other is None else 'the example')}"
    notes = (*notes, *(() if other is None else other.notes), *_known(places, volume.shape[axis]), *tiling.place.notes)
    mask, u = (np.ascontiguousarray(np.moveaxis(each, 0, axis)) for each in (mask, u))
    more = {"weight": None, "law": chosen.law, "epsilon": tiling.place.epsilon, "uncertainty": uncertain}
    return result_of(volume, mask, u, status=f"{tried}{end}", notes=notes, **more)


@dataclass(frozen=True, eq=False)
class SlicesProblem:
    """The volume between slices, which a setting fills from an interpolation (length, Y, X), by default that of its
    way."""

    slices: Slices
    setting: Setting
    level: np.ndarray | None = None

    @property
    def law(self) -> Coefficients | None:
        return self.setting.law

    @property
    def steps(self) -> int:
        return self.setting.steps

    @property
    def parts(self) -> dict[str, object]:
        slices, setting = self.slices, self.setting
        numbers = {"places": slices.places, "spacing": slices.spacing, "periodic": slices.periodic}
        start = setting.way if self.level is None else digest_of(self.level)
        springs = {"strength": setting.strength, "pull": setting.pull}
        return {"slices": digest_of(slices.inside), **numbers, "start": start, **springs}

    def given(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, data.Data]:
        """Return the interpolation, and springs on the known voxels and on those that odds hold."""
        slices, setting, (rows, inside) = self.slices, self.setting, self.slices.known(box)
        numbers = slices.numbers(box)
        level = slices.level(setting.way, box) if self.level is None else self.level[np.ix_(*numbers)]
        held = slices.between[numbers[0], None, None]
        pull = np.where(held, setting.pull / min(slices.spacing[1:]) * level, 0).astype(np.float32)
        pull[rows] = np.where(inside, setting.strength, -setting.strength)
        return level, data.Hinge(place.spread(pull, centre=0), MARGIN)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the profile of the interpolation."""
        return np.tanh(level / (math.sqrt(2) * place.epsilon))

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the voxels where the phase field is positive, and the known ones as they are."""
        mask, (rows, inside) = phase > 0, self.slices.known(box)
        mask[rows] = inside
        return mask


def _filled(
    between: SlicesProblem, epsilon: float | None, tile: int | None, progress: Progress, **tools: Any
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the mask and the phase field of a volume that a setting fills, and how its flow ended."""
    tiling = Tiling.of(between.slices.frame, epsilon, tile, periodic=between.slices.periodic)
    found = lowered(between, tiling, progress=progress, **tools)
    return found.mask, found.phase, filled(found.mask) if between.law is None else ending(found)


def _sure(task: Task[Slices] | None, count: int) -> Task[Slices]:
    """Return a task; raise ScanError where the slices, so many, give none."""
    if task is None:
        raise ScanError(
            "expected three or more known slices with voxels inside and outside, an example or a stiffness, got "
            f"{count} slices"
        )
    return task


def _uncertainty(
    odds: Chances, slices: Slices, volume: Field, axis: int, seeds: Sequence[int], count: int
) -> Uncertainty:
    """Return what probabilities say of a volume, and so many suggestions."""
    entropies = entropy(odds.values).sum((1, 2))
    values = np.ascontiguousarray(np.moveaxis(odds.values, 0, axis))
    probability = replace(volume, values=values, notes=())
    following = suggestions(entropies, slices.places, count, slices.periodic)
    return Uncertainty(probability, tuple(seeds), odds.error, following)


def _learned(uncertain: Uncertainty, where: str) -> str:
    """Return how good probabilities are, and what to annotate next, as the end of a sentence."""
    following = ", ".join(map(str, uncertain.suggestions))
    text = f"probabilities of {len(uncertain.seeds)} runs err by {uncertain.calibration_error:.3f} on {where}"
    return f"{text}; annotate next: {following}" if following else text


def _gain(best: Choice, where: str) -> str:
    """Return what a calibration found, as the beginning of a sentence."""
    way = best.setting.way
    if best.setting.law is None:
        return f"no prior helps here: Dice {best.plain:.3f} on slices {where} by {way}, {best.dice:.3f} with a prior; "
    return f"a prior helps, from {way}: Dice {best.dice:.3f} on slices {where}, {best.plain:.3f} without; "


def _like(example: Source, volume: Field, reading: dict[str, Any]) -> Field:
    """Return the example; raise ScanError where its voxels differ in size from the volume's."""
    placed = {} if isinstance(example, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
    other = field_of(example, **placed)
    check_spacing(other, volume, "the slices")
    return other


def known_places(length: int, every: int | None, first: int, known: Sequence[int] | None) -> list[int]:
    """Return the numbers of the known slices, ascending; raise ScanError where they are no such numbers."""
    if (every is None) == (known is None):
        raise ScanError("expected either every how many slices are known, or their numbers")
    numbers = [check_float(n, "whole numbers of slices") for n in ((every, first) if known is None else known)]
    if not all(math.isfinite(number) and number == int(number) for number in numbers):  # type: ignore[arg-type, operator]
        raise ScanError(f"expected whole numbers of slices, got {', '.join(map(str, numbers))}")
    if every is not None and (every < 1 or first < 0):
        raise ScanError(f"expected every from 1 and first from 0, got {every} and {first}")
    places = sorted({int(n) for n in (known if known is not None else range(int(first), length, int(every or 1)))})
    if len(places) < 2 or places[0] < 0 or places[-1] >= length:
        raise ScanError(f"expected two or more known slices within 0 to {length - 1}, got {places}")
    return places


def _known(places: list[int], length: int) -> tuple[str, ...]:
    """Return sentences on the number of known slices, and of slices that are extrapolated."""
    before, beyond = places[0], length - 1 - places[-1]
    outer = f"The {before} before the first and the {beyond} beyond the last are extrapolated."
    return f"{len(places)} of {length} slices are known.", *((outer,) if before or beyond else ())


FORM = "labels that are whole numbers"


def reconstruct_labels(
    slices: Source,
    prior: LawLike | Mapping[int, LawLike],
    *,
    chosen: Sequence[int] | None = None,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    axis: int = 0,
    example: Source | None = None,
    store: str | PathLike[str] | None = None,
    progress: Progress = silent,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    **options: Any,
) -> Segmentation:
    """Fill several structures between known slices, each as `reconstruct` does; where two claim a voxel, the one that
    is deeper there has it, by its phase field.

    Where every voxel of the known slices is labelled, so is every voxel of the volume: the least shallow has those that
    none claims. A label for which slices or example are too few is interpolated by the spline, and a note says why.

    Parameters
    ----------
    slices
        Labels of the whole volume's shape, whole numbers, 0 where there is nothing; only the known slices count.
    prior
        A law for all labels, or one for each.
    chosen
        The labels that are structures, by default all but 0; the others count as nothing.
    example
        Labels of another volume of the same kind, known whole: for each label, what has this value there.
    every, first, known, axis, store, progress, spacing, unit, options
        As in `reconstruct`, without `runs` and `suggest`.

    Returns
    -------
    Segmentation
        `labels` has the value of the structure at each voxel, `mask` where there is one, `phase` the greatest phase
        field; there are no coefficients. Its `status` says of each label what `reconstruct` says.

    Raises
    ------
    ValueError
        As `reconstruct`, if it refuses all labels; or if the known slices do not have a label, or none but 0.
    """
    volume = field_of(slices, spacing=spacing, unit=unit)
    places = known_places(volume.shape[axis], every, first, known)
    planes = np.moveaxis(volume.values, axis, 0)[places]
    numbers = labels_of(planes, chosen)
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(numbers, prior)
    if missing := [number for number in numbers if number not in laws]:
        raise ScanError(f"expected a law for each label, got none for {', '.join(map(str, missing))}")
    placed = {} if isinstance(example, Field) else {"spacing": spacing, "unit": unit}
    other = None if example is None else field_of(example, **placed)
    deepest = np.full(volume.shape, -np.inf, dtype=np.float32)
    owner = np.zeros(volume.shape, dtype=np.int64)
    parts: list[_Part] = []
    for count, number in enumerate(numbers):
        each = {
            "store": None if store is None else Path(store) / str(number),
            "progress": sub_progress(progress, count / len(numbers), (count + 1) / len(numbers)),
        }
        phase, one = _completed(volume, number, laws[number], places, axis, other, {**options, **each})
        owner = np.where(phase > deepest, number, owner)
        deepest = np.maximum(deepest, phase)
        parts.append(one)
    if all(one.refusal for one in parts):
        raise parts[0].refusal  # type: ignore[misc]
    inside = np.isin(planes, numbers)
    values = owner if inside.all() else np.where(deepest > 0, owner, 0)
    np.moveaxis(values, axis, 0)[places] = np.where(inside, planes, 0)
    values = values.astype(np.int32 if min(numbers) < 0 else np.min_scalar_type(max(numbers)))
    return Segmentation(
        mask=replace(volume, values=values != 0, notes=()),
        phase=replace(volume, values=deepest, notes=()),
        weight=None,
        coefficients=None,
        epsilon=next(one.epsilon for one in parts if not one.refusal),
        status="; ".join(f"label {number}: {one.status}" for number, one in zip(numbers, parts, strict=True)),
        notes=tuple(dict.fromkeys((*volume.notes, *(note for one in parts for note in one.notes)))),
        labels=replace(volume, values=values, notes=()),
    )


def labels_of(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: those that are chosen, or all but 0.

    Raises
    ------
    ScanError
        If the values are grey levels, there is no such label, or 0 is one.
    """
    there = [int(value) for value in np.unique(labels(values, "known slices"))]
    numbers = (
        [each for each in there if each]
        if chosen is None
        else sorted({check_int(n, FORM, -SEEDS, SEEDS) for n in chosen})
    )
    listed = ", ".join(map(str, there[:12])) + (", …" if len(there) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"expected labels other than 0 in the known slices, got {'0' if numbers else listed}")
    if missing := [each for each in numbers if each not in there]:
        raise ScanError(f"expected labels of the known slices ({listed}), got {', '.join(map(str, missing))}")
    return numbers


def infer_law(example: Field, progress: Progress = silent) -> Inference:
    """Return what `infer` reads of the law of an example's mask in seconds, without growing anything."""
    from curvafit.inference.infer import infer

    return infer(example, kind="mask", fast=True, progress=progress)


def infer_laws(
    example: Field, chosen: Sequence[int] | None = None, progress: Progress = silent
) -> tuple[dict[int, Inference | Coefficients], tuple[str, ...]]:
    """Return the law of each label of an example, and notes; the Willmore energy where no law can be read."""
    laws: dict[int, Inference | Coefficients] = {}
    notes = []
    for label in labels_of(example.values, chosen):
        try:
            laws[label] = infer_law(replace(example, values=example.values == label), progress)
        except ScanError as reason:
            notes.append(f"Label {label} of the example has no law ({reason}): the Willmore energy is tried.")
            laws[label] = Coefficients.willmore()
    return laws, tuple(notes)


@dataclass(frozen=True, eq=False)
class _Part:
    """A label's ε, what is said of it, and why it was not completed."""

    epsilon: float
    status: str
    notes: tuple[str, ...]
    refusal: ScanError | None = None


def _completed(
    volume: Field,
    number: int,
    law: LawLike,
    places: list[int],
    axis: int,
    example: Field | None,
    options: dict[str, Any],
) -> tuple[np.ndarray, _Part]:
    """Return a label's phase field, as `reconstruct` fills it, or interpolated where that refuses."""
    name, notes, shown = f"label {number}", (), None
    mask = replace(volume, values=volume.values == number, notes=())
    if example is not None and (example.values == number).any():
        shown = replace(example, values=example.values == number, notes=())
    elif example is not None:
        notes = (f"The example has no {name}: it is tried out on slices left out.",)
    try:
        found = reconstruct(mask, law, known=places, axis=axis, example=shown, **options)
    except ScanError as reason:
        between = slices_of(mask, places, axis)
        level = np.ascontiguousarray(np.moveaxis(between.level("spline"), 0, axis))
        phase = optimal_profile(torch.from_numpy(level), RESOLVED * min(volume.spacing)).numpy()
        return phase, _Part(0.0, "interpolated by a spline", (*notes, f"Of {name}: {reason}."), reason)
    return found.phase.values, _Part(found.epsilon, found.status, (*notes, *found.notes))
