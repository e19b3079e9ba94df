"""A volume between known slices: plain interpolation, or F_ε lowered from there with the slices held; one structure or
several that exclude each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import SEEDS, check_float, check_int
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation import data
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import LawLike
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.engine import STEPS, WILLMORE, WorkingGrid, draw_laws, infer_law, laws_of
from curvafit.segmentation.examples import Example, crop_to_surface, grow_task
from curvafit.segmentation.result import Segmentation, Uncertainty, flow_summary
from curvafit.segmentation.slices import WAYS, Slices, check_spacing, known_places, require_labels
from curvafit.segmentation.tiles import LoweredVolume, Problem, Tiling, lower_volume
from curvafit.segmentation.trials import ODDS, Trial, best_plain_way, choose_by_masks, leave_out_slices
from curvafit.segmentation.uncertainty import RUNS, ProbabilityMap, entropy, estimate_probability, suggest_slices
from curvafit.volumes.boxes import digest_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box
from curvafit.volumes.read import Source, field_of

#: Stiffness of the springs on known voxels, in working units: a tenth of it gives way, ten times as much stalls.
STIFFNESS = 1e7
#: Margin of the springs: u of the optimal profile half a voxel from the surface, as known voxels next to it are.
MARGIN = math.tanh(WORKING_SPACING / 2 / (math.sqrt(2) * WORKING_EPSILON))
#: Least and greatest stiffness.
STIFFEST = (1e-9, 1e12)
#: Most runs.
MOST = 1000
#: Stiffness of the springs on unknown voxels, in working units, for each nat of an example's odds: both are tried.
PULLS = (1e4, 3e4)


def reconstruct(
    slices: Source,
    prior: LawLike | None = None,
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
    workers: Workers | int | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Fill a volume between known slices: lower F_ε from an interpolation if that is better than the interpolation.

    Which is better is tried out on an example with as few slices given, or else on every second known slice, which the
    others predict. From an example the odds are learned that a voxel between two slices is inside, by its distances
    from both outlines: where they are the best interpolation, springs of these odds hold the surface while F_ε is
    lowered. Known slices stay as they are. Where the volume ends, the surface goes on freely.

    Parameters
    ----------
    slices
        A mask, or labels, of the whole volume's shape, positive inside, as a path, a `Field`, an array or a tensor;
        only the known slices count.
    prior
        As in `segment`, by default the law that `infer` finds of the example. Each law that a fit trusts is tried.
    every, first
        Slices `first`, `first + every`, … along `axis` are known. The volume is extrapolated before the first known
        slice and beyond the last.
    known
        The numbers of the known slices, two or more, in place of `every` and `first`.
    axis
        The axis of the array across the slices, 0, 1 or 2, that is z, y or x.
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
        Number of slices to suggest for annotation next; needs `runs`, by default 8.
    epsilon, steps, tile, store, workers, progress, reading
        As in `segment`.

    Raises
    ------
    ValueError, FileNotFoundError
        As `segment`; or if fewer than two slices are known, or too few to try the prior out on and there is neither an
        example nor a stiffness; or if known slices are all empty, all full or grey levels, the example's spacing is
        another one, more slices are to be suggested than are unknown, or there is neither a prior nor an example.
    """
    volume = field_of(slices, **reading)
    axis = check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    places = known_places(volume.shape[axis], every, first, known)
    target = Slices.of(volume, places, axis, periodic)
    tiling = Tiling.of(target.frame, epsilon, tile, periodic=periodic)
    if stiffness is not None:
        stiffness = check_float(stiffness, "a positive stiffness", *STIFFEST)
    suggest = check_int(suggest, "a number of slices from 0", 0, volume.shape[axis] - len(places))
    runs = check_int(runs, "a number of runs from 0", 0, MOST)
    shown = None if example is None else _load_example(example, volume, reading)
    other = None if shown is None else Example.of(shown, places, axis)
    prior = infer_law(shown, progress) if prior is None else prior
    laws, notes = laws_of(prior, volume)
    if suggest and not runs:
        runs, notes = RUNS, (*notes, f"Suggestions need runs: {RUNS} are made.")
    firm = STIFFNESS if stiffness is None else stiffness
    level = Slices.level if other is None else other.level

    def candidates(way: str) -> list[Trial]:
        pulls = PULLS if way == ODDS else (0.0,)
        return [Trial(way, law, firm, steps, pull) for law, pull in product(laws, pulls)]

    def pose(slices: Slices, trial: Trial) -> SlicesProblem:
        return SlicesProblem(trial, slices, level(slices, ODDS) if trial.way == ODDS else None)

    def fill(slices: Slices, trial: Trial) -> np.ndarray:
        if trial.law is None:
            return level(slices, trial.way) > 0
        step: Progress = lambda _, share: progress("trying the prior out", share)  # noqa: E731
        return _lower(pose(slices, trial), epsilon, None, step).mask

    def run(slices: Slices, trial: Trial, moved: np.ndarray, step: Progress) -> tuple[np.ndarray, float]:
        again: Progress = lambda _, share: step("running again", share)  # noqa: E731
        return _lower(SlicesProblem(trial, slices, moved), epsilon, tile, again).phase, tiling.place.epsilon

    chosen, gain, uncertain = candidates("spline")[0], "", None
    fair = (grow_task(target, laws[0], epsilon, progress) if other is None else other.part) if runs else None
    if stiffness is None:
        chosen = _choose(target if tiling.count == 1 else crop_to_surface(target)[0], other, candidates, fill)
        gain = _describe_gain(chosen, "left out" if other is None else "of the example")
    found = lower_volume(pose(target, chosen), tiling, store=store, workers=workers, progress=progress)
    end = flow_summary(found)
    if fair is not None:
        drawn = () if chosen.law is None else draw_laws(prior, volume, runs)
        likely = estimate_probability(
            fair, target, chosen, drawn or (chosen.law,), runs, level=level, flow=run, progress=progress
        )
        uncertain = _uncertainty(likely, target, volume, axis, runs, suggest)
        end = f"{end}; {_describe_errors(uncertain, 'a shape of the law' if other is None else 'the example')}"
    notes = (*notes, *(() if other is None else other.notes), *_known_notes(places, volume.shape[axis]))
    whole = replace(found, mask=_turn_back(axis, found.mask), phase=_turn_back(axis, found.phase))
    return Segmentation.of(
        volume, whole, chosen.law, tiling.place.epsilon, (*notes, *tiling.place.notes),
        weight=None, status=f"{gain}{end}", uncertainty=uncertain,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SlicesProblem(Problem):
    """The volume between slices, and a trial whose strength is the stiffness of springs on the known voxels.

    The start is `level` (length, Y, X), by default the trial's own interpolation.
    """

    slices: Slices
    level: np.ndarray | None = None

    @property
    def parts(self) -> dict[str, object]:
        slices, trial = self.slices, self.trial
        numbers = {"places": slices.places, "spacing": slices.spacing, "periodic": slices.periodic}
        start = trial.way if self.level is None else digest_of(self.level)
        springs = {"strength": trial.strength, "pull": trial.pull}
        return {"slices": digest_of(slices.inside), **numbers, "start": start, **springs}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, data.Data]:
        """Return the interpolation on a box, positive inside, and the hinge term that holds voxels there.

        Known voxels are held with the trial's strength. Where the start is an example's odds, voxels between known
        slices are held too: by the trial's pull for each pixel of the level, which is then the log-odds of the inside.
        """
        slices, trial, (rows, inside) = self.slices, self.trial, self.slices.known(box)
        numbers = slices.numbers(box)
        level = slices.level(trial.way, box) if self.level is None else self.level[np.ix_(*numbers)]
        held = slices.between[numbers[0], None, None]
        pull = np.where(held, trial.pull / min(slices.spacing[1:]) * level, 0).astype(np.float32)
        pull[rows] = np.where(inside, trial.strength, -trial.strength)
        return level, data.Hinge(place.spread(pull, centre=0), MARGIN)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the optimal profile tanh(d / √2 ε) of the interpolation."""
        return np.tanh(level / (math.sqrt(2) * place.epsilon))

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the voxels where the phase field is positive, and the known ones as they are."""
        mask, (rows, inside) = phase > 0, self.slices.known(box)
        mask[rows] = inside
        return mask


