"""NRRD's and MetaImage's headers, which say how many bytes of values there should be, and where."""

from __future__ import annotations

import math
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.formats.base import Damaged, ScanError
from curvafit.formats.streams import check_memory, check_regular, decompressed, read_numbers

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
#: MetaImage's types -> bytes of a number.
_META_SIZES = {
    **dict.fromkeys(("MET_CHAR", "MET_UCHAR"), 1),
    **dict.fromkeys(("MET_SHORT", "MET_USHORT"), 2),
    **dict.fromkeys(("MET_INT", "MET_UINT", "MET_FLOAT"), 4),
    **dict.fromkeys(("MET_LONG", "MET_ULONG", "MET_LONG_LONG", "MET_ULONG_LONG", "MET_DOUBLE"), 8),
}
#: Bytes of a MetaImage's header at most.
_HEADER = 1 << 16


def nrrd_values(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path) -> np.ndarray:
    """The values, z first, of an NRRD file that is read to the end of its header, or of the file that this names.

    Raises
    ------
    ScanError, Damaged
        If the values are not as many as the header says, or of a type or encoding that is not read.
    """
    if header["dimension"] != len(header["sizes"]):
        raise Damaged(f"{len(header['sizes'])} sizes for {header['dimension']} axes")
    shape, dtype = [int(n) for n in header["sizes"]][::-1], _nrrd_type(header)
    check_memory(shape, dtype, path)
    named = header.get("data file", header.get("datafile"))
    if named is None:
        return _nrrd_body(nrrd, header, file, path, (shape, dtype))
    with check_regular(path.parent / str(named)).open("rb") as other:
        return _nrrd_body(nrrd, header, other, path, (shape, dtype))


def _nrrd_body(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path, kind: tuple[Any, Any]) -> np.ndarray:
    """The values from where the file stands, after the lines and bytes that the header skips."""
    (shape, dtype), encoding = kind, str(header.get("encoding")).lower()
    if encoding not in _NRRD_ENCODINGS:
        if math.prod(shape) > path.stat().st_size and "data file" not in header:
            raise Damaged(f"{math.prod(shape)} numbers by its header, fewer bytes in the file")
        return nrrd.read_data(header, file, str(path), index_order="C")
    for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
        file.readline()
    skipped = int(header.get("byte skip", header.get("byteskip", 0)))
    stream = decompressed(file, _NRRD_ENCODINGS[encoding])
    if skipped < 0:
        stream.seek(-math.prod(shape) * dtype.itemsize, 2)
    else:
        stream.read(skipped)
    return read_numbers(stream, shape, dtype, path)


def _nrrd_type(header: dict[str, Any]) -> np.dtype:
    name = str(header["type"]).strip().lower().removeprefix("signed ").removesuffix("_t")
    if name not in _NRRD_TYPES:
        raise ScanError(f"expected numbers of a type such as uint8 or float in an NRRD file, got {name[:40]!r}")
    dtype = np.dtype(_NRRD_TYPES[name])
    return dtype.newbyteorder(">" if header.get("endian") == "big" else "<")


def check_meta(path: Path) -> None:
    """Make sure that a MetaImage's values are all there, and whole where they are compressed.

    Raises
    ------
    ScanError, Damaged, OSError, EOFError, zlib.error
        If they are not.
    """
    with path.open("rb") as file:
        header = _meta_header(file)
        name = header.get("ElementDataFile", "")
        places = [name]
        if name.upper() == "LIST":
            places = file.read(_HEADER).decode("latin-1").splitlines()
        elif name.upper() == "LOCAL":
            return _check_meta_body(header, file, path)
    for place in places:
        check_regular(path.parent / place.strip())
    if len(places) == 1 and "%" not in name:
        with (path.parent / name).open("rb") as file:
            _check_meta_body(header, file, path)


def _meta_header(file: IO[bytes]) -> dict[str, str]:
    """The lines `name = value` up to the one that says where the values are."""
    found: dict[str, str] = {}
    while "ElementDataFile" not in found and file.tell() < _HEADER and (line := file.readline(_HEADER)):
        name, _, value = line.decode("latin-1").partition("=")
        found[name.strip()] = value.strip()
    return found


def _check_meta_body(header: dict[str, str], file: IO[bytes], path: Path) -> None:
    """Count the bytes of values from where the file stands, decompressed; at its end zlib compares its checksum."""
    kind = header.get("ElementType", "")
    if kind not in _META_SIZES:
        raise ScanError(f"expected an element type among {', '.join(_META_SIZES)}, got {kind[:40]!r} in {path}")
    shape = [int(n) for n in header.get("DimSize", "").split()]
    channels = int(header.get("ElementNumberOfChannels", 1))
    check_memory([*shape, channels], np.dtype(f"u{_META_SIZES[kind]}"), path)
    if header.get("BinaryData", "True").lower().startswith("f"):
        return
    wanted = math.prod(shape) * channels * _META_SIZES[kind]
    packed = header.get("CompressedData", "False").lower().startswith("t")
    skipped = int(header.get("HeaderSize", 0))
    file.seek(max(0, path.stat().st_size - wanted) if skipped < 0 else file.tell() + skipped)
    stream, count = decompressed(file, "zlib" if packed else "raw"), 0
    while count <= wanted and (piece := stream.read(1 << 20)):
        count += len(piece)
    if count != wanted:
        raise Damaged(f"{wanted} bytes of values by its header, {'more' if count > wanted else count} in the file")
