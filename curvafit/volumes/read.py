"""Reading of volumes: `load` takes any source of one.

The suffix of a file chooses its reader. Any fault of a file becomes one sentence, and libraries print nothing.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import quoted
from curvafit.core.files import is_url
from curvafit.core.runtime import one_line
from curvafit.volumes.boxes import Crop, parse_box
from curvafit.volumes.formats import microscopes
from curvafit.volumes.formats.arrays import read_hdf5, read_imaris, read_npy, read_npz, read_raw
from curvafit.volumes.formats.base import Damaged, ScanError, Stated, check_array, check_regular, collect_complaints
from curvafit.volumes.formats.dicom import SUFFIXES, is_dicom, read_dicom
from curvafit.volumes.formats.mrc import read_mrc
from curvafit.volumes.formats.nifti import read_nifti
from curvafit.volumes.formats.nrrd import read_metaimage, read_nrrd
from curvafit.volumes.formats.scanco import read_aim, read_isq
from curvafit.volumes.formats.slices import SLICES, read_slices
from curvafit.volumes.formats.tiff import read_tiff
from curvafit.volumes.formats.zarr import list_levels, read_remote, read_zarr
from curvafit.volumes.stated import to_volume
from curvafit.volumes.volume import Volume, check_finite, positive_triple

#: A volume as a caller gives it.
Source = str | os.PathLike[str] | Volume | np.ndarray | torch.Tensor

#: Suffix -> reader(path, key=, raw_shape=, dtype=).
READERS: dict[str, Callable[..., Stated]] = {
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
    **dict.fromkeys(SUFFIXES, read_dicom),
    **dict.fromkeys(microscopes.SUFFIXES, microscopes.read_microscope),
    ".isq": read_isq,
    ".aim": read_aim,
}

#: Readers of formats that can hold several arrays, by key.
KEYED = (read_npz, read_hdf5, read_imaris, read_zarr, read_dicom, microscopes.read_microscope)


def load(
    source: Source,
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
    lazy: bool = False,
) -> Volume:
    """Return the volume of a file, of a folder of slices, or of an array.

    Raises FileNotFoundError if there is no such file, and ScanError, which is a ValueError, if the suffix is unknown,
    the file is damaged or truncated, the key is missing, the volume is not 3D, not finite, constant or larger than
    memory, the spacing is not positive, or the file has no such channel, label or crop; or if the source is none, or an
    option does not apply to it.

    Parameters
    ----------
    source
        A path; a `Volume`, which has its own spacing and unit; or an array or tensor (Z, Y, X). Files are NIfTI, TIFF,
        NPY, NPZ, HDF5, Imaris, RAW, Zarr, Scanco's ISQ and AIM; with `curvafit[io]` also NRRD, MHA/MHD, MRC and DICOM;
        with `curvafit[microscopes]` CZI, LIF and ND2; with `curvafit[remote]` the URL (https, s3) of a Zarr store.
        Folders hold slices as TIFF, BMP, PNG, JPEG or DICOM. `file.h5::key` names an array within a file; `key` does
        the same.
    spacing, unit
        Voxel edges (z, y, x), or one for all, and nm, um, mm or m, in place of what the file says; for an array the
        default is one voxel. A `unit` alone converts the lengths of a file that names their unit, and names that of
        others.
    channel, time
        The channel and the time to read, counted from 0, from a file of several. Colours and components of vectors are
        channels, and so are times in a file without channels.
    label
        The voxels that have this value, as a mask.
    crop
        A box of voxels, `"z0:z1,y0:y1,x0:x1"` or three slices; the affine says where the box lies. From Zarr, HDF5,
        Imaris, NPY, RAW, ISQ, AIM, MRC and uncompressed NIfTI only the box is read.
    raw_shape, dtype
        Voxels (z, y, x) and numpy type of a RAW file, which does not state them.
    strict
        Refuse a volume with parts that are not stored: chunks of Zarr or HDF5, which otherwise get the fill value, or
        slices that a folder's numbers skip. Without `strict` a note tells of such parts.
    lazy
        Read voxels where they are asked for, from the files of which only a box is read; values are not checked then.
    """
    placed: dict[str, Any] = {"spacing": spacing, "unit": unit}
    reading = {"key": key, "channel": channel, "time": time, "raw_shape": raw_shape, "dtype": dtype, "strict": strict}
    box = None if crop is None else parse_box(crop)
    if isinstance(source, str | os.PathLike):
        volume = _open(source, **placed, **reading)
    elif isinstance(source, Volume):
        _refuse(placed, "a file or an array", "a Volume, which has its own")
        _refuse(reading, "the path of a file", "a Volume, which is read already")
        volume = source
    elif isinstance(source, np.ndarray | torch.Tensor):
        _refuse(reading, "the path of a file", "an array")
        edges = positive_triple(1.0 if spacing is None else spacing)
        volume = Volume(_to_numpy(source), edges, "voxel" if unit is None else unit)
    else:
        raise ScanError(f"a volume must be the path of a file, a Volume, an array or a tensor, got {quoted(source)}")
    volume = volume if box is None else volume.crop(box)
    if not lazy and (volume.in_file or isinstance(source, str | os.PathLike)):
        volume = volume.load()
    return volume if label is None else volume.label(label)


def _open(
    path: str | os.PathLike[str],
    key: str | None,
    raw_shape: Sequence[int] | None,
    dtype: str | None,
    strict: bool,
    **options: Any,
) -> Volume:
    """Return the volume of a file, whose values are read where they are asked for where the format has them so."""
    location, key = split_key(path, key)
    how = {"key": key, "raw_shape": raw_shape, "dtype": dtype}
    stated = read_file(location, **how)  # type: ignore[arg-type]
    if strict and stated.gaps:
        raise ScanError(f"{location} is not whole: {stated.gaps[0]}")
    if not isinstance(stated.array, np.ndarray) or isinstance(stated.array, np.memmap):
        stated = stated._replace(array=FileArray(location, how, stated.array))
    return to_volume(stated, f"{location}::{key}" if key else str(location), **options)


class FileArray:
    """The array of a file, which each process opens for itself."""

    def __init__(self, path: Path | str, how: Mapping[str, Any], array: Any) -> None:
        self.path, self.how, self.shape, self.dtype, self._array = path, how, tuple(array.shape), array.dtype, array

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_array": None}

    def __getitem__(self, index: Any) -> np.ndarray:
        # A mapped file that became shorter would end the process: what is mapped is opened, and checked, each time.
        if self._array is None or isinstance(getattr(self._array, "array", self._array), np.memmap):
            self._array = read_file(self.path, **self.how).array
        with _name_damage(self.path):
            return np.asarray(self._array[index])

    @property
    def digest(self) -> str:
        """A text that changes with the content, without reading it: of a folder the total size and latest time."""
        if isinstance(self.path, str):
            return f"{self.path} {self.how}"
        files = [path for path in self.path.rglob("*") if path.is_file()] if self.path.is_dir() else [self.path]
        states = [path.stat() for path in files]
        size, time = sum(state.st_size for state in states), max(state.st_mtime_ns for state in states)
        return f"{self.path.resolve()} {self.how}: {size} bytes at {time}"


def read_values(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array in a volume file, z first, without axes of length one before the last three.

    Values are not checked; a warning tells of parts that are not stored.
    """
    stated = read_file(Path(path))
    for gap in stated.gaps:
        warnings.warn(f"{path}: {gap}", UserWarning, stacklevel=2)
    check_array(stated.array.shape, stated.array.dtype, path)
    with _name_damage(Path(path)):
        values = np.asarray(stated.array[...])
    while values.ndim > 3 and values.shape[0] == 1:
        values = values[0]
    return values


