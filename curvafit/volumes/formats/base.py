"""What every reader shares: its result and errors, a library's complaints, keys, attributes, and a file's numbers."""

from __future__ import annotations

import logging
import math
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.runtime import memory, one_line

#: Bytes of one read.
_PIECE = 1 << 22


class ScanError(ValueError):
    """A volume that cannot be used; the message is one sentence on one line."""

    def __init__(self, sentence: str) -> None:
        super().__init__(one_line(sentence))


class Damaged(Exception):
    """A fault of a file; `read_file` makes a sentence of it that names the file."""


class Axes(NamedTuple):
    """The axes of channels and of times of a file's array, where the file names them."""

    channel: int | None = None
    time: int | None = None


#: No axis has a name.
UNNAMED = Axes()


class Raw(NamedTuple):
    """The content of a file: an array with z first, and spacing, unit and affine where the file states them.

    `spacing` has one number per axis of `values`, or three for (z, y, x). `guesses` are sentences on a spacing or unit
    that the file does not state; they do not hold where the caller states them. `gaps` are sentences on values that the
    file lacks and that were filled in. `axes` are those of channels and times. Where `values` are only a part of the
    file's array, `whole` is the shape of the array, which has as many axes.
    """

    values: np.ndarray
    spacing: tuple[float, ...] | None = None
    unit: str | None = None
    affine: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    axes: Axes = UNNAMED
    whole: tuple[int, ...] | None = None


@contextmanager
def collect_complaints(logger: str | None = None) -> Iterator[list[str]]:
    """Collect what a library logs in this thread, so that nothing is printed, and silence warnings."""
    messages: list[str] = []
    thread, source = threading.get_ident(), logging.getLogger(logger or __name__)
    level = source.level

    def collect(record: logging.LogRecord) -> bool:
        if record.thread == thread:
            messages.append(one_line(record.getMessage()))
        return record.thread != thread

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source.addFilter(collect)
        if not source.isEnabledFor(logging.WARNING):
            source.setLevel(logging.WARNING)
        try:
            yield messages
        finally:
            source.setLevel(level)
            source.removeFilter(collect)


def pick_key(keys: list[str], key: str | None, path: object) -> str:
    """Return the key, by default the only one, or raise ScanError with a list of the keys."""
    listed = ", ".join(name[:80] for name in keys[:20]) + (", …" if len(keys) > 20 else "")
    if key is None:
        if len(keys) == 1:
            return keys[0]
        raise ScanError(f"{path} needs a key, as in {path}::KEY; it has {listed or 'no arrays'}")
    name = key if key in keys else key.strip("/")
    if name not in keys:
        raise ScanError(f"{path} has no key {quoted(key)}; it has {listed or 'no arrays'}")
    return name


def read_spacing(attributes: Mapping[str, Any], ndim: int) -> tuple[tuple[Any, ...] | None, Any]:
    """Return spacing and unit from an array's attributes, unchecked; one number counts for all axes."""
    for name, fixed_unit in (("element_size_um", "um"), ("spacing", None), ("voxel_size", None)):
        if name in attributes:
            sizes = _entries(attributes[name])
            unit = fixed_unit or next(iter(_entries(attributes.get("unit", attributes.get("units")))), None)
            return sizes * ndim if len(sizes) == 1 else sizes, unit
    return None, None


def _entries(value: Any) -> tuple[Any, ...]:
    """Return the first entries of an attribute as a tuple, bytes as text."""
    array = np.asarray(value, dtype=object) if isinstance(value, list | tuple) else np.asarray(value)
    entries = array.ravel()[:99].tolist()
    return tuple(each.decode(errors="replace") if isinstance(each, bytes) else each for each in entries)


# ---- numbers of a file -----------------------------------------------------------------------------------------------


def read_numbers(stream: Any, shape: Sequence[int], dtype: np.dtype, place: object) -> np.ndarray:
    """Return the array of a stream, last axis fastest. The stream must end with it: its checksum is compared there."""
    check_array(shape, dtype, place)
    values = np.empty(math.prod(shape), dtype)
    buffer, size = values.view(np.uint8).data, 0
    while size < values.nbytes and (count := stream.readinto(buffer[size : size + _PIECE])):
        size += count
    if size < values.nbytes or stream.read(1):
        held = size if size < values.nbytes else "more"
        raise Damaged(f"{values.nbytes} bytes of values by its header, {held} in the file")
    return values.reshape(shape)


def smallest_type(values: np.ndarray) -> np.dtype:
    """Return the smallest type of whole numbers that holds those of an array."""
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    kinds = map(np.dtype, ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64"))
    return next((kind for kind in kinds if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max), np.dtype("int64"))


def map_numbers(path: Path, start: int, shape: Sequence[int], dtype: np.dtype, tail: bool = False) -> np.ndarray:
    """Map the array, last axis fastest, that fills a file from the byte `start` to the end, or to a `tail`."""
    nbytes, size = math.prod(shape) * dtype.itemsize, path.stat().st_size - start
    if nbytes > size or (nbytes < size and not tail):
        raise Damaged(f"{nbytes} bytes of values by its header, {size} in the file")
    return np.memmap(path, dtype, "r", start, tuple(shape)) if nbytes else np.empty(tuple(shape), dtype)


def check_array(shape: Sequence[int], dtype: np.dtype, place: object) -> None:
    """Raise ScanError if an array does not hold numbers or fit into memory; call it before memory is allocated."""
    if dtype.kind in "OV":
        raise ScanError(f"a volume must hold numbers, got values of type {str(dtype)[:80]} in {place}")
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if min(shape, default=1) < 0:
        raise ScanError(f"a shape must be positive, got {tuple(shape)} in {place}")
    if size > memory():
        raise ScanError(f"{place} does not fit into memory: its header says {size:.3g} bytes")


def affine_of(matrix: np.ndarray, first: Any) -> np.ndarray:
    """Return the affine of axes (3, 3), x first, and the place of the first voxel."""
    return np.vstack([np.column_stack([matrix, first]), [0.0, 0.0, 0.0, 1.0]])


def check_regular(path: Path) -> Path:
    """Return the path of a file or a folder, or raise ScanError: reading anything else may never end."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ScanError(f"{path} is neither a file nor a folder")
    return path
