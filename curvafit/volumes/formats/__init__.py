"""File formats, a module each; the suffix of a file chooses its reader and its writer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from curvafit.core.units import parse_unit
from curvafit.volumes.formats.arrays import read_hdf5, read_npy, read_npz, read_raw, write_npy
from curvafit.volumes.formats.base import Raw, ScanError
from curvafit.volumes.formats.medical import check_mrc, is_dicom, read_dicom, read_itk, read_mrc, read_nrrd, write_mrc
from curvafit.volumes.formats.ngff import read_zarr, write_zarr
from curvafit.volumes.formats.nifti import read_nifti, write_nifti
from curvafit.volumes.formats.tiff import SLICES, read_slices, read_tiff, write_ome_tiff, write_tiff

__all__ = [
    "KEYED",
    "READERS",
    "WRITERS",
    "Raw",
    "ScanError",
    "parse_unit",
    "pick_reader",
    "pick_writer",
]

#: Suffix -> reader(path, key=, raw_shape=, dtype=).
READERS: dict[str, Callable[..., Raw]] = {
    **dict.fromkeys((".nii", ".nii.gz"), read_nifti),
    **dict.fromkeys((".tif", ".tiff"), read_tiff),
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".h5", ".hdf5"), read_hdf5),
    **dict.fromkeys((".raw", ".bin", ".vol"), read_raw),
    ".zarr": read_zarr,
    ".nrrd": read_nrrd,
    ".nhdr": read_nrrd,
    ".mha": read_itk,
    ".mhd": read_itk,
    **dict.fromkeys((".mrc", ".map", ".rec"), read_mrc),
}

#: Readers of formats that can hold several arrays, by key.
KEYED = (read_npz, read_hdf5, read_zarr, read_dicom)

#: Suffix -> writer(field, path).
WRITERS: dict[str, Callable[[Any, Path], None]] = {
    ".nii": write_nifti,
    ".nii.gz": write_nifti,
    **dict.fromkeys((".ome.tif", ".ome.tiff"), write_ome_tiff),
    ".tif": write_tiff,
    ".tiff": write_tiff,
    ".npy": write_npy,
    ".mrc": write_mrc,
    **dict.fromkeys((".zarr", ".ome.zarr"), write_zarr),
}


def pick_reader(path: Path, shape_given: bool = False) -> Callable[..., Raw]:
    """Return the reader of a file by its suffix, or of a folder by its content.

    Raises
    ------
    ScanError
        If the suffix is unknown and the caller gives no shape of a RAW file, or the folder holds no slices.
    """
    if path.is_dir():
        return _pick_folder(path)
    for suffix in sorted(READERS, key=len, reverse=True):
        if path.name.lower().endswith(suffix):
            return READERS[suffix]
    if shape_given:
        return read_raw
    raise ScanError(f"expected a file ending in one of {', '.join(READERS)}, got {path.name!r}")


def pick_writer(path: Path, unit: str) -> Callable[[Any, Path], None]:
    """Return the writer of a file by its suffix, if the format can hold lengths in `unit`.

    Raises
    ------
    ScanError
        If the suffix is unknown, the format needs a unit and there is none, or its library is not installed.
    """
    suffix = next((known for known in WRITERS if path.name.lower().endswith(known)), None)
    if suffix is None:
        raise ScanError(f"expected a name ending in one of {', '.join(WRITERS)}, got {path.name!r}")
    if suffix == ".mrc":
        check_mrc(unit)
    return WRITERS[suffix]


def _pick_folder(path: Path) -> Callable[..., Raw]:
    inside = [p for p in path.iterdir() if not p.name.startswith(".")]
    if any(p.name in ("zarr.json", ".zarray", ".zgroup") for p in path.iterdir()) or path.suffix == ".zarr":
        return read_zarr
    if any(p.suffix.lower() in SLICES for p in inside):
        return read_slices
    if any(p.is_file() and is_dicom(p) for p in inside):
        return read_dicom
    raise ScanError(f"expected a folder of TIFF or DICOM slices or a Zarr store, got {path} with none")
