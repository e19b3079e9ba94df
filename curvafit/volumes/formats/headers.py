"""Numbers behind a header: NRRD and MetaImage, as ITK and 3D Slicer write them; MRC and CCP4 maps; Scanco's micro-CT.

NRRD and MRC are read with libraries of the extra `[io]`. ITK's reader of Scanco's ISQ and AIM, itk-ioscanco, is not
used: it rounds the values of some files to whole Hounsfield units, takes some truncated files for whole, and from
Python reads no masks.
"""

from __future__ import annotations

import bz2
import gzip
import io
import math
import os
import re
import warnings
import zlib
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.core.checks import require
from curvafit.core.units import common_unit, convert_length
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import LPS_TO_RAS, ScanError, Stated

#: NRRD's encodings that are read -> the function that makes a stream of a file.
_NRRD_ENCODINGS: dict[str, Callable[[Any], Any]] = {"raw": lambda file: file}
_NRRD_ENCODINGS |= {"gzip": gzip.open, "gz": gzip.open, "bzip2": bz2.open, "bz2": bz2.open}
#: NRRD's fields that files spell with or without the space.
_SPACED = ("data file", "line skip", "byte skip", "axis mins", "axis maxs", "old min", "old max")
#: MetaImage's types -> numpy's.
_META_TYPES = {"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8"}
_META_TYPES |= {name.replace("MET_", "MET_U"): f"u{kind[1]}" for name, kind in _META_TYPES.items()}
_META_TYPES |= {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
#: What a MetaImage may write for True, and the most bytes of a header.
_TRUE, _HEADER = ("true", "t", "1"), 1 << 20
#: IMOD's stamp, from byte 152 on: its flags follow, the first of which says that bytes are signed.
_IMOD = 1146047817
#: AIM's types -> numpy's.
_AIM_TYPES = {0x00010001: "i1", 0x00160001: "u1", 0x000D0001: "u1", 0x00020002: "<i2"}
_AIM_TYPES |= {0x00170002: "<u2", 0x00030004: "<i4", 0x001A0004: "<f4"}
#: AIM's types of masks: run lengths of two alternating values, and pairs of a run length and a value.
_TWO_VALUES, _PAIRS = 0x00150001, 0x00080002


# ---- NRRD ------------------------------------------------------------------------------------------------------------


def read_nrrd(path: Path, **_: object) -> Stated:
    """Read an NRRD file; lengths along space directions without a unit are in mm."""
    nrrd = require("nrrd", "io", "reading NRRD files")
    with path.open("rb") as file:
        header = _read_header(nrrd, file, path)
        detached = base.check_regular(path.parent / header["data file"]) if "data file" in header else None
        with nullcontext(file) if detached is None else detached.open("rb") as content:
            values = _read_values(nrrd, header, content, path)
    notes: tuple[str, ...] = ()
    if {"old min", "old max"} & header.keys():
        notes = (f"The values stand for {header.get('old min')} to {header.get('old max')}: they are as stored.",)
    axes, units = _name_axes(header), list(header.get("space units", header.get("units", ())))
    units = [unit or next(filter(None, units), None) for unit in units]
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        directions = directions[~np.isnan(directions).any(axis=1)]
        affine = base.affine_of(directions.T, header.get("space origin", np.zeros(3)))
        unit, factors = common_unit(units or [None])
        if len(factors) == 3:  # one for each axis of the world, x first
            affine[:3] *= np.array(factors)[:, None]
        space = str(header.get("space", ""))
        if (to_ras := _to_right_anterior_superior(space)) is None:
            fault = f"The file's space is {space!r}" if space else "The file names no space"
            notes += (f"{fault}: its directions are taken for right, anterior and superior.",)
        affine = affine if to_ras is None else to_ras @ affine
        lengths = np.linalg.norm(affine[:3, :3], axis=0)[::-1]
        steps = [lengths["zyx".index(axis)] if axis in tuple("zyx") else None for axis in axes]
        guesses = () if unit else ("The file names no unit of length: mm is assumed.",)
        return Stated(values, axes, steps, (unit,) * len(steps), None, affine, "mm", notes, guesses)
    if "spacings" in header:
        steps = header["spacings"][::-1]
        units = units[::-1] if len(units) == values.ndim else [None] * values.ndim
        origin = header.get("axis mins", np.zeros(values.ndim))[::-1]
        if "axis mins" in header:  # the first face of a cell, half a step before its centre, or the centre of a node
            centers = header.get("centerings") or str(header.get("centers", "none " * values.ndim)).split()
            origin = origin + np.array([str(center) == "cell" for center in centers[::-1]]) * steps / 2
        guesses = () if any(units) else ("The file names no unit of length: its spacings count in voxels.",)
        return Stated(values, axes, steps, units, origin, notes=notes, guesses=guesses)
    if {"axis mins", "axis maxs"} & header.keys():
        notes += ("The file states where its axes begin or end, but no spacing: that is not used.",)
    return Stated(values, axes, notes=notes)


def _read_header(nrrd: Any, file: IO[bytes], path: Path) -> dict[str, Any]:
    """Return the fields of a header, whose `data file` holds the values if they do not follow it."""
    lines: list[bytes] = []
    while file.tell() < _HEADER and (line := file.readline(_HEADER)).strip():
        lines.append(line)
    if any(re.match(rb"data ?file:\s*(LIST\b|.*%\d*d.* \d)", line) for line in lines):
        raise ScanError(f"{path} has its values in several files, which are not joined: write it as .nrrd")
    header = dict(nrrd.read_header(lines))
    header |= {name: header[joined] for name in _SPACED if (joined := name.replace(" ", "")) in header}
    if skip := next((name for name in ("line skip", "byte skip") if int(header.get(name, 0))), ""):
        raise ScanError(f"{path} has a {skip}, which is not followed: write it as .nrrd")
    return header


def _to_right_anterior_superior(space: str) -> np.ndarray | None:
    """Return the map (4, 4) from a space, such as left-posterior-superior or LPS, to NIfTI's, None if it is unknown."""
    directions = space.lower().removesuffix("-time").split("-")
    letters = [direction[:1] for direction in directions] if len(directions) == 3 else list(space.lower()[:3])
    signs = [-1.0 if letter in "lpi" else 1.0 for letter in letters]
    known = [letter in pair for letter, pair in zip(letters, ("rl", "ap", "si"), strict=False)] == [True] * 3
    return np.diag([*signs, 1.0]) if known else None


def _read_values(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values, z first, that follow in an open file: an NRRD file behind its header, or a file of values."""
    # pynrrd itself reads only the first part of a compressed stream, and not the checksum at its end.
    if header["dimension"] != len(header["sizes"]):
        raise base.Damaged(f"{len(header['sizes'])} sizes for {header['dimension']} axes")
    shape, encoding = [int(n) for n in header["sizes"]][::-1], str(header.get("encoding")).lower()
    empty = {"dimension": 1, "sizes": np.zeros(1, int), "encoding": "raw", "type": header["type"]}
    dtype = nrrd.read_data({"endian": header.get("endian", "little"), **empty}, io.BytesIO()).dtype
    if dtype.itemsize > 1 and "endian" not in header:
        raise base.Damaged("its numbers have several bytes, and it does not state their order, endian")
    if encoding not in _NRRD_ENCODINGS:
        raise ScanError(f"{path} has the encoding {encoding[:40]!r}: write it as raw, gzip or bzip2")
    return base.read_numbers(_NRRD_ENCODINGS[encoding](file), shape, dtype, path)


def _name_axes(header: dict[str, Any]) -> str:
    """Return a string with the letter of each axis, z first; axes that are not of space are times or channels."""
    count, kinds = int(header["dimension"]), [str(kind).lower() for kind in header.get("kinds", ())]
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        is_space = [not np.isnan(direction).any() for direction in directions]
    else:
        is_space = [kind in ("domain", "space", "none", "???") for kind in kinds]
    if len(is_space) != count or len(kinds) not in (0, count):
        return "?" * count
    other_letters = ["t" if kind == "time" else "c" for kind in kinds] or ["c"] * count
    space_letters = iter("xyz" + "?" * count)
    letters = [next(space_letters) if space else other for space, other in zip(is_space, other_letters, strict=True)]
    return "".join(letters)[::-1]


# ---- MetaImage -------------------------------------------------------------------------------------------------------


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
    """Return the values of the lines `name = value`, by name, up to `ElementDataFile`, the last one of a header."""
    header: dict[str, str] = {}
    while "ElementDataFile" not in header and file.tell() < _HEADER and (line := file.readline(_HEADER)):
        name, _, value = line.decode("latin-1").partition("=")
        header[name.strip()] = value.strip()
    return header


def _meta_image(header: dict[str, str], file: IO[bytes], path: Path) -> Stated:
    """Return a MetaImage with the affine that ITK gives it; channels are the last axis, or else the first of four."""
    sizes = [int(n) for n in header["DimSize"].split()]
    ndim, channels = len(sizes), int(header.get("ElementNumberOfChannels", 1))
    if header.get("ObjectType", "Image") != "Image" or str(ndim) != header["NDims"] or min(sizes) < 1:
        raise base.Damaged(f"an image of {header['NDims'][:20]} axes with the sizes {sizes[:9]}")
    spacing = _meta_numbers(header, ("ElementSpacing", "ElementSize"), np.ones(ndim))
    origin = _meta_numbers(header, ("Offset", "Position", "Origin"), np.zeros(ndim))
    matrix = _meta_numbers(header, ("TransformMatrix", "Rotation", "Orientation"), np.eye(ndim).ravel())
    shape, steps = sizes[::-1], [*spacing[::-1]]
    axes = "c" * (ndim - 3) + "zyx"[-ndim:]
    if channels != 1:
        shape, steps = [*shape, channels], [*steps, 1.0]
        axes = axes.replace("c", "?") + "c"
    values, affine = _meta_values(header, shape, file, path), None
    if ndim in (3, 4):
        affine = LPS_TO_RAS @ base.affine_of(matrix.reshape(ndim, ndim).T[:3, :3] * spacing[:3], origin[:3])
    unit = header.get("DistanceUnits", "mm")
    return Stated(values, axes, steps, (unit,) * len(steps), affine=affine, notes=_meta_notes(header))


def _meta_notes(header: dict[str, str]) -> tuple[str, ...]:
    """Return a note on what a header states that ITK, and so we, ignore."""
    neutral = {"CenterOfRotation": 0.0, "ElementToIntensityFunctionSlope": 1.0, "ElementToIntensityFunctionOffset": 0.0}
    unused = [name for name, value in neutral.items() if any(float(k) != value for k in header.get(name, "").split())]
    if {"ElementSpacing", "ElementSize"} <= header.keys() and header["ElementSize"] != header["ElementSpacing"]:
        unused.append("ElementSize")
    axes = np.array(header.get("TransformMatrix", "1 0 0 0 1 0 0 0 1").split(), dtype=np.float64)
    orientation = header.get("AnatomicalOrientation", "???").upper()
    if axes.size == 9 and "?" not in orientation:
        largest = np.abs(axes.reshape(3, 3)).argmax(axis=1)
        sides = ["LPS"[k] if axis[k] < 0 else "RAI"[k] for axis, k in zip(axes.reshape(3, 3), largest, strict=True)]
        unused += ["AnatomicalOrientation"] if orientation != "".join(sides) else []  # the sides where axes start
    verb = "is" if len(unused) == 1 else "are"
    return (f"The file's {', '.join(unused)} {verb} not used, as in ITK.",) if unused else ()


def _meta_values(header: dict[str, str], shape: list[int], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values from the file's position, behind a header, to its end."""
    # SimpleITK could read them, but it compares no checksum of a compressed file, and prints warnings itself.
    element_type = header.get("ElementType", "")
    if element_type not in _META_TYPES:
        raise ScanError(f"{path} has the element type {element_type[:40]!r}, none of {', '.join(_META_TYPES)}")
    big_endian = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False"))
    dtype = np.dtype(_META_TYPES[element_type]).newbyteorder(">" if big_endian.lower() in _TRUE else "<")
    base.check_array(shape, dtype, path)
    if header.get("BinaryData", "True").lower() not in _TRUE:
        raise ScanError(f"{path} holds values in text, which are not read: write it with binary values")
    nbytes, skipped = math.prod(shape) * dtype.itemsize, int(header.get("HeaderSize", 0))
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - nbytes) if skipped < 0 else file.tell() + skipped)  # -1: the values are the last bytes
    if header.get("CompressedData", "False").lower() not in _TRUE:
        return base.read_numbers(file, shape, dtype, path)
    remaining = size - file.tell()
    if int(header.get("CompressedDataSize", remaining)) != remaining:
        raise base.Damaged(f"{header['CompressedDataSize']} compressed bytes by its header, {remaining} in the file")
    inflate = zlib.decompressobj()
    content = inflate.decompress(file.read(), nbytes + 1)  # one more than expected, so that a surplus is noticed
    if len(content) != nbytes or not inflate.eof or inflate.unused_data:
        raise base.Damaged(f"{nbytes} bytes of values by its header, not so many in the file")
    return np.frombuffer(bytearray(content), dtype).reshape(shape)


