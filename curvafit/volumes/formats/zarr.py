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

#: Edge of a chunk, and of the largest volume that is not halved any more, in voxels.
CHUNK = 64
#: Chunks of an array at most; more would take hours to read.
_MOST = 10_000_000
#: Chunks a side of the boxes by which a level is halved.
_HALVED = 2
#: Our unit -> OME-Zarr's, which has none for the voxel.
_UNITS = {"nm": "nanometer", "um": "micrometer", "mm": "millimeter", "m": "meter"}
#: Version of OME-Zarr -> Zarr's format, for writing.
_FORMATS = {"0.4": 2, "0.5": 3}
#: In the index of a shard: bytes of a chunk's offset and length, of the checksum at the end, and what stands for none.
_ENTRY, _CHECKSUM, _ABSENT = 16, 4, 2**64 - 1
#: The letters of the axes of a level of an image, and the steps, units and origin along them, as `Stated` has them.
_Place = dict[str, Any]


def read_zarr(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read an array, or one of a group, with spacing and unit of its attributes or of OME-Zarr's multiscales.

    A key names an array, or an image of OME-Zarr, of which the finest level is read. Without one a group is that image,
    holds one besides labels, or has a single array.
    """
    import zarr

    _check_store(path)
    node: Any = zarr.open(path, mode="r")
    if isinstance(node, zarr.Array):
        return _state_array(node, path)
    arrays, places, name = _pick_array(node, key, path)
    if key is None:
        _check_levels(arrays, places, path)
    return _state_array(arrays[name], path / arrays[name].path, places.get(name), node)


def read_remote(url: str, key: str | None = None) -> Stated:
    """Read an array, or a level of an image of OME-Zarr, of a store at a URL, `https://` or `s3://`.

    What is in such a store cannot be listed: without a key its image's finest level is read.
    """
    scheme = url.partition("://")[0]
    for module, extra in (("fsspec", "remote"), ("s3fs", "") if scheme == "s3" else ("aiohttp", "remote")):
        require(module, extra, f"reading {scheme}://")
    import zarr

    node: Any = zarr.open(url, mode="r")
    if isinstance(node, zarr.Array):
        return _state_array(node, None)
    places = _levels("", node.attrs.asdict())
    name = key or next(iter(places), None)
    if name is None:
        raise ScanError(f"{url} holds no image of OME-Zarr: name an array, as in {url}::KEY")
    array = node[name]
    if not isinstance(array, zarr.Array):
        places = _levels(name, array.attrs.asdict())
        name = next(iter(places), name)
        array = node[name]
    return _state_array(array, None, places.get(name), node)


def list_levels(path: Path, key: str | None) -> dict[str, tuple[float, ...] | None]:
    """Return the known spacing of each level of the image that is read of a store, by key; none of an array."""
    import zarr

    _check_store(path)
    node: Any = zarr.open(path, mode="r")
    if isinstance(node, zarr.Array):
        return {}
    arrays, places, name = _pick_array(node, key, path)
    if key is not None and key.strip("/") == name:
        return {}
    return {each: place["steps"] for each, place in places.items() if each in arrays}


def _pick_array(node: Any, key: str | None, path: Path) -> tuple[dict[str, Any], dict[str, _Place], str]:
    """Return the arrays of a group, the places of the levels of the image that is read, and its array's name."""
    import zarr

    members = dict(node.members(max_depth=None))
    arrays = {name: member for name, member in members.items() if isinstance(member, zarr.Array)}
    images = {"": node} | {name: member for name, member in members.items() if name not in arrays}
    levels = {name: _levels(name, group.attrs.asdict()) for name, group in images.items()}
    firsts = {name: next(iter(places)) for name, places in levels.items() if places}
    if key is None:
        volumes = [name for name in firsts if "labels" not in name.split("/")]
        key = firsts.get("") or (firsts[volumes[0]] if len(volumes) == 1 else None)
    elif key.strip("/") in firsts:
        key = firsts[key.strip("/")]
    name = base.pick_key(sorted(arrays), key, path)
    return arrays, next((level for level in levels.values() if name in level), {}), name


def _state_array(array: Any, folder: Path | None, place: _Place | None = None, group: Any = None) -> Stated:
    """Return an array in a folder at its place, by default that of its or its group's attributes."""
    if place is None:
        shared = {} if group is None else group.attrs.asdict()
        place = base.read_spacing({**shared, **array.attrs.asdict()}, array.ndim)
    axes, units = place.get("axes", ""), place.get("units") or (None,) * 3
    named = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS") or ()
    own, notes = base.name_axes([str(each) for each in named]), tuple(place.get("notes", ()))
    own = own if len(own) == array.ndim else "?" * array.ndim
    if len(axes) == array.ndim and any(a != b and "?" not in (a, b) for a, b in zip(axes, own, strict=True)):
        notes += (f"The array calls its axes {', '.join(map(str, named))}: those of the image count.",)
    axes = axes if len(axes) == array.ndim else own
    unknown = ("Whether chunks are missing in a store that is not on this machine is not known.",)
    gaps = unknown if folder is None else _missing_chunks(array, folder)
    return Stated(array, **{**place, "axes": axes, "units": units, "notes": notes}, gaps=gaps)


def write_zarr(field: Any, path: Path, version: str = "0.5", labels: bool = False) -> None:
    """Write an image of OME-Zarr: the volume as `0`, halved copies as `1`, `2` … down to one chunk.

    `labels` says that its whole numbers are labels of the image two folders above.
    """
    with hold_signals():
        group = _create_zarr(field, path, version, labels)
    finest = _level_of(group, 0)
    for core in _cores_of(group, 0):
        values = field.read(core).astype(finest.dtype, copy=False)
        with hold_signals():  # Zarr's own threads would go on to write while the folder is deleted
            finest[core] = values
    for level in range(1, len(group)):
        for core in _cores_of(group, level):
            with hold_signals():
                _halve_level(group, level, core)


def _create_zarr(frame: Any, path: Path, version: str, labels: bool) -> Any:
    """Create an image of OME-Zarr with a volume's shape, type and place, and return its group."""
    import zarr

    dtype = np.dtype(np.uint8) if labels and frame.dtype.kind == "b" else frame.dtype
    shapes = [tuple(frame.shape)]
    while max(shapes[-1]) > CHUNK:
        shapes.append(tuple(-(-n // 2) for n in shapes[-1]))
    # A mean of 2ᵏ voxels along an axis lies (2ᵏ - 1) / 2 voxels behind the first one's centre; a picked voxel does not.
    shift = 0.5 if dtype.kind == "f" else 0.0
    kind = {"type": "space", **({"unit": _UNITS[frame.unit]} if frame.unit in _UNITS else {})}
    datasets = []
    for k in range(len(shapes)):
        transforms = [{"type": "scale", "scale": [2**k * h for h in frame.spacing]}]
        first = [x + shift * (2**k - 1) * h for x, h in zip(base.first_voxel(frame), frame.spacing, strict=True)]
        if any(first):
            transforms += [{"type": "translation", "translation": first}]
        datasets.append({"path": str(k), "coordinateTransformations": transforms})
    axes = [{"name": name, **kind} for name in "zyx"]
    image = {"name": path.name if labels else "volume", "axes": axes, "datasets": datasets}
    old = _FORMATS[version] == 2
    content: dict[str, Any] = {"multiscales": [image | {"version": version} if old else image]}
    if labels:
        content["image-label"] = {"source": {"image": "../../"}} | ({"version": version} if old else {})
    naming: dict[str, Any] = {"chunk_key_encoding": {"name": "v2", "separator": "/"}} if old else {}
    naming |= {} if old else {"dimension_names": ("z", "y", "x")}
    attributes = content if old else {"ome": {"version": version, **content}}
    group = zarr.create_group(path, attributes=attributes, zarr_format=2 if old else 3)
    for k, shape in enumerate(shapes):
        group.create_array(
            str(k),
            shape=shape,
            dtype=np.dtype(dtype.newbyteorder("=").str),  # of the two 64-bit types of C, Zarr knows one
            chunks=tuple(min(CHUNK, n) for n in shape),
            **naming,
        )
    return group


def _level_of(group: Any, level: int) -> Any:
    """Return a level of an image to write to: a chunk that is not there afterwards is one that was lost."""
    return group[str(level)].with_config({"write_empty_chunks": True})


def _cores_of(group: Any, level: int) -> list[Box]:
    """Return the boxes of whole chunks by which a level is written."""
    array = group[str(level)]
    return cut_boxes(array.shape, [_HALVED * edge for edge in array.chunks])


def _halve_level(group: Any, level: int, core: Box) -> None:
    """Write a core of whole chunks of a level: of floats means of 2³ voxels of the level before it (the last voxels
    count twice where the number is odd), of whole numbers, which may be labels, every second value."""
    finer = group[str(level - 1)]
    values = finer[tuple(slice(2 * e.start, min(2 * e.stop, n)) for e, n in zip(core, finer.shape, strict=True))]
    if values.dtype.kind == "f":
        even = np.pad(values, [(0, n % 2) for n in values.shape], mode="edge")
        nz, ny, nx = (n // 2 for n in even.shape)
        values = even.reshape(nz, 2, ny, 2, nx, 2).mean((1, 3, 5), dtype=np.float32).astype(values.dtype)
    else:
        values = values[::2, ::2, ::2]
    _level_of(group, level)[core] = values


# ---- labels of an image ----------------------------------------------------------------------------------------------


def image_of(path: Path) -> Path | None:
    """Return the OME-Zarr image of which a path, `IMAGE/labels/NAME`, is to be labels; None if it is another path.

    Raises ScanError if there is no such image, its version is not 0.4 or 0.5, or the name is none.
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
    """Raise ScanError where a field's voxels are not those of a level of an image, or of a part of one."""
    import zarr

    group: Any = zarr.open_group(image, mode="r")
    for name, place in _levels("", group.attrs.asdict()).items():
        axes = place["axes"] or "zyx"
        where, count = [axes.index(letter) for letter in "zyx"], len(axes)
        stated = (place["steps"] or (1.0,) * count, place["origin"] or (0.0,) * count, group[name].shape)
        edges, start, shape = (np.array([each[axis] for axis in where]) for each in stated)
        common, factors = common_unit([place["units"][axis] for axis in where] if place["units"] else [None] * 3)
        unit, factor = parse_unit(common)
        similar = np.allclose(np.array(field.spacing) / factor, edges * factors, rtol=1e-3, atol=0)
        first = (np.array(base.first_voxel(field)) / factor / factors - start) / edges
        if unit == field.unit and similar and (first > -0.01).all() and (first + field.shape < shape + 0.01).all():
            return
    size = format_sampling(field.shape, field.spacing, field.unit)
    raise ScanError(f"labels must have the voxels of a level of {image} or of a part of one, got {size}")


@hold_signals()
def add_labels(written: Path, image: Path, name: str) -> Path:
    """Move written labels into an image, under a name, list them there, and return where they are."""
    import zarr

    folder = image / "labels"
    folder.mkdir(exist_ok=True)
    target = move_into_place(written, folder / name)
    version, old = version_of(image), (image / ".zgroup").exists()
    place = folder / (".zattrs" if old else "zarr.json")
    content = json.loads(place.read_text(encoding="utf-8")) if place.exists() else {}
    if old:
        listed = content
    else:
        content = {"zarr_format": 3, "node_type": "group", "attributes": {}, **content}
        listed = content["attributes"].setdefault("ome", {"version": version})
    if name not in listed.setdefault("labels", []):
        listed["labels"].append(name)
        write_content(place, json.dumps(content, indent=2))
    if old and not (folder / ".zgroup").exists():
        write_content(folder / ".zgroup", json.dumps({"zarr_format": 2}))
    root = store_of(image)
    if (root / ".zmetadata").exists() or zarr.open_group(root, mode="r").metadata.consolidated_metadata is not None:
        with warnings.catch_warnings():  # that format 3 does not specify what this store has
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(root)
    return target


def version_of(image: Path) -> str | None:
    """Return the version of OME-Zarr of an image; None if a group is none."""
    import zarr

    attributes: Any = zarr.open_group(image, mode="r").attrs.asdict()
    scales = attributes.get("ome", attributes).get("multiscales")
    if not scales:
        return None
    return str(attributes.get("ome", {}).get("version") or scales[0].get("version") or "0.4")


@hold_signals()
def mark(folder: Path, kind: str) -> None:
    """Mark a group, in its attributes, as written by this program, with its kind."""
    import zarr

    zarr.open_group(folder, mode="r+").attrs[MARK] = {"kind": kind}


def _levels(name: str, attributes: Mapping[str, Any]) -> dict[str, _Place]:
    """Return the place of each level of an OME-Zarr image, by the level's path."""
    ome = attributes.get("ome", attributes)
    images = ome.get("multiscales") or [{}]
    image, systems = images[0], {each["name"]: each["axes"] for each in images[0].get("coordinateSystems", [])}
    notes = (f"The group holds {len(images)} images: the first is used.",) if len(images) > 1 else ()
    version = str(ome.get("version") or image.get("version") or "0.4")
    notes += () if re.match(r"0\.[1-6]\b", version) else (f"It is of OME-Zarr {version}, and read as of 0.6.",)
    places: dict[str, _Place] = {}
    for level in image.get("datasets", []):
        steps = list(level.get("coordinateTransformations", []))
        listed = image.get("axes") or systems.get(steps[0].get("output") if steps else "") or []
        # Those of all levels come after those of one; with systems of coordinates they lead to others than the first.
        steps += [] if systems else image.get("coordinateTransformations", [])
        axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in listed]
        names = [str(axis["type"] if axis.get("type") in ("channel", "time") else axis.get("name")) for axis in axes]
        place = {"axes": base.name_axes(names), "units": [axis.get("unit") for axis in axes], "notes": notes}
        places[f"{name}/{level['path']}".strip("/")] = place | _place_of(steps, place["axes"])
    return places


def _place_of(transforms: Sequence[Mapping[str, Any]], axes: str) -> _Place:
    """Return steps and origin, or steps and affine, that transforms of indices state.

    Of one that is not known the unit says so: it is refused unless the caller states spacing and unit.
    """
    lengths = [len(value) for step in transforms if isinstance(value := step.get(str(step.get("type"))), list)]
    n = len(axes) or max(lengths, default=0)
    matrix = _compose(transforms, n)
    if isinstance(matrix, str):
        return {"steps": None, "units": (f"coordinates of a transform {matrix}",) * n}
    if not any(step.get("type") != "translation" for step in transforms):
        return {"steps": None, "origin": matrix[:n, n].tolist() if transforms else None}
    linear = matrix[:n, :n]
    steps, space = np.linalg.norm(linear, axis=0), [axes.index(axis) for axis in "xyz" if axis in axes]
    if np.array_equal(linear, np.diag(steps)):
        return {"steps": steps.tolist(), "origin": matrix[:n, n].tolist() if matrix[:n, n].any() else None}
    if len(space) < 3 or np.count_nonzero(linear) != n - 3 + np.count_nonzero(linear[np.ix_(space, space)]):
        return {"steps": None, "units": ("coordinates of a transform of axes that are not of space",) * n}
    return {"steps": steps.tolist(), "affine": base.affine_of(linear[np.ix_(space, space)], matrix[space, n])}


def _compose(transforms: Sequence[Mapping[str, Any]], n: int) -> np.ndarray | str:
    """Return the matrix (n + 1, n + 1) of transforms one after the other, or the type of one that is not known."""
    matrix = np.eye(n + 1)
    for step in transforms:
        kind, part = str(step.get("type")), np.eye(n + 1)
        value: Any = step.get({"sequence": "transformations"}.get(kind, kind))
        if kind == "identity":
            continue
        if kind not in ("scale", "translation", "affine", "rotation", "mapAxis", "sequence") or value is None:
            return repr(kind)
        if kind == "scale":
            part[:n, :n] = np.diag(np.array(value, dtype=np.float64))
        elif kind == "translation":
            part[:n, n] = value
        elif kind == "affine":
            part[:n] = value
        elif kind == "sequence":
            inner = _compose(value, n)
            if isinstance(inner, str):
                return inner
            part = inner
        else:
            part[:n, :n] = value if kind == "rotation" else np.eye(n)[value]
        matrix = part @ matrix
    return matrix


def _check_levels(arrays: Mapping[str, Any], places: Mapping[str, _Place], path: Path) -> None:
    """Raise ScanError where levels of an image are missing, or differ in extent by more than one of their voxels."""
    extents: dict[str, np.ndarray] = {}
    for name, place in places.items():
        if name not in arrays:
            raise ScanError(f"{path} lists the level {name}, which is not there: name another, as in {path}::0")
        if place["steps"] is None or len(place["steps"]) != arrays[name].ndim:
            continue
        extents[name] = np.array(place["steps"]) * arrays[name].shape
        first = next(iter(extents))
        if (np.abs(extents[name] - extents[first]) > 1.01 * np.array(place["steps"])).any():
            sizes = (" x ".join(f"{edge:g}" for edge in extents[each]) for each in (first, name))
            listed = " and ".join(f"{size} of {each}" for size, each in zip(sizes, (first, name), strict=True))
            raise ScanError(f"the levels of {path} disagree in extent, {listed}: name one, as in {path}::{first}")


# ---- chunks that are not stored --------------------------------------------------------------------------------------


def _check_store(folder: Path) -> None:
    """Raise ScanError where something in a store is neither file nor folder, or a link leads to a folder above it."""
    for place, folders, files in os.walk(folder):
        for name in folders:
            path = Path(place, name)
            if path.is_symlink() and Path(os.path.realpath(place)).is_relative_to(path.resolve()):
                raise ScanError(f"the link {path} in a Zarr store leads back to a folder above it")
        for name in files:
            path = Path(place, name)
            if path.exists() and not path.is_file():
                raise ScanError(f"{path} in a Zarr store is no file")


def _missing_chunks(array: Any, folder: Path) -> tuple[str, ...]:
    """Return a sentence on the chunks that are not stored; Zarr's `nchunks_initialized` does not look into shards."""
    outer, chunks = array.shards or array.chunks, math.prod(_counts(array.shape, array.chunks))
    if chunks > _MOST:
        raise ScanError(f"a Zarr array may have at most {_MOST:,} chunks, got {chunks:,} in {folder}")
    missing, blosc = chunks, "blosc" in type(array.compressors[-1] if array.compressors else None).__name__.lower()
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        place = tuple(map(int, re.findall(r"\d+", name)))
        if len(place) != array.ndim or array.metadata.encode_chunk_key(place) != name or not path.is_file():
            continue
        rest = [min(edge, n - k * edge) for n, edge, k in zip(array.shape, outer, place, strict=True)]
        if min(rest, default=1) <= 0:  # a chunk beyond the array, which may have been larger once
            continue
        inside = _counts(rest, array.chunks)
        missing -= math.prod(inside)
        if array.shards:
            missing += _missing_within(array, path, inside)
        elif blosc:
            _check_blosc(path)
    note = f"{missing} of {chunks} chunks are not stored: their voxels have the fill value {array.fill_value}."
    return (note,) if missing else ()


def _check_blosc(chunk: Path) -> None:
    """Raise Damaged where a chunk's size is not the one in its header; Blosc does not compare them."""
    with chunk.open("rb") as stream:
        nbytes = int.from_bytes(stream.read(16)[12:], "little")
    if nbytes != (size := chunk.stat().st_size):
        raise base.Damaged(f"{nbytes} bytes by the header of chunk {chunk.name}, {size} in the file")


def _counts(shape: Sequence[int], edges: Sequence[int]) -> list[int]:
    """Return how many pieces of these edges cover each axis."""
    return [-(-n // edge) if edge else 0 for n, edge in zip(shape, edges, strict=True)]


def _missing_within(array: Any, shard: Path, inside: Sequence[int]) -> int:
    """Return how many chunks a shard's index, if of the usual kind, lacks of those `inside` the array."""
    codec: Any = next((codec for codec in array.metadata.codecs if hasattr(codec, "index_codecs")), None)
    if [type(each).__name__ for each in getattr(codec, "index_codecs", ())] != ["BytesCodec", "Crc32cCodec"]:
        return 0
    counts = _counts(array.shards, array.chunks)
    size = _ENTRY * math.prod(counts)
    with shard.open("rb") as stream:
        if str(getattr(codec.index_location, "value", codec.index_location)) == "end":
            stream.seek(max(0, shard.stat().st_size - size - _CHECKSUM))
        index = stream.read(size)
    if len(index) < size:
        return 0  # reading it says what is wrong
    absent = (np.frombuffer(index, "<u8").reshape(*counts, 2) == _ABSENT).all(-1)
    return int(absent[tuple(slice(n) for n in inside)].sum())
