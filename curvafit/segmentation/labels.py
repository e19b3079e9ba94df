"""Several structures between known slices: each is filled by `reconstruct`, and each voxel gets one label."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from skimage import measure

from curvafit.core.checks import SEEDS, check_int
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.priors.law import LawLike
from curvafit.segmentation.flow import Working
from curvafit.segmentation.known import Known, check_shared, check_which, list_numbers
from curvafit.segmentation.reconstruction import UNTOLD, Inputs, fill_between, load_example, load_image
from curvafit.segmentation.result import Segmentation, Uncertainty
from curvafit.segmentation.slices import IDS, WHOLE, filled_range, index_labels, mark_between, require_labels
from curvafit.segmentation.uncertainty import doubt, expected_dice, suggest_slices
from curvafit.volumes.formats.base import smallest_type
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Run
from curvafit.volumes.volume import Box, ScanError, Volume, grow, round_labels

#: Label of unknown voxels in the mask of one structure.
UNKNOWN = 255
#: Labels that are described one by one.
FEW = 4
ONCE = "The labels are read in the image as instances of one structure (--no-instances reads each by itself)."
APIECE = "Each label is read in the image by itself (--instances reads those of one kind, such as cells, as one)."
#: Voxels around a label's box.
ROOM = 16
#: Probabilities are clipped by this much from 0 and 1 before odds are taken.
SURE = 1e-6
#: Labels are instances, objects of one kind that an image does not distinguish, if in the fraction `MOST` of them at
#: least `PIECE` of the area is one piece in each slice, and they explain at most `ALIKE` of the grey levels' variance.
PIECE, MOST, ALIKE = 0.9, 0.9, 0.5


def reconstruct_labels(
    slices: Source,
    prior: LawLike | Mapping[int, LawLike] | None = None,
    *,
    chosen: Sequence[int] | None = None,
    image: Source | None = None,
    instances: bool | None = None,
    example: Source | None = None,
    working: Working = Working(),
    progress: Progress = silent,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    **options: Any,
) -> Segmentation:
    """Fill several structures between known slices, each by `reconstruct`; a voxel that two of them claim goes to the
    more probable one.

    With an image, labels that are instances, such as cells, are filled as one structure, in which each voxel has the
    label that is nearest as filled without the image, and each label is kept in one piece.

    Each label is filled in the box where it may be. Where every voxel of the known slices is labelled, so is every
    voxel that is filled: an unclaimed voxel goes to the most probable label, or to the nearest. A label for which
    slices or example are too few for what is asked is filled by the network alone, and a note says why.

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
        vary more within them than between them. Where every voxel is labelled, each is read by itself.
    options
        Those of `reconstruct`, as are the others: every, known, ignore, axis and suggest.

    In the result `labels` has the label of the structure at each voxel, `mask` whether there is one, `probability` that
    of the voxel's label; there are neither coefficients nor a phase field. Its `status` is that of `reconstruct` for
    each label, or of many a summary. Raises ValueError as `reconstruct`, if it refuses all labels; or if the known
    slices do not have a label, or none but 0.
    """
    reading = {"spacing": spacing, "unit": unit}
    inputs = _Inputs.load(slices, chosen, image, example, working=working, reading=reading, **options)
    first, rest = sub_progress(progress, 0.0, 0.5), sub_progress(progress, 0.5, 1.0)
    whole, alone, notes = _fill_instances(inputs, instances, first)
    parts, reasons = _fill_each(alone, prior, progress if alone is inputs else rest)
    return _join_labels(inputs, parts, whole, notes, reasons)


@dataclass(frozen=True, eq=False)
class _Inputs:
    """What labels are filled from: known slices; the `labels` to fill, and for each voxel (Z, Y, X) the index of its
    label (`index_labels`); which voxels are known, and whether others are `marked`; and what `reconstruct` takes."""

    known: Known
    indices: np.ndarray
    labels: list[int]
    known_voxels: np.ndarray
    marked: bool
    suggest: int
    image: Volume | None
    example: Volume | None
    working: Working

    @classmethod
    def load(
        cls, slices: Source, chosen: Sequence[int] | None, image: Source | None, example: Source | None, *,
        working: Working, reading: dict[str, Any], suggest: int = 0, **which: Any,
    ) -> _Inputs:  # fmt: skip
        """Read labels, image and example, and find which slices and which labels are known."""
        volume = load(slices, **reading)
        check_which(volume.shape, **which, suggest=suggest)
        volume = replace(volume, array=round_labels(volume.values))
        known, ignore = Known.find(volume, Run(), **which), which.get("ignore")
        places, values = list(known.places), known.turn(volume.values)
        labels = find_labels(values[places], chosen)
        if all(which.get(name) is None for name in ("every", "known", "ignore")):
            check_shared(values, places, labels)
        indices = index_labels(volume.values, labels, ignore)
        known_voxels = np.zeros(values.shape, dtype=bool) if known.marks is None else known.marks != 0
        known_voxels[places] = True
        annotated = None if example is None else load_example(example, volume, reading)
        grey = None if image is None else load_image(image, volume, reading)
        return cls(
            known, indices, labels, known.turn_back(known_voxels), ignore is not None, suggest, grey, annotated,
            working,
        )  # fmt: skip

    @property
    def in_slices(self) -> np.ndarray:
        """The indices of labels in the known slices (N, Y, X), 0 where there is none."""
        return self.known.turn(self.indices)[list(self.known.places)].clip(0)

    @property
    def full(self) -> bool:
        """Whether every voxel of the known slices is labelled."""
        return bool(self.in_slices.all())

    def fill(self, index: int | None, box: Box, law: LawLike | None = None, **more: Any) -> Segmentation:
        """Fill the label with an index in a box, or all labels as one structure; `more` is as in `reconstruct`."""
        indices, known, working = self.indices[box], self.known, more.get("working", self.working)
        inside = (indices > 0 if index is None else indices == index).astype(np.uint8)
        start, stop, _ = box[known.axis].indices(self.indices.shape[known.axis])
        which: dict[str, Any] = {"ignore": UNKNOWN if self.marked else None, "axis": known.axis}
        if self.marked:
            inside[indices < 0] = UNKNOWN
        else:
            which["known"] = [place - start for place in known.places if start <= place < stop]
        mask = replace(known.volume, array=inside, affine=None, notes=())
        if law is None:
            working = replace(working, tile=None)  # a box of a label is filled at once
        inputs = Inputs.load(mask, which, law, more.get("image"), more.get("example"), working=working, reading={})
        with inputs.open_run(working, more["progress"]) as run:
            return fill_between(inputs, run, working, more["progress"], larger=known)


def _fill_instances(
    inputs: _Inputs, instances: bool | None, progress: Progress
) -> tuple[Segmentation | None, _Inputs, tuple[str, ...]]:
    """Fill labels that are instances as one structure, by the image. Return this structure, None if they are not or the
    image does not show it; the inputs from which each label is to be filled then; and notes."""
    image = inputs.image
    if image is None or inputs.full:
        return None, inputs, ()
    if instances is None:
        levels = inputs.known.turn(image.values)[list(inputs.known.places)]
        instances = are_instances(inputs.in_slices, levels, len(inputs.labels))
    if not instances:
        return None, inputs, (*image.notes, APIECE)
    whole = inputs.fill(None, WHOLE, image=replace(image, affine=None, notes=()), progress=progress)
    # Without the image each label is filled by the packaged network: that of `working` reads images.
    alone = replace(inputs, image=None, working=replace(inputs.working, filler=None))
    if UNTOLD in whole.notes:
        return None, alone, (*image.notes, UNTOLD)
    return whole, alone, (*image.notes, ONCE)


def _join_labels(
    inputs: _Inputs, parts: _Parts, whole: Segmentation | None, notes: Sequence[str], reasons: Sequence[str]
) -> Segmentation:
    """Return the result of labels that were filled one by one (`parts`), or that split a `whole`."""
    known, image, labels = inputs.known, inputs.image, inputs.labels
    volume, places = known.volume, list(known.places)
    unfilled = np.ones(known.turn(inputs.indices).shape, dtype=bool)
    filled = filled_range(places, len(unfilled))
    unfilled[slice(None) if image is not None else filled] = False
    indices, likely, odds = _join_parts(inputs, parts, inputs.full, known.turn_back(unfilled))
    doubts = {label: part.uncertainty for label, (_, part) in zip(labels, parts, strict=True)}
    dice = {label: doubt.expected_dice for label, doubt in doubts.items() if doubt is not None}
    if whole is not None:
        indices, likely, expected = _split_instances(inputs, parts, whole, indices, odds)
        dice, reasons = dict(zip(labels, expected, strict=True)), whole.notes
    likely = np.where(inputs.known_voxels, 1.0, likely).astype(np.float32)
    error = max(doubt.calibration_error for doubt in (whole and whole.uncertainty, *doubts.values()) if doubt)
    entropy = doubt(likely)
    entropies = tuple(entropy.sum(tuple({0, 1, 2} - {axis})) for axis in range(3))
    suggestions = suggest_slices(entropies[known.axis], places, inputs.suggest)
    entropies[known.axis][~mark_between(places, len(unfilled))] = 0
    table = np.array([0, *labels], volume.values.dtype if volume.values.dtype.kind in "iu" else np.int64)
    if (kind := smallest_type(table)).itemsize < 8:  # labels of 64 bits keep their type
        table = table.astype(kind)
    uncertain = Uncertainty(
        replace(volume, array=likely, notes=()), error, suggestions, min(dice.values()), dice, entropies=entropies
    )
    return Segmentation.of(
        volume, indices != 0, None, None, max(part.epsilon for _, part in parts),
        (*known.notes, *notes, *reasons), weight=None, status=_describe_labels(parts, dice, whole, suggestions),
        image=image, labels=replace(volume, array=table[indices], notes=()), uncertainty=uncertain,
    )  # fmt: skip


#: The box in which each label was filled, and the result there.
_Parts = list[tuple[Box, Segmentation]]


def _fill_each(
    inputs: _Inputs, prior: LawLike | Mapping[int, LawLike] | None, progress: Progress
) -> tuple[_Parts, Sequence[str]]:
    """Fill each label in its box, by the network alone where `reconstruct` refuses more; return the results, and notes
    with the labels that they concern."""
    parts, labels_of_note, count = [], dict[str, list[int]](), len(inputs.labels)
    image, example, store = inputs.image, inputs.example, inputs.working.store
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(inputs.labels, prior)
    for index, label in enumerate(inputs.labels, 1):
        inside = (inputs.indices == index) & inputs.known_voxels
        box = _box_of_label(inside, inputs)
        more = {
            "image": image and replace(image, array=image.values[box], affine=None, notes=()),
            "example": example and replace(example, array=(example.values == label).astype(np.uint8), notes=()),
            "working": replace(inputs.working, store=store and Path(store) / str(label)),
        }
        step = sub_progress(progress, (index - 1) / count, index / count)
        try:
            part = inputs.fill(index, box, laws.get(label), progress=step, **more)
        except ScanError as reason:
            part = inputs.fill(index, box, progress=step, working=replace(inputs.working, store=None))
            labels_of_note[f"Filled by the network alone: {reason}."] = [label]
        parts.append((box, part))
        for note in part.notes:
            labels_of_note.setdefault(note, []).append(label)
    notes = []
    for note, labels in labels_of_note.items():
        names = f"Label{'s' * (len(labels) > 1)} {', '.join(map(str, labels))}: "
        notes.append(note if len(labels) == count else names + note)
    return parts, notes


def _join_parts(inputs: _Inputs, parts: _Parts, full: bool, unfilled: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return, for each voxel (Z, Y, X), the index of the most probable label of those that claim it, 0 in the
    background and where nothing is filled; the probability of it; and the sum of the labels' odds. Where voxels must
    have a label (`full`), one that none claims goes to the most probable of all."""
    shape = inputs.indices.shape
    score, owner = np.full(shape, -1, dtype=np.float32), np.zeros(shape, dtype=np.int16)
    largest, total = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    claimed = np.full(shape, full)
    for index, (box, part) in enumerate(parts, 1):
        assert part.probability is not None
        own = part.probability.values + part.mask.values  # a label that claims a voxel comes before all that do not
        owner[box] = np.where(own > score[box], index, owner[box])
        score[box], claimed[box] = np.maximum(score[box], own), claimed[box] | part.mask.values
        odds = _odds(part)
        largest[box], total[box] = np.maximum(largest[box], odds), total[box] + odds
    if full and (uncovered := owner == 0).any():  # in no label's box
        owner = _take_nearest(owner, uncovered, inputs.known.volume.spacing)
    indices = np.where(inputs.known_voxels, inputs.indices, np.where(claimed & ~unfilled, owner, 0))
    # The background counts with odds of 1, unless every voxel is to have a label.
    likely = np.where(indices, largest, 1.0) / np.maximum(total + ((indices == 0) | (not full)), SURE)
    return indices, likely, total