def _meta_numbers(header: dict[str, str], names: Sequence[str], default: np.ndarray) -> np.ndarray:
    """Return the numbers of the first name that the header has, or `default`, whose length they must have."""
    for name in names:
        if name in header:
            numbers = np.array(header[name].split(), dtype=np.float64)
            if len(numbers) != len(default):
                raise base.Damaged(f"{name} of {len(numbers)} numbers, not {len(default)}")
            return numbers
    return default


# ---- MRC: lengths are in Å -------------------------------------------------------------------------------------------


def read_mrc(path: Path, **_: object) -> Stated:
    """Read an MRC file, with axes in the header's order, and its origin or, without one, its first voxel (nstart)."""
    mrcfile = require("mrcfile", "io", "reading and writing MRC files")
    with (
        warnings.catch_warnings(record=True, action="always") as caught,
        mrcfile.open(path, permissive=True, header_only=True) as file,
    ):
        header, voxel_size = file.header, file.voxel_size
        shape, dtype = mrcfile.utils.data_shape_from_header(header), mrcfile.utils.data_dtype_from_header(header)
    notes = [f"The file's header is odd: {w.message}." for w in caught if issubclass(w.category, RuntimeWarning)]
    angles = [float(angle) for angle in header.cellb.tolist()]
    if any(angle and abs(angle - 90) > 0.5 for angle in angles):
        raise ScanError(f"the axes of {path} meet at {angles}°, not at right angles: resample it")
    start = header.nbytes + int(header.nsymbt)
    stamp, flags = np.frombuffer(header.extra2.tobytes()[40:48], header.mode.dtype)
    values = base.map_numbers(path, start, [int(n) for n in shape], dtype)
    # Bytes are signed, as is standard, unless IMOD's stamp says otherwise, or the header's maximum is above theirs.
    if dtype == np.int8 and (not flags & 1 if stamp == _IMOD else header.dmax > 127):
        values = values.view(np.uint8)
        if stamp != _IMOD:
            notes.append("The bytes are taken for numbers from 0 to 255, as the header's maximum is above 127.")
    numbers = [int(header[name]) for name in ("maps", "mapr", "mapc")]  # of sections, rows and columns; 1 is x
    axes = "".join("xyz"[k - 1] for k in numbers) if sorted(numbers) == [1, 2, 3] else "zyx"
    edges = {axis: float(voxel_size[axis]) for axis in "xyz"}
    origin = {axis: float(header.origin[axis]) for axis in "xyz"}
    starts = (header.nzstart, header.nystart, header.nxstart)  # of sections, rows and columns, in voxels
    first = {axis: float(n) * edges[axis] for axis, n in zip(axes, starts, strict=True)}
    if not any(origin.values()):
        origin = first
    elif any(first.values()) and not np.allclose(list(origin.values()), [first[axis] for axis in origin], rtol=1e-3):
        notes.append("The header states an origin and another first voxel (nstart): the origin is used.")
    if header.ispg == 0 and stamp != _IMOD and values.shape[0] > 1:
        notes.append("By its header the file is a stack of images (space group 0): it is read as a volume.")
    axes = "c" * (values.ndim - 3) + axes
    if not math.prod(edges.values()) > 0:  # no voxel size is stated
        return Stated(values, axes, units=(None,) * values.ndim, notes=tuple(notes))
    steps, positions = ([lengths.get(axis, 0.0) for axis in axes] for lengths in (edges, origin))
    return Stated(values, axes, steps, ("angstrom",) * values.ndim, positions, notes=tuple(notes))


