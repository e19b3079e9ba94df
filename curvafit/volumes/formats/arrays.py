"""NPY, NPZ, HDF5 and RAW files, and microscopes': Imaris; CZI, LIF and ND2 by bioio, of the extra `[microscopes]`."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import quoted, require
from curvafit.core.records import read_member
from curvafit.core.units import is_unit
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import ScanError, Stated

#: Suffix of a microscope's own file -> the package that reads it.
MICROSCOPES = {".czi": "bioio_czi", ".lif": "bioio_lif", ".nd2": "bioio_nd2"}
_RAW_TYPES = "uint8, int8, uint16, int16, uint32, int32, float32, float64 (or with > for big-endian, as in >u2)"


def read_npy(path: Path, **_: object) -> Stated:
    """Read the numbers of an NPY file."""
    values = np.lib.format.open_memmap(path, mode="r")
    if values.offset + values.nbytes != path.stat().st_size:
        raise base.Damaged(f"{values.nbytes} bytes of values by its header, not so many in the file")
    return Stated(values, "?" * values.ndim)


def write_npy(field: Any, path: Path) -> None:
    """Write the values alone: NPY holds neither spacing nor unit."""
    with path.open("wb") as stream:
        np.save(stream, field.values)


def read_npz(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read the array of an NPZ file that a key names, with the voxel size that arrays named like `spacing` state."""
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        attribute_names = [name for name in names if name != key and _is_attribute(archive, name)]
        keys = [name for name in names if name not in attribute_names]
        values = read_member(archive, f"{base.pick_key(keys, key, path)}.npy")
        attributes = {name: read_member(archive, f"{name}.npy") for name in attribute_names}
    return Stated(values, "?" * values.ndim, **base.read_spacing(attributes, values.ndim))


def _is_attribute(archive: zipfile.ZipFile, name: str) -> bool:
    """Return whether an array is named like a spacing and is a few numbers, or is named like a unit and is text."""
    is_unit_name = name in ("unit", "units")
    if not is_unit_name and name != "offset" and not base.SPACING.search(name):
        return False
    with archive.open(f"{name}.npy") as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    return dtype.kind in ("US" if is_unit_name else "iuf") and len(shape) <= 1 and math.prod(shape) <= 99


