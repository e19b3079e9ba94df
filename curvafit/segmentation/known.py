"""Which slices of a volume of labels are known; reading them slab by slab; notes and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from curvafit.core.checks import SEEDS, check_int
from curvafit.priors.grid import MOST
from curvafit.segmentation.slices import IDS, LABELS, Slices, axis_first, require_labels
from curvafit.volumes.formats.zarr import CHUNK
from curvafit.volumes.run import Record, Run
from curvafit.volumes.volume import Box, ScanError, Volume, check_finite, cut_boxes, round_labels

#: Slices of a file that are read at once, and their bytes at most.
THICK, SLAB = CHUNK, 2**26
#: Fraction of the slices with labels, between a label's first and last, that may lack it if all count as known.
APART = 1 / 3


@dataclass(frozen=True, eq=False)
class Known:
    """A volume of labels and which of its slices across `axis` are known: their indices `places`, ascending, `marks` of
    known voxels in the others, as in `Slices`, and notes."""

    volume: Volume
    axis: int
    places: tuple[int, ...] = ()
    marks: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def find(
        cls, volume: Volume, run: Run, *, every: int | slice | None = None, known: Sequence[int] | None = None,
        ignore: int | None = None, axis: int = 0,
    ) -> Known:  # fmt: skip
        """Find which slices of a volume are known by the options of `reconstruct`; `ignore` needs it in memory."""
        whole = cls(volume, axis)
        if ignore is not None:
            ignore = check_int(ignore, "a label to ignore", -SEEDS, IDS)
            places, marks = annotated_slices(whole.turn(volume.values), ignore)
            return replace(whole, places=tuple(places), marks=marks)
        if every is None and known is None:
            labelled = whole._find_labelled(run)
            places = choose_labelled(labelled)
            return replace(whole, places=tuple(places), notes=note_labelled(places, labelled))
        return replace(whole, places=tuple(known_places(volume.shape[whole.axis], every, known)))

    def read(self, run: Run, name: str = "the known slices") -> tuple[Slices, np.ndarray]:
        """Read the known slices into the run's store; return them and their labels. Raises `ScanError` if they hold
        grey levels, or are all empty or all full; the message calls them `name`."""
        length, *plane = axis_first(self.volume.shape, self.axis)
        inside = run.open("known", np.bool_, (len(self.places), *plane))

        def keep(_: int, record: Record) -> Record:
            rows = record["which"]
            if len(rows):
                inside[rows[0] : rows[-1] + 1] = record["inside"]
            return {"values": record["values"], "count": np.count_nonzero(record["inside"])}

        records = run("reading known slices", partial(_read_slab, self, name), len(self._slabs), keep=keep)
        labels = np.unique(np.concatenate([record["values"] for record in records]))
        if len(labels) > LABELS:
            raise ScanError(f"{name} must be a mask or have at most {LABELS} labels, got {len(labels)} values")
        count = sum(int(record["count"]) for record in records)
        self._check_label(count > 0)
        if count in (0, len(self.places) * plane[0] * plane[1]):
            raise ScanError(
                f"{name} must have voxels inside and outside, but all are {'full' if count else 'empty'}; is another "
                "slice the first, is there a label that nobody annotated, or are there several labels?"
            )
        edges = axis_first(self.volume.spacing, self.axis)
        return Slices(inside.stored, self.places, length, edges, self.volume.unit, self.marks), labels

    def turn(self, values: np.ndarray) -> np.ndarray:
        """Move the axis across the slices to the front."""
        return np.moveaxis(values, self.axis, 0)

    def turn_back(self, values: np.ndarray) -> np.ndarray:
        """Move the axis across the slices from the front to its place."""
        return np.ascontiguousarray(np.moveaxis(values, 0, self.axis))

    def turn_box(self, box: Box) -> Box:
        """Move the first edge of a box, which is across the slices, to its place."""
        edges = list(box)
        edges.insert(self.axis, edges.pop(0))
        return edges[0], edges[1], edges[2]

    @property
    def _slabs(self) -> list[Box]:
        """The boxes of slices that are read at once: of a volume in memory all."""
        shape = length, *plane = axis_first(self.volume.shape, self.axis)
        thickness = length
        if self.volume.in_file:
            thickness = min(THICK, max(1, SLAB // (plane[0] * plane[1] * self.volume.array.file.dtype.itemsize)))
        return cut_boxes(shape, (thickness, *plane))

    def _find_labelled(self, run: Run) -> np.ndarray:
        """Return whether each slice has labels, bool (length,)."""
        records = run("looking for labels", partial(_read_slab, self, ""), len(self._slabs))
        labelled = np.concatenate([record["there"] for record in records])
        self._check_label(bool(labelled.any()))
        return labelled

    def _check_label(self, present: bool) -> None:
        """Raise ScanError where the label that was to be read from a file is not present."""
        if not present and self.volume.in_file and self.volume.array.label is not None:
            raise ScanError(f"label {self.volume.array.label} is in none of the known slices")


def _read_slab(known: Known, name: str, number: int) -> Record:
    """Return the record of a slab: whether each slice has labels (`there`), which of the known slices it holds
    (`which`), their masks (`inside`), and the different labels in them (`values`)."""
    volume, box = known.volume, known._slabs[number]
    slab, values = box[0], volume.read(known.turn_box(box))
    if volume.in_file:
        check_finite(values, volume.source)
    values = known.turn(round_labels(values))
    labelled = (values > 0).any((1, 2))
    rows = np.array([k for k, place in enumerate(known.places) if slab.start <= place < slab.stop], dtype=np.intp)
    if not len(rows):
        return {"there": labelled, "which": rows, "inside": np.empty(0, dtype=bool), "values": values[:0, 0, 0]}
    values = require_labels(values[[known.places[k] - slab.start for k in rows]], name)
    return {"there": labelled, "which": rows, "inside": values > 0, "values": np.unique(values)}


def check_which(
    shape: Sequence[int], every: int | slice | None = None, known: Sequence[int] | None = None,
    ignore: int | None = None, axis: int = 0, *, suggest: int,
) -> None:  # fmt: skip
    """Raise ValueError where options of `reconstruct` do not fit the volume's shape, or each other."""
    length = shape[check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)]
    if ignore is not None and (every is not None or known is not None):
        raise ScanError("give either every, known or ignore")
    places = [] if every is None and known is None else known_places(length, every, known)
    check_int(suggest, "a number of slices from 0", 0, length - len(places))


