"""Reading of volumes: `load` for files, `field_of` for any source of a volume.

The suffix of a file chooses its reader. Any fault of a file becomes one sentence, and libraries print nothing.
"""

from __future__ import annotations

import inspect
import math
import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import quoted
from curvafit.core.runtime import one_line
from curvafit.core.units import is_unit, parse_unit
from curvafit.volumes.field import Field, positive_triple
from curvafit.volumes.formats.arrays import read_hdf5, read_imaris, read_npy, read_npz, read_raw
from curvafit.volumes.formats.base import Damaged, Raw, ScanError, check_regular, collect_complaints
from curvafit.volumes.formats.medical import is_dicom, read_dicom, read_metaimage, read_mrc, read_nrrd
from curvafit.volumes.formats.nifti import read_nifti
from curvafit.volumes.formats.part import Crop, Part, parse_box, take_part
from curvafit.volumes.formats.scanco import read_aim, read_isq
from curvafit.volumes.formats.tiff import SLICES, read_slices, read_tiff
from curvafit.volumes.formats.zarr import list_levels, read_zarr

#: A volume as a caller gives it.
Source = str | os.PathLike[str] | Field | np.ndarray | torch.Tensor

#: Suffix -> reader(path, key=, raw_shape=, dtype=).
READERS: dict[str, Callable[..., Raw]] = {
    **dict.fromkeys((".nii", ".nii.gz"), read_nifti),
    **dict.fromkeys((".tif", ".tiff"), read_tiff),
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".h5", ".hdf5"), read_hdf5),
    ".ims": read_imaris,
    **dict.fromkeys((".raw", ".bin", ".vol"), read_raw),
    ".zarr": read_zarr,
    **dict.fromkeys((".nrrd", ".nhdr"), read_nrrd),
    **dict.fromkeys((".mha", ".mhd"), read_metaimage),
    **dict.fromkeys((".mrc", ".map", ".rec"), read_mrc),
    ".isq": read_isq,
    ".aim": read_aim,
}

#: Readers of formats that can hold several arrays, by key.
KEYED = (read_npz, read_hdf5, read_imaris, read_zarr, read_dicom)


def load(
    path: str | os.PathLike[str],
    *,
    key: str | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    channel: int | None = None,
    time: int | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    raw_shape: Sequence[int] | None = None,
    dtype: str | None = None,
    strict: bool = False,
) -> Field:
    """Read a volume from a file, or from a folder of slices.

    Raises FileNotFoundError if there is no such file, and ScanError, which is a ValueError, if the suffix is unknown,
    the file is damaged or truncated, the key is missing, the volume is not 3D, not finite, constant or larger than
    memory, the spacing is not positive, or the file has no such channel, label or crop.

    Parameters
    ----------
    path
        NIfTI, TIFF, NPY, NPZ, HDF5, Imaris, RAW, Zarr, Scanco's ISQ and AIM; with `curvafit[io]` also NRRD, MHA/MHD,
        MRC and DICOM folders. `file.h5::key` names an array within a file; `key` does the same.
    spacing, unit
        Voxel edges (z, y, x), or one for all, and nm, um, mm or m, in place of what the file says. A `unit` alone
        renames the file's numbers; it does not convert them.
    channel, time
        The channel and the time to read, counted from 0, from a file of several. Colours and components of vectors are
        channels, and so are times in a file without channels.
    label
        The voxels that have this value, as a mask.
    crop
        A box of voxels, `"z0:z1,y0:y1,x0:x1"` or three slices; the affine says where the box lies. From Zarr, HDF5,
        Imaris, NPY, RAW, ISQ, AIM and uncompressed NIfTI only the box is read.
    raw_shape, dtype
        Voxels (z, y, x) and numpy type of a RAW file, which does not state them.
    strict
        Refuse a volume with parts that are not stored: chunks of Zarr or HDF5, which otherwise get the fill value, or
        slices that a folder's numbers skip. Without `strict` a note tells of such parts.
    """
    location, key = split_key(path, key)
    part = Part(channel, time, parse_box(crop))
    read = read_file(location, key, raw_shape, dtype, None if part == Part() else part)
    raw, start = take_part(read, part, location)
    if strict and raw.gaps:
        raise ScanError(f"{location} is not whole: {raw.gaps[0]}")
    if raw.values.size == 0:
        raise ScanError(f"a volume must be 3D, got no values (shape {raw.values.shape}) in {location}")
    lowest, highest = _check_finite(raw.values, location)
    if lowest == highest:
        raise ScanError(f"every voxel of {location} is {lowest}: a volume must vary")
    field = to_field(raw, f"{location}::{key}" if key else str(location), spacing, unit)
    field = field if part.crop is None else field.move_origin(start)
    return field if label is None else field.label(label)


