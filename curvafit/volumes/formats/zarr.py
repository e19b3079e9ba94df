"""Zarr: reading of arrays, groups and OME-Zarr; writing of OME-Zarr 0.5, and of labels into images of 0.4 and 0.5."""

from __future__ import annotations

import json
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import require
from curvafit.core.files import move_into_place, write_content
from curvafit.core.records import MARK, is_zarr
from curvafit.core.runtime import hold_signals
from curvafit.core.units import common_unit, format_sampling, parse_unit
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
#: Version of OME-Zarr -> Zarr's format, for writing.
_FORMATS = {"0.4": 2, "0.5": 3}
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
    if key is None:
        _check_levels(arrays, levels, path)
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


def write_zarr(field: Any, path: Path, version: str = "0.5", labels: bool = False) -> None:
    """Write an image of OME-Zarr: the volume as `0`, halved copies as `1`, `2` … down to one chunk.

    `labels` says that its whole numbers are labels of the image two folders above.
    """
    with hold_signals():
        group = _create_zarr(field, path, version, labels)
    finest = _open_level(group, 0)
    for box in _chunk_boxes(group, 0):
        values = field.read(box).astype(finest.dtype, copy=False)
        with hold_signals():  # Zarr's own threads would go on to write while the folder is deleted
            finest[box] = values
    for level in range(1, len(group)):
        for box in _chunk_boxes(group, level):
            with hold_signals():
                _halve_level(group, level, box)


