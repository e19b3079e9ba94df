"""Chunks of a Zarr array that are not stored: Zarr fills them with the fill value without a word."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.volumes.formats.base import Damaged, ScanError

#: Chunks of an array at most; more would take hours to look for.
_MOST = 10_000_000
#: Entry of a shard's index for a chunk that is not in the shard.
_ABSENT = np.uint64(2**64 - 1)


def check_store(folder: Path) -> None:
    """Raise ScanError where something in a store is neither file nor folder, or a link leads to a folder above it."""
    for place, folders, files in os.walk(folder):
        for name in folders:
            path = Path(place, name)
            if path.is_symlink() and Path(os.path.realpath(place)).is_relative_to(path.resolve()):
                raise ScanError(f"expected a Zarr store, got one whose link {path} leads back to a folder above it")
        for name in files:
            path = Path(place, name)
            if path.exists() and not path.is_file():
                raise ScanError(f"expected files in a Zarr store, got {path}, which is none")


def missing_chunks(array: Any, folder: Path) -> tuple[str, ...]:
    """Return a sentence on the chunks of an array that are not stored, within shards too, or none.

    Raises
    ------
    ScanError
        If the array has more than 10 million chunks.
    """
    outer = array.shards or array.chunks
    counts, chunks = _counts(array.shape, outer), math.prod(_counts(array.shape, array.chunks))
    if chunks > _MOST:
        raise ScanError(f"expected at most {_MOST:,} chunks in a Zarr array, got {chunks:,} in {folder}")
    missing, blosc = 0, "blosc" in type(array.compressors[-1] if array.compressors else None).__name__.lower()
    for place in itertools.product(*map(range, counts)):
        path = folder / array.metadata.encode_chunk_key(place)
        rest = [min(edge, n - k * edge) for n, edge, k in zip(array.shape, outer, place, strict=True)]
        inside = _counts(rest, array.chunks)
        if not path.is_file():
            missing += math.prod(inside)
        elif array.shards:
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
    """Count the chunks `inside` the array that a shard's index lacks.

    An index of another kind than the usual one (little-endian, then a CRC32C) counts 0.
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
    absent = (np.frombuffer(index, "<u8").reshape(*counts, 2) == _ABSENT).all(-1)
    return int(absent[tuple(slice(n) for n in inside)].sum())