def check_mrc(unit: str, values: np.ndarray | None = None) -> None:
    """Raise ScanError if MRC cannot hold lengths in a unit, or values, and ImportError without its library."""
    require("mrcfile", "io", "reading and writing MRC files")
    if unit == "voxel":
        raise ScanError("an MRC file holds voxel sizes in Å: give the unit, nm, um, mm or m")
    if values is not None and values.dtype.kind in "iu" and values.dtype.itemsize > 2:
        raise ScanError(f"an MRC file holds whole numbers of at most 16 bits or floats, got {values.dtype}")


def write_mrc(field: Any, path: Path) -> None:
    """Write a volume with voxel sizes and position in Å; types that MRC lacks are replaced, as float64 by float32."""
    dtype = {"bool": "int8", "float64": "float32", "uint8": "uint16"}.get(field.values.dtype.name)
    values = field.values if dtype is None else field.values.astype(dtype)
    with require("mrcfile", "io", "reading and writing MRC files").new(path, values, overwrite=True) as file:
        file.voxel_size = tuple(convert_length(h, field.unit, "angstrom") for h in field.spacing[::-1])
        file.header.origin = tuple(convert_length(x, field.unit, "angstrom") for x in base.first_voxel(field)[::-1])


# ---- Scanco's ISQ and AIM, read where they lie on disk and placed as by ITK ------------------------------------------


