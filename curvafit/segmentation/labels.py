"""Several structures between known slices: each is filled by `reconstruct`, and a voxel goes to one of them."""

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
from curvafit.segmentation.known import Known, check_shared, check_which, doubt_places
from curvafit.segmentation.reconstruction import SHIFTED, SURE, UNTOLD, load_example, load_image, reconstruct
from curvafit.segmentation.result import Segmentation, Uncertainty
from curvafit.segmentation.slices import IDS, WHOLE, filled_range, index_labels, mark_known, require_labels
from curvafit.segmentation.uncertainty import doubt, expected_dice, suggest_slices
from curvafit.volumes.formats.base import smallest_type
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Run
from curvafit.volumes.volume import Box, ScanError, Volume, round_labels

#: Which slices are known, unless it is said.
WHICH: dict[str, Any] = {"every": None, "known": None, "ignore": None, "axis": 0}
#: Label of unknown voxels in the mask of one structure.
UNKNOWN = 255
#: Labels that are described one by one.
FEW = 4
ONCE = "The labels are read in the image as instances of one structure (--no-instances reads each by itself)."
APIECE = "Each label is read in the image by itself (--instances reads those of one kind, such as cells, as one)."
#: Voxels around a label's box.
ROOM = 16
#: Of instances, labels of one kind that an image tells from the background but not from each other: the share of a
#: label's area that is in one piece in each slice, the share of labels of which that holds, and the greatest share of
#: the variance of grey levels that is due to which label they have.
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
        Those of `reconstruct`, as are the others: every, known, ignore, axis, suggest and periodic.

    In the result `labels` has the label of the structure at each voxel, `mask` whether there is one, `phase` the
    greatest phase field, `probability` that of the voxel's label; there are no coefficients. Its `status` is that of
    `reconstruct` for each label, or of many a summary. Raises ValueError as `reconstruct`, if it refuses all labels; or
    if the known slices do not have a label, or none but 0.
    """
    reading = {"spacing": spacing, "unit": unit}
    labels = _Labels.load(slices, chosen, image, example, working=working, reading=reading, **options)
    first, rest = sub_progress(progress, 0.0, 0.5), sub_progress(progress, 0.5, 1.0)
    whole, alone, notes = _fill_instances(labels, instances, first)
    parts, reasons = _fill_each(alone, prior, progress if alone is labels else rest)
    return _join_labels(labels, parts, whole, notes, reasons)


@dataclass(frozen=True, eq=False)
class _Labels:
    """What labels are filled from: known slices with labels by their places (`index_labels`), the labels' numbers, the
    known voxels (Z, Y, X), whether others are marked as such, and what goes to `reconstruct` for each."""

    given: Known
    values: np.ndarray
    numbers: list[int]
    known: np.ndarray
    marked: bool
    periodic: bool
    suggest: int
    image: Volume | None
    example: Volume | None
    working: Working

    @classmethod
    def load(
        cls, slices: Source, chosen: Sequence[int] | None, image: Source | None, example: Source | None, *,
        working: Working, reading: dict[str, Any], suggest: int = 0, periodic: bool = False, **which: Any,
    ) -> _Labels:  # fmt: skip
        """Read labels, image and example, and find which slices and which labels are known."""
        which, volume = {**WHICH, **which}, load(slices, **reading)
        check_which(volume.shape, **which, suggest=suggest)
        volume = replace(volume, array=round_labels(volume.values))
        given, ignore = Known.find(volume, Run(), **which), which["ignore"]
        places, slices_first = list(given.places), given.turn(volume.values)
        doubts = () if which["every"] is None else doubt_places(np.asarray((slices_first > 0).any((1, 2))), places)
        suggest = check_int(suggest, "a number of slices from 0", 0, len(slices_first) - len(places))
        numbers = find_labels(slices_first[places], chosen)
        if which["every"] is None and which["known"] is None and ignore is None:
            check_shared(slices_first, places, numbers)
        given = replace(given, notes=(*given.notes, *doubts))
        values = index_labels(volume.values, numbers, ignore)
        known = given.turn_back(mark_known(slices_first.shape, places, given.marks))
        other = None if example is None else load_example(example, volume, reading)
        levels = None if image is None else load_image(image, volume, reading)
        return cls(
            given, values, numbers, known, ignore is not None, periodic, suggest, levels, other, working
        )  # fmt: skip

    @property
    def drawn(self) -> np.ndarray:
        """The places of labels in the known slices, from 1, 0 where there is none."""
        return self.given.turn(self.values)[list(self.given.places)].clip(0)

    @property
    def full(self) -> bool:
        """Whether every voxel of the known slices is labelled."""
        return bool(self.drawn.all())

    def fill(self, place: int | None, box: Box, law: LawLike | None = None, **more: Any) -> Segmentation:
        """Fill one label in a box, by its place, or all as one structure."""
        values, given, working = self.values[box], self.given, more.pop("working", self.working)
        inside = (values > 0 if place is None else values == place).astype(np.uint8)
        start, stop, _ = box[given.axis].indices(self.values.shape[given.axis])
        which: dict[str, Any] = {"known": [k - start for k in given.places if start <= k < stop]}
        if self.marked:
            inside[values < 0], which = UNKNOWN, {"ignore": UNKNOWN}
        mask = replace(given.volume, array=inside, affine=None, notes=())
        if law is None:
            working = replace(working, tile=None)  # a box of a label is filled at once
        return reconstruct(mask, law, axis=given.axis, periodic=self.periodic, working=working, **which, **more)


def _fill_instances(
    labels: _Labels, instances: bool | None, progress: Progress
) -> tuple[Segmentation | None, _Labels, tuple[str, ...]]:
    """Fill labels that are instances as one structure that the image tells, if there is one; return the structure, what
    the labels are filled from then, and notes."""
    image = labels.image
    if image is None or labels.full or labels.periodic:
        return None, labels, ()
    if instances is None:
        levels = labels.given.turn(image.values)[list(labels.given.places)]
        instances = are_instances(labels.drawn, levels, len(labels.numbers))
    if not instances:
        return None, labels, (*image.notes, APIECE)
    whole = labels.fill(None, WHOLE, image=replace(image, affine=None, notes=()), progress=progress)
    alone = replace(labels, image=None, working=replace(labels.working, filler=None))  # that one reads images
    shifted = [note for note in whole.notes if note.startswith(SHIFTED.partition("{")[0])]
    if UNTOLD in whole.notes:
        return None, alone, (*image.notes, *shifted, UNTOLD)
    return whole, alone, (*image.notes, ONCE, *shifted)


def _join_labels(
    labels: _Labels, parts: _Parts, whole: Segmentation | None, notes: Sequence[str], reasons: Sequence[str]
) -> Segmentation:
    """Return the result of labels that are filled one by one, or as parts of a whole."""
    known, image, numbers = labels.given, labels.image, labels.numbers
    volume, places = known.volume, list(known.places)
    length = volume.shape[known.axis]
    far = np.ones(known.turn(labels.values).shape, dtype=bool)
    far[slice(None) if labels.periodic or image is not None else filled_range(places, length)] = False
    values, likely, phase, odds = _join_parts(labels, parts, labels.full, known.turn_back(far))
    doubts = {number: part.uncertainty for number, (_, part) in zip(numbers, parts, strict=True)}
    dice = {number: doubt.expected_dice for number, doubt in doubts.items() if doubt is not None}
    if whole is not None:
        values, likely, expected = _split_instances(labels, parts, whole, values, odds)
        dice, phase, reasons = dict(zip(numbers, expected, strict=True)), whole.phase.values, whole.notes
    likely = np.where(labels.known, 1.0, likely).astype(np.float32)
    error = max(doubt.calibration_error for doubt in (whole and whole.uncertainty, *doubts.values()) if doubt)
    unsure = doubt(likely)
    entropies = tuple(unsure.sum(tuple({0, 1, 2} - {axis})) for axis in range(3))
    following = suggest_slices(entropies[known.axis], places, labels.suggest, labels.periodic)
    table = np.array([0, *numbers], volume.values.dtype if volume.values.dtype.kind in "iu" else np.int64)
    if (kind := smallest_type(table)).itemsize < 8:  # of 64 bits the given one
        table = table.astype(kind)
    uncertain = Uncertainty(
        replace(volume, array=likely, notes=()), error, following, min(dice.values()), dice, entropies=entropies
    )
    return Segmentation.of(
        volume, values != 0, np.maximum(phase, -1), None, max(part.epsilon for _, part in parts),
        (*known.notes, *notes, *reasons), weight=None, status=_describe_labels(parts, dice, whole, following),
        image=image, labels=replace(volume, array=table[values], notes=()), uncertainty=uncertain,
    )  # fmt: skip


_Parts = list[tuple[Box, Segmentation]]


def _fill_each(
    labels: _Labels, prior: LawLike | Mapping[int, LawLike] | None, progress: Progress
) -> tuple[_Parts, Sequence[str]]:
    """Fill each label in its box, or by the network alone where it is refused so; return boxes and labels, and
    notes."""
    parts, notes, count = [], dict[str, list[int]](), len(labels.numbers)
    image, example, store = labels.image, labels.example, labels.working.store
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(labels.numbers, prior)
    for place, number in enumerate(labels.numbers, 1):
        inside = (labels.values == place) & labels.known
        box = WHOLE if labels.periodic else _box_of_label(inside, labels)
        more = {
            "image": image and replace(image, array=image.values[box], affine=None, notes=()),
            "example": example and replace(example, array=(example.values == number).astype(np.uint8), notes=()),
            "working": replace(labels.working, store=store and Path(store) / str(number)),
        }
        step = sub_progress(progress, (place - 1) / count, place / count)
        try:
            part = labels.fill(place, box, laws.get(number), progress=step, **more)
        except ScanError as reason:
            part = labels.fill(place, box, progress=step, working=replace(labels.working, store=None))
            notes[f"Filled by the network alone: {reason}."] = [number]
        parts.append((box, part))
        for note in part.notes:
            notes.setdefault(note, []).append(number)
    named = {text: f"Label{'s' * (len(of) > 1)} {', '.join(map(str, of))}: {text}" for text, of in notes.items()}
    return parts, [text if len(notes[text]) == count else line for text, line in named.items()]


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
    inside, known = whole.probability.values, labels.given
    likely, dice = np.where(values, inside, 1 - inside), []
    between = np.zeros(values.shape[known.axis], dtype=bool)
    between[known.places[0] : known.places[-1]] = True
    between[list(known.places)] = False
    for number, (box, part) in enumerate(parts, 1):
        chances, voxels = inside[box] * _odds(part) / np.maximum(odds[box], SURE), values[box] == number
        likely[box] = np.where(voxels, chances, likely[box])
        chances, voxels = (known.turn(each)[between[box[known.axis]]] for each in (chances, voxels))
        dice.append(expected_dice(chances, voxels) if chances.size else 1.0)
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
    way = "filled:" if whole is None else f"filled as instances of one structure, {whole.status}; of labels,"
    return f"{len(parts)} labels {way} {median}{end}"


def _odds(part: Segmentation) -> np.ndarray:
    """Return the odds of the inside, finite."""
    likely = np.clip(part.mask.values if part.probability is None else part.probability.values, SURE, 1 - SURE)
    return likely / (1 - likely)


def find_labels(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: the chosen ones, or all but 0. Raises
    `ScanError` if the values are grey levels, a chosen label is missing, or there is none but 0."""
    if chosen is not None:
        chosen = sorted({check_int(n, "labels that are whole numbers", -SEEDS, IDS) for n in chosen})
        kept = require_labels(values, "the known slices", math.inf)  # of those that are not chosen any number
        values = np.where(index_labels(kept, chosen), kept, 0)
    present = [int(value) for value in np.unique(require_labels(values, "the known slices"))]
    numbers = [number for number in present if number] if chosen is None else chosen
    listed = ", ".join(map(str, present[:12])) + (", …" if len(present) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"labels must be other than 0, got {'0' if numbers else f'{listed} in the known slices'}")
    if missing := [number for number in numbers if number not in present]:
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
    labelled = np.where(known, labels, np.where(mask, labels[tuple(near)], 0))  # type: ignore[arg-type]
    pieces = np.asarray(measure.label(labelled, connectivity=3))
    owner, stays = np.zeros(pieces.max() + 1, dtype=labelled.dtype), np.zeros(pieces.max() + 1, dtype=bool)
    owner[pieces], stays[pieces[known]], stays[0] = labelled, True, True
    row = np.cumsum(~stays) - 1
    touched = np.zeros((np.count_nonzero(~stays), int(labels.max()) + 1), dtype=np.intp)
    for axis in range(3):
        moved = np.moveaxis(pieces, axis, 0)
        for here, there in ((moved[1:], moved[:-1]), (moved[:-1], moved[1:])):
            meet = ~stays[here] & stays[there] & (there > 0)
            np.add.at(touched, (row[here[meet]], owner[there[meet]]), 1)
    owner[~stays] = touched.argmax(1)  # that is 0 where nothing is touched
    return owner[pieces]
