"""NPY, NPZ, HDF5 and RAW."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from curvafit.formats.base import Raw, ScanError, pick_key, stated

_RAW_TYPES = "uint8, int8, uint16, int16, uint32, int32, float32, float64 (or with > for big-endian, as in >u2)"


def read_npy(path: Path, **_: object) -> Raw:
    return Raw(np.load(path, allow_pickle=False))


def write_npy(field: Any, path: Path) -> None:
    with path.open("wb") as stream:
        np.save(stream, field.values)


def read_npz(path: Path, *, key: str | None = None, **_: object) -> Raw:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return Raw(file[pick_key(list(file.files), key, path)])


def read_hdf5(path: Path, *, key: str | None = None, **_: object) -> Raw:
    """A dataset, with its attribute `element_size_um` or `spacing` and `unit` where it has one."""
    with h5py.File(path, "r") as file:
        keys: list[str] = []
        file.visititems(lambda name, item: keys.append(name) if isinstance(item, h5py.Dataset) else None)
        dataset: Any = file[pick_key(keys, key, path)]
        spacing, unit = stated(dict(dataset.attrs), dataset.ndim)
        return Raw(dataset[()], spacing, unit)


def read_raw(path: Path, *, raw_shape: Sequence[int] | None = None, dtype: str | None = None, **_: object) -> Raw:
    """Bare numbers, x fastest: shape and type come from the caller (a byte a voxel needs no type)."""
    if raw_shape is None:
        raise ScanError(f"expected --raw-shape Z,Y,X for the bare numbers in {path}, got none")
    shape = tuple(int(n) for n in raw_shape)
    size = path.stat().st_size
    if len(shape) != 3 or min(shape) < 1:
        raise ScanError(f"expected a raw shape of 3 positive whole numbers (z, y, x), got {tuple(raw_shape)}")
    if dtype is None and size != math.prod(shape):
        raise ScanError(f"expected --dtype for {path} ({size / math.prod(shape):.4g} bytes a voxel), got none")
    try:
        kind = np.dtype(dtype or "uint8")
    except TypeError:
        raise ScanError(f"expected a dtype such as {_RAW_TYPES}, got {dtype!r}") from None
    if size != math.prod(shape) * kind.itemsize:
        wanted = math.prod(shape) * kind.itemsize
        raise ScanError(f"expected {wanted} bytes for shape {shape} of {kind}, got {size} in {path}")
    return Raw(np.fromfile(path, dtype=kind).reshape(shape))
