"""What every reader shares: what a file states, errors, a library's complaints, keys, attributes, numbers."""

from __future__ import annotations

import logging
import math
import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.runtime import memory, one_line

#: From DICOM's and ITK's patient frame (left, posterior, superior) to NIfTI's (right, anterior, superior).
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: Names of attributes that look like a spacing.
SPACING = re.compile("spacing|resolution|(voxel|pixel|element)_?size", re.IGNORECASE)
#: What is assumed of slices whose distance a file does not state.
NO_DISTANCE = "The file states no distance of slices: it is taken as the pixel's."
#: Bytes of one read.
_PIECE = 1 << 22


class ScanError(ValueError):
    """A volume that cannot be used; the message is one sentence on one line."""

    def __init__(self, sentence: str) -> None:
        super().__init__(one_line(sentence))


class Damaged(Exception):
    """A fault of a file; `read_file` makes a sentence of it that names the file."""


class Stated(NamedTuple):
    """What a file states of a volume, and nothing more.

    Attributes
    ----------
    array
        The values as the file means them: an array, or an object with `shape`, `dtype` and `array[index]`, which reads.
    axes
        A letter for each axis of the array: z, y, x; t (times), c (channels), s (samples of a colour); or `?` where the
        file names none.
    steps, units
        The distance of voxels along each axis and the unit it is in, or along z, y and x if there are three; None where
        the file does not say.
    origin
        Where the first voxel lies, as `steps`; None where the file does not say, or has an affine.
    affine
        4x4 map from index (x, y, z, 1) to the world, right, anterior, superior, in the unit of x.
    custom
        The unit that the format implies for steps without one.
    notes, guesses, gaps
        Sentences: on what was done; on a spacing or unit that the file does not state, which do not hold where the
        caller states them; on values that the file lacks and that were filled in.
    """

    array: Any
    axes: str
    steps: Sequence[Any] | None = None
    units: Sequence[Any] = (None, None, None)
    origin: Sequence[float] | None = None
    affine: np.ndarray | None = None
    custom: str = "voxel"
    notes: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()


@contextmanager
def collect_complaints(logger: str | None = None) -> Iterator[list[str]]:
    """Collect what a library logs in this thread, so that nothing is printed, and silence warnings."""
    messages: list[str] = []
    thread, library = threading.get_ident(), logging.getLogger(logger or __name__)
    level = library.level

    def collect(record: logging.LogRecord) -> bool:
        if record.thread == thread:
            messages.append(one_line(record.getMessage()))
        return record.thread != thread

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        library.addFilter(collect)
        if not library.isEnabledFor(logging.WARNING):  # a disabled logger calls no filter
            library.setLevel(logging.WARNING)
        try:
            yield messages
        finally:
            library.setLevel(level)
            library.removeFilter(collect)


def pick_key(keys: list[str], key: str | None, path: object) -> str:
    """Return the one of `keys` that `key` names, by default the only one, or raise ScanError with a list of them."""
    listed = ", ".join(name[:80] for name in keys[:20]) + (", …" if len(keys) > 20 else "")
    if key is None:
        if len(keys) == 1:
            return keys[0]
        raise ScanError(f"{path} needs a key, as in {path}::KEY; it has {listed or 'no arrays'}")
    name = key if key in keys else key.strip("/")
    if name not in keys:
        raise ScanError(f"{path} has no key {quoted(key)}; it has {listed or 'no arrays'}")
    return name


def read_spacing(attributes: Mapping[str, Any], ndim: int) -> dict[str, Any]:
    """Return steps, units and origin from an array's attributes, unchecked; one number counts for all axes.

    `resolution` and `offset` are CREMI's. A note names what looks like a spacing and is not used.
    """
    names = ("element_size_um", "spacing", "voxel_size", "resolution")
    used = next((name for name in names if name in attributes), "")
    unused = [name for name in attributes if SPACING.search(name) and name != used]
    notes = (f"It has {', '.join(unused)[:200]}, which is not used.",) if unused else ()
    if not used:
        return {"notes": notes}
    sizes = _entries(attributes[used])
    unit = "um" if used == "element_size_um" else None
    unit = unit or next(iter(_entries(attributes.get("unit", attributes.get("units")))), None)
    sizes = sizes * ndim if len(sizes) == 1 else sizes
    geometry: dict[str, Any] = {"steps": sizes, "units": (unit,) * len(sizes), "notes": notes}
    return geometry | ({"origin": _entries(attributes["offset"])} if "offset" in attributes else {})


