"""A volume between known slices: plain interpolation, or F_ε lowered from there with the slices held; one structure or
several that exclude each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
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
from curvafit.priors.law import LawLike
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.engine import STEPS, WorkingGrid, drawn_laws, laws_of
from curvafit.segmentation.examples import Example, crop_to_surface, grow_task
from curvafit.segmentation.result import Segmentation, Uncertainty, flow_summary
from curvafit.segmentation.slices import WAYS, Slices, check_spacing, known_places, require_labels
from curvafit.segmentation.tiles import LoweredVolume, Tiling, lower_volume
from curvafit.segmentation.trials import ODDS, Trial, best_plain_way, choose_by_masks, leave_out_slices
from curvafit.segmentation.uncertainty import RUNS, ProbabilityMap, entropy, estimate_probability, suggest_slices
from curvafit.volumes.boxes import digest_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box
from curvafit.volumes.read import Source, field_of

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference

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
        As in `segment`, by default the law that `infer` finds of the example. Each law that a fit trusts is tried.
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
        example nor a stiffness; or if known slices are all empty, all full or grey levels, the example's spacing is
        another one, more slices are to be suggested than are unknown, or there is neither a prior nor an example.
    FileNotFoundError
        If there is no such `fit.json`.
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
    prior = infer_law(_require_example(shown), progress) if prior is None else prior
    laws, notes = laws_of(prior, volume)
    if suggest and not runs:
        runs, notes = RUNS, (*notes, f"Suggestions need runs: {RUNS} are made.")
    firm = STIFFNESS if stiffness is None else stiffness
    level = Slices.level if other is None else other.level

    def candidates(way: str) -> list[Trial]:
        pulls = PULLS if way == ODDS else (0.0,)
        return [Trial(way, law, firm, steps, pull) for law, pull in product(laws, pulls)]

    def start(slices: Slices, trial: Trial) -> np.ndarray | None:
        return level(slices, ODDS) if trial.way == ODDS else None

    def fill(slices: Slices, trial: Trial) -> np.ndarray:
        if trial.law is None:
            return level(slices, trial.way) > 0
        step: Progress = lambda _, share: progress("trying the prior out", share)  # noqa: E731
        return _lower(SlicesProblem(slices, trial, start(slices, trial)), epsilon, None, step).mask

    def run(slices: Slices, trial: Trial, moved: np.ndarray, step: Progress) -> tuple[np.ndarray, float]:
        steps: Progress = lambda _, share: step("running again", share)  # noqa: E731
        return _lower(SlicesProblem(slices, trial, moved), epsilon, tile, steps).phase, tiling.place.epsilon

    chosen, tried, uncertain = candidates("spline")[0], "", None
    fair = (grow_task(target, laws[0], epsilon, progress) if other is None else other.part) if runs else None
    if stiffness is None:
        chosen = _choose(target if tiling.count == 1 else crop_to_surface(target)[0], other, candidates, fill)
        tried = _gain(chosen, "left out" if other is None else "of the example")
    problem = SlicesProblem(target, chosen, start(target, chosen))
    found = lower_volume(problem, tiling, store=store, workers=workers, progress=progress)
    end = flow_summary(found)
    if fair is not None:
        drawn = () if chosen.law is None else drawn_laws(prior, volume, runs)
        likely = estimate_probability(
            fair, target, chosen, drawn or (chosen.law,), runs, level=level, flow=run, progress=progress
        )
        uncertain = _uncertainty(likely, target, volume, axis, range(runs), suggest)
        end = f"{end}; {_calibration(uncertain, 'a shape of the law' if other is None else 'the example')}"
    notes = (*notes, *(() if other is None else other.notes), *_known_notes(places, volume.shape[axis]))
    mask, phase = _turn_back(axis, found.mask, found.phase)
    return Segmentation.of(
        volume, mask, phase, (*notes, *tiling.place.notes),
        weight=None, coefficients=chosen.law, epsilon=tiling.place.epsilon, status=f"{tried}{end}",
        uncertainty=uncertain,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SlicesProblem:
    """The volume between slices, which a trial fills from an interpolation (length, Y, X), by default that of its way.

    See `tiles.Problem`.
    """

    slices: Slices
    trial: Trial
    level: np.ndarray | None = None

    @property
    def law(self) -> Coefficients | None:
        return self.trial.law

    @property
    def steps(self) -> int:
        return self.trial.steps

    @property
    def parts(self) -> dict[str, object]:
        slices, trial = self.slices, self.trial
        numbers = {"places": slices.places, "spacing": slices.spacing, "periodic": slices.periodic}
        start = trial.way if self.level is None else digest_of(self.level)
        springs = {"strength": trial.strength, "pull": trial.pull}
        return {"slices": digest_of(slices.inside), **numbers, "start": start, **springs}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, data.Data]:
        """Return the interpolation, and springs on the known voxels and on those that odds hold."""
        slices, trial, (rows, inside) = self.slices, self.trial, self.slices.known(box)
        numbers = slices.numbers(box)
        level = slices.level(trial.way, box) if self.level is None else self.level[np.ix_(*numbers)]
        held = slices.between[numbers[0], None, None]
        pull = np.where(held, trial.pull / min(slices.spacing[1:]) * level, 0).astype(np.float32)
        pull[rows] = np.where(inside, trial.strength, -trial.strength)
        return level, data.Hinge(place.spread(pull, centre=0), MARGIN)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the profile of the interpolation."""
        return np.tanh(level / (math.sqrt(2) * place.epsilon))

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the voxels where the phase field is positive, and the known ones as they are."""
        mask, (rows, inside) = phase > 0, self.slices.known(box)
        mask[rows] = inside
        return mask


def _lower(problem: SlicesProblem, epsilon: float | None, tile: int | None, progress: Progress) -> LoweredVolume:
    """Lower a problem on tiles of its own volume."""
    tiling = Tiling.of(problem.slices.frame, epsilon, tile, periodic=problem.slices.periodic)
    return lower_volume(problem, tiling, progress=progress)


def _choose(
    slices: Slices,
    example: Example | None,
    candidates: Callable[[str], list[Trial]],
    fill: Callable[[Slices, Trial], np.ndarray],
) -> Trial:
    """Return the trial that is best on the example, or on every second of the slices."""
    if example is not None:
        return choose_by_masks(example.part, candidates, fill, (best_plain_way(example.whole, fill, (*WAYS, ODDS)),))
    task = leave_out_slices(slices)
    if task is None:
        raise ScanError(
            "expected three or more known slices with voxels inside and outside, an example or a stiffness, got "
            f"{len(slices.places)} slices"
        )
    return choose_by_masks(task, candidates, fill, ("spline",))


def _turn_back(axis: int, *arrays: np.ndarray) -> list[np.ndarray]:
    """Return volumes with their first axis where it was."""
    return [np.ascontiguousarray(np.moveaxis(array, 0, axis)) for array in arrays]


def _uncertainty(
    likely: ProbabilityMap, slices: Slices, volume: Field, axis: int, seeds: Sequence[int], count: int
) -> Uncertainty:
    """Return what probabilities say of a volume, and so many suggestions."""
    entropies = entropy(likely.values).sum((1, 2))
    (values,) = _turn_back(axis, likely.values)
    following = suggest_slices(entropies, slices.places, count, slices.periodic)
    return Uncertainty(replace(volume, values=values, notes=()), tuple(seeds), likely.error, following)


def _calibration(uncertain: Uncertainty, where: str) -> str:
    """Return how good probabilities are, and what to annotate next, as the end of a sentence."""
    following = ", ".join(map(str, uncertain.suggestions))
    text = f"probabilities of {len(uncertain.seeds)} runs err by {uncertain.calibration_error:.3f} on {where}"
    return f"{text}; annotate next: {following}" if following else text


def _gain(best: Trial, where: str) -> str:
    """Return what was chosen and what it gains, as the beginning of a sentence."""
    score, plain = f"Dice {best.score:.3f}", f"{best.plain:.3f}"
    if best.law is None:
        return f"no prior helps here: Dice {plain} on slices {where} by {best.way}, {best.score:.3f} with a prior; "
    return f"a prior helps, from {best.way}: {score} on slices {where}, {plain} without; "


def _load_example(example: Source, volume: Field, reading: dict[str, Any]) -> Field:
    """Return the example; raise ScanError where its voxels differ in size from the volume's."""
    placed = {} if isinstance(example, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
    other = field_of(example, **placed)
    check_spacing(other, volume, "the slices")
    return other


def _require_example(example: Field | None) -> Field:
    """Return an example; raise ScanError where there is none to infer a law from."""
    if example is None:
        raise ScanError("expected a prior, or an example to infer one from, got neither")
    return example


def _known_notes(places: list[int], length: int) -> tuple[str, ...]:
    """Return sentences on the number of known slices, and of slices that are extrapolated."""
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
    """Fill several structures between known slices, each as `reconstruct` does; where two claim a voxel, the one that
    is deeper there has it, by its phase field.

    Where every voxel of the known slices is labelled, so is every voxel of the volume: an unclaimed voxel goes to the
    label with the largest phase value. A label for which slices or example are too few is interpolated by the spline,
    and a note says why.

    Parameters
    ----------
    slices
        Labels of the whole volume's shape, whole numbers, 0 where there is nothing; only the known slices count.
    prior
        A law for all labels, or one for each; by default what `infer` finds of each label of the example, and the
        Willmore energy where that has no law.
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
    axis = check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    places = known_places(volume.shape[axis], every, first, known)
    planes = np.moveaxis(volume.values, axis, 0)[places]
    numbers = labels_of(planes, chosen)
    placed = {} if isinstance(example, Field) else {"spacing": spacing, "unit": unit}
    other = None if example is None else field_of(example, **placed)
    if prior is None:
        laws, notes = infer_laws(_require_example(other), numbers, progress)
    else:
        laws, notes = prior if isinstance(prior, Mapping) else dict.fromkeys(numbers, prior), ()
    if missing := [number for number in numbers if number not in laws]:
        raise ScanError(f"expected a law for each label, got none for {', '.join(map(str, missing))}")
    deepest, owner = np.full(volume.shape, -np.inf, dtype=np.float32), np.zeros(volume.shape, dtype=np.int64)
    parts: list[_Part] = []
    for count, number in enumerate(numbers):
        own = {
            "store": None if store is None else Path(store) / str(number),
            "progress": sub_progress(progress, count / len(numbers), (count + 1) / len(numbers)),
        }
        phase, one = _fill_label(volume, number, laws[number], places, axis, other, {**options, **own})
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
        notes=tuple(dict.fromkeys((*volume.notes, *notes, *(note for one in parts for note in one.notes)))),
        labels=replace(volume, values=values, notes=()),
    )


def labels_of(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: those that are chosen, or all but 0.

    Raises
    ------
    ScanError
        If the values are grey levels, there is no such label, or 0 is one.
    """
    found = [int(value) for value in np.unique(require_labels(values, "known slices"))]
    if chosen is None:
        numbers = [number for number in found if number]
    else:
        numbers = sorted({check_int(n, "labels that are whole numbers", -SEEDS, SEEDS) for n in chosen})
    listed = ", ".join(map(str, found[:12])) + (", …" if len(found) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"expected labels other than 0 in the known slices, got {'0' if numbers else listed}")
    if missing := [number for number in numbers if number not in found]:
        raise ScanError(f"expected labels of the known slices ({listed}), got {', '.join(map(str, missing))}")
    return numbers


def infer_law(example: Field, progress: Progress = silent) -> Inference:
    """Return what `infer` reads of the law of an example's mask in seconds, without growing anything."""
    from curvafit.inference.infer import infer  # with the posterior's packages: only where a law is to be inferred

    return infer(example, kind="mask", fast=True, progress=progress)


def infer_laws(
    example: Field, chosen: Sequence[int] | None = None, progress: Progress = silent
) -> tuple[dict[int, Inference | Coefficients], tuple[str, ...]]:
    """Return the law of each label of an example, and notes; the Willmore energy where no law can be read."""
    laws: dict[int, Inference | Coefficients] = {}
    notes = []
    for label in labels_of(example.values, None) if chosen is None else chosen:
        try:
            laws[label] = infer_law(replace(example, values=example.values == label), progress)
        except ScanError as reason:
            notes.append(f"Label {label} of the example has no law ({reason}): the Willmore energy is tried.")
            laws[label] = Coefficients.willmore()
    return laws, tuple(notes)


@dataclass(frozen=True, eq=False)
class _Part:
    """A label's ε, what is said of it, and why it was not filled."""

    epsilon: float
    status: str
    notes: tuple[str, ...]
    refusal: ScanError | None = None


def _fill_label(
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
        level = np.ascontiguousarray(np.moveaxis(Slices.of(mask, places, axis).level("spline"), 0, axis))
        phase = optimal_profile(torch.from_numpy(level), RESOLVED * min(volume.spacing)).numpy()
        return phase, _Part(0.0, "interpolated by a spline", (*notes, f"Of {name}: {reason}."), reason)
    return found.phase.values, _Part(found.epsilon, found.status, (*notes, *found.notes))
