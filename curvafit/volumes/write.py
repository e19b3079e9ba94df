"""Writing of volumes: `save` chooses the format by the suffix."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.files import write_atomically
from curvafit.core.records import can_write, is_own_zarr
from curvafit.volumes.formats.arrays import write_npy
from curvafit.volumes.formats.base import ScanError, first_voxel, smallest_type
from curvafit.volumes.formats.headers import check_mrc, write_mrc
from curvafit.volumes.formats.nifti import write_nifti
from curvafit.volumes.formats.tiff import check_ome_tiff, write_ome_tiff, write_tiff
from curvafit.volumes.formats.zarr import mark, write_zarr
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Volume

#: Suffix -> writer(field, path).
WRITERS: dict[str, Callable[[Any, Path], None]] = {
    **dict.fromkeys((".nii", ".nii.gz"), write_nifti),
    **dict.fromkeys((".ome.tif", ".ome.tiff"), write_ome_tiff),
    **dict.fromkeys((".tif", ".tiff"), write_tiff),
    ".npy": write_npy,
    ".mrc": write_mrc,
    **dict.fromkeys((".zarr", ".ome.zarr"), write_zarr),
}


def save(
    source: Source,
    path: str | os.PathLike[str],
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    kind: str = "volume",
    overwrite: bool = False,
) -> Path:
    """Write a volume as NIfTI, TIFF, NPY, MRC or Zarr, by suffix.

    A file of that name is replaced once the new one is whole. A folder is replaced only if it is empty, if it is a Zarr
    store that `save` wrote with the same `kind`, or with `overwrite`.

    NIfTI keeps the affine (qform and sform) and the unit. TIFF (ImageJ's or OME's metadata), MRC (in Å) and Zarr
    (OME-Zarr 0.5, with halved copies of a large volume) keep spacing and unit; Zarr and MRC also keep the position of
    the first voxel, unless axes are rotated. NPY keeps the values only. `note_lost` says what is lost. TIFF stores
    64-bit integers in the smallest type that holds them, and float16 as float32.

    Raises ValueError if the suffix is unknown, the format cannot hold the values' type or needs a unit and the volume
    has none, the source is not a volume, another folder has that name, or the path is in a Zarr store.

    Parameters
    ----------
    source
        A `Volume`, an array or tensor (Z, Y, X), or the path of another volume file.
    spacing, unit
        Spacing and unit of an array, or in place of those of another file: see `load`.
    kind
        The mark of a Zarr store: what the store is for.
    overwrite
        Whether any other folder of that name may be replaced.
    """
    target = Path(path)
    lazy = is_streamed(target) and isinstance(source, Volume)  # of a path the values are read, and checked, first
    field = load(source, spacing=spacing, unit=unit, lazy=lazy)
    can_write(target, lambda existing: not existing.is_dir() or is_own_zarr(existing, kind), overwrite=overwrite)
    writer = pick_writer(target, field.unit, np.empty(0, field.dtype) if field.in_file else field.values)

    def write(temporary: Path) -> None:
        writer(field, temporary)
        if temporary.is_dir():
            mark(temporary, kind)

    return write_atomically(target, write)


def pick_writer(path: Path, unit: str, values: np.ndarray | None = None) -> Callable[[Any, Path], None]:
    """Return the writer for a path; raise ScanError if its format cannot hold lengths in `unit`, or `values`.

    To check before the work, pass an array of the values' type with only the smallest and the largest of them.
    """
    suffix = next((suffix for suffix in WRITERS if path.name.lower().endswith(suffix)), None)
    if suffix is None:
        raise ScanError(f"a volume's name must end in one of {', '.join(WRITERS)}, got {path.name!r}")
    if suffix == ".mrc":
        check_mrc(unit, values)
    if suffix.startswith(".ome.tif") and values is not None:
        check_ome_tiff(values)
    if values is not None and values.dtype.itemsize > 8 and suffix != ".npy":
        raise ScanError(f"{suffix} holds numbers of at most 64 bits, got {values.dtype}")
    return WRITERS[suffix]


def is_streamed(path: Path) -> bool:
    """Return whether a volume is written box by box, and need not fit into memory."""
    return path.name.lower().endswith(".zarr")


def note_lost(path: Path, volume: Volume) -> tuple[str, ...]:
    """Return a note on the parts of a volume's position and axes that the format of `path` does not hold, if any."""
    name, shifted = path.name.lower(), any(first_voxel(volume))  # which is 0 where axes are rotated
    unrotated = np.diag([*volume.spacing[::-1], 1.0])
    rotated = volume.affine is not None and not shifted and not np.allclose(volume.affine, unrotated, rtol=1e-5)
    if name.endswith(".npy"):
        lost = "voxel size and position in space" if volume.affine is not None or volume.unit != "voxel" else ""
    elif name.endswith((".tif", ".tiff")):
        lost = "the position in space" if rotated or shifted else ""
    else:
        lost = "turned axes and the position in space" if rotated and not name.endswith((".nii", ".nii.gz")) else ""
    return (f"{path.name} does not hold {lost}: NIfTI does.",) if lost else ()


def check_labels(path: str | Path, labels: Volume) -> None:
    """Raise ScanError, before the work, if a format cannot hold labels as large as these."""
    limits = np.array([labels.values.min(), labels.values.max()])
    pick_writer(Path(path), labels.unit, limits.astype(smallest_type(limits)))
