"""A volume and its place in the world, values in z, y, x, in memory or read where asked for; boxes of its voxels."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from numbers import Integral
from typing import Any

import numpy as np

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.core.runtime import Pictured, one_line
from curvafit.core.units import METRES, format_sampling, parse_unit
from curvafit.volumes.formats.base import ScanError, check_array

#: A note on the mask of a label.
_LABELLED = "The structure is label {}."
#: Voxels by which two positions may differ and still count as the same.
ASTRAY = 0.1
#: Voxels subtracted from positions before they are rounded, so that all of those half way go to the lower voxel.
_TIE = 1e-3

# ---- boxes -----------------------------------------------------------------------------------------------------------

#: A box of voxels along (z, y, x).
Box = tuple[slice, slice, slice]
#: A box as a caller gives it: `"z0:z1,y0:y1,x0:x1"`, or three slices.
Crop = str | Sequence[slice]


def parse_box(crop: Crop) -> Box:
    """Return a crop as three slices."""
    slices: Any = list(map(_parse_slice, crop.split(","))) if isinstance(crop, str) else crop
    if not isinstance(slices, Sequence) or len(slices) != 3 or not all(map(_is_contiguous, slices)):
        raise ScanError(f'crop must be "z0:z1,y0:y1,x0:x1" or three slices, got {quoted(crop)}')
    return slices[0], slices[1], slices[2]


def resolve_box(box: Box, shape: Sequence[int], place: object) -> Box:
    """Return a box without open or negative ends; raise ScanError where it leaves a volume of a shape (z, y, x)."""
    spans = []
    for axis, span, n in zip("zyx", box, shape, strict=True):
        start, stop = (0 if span.start is None else span.start), (n if span.stop is None else span.stop)
        low, high = (start + n if start < 0 else start), (stop + n if stop < 0 else stop)
        if not 0 <= low < high <= n:
            raise ScanError(f"crop must lie within 0:{n} along {axis} of {place}, got {start}:{stop}")
        spans.append(slice(low, high))
    return spans[0], spans[1], spans[2]


def cut_boxes(shape: Sequence[int], edge: int | Sequence[int]) -> list[Box]:
    """Cut a volume into boxes of an edge, or of one along each axis, z slowest; the last ones may be smaller."""
    edges = (edge,) * 3 if isinstance(edge, int) else edge
    axes = ([slice(a, min(a + e, n)) for a in range(0, n, e)] for n, e in zip(shape, edges, strict=True))
    return [(z, y, x) for z, y, x in product(*axes)]


def grow(box: Box, by: int | Sequence[int], shape: Sequence[int]) -> Box:
    """Return a box with more voxels on every side, as far as the volume has them."""
    margins = (by,) * 3 if isinstance(by, int) else by
    z, y, x = (slice(max(0, a.start - m), min(n, a.stop + m)) for a, m, n in zip(box, margins, shape, strict=True))
    return z, y, x


def within(inner: Box, outer: Box) -> Box:
    """Return a box counted from the first voxel of another."""
    z, y, x = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(inner, outer, strict=True))
    return z, y, x


def _parse_slice(text: str) -> slice | None:
    """Return the slice of a text such as `"3:7"`, `":7"` or `":"`, None for another text."""
    match = re.fullmatch(r"\s*(-?\d{1,18})?\s*:\s*(-?\d{1,18})?\s*", text)
    return slice(*(None if edge is None else int(edge) for edge in match.groups())) if match else None


def _is_contiguous(value: Any) -> bool:
    """Return whether a value is a slice with whole numbers or None as ends, and no step."""
    if not isinstance(value, slice) or value.step not in (None, 1):
        return False
    ends = (value.start, value.stop)
    return all(end is None or (isinstance(end, Integral) and not isinstance(end, bool)) for end in ends)


# ---- volumes ---------------------------------------------------------------------------------------------------------


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
            place = self.source or "an array"
            raise ScanError(f"a volume must hold real numbers, got values of type {array.dtype} in {place}")
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
        in_memory = isinstance(self.array, np.ndarray) and self.array.size
        limits = f" from {self.values.min():.4g} to {self.values.max():.4g}" if in_memory else ""
        source = f", from {self.source}" if self.source else ""
        size = format_sampling(self.shape, self.spacing, self.unit)
        return one_line(f"Volume({size}, {self.dtype}{limits}{source})")

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
        """A text that changes with the values (in a file, with its size or time of change) and the voxel size."""
        content = digest_of(self.array) if isinstance(self.array, np.ndarray) else self.array.digest
        return f"{content}, {self.spacing} {self.unit}"

    def read(self, box: Box) -> np.ndarray:
        """Return the values of a box of voxels."""
        return self.array[box]

    def load(self) -> Volume:
        """Return the volume in memory; ScanError where that of a file does not fit, is not finite, or constant."""
        values = self.values
        label = self.array.label if self.in_file else None
        if label is None and self.source:
            lowest, highest = check_finite(values, self.source)
            if lowest == highest:
                raise ScanError(f"every voxel of {self.source} is {lowest}: a volume must vary")
        elif label is not None and _LABELLED.format(label) in self.notes and (values.all() or not values.any()):
            replace(self, array=replace(self.array, label=None)).load().label(label)  # its ScanError lists the labels
        return replace(self, array=values) if self.in_file else self

    def check_fits(self) -> None:
        """Raise ScanError where all values do not fit into memory, before a label's mask is made of them."""
        dtype = self.array.file.dtype if self.in_file else self.dtype
        check_array(self.shape, dtype, self.source or "the volume")

    def crop(self, crop: Crop) -> Volume:
        """Return a box of voxels, whose affine says where the box lies in the volume.

        `crop` is `"z0:z1,y0:y1,x0:x1"` or three slices, counted as Python does: `":,10:,-64:"` is all of z, y from
        voxel 10 on and the last 64 of x. A crop that is no box, or leaves the volume, is a ScanError.
        """
        box = resolve_box(parse_box(crop), self.shape, self.source or "the volume")
        array = self.array.crop(box) if self.in_file else self.array[box]
        return replace(self, array=array).move_origin([span.start for span in box])

    def label(self, label: int) -> Volume:
        """Return the mask of the voxels with this value; ScanError, once they are read, where none or all have it."""
        label = check_int(label, "a label that is a whole number", -SEEDS, 2 * SEEDS - 1)
        notes = (*self.notes, _LABELLED.format(label))
        if self.in_file and self.array.label is None:
            return replace(self, array=replace(self.array, label=label), notes=notes)
        mask = is_label(self.values, label)
        if mask.all() or not mask.any():
            labels = np.unique(self.values)
            listed = ", ".join(map(str, labels[:12].tolist())) + (", …" if len(labels) > 12 else "")
            fault = "is the only label" if mask.any() else "is no label"
            raise ScanError(f"label {label} {fault} of the scan, which has {listed}")
        return replace(self, array=mask, notes=notes)

    def move_origin(self, start: Sequence[float]) -> Volume:
        """Return the volume with its first voxel moved to the position of its voxel `start` (z, y, x)."""
        affine = np.diag([*self.spacing[::-1], 1.0]) if self.affine is None else self.affine.copy()
        affine[:3, 3] += affine[:3, :3] @ np.array(start[::-1], dtype=np.float64)
        ranges = (f"{low}:{low + n}" for low, n in zip(start, self.shape, strict=True))
        return replace(self, affine=affine, notes=(*self.notes, f"Voxels {', '.join(ranges)} (z, y, x) are used."))


