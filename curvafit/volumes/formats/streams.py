"""Reading the numbers of a file to its last byte, which checks their count and the checksum of a compressed stream."""

from __future__ import annotations

import bz2
import gzip
import io
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.core import records
from curvafit.core.runtime import memory
from curvafit.volumes.formats.base import Damaged, ScanError

#: Bytes of one read.
_PIECE = 1 << 22
#: First bytes of a compressed file -> its encoding.
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2"}


def read_numbers(stream: Any, shape: Sequence[int], dtype: np.dtype, place: object) -> np.ndarray:
    """Return the array of a stream, as `records.read_numbers` does.

    Raises
    ------
    ScanError
        If the array does not fit into memory.
    """
    check_array(shape, dtype, place)
    return records.read_numbers(stream, shape, dtype)


def mapped(path: Path, start: int, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """Return the array, last axis fastest, from a byte of a file to its end, mapped rather than read.

    Raises
    ------
    ScanError
        If the values are not numbers.
    Damaged
        If the file is shorter or longer.
    """
    check_array([0], dtype, path)
    nbytes, size = math.prod(shape) * dtype.itemsize, path.stat().st_size - start
    if nbytes != size:
        raise Damaged(f"{nbytes} bytes of values by its header, {size} in the file")
    return np.memmap(path, dtype, "r", start, tuple(shape)) if size else np.empty(tuple(shape), dtype)


def check_array(shape: Sequence[int], dtype: np.dtype, place: object) -> None:
    """Raise ScanError where the array of a header cannot be read, before memory is allocated.

    Raises
    ------
    ScanError
        If the type is one of objects or records, an axis is negative, or the array is larger than the machine's
        memory.
    """
    if dtype.kind in "OV":
        raise ScanError(f"expected numbers, got values of type {str(dtype)[:80]} in {place}")
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if min(shape, default=1) < 0:
        raise ScanError(f"expected a shape of positive whole numbers, got {tuple(shape)} in {place}")
    if size > memory():
        raise ScanError(f"expected a volume that fits into memory, got {size:.3g} bytes by the header of {place}")


def check_regular(path: Path) -> Path:
    """Return the path of a file or a folder, or raise ScanError: reading anything else may never end.

    Raises
    ------
    ScanError
        If the path is a pipe, a socket or a device.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ScanError(f"expected a file or a folder, got {path}, which is neither")
    return path


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file as a stream of bytes, decompressed if its first bytes are those of gzip or bzip2."""
    with path.open("rb") as file:
        start = file.read(3)
        file.seek(0)
        kind = next((kind for mark, kind in _COMPRESSED.items() if start.startswith(mark)), "raw")
        yield decompressed(file, kind)


def skip(stream: Any, count: int) -> None:
    """Read and forget `count` bytes, or all where there are fewer."""
    while count > 0 and (piece := stream.read(min(count, _PIECE))):
        count -= len(piece)


def decompressed(stream: IO[bytes], encoding: str) -> Any:
    """Return a stream of the decompressed rest of one in `"gzip"`, `"bzip2"`, `"zlib"` or `"raw"`."""
    if encoding == "zlib":
        return io.BufferedReader(_Inflated(stream))
    several: dict[str, Any] = {"gzip": lambda: gzip.GzipFile(fileobj=stream), "bzip2": lambda: bz2.BZ2File(stream)}
    return several[encoding]() if encoding in several else stream


class _Inflated(io.RawIOBase):
    """The bytes of one zlib stream, whose checksum is compared at its end; nothing may follow."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._inflate = stream, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any, /) -> int:
        while not self._inflate.eof:
            if piece := self._inflate.decompress(self._input(), len(room)):
                room[: len(piece)] = piece
                return len(piece)
        if self._inflate.unused_data or self._stream.read(1):
            raise Damaged("bytes follow the compressed stream")
        return 0

    def _input(self) -> bytes:
        """Return the next compressed bytes."""
        compressed = self._inflate.unconsumed_tail or self._stream.read(1 << 16)
        if not compressed:
            raise Damaged("the compressed stream ends too early")
        return compressed