def _create_zarr(frame: Any, path: Path, version: str, labels: bool) -> Any:
    """Create an image of OME-Zarr with the shape, type, spacing and position of a volume, and return its group."""
    import zarr

    dtype = np.dtype(np.uint8) if labels and frame.dtype.kind == "b" else frame.dtype
    shapes = [tuple(frame.shape)]
    while max(shapes[-1]) > CHUNK:
        shapes.append(tuple(-(-n // 2) for n in shapes[-1]))
    # A mean of 2ᵏ voxels along an axis lies (2ᵏ - 1) / 2 voxels behind the first one's centre; a picked voxel does not.
    shift = 0.5 if dtype.kind == "f" else 0.0
    space = {"type": "space", **({"unit": _UNITS[frame.unit]} if frame.unit in _UNITS else {})}
    datasets = []
    for k in range(len(shapes)):
        transforms = [{"type": "scale", "scale": [2**k * h for h in frame.spacing]}]
        first = [x + shift * (2**k - 1) * h for x, h in zip(base.first_voxel(frame), frame.spacing, strict=True)]
        if any(first):
            transforms += [{"type": "translation", "translation": first}]
        datasets.append({"path": str(k), "coordinateTransformations": transforms})
    axes = [{"name": name, **space} for name in "zyx"]
    image = {"name": path.name if labels else "volume", "axes": axes, "datasets": datasets}
    is_format_2 = _FORMATS[version] == 2
    versioned = {"version": version} if is_format_2 else {}
    content: dict[str, Any] = {"multiscales": [image | versioned]}
    if labels:
        content["image-label"] = {"source": {"image": "../../"}} | versioned
    naming: dict[str, Any] = {"dimension_names": ("z", "y", "x")}
    if is_format_2:
        naming = {"chunk_key_encoding": {"name": "v2", "separator": "/"}}
    attributes = content if is_format_2 else {"ome": {"version": version, **content}}
    group = zarr.create_group(path, attributes=attributes, zarr_format=2 if is_format_2 else 3)
    dtype = np.dtype(dtype.newbyteorder("=").str)  # of the two 64-bit types of C, Zarr knows one
    for k, shape in enumerate(shapes):
        chunks = tuple(min(CHUNK, n) for n in shape)
        group.create_array(str(k), shape=shape, dtype=dtype, chunks=chunks, **naming)
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


# ---- labels of an image ----------------------------------------------------------------------------------------------


def image_of(path: Path) -> Path | None:
    """Return the OME-Zarr image of a path to its labels, `IMAGE/labels/NAME`; None for any other path.

    Raises ScanError if the group is no such image, its version is not 0.4 or 0.5, or the name is not valid.
    """
    image = path.parent.parent
    if path.parent.name != "labels" or not is_zarr(image):
        return None
    version = version_of(image)
    if version not in _FORMATS:
        kind = "no image of OME-Zarr" if version is None else f"OME-Zarr {version}"
        raise ScanError(f"labels are written into an image of OME-Zarr 0.4 or 0.5, {image} is {kind}")
    if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", path.name):
        raise ScanError(f"a name of labels has letters, digits and _ . - alone, got {path.name!r}")
    return image


def store_of(image: Path) -> Path:
    """Return the outermost Zarr group around an image."""
    while is_zarr(image.parent):
        image = image.parent
    return image


def write_labels(field: Any, path: Path, *, image: Path) -> None:
    """Write whole numbers, or a mask, as labels of an image; `path` may be anywhere until `add_labels`."""
    if field.dtype.kind not in "biu":
        raise ScanError(f"labels must be whole numbers, got values of type {field.dtype}")
    check_place(field, image)
    write_zarr(field, path, version_of(image) or "", labels=True)


def check_place(field: Any, image: Path) -> None:
    """Raise ScanError where a field's voxels are not those of a level of an image, or of a box of one."""
    import zarr

    group: Any = zarr.open_group(image, mode="r")
    for name, level in _read_levels("", group.attrs.asdict()).items():
        axes = level["axes"] or "zyx"
        zyx, count = [axes.index(letter) for letter in "zyx"], len(axes)
        by_axis = (level["steps"] or (1.0,) * count, level.get("origin") or (0.0,) * count, group[name].shape)
        edges, origin, shape = (np.array([values[axis] for axis in zyx]) for values in by_axis)
        common, to_common = common_unit([level["units"][axis] for axis in zyx] if level["units"] else [None] * 3)
        unit, from_common = parse_unit(common)  # lengths of the field are in `unit`, those of the level by axis
        same_edges = np.allclose(np.array(field.spacing) / from_common, edges * to_common, rtol=1e-3, atol=0)
        first = (np.array(base.first_voxel(field)) / from_common / to_common - origin) / edges  # in voxels of the level
        if unit == field.unit and same_edges and (first > -0.01).all() and (first + field.shape < shape + 0.01).all():
            return
    size = format_sampling(field.shape, field.spacing, field.unit)
    raise ScanError(f"labels must have the voxels of a level of {image} or of a part of one, got {size}")


@hold_signals()
def add_labels(written: Path, image: Path, name: str) -> Path:
    """Move written labels into an image, under a name, list them in its metadata, and return their path."""
    import zarr

    folder = image / "labels"
    folder.mkdir(exist_ok=True)
    target = move_into_place(written, folder / name)
    version, is_format_2 = version_of(image), (image / ".zgroup").exists()
    metadata = folder / (".zattrs" if is_format_2 else "zarr.json")
    content = json.loads(metadata.read_text(encoding="utf-8")) if metadata.exists() else {}
    if is_format_2:
        attributes = content
    else:
        content = {"zarr_format": 3, "node_type": "group", "attributes": {}, **content}
        attributes = content["attributes"].setdefault("ome", {"version": version})
    if name not in attributes.setdefault("labels", []):
        attributes["labels"].append(name)
        write_content(metadata, json.dumps(content, indent=2))
    if is_format_2 and not (folder / ".zgroup").exists():
        write_content(folder / ".zgroup", json.dumps({"zarr_format": 2}))
    root = store_of(image)
    if (root / ".zmetadata").exists() or zarr.open_group(root, mode="r").metadata.consolidated_metadata is not None:
        with warnings.catch_warnings():  # that consolidated metadata are no part of format 3, which this store has
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(root)
    return target


def version_of(image: Path) -> str | None:
    """Return the version of OME-Zarr of an image; None if a group is no image."""
    import zarr

    attributes: Any = zarr.open_group(image, mode="r").attrs.asdict()
    images = attributes.get("ome", attributes).get("multiscales")
    if not images:
        return None
    return str(attributes.get("ome", {}).get("version") or images[0].get("version") or "0.4")


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
    systems = {system["name"]: system["axes"] for system in image.get("coordinateSystems", [])}
    notes = (f"The group holds {len(images)} images: the first is used.",) if len(images) > 1 else ()
    version = str(ome.get("version") or image.get("version") or "0.4")
    notes += () if re.match(r"0\.[1-6]\b", version) else (f"It is of OME-Zarr {version}, and read as of 0.6.",)
    levels: dict[str, _Geometry] = {}
    for dataset in image.get("datasets", []):
        transforms = list(dataset.get("coordinateTransformations", []))
        listed = image.get("axes") or systems.get(transforms[0].get("output") if transforms else "") or []
        # The image's own come after a level's, unless there are systems of coordinates: then they lead to another one.
        transforms += [] if systems else image.get("coordinateTransformations", [])
        axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in listed]
        names = [str(axis["type"] if axis.get("type") in ("channel", "time") else axis.get("name")) for axis in axes]
        geometry = {"axes": base.name_axes(names), "units": [axis.get("unit") for axis in axes], "notes": notes}
        levels[f"{name}/{dataset['path']}".strip("/")] = geometry | _read_transforms(transforms, geometry["axes"])
    return levels


def _read_transforms(transforms: Sequence[Mapping[str, Any]], axes: str) -> _Geometry:
    """Return steps and origin, or steps and affine, that transforms of indices state.

    An unknown transform becomes the name of a unit, which is refused unless the caller states spacing and unit.
    """
    lengths = [len(value) for t in transforms if isinstance(value := t.get(str(t.get("type"))), list)]
    n = len(axes) or max(lengths, default=0)
    matrix = _compose(transforms, n)
    if isinstance(matrix, str):
        return {"steps": None, "units": (f"coordinates of a transform {matrix}",) * n}
    linear, offset = matrix[:n, :n], matrix[:n, n]
    if all(t.get("type") == "translation" for t in transforms):
        return {"steps": None, "origin": offset.tolist() if transforms else None}
    steps, space = np.linalg.norm(linear, axis=0), [axes.index(axis) for axis in "xyz" if axis in axes]
    if np.array_equal(linear, np.diag(steps)):
        return {"steps": steps.tolist(), "origin": offset.tolist() if offset.any() else None}
    in_space = linear[np.ix_(space, space)]
    # An affine has x, y and z alone: any other axis must have its step on the diagonal, and nothing else.
    if len(space) < 3 or np.count_nonzero(linear) != n - 3 + np.count_nonzero(in_space):
        return {"steps": None, "units": ("coordinates of a transform of axes that are not of space",) * n}
    return {"steps": steps.tolist(), "affine": base.affine_of(in_space, offset[space])}


def _compose(transforms: Sequence[Mapping[str, Any]], n: int) -> np.ndarray | str:
    """Return the matrix (n + 1, n + 1) of transforms, applied in order, or the type of the first unknown one."""
    composed = np.eye(n + 1)
    for transform in transforms:
        kind, matrix = str(transform.get("type")), np.eye(n + 1)
        value: Any = transform.get({"sequence": "transformations"}.get(kind, kind))
        if kind == "identity":
            continue
        if kind not in ("scale", "translation", "affine", "rotation", "mapAxis", "sequence") or value is None:
            return repr(kind)
        if kind == "scale":
            matrix[:n, :n] = np.diag(np.array(value, dtype=np.float64))
        elif kind == "translation":
            matrix[:n, n] = value
        elif kind == "affine":
            matrix[:n] = value
        elif kind == "sequence":
            inner = _compose(value, n)
            if isinstance(inner, str):
                return inner
            matrix = inner
        else:
            matrix[:n, :n] = value if kind == "rotation" else np.eye(n)[value]
        composed = matrix @ composed
    return composed


def _check_levels(arrays: Mapping[str, Any], levels: Mapping[str, _Geometry], path: Path) -> None:
    """Raise ScanError where levels of an image are missing, or differ in extent by more than one of their voxels."""
    extents: dict[str, np.ndarray] = {}
    for name, level in levels.items():
        if name not in arrays:
            raise ScanError(f"{path} lists the level {name}, which is not there: name another, as in {path}::0")
        if level["steps"] is None or len(level["steps"]) != arrays[name].ndim:
            continue
        extents[name] = np.array(level["steps"]) * arrays[name].shape
        first = next(iter(extents))
        if (np.abs(extents[name] - extents[first]) > 1.01 * np.array(level["steps"])).any():
            sizes = {key: " x ".join(f"{edge:g}" for edge in extents[key]) for key in (first, name)}
            listed = " and ".join(f"{size} of {key}" for key, size in sizes.items())
            raise ScanError(f"the levels of {path} disagree in extent, {listed}: name one, as in {path}::{first}")


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