def read_isq(path: Path, **_: object) -> Stated:
    """Read an ISQ scan, whose header states the edges of the whole volume in µm."""
    head = _read_head(path, 512)
    if head[:16] != b"CTDATA-HEADER_V1":
        raise base.Damaged("it does not begin as an ISQ file")
    fields = np.frombuffer(head, "<i4", 124, 16)
    shape, edges, scaling = fields[7:10], fields[10:13], int(fields[18])
    further_blocks = int(fields[123])  # of 512 bytes each, between this one and the values
    if min(*shape, *edges, further_blocks + 1) < 1:
        raise base.Damaged(f"{shape.tolist()} voxels with edges of {edges.tolist()} µm in all")
    values = base.map_numbers(path, 512 * (further_blocks + 1), shape[::-1].tolist(), np.dtype("<i2"), tail=True)
    return _state(values, edges / shape / 1000, np.zeros(3), scaling)


def read_aim(path: Path, **_: object) -> Stated:
    """Read an AIM scan or mask of version 020 or 030, at its position in the scan that it was cut from."""
    head = _read_head(path, 264)
    is_020 = head[:16] != b"AIMDATA_V030   \0"
    # A file begins with five sizes in bytes: of this block, a header, a log, the values and more, which follow in turn.
    integer, sizes_start, header_start, geometry_start = ("<i4", 0, 20, 44) if is_020 else ("<i8", 16, 56, 72)
    sizes = [int(n) for n in np.frombuffer(head, integer, 5, sizes_start)]
    if sizes[:2] != ([20, 140] if is_020 else [40, 224]) or min(sizes) < 0:
        raise base.Damaged("it does not begin as an AIM file of version 020 or 030")
    kind = int.from_bytes(head[geometry_start - 4 : geometry_start], "little")
    triples = np.frombuffer(head, integer, 24, geometry_start).reshape(8, 3)
    position, shape = triples[0], triples[1][::-1].tolist()
    spacing = _vax_floats(triples[7]) if is_020 else triples[7] * 1e-6
    start = sizes_start + sum(sizes[:3])
    if min(shape) < 1:
        raise base.Damaged(f"{shape} voxels")
    log = bytes(base.map_numbers(path, header_start + sizes[1], [sizes[2]], np.dtype("u1"), tail=True))
    if kind in _AIM_TYPES:
        values = base.map_numbers(path, start, shape, np.dtype(_AIM_TYPES[kind]), tail=True)
    elif kind in (_TWO_VALUES, _PAIRS):
        values = _unpack_runs(path, start, shape, np.dtype(integer), kind)
    else:
        raise ScanError(f"{path} has values of AIM's type {kind:#010x}, which are not read")
    scaling = re.search(rb"Mu_Scaling +(\d{1,9})\b", log)
    return _state(values, spacing, position * spacing, int(scaling[1]) if scaling else 0)