@dataclass(frozen=True)
class StoredArray:
    """Three axes of an array in a file, read where boxes of them are asked for.

    `file` has `shape`, `dtype`, `file[index]` and a `digest`; `index` has a number or a slice for each axis of `file`,
    and `order` lists which of these axes are z, y and x. With a `label` the array is the mask of the voxels with it.
    """

    file: Any
    index: tuple[int | slice, ...]
    order: tuple[int, int, int]
    label: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        z, y, x = (span.stop - span.start for axis in self.order if isinstance(span := self.index[axis], slice))
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
        for axis, span, n in zip(self.order, box, self.shape, strict=True):
            low, high, _ = span.indices(n)
            start = self.index[axis].start  # type: ignore[union-attr]
            index[axis] = slice(start + low, start + max(low, high))
        return replace(self, index=tuple(index))

    def __getitem__(self, box: Box) -> np.ndarray:
        values = np.asarray(self.file[self.crop(box).index])
        if self.label is not None:
            check_finite(values, "a volume with labels")
            values = is_label(values, self.label)
        # The axes with a number in `index` are gone: those of `order` are counted without them.
        zyx = values.transpose([sorted(self.order).index(axis) for axis in self.order])
        return np.array(zyx, self.dtype, order="C", copy=None if values.flags.owndata else True)  # not a mapped file


def check_finite(values: np.ndarray, place: object) -> tuple[float, float]:
    """Return the lowest and the highest value, or raise ScanError where one is not finite."""
    lowest, highest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if values.dtype.kind == "f" and not (math.isfinite(lowest) and math.isfinite(highest)):
        fault = "NaN" if math.isnan(lowest) else "infinite"
        count = np.count_nonzero(np.isnan(values) if fault == "NaN" else np.isinf(values))
        raise ScanError(f"a volume must be finite, got {count} values that are {fault} in {place}")
    return lowest, highest


def digest_of(values: np.ndarray) -> str:
    """Return a text that differs between arrays: type, shape and a part of the SHA-256."""
    content = np.ascontiguousarray(values)
    return f"{content.dtype} {content.shape} {hashlib.sha256(content.view(np.uint8).data).hexdigest()[:16]}"


