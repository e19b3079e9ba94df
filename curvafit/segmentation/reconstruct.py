"""A volume between known slices: filled by a network, and by F_ε where a law is better; one structure or several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from scipy.special import expit
from skimage import measure

from curvafit.core.checks import SEEDS, check_float, check_int
from curvafit.core.extras import require
from curvafit.core.runtime import Progress, check_memory, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation import data
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import LawLike
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import profile_distance
from curvafit.segmentation.filler import Taught, fill
from curvafit.segmentation.flow import STEPS, WorkingGrid, choose_epsilon
from curvafit.segmentation.image import find_shift, read_image
from curvafit.segmentation.result import (
    FEW,
    Segmentation,
    Uncertainty,
    describe_filled,
    doubt_labels,
    doubt_places,
    flow_summary,
    note_labelled,
)
from curvafit.segmentation.slices import (
    IDS,
    WHOLE,
    Slices,
    annotated_slices,
    check_shared,
    check_spacing,
    choose_labelled,
    find_labelled,
    index_labels,
    known_places,
    load_with,
    mark_known,
    reach_of,
    require_labels,
)
from curvafit.segmentation.teach import tune
from curvafit.segmentation.tiles import Problem, Tiling, check_edge, lower_volume
from curvafit.segmentation.trials import (
    PART,
    Example,
    Task,
    Trial,
    choose_by_masks,
    crop_to_surface,
    laws_of,
    leave_out_slices,
)
from curvafit.segmentation.uncertainty import (
    best_log_odds,
    calibration_error,
    doubt,
    expected_dice,
    fit_weights,
    near_surface,
    probability,
    share_by_slices,
    suggest_slices,
)
from curvafit.volumes.boxes import Box
from curvafit.volumes.formats.base import smallest_type
from curvafit.volumes.place import lay
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import ScanError, Volume, digest_of, round_labels

#: Stiffness of the springs on known voxels, in working units: a tenth of it gives way, ten times as much stalls.
STIFFNESS = 1e7
#: Margin of the springs: u of the optimal profile half a voxel from the surface, as known voxels next to it are.
MARGIN = math.tanh(WORKING_SPACING / 2 / (math.sqrt(2) * WORKING_EPSILON))
#: Least and greatest stiffness.
STIFFEST = (1e-9, 1e12)
#: Stiffness of the springs on unknown voxels, in working units, for each nat of their log-odds: all are tried.
PULLS = (0.0, 1e4, 3e4)
#: Which slices are known, and how many to suggest, unless it is said.
WHICH: dict[str, Any] = {"every": None, "first": 0, "known": None, "ignore": None, "axis": 0, "suggest": 0}
#: Label of unknown voxels in the mask of one structure.
UNKNOWN = 255
#: Fewest grey levels of an image, and most voxels in which they are counted.
GREY, SAMPLED = 8, 1_000_000
#: Bytes that each voxel takes at least while a volume is filled at once.
LEAST_BYTES = 30
#: Least share of the entropy of slices held out that an image takes away: that of the structure takes half or more.
TOLD = 0.1
ONCE = "The labels are read in the image as instances of one structure (--no-instances reads each by itself)."
APIECE = "Each label is read in the image by itself (--instances reads those of one kind, such as cells, as one)."
SHIFTED = "The image seems to lie off the annotated slices by {} voxels along {}: it fits them better when it is moved."
UNTOLD = "The image does not tell the structure in annotated slices held out: it is left out."
#: Voxels around a label's box.
ROOM = 16
#: Of instances, labels of one kind that an image tells from the background but not from each other: the share of a
#: label's area that is in one piece in each slice, the share of labels of which that holds, and the greatest share of
#: the variance of grey levels that is due to which label they have.
PIECE, MOST, ALIKE = 0.9, 0.9, 0.5
#: Probabilities of labels are at least this.
SURE = 1e-6


def reconstruct(
    slices: Source,
    prior: LawLike | None = None,
    *,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    ignore: int | None = None,
    axis: int = 0,
    image: Source | None = None,
    example: Source | None = None,
    suggest: int = 0,
    periodic: bool = False,
    filler: str | Path | None = None,
    stiffness: float | None = None,
    epsilon: float | None = None,
    steps: int = STEPS,
    tile: int | None = None,
    store: str | PathLike[str] | None = None,
    workers: Workers | int | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Fill a volume between known slices, and say how sure each voxel is.

    A network fills it that generated shapes have taught (`filler.Filler`). An example tunes the network, where that
    makes it better by more than the noise. With an image, trees learn from the known slices which grey levels are
    inside, and the network weighs what they say of the others. With a law, F_ε is lowered from there if this is better:
    it is tried out on the part of the example that did not tune, or else on every second known slice. Known slices stay
    as they are.

    Parameters
    ----------
    slices
        A mask, or labels, of the whole volume's shape, positive inside, as a path, a `Volume`, an array or a tensor;
        only the known slices count.
    prior
        A law as in `segment`, to be tried; by default none. Each law that a fit trusts is tried.
    every, first
        Slices `first`, `first + every`, … along `axis` are known. Before the first known slice and beyond the last, the
        volume goes on as that slice is for half a gap, or as an image tells. By default the slices with labels are
        known, and where they are every n-th, three or more, the empty ones next to them in this rhythm.
    known
        The numbers of known slices, in place of `every` or besides.
    ignore
        The label of voxels that nobody annotated, in place of `every` and `known`: slices without it are known, two or
        more, and so is each other voxel, in slices along any axis or in parts of slices.
    axis
        The axis of the array across the slices, 0, 1 or 2, that is z, y or x.
    image
        Grey levels of the volume, on the same voxels (the affines tell their pose); needs `curvafit[image]`. It goes
        with neither example nor law.
    example
        A mask of another volume of the same kind, known whole. A file or an array has the slices' `spacing` and `unit`.
    suggest
        Number of slices to suggest for annotation next.
    periodic
        Whether the volume repeats, as generated ones do.
    filler
        Weights of `curvafit atlas teach`, for an image those of `--images`; by default the packaged ones.
    stiffness
        Stiffness of the springs on known voxels, in working units: the first law is lowered without being tried out.
    epsilon, steps, tile, store, workers, progress, reading
        As in `segment`.

    Raises
    ------
    ValueError, FileNotFoundError
        As `segment`; or if known slices are fewer than two, or than a law is tried out on, all empty, all full or grey
        levels; or if an example's spacing or an image's voxels are other ones.
    ImportError
        If an image is given, and scikit-learn is not installed.
    """
    which: dict[str, Any] = dict(zip(WHICH, (every, first, known, ignore, axis, suggest), strict=True))
    given = _Given.read(slices, reading, **which)
    volume, axis = given.volume, given.axis
    check_memory(volume.shape, LEAST_BYTES, "a volume that is filled at once, not in blocks into Zarr,")
    target = Slices.of(volume, given.places, axis, periodic, given.marks)
    if stiffness is not None:
        stiffness = check_float(stiffness, "a positive stiffness", *STIFFEST)
    laws, notes = ((), ()) if prior is None else laws_of(prior, volume)
    width, tile = choose_epsilon(volume, epsilon), check_edge(tile)
    taught, other, evidence, seen = Taught.load(filler, image=image is not None), None, None, None
    if image is not None:
        if example is not None or laws:
            raise ScanError("give an image, or an example or a law, but not both: nothing joins them yet")
        seen = _load_image(image, volume, reading)
        evidence, doubts = _read_evidence(given.turn(seen.values), target, axis, sub_progress(progress, 0.0, 0.5))
        taught, notes = Taught.load() if evidence is None else taught, (*notes, *seen.notes, *doubts)
    if example is not None:
        other = Example.of(_load_example(example, volume, reading), given.places, axis)
        taught = tune(taught, other, sub_progress(progress, 0.0, 0.5))
        notes = (*notes, *other.notes)
    engine = _Engine(taught, evidence, epsilon, progress)
    chosen, said, task = Trial(), taught.status, None if other is None else other.task
    if stiffness is not None and laws:
        chosen, said = Trial(laws[0], stiffness, steps), "the law is lowered from the network's volume"
    elif laws:
        one_tile = Tiling.of(target.frame, epsilon, tile, periodic=periodic).count == 1
        task = _pose_task(target if one_tile else crop_to_surface(target, PART)[0], other)
        trials = [Trial(law, STIFFNESS, steps, pull) for law, pull in product(laws, PULLS)]
        chosen = choose_by_masks(task, trials, lambda slices, trial: engine.run(slices, trial) > 0)
        said = _describe_gain(chosen, "left out" if other is None else "of the example")
    if chosen.law is None:
        phase = engine.run(target, chosen)
        mask, likely = target.keep_known(phase > 0), (expit(engine.logits(target)), taught.error)
        summary = flow_summary(float(mask.mean()))
    else:
        tiling = Tiling.of(target.frame, epsilon, tile, periodic=periodic)
        problem = SlicesProblem(chosen, target, engine.level(target))
        found = lower_volume(problem, tiling, store=store, workers=workers, progress=progress)
        mask, phase = target.keep_known(found.mask & ~target.outside[:, None, None]), found.phase
        summary = flow_summary(float(found.mask.mean()), found.energies, found.steps)
        notes = (*notes, *tiling.place.notes)
        likely = _weigh_evidence(engine, chosen, task, target, phase)
    uncertain = _uncertainty(*likely, mask, target, given, told=evidence is not None)
    tested = "the example" if other else "slices left out" if chosen.law else "generated shapes"
    ways = {"tested": tested, "image": evidence is not None, "periodic": periodic}
    status, doubts = describe_filled(said, summary, float(mask.mean()), uncertain, given.places, target.length, **ways)
    labels = doubt_labels(np.unique(given.turn(volume.values)[given.places]), ignore)
    return Segmentation.of(
        volume, given.turn_back(mask), given.turn_back(phase), chosen.law, width,
        (*given.notes, *labels, *notes, *doubts),
        weight=None, status=status, uncertainty=uncertain, image=seen,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Given:
    """Labels of a volume, the slices across an axis that are known, marks of known voxels in others, notes, and how
    many slices to suggest."""

    volume: Volume
    axis: int
    places: list[int]
    marks: np.ndarray | None
    notes: tuple[str, ...]
    suggest: int

    @classmethod
    def read(
        cls, slices: Source, reading: dict[str, Any], *, every: int | None, first: int, known: Sequence[int] | None,
        ignore: int | None, axis: int, suggest: int,
    ) -> _Given:  # fmt: skip
        volume = load(slices, **reading)
        volume = replace(volume, array=round_labels(volume.values))
        axis = check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
        values, marks, notes = np.moveaxis(volume.values, axis, 0), None, ()
        if ignore is not None:
            if every is not None or known is not None:
                raise ScanError("give either every, known or ignore")
            places, marks = annotated_slices(values, check_int(ignore, "a label to ignore", -SEEDS, IDS))
        elif every is None and known is None:
            places = choose_labelled(there := find_labelled(values))
            notes = note_labelled(places, there)
        else:
            places = known_places(len(values), every, first, known)
            notes = () if every is None else doubt_places(find_labelled(values), places)
        suggest = check_int(suggest, "a number of slices from 0", 0, len(values) - len(places))
        return cls(volume, axis, places, marks, notes, suggest)

    def turn(self, values: np.ndarray) -> np.ndarray:
        """Move the axis across the slices to the front."""
        return np.moveaxis(values, self.axis, 0)

    def turn_back(self, values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.moveaxis(values, 0, self.axis))


@dataclass(frozen=True, eq=False)
class _Engine:
    """What fills any slices: the network, and laws that start from its volume."""

    taught: Taught
    evidence: np.ndarray | None
    epsilon: float | None
    progress: Progress
    filled: dict[Slices, np.ndarray] = field(default_factory=dict)
    lowered: dict[tuple[Any, ...], np.ndarray] = field(default_factory=dict)

    def logits(self, slices: Slices) -> np.ndarray:
        """Return the network's log-odds of the inside (Z, Y, X), computed once."""
        if slices not in self.filled:
            step = sub_progress(self.progress, 0.5, 1.0)
            self.filled[slices] = fill(slices, self.taught, evidence=self.evidence, progress=step)
        return self.filled[slices]

    def level(self, slices: Slices) -> np.ndarray:
        """Return log-odds over those of the best threshold (Z, Y, X), times the edge of a voxel. Slices before the
        first known one and beyond the last have no threshold, unless an image tells them."""
        logits, told = self.logits(slices), slices.between | (self.evidence is not None)
        least = best_log_odds(logits[slices.between]) if slices.between.any() else 0.0
        return (min(slices.spacing[1:]) * (logits - np.where(told, least, 0)[:, None, None])).astype(np.float32)

    def run(self, slices: Slices, trial: Trial) -> np.ndarray:
        """Return the phase field (Z, Y, X) of a trial; a law is lowered once, whatever the trial's scores."""
        if trial.law is None:
            return _profile(self.level(slices), choose_epsilon(slices.frame, self.epsilon))
        tiling = Tiling.of(slices.frame, self.epsilon, periodic=slices.periodic)
        key = (slices, trial.law, trial.strength, trial.steps, trial.pull)
        if key not in self.lowered:
            step: Progress = lambda _, share: self.progress("trying the law out", share)  # noqa: E731
            problem = SlicesProblem(trial, slices, self.level(slices))
            self.lowered[key] = lower_volume(problem, tiling, progress=step).phase
        return self.lowered[key]


@dataclass(frozen=True, eq=False)
class SlicesProblem(Problem):
    """The volume between slices, and a trial whose strength is the stiffness of springs on the known voxels. `level`
    (length, Y, X), positive inside, is the start: log-odds over a threshold's, times the edge of a voxel."""

    slices: Slices
    level: np.ndarray

    @property
    def inputs(self) -> dict[str, object]:
        slices, trial = self.slices, self.trial
        numbers = {"places": slices.places, "spacing": slices.spacing, "periodic": slices.periodic}
        springs = {"strength": trial.strength, "pull": trial.pull}
        return {"slices": digest_of(slices.inside), **numbers, "start": digest_of(self.level), **springs}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, data.Data]:
        """Return the level on a box, and the hinge term that holds known voxels, and by the pull those between."""
        slices, trial, (rows, inside) = self.slices, self.trial, self.slices.known(box)
        numbers = slices.numbers(box)
        level = self.level[np.ix_(*numbers)]
        held = slices.between[numbers[0], None, None]
        pull = np.where(held, trial.pull / min(slices.spacing[1:]) * level, 0).astype(np.float32)
        pull[rows] = np.where(inside, trial.strength, -trial.strength)
        if slices.marks is not None:
            marks = slices.marks[np.ix_(*numbers)]
            pull = np.where(marks == 0, pull, trial.strength * marks).astype(np.float32)
        return level, data.Hinge(place.spread(pull, centre=0), MARGIN)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the optimal profile of the level."""
        return _profile(level, place.epsilon)

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the voxels where the phase field is positive, and the known ones as they are."""
        return self.slices.keep_known(phase > 0, box)


