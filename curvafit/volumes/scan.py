"""Volume files to `Field` and back: values in z,y,x, with spacing, unit and affine."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curvafit.files import check_free, write_atomically
from curvafit.priors.bounds import quoted
from curvafit.volumes.formats import READERS, WRITERS, Raw, ScanError, normalise_unit, pick_writer
from curvafit.volumes.formats.guard import read_file
from curvafit.volumes.formats.ngff import is_ours, mark

__all__ = ["READABLE", "WRITABLE", "Field", "ScanError", "load", "read_values", "save"]

#: Suffixes that `load` and `save` know.
READABLE = tuple(READERS)
WRITABLE = tuple(WRITERS)


@dataclass(frozen=True)
class Field:
    """A volume and its place in the world.

    Parameters
    ----------
    values
        Array (Z, Y, X), in the file's own type.
    spacing
        Voxel edges along (z, y, x), in `unit`.
    unit
        `"voxel"` (unknown), `"nm"`, `"um"`, `"mm"` or `"m"`.
    affine
        4x4 map from voxel index (x, y, z, 1) to position in `unit`, NIfTI's convention; its columns are as long as
        the spacing. None where the file has none.
    source
        Where it came from.
    notes
        Sentences on what was assumed while reading.

    Raises
    ------
    ValueError
        If values are not a 3D array, spacing is not 3 positive numbers or the unit has no known name.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = "voxel"
    affine: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if np.ndim(self.values) != 3:
            raise ScanError(f"expected a 3D volume, got an array of shape {np.shape(self.values)}")
        spacing = _positive_triple(self.spacing)
        unit, factor = normalise_unit(self.unit)
        object.__setattr__(self, "values", np.asarray(self.values))
        object.__setattr__(self, "spacing", tuple(h * factor for h in spacing))
        object.__setattr__(self, "unit", unit)
        if self.affine is not None:
            affine = np.array(self.affine, dtype=np.float64)
            if affine.shape != (4, 4):
                raise ScanError(f"expected an affine of shape (4, 4), got {affine.shape}")
            affine[:3] *= factor
            object.__setattr__(self, "affine", affine)

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.values.shape  # type: ignore[return-value]


def load(
    path: str | os.PathLike[str],
    *,
    key: str | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    raw_shape: Sequence[int] | None = None,
    dtype: str | None = None,
    strict: bool = False,
) -> Field:
    """Read a volume from a file, or from a folder of slices.

    Parameters
    ----------
    path
        NIfTI, TIFF, NPY, NPZ, HDF5, RAW, Zarr; with `curvafit[io]` also NRRD, MHA/MHD, MRC and DICOM folders.
        `file.h5::key` names an array within a file; `key` does the same.
    spacing, unit
        Override what the file says: voxel edges (z, y, x), or one for all; nm, um, mm or m. A `unit` alone renames
        the file's numbers, it does not convert them.
    raw_shape, dtype
        Voxels (z, y, x) and numpy type of a RAW file, which cannot tell them.
    strict
        Refuse a volume of which parts are not stored, which a note tells of otherwise: chunks of Zarr or HDF5, which
        then have the fill value; slices that a folder's numbers skip.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ScanError
        A `ValueError`: unknown suffix, a damaged or truncated file, a missing key, a volume that is not 3D,
        not finite, constant or larger than memory, a spacing that is not positive.
    """
    location, key = _split_key(os.fspath(path), key)
    raw = _squeezed(read_file(location, key, raw_shape, dtype), location)
    if strict and raw.gaps:
        raise ScanError(f"expected a whole volume, got {location}: {raw.gaps[0]}")
    _check_values(raw.values, location)
    return _placed(raw, f"{location}::{key}" if key else str(location), spacing, unit)


def read_values(path: str | os.PathLike[str]) -> np.ndarray:
    """The array in a volume file, z first, whatever it holds; axes of one before the last three are left out.

    Parts that are not stored are a warning.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ScanError
        If the suffix is unknown or the file damaged.
    """
    raw = read_file(Path(path))
    values = raw.values
    for gap in raw.gaps:
        warnings.warn(f"{path}: {gap}", UserWarning, stacklevel=2)
    while values.ndim > 3 and values.shape[0] == 1:
        values = values[0]
    return values


def save(field: Field, path: str | os.PathLike[str], *, kind: str = "volume", overwrite: bool = False) -> Path:
    """Write a field as NIfTI, TIFF, NPY, MRC or Zarr, by suffix; a file of that name is replaced once the new one is
    whole, a folder only if it is empty or a Zarr store that `save` wrote with the same `kind` (or with `overwrite`).

    NIfTI keeps the affine (qform and sform) and the unit; TIFF (ImageJ's or OME's metadata), MRC (in Å) and Zarr
    (OME-NGFF 0.5, with halved copies of a large volume) spacing and unit; NPY the values only.

    Raises
    ------
    ScanError
        If the suffix is unknown, the format cannot hold the values' type, or it needs a unit and there is none.
    ValueError
        If another folder stands there.
    """
    target = Path(path)
    writer = pick_writer(target, field.unit)
    check_free([target], lambda there: not there.is_dir() or is_ours(there, kind), overwrite=overwrite)

    def write(temporary: Path) -> None:
        writer(field, temporary)
        if temporary.is_dir():
            mark(temporary, kind)

    return write_atomically(target, write)


