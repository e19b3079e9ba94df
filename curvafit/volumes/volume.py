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
#: Voxels by which places may differ that are one.
ASTRAY = 0.1
#: Voxels by which a voxel that lies half way between two others is nearer to the first.
_TIE = 1e-3

# ---- boxes -----------------------------------------------------------------------------------------------------------

#: A box of voxels along (z, y, x).
Box = tuple[slice, slice, slice]
#: A box as a caller gives it: `"z0:z1,y0:y1,x0:x1"`, or three slices.
Crop = str | Sequence[slice]


def parse_box(crop: Crop) -> Box:
    """Return a crop as three slices."""
    parts: Any = list(map(_parse_slice, crop.split(","))) if isinstance(crop, str) else crop
    if not isinstance(parts, Sequence) or len(parts) != 3 or not all(map(_is_plain, parts)):
        raise ScanError(f'crop must be "z0:z1,y0:y1,x0:x1" or three slices, got {quoted(crop)}')
    return parts[0], parts[1], parts[2]


def resolve_box(box: Box, shape: Sequence[int], place: object) -> Box:
    """Return a box in a volume of a shape (z, y, x), with all its ends counted from the first voxel."""
    edges = []
    for name, edge, n in zip("zyx", box, shape, strict=True):
        start, stop = (0 if edge.start is None else edge.start), (n if edge.stop is None else edge.stop)
        first, last = (start + n if start < 0 else start), (stop + n if stop < 0 else stop)
        if not 0 <= first < last <= n:
            raise ScanError(f"crop must lie within 0:{n} along {name} of {place}, got {start}:{stop}")
        edges.append(slice(first, last))
    return edges[0], edges[1], edges[2]


def cut_boxes(shape: Sequence[int], edge: int | Sequence[int]) -> list[Box]:
    """Cut a volume into boxes of an edge, or of one along each axis, z slowest; the last ones may be smaller."""
    edges = (edge,) * 3 if isinstance(edge, int) else edge
    axes = ([slice(a, min(a + e, n)) for a in range(0, n, e)] for n, e in zip(shape, edges, strict=True))
    return [(z, y, x) for z, y, x in product(*axes)]


def grow(box: Box, by: int | Sequence[int], shape: Sequence[int]) -> Box:
    """Return a box with more voxels on every side, as far as the volume has them."""
    more = (by,) * 3 if isinstance(by, int) else by
    z, y, x = (slice(max(0, e.start - m), min(n, e.stop + m)) for e, m, n in zip(box, more, shape, strict=True))
    return z, y, x


def within(inner: Box, outer: Box) -> Box:
    """Return a box in the voxels of another."""
    z, y, x = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(inner, outer, strict=True))
    return z, y, x


def _parse_slice(text: str) -> slice | None:
    """Return the slice of a text such as `"3:7"`, `":7"` or `":"`, None for another text."""
    match = re.fullmatch(r"\s*(-?\d{1,18})?\s*:\s*(-?\d{1,18})?\s*", text)
    return slice(*(None if edge is None else int(edge) for edge in match.groups())) if match else None


def _is_plain(edge: Any) -> bool:
    """Return whether this is a slice that has whole numbers, or nothing, as ends, and no step."""
    if not isinstance(edge, slice) or edge.step not in (None, 1):
        return False
    ends = (edge.start, edge.stop)
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
            lowest, highest = check_finite(values, self.source)
            if lowest == highest:
                raise ScanError(f"every voxel of {self.source} is {lowest}: a volume must vary")
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


# ---- a volume on the voxels of another -------------------------------------------------------------------------------