def _read_head(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        head = file.read(size)
    if len(head) < size:
        raise base.Damaged(f"{size} bytes of header expected, {len(head)} in the file")
    return head


def _vax_floats(encoded: np.ndarray) -> np.ndarray:
    """Decode VAX's floats of four bytes: IEEE's with the two halves swapped and the exponent larger by two."""
    swapped = np.ascontiguousarray(encoded).view("<u2").reshape(-1, 2)[:, ::-1].copy()
    return swapped.view("<f4")[:, 0].astype(float) / 4


def _unpack_runs(path: Path, start: int, shape: Sequence[int], integer: np.dtype, kind: int) -> np.ndarray:
    """Return the voxels of a mask that is stored as run lengths, after an integer with their size in bytes."""
    base.check_array(shape, np.dtype("i1"), path)
    size = int(base.map_numbers(path, start, [1], integer, tail=True)[0]) - integer.itemsize
    if size < 2:
        raise base.Damaged(f"{size} bytes of runs")
    runs = base.map_numbers(path, start + integer.itemsize, [size], np.dtype("i1"), tail=True)
    if kind == _PAIRS:
        lengths, values = runs[: size // 2 * 2 : 2].view("u1"), runs[1::2]
    else:  # the two values, then lengths, where 255 stands for 254 voxels of a run that goes on in the next byte
        codes = runs[2:].view("u1")
        finished_runs = np.cumsum(codes != 255) - (codes != 255)
        lengths, values = np.minimum(codes, 254), runs[:2][finished_runs % 2]
    count, total = math.prod(shape), int(lengths.sum(dtype=np.int64))
    if not count <= total < count + 255:
        raise base.Damaged(f"{count} voxels by its header, {total} in its runs")
    return np.repeat(values, lengths)[:count].reshape(tuple(shape))


def _state(values: np.ndarray, spacing: np.ndarray, origin: np.ndarray, scaling: int) -> Stated:
    """Return values with a spacing and an origin (x, y, z) in mm in ITK's frame, and a note on what the values mean."""
    flip = np.array([-1, -1, 1])  # from ITK's frame to NIfTI's
    affine = base.affine_of(np.diag(flip * spacing), flip * origin)
    note = f"The values are the file's own: divided by {scaling}, they are the attenuation in 1/cm."
    notes = (note,) if scaling > 1 and values.dtype.itemsize > 1 else ()
    return Stated(values, "zyx", spacing[::-1].tolist(), ("mm",) * 3, affine=affine, notes=notes)