def _profile(level: np.ndarray, epsilon: float) -> np.ndarray:
    return np.tanh(level / (math.sqrt(2) * epsilon))


def _pose_task(slices: Slices, example: Example | None) -> Task[Slices]:
    """Return what a law is tried out on: a part of the example, or else every second known slice."""
    task = leave_out_slices(slices) if example is None else example.part
    if task is None:
        raise ScanError(
            "to try the prior out, give three or more known slices with voxels inside and outside, an example or a "
            f"stiffness, got {len(slices.places)} slices"
        )
    return task


def _weigh_evidence(
    engine: _Engine, trial: Trial, task: Task[Slices] | None, target: Slices, phase: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the probability of the inside (Z, Y, X) where a law was lowered, by the network's log-odds and the depth
    below the law's surface, with weights fitted to the task if there is one; and its calibration error there."""

    def evidence(slices: Slices, phase: np.ndarray, rows: list[int]) -> np.ndarray:
        depth = profile_distance(torch.from_numpy(phase[rows]), float(RESOLVED)).numpy()
        return np.stack([engine.logits(slices)[rows].ravel(), depth.ravel()], axis=-1)

    if task is None:
        return expit(engine.logits(target)), engine.taught.error
    rows, tried = list(task.places), engine.run(task.given, trial)
    known = evidence(task.given, tried, rows)
    weights = fit_weights(known, task.truth.ravel())
    told, near = probability(known, weights).reshape(task.truth.shape), near_surface(tried > 0)[rows]
    values = probability(evidence(target, phase, list(range(target.length))), weights).reshape(target.shape)
    values[target.outside] = np.minimum(values[target.outside], 0.5)
    return values, calibration_error(told[near], task.truth[near])


def _uncertainty(
    likely: np.ndarray, error: float, mask: np.ndarray, slices: Slices, given: _Given, *, told: bool
) -> Uncertainty:
    """Return what probabilities (Z, Y, X) say; `told` says whether an image tells the ends."""
    inside = slices.keep_known(np.zeros(slices.shape, dtype=bool))
    values = np.where(slices.known_voxels, inside, likely).astype(np.float32)
    suggestions = suggest_slices(doubt(values).sum((1, 2)), slices.places, given.suggest, slices.periodic)
    dice = expected_dice(likely[slices.between], mask[slices.between]) if slices.between.any() else 1.0
    areas, ends = slices.inside.mean((1, 2)), {"periodic": slices.periodic, "whole": told}
    known = share_by_slices(areas, slices.places, slices.length, **ends)
    likely_field = replace(given.volume, array=given.turn_back(values), notes=())
    mean = float(values[slice(None) if told else ~slices.outside].sum(dtype=np.float64)) / values.size
    return Uncertainty(likely_field, error, suggestions, dice, known_share=known, mean_probability=mean)


def _describe_gain(best: Trial, where: str) -> str:
    """Say what was chosen and what it gains, as the beginning of a sentence."""
    score, plain = f"Dice {best.score:.3f}", f"{best.plain:.3f}"
    if best.law is None:
        return f"no law helps here: Dice {plain} on slices {where} by the network alone, {best.score:.3f} with a law"
    return f"a law helps: {score} on slices {where}, {plain} by the network alone"


def _load_image(image: Source, volume: Volume, reading: dict[str, Any]) -> Volume:
    """Load the grey levels of the volume that the slices are of."""
    require("sklearn.ensemble", "image", "reading an image")
    field, laid = lay(load_with(image, reading, "crop"), volume, "the image", "the slices", exact=True)
    if (count := len(np.unique(field.values.ravel()[:: -(-field.values.size // SAMPLED)]))) < GREY:
        raise ScanError(f"the image must have grey levels, but has {count} values: is it a mask?")
    return replace(field, notes=laid)


def _read_evidence(
    levels: np.ndarray, slices: Slices, axis: int, progress: Progress
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return what an image says of a volume, None where it does not tell known slices, and sentences on its doubts."""
    off = zip(find_shift(levels, slices), "zyx".replace("zyx"[axis], ""), strict=True)
    doubts = tuple(SHIFTED.format(f"{voxels:+d}", name) for voxels, name in off if voxels)
    evidence, told = read_image(levels, slices, progress=progress)
    return (None, (*doubts, UNTOLD)) if told < TOLD else (evidence, doubts)


def _load_example(example: Source, volume: Volume, reading: dict[str, Any]) -> Volume:
    """Load an example with the spacing and unit of the slices, which are of `volume`."""
    field = load_with(example, reading)
    check_spacing(field, volume, "the slices")
    require_labels(field.values, "the example")
    return field


# ---- several structures ----------------------------------------------------------------------------------------------


def reconstruct_labels(
    slices: Source,
    prior: LawLike | Mapping[int, LawLike] | None = None,
    *,
    chosen: Sequence[int] | None = None,
    image: Source | None = None,
    instances: bool | None = None,
    example: Source | None = None,
    store: str | PathLike[str] | None = None,
    progress: Progress = silent,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    **options: Any,
) -> Segmentation:
    """Fill several structures between known slices, each by `reconstruct`; a voxel that two of them claim goes to the
    one with the greater phase field there.

    With an image, labels that are instances, such as cells, are filled as one structure, in which each voxel has the
    label that is nearest as filled without the image, and each label is kept in one piece.

    Each label is filled in the box where it may be. Where every voxel of the known slices is labelled, so is every
    voxel that is filled: an unclaimed voxel goes to the label with the largest phase value, or to the nearest. A label
    for which slices or example are too few for what is asked is filled by the network alone, and a note says why.

    Parameters
    ----------
    slices
        Labels of the whole volume's shape, whole numbers, 0 where there is nothing; only the known slices count.
    prior
        A law for all labels, or one for each, to be tried; by default none.
    chosen
        The labels that are structures, by default all but 0; the others count as nothing.
    example
        Labels of another volume of the same kind, known whole, with the same values for the same structures.
    instances
        Whether labels are of one kind that the image tells from the background, but not from each other; else it is
        read for each by itself. By default they are if nine in ten are one piece in each known slice and grey levels
        vary more within them than between them. Where every voxel is labelled, or the volume repeats, each is read by
        itself.
    options
        Those of `reconstruct`, as are the others.

    Returns
    -------
    Segmentation
        `labels` has the label of the structure at each voxel, `mask` whether there is one, `phase` the greatest phase
        field, `probability` that of the voxel's label; there are no coefficients. Its `status` is that of `reconstruct`
        for each label, or of many a summary.

    Raises
    ------
    ValueError
        As `reconstruct`, if it refuses all labels; or if the known slices do not have a label, or none but 0.
    """
    reading = {"spacing": spacing, "unit": unit}
    which = {name: options.pop(name, usual) for name, usual in WHICH.items()}
    given = _Given.read(slices, reading, **which)
    volume, places, notes, moved = given.volume, given.places, given.notes, given.turn(given.volume.values)
    numbers = find_labels(moved[places], chosen)
    if which["every"] is None and which["known"] is None and which["ignore"] is None:
        check_shared(moved, places, numbers)
    index = replace(volume, array=index_labels(volume.values, numbers, which["ignore"]), notes=())
    there = given.turn_back(mark_known(moved.shape, places, given.marks))
    labels = _Labels(replace(given, volume=index), there, which["ignore"] is not None, options)
    other = None if example is None else _load_example(example, volume, reading)
    seen = None if image is None else _load_image(image, volume, reading)
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(numbers, prior)
    drawn, whole, alone = given.turn(index.values)[places].clip(0), None, seen
    full, periodic = bool(drawn.all()), bool(options.get("periodic"))
    if seen is not None and not full and not periodic:
        if instances is None:
            instances = are_instances(drawn, given.turn(seen.values)[places], len(numbers))
        notes = (*notes, *seen.notes, ONCE if instances else APIECE)
        if instances:
            bare = replace(seen, affine=None, notes=())
            whole = labels.fill(None, WHOLE, image=bare, progress=sub_progress(progress, 0.0, 0.5))
            progress, alone = sub_progress(progress, 0.5, 1.0), None
            options.pop("filler", None)  # that one reads images
            notes = (*notes, *(note for note in whole.notes if note.startswith(SHIFTED.partition("{")[0])))
        if whole is not None and UNTOLD in whole.notes:
            whole, notes = None, (*notes[:-1], UNTOLD)
    parts, said = _fill_each(labels, numbers, laws, (alone, other, store), progress)
    far = np.ones(moved.shape, dtype=bool)
    far[slice(None) if periodic or seen is not None else reach_of(places, len(moved))] = False
    values, likely, phase, odds = _join_parts(labels, parts, full, given.turn_back(far))
    doubts = {number: part.uncertainty for number, (_, part) in zip(numbers, parts, strict=True)}
    dice = {number: doubt.expected_dice for number, doubt in doubts.items() if doubt is not None}
    if whole is not None:
        values, likely, found = _split_instances(labels, parts, whole, values, odds)
        dice, phase, said = dict(zip(numbers, found, strict=True)), whole.phase.values, whole.notes
    likely = np.where(labels.known, 1.0, likely).astype(np.float32)
    error = max(doubt.calibration_error for doubt in (whole and whole.uncertainty, *doubts.values()) if doubt)
    following = suggest_slices(doubt(given.turn(likely)).sum((1, 2)), places, given.suggest, periodic)
    likely = replace(volume, array=likely, notes=())
    table = np.array([0, *numbers], volume.values.dtype if volume.values.dtype.kind in "iu" else np.int64)
    if (kind := smallest_type(table)).itemsize < 8:  # of 64 bits the given one
        table = table.astype(kind)
    return Segmentation.of(
        volume, values != 0, np.maximum(phase, -1), None, max(part.epsilon for _, part in parts), (*notes, *said),
        weight=None, status=_describe_labels(parts, dice, whole, following), image=seen,
        labels=replace(volume, array=table[values], notes=()),
        uncertainty=Uncertainty(likely, error, following, min(dice.values()), dice),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Labels:
    """What is given, with labels by their places (`index_labels`), the known voxels, whether others are marked as such,
    and options of `reconstruct`."""

    given: _Given
    known: np.ndarray
    marked: bool
    options: dict[str, Any]

    @property
    def values(self) -> np.ndarray:
        """The places of the labels (Z, Y, X)."""
        return self.given.volume.values

    def fill(self, place: int | None, box: Box, law: LawLike | None = None, **more: Any) -> Segmentation:
        """Fill one label in a box, by its place, or all as one structure."""
        values, given = self.values[box], self.given
        inside = (values > 0 if place is None else values == place).astype(np.uint8)
        start, stop, _ = box[given.axis].indices(self.values.shape[given.axis])
        which: dict[str, Any] = {"known": [k - start for k in given.places if start <= k < stop]}
        if self.marked:
            inside[values < 0], which = UNKNOWN, {"ignore": UNKNOWN}
        mask = replace(given.volume, array=inside, affine=None)
        return reconstruct(mask, law, axis=given.axis, **which, **self.options, **more)


_Parts = list[tuple[Box, Segmentation]]


def _fill_each(
    labels: _Labels, numbers: Sequence[int], laws: Mapping[int, Any], tools: tuple[Any, Any, Any], progress: Progress
) -> tuple[_Parts, Sequence[str]]:
    """Fill each label in its box, with image, example and store as `tools`, or by the network alone where it is refused
    so; return boxes and labels, and notes."""
    parts, notes, (image, example, store) = [], dict[str, list[int]](), tools
    for place, number in enumerate(numbers, 1):
        inside = (labels.values == place) & labels.known
        box = WHOLE if labels.options.get("periodic") else _box_of_label(inside, labels)
        more = {
            "image": image and replace(image, array=image.values[box], affine=None, notes=()),
            "example": example and replace(example, array=(example.values == number).astype(np.uint8), notes=()),
            "store": store and Path(store) / str(number),
        }
        step = sub_progress(progress, (place - 1) / len(numbers), place / len(numbers))
        try:
            part = labels.fill(place, box, laws.get(number), progress=step, **more)
        except ScanError as reason:
            part = labels.fill(place, box, progress=step)
            notes[f"Filled by the network alone: {reason}."] = [number]
        parts.append((box, part))
        for note in part.notes:
            notes.setdefault(note, []).append(number)
    named = {text: f"Label{'s' * (len(of) > 1)} {', '.join(map(str, of))}: {text}" for text, of in notes.items()}
    return parts, [text if len(notes[text]) == len(numbers) else said for text, said in named.items()]


def _join_parts(labels: _Labels, parts: _Parts, full: bool, far: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the place of the label with the greatest phase field at each voxel, 0 where there is none or `far` from
    known slices; how likely that is; this phase field; and the sum of the labels' odds."""
    shape = labels.values.shape
    deepest, owner = np.full(shape, -np.inf, dtype=np.float32), np.zeros(shape, dtype=np.int16)
    largest, odds = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    for place, (box, part) in enumerate(parts, 1):
        owner[box] = np.where(part.phase.values > deepest[box], place, owner[box])
        deepest[box] = np.maximum(deepest[box], part.phase.values)
        own = _odds(part)
        largest[box], odds[box] = np.maximum(largest[box], own), odds[box] + own
    if full and (unseen := np.isneginf(deepest)).any():  # in no label's box
        spacing = labels.given.volume.spacing
        near = ndimage.distance_transform_edt(unseen, spacing, return_distances=False, return_indices=True)
        owner = owner[tuple(near)]  # type: ignore[arg-type]
    values = np.where(labels.known, labels.values, np.where(((deepest > 0) | full) & ~far, owner, 0))
    likely = np.where(values, largest, 1.0) / np.maximum(odds + ((values == 0) | (not full)), SURE)
    return values, likely, deepest, odds


def _split_instances(
    labels: _Labels, parts: _Parts, whole: Segmentation, values: np.ndarray, odds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Split what all labels fill as one structure by where each is alone; return places, their probabilities (that of
    the structure times the label's share in the odds of all), and the Dice to expect of each."""
    assert whole.probability is not None
    values = split_structure(whole.mask.values, values, labels.known, labels.given.volume.spacing)
    inside, given = whole.probability.values, labels.given
    likely, dice = np.where(values, inside, 1 - inside), []
    between = np.zeros(values.shape[given.axis], dtype=bool)
    between[given.places[0] : given.places[-1]] = True
    between[given.places] = False
    for place, (box, part) in enumerate(parts, 1):
        own, mine = inside[box] * _odds(part) / np.maximum(odds[box], SURE), values[box] == place
        likely[box] = np.where(mine, own, likely[box])
        own, mine = (given.turn(each)[between[box[given.axis]]] for each in (own, mine))
        dice.append(expected_dice(own, mine) if own.size else 1.0)
    return values, likely, dice


def _box_of_label(inside: np.ndarray, labels: _Labels) -> Box:
    """Return the box in which a label may be, given where it is known to be (Z, Y, X): along the axis up to the known
    slices without it, and across it `ROOM` voxels and two gaps beyond."""
    places, axis, spacing = labels.given.places, labels.given.axis, labels.given.volume.spacing
    step = 2 * max(np.diff(places)) * spacing[axis]
    box: list[slice] = []
    for k in range(3):
        found = np.flatnonzero(inside.any(tuple({0, 1, 2} - {k})))
        low, high = int(found[0]), int(found[-1])
        if k == axis:
            before, beyond = [p for p in places if p < low], [p for p in places if p > high]
            box.append(slice(before[-1] if before else 0, beyond[0] + 1 if beyond else inside.shape[k]))
        else:
            margin = ROOM + math.ceil(step / spacing[k])
            box.append(slice(max(low - margin, 0), min(high + 1 + margin, inside.shape[k])))
    return box[0], box[1], box[2]


def _describe_labels(
    parts: _Parts, dice: Mapping[int, float], whole: Segmentation | None, following: Sequence[int]
) -> str:
    """Say how some labels were filled, and of many or of instances how well in the median and in the worst case."""
    end = f"; annotate next: {', '.join(map(str, following))}" if following else ""
    if len(parts) <= FEW and whole is None:
        each = zip(dice, parts, strict=True)
        return "; ".join(f"label {number}: {part.status}" for number, (_, part) in each) + end
    worst = ", ".join(f"label {number} {dice[number]:.2f}" for number in sorted(dice, key=lambda n: dice[n])[:FEW])
    median = f"expect a Dice of {np.median(list(dice.values())):.2f} between known slices in the median; least: {worst}"
    how = "filled:" if whole is None else f"filled as instances of one structure, {whole.status}; of labels,"
    return f"{len(parts)} labels {how} {median}{end}"


def _odds(part: Segmentation) -> np.ndarray:
    """Return the odds of the inside, finite."""
    likely = np.clip(part.mask.values if part.probability is None else part.probability.values, SURE, 1 - SURE)
    return likely / (1 - likely)


def find_labels(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: the chosen ones, or all but 0. Raises
    `ScanError` if the values are grey levels, a chosen label is missing, or there is none but 0."""
    if chosen is not None:
        chosen = sorted({check_int(n, "labels that are whole numbers", -SEEDS, IDS) for n in chosen})
        others = require_labels(values, "the known slices", math.inf)  # of those that are not chosen any number
        values = np.where(index_labels(others, chosen), others, 0)
    found = [int(value) for value in np.unique(require_labels(values, "the known slices"))]
    numbers = [number for number in found if number] if chosen is None else chosen
    listed = ", ".join(map(str, found[:12])) + (", …" if len(found) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"labels must be other than 0, got {'0' if numbers else f'{listed} in the known slices'}")
    if missing := [number for number in numbers if number not in found]:
        raise ScanError(f"the known slices have the labels {listed}, but not {', '.join(map(str, missing))}")
    return numbers


def are_instances(labels: np.ndarray, levels: np.ndarray, count: int) -> bool:
    """Return whether labels from 1 to `count` in slices (N, Y, X) are instances, as they are drawn and by grey levels
    there: nine in ten are, but for a tenth of their area, one piece in each slice, and grey levels vary more within
    labels than between them."""
    own, grey = labels[labels > 0], levels[labels > 0].astype(np.float64)
    total, largest = np.bincount(own, minlength=count + 1), np.zeros(count + 1)
    for plane in labels:
        pieces = np.asarray(measure.label(plane, connectivity=2))
        owner = np.zeros(pieces.max() + 1, dtype=np.intp)
        owner[pieces] = plane
        best = np.zeros(count + 1)
        np.maximum.at(best, owner, np.bincount(pieces.ravel()))
        largest += best
    means = np.bincount(own, grey, minlength=count + 1) / np.maximum(total, 1)
    whole = (largest >= PIECE * total)[1:].mean() >= MOST
    return bool(whole and means[own].var() <= ALIKE * grey.var())


def split_structure(mask: np.ndarray, labels: np.ndarray, known: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
    """Return labels of a structure's mask (Z, Y, X): each voxel has the nearest of the `labels` (Z, Y, X), which are 0
    where there is none, and those of `known` voxels stay. Each label is kept in one piece: of the pieces that it has,
    those without a known voxel go to the label that they touch most, or to the background."""
    near = ndimage.distance_transform_edt(labels == 0, spacing, return_distances=False, return_indices=True)
    found = np.where(known, labels, np.where(mask, labels[tuple(near)], 0))  # type: ignore[arg-type]
    pieces = np.asarray(measure.label(found, connectivity=3))
    owner, stays = np.zeros(pieces.max() + 1, dtype=found.dtype), np.zeros(pieces.max() + 1, dtype=bool)
    owner[pieces], stays[pieces[known]], stays[0] = found, True, True
    row = np.cumsum(~stays) - 1
    touched = np.zeros((np.count_nonzero(~stays), int(labels.max()) + 1), dtype=np.intp)
    for axis in range(3):
        turned = np.moveaxis(pieces, axis, 0)
        for one, other in ((turned[1:], turned[:-1]), (turned[:-1], turned[1:])):
            meet = ~stays[one] & stays[other] & (other > 0)
            np.add.at(touched, (row[one[meet]], owner[other[meet]]), 1)
    owner[~stays] = touched.argmax(1)  # that is 0 where nothing is touched
    return owner[pieces]