# ---- which slices ----------------------------------------------------------------------------------------------------


def known_places(length: int, every: int | slice | None, known: Sequence[int] | None) -> list[int]:
    """Return the indices of the known slices, ascending: every `every`-th, and those listed in `known`. Raises
    `ValueError` if they are not two or more slices of the volume."""
    known = [*(known or ())]
    if every is not None:
        first, step = (every.start or 0, every.step or 1) if isinstance(every, slice) else (0, every)
        step = check_int(step, "every, a whole number from 1", 1, MOST)
        known += range(check_int(first, "first, a whole number from 0", 0, MOST), length, step)
    form = f"known slices that are whole numbers from 0 to {length - 1}"
    places = sorted({check_int(number, form, 0, length - 1) for number in known})
    if len(places) < 2:
        raise ScanError(f"two or more slices within 0 to {length - 1} must be known, got {places}")
    return places


def choose_labelled(labelled: np.ndarray) -> list[int]:
    """Return the indices of the known slices, given whether each slice has labels, bool (Z,): those with labels, and
    empty ones next to them in their rhythm (`next_in_rhythm`)."""
    places = np.flatnonzero(labelled)
    if len(places) < 2:
        raise ScanError(f"two or more slices must have labels, got {len(places)}; or give every or known")
    if np.diff(places).max() == 1:
        raise ScanError(
            "no slice without labels lies between those with labels: give every or known, which slices count; slices "
            "that nobody annotated must be there too, empty"
        )
    return sorted([*places.tolist(), *next_in_rhythm(places, len(labelled))])


def next_in_rhythm(places: Sequence[int] | np.ndarray, length: int) -> list[int]:
    """Return the slices one step before the first and beyond the last of those with labels, if these are three or more
    at a constant step: they are taken for annotated and empty."""
    steps = set(np.diff(places).tolist())
    if len(places) < 3 or len(steps) > 1:
        return []
    step = steps.pop()
    return [k for k in (int(places[0]) - step, int(places[-1]) + step) if 0 <= k < length]


def annotated_slices(values: np.ndarray, ignore: int) -> tuple[list[int], np.ndarray | None]:
    """Return the indices of the slices (Z, Y, X) that are annotated whole, and marks of the others, as in `Slices`.
    `ignore` is the label of voxels that nobody annotated; 0 is known to be empty."""
    annotated = values != ignore
    if annotated.all():
        raise ScanError(f"no voxel has the label {ignore}, which tells what nobody annotated")
    whole = annotated.all((1, 2))
    places = np.flatnonzero(whole).tolist()
    if len(places) < 2:
        raise ScanError(f"two or more slices must have no voxel of the label {ignore}, got {places}")
    annotated[whole] = False  # marks are of the other slices
    if not annotated.any():
        return places, None
    return places, np.where(annotated, np.where(values > 0, 1, -1), 0).astype(np.int8)


def check_shared(values: np.ndarray, places: Sequence[int], labels: Sequence[int]) -> None:
    """Raise ScanError where each label has annotated slices (Z, Y, X) of its own, so that it may be in the others."""
    for label in labels:
        present = (values[list(places)] == label).any((1, 2))
        span = present[present.argmax() : len(present) - present[::-1].argmax()]
        if (missing := np.count_nonzero(~span)) > APART * len(span):
            some = f"label {label} is on {len(span) - missing} of the {len(span)} slices with labels that it spans"
            raise ScanError(
                f"{some}: fill labels that have slices of their own one after the other, or name known slices"
            )


def note_labelled(places: Sequence[int], labelled: np.ndarray) -> tuple[str, ...]:
    """Return notes on the known slices at `places`: those with labels, and empty ones in their rhythm."""
    with_labels, empty = [k for k in places if labelled[k]], [k for k in places if not labelled[k]]
    known = f"The {len(with_labels)} slices with labels are known: {list_numbers(with_labels, 24)}."
    notes = (f"{known} Another one that is rightly empty must be named.",)
    taken = f"Taken for rightly empty, as next in the rhythm of those with labels: {list_numbers(empty)}."
    return (*notes, f"{taken} If that is wrong, name the known slices.") if empty else notes


def doubt_labels(values: np.ndarray, ignore: int | None = None) -> tuple[str, ...]:
    """Return a note where known slices have several labels, given their different values."""
    count = np.count_nonzero((values > 0) & (values != ignore))
    advice = "reconstruct_labels, or --labels all, fills each by itself"
    return (f"The known slices have {count} labels, which are filled as one structure: {advice}.",) if count > 1 else ()


def list_numbers(numbers: Sequence[int], most: int = 4) -> str:
    """Return the first of some numbers as a list."""
    return ", ".join(map(str, numbers[:most])) + (", …" if len(numbers) > most else "")