def lay(field: Volume, on: Volume, name: str, kind: str, *, exact: bool = False) -> tuple[Volume, tuple[str, ...]]:
    """Return a volume on the voxels of another, and a note on how it was laid where the two differ.

    Where both state where they lie, the affines decide: axes change places and directions, and voxels move. On other
    voxels a value is that of the nearest one, and 0 beyond them; `exact` refuses both. Where one states no place, equal
    shapes are laid voxel by voxel. Messages call the volume `name`, and the other's voxels those of `kind`. Raises
    ScanError where the two do not meet, or have no place and other shapes.
    """
    step, note = _find_step(field, on), f"{name[0].upper()}{name[1:]} is laid on {kind}"
    if step is None:
        if field.shape != on.shape:
            raise ScanError(f"{name} must have the shape of {kind} {on.shape}, got {field.shape} without a place in it")
        neither = field.affine is None and on.affine is None
        both = field.affine is not None and on.affine is not None
        why = "their units do not convert" if both else "one of the two states no place"
        return field, () if neither else (f"{note} voxel by voxel: {why}.",)
    matrix, offset = step
    whole, moved = np.rint(matrix), np.rint(offset)
    corners = np.array(list(product(*((0, n - 1) for n in on.shape))))
    far = np.abs(corners @ (matrix - whole).T + offset - moved).max()
    on_voxels = far < ASTRAY and np.array_equal(whole @ whole.T, np.eye(3))
    if on_voxels and field.shape == on.shape and np.array_equal(whole, np.eye(3)) and not moved.any():
        return field, ()
    sampling = format_sampling(field.shape, field.spacing, field.unit)
    if exact and not on_voxels:
        raise ScanError(f"{name} must have the voxels of {kind}, got {sampling} that lie between them: resample it")
    laid, share = _take_nearest(field.values, *((whole, moved) if on_voxels else step), on.shape)
    if share == 0 or (exact and share < 1):
        what = f"{'shape and ' * exact}place of {kind}"
        raise ScanError(f"{name} must have the {what}, but by the affines covers {share:.0%} of it")
    note += f" by its affine: {'whole voxels are moved' if on_voxels else f'the nearest of its {sampling} counts'}"
    note += "" if share == 1 else f"; {1 - share:.2g} of {kind} lies beyond it, and counts as 0"
    return replace(field, array=laid, spacing=on.spacing, unit=on.unit, affine=on.affine), (f"{note}.",)


def _find_step(field: Volume, on: Volume) -> tuple[np.ndarray, np.ndarray] | None:
    """Return matrix and offset from voxels (z, y, x) of a volume to those of another, None where no place tells it.

    A length in voxels is one in any unit where the voxels are as long: a file may not name its unit.
    """
    if field.affine is None or on.affine is None or not np.linalg.det(field.affine[:3, :3]):
        return None
    factor = 1.0
    if field.unit != on.unit:
        if {field.unit, on.unit} <= METRES.keys():
            factor = METRES[on.unit] / METRES[field.unit]
        elif not np.allclose(sorted(field.spacing), sorted(on.spacing), rtol=1e-3):
            return None
    between = np.linalg.inv(field.affine) @ np.diag([factor] * 3 + [1.0]) @ on.affine
    return between[2::-1, 2::-1], between[2::-1, 3]  # affines are of x, y, z, arrays of z, y, x


def _take_nearest(
    values: np.ndarray, matrix: np.ndarray, offset: np.ndarray, shape: tuple[int, int, int]
) -> tuple[np.ndarray, float]:
    """Return the value nearest to each voxel of a shape, 0 beyond them, and the share of voxels that has one."""
    nearest, count = np.zeros(shape, values.dtype), 0
    y, x = np.ogrid[: shape[1], : shape[2]]
    for z, plane in enumerate(nearest):
        at = [
            np.floor(a * z + b * y + c * x + d + 0.5 - _TIE).astype(np.int64)
            for (a, b, c), d in zip(matrix, offset, strict=True)
        ]
        inside = np.logical_and.reduce([(k >= 0) & (k < n) for k, n in zip(at, values.shape, strict=True)])
        plane[inside] = values[tuple(k[inside] for k in at)]
        count += np.count_nonzero(inside)
    return nearest, count / nearest.size
