"""Scanco's ISQ and AIM files of micro-CT, read where they lie on disk; ITK places them the same way.

ITK's reader of them, itk-ioscanco, is not used: it rounds the values of some files to whole Hounsfield units, takes
some truncated files for whole, and from Python reads no masks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from curvafit.volumes.formats.base import Damaged, ScanError, Stated, affine_of, check_array, map_numbers

#: AIM's types -> numpy's.
_AIM_TYPES = {0x00010001: "i1", 0x00160001: "u1", 0x000D0001: "u1", 0x00020002: "<i2"}
_AIM_TYPES |= {0x00170002: "<u2", 0x00030004: "<i4", 0x001A0004: "<f4"}
#: AIM's types of masks: run lengths of two values in turn, and pairs of a run length and a value.
_TWO_VALUES, _PAIRS = 0x00150001, 0x00080002


def read_isq(path: Path, **_: object) -> Stated:
    """Read an ISQ scan, whose header states the edges of the whole volume in µm."""
    head = _read_head(path, 512)
    if head[:16] != b"CTDATA-HEADER_V1":
        raise Damaged("it does not begin as an ISQ file")
    numbers = np.frombuffer(head, "<i4", 124, 16)
    shape, edges, blocks = numbers[7:10], numbers[10:13], int(numbers[123])
    if min(*shape, *edges, blocks + 1) < 1:
        raise Damaged(f"{shape.tolist()} voxels with edges of {edges.tolist()} µm in all")
    values = map_numbers(path, 512 * (blocks + 1), shape[::-1].tolist(), np.dtype("<i2"), tail=True)
    return _place(values, edges / shape / 1000, np.zeros(3), int(numbers[18]))


def read_aim(path: Path, **_: object) -> Stated:
    """Read an AIM scan or mask of version 020 or 030, at its position in the scan that it was cut from."""
    head = _read_head(path, 264)
    old = head[:16] != b"AIMDATA_V030   \0"
    integer, first, sizes_end, place = ("<i4", 0, 20, 44) if old else ("<i8", 16, 56, 72)
    sizes = [int(n) for n in np.frombuffer(head, integer, 5, first)]
    if sizes[:2] != ([20, 140] if old else [40, 224]) or min(sizes) < 0:
        raise Damaged("it does not begin as an AIM file of version 020 or 030")
    kind = int.from_bytes(head[place - 4 : place], "little")
    triples = np.frombuffer(head, integer, 24, place).reshape(8, 3)
    position, shape = triples[0], triples[1][::-1].tolist()
    spacing = _vax_floats(triples[7]) if old else triples[7] * 1e-6
    start = first + sum(sizes[:3])
    if min(shape) < 1:
        raise Damaged(f"{shape} voxels")
    log = bytes(map_numbers(path, sizes_end + sizes[1], [sizes[2]], np.dtype("u1"), tail=True))
    if kind in _AIM_TYPES:
        values = map_numbers(path, start, shape, np.dtype(_AIM_TYPES[kind]), tail=True)
    elif kind in (_TWO_VALUES, _PAIRS):
        values = _unpack_runs(path, start, shape, np.dtype(integer), kind)
    else:
        raise ScanError(f"{path} has values of AIM's type {kind:#010x}, which are not read")
    scaling = re.search(rb"Mu_Scaling +(\d{1,9})\b", log)
    return _place(values, spacing, position * spacing, int(scaling[1]) if scaling else 0)


def _read_head(path: Path, size: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        head = file.read(size)
    if len(head) < size:
        raise Damaged(f"{size} bytes of header expected, {len(head)} in the file")
    return head


def _vax_floats(words: np.ndarray) -> np.ndarray:
    """Return the floats of VAX in four bytes each: halves in the other order, the exponent larger by two."""
    return np.ascontiguousarray(words).view("<u2").reshape(-1, 2)[:, ::-1].copy().view("<f4")[:, 0].astype(float) / 4


def _unpack_runs(path: Path, start: int, shape: Sequence[int], integer: np.dtype, kind: int) -> np.ndarray:
    """Return the voxels of a mask that is stored as runs, behind the size of the runs in bytes."""
    check_array(shape, np.dtype("i1"), path)
    size = int(map_numbers(path, start, [1], integer, tail=True)[0]) - integer.itemsize
    if size < 2:
        raise Damaged(f"{size} bytes of runs")
    runs = map_numbers(path, start + integer.itemsize, [size], np.dtype("i1"), tail=True)
    if kind == _PAIRS:
        lengths, values = runs[: size // 2 * 2 : 2].view("u1"), runs[1::2]
    else:  # a run that is longer than 254 goes on after each 255
        codes = runs[2:].view("u1")
        turns = np.cumsum(codes != 255) - (codes != 255)
        lengths, values = np.minimum(codes, 254), runs[:2][turns % 2]
    count, total = math.prod(shape), int(lengths.sum(dtype=np.int64))
    if not count <= total < count + 255:
        raise Damaged(f"{count} voxels by its header, {total} in its runs")
    return np.repeat(values, lengths)[:count].reshape(tuple(shape))


def _place(values: np.ndarray, spacing: np.ndarray, origin: np.ndarray, scaling: int) -> Stated:
    """Return the content with its place, of numbers (x, y, z) in mm in ITK's frame, and with what its values are."""
    flip = np.array([-1, -1, 1])  # from ITK's frame to NIfTI's
    affine = affine_of(np.diag(flip * spacing), flip * origin)
    note = f"The values are the file's own: divided by {scaling}, they are the attenuation in 1/cm."
    notes = (note,) if scaling > 1 and values.dtype.itemsize > 1 else ()
    return Stated(values, "zyx", spacing[::-1].tolist(), ("mm",) * 3, affine=affine, notes=notes)