def _split_key(path: str, key: str | None) -> tuple[Path, str | None]:
    if "::" in path and Path(path).exists():
        return Path(path), key
    name, separator, inner = path.rpartition("::")
    return (Path(name), key or inner or None) if separator else (Path(path), key)


def _squeezed(raw: Raw, path: Path) -> Raw:
    """Drop axes of length 1 beyond three, with their spacing."""
    values = raw.values
    if values.dtype.kind not in "biuf":
        raise ScanError(f"expected numbers, got values of type {values.dtype} in {path}")
    kept = [axis for axis, n in enumerate(values.shape) if n != 1]
    if len(kept) != 3:
        got = "no values" if values.size == 0 else f"{len(kept)}D of shape {tuple(values.shape)}"
        raise ScanError(f"expected a 3D volume, got {got} in {path}")
    spacing = raw.spacing
    if spacing is not None and len(spacing) == values.ndim:
        spacing = tuple(spacing[axis] for axis in kept)
    return raw._replace(values=values.reshape([values.shape[axis] for axis in kept]), spacing=spacing)


def _check_values(values: np.ndarray, path: Path) -> None:
    if values.size == 0:
        raise ScanError(f"expected a 3D volume, got no values (shape {values.shape}) in {path}")
    lowest, highest = values.min(), values.max()
    if values.dtype.kind == "f" and not (math.isfinite(lowest) and math.isfinite(highest)):
        what = "NaN" if math.isnan(lowest) else "infinite"
        count = np.count_nonzero(np.isnan(values) if what == "NaN" else np.isinf(values))
        raise ScanError(f"expected finite values, got {count} that are {what} in {path}")
    if lowest == highest:
        raise ScanError(f"expected a volume that varies, got {lowest} everywhere in {path}")


def _placed(raw: Raw, source: str, spacing: Sequence[float] | float | None, unit: str | None) -> Field:
    """Native values with the file's spacing and unit, or the caller's."""
    notes = [*raw.gaps, *raw.notes, *(() if spacing is not None or unit is not None else raw.guesses)]
    file_unit, factor = ("voxel", 1.0) if spacing is not None and unit is not None else normalise_unit(raw.unit)
    stated = None if raw.spacing is None else _scaled(raw.spacing, factor)
    affine = None if raw.affine is None else np.diag([factor, factor, factor, 1.0]) @ raw.affine
    chosen_unit, chosen_factor = (file_unit, 1.0) if unit is None else normalise_unit(unit)
    chosen = _positive_triple(1.0 if stated is None and spacing is None else stated if spacing is None else spacing)
    if stated is None and spacing is None:
        counted = "counted in voxels" if chosen_unit == "voxel" else f"those of voxels of 1 {chosen_unit}"
        notes.append(f"The file states no spacing: lengths are {counted}.")
    if affine is not None and stated != chosen:
        lengths = np.linalg.norm(affine[:3, :3], axis=0)
        affine[:3, :3] *= np.array(chosen)[::-1] / np.where(lengths > 0, lengths, 1)
    if unit is not None:
        chosen = (chosen[0] * chosen_factor, chosen[1] * chosen_factor, chosen[2] * chosen_factor)
        affine = None if affine is None else np.diag([chosen_factor] * 3 + [1.0]) @ affine
    values = np.ascontiguousarray(raw.values, dtype=raw.values.dtype.newbyteorder("="))
    return Field(values, chosen, chosen_unit, affine, source, tuple(notes))


def _scaled(spacing: tuple[object, ...], factor: float) -> tuple[object, ...]:
    """A file's spacing times a factor, as it stands where it is no numbers."""
    return tuple(h * factor if isinstance(h, (int, float)) else h for h in spacing)


def _positive_triple(spacing: object) -> tuple[float, float, float]:
    try:
        triple = (float(spacing),) * 3 if isinstance(spacing, (int, float)) else tuple(float(h) for h in spacing)  # type: ignore[union-attr]
    except (TypeError, ValueError, OverflowError):
        triple = ()
    if len(triple) != 3 or any(not math.isfinite(h) or h <= 0 for h in triple):
        raise ScanError(f"expected a spacing of 3 positive numbers (z, y, x), got {quoted(spacing)}")
    return triple  # type: ignore[return-value]