def _lower(problem: SlicesProblem, epsilon: float | None, tile: int | None, progress: Progress) -> LoweredVolume:
    """Lower a problem on a tiling of its own slices."""
    tiling = Tiling.of(problem.slices.frame, epsilon, tile, periodic=problem.slices.periodic)
    return lower_volume(problem, tiling, progress=progress)


def _choose(
    slices: Slices,
    example: Example | None,
    candidates: Callable[[str], list[Trial]],
    fill: Callable[[Slices, Trial], np.ndarray],
) -> Trial:
    """Return the trial that is best on the example, or else on every second known slice."""
    if example is not None:
        return choose_by_masks(example.part, candidates, fill, (best_plain_way(example.whole, fill, (*WAYS, ODDS)),))
    task = leave_out_slices(slices)
    if task is None:
        raise ScanError(
            "to try the prior out, give three or more known slices with voxels inside and outside, an example or a "
            f"stiffness, got {len(slices.places)} slices"
        )
    return choose_by_masks(task, candidates, fill, ("spline",))


def _turn_back(axis: int, values: np.ndarray) -> np.ndarray:
    """Move the first axis of a volume back to where it was."""
    return np.ascontiguousarray(np.moveaxis(values, 0, axis))


def _uncertainty(
    likely: ProbabilityMap, slices: Slices, volume: Field, axis: int, runs: int, count: int
) -> Uncertainty:
    """Return the probability map of a volume from its runs, and the `count` slices most worth annotating next."""
    suggestions = suggest_slices(entropy(likely.values).sum((1, 2)), slices.places, count, slices.periodic)
    probability = replace(volume, values=_turn_back(axis, likely.values), notes=())
    return Uncertainty(probability, seeds=tuple(range(runs)), calibration_error=likely.error, suggestions=suggestions)


