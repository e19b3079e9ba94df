"""NPY, NPZ, HDF5, RAW and Zarr."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr

from curvafit.formats.base import Raw, ScanError, pick_key

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
        spacing, unit = _stated(dict(dataset.attrs), dataset.ndim)
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


def read_zarr(path: Path, *, key: str | None = None, **_: object) -> Raw:
    """An array, or one of a group; spacing and unit from its attributes or from OME-Zarr's multiscales."""
    node: Any = zarr.open(path, mode="r")
    if isinstance(node, zarr.Array):
        spacing, unit = _stated(node.attrs.asdict(), node.ndim)
        return Raw(np.asarray(node[...]), spacing, unit)
    arrays = _zarr_arrays(node)
    attributes = node.attrs.asdict()
    scales = _multiscales(attributes)
    if key is None and scales:
        key = next(iter(scales))
    name = pick_key(sorted(arrays), key, path)
    array = arrays[name]
    spacing, unit = scales.get(name) or _stated({**attributes, **array.attrs.asdict()}, array.ndim)
    return Raw(np.asarray(array[...]), spacing, unit)


def write_zarr(field: Any, path: Path) -> None:
    chunks = tuple(min(64, n) for n in field.values.shape)
    array = zarr.create_array(path, shape=field.values.shape, chunks=chunks, dtype=field.values.dtype)
    array[...] = field.values
    array.attrs.update({"spacing": list(field.spacing), "unit": field.unit, "axes": "zyx"})


def _zarr_arrays(group: Any, prefix: str = "") -> dict[str, Any]:
    found = {prefix + name: array for name, array in group.arrays()}
    for name, inner in group.groups():
        found.update(_zarr_arrays(inner, f"{prefix}{name}/"))
    return found


def _stated(attributes: Mapping[str, Any], ndim: int) -> tuple[tuple[float, ...] | None, str | None]:
    """Spacing and unit of an array's attributes; one number counts for all axes."""
    for name, known in (("element_size_um", "um"), ("spacing", None), ("voxel_size", None)):
        if name in attributes:
            sizes = np.atleast_1d(np.asarray(attributes[name], dtype=np.float64))
            unit = known or attributes.get("unit", attributes.get("units"))
            unit = unit.decode() if isinstance(unit, bytes) else unit
            return tuple(float(h) for h in (np.repeat(sizes, ndim) if sizes.size == 1 else sizes)), unit
    return None, None


def _multiscales(attributes: Mapping[str, Any]) -> dict[str, tuple[tuple[float, ...] | None, str | None]]:
    """OME-Zarr: path of each level -> (scale of its axes, unit of the last one)."""
    described = attributes.get("ome", attributes).get("multiscales") or []
    found: dict[str, tuple[tuple[float, ...] | None, str | None]] = {}
    for image in described[:1]:
        axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", [])]
        unit = axes[-1].get("unit") if axes else None
        for level in image.get("datasets", []):
            scales = [t["scale"] for t in level.get("coordinateTransformations", []) if t.get("type") == "scale"]
            found[level["path"]] = (tuple(float(h) for h in scales[0]) if scales else None, unit)
    return found
