"""NRRD and MetaImage, as ITK and 3D Slicer write them; NRRD with a library of the extra `[io]`."""

from __future__ import annotations

import bz2
import gzip
import io
import math
import os
import re
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.core.extras import require
from curvafit.core.units import common_unit
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import LPS_TO_RAS, ScanError, Stated

#: NRRD's encodings that are read -> the function that makes a stream of a file.
_NRRD_ENCODINGS: dict[str, Callable[[Any], Any]] = {
    "raw": lambda file: file,
    **dict.fromkeys(("gzip", "gz"), gzip.open),
    **dict.fromkeys(("bzip2", "bz2"), bz2.open),
}
#: NRRD's fields that are written with and without a space.
_SPACED = ("data file", "line skip", "byte skip", "axis mins", "axis maxs", "old min", "old max")
#: MetaImage's types -> numpy's.
_META_TYPES = {"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8"}
_META_TYPES |= {name.replace("MET_", "MET_U"): f"u{kind[1]}" for name, kind in _META_TYPES.items()}
_META_TYPES |= {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
#: What a MetaImage may write for True, and the most bytes of a header.
_TRUE, _HEADER = ("true", "t", "1"), 1 << 20


def read_nrrd(path: Path, **_: object) -> Stated:
    """Read an NRRD file; lengths along space directions without a unit are in mm."""
    nrrd = require("nrrd", "io", "reading NRRD files")
    with path.open("rb") as file:
        header, names = _read_header(nrrd, file)
        values = _read_files(nrrd, header, names, path) if names else _read_values(nrrd, header, file, path)
    notes: tuple[str, ...] = ()
    if {"old min", "old max"} & header.keys():
        notes = (f"The values stand for {header.get('old min')} to {header.get('old max')}: they are as stored.",)
    axes, units = _name_axes(header), list(header.get("space units", header.get("units", ())))
    units = [each or next(filter(None, units), None) for each in units]
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        directions = directions[~np.isnan(directions).any(axis=1)]
        affine = base.affine_of(directions.T, header.get("space origin", np.zeros(3)))
        unit, factors = common_unit(units or [None])
        if len(factors) == 3:  # one for each axis of the world, x first
            affine[:3] *= np.array(factors)[:, None]
        space = str(header.get("space", ""))
        if (turned := _to_right_anterior_superior(space)) is None:
            space = f"The file's space is {space!r}" if space else "The file names no space"
            notes += (f"{space}: its directions are taken for right, anterior and superior.",)
        affine = affine if turned is None else turned @ affine
        steps = np.linalg.norm(affine[:3, :3], axis=0)[::-1]
        steps = [steps["zyx".index(axis)] if axis in tuple("zyx") else None for axis in axes]
        guesses = () if unit else ("The file names no unit of length: mm is assumed.",)
        return Stated(values, axes, steps, (unit,) * len(steps), None, affine, "mm", notes, guesses)
    if "spacings" in header:
        steps, units = header["spacings"][::-1], units[::-1] if len(units) == values.ndim else [None] * values.ndim
        origin = header.get("axis mins", np.zeros(values.ndim))[::-1]
        if "axis mins" in header:  # that of a cell is its face, half a step before its middle
            centers = header.get("centerings") or str(header.get("centers", "none " * values.ndim)).split()
            origin = origin + np.array([str(center) == "cell" for center in centers[::-1]]) * steps / 2
        guesses = () if any(units) else ("The file names no unit of length: its spacings count in voxels.",)
        return Stated(values, axes, steps, units, origin, notes=notes, guesses=guesses)
    if {"axis mins", "axis maxs"} & header.keys():
        notes += ("The file states where its axes begin or end, but no spacing: that is not used.",)
    return Stated(values, axes, notes=notes)


def _read_header(nrrd: Any, file: IO[bytes]) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of a header, and the names of the files of values where these are not behind it."""
    lines: list[bytes] = []
    while file.tell() < _HEADER and (line := file.readline(_HEADER)).strip():
        lines.append(line)
    listed = next((k for k, line in enumerate(lines) if re.match(rb"data ?file:\s*LIST\b", line)), len(lines))
    header = dict(nrrd.read_header(lines[:listed]))
    header |= {name: header[joined] for name in _SPACED if (joined := name.replace(" ", "")) in header}
    if listed < len(lines):
        return header, [line.decode().strip() for line in lines[listed + 1 :]]
    name, *numbers = str(header.get("data file", "")).split(" ")
    if "%" in name and len(numbers) >= 3:  # NAME%03d.raw FIRST LAST STEP
        first, last, step = map(int, numbers[:3])
        return header, [name % k for k in range(first, last + 1, step)]
    return header, [str(header["data file"])] if "data file" in header else []


def _to_right_anterior_superior(space: str) -> np.ndarray | None:
    """Return the map from a named space, such as left-posterior-superior or LPS, to NIfTI's, or None for others."""
    words = space.lower().removesuffix("-time").split("-")
    letters = [word[:1] for word in words] if len(words) == 3 else list(space.lower()[:3])
    signs = [-1.0 if letter in "lpi" else 1.0 for letter in letters]
    named = [letter in pair for letter, pair in zip(letters, ("rl", "ap", "si"), strict=False)] == [True] * 3
    return np.diag([*signs, 1.0]) if named else None


def _read_files(nrrd: Any, header: dict[str, Any], names: Sequence[str], path: Path) -> np.ndarray:
    """Return the values, z first, of the files of a header, each of which has a part of the slowest axis."""
    sizes, parts = [int(n) for n in header["sizes"]], []
    if not names or sizes[-1] % len(names):
        raise base.Damaged(f"{sizes[-1]} slices in {len(names)} files")
    for name in names:
        with base.check_regular(path.parent / name).open("rb") as file:
            part = {**header, "sizes": [*sizes[:-1], sizes[-1] // len(names)]}
            parts.append(_read_values(nrrd, part, file, path))
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _read_values(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values, z first, from an NRRD file open at the end of its header, or from a file of values."""
    # pynrrd reads only the first part of a compressed stream, and not the checksum at its end.
    if header["dimension"] != len(header["sizes"]):
        raise base.Damaged(f"{len(header['sizes'])} sizes for {header['dimension']} axes")
    shape, encoding = [int(n) for n in header["sizes"]][::-1], str(header.get("encoding")).lower()
    no_values = {"dimension": 1, "sizes": np.zeros(1, int), "encoding": "raw", "type": header["type"]}
    dtype = nrrd.read_data({"endian": header.get("endian", "little"), **no_values}, io.BytesIO()).dtype
    if dtype.itemsize > 1 and "endian" not in header:
        raise base.Damaged("its numbers have several bytes, and it does not state their order, endian")
    if encoding not in _NRRD_ENCODINGS:
        raise ScanError(f"{path} has the encoding {encoding[:40]!r}: write it as raw, gzip or bzip2")
    for _ in range(int(header.get("line skip", 0))):
        file.readline()
    stream, start = _NRRD_ENCODINGS[encoding](file), int(header.get("byte skip", 0))
    if start < 0:
        stream.seek(-math.prod(shape) * dtype.itemsize, os.SEEK_END)
    else:
        stream.seek(start, os.SEEK_CUR)
    return base.read_numbers(stream, shape, dtype, path)


def _name_axes(header: dict[str, Any]) -> str:
    """Return the letters of the axes of the values, z first: of those that are not of space, times or channels."""
    count, kinds = int(header["dimension"]), [str(kind).lower() for kind in header.get("kinds", ())]
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        other = [bool(np.isnan(each).any()) for each in directions]
    else:
        other = [kind not in ("domain", "space", "none", "???") for kind in kinds]
    if len(other) != count or len(kinds) not in (0, count):
        return "?" * count
    times, space = [kind == "time" for kind in kinds] or [False] * count, iter("xyz" + "?" * count)
    letters = ("ct"[time] if each else next(space) for each, time in zip(other, times, strict=True))
    return "".join(letters)[::-1]


def read_metaimage(path: Path, **_: object) -> Stated:
    """Read a MetaImage (MHA, or MHD with the file of values that it names), whose unit is the millimetre."""
    with path.open("rb") as file:
        header = _meta_header(file)
        name = header["ElementDataFile"]
        if name.upper() == "LOCAL":
            return _meta_image(header, file, path)
    with base.check_regular(path.parent / name).open("rb") as file:
        return _meta_image(header, file, path)


def _meta_header(file: IO[bytes]) -> dict[str, str]:
    """Return the values of the lines `name = value`, by name, up to the line that says where the voxels are."""
    header: dict[str, str] = {}
    while "ElementDataFile" not in header and file.tell() < _HEADER and (line := file.readline(_HEADER)):
        name, _, value = line.decode("latin-1").partition("=")
        header[name.strip()] = value.strip()
    return header


def _meta_image(header: dict[str, str], file: IO[bytes], path: Path) -> Stated:
    """Return a MetaImage where ITK places it; channels are an axis after `NDims`, or else the first of four."""
    shape = [int(n) for n in header["DimSize"].split()]
    axes, channels = len(shape), int(header.get("ElementNumberOfChannels", 1))
    if header.get("ObjectType", "Image") != "Image" or str(axes) != header["NDims"] or min(shape) < 1:
        raise base.Damaged(f"an image of {header['NDims'][:20]} axes with the sizes {shape[:9]}")
    spacing = _meta_numbers(header, ("ElementSpacing", "ElementSize"), np.ones(axes))
    origin = _meta_numbers(header, ("Offset", "Position", "Origin"), np.zeros(axes))
    matrix = _meta_numbers(header, ("TransformMatrix", "Rotation", "Orientation"), np.eye(axes).ravel())
    shape = [*shape[::-1], *([channels] if channels != 1 else [])]
    values, affine = _meta_values(header, shape, file, path), None
    if axes in (3, 4):
        affine = LPS_TO_RAS @ base.affine_of(matrix.reshape(axes, axes).T[:3, :3] * spacing[:3], origin[:3])
    letters = ("?" if channels != 1 else "c") * (axes - 3) + "zyx"[-axes:] + "c" * (channels != 1)
    steps = [*spacing[::-1], *([1.0] if channels != 1 else [])]
    unit = header.get("DistanceUnits", "mm")
    return Stated(values, letters, steps, (unit,) * len(steps), affine=affine, notes=_meta_notes(header))


def _meta_notes(header: dict[str, str]) -> tuple[str, ...]:
    """Return what a header states and ITK passes over, as a note."""
    plain = {"CenterOfRotation": 0.0, "ElementToIntensityFunctionSlope": 1.0, "ElementToIntensityFunctionOffset": 0.0}
    odd = [name for name, value in plain.items() if any(float(k) != value for k in header.get(name, "").split())]
    both = {"ElementSpacing", "ElementSize"} <= header.keys() and header["ElementSize"] != header["ElementSpacing"]
    odd += ["ElementSize"] if both else []
    axes = np.array(header.get("TransformMatrix", "1 0 0 0 1 0 0 0 1").split(), dtype=np.float64)
    letters = header.get("AnatomicalOrientation", "???").upper()
    if axes.size == 9 and "?" not in letters:
        largest = [(k, int(axis[k] < 0)) for axis in axes.reshape(3, 3) for k in [int(np.abs(axis).argmax())]]
        own = "".join(("RAI", "LPS")[back][k] for k, back in largest)  # where each axis comes from
        odd += ["AnatomicalOrientation"] if letters != own else []
    return (f"The file's {', '.join(odd)} {'is' if len(odd) == 1 else 'are'} not used, as in ITK.",) if odd else ()


def _meta_values(header: dict[str, str], shape: list[int], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values from the file's position to its end."""
    # SimpleITK could read them, but it compares no checksum of a compressed file, and prints warnings itself.
    kind = header.get("ElementType", "")
    if kind not in _META_TYPES:
        raise ScanError(f"{path} has the element type {kind[:40]!r}, none of {', '.join(_META_TYPES)}")
    order = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False"))
    dtype = np.dtype(_META_TYPES[kind]).newbyteorder(">" if order.lower() in _TRUE else "<")
    base.check_array(shape, dtype, path)
    if header.get("BinaryData", "True").lower() not in _TRUE:
        raise ScanError(f"{path} holds values in text, which are not read: write it with binary values")
    nbytes, head = math.prod(shape) * dtype.itemsize, int(header.get("HeaderSize", 0))
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - nbytes) if head < 0 else file.tell() + head)
    if header.get("CompressedData", "False").lower() not in _TRUE:
        return base.read_numbers(file, shape, dtype, path)
    rest = size - file.tell()
    if int(header.get("CompressedDataSize", rest)) != rest:
        raise base.Damaged(f"{header['CompressedDataSize']} compressed bytes by its header, {rest} in the file")
    inflate = zlib.decompressobj()
    content = inflate.decompress(file.read(), nbytes + 1)
    if len(content) != nbytes or not inflate.eof or inflate.unused_data:
        raise base.Damaged(f"{nbytes} bytes of values by its header, not so many in the file")
    return np.frombuffer(bytearray(content), dtype).reshape(shape)


def _meta_numbers(header: dict[str, str], names: Sequence[str], default: np.ndarray) -> np.ndarray:
    """Return the numbers of the first of these lines that the header has, or `default`, which has as many numbers."""
    for name in names:
        if name in header:
            numbers = np.array(header[name].split(), dtype=np.float64)
            if len(numbers) != len(default):
                raise base.Damaged(f"{name} of {len(numbers)} numbers, not {len(default)}")
            return numbers
    return default
