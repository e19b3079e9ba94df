"""A volume of which boxes of voxels are read, so that no more of it is in memory than is worked on."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.arrays import read_hdf5, read_npy, read_raw
from curvafit.volumes.formats.base import check_array
from curvafit.volumes.formats.nifti import read_nifti
from curvafit.volumes.formats.part import Box, Crop, Part, cut_boxes, parse_box, resolve_box, take_part
from curvafit.volumes.formats.zarr import read_zarr
from curvafit.volumes.read import Source, check_reading, field_of, pick_reader, read_file, split_key, to_field

#: Readers that read a box alone.
_BY_BOX = (read_zarr, read_hdf5, read_npy, read_raw, read_nifti)
#: Voxels that `check_finite` reads at once.
_SLAB = 2**24
#: A sample has at most so many runs of neighbouring voxels along each axis, each so long.
RUNS, LONG = 4, 64


def boxes_of(
    source: Source | Boxes,
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    **reading: Any,
) -> Boxes:
    """Return the boxes of any source of a volume.

    From Zarr, HDF5, NPY, RAW and uncompressed NIfTI, boxes are read where they are asked for. Other sources are wholly
    in memory, in the file's type. Arguments and errors are those of `field_of`; boxes are returned as they are.
    """
    check_reading(reading)
    if isinstance(source, Boxes):
        return source
    options: dict[str, Any] = {"spacing": spacing, "unit": unit, "crop": crop, **reading}
    if label is None and isinstance(source, str | os.PathLike):
        path, key = split_key(source, reading.get("key"))
        box_wise = path.exists() and not path.name.lower().endswith(".gz")
        if box_wise and pick_reader(path, reading.get("raw_shape") is not None) in _BY_BOX:
            return _open_file(path, key, options)
    return InMemory(field_of(source, label=label, **options))  # type: ignore[arg-type]


def check_fits(boxes: Boxes) -> None:
    """Raise ScanError where the whole of a volume does not fit into memory."""
    check_array(boxes.frame.shape, boxes.frame.values.dtype, boxes.frame.source or "the volume")


def read_whole(boxes: Boxes) -> Field:
    """Return the volume in memory, in its own type."""
    z, y, x = (slice(0, n) for n in boxes.frame.shape)
    return replace(boxes.frame, values=boxes.part((z, y, x)))


def check_finite(boxes: Boxes) -> None:
    """Read all of a volume, some slices at once, and raise ScanError where values are not finite."""
    shape = boxes.frame.shape
    slabs = cut_boxes(shape, (max(1, _SLAB // max(1, shape[1] * shape[2])), *shape[1:]))
    if faults := sum(np.count_nonzero(~np.isfinite(boxes.part(slab))) for slab in slabs):
        raise ScanError(f"a volume must be finite, got {faults} values that are not")


def subsample(boxes: Boxes) -> tuple[Field, list[Box]]:
    """Return a sample of a volume, without an affine, and the boxes of the sample in which voxels are neighbours.

    Along an axis of more than `RUNS` x `LONG` voxels, the sample has `RUNS` runs of `LONG` voxels, from the middles of
    equal parts; along a shorter one it has all voxels.
    """
    runs = [_sample_runs(n) for n in boxes.frame.shape]
    # The runs, which are of one length along an axis, lie end to end in the sample.
    shape = [sum(run.stop - run.start for run in axis) for axis in runs]
    sample = np.empty(shape, boxes.frame.values.dtype)
    places = cut_boxes(shape, [axis[0].stop - axis[0].start for axis in runs])
    for place, (z, y, x) in zip(places, product(*runs), strict=True):
        sample[place] = boxes.part((z, y, x))
    return replace(boxes.frame, values=sample, affine=None), places


def _sample_runs(n: int) -> list[slice]:
    """Return the runs of a sample along an axis of n voxels."""
    if n <= RUNS * LONG:
        return [slice(0, n)]
    starts = [(2 * k + 1) * n // (2 * RUNS) - LONG // 2 for k in range(RUNS)]
    return [slice(start, start + LONG) for start in starts]


def digest_of(values: np.ndarray) -> str:
    """Return a text that differs between arrays: type, shape and a part of the SHA-256."""
    content = np.ascontiguousarray(values)
    return f"{content.dtype} {content.shape} {hashlib.sha256(content.view(np.uint8).data).hexdigest()[:16]}"


@dataclass(frozen=True)
class InMemory:
    """The boxes of a volume in memory."""

    field: Field

    @property
    def frame(self) -> Field:
        """The volume's shape and place, with zeros for values."""
        return _empty(self.field, self.field.shape)

    @cached_property
    def digest(self) -> str:
        """A text that changes with the content."""
        return digest_of(self.field.values)

    def part(self, box: Box) -> np.ndarray:
        """Return the values (Z, Y, X) of a box of voxels."""
        return self.field.values[box]


@dataclass(frozen=True, eq=False)
class InFile:
    """The boxes of a volume in a file, at its channel and time, from its first voxel in the file on."""

    frame: Field
    path: Path
    options: dict[str, Any]
    place: Part
    first: tuple[int, ...]

    @property
    def digest(self) -> str:
        """A text that changes with the content, without reading it: of a folder the total size and latest time."""
        files = [path for path in self.path.rglob("*") if path.is_file()] if self.path.is_dir() else [self.path]
        states = [path.stat() for path in files]
        size, time = sum(state.st_size for state in states), max(state.st_mtime_ns for state in states)
        return f"{self.path.resolve()} {self.place} {self.first} {self.options}: {size} bytes at {time}"

    def part(self, box: Box) -> np.ndarray:
        """Return the values (Z, Y, X) of a box of voxels."""
        z, y, x = (slice(edge.start + n, edge.stop + n) for edge, n in zip(box, self.first, strict=True))
        values = _read(self.path, self.options, replace(self.place, crop=(z, y, x)))[0].values
        return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))


#: A volume of which boxes are read.
Boxes = InMemory | InFile


def _empty(field: Field, shape: Sequence[int]) -> Field:
    """Return a volume of this shape at a field's place, with zeros that take no memory."""
    return replace(field, values=np.broadcast_to(np.zeros((), field.values.dtype), shape))


def _open_file(path: Path, key: str | None, options: dict[str, Any]) -> InFile:
    """Return the boxes of a file; the first voxel is read to know the volume's place."""
    reading = {"key": key, "raw_shape": options.get("raw_shape"), "dtype": options.get("dtype")}
    place = Part(options.get("channel"), options.get("time"))
    corner, shape = _read(path, reading, replace(place, crop=(slice(0, 1),) * 3))
    if options.get("strict") and corner.gaps:
        raise ScanError(f"{path} is not whole: {corner.gaps[0]}")
    box = resolve_box(parse_box(options["crop"]), shape, path)
    first, size = [edge.start for edge in box], [edge.stop - edge.start for edge in box]
    field = to_field(corner, f"{path}::{key}" if key else str(path), options["spacing"], options["unit"])
    frame = _empty(field, size)
    return InFile(frame if options["crop"] is None else frame.move_origin(first), path, reading, place, tuple(first))


def _read(path: Path, reading: dict[str, Any], part: Part) -> tuple[Any, tuple[int, ...]]:
    """Return a part of a file's content, with three axes, and the shape of the whole (z, y, x)."""
    raw = read_file(path, part=part, **reading)
    shape = raw.whole or raw.values.shape
    return take_part(raw, part, path)[0], tuple(shape[axis] for axis in part.index(shape, raw.axes, path)[1])