def _entries(value: Any) -> tuple[Any, ...]:
    """Return the first entries of an attribute as a tuple, bytes as text."""
    array = np.asarray(value, dtype=object) if isinstance(value, list | tuple) else np.asarray(value)
    entries = array.ravel()[:99].tolist()
    return tuple(entry.decode(errors="replace") if isinstance(entry, bytes) else entry for entry in entries)


# ---- numbers of a file -----------------------------------------------------------------------------------------------


def read_numbers(stream: Any, shape: Sequence[int], dtype: np.dtype, place: object) -> np.ndarray:
    """Read an array, last axis fastest, that fills the rest of a stream; raise Damaged where the lengths differ."""
    check_array(shape, dtype, place)
    values = np.empty(math.prod(shape), dtype)
    buffer, filled = values.view(np.uint8).data, 0
    while filled < values.nbytes and (count := stream.readinto(buffer[filled : filled + _PIECE])):
        filled += count
    if filled < values.nbytes or stream.read(1):  # at its end a compressed stream compares its checksum
        actual = filled if filled < values.nbytes else "more"
        raise Damaged(f"{values.nbytes} bytes of values by its header, {actual} in the file")
    return values.reshape(shape)


def smallest_type(values: np.ndarray) -> np.dtype:
    """Return the smallest integer type that holds the whole numbers of an array."""
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    dtypes = map(np.dtype, ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64"))
    fitting = (dtype for dtype in dtypes if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max)
    return next(fitting, np.dtype("int64"))


def map_numbers(path: Path, start: int, shape: Sequence[int], dtype: np.dtype, tail: bool = False) -> np.ndarray:
    """Map an array in a file, last axis fastest, from the byte `start` to the end; other bytes may follow if `tail`."""
    nbytes, size = math.prod(shape) * dtype.itemsize, path.stat().st_size - start
    if nbytes > size or (nbytes < size and not tail):
        raise Damaged(f"{nbytes} bytes of values by its header, {size} in the file")
    return np.memmap(path, dtype, "r", start, tuple(shape)) if nbytes else np.empty(tuple(shape), dtype)


def check_array(shape: Sequence[int], dtype: np.dtype, place: object) -> None:
    """Raise ScanError if an array would not hold numbers, or not fit into memory; call it before allocating it."""
    if dtype.kind in "OV":
        raise ScanError(f"a volume must hold numbers, got values of type {str(dtype)[:80]} in {place}")
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if min(shape, default=1) < 0:
        raise ScanError(f"a shape must be positive, got {tuple(shape)} in {place}")
    if size > memory():
        raise ScanError(f"{place} does not fit into memory: its header says {size:.3g} bytes")


def affine_of(matrix: np.ndarray, first: Any) -> np.ndarray:
    """Return the affine (4, 4) of a matrix (3, 3) with the axes as columns, x first, and the first voxel's position."""
    return np.vstack([np.column_stack([matrix, first]), [0.0, 0.0, 0.0, 1.0]])


def check_regular(path: Path) -> Path:
    """Return the path of a file or a folder, or raise ScanError: reading anything else may never end."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ScanError(f"{path} is neither a file nor a folder")
    return path


def name_axes(names: Sequence[str]) -> str:
    """Return a string with the letter of each axis, `?` for an unknown name."""
    letters = {"channel": "c", "time": "t"}
    lowered = (letters.get(name.casefold(), name.casefold()) for name in names)
    return "".join(name if name in tuple("tcszyx") else "?" for name in lowered)


def first_voxel(volume: Any) -> tuple[float, ...]:
    """Return the position of a volume's first voxel (z, y, x); 0 if axes are rotated, which few formats can express."""
    affine = volume.affine
    if affine is None or not np.allclose(affine[:3, :3], np.diag(volume.spacing[::-1]), rtol=1e-5, atol=0):
        return (0.0, 0.0, 0.0)
    return tuple(affine[2::-1, 3].tolist())
