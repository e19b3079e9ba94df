"""Zarr: reading of bare arrays, groups and OME-Zarr; writing of OME-NGFF 0.5."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.records import MARK
from curvafit.core.runtime import hold_signals
from curvafit.volumes.formats.base import Damaged, Raw, ScanError, pick_key, read_spacing
from curvafit.volumes.formats.part import Part, index_of, read_part

#: Edge of a chunk, and of the largest volume that is not halved any more, in voxels.
CHUNK = 64
#: Chunks of an array at most; more would take hours to read.
_MOST = 10_000_000
#: Spacing along all axes, unit and axis of channels of an array, each where it is known.
_Place = tuple[tuple[Any, ...] | None, Any, int | None]
#: Our unit -> OME-NGFF's, which has none for the voxel.
_UNITS = {"nm": "nanometer", "um": "micrometer", "mm": "millimeter", "m": "meter"}


def read_zarr(path: Path, *, key: str | None = None, part: Part | None = None, **_: object) -> Raw:
    """Read an array, or one array of a group, with spacing and unit of its attributes or of OME-Zarr's multiscales."""
    import zarr

    _check_store(path)
    node: Any = zarr.open(path, mode="r")
    if isinstance(node, zarr.Array):
        return _read_array(node, path, (*read_spacing(node.attrs.asdict(), node.ndim), None), part)
    arrays = {name: member for name, member in node.members(max_depth=None) if isinstance(member, zarr.Array)}
    attributes = node.attrs.asdict()
    scales = _multiscales(attributes)
    if key is None and scales:
        key = next(iter(scales))
    name = pick_key(sorted(arrays), key, path)
    array = arrays[name]
    place = scales.get(name) or (*read_spacing({**attributes, **array.attrs.asdict()}, array.ndim), None)
    return _read_array(array, path / array.path, place, part)


def _read_array(array: Any, folder: Path, place: _Place, part: Part | None) -> Raw:
    """Return the values of an array in a folder, with a sentence on chunks that are not stored."""
    spacing, unit, channels = place
    index_of(array, part, folder, channels)  # before chunks are counted: a header may claim any number of them
    gaps = _missing_chunks(array, folder)
    return read_part(array, part, folder, channels)._replace(spacing=spacing, unit=unit, gaps=gaps)


def write_zarr(field: Any, path: Path) -> None:
    """Write an OME-NGFF 0.5 group of one image: the volume as `0`, halved copies as `1`, `2` … down to one chunk."""
    import zarr

    levels = list(_halvings(np.asarray(field.values)))
    # A mean of 2ᵏ voxels along an axis lies (2ᵏ - 1) / 2 voxels behind the first one's centre; a picked voxel does not.
    shift = 0.5 if field.values.dtype.kind == "f" else 0.0
    kind = {"type": "space", **({"unit": _UNITS[field.unit]} if field.unit in _UNITS else {})}
    datasets = []
    for k in range(len(levels)):
        transforms = [{"type": "scale", "scale": [2**k * h for h in field.spacing]}]
        if shift and k:
            transforms += [{"type": "translation", "translation": [shift * (2**k - 1) * h for h in field.spacing]}]
        datasets.append({"path": str(k), "coordinateTransformations": transforms})
    image = {"name": "volume", "axes": [{"name": name, **kind} for name in "zyx"], "datasets": datasets}
    with hold_signals():  # Zarr's own threads would go on to write while the folder is deleted
        group = zarr.create_group(path, attributes={"ome": {"version": "0.5", "multiscales": [image]}})
        for k, values in enumerate(levels):
            group.create_array(
                str(k),
                data=values,
                chunks=tuple(min(CHUNK, n) for n in values.shape),
                dimension_names=("z", "y", "x"),
                config={"write_empty_chunks": True},  # so that a chunk that is not there is one that was lost
            )


@hold_signals()
def mark(folder: Path, kind: str) -> None:
    """Mark a group, in its attributes, as written by this program, with its kind."""
    import zarr

    zarr.open_group(folder, mode="r+").attrs[MARK] = {"kind": kind}


def _halvings(values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the volume and its halved copies, down to one chunk.

    Floats are means of 2³ voxels (the last voxels count twice where the number is odd). Whole numbers, which may be
    labels, are every second value.
    """
    yield values
    while max(values.shape) > CHUNK:
        if values.dtype.kind == "f":
            even = np.pad(values, [(0, n % 2) for n in values.shape], mode="edge")
            nz, ny, nx = (n // 2 for n in even.shape)
            values = even.reshape(nz, 2, ny, 2, nx, 2).mean((1, 3, 5), dtype=np.float32).astype(values.dtype)
        else:
            values = values[::2, ::2, ::2]
        yield values


def _multiscales(attributes: Mapping[str, Any]) -> dict[str, _Place]:
    """Return the place of each level of an OME-Zarr image, by the level's path; the unit is that of the last axis."""
    image = next(iter(attributes.get("ome", attributes).get("multiscales") or []), {})
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", [])]
    unit = axes[-1].get("unit") if axes else None
    channels = next((k for k, axis in enumerate(axes) if axis.get("type", axis.get("name")) in ("channel", "c")), None)
    places: dict[str, _Place] = {}
    for level in image.get("datasets", []):
        scales = [t["scale"] for t in level.get("coordinateTransformations", []) if t.get("type") == "scale"]
        places[level["path"]] = (tuple(float(h) for h in scales[0]) if scales else None, unit, channels)
    return places


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
    """Return a sentence on the chunks of an array that are not stored, if there are any.

    Zarr's own `nchunks_initialized` does not look into shards.
    """
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
    fill = f"their voxels have the fill value {array.fill_value}."
    return (f"{missing} of {chunks} chunks are not stored: {fill}",) if missing else ()


def _check_blosc(chunk: Path) -> None:
    """Raise Damaged where a chunk's size is not the one in its header; Blosc does not compare them."""
    with chunk.open("rb") as stream:
        nbytes = int.from_bytes(stream.read(16)[12:], "little")
    if nbytes != (size := chunk.stat().st_size):
        raise Damaged(f"{nbytes} bytes by the header of chunk {chunk.name}, {size} in the file")


def _counts(shape: Sequence[int], edges: Sequence[int]) -> list[int]:
    """Return how many pieces of these edges cover each axis."""
    return [-(-n // edge) if edge else 0 for n, edge in zip(shape, edges, strict=True)]


def _missing_within(array: Any, shard: Path, inside: Sequence[int]) -> int:
    """Return how many chunks a shard's index lacks, of those `inside` the array.

    An index of another kind than the usual one (little-endian, then a CRC32C) is not looked at.
    """
    codec: Any = next((each for each in array.metadata.codecs if hasattr(each, "index_codecs")), None)
    if [type(each).__name__ for each in getattr(codec, "index_codecs", ())] != ["BytesCodec", "Crc32cCodec"]:
        return 0
    counts = _counts(array.shards, array.chunks)
    size = 16 * math.prod(counts)
    with shard.open("rb") as stream:
        if str(getattr(codec.index_location, "value", codec.index_location)) == "end":
            stream.seek(max(0, shard.stat().st_size - size - 4))
        index = stream.read(size)
    if len(index) < size:
        return 0  # reading it says what is wrong
    absent = (np.frombuffer(index, "<u8").reshape(*counts, 2) == 2**64 - 1).all(-1)
    return int(absent[tuple(slice(n) for n in inside)].sum())