def _describe_errors(uncertain: Uncertainty, where: str) -> str:
    """Say how good probabilities are, and what to annotate next, as the end of a sentence."""
    following = ", ".join(map(str, uncertain.suggestions))
    text = f"probabilities of {len(uncertain.seeds)} runs err by {uncertain.calibration_error:.3f} on {where}"
    return f"{text}; annotate next: {following}" if following else text


def _describe_gain(best: Trial, where: str) -> str:
    """Say what was chosen and what it gains, as the beginning of a sentence."""
    score, plain = f"Dice {best.score:.3f}", f"{best.plain:.3f}"
    if best.law is None:
        return f"no prior helps here: Dice {plain} on slices {where} by {best.way}, {best.score:.3f} with a prior; "
    return f"a prior helps, from {best.way}: {score} on slices {where}, {plain} without; "


def _load_example(example: Source, volume: Field, reading: dict[str, Any]) -> Field:
    """Load an example with the spacing and unit of the slices, which are of `volume`."""
    placed = {} if isinstance(example, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
    field = field_of(example, **placed)
    check_spacing(field, volume, "the slices")
    return field


def _known_notes(places: list[int], length: int) -> tuple[str, ...]:
    """Return sentences on the number of known slices, and of extrapolated ones."""
    before, beyond = places[0], length - 1 - places[-1]
    outer = f"The {before} before the first and the {beyond} beyond the last are extrapolated."
    return f"{len(places)} of {length} slices are known.", *((outer,) if before or beyond else ())


# ---- several structures ----------------------------------------------------------------------------------------------


def reconstruct_labels(
    slices: Source,
    prior: LawLike | Mapping[int, LawLike] | None = None,
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
    """Fill several structures between known slices, each by `reconstruct`; a voxel that two of them claim goes to the
    one with the greater phase field there.

    Where every voxel of the known slices is labelled, so is every voxel of the volume: an unclaimed voxel goes to the
    label with the largest phase value. A label for which slices or example are too few is interpolated by the spline,
    and a note says why.

    Parameters
    ----------
    slices
        Labels of the whole volume's shape, whole numbers, 0 where there is nothing; only the known slices count.
    prior
        A law for all labels, or one for each; by default the law that `infer` finds of each label of the example, or
        the Willmore energy for a label without one.
    chosen
        The labels that are structures, by default all but 0; the others count as nothing.
    example
        Labels of another volume of the same kind, known whole, with the same values for the same structures.
    every, first, known, axis, store, progress, spacing, unit, options
        As in `reconstruct`, without `runs` and `suggest`.

    Returns
    -------
    Segmentation
        `labels` has the label of the structure at each voxel, `mask` whether there is one, `phase` the greatest phase
        field; there are no coefficients. Its `status` is that of `reconstruct` for each label.

    Raises
    ------
    ValueError
        As `reconstruct`, if it refuses all labels; or if the known slices do not have a label, or none but 0.
    """
    volume = field_of(slices, spacing=spacing, unit=unit)
    axis = check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    places = known_places(volume.shape[axis], every, first, known)
    planes = np.moveaxis(volume.values, axis, 0)[places]
    numbers = find_labels(planes, chosen)
    other = None if example is None else _load_example(example, volume, {"spacing": spacing, "unit": unit})
    notes = list(volume.notes)
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(numbers, prior)
    if missing := [number for number in numbers if number not in laws]:
        raise ScanError(f"each label needs a law, but there is none for {', '.join(map(str, missing))}")
    if prior is None:
        laws = {number: _infer_label(other, number, notes, progress) for number in numbers}
    deepest, owner = np.full(volume.shape, -np.inf, dtype=np.float32), np.zeros(volume.shape, dtype=np.int64)
    parts: list[Segmentation] = []
    refusals: list[ScanError] = []
    for count, number in enumerate(numbers):
        mask, shown = _select_label(volume, number), _select_label(other, number)
        if shown is not None and not shown.values.any():
            shown = None
            notes.append(f"The example has no label {number}: it is tried out on slices left out.")
        folder = None if store is None else Path(store) / str(number)
        step = sub_progress(progress, count / len(numbers), (count + 1) / len(numbers))
        try:
            part = reconstruct(
                mask, laws[number], known=places, axis=axis, example=shown, store=folder, progress=step, **options
            )
        except ScanError as reason:
            refusals.append(reason)
            part = _interpolate(mask, places, axis, f"Of label {number}: {reason}.")
        owner = np.where(part.phase.values > deepest, number, owner)
        deepest = np.maximum(deepest, part.phase.values)
        notes += part.notes
        parts.append(part)
    if len(refusals) == len(numbers):
        raise refusals[0]
    inside = np.isin(planes, numbers)
    values = owner if inside.all() else np.where(deepest > 0, owner, 0)
    np.moveaxis(values, axis, 0)[places] = np.where(inside, planes, 0)
    values = values.astype(np.int32 if min(numbers) < 0 else np.min_scalar_type(max(numbers)))
    return Segmentation(
        mask=replace(volume, values=values != 0, notes=()),
        phase=replace(volume, values=deepest, notes=()),
        weight=None,
        coefficients=None,
        epsilon=max(part.epsilon for part in parts),
        status="; ".join(f"label {number}: {part.status}" for number, part in zip(numbers, parts, strict=True)),
        notes=tuple(dict.fromkeys(notes)),
        labels=replace(volume, values=values, notes=()),
    )


def find_labels(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: the chosen ones, or all but 0.

    Raises `ScanError` if the values are grey levels, a chosen label is missing, or there is none but 0.
    """
    found = [int(value) for value in np.unique(require_labels(values, "the volume of known slices"))]
    if chosen is None:
        numbers = [number for number in found if number]
    else:
        numbers = sorted({check_int(n, "labels that are whole numbers", -SEEDS, SEEDS) for n in chosen})
    listed = ", ".join(map(str, found[:12])) + (", …" if len(found) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"labels must be other than 0, got {'0' if numbers else f'{listed} in the known slices'}")
    if missing := [number for number in numbers if number not in found]:
        raise ScanError(f"the known slices have the labels {listed}, but not {', '.join(map(str, missing))}")
    return numbers


def _select_label(volume: Any, number: int) -> Any:
    """Return the mask of a label, of a volume if there is one."""
    return None if volume is None else replace(volume, values=volume.values == number, notes=())


def _infer_label(example: Field | None, number: int, notes: list[str], progress: Progress) -> LawLike:
    """Infer the law of a label of the example; without one, note why, and return the Willmore energy."""
    try:
        return infer_law(None if example is None else replace(example, values=example.values == number), progress)
    except ScanError as reason:
        if example is None:
            raise
        notes.append(f"Label {number} of the example has no law ({reason}): the Willmore energy is tried.")
        return WILLMORE


def _interpolate(mask: Field, places: list[int], axis: int, note: str) -> Segmentation:
    """Return a label's interpolation by the spline, as a segmentation without an ε."""
    level = _turn_back(axis, Slices.of(mask, places, axis).level("spline"))
    phase = optimal_profile(torch.from_numpy(level), RESOLVED * min(mask.spacing)).numpy()
    lowered = LoweredVolume(phase > 0, phase, (), 0)
    return Segmentation.of(mask, lowered, None, 0.0, (note,), weight=None, status="interpolated by a spline")