def field_of(
    source: Source,
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    **reading: Any,
) -> Field:
    """Return the `Field` of any source of a volume.

    Raises ScanError if the source is none of these or an option does not apply to it, and what `load` raises.

    Parameters
    ----------
    source
        The path of a file, which is read; a `Field`, which is taken as it is; or an array or tensor (Z, Y, X).
    spacing, unit
        Voxel edges (z, y, x), or one for all, and their unit. For a file, they replace what the file says; for an array
        the default is one voxel. A `Field` has its own.
    label, crop
        The voxels of one value, as a mask; a box of voxels: see `Field.label` and `Field.crop`.
    reading
        Options of reading a file: see `load`.
    """
    check_reading(reading)
    if isinstance(source, str | os.PathLike):
        return load(source, spacing=spacing, unit=unit, label=label, crop=crop, **reading)
    if isinstance(source, Field):
        _refuse({"spacing": spacing, "unit": unit}, "a file or an array", "a Field, which has its own")
        _refuse(reading, "the path of a file", "a Field, which is read already")
        field = source
    elif isinstance(source, np.ndarray | torch.Tensor):
        _refuse(reading, "the path of a file", "an array")
        edges = positive_triple(1.0 if spacing is None else spacing)
        field = Field(_to_numpy(source), edges, "voxel" if unit is None else unit)
    else:
        raise ScanError(f"a volume must be the path of a file, a Field, an array or a tensor, got {quoted(source)}")
    field = field if crop is None else field.crop(crop)
    return field if label is None else field.label(label)


def check_reading(reading: Mapping[str, Any]) -> None:
    """Raise TypeError where an option of reading is none of `load`."""
    for name in reading.keys() - inspect.signature(load).parameters.keys():
        raise TypeError(f"got an unexpected keyword argument {name!r}: it is no option, and none of reading (load)")


def place_of(path: str | os.PathLike[str]) -> Field:
    """Return the field of a volume file for its spacing, unit and affine: the values are not checked."""
    location, key = split_key(path, None)
    raw, _ = take_part(read_file(location, key), Part(), location)
    return to_field(raw, str(location), None, None)