def is_label(values: np.ndarray, label: int) -> np.ndarray:
    """Return the mask of the values that equal a label; floats within 1e-3 of it count as equal."""
    return np.abs(values - label) <= 1e-3 if values.dtype.kind == "f" else values == label


def round_labels(values: np.ndarray) -> np.ndarray:
    """Round floats if all are within 1e-3 of whole numbers, as resampled labels are; return other values unchanged."""
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


# ---- a volume on the voxels of another -------------------------------------------------------------------------------


def lay(field: Volume, on: Volume, name: str, kind: str, *, exact: bool = False) -> tuple[Volume, tuple[str, ...]]:
    """Return a volume on the voxels of another, `on`, and a note on how it was resampled if it was.

    Where both have an affine, the affines decide: axes are permuted, flipped and shifted. If the voxels do not coincide
    each gets the value of the nearest one, and 0 outside the volume; `exact` refuses both. Where an affine is missing,
    volumes of equal shape are matched voxel by voxel. Messages call the volume `name`, and the other `kind`. Raises
    ScanError where the two do not overlap, or lack an affine and differ in shape.
    """
    mapping, note = _map_voxels(on, field), f"{name[0].upper()}{name[1:]} is laid on {kind}"
    if mapping is None:
        if field.shape != on.shape:
            raise ScanError(f"{name} must have the shape of {kind} {on.shape}, got {field.shape} without a place in it")
        neither = field.affine is None and on.affine is None
        both = field.affine is not None and on.affine is not None
        reason = "their units do not convert" if both else "one of the two states no place"
        return field, () if neither else (f"{note} voxel by voxel: {reason}.",)
    matrix, offset = mapping
    whole_matrix, whole_offset = np.rint(matrix), np.rint(offset)
    corners = np.array(list(product(*((0, n - 1) for n in on.shape))))  # rounding moves no voxel more than a corner
    error = np.abs(corners @ (matrix - whole_matrix).T + offset - whole_offset).max()
    on_voxels = error < ASTRAY and np.array_equal(whole_matrix @ whole_matrix.T, np.eye(3))
    if on_voxels and field.shape == on.shape and np.array_equal(whole_matrix, np.eye(3)) and not whole_offset.any():
        return field, ()
    sampling = format_sampling(field.shape, field.spacing, field.unit)
    if exact and not on_voxels:
        raise ScanError(f"{name} must have the voxels of {kind}, got {sampling} that lie between them: resample it")
    values, covered = _take_nearest(field.values, *((whole_matrix, whole_offset) if on_voxels else mapping), on.shape)
    if covered == 0 or (exact and covered < 1):
        expected = f"{'shape and ' * exact}place of {kind}"
        raise ScanError(f"{name} must have the {expected}, but by the affines covers {covered:.0%} of it")
    note += f" by its affine: {'whole voxels are moved' if on_voxels else f'the nearest of its {sampling} counts'}"
    note += "" if covered == 1 else f"; {1 - covered:.2g} of {kind} lies beyond it, and counts as 0"
    return replace(field, array=values, spacing=on.spacing, unit=on.unit, affine=on.affine), (f"{note}.",)


def _map_voxels(on: Volume, field: Volume) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the matrix (3, 3) and offset (3,) that map voxels (z, y, x) of `on` to those of `field`, None if unknown.

    Where one volume names no unit and their voxels are equally long in numbers, their units are taken for the same.
    """
    if field.affine is None or on.affine is None or not np.linalg.det(field.affine[:3, :3]):
        return None
    factor = 1.0
    if field.unit != on.unit:
        if {field.unit, on.unit} <= METRES.keys():
            factor = METRES[on.unit] / METRES[field.unit]
        elif not np.allclose(sorted(field.spacing), sorted(on.spacing), rtol=1e-3):
            return None
    mapping = np.linalg.inv(field.affine) @ np.diag([factor] * 3 + [1.0]) @ on.affine
    return mapping[2::-1, 2::-1], mapping[2::-1, 3]  # affines are of x, y, z, arrays of z, y, x


def _take_nearest(
    values: np.ndarray, matrix: np.ndarray, offset: np.ndarray, shape: tuple[int, int, int]
) -> tuple[np.ndarray, float]:
    """Return values at voxels of a shape, mapped by matrix and offset, 0 outside, and the fraction that is inside."""
    nearest, count = np.zeros(shape, values.dtype), 0
    y, x = np.ogrid[: shape[1], : shape[2]]
    for z, plane in enumerate(nearest):
        indices = [
            np.floor(a * z + b * y + c * x + d + 0.5 - _TIE).astype(np.int64)
            for (a, b, c), d in zip(matrix, offset, strict=True)
        ]
        inside = np.logical_and.reduce([(k >= 0) & (k < n) for k, n in zip(indices, values.shape, strict=True)])
        plane[inside] = values[tuple(k[inside] for k in indices)]
        count += np.count_nonzero(inside)
    return nearest, count / nearest.size
