"""Zarr: reading of arrays, groups and OME-Zarr; writing of OME-Zarr 0.5."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import require
from curvafit.core.records import MARK
from curvafit.core.runtime import hold_signals
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import ScanError, Stated
from curvafit.volumes.volume import Box, cut_boxes

#: Edge of a chunk, and of the largest volume that gets no halved copy, in voxels.
CHUNK = 64
#: Chunks of an array at most; more would take hours to read.
_MOST = 10_000_000
#: Edge, in chunks, of the boxes in which a level is written.
_BOX = 2
#: Our unit -> OME-Zarr's, which has none for the voxel.
_UNITS = {"nm": "nanometer", "um": "micrometer", "mm": "millimeter", "m": "meter"}
#: In a shard's index: bytes of a chunk's offset and length, of the checksum at the end, and either of an absent chunk.
_ENTRY, _CHECKSUM, _ABSENT = 16, 4, 2**64 - 1
#: The axes, steps, units, origin or affine and notes of an array, as the fields of `Stated`.
_Geometry = dict[str, Any]


def read_zarr(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read an array, or one of a group, with spacing and unit of its attributes or of OME-Zarr's multiscales.

    A key names an array, or an image of OME-Zarr, of which the finest level is read. Without a key the group must be an
    image, hold a single one besides labels, or hold a single array.
    """
    import zarr

    _check_store(path)
    node: Any = zarr.open(path, mode="r")
    if isinstance(node, zarr.Array):
        return _state_array(node, path)
    arrays, levels, name = _pick_array(node, key, path)
    return _state_array(arrays[name], path / arrays[name].path, levels.get(name), node)


def read_remote(url: str, key: str | None = None) -> Stated:
    """Read an array, or a level of an image of OME-Zarr, from a store at a URL, `https://` or `s3://`.

    Such a store cannot be searched for arrays: without a key it must be an image, whose finest level is read.
    """
    scheme = url.partition("://")[0]
    for module, extra in (("fsspec", "remote"), ("s3fs", "") if scheme == "s3" else ("aiohttp", "remote")):
        require(module, extra, f"reading {scheme}://")
    import zarr

    node: Any = zarr.open(url, mode="r")
    if isinstance(node, zarr.Array):
        return _state_array(node, None)
    levels = _read_levels("", node.attrs.asdict())
    name = key or next(iter(levels), None)
    if name is None:
        raise ScanError(f"{url} holds no image of OME-Zarr: name an array, as in {url}::KEY")
    array = node[name]
    if not isinstance(array, zarr.Array):  # the key names an image
        levels = _read_levels(name, array.attrs.asdict())
        array = node[name := next(iter(levels), name)]
    return _state_array(array, None, levels.get(name), node)


def _pick_array(node: Any, key: str | None, path: Path) -> tuple[dict[str, Any], dict[str, _Geometry], str]:
    """Return the arrays of a group, the levels of the image that is read, if it is one, and the name of its array."""
    import zarr

    members = dict(node.members(max_depth=None))
    arrays = {name: member for name, member in members.items() if isinstance(member, zarr.Array)}
    groups = {"": node} | {name: member for name, member in members.items() if name not in arrays}
    images = {name: _read_levels(name, group.attrs.asdict()) for name, group in groups.items()}
    finest = {name: next(iter(levels)) for name, levels in images.items() if levels}
    if key is None:
        volumes = [name for name in finest if "labels" not in name.split("/")]
        key = finest.get("") or (finest[volumes[0]] if len(volumes) == 1 else None)
    elif key.strip("/") in finest:
        key = finest[key.strip("/")]
    name = base.pick_key(sorted(arrays), key, path)
    return arrays, next((levels for levels in images.values() if name in levels), {}), name


def _state_array(array: Any, folder: Path | None, geometry: _Geometry | None = None, group: Any = None) -> Stated:
    """Return an array in a folder with its geometry, by default that of its or its group's attributes."""
    if geometry is None:
        shared = {} if group is None else group.attrs.asdict()
        geometry = base.read_spacing({**shared, **array.attrs.asdict()}, array.ndim)
    units, notes = geometry.get("units") or (None,) * 3, tuple(geometry.get("notes", ()))
    image_axes = geometry.get("axes", "")
    names = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS") or ()
    axes = base.name_axes([str(name) for name in names])
    axes = axes if len(axes) == array.ndim else "?" * array.ndim
    if len(image_axes) == array.ndim:
        if any(a != b and "?" not in (a, b) for a, b in zip(image_axes, axes, strict=True)):
            notes += (f"The array calls its axes {', '.join(map(str, names))}: those of the image count.",)
        axes = image_axes
    unknown = ("Whether chunks are missing in a store that is not on this machine is not known.",)
    gaps = unknown if folder is None else _missing_chunks(array, folder)
    return Stated(array, **{**geometry, "axes": axes, "units": units, "notes": notes}, gaps=gaps)