def read_values(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array in a volume file, z first, without axes of length one before the last three.

    Values are not checked; a warning tells of parts that are not stored.
    """
    raw = read_file(Path(path))
    values = raw.values
    for gap in raw.gaps:
        warnings.warn(f"{path}: {gap}", UserWarning, stacklevel=2)
    while values.ndim > 3 and values.shape[0] == 1:
        values = values[0]
    return values


def read_file(
    path: Path,
    key: str | None = None,
    raw_shape: Sequence[int] | None = None,
    dtype: str | None = None,
    part: Part | None = None,
) -> Raw:
    """Return the content of a file or a folder, or the part of it; what a library raises at damage is a ScanError."""
    if not path.exists():
        raise FileNotFoundError(one_line(f"no such file: {path}"))
    reader = pick_reader(check_regular(path), raw_shape is not None)
    if key is not None and reader not in KEYED:
        raise ScanError(f"a key applies to NPZ, HDF5, Imaris, Zarr and DICOM only, got {quoted(key)} for {path}")
    try:
        with collect_complaints():
            return reader(path, key=key, raw_shape=raw_shape, dtype=dtype, part=part)
    except (ScanError, ImportError):  # a library that is not installed says so itself
        raise
    except MemoryError as reason:
        raise ScanError(f"{path} does not fit into memory") from reason
    except Exception as reason:  # every library has its own way to say that a file is damaged
        kind = "" if isinstance(reason, Damaged | ValueError) else f"{type(reason).__name__}: "
        text = " ".join(f"{kind}{reason}"[:2000].split())[:200]
        raise ScanError(f"{path} cannot be read, it is damaged or something else ({text})") from reason


def pick_reader(path: Path, shape_given: bool = False) -> Callable[..., Raw]:
    """Return the reader of a file by its suffix, or of a folder by its content."""
    if path.is_dir():
        return _pick_folder(path)
    name = re.sub(r";\d+$", "", path.name.lower())  # VMS numbers the versions of a file: SCAN.AIM;1
    for suffix in sorted(READERS, key=len, reverse=True):
        if name.endswith(suffix):
            return READERS[suffix]
    if shape_given:
        return read_raw
    raise ScanError(f"a volume's name must end in one of {', '.join(READERS)}, got {path.name!r}")


def _refuse(options: dict[str, Any], expected: str, got: str) -> None:
    """Raise ScanError where an option would have no effect."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise ScanError(f"{name} applies to {expected} only, got it with {got}")


def _to_numpy(source: np.ndarray | torch.Tensor) -> np.ndarray:
    """Return an array or tensor as an array of real, finite numbers."""
    if isinstance(source, torch.Tensor):
        tensor = source.detach().cpu()
        source = (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()
    if source.dtype.kind not in "biuf":
        raise ScanError(f"a volume must hold real numbers, got an array of type {source.dtype}")
    if source.size:
        _check_finite(source, "an array")
    return source


def split_key(path: str | os.PathLike[str], key: str | None) -> tuple[Path, str | None]:
    """Return the file of a path, and the name of the array in the file, which the path may state after `::`."""
    path = os.fspath(path)
    name, separator, inner = path.rpartition("::")
    return (Path(path), key) if not separator or Path(path).exists() else (Path(name), key or inner or None)


def levels_of(source: object, key: str | None = None) -> dict[str, tuple[float, ...] | None]:
    """Return the spacing of each level of an OME-Zarr image by its key, the finest first; nothing of a named level."""
    if not isinstance(source, str | os.PathLike):
        return {}
    path, key = split_key(source, key)
    return list_levels(path, key) if path.is_dir() and pick_reader(path) is read_zarr else {}


def _check_finite(values: np.ndarray, place: object) -> tuple[float, float]:
    """Return the lowest and the highest value, or raise ScanError where one is not finite."""
    lowest, highest = values.min(), values.max()
    if values.dtype.kind == "f" and not (math.isfinite(lowest) and math.isfinite(highest)):
        what = "NaN" if math.isnan(lowest) else "infinite"
        count = np.count_nonzero(np.isnan(values) if what == "NaN" else np.isinf(values))
        raise ScanError(f"a volume must be finite, got {count} values that are {what} in {place}")
    return lowest, highest


def to_field(raw: Raw, source: str, spacing: Sequence[float] | float | None, unit: str | None) -> Field:
    """Return the values in native byte order, with the spacing and unit of the caller or, by default, of the file."""
    notes = [*raw.gaps, *raw.notes, *(() if spacing is not None or unit is not None else raw.guesses)]
    if unit is None and not is_unit(raw.unit):
        raise ScanError(f"{source} states lengths in {quoted(raw.unit)}, which is not known: give --spacing and --unit")
    unread = unit is not None and (spacing is not None or not is_unit(raw.unit))
    try:
        file_unit, factor = ("voxel", 1.0) if unread else parse_unit(raw.unit)
        name, renamed = (file_unit, 1.0) if unit is None else parse_unit(unit)
        stated = None if spacing is not None or raw.spacing is None else positive_triple(raw.spacing)
    except ValueError as reason:
        raise ScanError(f"{reason} for {source}") from None
    if spacing is not None:
        edges = np.array(positive_triple(spacing))
        # edges of which the finest is 1 are ratios, in voxels of that one
        if unit is None and name == "voxel" and edges.min() != 1:
            raise ScanError(f"expected the unit of the spacing {quoted(spacing)} of {source}, such as mm, got none")
    elif stated is not None:
        edges = factor * np.array(stated)
    else:
        edges = np.ones(3)
        counted = "counted in voxels" if name == "voxel" else f"those of voxels of 1 {name}"
        notes.append(f"The file states no spacing: lengths are {counted}.")
    affine = None if raw.affine is None else np.diag([factor] * 3 + [1.0]) @ raw.affine
    if affine is not None:
        if spacing is not None or raw.spacing is None:
            lengths = np.linalg.norm(affine[:3, :3], axis=0)
            affine[:3, :3] *= edges[::-1] / np.where(lengths > 0, lengths, 1)
        affine[:3] *= renamed
    values = np.ascontiguousarray(raw.values, dtype=raw.values.dtype.newbyteorder("="))
    return Field(values, tuple((renamed * edges).tolist()), name, affine, source, tuple(notes))


def _pick_folder(path: Path) -> Callable[..., Raw]:
    """Return the reader of a folder: of a Zarr store, or of TIFF or DICOM slices."""
    inside = [p for p in path.iterdir() if not p.name.startswith(".")]
    if any(p.name in ("zarr.json", ".zarray", ".zgroup") for p in path.iterdir()) or path.suffix == ".zarr":
        return read_zarr
    if any(p.suffix.lower() in SLICES for p in inside):
        return read_slices
    if any(p.is_file() and is_dicom(p) for p in inside):
        return read_dicom
    raise ScanError(f"the folder {path} holds neither TIFF or DICOM slices nor a Zarr store")