def read_hdf5(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read a dataset, its axes from `axistags` or dimension labels, and its spacing from attributes or `axistags`."""
    import h5py

    file = h5py.File(path, "r")
    dataset: Any = file[base.pick_key(_list_datasets(file), key, path)]
    _check_dataset(dataset, path)
    tags = json.loads(dataset.attrs["axistags"])["axes"] if "axistags" in dataset.attrs else []
    tags = tags if len(tags) == dataset.ndim else []
    labels = [dimension.label for dimension in dataset.dims]
    names = [str(tag["key"]) for tag in tags] or labels
    axes, geometry = base.name_axes(names), base.read_spacing(dataset.attrs, dataset.ndim)
    if tags and any(labels) and base.name_axes(labels) != axes:
        listed = f"{', '.join(names)} in axistags, and {', '.join(labels)} in their labels"
        raise ScanError(f"{path} calls its axes {listed}")
    steps = [float(tag.get("resolution") or 0) for tag in tags]
    if "steps" not in geometry and tags and all(h > 0 for h, axis in zip(steps, axes, strict=True) if axis in "zyx"):
        units = [text if is_unit(text := str(tag.get("description") or "")) else None for tag in tags]
        geometry |= {"steps": [h or 1.0 for h in steps], "units": units}
    return Stated(dataset, axes, **geometry, gaps=tuple(_describe_gaps(dataset, path)))


def read_imaris(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read a channel (key `TimePoint 0/Channel 1`) of an Imaris file, without the padding of its last chunks."""
    import h5py

    level = "DataSet/ResolutionLevel 0/"
    file: Any = h5py.File(path, "r")
    names = [name for name in _list_datasets(file) if name.startswith(level) and name.endswith("/Data")]
    keys = [name.removeprefix(level).removesuffix("/Data") for name in names]
    channel = file[level + base.pick_key(keys, key, path)]
    dataset, image = channel["Data"], file["DataSetInfo/Image"]
    _check_dataset(dataset, path)
    shape = tuple(int(_read_text(channel, f"ImageSize{axis}")) for axis in "ZYX")
    lower, upper = ([float(_read_text(image, f"Ext{end}{k}")) for k in (2, 1, 0)] for end in ("Min", "Max"))
    if len(dataset.shape) != 3 or not all(0 < n <= stored for n, stored in zip(shape, dataset.shape, strict=True)):
        raise base.Damaged(f"{list(shape)} voxels by its header, {list(dataset.shape)} in the file")
    steps = [(high - low) / n for low, high, n in zip(lower, upper, shape, strict=True)]
    unit = _read_text(image, "Unit") if "Unit" in image.attrs else "um"
    return Stated(Corner(dataset, shape), "zyx", steps, (unit,) * 3, gaps=tuple(_describe_gaps(dataset, path)))


class Corner:
    """The first voxels of a larger array."""

    def __init__(self, array: Any, shape: tuple[int, ...]) -> None:
        self.array, self.shape, self.dtype = array, shape, array.dtype

    def __getitem__(self, index: Any) -> np.ndarray:
        return self.array[index]


def _list_datasets(file: Any) -> list[str]:
    """Return the names of a file's datasets; links to other files are not followed."""
    import h5py

    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names


def _check_dataset(dataset: Any, path: Path) -> None:
    """Raise ScanError where the values of a dataset are not in its file."""
    if dataset.external:
        raise ScanError(f"the values of {path} lie in other files, which are not read")
    if dataset.shape is None:
        raise ScanError(f"a volume must be 3D, got no values in {path}")


def _read_text(item: Any, name: str) -> str:
    """Return an attribute that Imaris writes as an array of single characters."""
    return np.asarray(item.attrs[name]).astype("S").tobytes().decode("latin-1").strip("\0 ")


def _describe_gaps(dataset: Any, path: Path) -> Iterator[str]:
    """Yield a sentence if values of a dataset are not stored: HDF5 fills them in silently."""
    fill = f"their voxels have the fill value {dataset.fillvalue}."
    if dataset.is_virtual:
        files = {source.file_name for source in dataset.virtual_sources()} - {"."}  # "." is the file itself
        absent = sorted(name for name in files if not base.check_regular(path.parent / name).exists())
        if absent:
            yield f"{len(absent)} of its {len(files)} source files are not there, {absent[0][:80]} among them; {fill}"
    elif dataset.chunks:
        count = math.prod(-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True))
        unstored = count - dataset.id.get_num_chunks()
        if unstored > 0:
            yield f"{unstored} of {count} chunks are not stored: {fill}"
    elif dataset.size and not dataset.id.get_storage_size():
        yield f"No values are stored: {fill}"


def read_raw(path: Path, *, raw_shape: Sequence[int] | None = None, dtype: str | None = None, **_: object) -> Stated:
    """Read numbers without a header, x fastest, of the given shape and type, by default one byte per voxel."""
    if raw_shape is None:
        raise ScanError(f"{path} holds bare numbers: give raw_shape (--raw-shape Z,Y,X)")
    shape = tuple(int(n) for n in raw_shape)
    size = path.stat().st_size
    if len(shape) != 3 or min(shape) < 1:
        raise ScanError(f"raw_shape must be 3 positive whole numbers (z, y, x), got {tuple(raw_shape)}")
    if dtype is None and size != math.prod(shape):
        raise ScanError(f"{path} has {size / math.prod(shape):.4g} bytes a voxel: give dtype (--dtype)")
    try:
        number_type = np.dtype(dtype or "uint8")
    except TypeError:
        raise ScanError(f"dtype must be one of {_RAW_TYPES}, got {quoted(dtype)}") from None
    if size != (nbytes := math.prod(shape) * number_type.itemsize):
        raise ScanError(f"shape {shape} of {number_type} takes {nbytes} bytes, got {size} in {path}")
    return Stated(base.map_numbers(path, 0, shape, number_type), "zyx")


def read_microscope(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read a scene (`key`), by default the only one, with the voxel size in um that its file states."""
    for module in (MICROSCOPES[path.suffix.lower()], "bioio"):  # the format's reader is only a plugin of bioio
        bioio = require(module, "microscopes", f"reading {path.suffix}")
    image = bioio.BioImage(path)
    image.set_scene(base.pick_key(list(image.scenes), key, path))
    axes, sizes = base.name_axes(image.dims.order), image.physical_pixel_sizes
    if not (sizes.X and sizes.Y):
        return Stated(image.dask_data, axes)
    guesses = () if sizes.Z or image.dims.Z == 1 else (base.NO_DISTANCE,)
    edges = {"z": sizes.Z or sizes.X, "y": sizes.Y, "x": sizes.X}
    return Stated(image.dask_data, axes, [edges.get(axis) for axis in axes], ("um",) * len(axes), guesses=guesses)
