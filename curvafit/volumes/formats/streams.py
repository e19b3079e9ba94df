"""Reading the numbers of a file to its last byte: their count is checked, and with it what a compressed stream says."""

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

from curvafit.machine import memory
from curvafit.volumes.formats.base import Damaged, ScanError

#: Bytes that are read at once.
_PIECE = 1 << 22
#: What a compressed file begins with -> what opens it.
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2"}


def read_numbers(stream: Any, shape: Sequence[int], dtype: np.dtype, place: object) -> np.ndarray:
    """Read an array, last axis fastest, and make sure that the stream ends with it.

    At its end a gzip, bzip2 or zip stream compares its checksum, which no reader of the first bytes alone would reach.

    Raises
    ------
    ScanError
        If the array fits into no memory.
    Damaged, OSError, EOFError, zlib.error, zipfile.BadZipFile
        If the stream is shorter, longer or damaged.
    """
    check_array(shape, dtype, place)
    values = np.empty(math.prod(shape), dtype)
    room, done = values.view(np.uint8).data if values.nbytes else memoryview(b""), 0
    while done < values.nbytes and (count := stream.readinto(room[done : done + _PIECE])):
        done += count
    if done < values.nbytes or stream.read(1):
        held = done if done < values.nbytes else "more"
        raise Damaged(f"{values.nbytes} bytes of values by its header, {held} in the file")
    return values.reshape(tuple(shape))


def mapped(path: Path, start: int, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """Return the array, last axis fastest, that a file holds from a byte to its end, without reading it.

    Raises
    ------
    ScanError
        If its type is none of numbers.
    Damaged
        If the file is shorter or longer.
    """
    check_array([0], dtype, path)
    wanted, held = math.prod(shape) * dtype.itemsize, path.stat().st_size - start
    if wanted != held:
        raise Damaged(f"{wanted} bytes of values by its header, {held} in the file")
    return np.memmap(path, dtype, "r", start, tuple(shape)) if wanted else np.empty(tuple(shape), dtype)


def check_array(shape: Sequence[int], dtype: np.dtype, place: object) -> None:
    """Refuse an array of a header before there is room made for it.

    Raises
    ------
    ScanError
        If the type is of objects or records, an axis is negative or the array larger than the machine's memory.
    """
    if dtype.kind in "OV":
        raise ScanError(f"expected numbers, got values of type {str(dtype)[:80]} in {place}")
    wanted = math.prod(int(n) for n in shape) * dtype.itemsize
    if min(shape, default=1) < 0:
        raise ScanError(f"expected a shape of positive whole numbers, got {tuple(shape)} in {place}")
    if wanted > memory():
        raise ScanError(f"expected a volume that fits into memory, got {wanted:.3g} bytes by the header of {place}")


def check_regular(path: Path) -> Path:
    """The path, if it is of a file or a folder: what else there is may never end.

    Raises
    ------
    ScanError
        If it is a pipe, a socket or a device.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ScanError(f"expected a file or a folder, got {path}, which is neither")
    return path


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A file's stream of bytes, decompressed where it begins as gzip's or bzip2's do."""
    with path.open("rb") as file:
        start = file.read(3)
        file.seek(0)
        kind = next((kind for mark, kind in _COMPRESSED.items() if start.startswith(mark)), "raw")
        yield decompressed(file, kind)


def skip(stream: Any, count: int) -> None:
    """Read and forget so many bytes, which fewer end quietly."""
    while count > 0 and (piece := stream.read(min(count, _PIECE))):
        count -= len(piece)


def decompressed(stream: IO[bytes], encoding: str) -> Any:
    """The bytes of the rest of a stream in `"gzip"`, `"bzip2"`, `"zlib"` or `"raw"`."""
    if encoding == "zlib":
        return io.BufferedReader(_Inflated(stream))
    several: dict[str, Any] = {"gzip": lambda: gzip.GzipFile(fileobj=stream), "bzip2": lambda: bz2.BZ2File(stream)}
    return several[encoding]() if encoding in several else stream


class _Inflated(io.RawIOBase):
    """The bytes of one zlib stream; at its end its checksum counts, and nothing may follow."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._inflate = stream, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any, /) -> int:
        while not self._inflate.eof:
            if piece := self._inflate.decompress(self._given(), len(room)):
                room[: len(piece)] = piece
                return len(piece)
        if self._inflate.unused_data or self._stream.read(1):
            raise Damaged("bytes follow the compressed stream")
        return 0

    def _given(self) -> bytes:
        """What is to be decompressed next."""
        given = self._inflate.unconsumed_tail or self._stream.read(1 << 16)
        if not given:
            raise Damaged("the compressed stream ends too early")
        return given
