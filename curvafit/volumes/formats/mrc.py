"""MRC files and CCP4 maps, by mrcfile of the extra `[io]`; lengths are in Å."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.extras import require
from curvafit.core.units import convert_length
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import ScanError, Stated

#: IMOD's stamp, from byte 152 on: its flags follow, the first of which says that bytes are signed.
_IMOD = 1146047817


def read_mrc(path: Path, **_: object) -> Stated:
    """Read an MRC file: axes as the header orders them, at its origin or, without one, at the start of its part."""
    mrcfile = require("mrcfile", "io", "reading and writing MRC files")
    with (
        warnings.catch_warnings(record=True, action="always") as odd,
        mrcfile.open(path, permissive=True, header_only=True) as file,
    ):
        header, size = file.header, file.voxel_size
        shape, dtype = mrcfile.utils.data_shape_from_header(header), mrcfile.utils.data_dtype_from_header(header)
    notes = [f"The file's header is odd: {each.message}." for each in odd if issubclass(each.category, RuntimeWarning)]
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
    columns = [int(header[name]) for name in ("maps", "mapr", "mapc")]  # 1 is x
    axes = "".join("xyz"[k - 1] for k in columns) if sorted(columns) == [1, 2, 3] else "zyx"
    edges = {letter: float(size[letter]) for letter in "xyz"}
    first = {letter: float(header.origin[letter]) for letter in "xyz"}
    starts = (header.nzstart, header.nystart, header.nxstart)  # of sections, rows and columns
    begin = {letter: float(n) * edges[letter] for letter, n in zip(axes, starts, strict=True)}
    if not any(first.values()):
        first = begin
    elif any(begin.values()) and not np.allclose(list(first.values()), [begin[k] for k in first], rtol=1e-3):
        notes.append("The header states an origin and another first voxel (nstart): the origin is used.")
    if header.ispg == 0 and stamp != _IMOD and values.shape[0] > 1:
        notes.append("By its header the file is a stack of images (space group 0): it is read as a volume.")
    several = values.ndim - 3
    steps, origin = ([0.0] * several + [each[letter] for letter in axes] for each in (edges, first))
    known = math.prod(edges.values()) > 0
    axes, units = "c" * several + axes, ("angstrom" if known else None,) * values.ndim
    return Stated(values, axes, steps if known else None, units, origin if known else None, notes=tuple(notes))


def check_mrc(unit: str, values: np.ndarray | None = None) -> None:
    """Raise ScanError if lengths have no unit or values no type of MRC's, and ImportError without the library, before
    `write_mrc`."""
    require("mrcfile", "io", "reading and writing MRC files")
    if unit == "voxel":
        raise ScanError("an MRC file holds voxel sizes in Å: give the unit, nm, um, mm or m")
    if values is not None and values.dtype.kind in "iu" and values.dtype.itemsize > 2:
        raise ScanError(f"an MRC file holds whole numbers of at most 16 bits or floats, got {values.dtype}")


def write_mrc(field: Any, path: Path) -> None:
    """Write a volume with its voxel sizes and its place in Å; instead of float64, bool, uint8 write float32, int8,
    uint16."""
    kind = {"bool": "int8", "float64": "float32", "uint8": "uint16"}.get(field.values.dtype.name)
    values = field.values if kind is None else field.values.astype(kind)
    with require("mrcfile", "io", "reading and writing MRC files").new(path, values, overwrite=True) as file:
        file.voxel_size = tuple(convert_length(h, field.unit, "angstrom") for h in field.spacing[::-1])
        file.header.origin = tuple(convert_length(x, field.unit, "angstrom") for x in base.first_voxel(field)[::-1])
