"""A volume and its place in the world: values in z, y, x, in memory or read where they are asked for."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.core.pictures import Pictured
from curvafit.core.runtime import one_line
from curvafit.core.units import format_sampling, parse_unit
from curvafit.volumes.boxes import Box, Crop, parse_box, resolve_box
from curvafit.volumes.formats.base import ScanError, check_array

#: A note on the mask of a label.
_LABELLED = "The structure is label {}."


@dataclass(frozen=True, repr=False, eq=False)
class Volume(Pictured):
    """A volume and its place in the world: values with spacing, unit and affine.

    Raises ScanError where values are not a 3D array of real numbers or the spacing is not 3 positive numbers.

    Parameters
    ----------
    array
        Array (Z, Y, X), in the file's own type: NumPy's, or one that reads boxes of voxels where they are asked for
        (`StoredArray`).
    spacing
        Voxel edges along (z, y, x), in `unit`.
    unit
        `"voxel"` (unknown), `"nm"`, `"um"`, `"mm"` or `"m"`.
    affine
        4x4 map from voxel index (x, y, z, 1) to position in `unit`, NIfTI's convention; its columns are as long as
        the spacing. None where the file has none.
    source
        Where the volume came from: the path of its file.
    notes
        Sentences on what was assumed while reading.
    """

    array: Any
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = "voxel"
    affine: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        array = self.array if isinstance(self.array, StoredArray) else np.asarray(self.array)
        if len(array.shape) != 3:
            raise ScanError(f"a volume must be 3D, got an array of shape {array.shape}")
        if array.dtype.kind not in "biuf":
            raise ScanError(f"a volume must hold real numbers, got values of type {array.dtype}")
        spacing = positive_triple(self.spacing)
        unit, factor = parse_unit(self.unit)
        object.__setattr__(self, "array", array)
        object.__setattr__(self, "spacing", tuple(h * factor for h in spacing))
        object.__setattr__(self, "unit", unit)
        if self.affine is not None:
            affine = np.array(self.affine, dtype=np.float64)
            if affine.shape != (4, 4):
                raise ScanError(f"an affine must have the shape (4, 4), got {affine.shape}")
            affine[:3] *= factor
            object.__setattr__(self, "affine", affine)

    def __repr__(self) -> str:
        known = isinstance(self.array, np.ndarray) and self.array.size
        extent = f" from {self.values.min():.4g} to {self.values.max():.4g}" if known else ""
        source = f", from {self.source}" if self.source else ""
        size = format_sampling(self.shape, self.spacing, self.unit)
        return one_line(f"Volume({size}, {self.dtype}{extent}{source})")

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.array.shape

    @property
    def dtype(self) -> np.dtype:
        return self.array.dtype

    @property
    def values(self) -> np.ndarray:
        """All values (Z, Y, X); of a volume in a file they are read each time, see `load`."""
        if isinstance(self.array, np.ndarray):
            return self.array
        self.check_fits()
        return self.array[:, :, :]

    @property
    def in_file(self) -> bool:
        """Whether values are read where they are asked for."""
        return isinstance(self.array, StoredArray)

    @cached_property
    def digest(self) -> str:
        """A text that changes with the content, of a file with its size and time, and with the size of voxels."""
        content = digest_of(self.array) if isinstance(self.array, np.ndarray) else self.array.digest
        return f"{content}, {self.spacing} {self.unit}"

    def read(self, box: Box) -> np.ndarray:
        """Return the values of a box of voxels."""
        return self.array[box]

    def load(self) -> Volume:
        """Return the volume in memory; ScanError where that of a file does not fit, is not finite, or constant."""
        values, label = self.values, self.array.label if self.in_file else None
        if label is None and self.source:
            check_varies(values, self.source)
        elif label is not None and _LABELLED.format(label) in self.notes and (values.all() or not values.any()):
            replace(self, array=replace(self.array, label=None)).load().label(label)  # says which labels there are
        return replace(self, array=values) if self.in_file else self

    def check_fits(self) -> None:
        """Raise ScanError where all values do not fit into memory; of a label, those that it is looked for in."""
        kind = self.array.file.dtype if self.in_file else self.dtype
        check_array(self.shape, kind, self.source or "the volume")

    def crop(self, crop: Crop) -> Volume:
        """Return a box of voxels, whose affine says where the box lies in the volume.

        `crop` is `"z0:z1,y0:y1,x0:x1"` or three slices, counted as Python does: `":,10:,-64:"` is all of z, y from
        voxel 10 on and the last 64 of x. A crop that is no box, or leaves the volume, is a ScanError.
        """
        box = resolve_box(parse_box(crop), self.shape, self.source or "the volume")
        array = self.array.crop(box) if self.in_file else self.array[box]
        return replace(self, array=array).move_origin([edge.start for edge in box])

    def label(self, label: int) -> Volume:
        """Return the mask of the voxels with this value; none or all of them are a ScanError, once they are read."""
        label = check_int(label, "a label that is a whole number", -SEEDS, 2 * SEEDS - 1)
        notes = (*self.notes, _LABELLED.format(label))
        if self.in_file and self.array.label is None:
            return replace(self, array=replace(self.array, label=label), notes=notes)
        mask = is_label(self.values, label)
        if mask.all() or not mask.any():
            values = np.unique(self.values)
            listed = ", ".join(map(str, values[:12].tolist())) + (", …" if len(values) > 12 else "")
            fault = "is the only label" if mask.any() else "is no label"
            raise ScanError(f"label {label} {fault} of the scan, which has {listed}")
        return replace(self, array=mask, notes=notes)

    def move_origin(self, start: Sequence[float]) -> Volume:
        """Return the volume with its first voxel placed where its voxel `start` (z, y, x) is."""
        affine = np.diag([*self.spacing[::-1], 1.0]) if self.affine is None else self.affine.copy()
        affine[:3, 3] += affine[:3, :3] @ np.array(start[::-1], dtype=np.float64)
        ends = (f"{first}:{first + n}" for first, n in zip(start, self.shape, strict=True))
        return replace(self, affine=affine, notes=(*self.notes, f"Voxels {', '.join(ends)} (z, y, x) are used."))


@dataclass(frozen=True)
class StoredArray:
    """Three axes of an array in a file, read where boxes of them are asked for.

    `file` has `shape`, `dtype`, `file[index]` and a `digest`; `index` has a number or a slice for each of its axes, and
    `order` names those of z, y and x. With a `label` the array is a mask, of the voxels that have this value.
    """

    file: Any
    index: tuple[int | slice, ...]
    order: tuple[int, int, int]
    label: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        z, y, x = (edge.stop - edge.start for axis in self.order if isinstance(edge := self.index[axis], slice))
        return z, y, x

    @property
    def dtype(self) -> np.dtype:
        return self.file.dtype.newbyteorder("=") if self.label is None else np.dtype(np.bool_)

    @property
    def digest(self) -> str:
        """A text that changes with the content."""
        return f"{self.file.digest} {self.index} {self.order} {self.label}"

    def crop(self, box: Box) -> StoredArray:
        """Return a box of voxels."""
        index: list[int | slice] = list(self.index)
        for axis, edge, n in zip(self.order, box, self.shape, strict=True):
            first, last, _ = edge.indices(n)
            start = self.index[axis].start  # type: ignore[union-attr]
            index[axis] = slice(start + first, start + max(first, last))
        return replace(self, index=tuple(index))

    def __getitem__(self, box: Box) -> np.ndarray:
        values = np.asarray(self.file[self.crop(box).index])
        if self.label is not None:
            check_finite(values, "a volume with labels")
            values = is_label(values, self.label)
        turned = values.transpose([sorted(self.order).index(axis) for axis in self.order])
        return np.array(turned, self.dtype, order="C", copy=None if values.flags.owndata else True)  # not a mapped file


def check_varies(values: np.ndarray, place: object) -> None:
    """Raise ScanError where values are not finite, or all the same."""
    lowest, highest = check_finite(values, place)
    if lowest == highest:
        raise ScanError(f"every voxel of {place} is {lowest}: a volume must vary")


def check_finite(values: np.ndarray, place: object) -> tuple[float, float]:
    """Return the lowest and the highest value, or raise ScanError where one is not finite."""
    lowest, highest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if values.dtype.kind == "f" and not (math.isfinite(lowest) and math.isfinite(highest)):
        what = "NaN" if math.isnan(lowest) else "infinite"
        count = np.count_nonzero(np.isnan(values) if what == "NaN" else np.isinf(values))
        raise ScanError(f"a volume must be finite, got {count} values that are {what} in {place}")
    return lowest, highest


def digest_of(values: np.ndarray) -> str:
    """Return a text that differs between arrays: type, shape and a part of the SHA-256."""
    content = np.ascontiguousarray(values)
    return f"{content.dtype} {content.shape} {hashlib.sha256(content.view(np.uint8).data).hexdigest()[:16]}"


def is_label(values: np.ndarray, label: int) -> np.ndarray:
    """Return where values are a label, bool; floats within 1e-3 of it are."""
    return np.abs(values - label) <= 1e-3 if values.dtype.kind == "f" else values == label


def round_labels(values: np.ndarray) -> np.ndarray:
    """Return floats within 1e-3 of whole numbers, as resampled labels are, as whole ones; all else as it is."""
    whole = np.rint(values) if values.dtype.kind == "f" else values
    return whole if whole is values or np.allclose(values, whole, rtol=0, atol=1e-3) else values


def positive_triple(spacing: object) -> tuple[float, float, float]:
    """Return one or three positive numbers as three, or raise ScanError."""
    try:
        triple = (float(spacing),) * 3 if isinstance(spacing, (int, float)) else tuple(float(h) for h in spacing)  # type: ignore[union-attr]
    except (TypeError, ValueError, OverflowError):
        triple = ()
    if len(triple) != 3 or any(not math.isfinite(h) or h <= 0 for h in triple):
        raise ScanError(f"spacing must be 3 positive numbers (z, y, x), got {quoted(spacing)}")
    return triple  # type: ignore[return-value]