def read_file(
    path: Path | str, key: str | None = None, raw_shape: Sequence[int] | None = None, dtype: str | None = None
) -> Stated:
    """Return what a file, a folder, or a store of an address states; what a library raises at damage is a ScanError."""
    if isinstance(path, str):
        with _name_damage(path):
            return read_remote(path, key)
    if not path.exists():
        raise FileNotFoundError(one_line(f"no such file: {path}"))
    reader = pick_reader(check_regular(path), raw_shape is not None)
    if key is not None and reader not in KEYED:
        raise ScanError(
            f"a key applies to NPZ, HDF5, Imaris, Zarr, DICOM, CZI, LIF and ND2 only, got {quoted(key)} for {path}"
        )
    with _name_damage(path):
        return reader(path, key=key, raw_shape=raw_shape, dtype=dtype)


@contextmanager
def _name_damage(path: Path | str) -> Iterator[None]:
    """Turn what a library raises at damage into a ScanError that names the file, and keep what it prints."""
    try:
        with collect_complaints():
            yield
    except (ScanError, ImportError):  # a library that is not installed says so itself
        raise
    except MemoryError as reason:
        raise ScanError(f"{path} does not fit into memory") from reason
    except Exception as reason:  # every library has its own way to say that a file is damaged
        kind = "" if isinstance(reason, Damaged | ValueError) else f"{type(reason).__name__}: "
        text = " ".join(f"{kind}{reason}"[:2000].split())[:200]
        raise ScanError(f"{path} cannot be read, it is damaged or something else ({text})") from reason


def pick_reader(path: Path, shape_given: bool = False) -> Callable[..., Stated]:
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
        check_finite(source, "an array")
    return source


def split_key(path: str | os.PathLike[str], key: str | None) -> tuple[Path | str, str | None]:
    """Return the file of a path, and the name of the array in the file, which the path may state after `::`; of a store
    that is not on this machine its address."""
    path = os.fspath(path)
    name, separator, inner = path.rpartition("::")
    if not separator or Path(path).exists():
        name, inner = path, None
    return (name if is_url(name) else Path(name)), key or inner or None


def levels_of(source: object, key: str | None = None) -> dict[str, tuple[float, ...] | None]:
    """Return the spacing of each level of an OME-Zarr image by its key, the finest first; nothing of a named level."""
    if not isinstance(source, str | os.PathLike):
        return {}
    path, key = split_key(source, key)
    return list_levels(path, key) if isinstance(path, Path) and path.is_dir() and pick_reader(path) is read_zarr else {}


def _pick_folder(path: Path) -> Callable[..., Stated]:
    """Return the reader of a folder: of a Zarr store, or of slices, as images or DICOM."""
    inside = [p for p in path.iterdir() if not p.name.startswith(".")]
    if any(p.name in ("zarr.json", ".zarray", ".zgroup") for p in path.iterdir()) or path.suffix == ".zarr":
        return read_zarr
    if any(p.suffix.lower() in SLICES for p in inside):
        return read_slices
    if any(p.is_file() and is_dicom(p) for p in inside):
        return read_dicom
    raise ScanError(f"the folder {path} holds neither slices (TIFF, BMP, PNG, JPEG, DICOM) nor a Zarr store")