def _take_nearest(values: np.ndarray, missing: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
    """Replace values (Z, Y, X) where they are missing by those of the nearest voxel that has one."""
    nearest = ndimage.distance_transform_edt(missing, spacing, return_distances=False, return_indices=True)
    return values[tuple(nearest)]  # type: ignore[arg-type]


def _split_instances(
    inputs: _Inputs, parts: _Parts, whole: Segmentation, indices: np.ndarray, odds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Split the whole structure among its labels, given the `indices` (Z, Y, X) of labels filled alone. Return the new
    indices, probabilities (the structure's times the label's part of the summed `odds`), and each expected Dice."""
    assert whole.probability is not None
    known = inputs.known
    indices = split_structure(whole.mask.values, indices, inputs.known_voxels, known.volume.spacing)
    inside = whole.probability.values
    likely, dice = np.where(indices, inside, 1 - inside), []
    between = mark_between(known.places, indices.shape[known.axis])
    for index, (box, part) in enumerate(parts, 1):
        probabilities, mask = inside[box] * _odds(part) / np.maximum(odds[box], SURE), indices[box] == index
        likely[box] = np.where(mask, probabilities, likely[box])
        rows = between[box[known.axis]]
        probabilities, mask = known.turn(probabilities)[rows], known.turn(mask)[rows]
        dice.append(expected_dice(probabilities, mask) if mask.size else 1.0)
    return indices, likely, dice


def _box_of_label(inside: np.ndarray, inputs: _Inputs) -> Box:
    """Return the box in which a label may be, given its known voxels, bool (Z, Y, X): from the last known slice before
    them to the next known slice beyond; within slices `ROOM` voxels and two gaps more on each side."""
    places, axis, spacing = inputs.known.places, inputs.known.axis, inputs.known.volume.spacing
    two_gaps = 2 * max(np.diff(places)) * spacing[axis]
    bounds = ndimage.find_objects(inside.view(np.uint8))[0]
    box = list(grow(bounds, [ROOM + math.ceil(two_gaps / h) for h in spacing], inside.shape))
    before = [place for place in places if place < bounds[axis].start]
    beyond = [place for place in places if place >= bounds[axis].stop]
    box[axis] = slice(before[-1] if before else 0, beyond[0] + 1 if beyond else inside.shape[axis])
    return box[0], box[1], box[2]


def _describe_labels(
    parts: _Parts, dice: Mapping[int, float], whole: Segmentation | None, suggestions: Sequence[int]
) -> str:
    """Return the status: that of each of a few labels; of many, or of instances, the median Dice and the worst ones."""
    end = f"; annotate next: {', '.join(map(str, suggestions))}" if suggestions else ""
    if len(parts) <= FEW and whole is None:
        return "; ".join(f"label {label}: {part.status}" for label, (_, part) in zip(dice, parts, strict=True)) + end
    worst = ", ".join(f"label {label} {dice[label]:.2f}" for label in sorted(dice, key=lambda label: dice[label])[:FEW])
    median = f"expect a Dice of {np.median(list(dice.values())):.2f} between known slices in the median; least: {worst}"
    start = "filled:" if whole is None else f"filled as instances of one structure, {whole.status}; of labels,"
    return f"{len(parts)} labels {start} {median}{end}"


def _odds(part: Segmentation) -> np.ndarray:
    """Return the odds of the inside in each voxel of a label's box, finite."""
    assert part.probability is not None
    likely = np.clip(part.probability.values, SURE, 1 - SURE)
    return likely / (1 - likely)


def find_labels(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels to fill, ascending: the chosen ones, or all but 0 in the known slices (N, Y, X). Raises
    `ScanError` if the values are grey levels, a chosen label is missing, or there is none but 0."""
    if chosen is not None:
        chosen = sorted({check_int(label, "labels that are whole numbers", -SEEDS, IDS) for label in chosen})
        values = require_labels(values, "the known slices", math.inf)  # only the chosen ones must be few
        values = np.where(index_labels(values, chosen), values, 0)
    present = [int(value) for value in np.unique(require_labels(values, "the known slices"))]
    labels = [label for label in present if label] if chosen is None else chosen
    listed = list_numbers(present, 12)
    if not labels or 0 in labels:
        raise ScanError(f"labels must be other than 0, got {'0' if labels else f'{listed} in the known slices'}")
    if missing := [label for label in labels if label not in present]:
        raise ScanError(f"the known slices have the labels {listed}, but not {', '.join(map(str, missing))}")
    return labels


def are_instances(labels: np.ndarray, levels: np.ndarray, count: int) -> bool:
    """Return whether labels from 1 to `count` in slices (N, Y, X) with grey `levels` are instances: nine in ten are one
    piece in each slice, but for a tenth of their area, and grey levels vary more within labels than between them."""
    inside = labels > 0
    owners, grey = labels[inside], levels[inside].astype(np.float64)
    areas, largest = np.bincount(owners, minlength=count + 1), np.zeros(count + 1)
    for plane in labels:
        pieces = np.asarray(measure.label(plane, connectivity=2))
        label_of_piece = np.zeros(pieces.max() + 1, dtype=np.intp)
        label_of_piece[pieces] = plane
        largest_here = np.zeros(count + 1)
        np.maximum.at(largest_here, label_of_piece, np.bincount(pieces.ravel()))
        largest += largest_here
    means = np.bincount(owners, grey, minlength=count + 1) / np.maximum(areas, 1)
    compact = (largest >= PIECE * areas)[1:].mean() >= MOST
    return bool(compact and means[owners].var() <= ALIKE * grey.var())


def split_structure(mask: np.ndarray, labels: np.ndarray, known: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
    """Split a structure's mask (Z, Y, X) among `labels` (Z, Y, X), 0 where there is none: each voxel gets the nearest,
    and `known` voxels keep theirs. Each label is kept in one piece: a piece without a known voxel goes to the label
    that it touches most, or to the background."""
    labelled = np.where(known, labels, np.where(mask, _take_nearest(labels, labels == 0, spacing), 0))
    pieces = np.asarray(measure.label(labelled, connectivity=3))
    label_of_piece = np.zeros(pieces.max() + 1, dtype=labelled.dtype)
    label_of_piece[pieces] = labelled
    anchored = np.zeros(len(label_of_piece), dtype=bool)  # pieces that keep their label, with the background, 0
    anchored[pieces[known]] = anchored[0] = True
    row_of_piece = np.cumsum(~anchored) - 1
    contacts = np.zeros((np.count_nonzero(~anchored), int(labels.max()) + 1), dtype=np.intp)
    for axis in range(3):
        moved = np.moveaxis(pieces, axis, 0)
        for piece, neighbour in ((moved[1:], moved[:-1]), (moved[:-1], moved[1:])):
            touching = ~anchored[piece] & anchored[neighbour] & (neighbour > 0)
            np.add.at(contacts, (row_of_piece[piece[touching]], label_of_piece[neighbour[touching]]), 1)
    label_of_piece[~anchored] = contacts.argmax(1)  # 0 where nothing is touched
    return label_of_piece[pieces]
