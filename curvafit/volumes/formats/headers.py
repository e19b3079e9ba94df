"""Headers of NRRD and MetaImage, which say where the values are and how many bytes they take."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.volumes.formats.base import Damaged, ScanError
from curvafit.volumes.formats.streams import check_array, check_regular, decompressed, read_numbers, skip

#: NRRD's names of types -> numpy's. `signed` and `_t` are taken off first.
_NRRD_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8"), "u1"),
    **dict.fromkeys(("short", "short int", "int16"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "int64"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64"), "u8"),
    "float": "f4",
    "double": "f8",
}
_NRRD_ENCODINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
#: MetaImage's types -> numpy's.
_META_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    **dict.fromkeys(("MET_INT", "MET_LONG"), "i4"),
    **dict.fromkeys(("MET_UINT", "MET_ULONG"), "u4"),
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
#: MetaImage's lines with one number per axis (1), or per pair of axes (2).
_META_COUNTS = {
    **dict.fromkeys(("ElementSpacing", "ElementSize", "Offset", "Position", "Origin", "CenterOfRotation"), 1),
    **dict.fromkeys(("TransformMatrix", "Rotation", "Orientation"), 2),
}
#: Most bytes of a MetaImage's header.
_HEADER = 1 << 16


def nrrd_values(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values, z first, of an NRRD file that is read to the end of its header, or of the file it names.

    Raises
    ------
    ScanError, Damaged
        If the number of values is not the header's, or their type or encoding is not supported.
    """
    if header["dimension"] != len(header["sizes"]):
        raise Damaged(f"{len(header['sizes'])} sizes for {header['dimension']} axes")
    shape, dtype = [int(n) for n in header["sizes"]][::-1], _nrrd_type(header)
    check_array(shape, dtype, path)
    name = header.get("data file", header.get("datafile"))
    if name is None:
        return _nrrd_body(nrrd, header, file, path, (shape, dtype))
    with check_regular(path.parent / str(name)).open("rb") as data_file:
        return _nrrd_body(nrrd, header, data_file, path, (shape, dtype))


def _nrrd_body(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path, kind: tuple[Any, Any]) -> np.ndarray:
    """Return the values from the file's position on, after the lines and bytes that the header skips."""
    (shape, dtype), encoding = kind, str(header.get("encoding")).lower()
    if encoding not in _NRRD_ENCODINGS:
        if math.prod(shape) > path.stat().st_size and "data file" not in header:
            raise Damaged(f"{math.prod(shape)} numbers by its header, fewer bytes in the file")
        return nrrd.read_data(header, file, str(path), index_order="C")
    for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
        file.readline()
    byte_skip = int(header.get("byte skip", header.get("byteskip", 0)))
    stream = decompressed(file, _NRRD_ENCODINGS[encoding])
    if byte_skip < 0:
        stream.seek(-math.prod(shape) * dtype.itemsize, 2)
    else:
        skip(stream, byte_skip)
    return read_numbers(stream, shape, dtype, path)


def _nrrd_type(header: dict[str, Any]) -> np.dtype:
    name = str(header["type"]).strip().lower().removeprefix("signed ").removesuffix("_t")
    if name not in _NRRD_TYPES:
        raise ScanError(f"expected numbers of a type such as uint8 or float in an NRRD file, got {name[:40]!r}")
    dtype = np.dtype(_NRRD_TYPES[name])
    return dtype.newbyteorder(">" if header.get("endian") == "big" else "<")


def read_meta(path: Path) -> tuple[dict[str, str], np.ndarray | None]:
    """Return the header of a MetaImage and its values, z first; None for values in text or in several files.

    Raises
    ------
    ScanError, Damaged, OSError, zlib.error
        If the header or the values are damaged, or the number of values is not the header's.
    """
    with path.open("rb") as file:
        header = _meta_header(file)
        name = header.get("ElementDataFile", "")
        if name.upper() == "LOCAL":
            return header, _meta_values(header, file, path)
        listed = name.upper() == "LIST"
        places = file.read(_HEADER).decode("latin-1").splitlines() if listed else [name]
    for place in places:
        check_regular(path.parent / place.strip())
    if listed or "%" in name:
        return header, None
    with (path.parent / name).open("rb") as file:
        return header, _meta_values(header, file, path)


def meta_numbers(header: dict[str, str], *names: str) -> np.ndarray | None:
    """Return the numbers of the first of these lines in a MetaImage's header, None without any."""
    return next((np.array(header[name].split(), dtype=np.float64) for name in names if name in header), None)


def _meta_header(file: IO[bytes]) -> dict[str, str]:
    """Return the lines `name = value` up to the one that says where the values are."""
    header: dict[str, str] = {}
    while "ElementDataFile" not in header and file.tell() < _HEADER and (line := file.readline(_HEADER)):
        name, _, value = line.decode("latin-1").partition("=")
        header[name.strip()] = value.strip()
    return header


def _meta_shape(header: dict[str, str]) -> list[int]:
    """Return the size along each axis, or raise Damaged where another line has another number of axes."""
    shape = [int(n) for n in header.get("DimSize", "").split()]
    if header.get("ObjectType", "Image") != "Image" or str(len(shape)) != header.get("NDims") or min(shape) < 1:
        raise Damaged(f"an image of {header.get('NDims', 'no')[:20]} axes with the sizes {shape[:9]}")
    for name, value in header.items():
        count = _META_COUNTS.get(name, 0)
        if count and len([float(each) for each in value.split()]) != len(shape) ** count:
            raise Damaged(f"{name} of {len(value.split())} numbers for {len(shape)} axes")
    return shape


def _meta_values(header: dict[str, str], file: IO[bytes], path: Path) -> np.ndarray | None:
    """Return the values from the file's position to its end; None where they are text."""
    kind = header.get("ElementType", "")
    if kind not in _META_TYPES:
        raise ScanError(f"expected an element type among {', '.join(_META_TYPES)}, got {kind[:40]!r} in {path}")
    shape, channels = _meta_shape(header), int(header.get("ElementNumberOfChannels", 1))
    order = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False"))
    dtype = np.dtype(_META_TYPES[kind]).newbyteorder(">" if _meta_truth(order) else "<")
    shape = [*shape[::-1], *([channels] if channels != 1 else [])]
    check_array(shape, dtype, path)
    if not _meta_truth(header.get("BinaryData", "True")):
        return None
    compression, header_size = _meta_truth(header.get("CompressedData", "False")), int(header.get("HeaderSize", 0))
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - math.prod(shape) * dtype.itemsize) if header_size < 0 else file.tell() + header_size)
    rest = size - file.tell()
    if compression and int(header.get("CompressedDataSize", rest)) != rest:
        raise Damaged(f"{header['CompressedDataSize']} compressed bytes by its header, {rest} in the file")
    return read_numbers(decompressed(file, "zlib" if compression else "raw"), shape, dtype, path)


def _meta_truth(text: str) -> bool:
    if text.lower() not in ("true", "false", "t", "f", "1", "0"):
        raise Damaged(f"{text[:20]!r} for True or False")
    return text.lower() in ("true", "t", "1")