def write_zarr(field: Any, path: Path) -> None:
    """Write an image of OME-Zarr 0.5: the volume as `0`, halved copies as `1`, `2` … down to one chunk."""
    with hold_signals():
        group = _create_zarr(field, path)
    finest = _open_level(group, 0)
    for box in _chunk_boxes(group, 0):
        values = field.read(box).astype(finest.dtype, copy=False)
        with hold_signals():  # Zarr's own threads would go on to write while the folder is deleted
            finest[box] = values
    for level in range(1, len(group)):
        for box in _chunk_boxes(group, level):
            with hold_signals():
                _halve_level(group, level, box)


def _create_zarr(frame: Any, path: Path) -> Any:
    """Create an image of OME-Zarr with the shape, type, spacing and position of a volume, and return its group."""
    import zarr

    shapes = [tuple(frame.shape)]
    while max(shapes[-1]) > CHUNK:
        shapes.append(tuple(-(-n // 2) for n in shapes[-1]))
    # A mean of 2ᵏ voxels along an axis lies (2ᵏ - 1) / 2 voxels behind the first one's centre; a picked voxel does not.
    shift = 0.5 if frame.dtype.kind == "f" else 0.0
    space = {"type": "space", **({"unit": _UNITS[frame.unit]} if frame.unit in _UNITS else {})}
    datasets = []
    for k in range(len(shapes)):
        transforms = [{"type": "scale", "scale": [2**k * h for h in frame.spacing]}]
        first = [x + shift * (2**k - 1) * h for x, h in zip(base.first_voxel(frame), frame.spacing, strict=True)]
        if any(first):
            transforms += [{"type": "translation", "translation": first}]
        datasets.append({"path": str(k), "coordinateTransformations": transforms})
    axes = [{"name": name, **space} for name in "zyx"]
    image = {"name": "volume", "axes": axes, "datasets": datasets}
    group = zarr.create_group(path, attributes={"ome": {"version": "0.5", "multiscales": [image]}}, zarr_format=3)
    dtype = np.dtype(frame.dtype.newbyteorder("=").str)  # of the two 64-bit types of C, Zarr knows one
    for k, shape in enumerate(shapes):
        chunks = tuple(min(CHUNK, n) for n in shape)
        group.create_array(str(k), shape=shape, dtype=dtype, chunks=chunks, dimension_names=("z", "y", "x"))
    return group


def _open_level(group: Any, level: int) -> Any:
    """Return a level of an image to write to, with all its chunks: one that is missing later was lost."""
    return group[str(level)].with_config({"write_empty_chunks": True})


def _chunk_boxes(group: Any, level: int) -> list[Box]:
    """Return the boxes of whole chunks in which a level is written."""
    array = group[str(level)]
    return cut_boxes(array.shape, [_BOX * edge for edge in array.chunks])


def _halve_level(group: Any, level: int, box: Box) -> None:
    """Write a box of whole chunks of a level, from 2 x 2 x 2 voxels of the next finer level for each voxel."""
    finer = group[str(level - 1)]
    values = finer[tuple(slice(2 * e.start, min(2 * e.stop, n)) for e, n in zip(box, finer.shape, strict=True))]
    if values.dtype.kind == "f":  # their mean; at an odd end the last voxel counts twice
        even = np.pad(values, [(0, n % 2) for n in values.shape], mode="edge")
        nz, ny, nx = (n // 2 for n in even.shape)
        values = even.reshape(nz, 2, ny, 2, nx, 2).mean((1, 3, 5), dtype=np.float32).astype(values.dtype)
    else:  # the first of them: whole numbers may be labels
        values = values[::2, ::2, ::2]
    _open_level(group, level)[box] = values


@hold_signals()
def mark(folder: Path, kind: str) -> None:
    """Write into a group's attributes that this program wrote it, and its kind."""
    import zarr

    zarr.open_group(folder, mode="r+").attrs[MARK] = {"kind": kind}


def _read_levels(name: str, attributes: Mapping[str, Any]) -> dict[str, _Geometry]:
    """Return the geometry of each level of an OME-Zarr image by the level's path, finest first; {} of another group."""
    ome = attributes.get("ome", attributes)
    images = ome.get("multiscales") or [{}]
    image = images[0]
    version = str(ome.get("version") or image.get("version") or "0.4")
    notes = (f"The group holds {len(images)} images: the first is used.",) if len(images) > 1 else ()
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes") or []]
    names = [str(axis["type"] if axis.get("type") in ("channel", "time") else axis.get("name")) for axis in axes]
    geometry = {"axes": base.name_axes(names), "units": [axis.get("unit") for axis in axes], "notes": notes}
    levels: dict[str, _Geometry] = {}
    for dataset in image.get("datasets", []):
        transforms = [*dataset.get("coordinateTransformations", []), *image.get("coordinateTransformations", [])]
        place = (
            _read_transforms(transforms) if re.match(r"0\.[1-5]\b", version) else _unknown_unit(f"OME-Zarr {version}")
        )
        levels[f"{name}/{dataset['path']}".strip("/")] = geometry | place
    return levels


def _read_transforms(transforms: Sequence[Mapping[str, Any]]) -> _Geometry:
    """Return the steps and the origin that transforms of indices, applied in order, state."""
    steps, origin = np.array(1.0), np.array(0.0)
    for transform in transforms:
        kind = str(transform.get("type"))
        value = transform.get(kind)
        if kind == "scale" and value is not None:
            steps, origin = steps * value, origin * value
        elif kind == "translation" and value is not None:
            origin = origin + value
        elif kind != "identity":
            return _unknown_unit(f"a transform {kind!r}")
    return {"steps": steps.tolist() if steps.ndim else None, "origin": origin.tolist() if origin.any() else None}


def _unknown_unit(source: str) -> _Geometry:
    """Return coordinates that are not read as an unknown unit: refused, unless the caller states spacing and unit."""
    return {"steps": None, "units": (f"coordinates of {source}",) * 3}


# ---- chunks that are not stored --------------------------------------------------------------------------------------


def _check_store(folder: Path) -> None:
    """Raise ScanError where something in a store is neither file nor folder, or a link leads to a folder above it."""
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent, name) for name in folders):
            if path.is_symlink() and Path(os.path.realpath(parent)).is_relative_to(path.resolve()):
                raise ScanError(f"the link {path} in a Zarr store leads back to a folder above it")
        for path in (Path(parent, name) for name in files):
            if path.exists() and not path.is_file():
                raise ScanError(f"{path} in a Zarr store is no file")


def _missing_chunks(array: Any, folder: Path) -> tuple[str, ...]:
    """Return a note on chunks that are not stored, if any; Zarr's `nchunks_initialized` does not look into shards."""
    edges, count = array.shards or array.chunks, math.prod(_counts(array.shape, array.chunks))
    if count > _MOST:
        raise ScanError(f"a Zarr array may have at most {_MOST:,} chunks, got {count:,} in {folder}")
    has_blosc = "blosc" in type(array.compressors[-1] if array.compressors else None).__name__.lower()
    missing = count
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        index = tuple(map(int, re.findall(r"\d+", name)))
        if len(index) != array.ndim or array.metadata.encode_chunk_key(index) != name or not path.is_file():
            continue
        shape = [min(edge, n - k * edge) for n, edge, k in zip(array.shape, edges, index, strict=True)]
        if min(shape, default=1) <= 0:  # a chunk beyond the array, which may have been larger once
            continue
        counts = _counts(shape, array.chunks)
        missing -= math.prod(counts)
        if array.shards:
            missing += _count_missing(array, path, counts)
        elif has_blosc:
            _check_blosc(path)
    note = f"{missing} of {count} chunks are not stored: their voxels have the fill value {array.fill_value}."
    return (note,) if missing else ()


def _check_blosc(chunk: Path) -> None:
    """Raise Damaged where a chunk's size is not the one in its header; Blosc does not compare them."""
    with chunk.open("rb") as stream:
        nbytes = int.from_bytes(stream.read(16)[12:], "little")
    if nbytes != (size := chunk.stat().st_size):
        raise base.Damaged(f"{nbytes} bytes by the header of chunk {chunk.name}, {size} in the file")


def _counts(shape: Sequence[int], edges: Sequence[int]) -> list[int]:
    """Return the number of chunks of these edges along each axis of a shape."""
    return [-(-n // edge) if edge else 0 for n, edge in zip(shape, edges, strict=True)]


def _count_missing(array: Any, shard: Path, counts: Sequence[int]) -> int:
    """Return how many of a shard's first `counts` chunks along the axes its index lacks; 0 if it has unusual codecs."""
    sharding: Any = next((codec for codec in array.metadata.codecs if hasattr(codec, "index_codecs")), None)
    if [type(codec).__name__ for codec in getattr(sharding, "index_codecs", ())] != ["BytesCodec", "Crc32cCodec"]:
        return 0
    index_shape = _counts(array.shards, array.chunks)
    size = _ENTRY * math.prod(index_shape)
    with shard.open("rb") as stream:
        if str(getattr(sharding.index_location, "value", sharding.index_location)) == "end":
            stream.seek(max(0, shard.stat().st_size - size - _CHECKSUM))
        index = stream.read(size)
    if len(index) < size:
        return 0  # reading its values says what is wrong
    absent = (np.frombuffer(index, "<u8").reshape(*index_shape, 2) == _ABSENT).all(-1)
    return int(absent[tuple(slice(n) for n in counts)].sum())
