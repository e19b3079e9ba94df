"""NIfTI: x, y, z in the file, z, y, x here; zooms, units and affines are read and written."""

from __future__ import annotations

import gzip
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.units import parse_unit
from curvafit.volumes.formats.base import ScanError, Stated, collect_complaints, map_numbers, read_numbers

#: Uncompressed bytes in each member of a gzip file.
MEMBER = 2**28
#: Our unit -> (NIfTI's, factor to it).
_TO_FILE = {"voxel": ("unknown", 1.0), "nm": ("micron", 1e-3), "um": ("micron", 1.0)}
_TO_FILE |= {"mm": ("mm", 1.0), "m": ("meter", 1.0)}


def read_nifti(path: Path, **_: object) -> Stated:
    """Read values, voxel sizes, unit and affine; lengths without a unit are taken to be in mm, as is usual."""
    import nibabel

    with collect_complaints("nibabel.global") as repairs:
        image: Any = nibabel.load(path)
    header, affine = image.header, np.array(image.affine, dtype=np.float64)
    zooms = tuple(float(f"{h:.7g}") for h in header.get_zooms())[:3]  # stored as float32
    if len(zooms) < 3:
        raise ScanError(f"a volume must be 3D, got {len(image.shape)}D of shape {image.shape[::-1]} in {path}")
    forms = [image.get_sform(coded=True)[0], image.get_qform(coded=True)[0]]  # None where the code is 0
    has_affine = any(form is not None for form in forms)
    steps = zooms[::-1]
    unit, implied_unit = header.get_xyzt_units()[0], "voxel"
    guesses = [f"The file's header is mended: {text}." for text in dict.fromkeys(repairs)]
    if described := _described_unit(header):
        unit, factor = described
        affine[:3] *= factor
        steps = tuple(h * factor for h in zooms[::-1])
    elif unit == "unknown":
        unit = None
        if any(h != 1 for h in zooms) or (has_affine and not np.allclose(affine, np.eye(4))):
            implied_unit = "mm"
            guesses.append("The file names no unit of length: mm is assumed.")
        else:
            steps = None
    lengths = np.linalg.norm(affine[:3, :3], axis=0)[::-1]
    if has_affine and steps is not None and not np.allclose(lengths, steps, rtol=0.01):
        guesses.append("The file's affine and voxel sizes disagree: the voxel sizes are used.")
    notes: tuple[str, ...] = ()
    if all(form is not None for form in forms) and not np.allclose(*forms, rtol=1e-3, atol=0.01 * min(zooms)):
        notes = ("The file states two places that differ, an sform and a qform: the sform is used.",)
    array, axes = _open_values(image, path)
    affine = affine if has_affine else None  # nibabel would make one up, with x from right to left
    return Stated(array, axes, steps, (unit,) * 3, None, affine, implied_unit, notes, tuple(guesses))


def _open_values(image: Any, path: Path) -> tuple[Any, str]:
    """Return the scaled values, z first, and the letters of their axes; an uncompressed file is mapped, not read."""
    proxy, compressed = image.dataobj, path.name.lower().endswith(".gz")
    shape = proxy.shape[::-1]
    # NIfTI's fourth axis is time, but programs use it for channels: it is taken for channels where no other axis beyond
    # space has more than one entry, unless the header has a unit of time.
    long = [axis for axis, n in enumerate(shape[:-3]) if n != 1]
    has_times = len(long) > 1 or image.header.get_xyzt_units()[1] in ("sec", "msec", "usec")
    time = long[-1] if long and long[-1] == len(shape) - 4 and has_times else None
    channel = next((axis for axis in long if axis != time), None)
    letters = ("t" if axis == time else "c" if axis == channel else "?" for axis in range(len(shape) - 3))
    if compressed:
        with gzip.open(path) as stream:
            stream.seek(proxy.offset)
            array = read_numbers(stream, shape, proxy.dtype, path)
    else:
        array = map_numbers(path, proxy.offset, shape, proxy.dtype)
    if (proxy.slope, proxy.inter) != (1, 0):
        scaled = Scaled(array, np.asanyarray(proxy.slope), np.asanyarray(proxy.inter))
        array = scaled[...] if compressed else scaled
    return array, "".join(letters) + "zyx"


class Scaled:
    """An array of values times a slope, plus an intercept."""

    def __init__(self, array: np.ndarray, slope: np.ndarray, intercept: np.ndarray) -> None:
        self.array, self.slope, self.intercept, self.shape = array, slope, intercept, array.shape
        self.dtype = self._scale(np.zeros(1, array.dtype)).dtype

    def __getitem__(self, index: Any) -> np.ndarray:
        return self._scale(self.array[index])

    def _scale(self, values: np.ndarray) -> np.ndarray:
        from nibabel.volumeutils import apply_read_scaling

        return apply_read_scaling(values, self.slope, self.intercept)  # type: ignore[arg-type]


def write_nifti(field: Any, path: Path) -> None:
    """Write a field with its unit and its affine as qform and sform; without an affine, with its spacing."""
    import nibabel

    values = field.values.view(np.uint8) if field.values.dtype == bool else field.values
    if values.dtype == np.float16:
        values = values.astype(np.float32)
    affine = affine_in_file(field)
    image = nibabel.Nifti1Image(values.T, affine, dtype=values.dtype)
    image.header.set_xyzt_units(_TO_FILE[field.unit][0])
    image.set_qform(affine, code="aligned")
    image.set_sform(affine, code="aligned")
    if field.unit in ("voxel", "nm"):
        image.header["descrip"] = f"curvafit unit={field.unit}".encode()
    _save(image, path)


def affine_in_file(field: Any) -> np.ndarray:
    """Return the affine (x, y, z) that a field has in a NIfTI file, in the file's unit."""
    affine = np.diag([*field.spacing[::-1], 1.0]) if field.affine is None else field.affine.copy()
    affine[:3] *= _TO_FILE[field.unit][1]
    return affine


def write_nifti_like(values: np.ndarray, like: Path, path: Path, unit: str | None = None) -> None:
    """Write values (Z, Y, X) with the header of another NIfTI file of that shape: same affines, codes and voxel sizes.

    Only the values' type, scale, range and intent are new. A given unit becomes that of the header's lengths if it has
    none; NIfTI has neither nm nor cm: lengths in these are converted.
    """
    import nibabel

    with collect_complaints("nibabel.global"):
        image: Any = nibabel.load(like)
    header = image.header.copy()
    if math.prod(image.shape) != values.size:
        raise ScanError(f"values must have the file's shape {image.shape[::-1]}, got {values.shape}")
    header.set_data_dtype(values.dtype)
    header.set_slope_inter(1, 0)
    header.set_intent("none")
    header["cal_min"] = header["cal_max"] = 0
    header_unit = (_described_unit(header) or header.get_xyzt_units())[0]
    if unit is not None and header_unit in ("voxel", "unknown"):
        _set_unit(header, unit)
    _save(type(image)(values.T.reshape(image.shape), None, header), path)


def _save(image: Any, path: Path) -> None:
    """Write an image; a .gz by libdeflate, three times as fast as zlib, in members so that it needs little memory."""
    from imagecodecs import gzip_encode

    buffer = io.BytesIO()
    image.to_stream(buffer)
    content, compressed = buffer.getbuffer(), path.name.lower().endswith(".gz")
    with path.open("wb") as stream:
        for start in range(0, len(content), MEMBER):
            member = content[start : start + MEMBER]
            stream.write(gzip_encode(bytes(member), level=1) if compressed else member)


def _described_unit(header: Any) -> tuple[str, float] | None:
    """Return the unit without a NIfTI code that `write_nifti` wrote into the description, and the factor to it."""
    match = re.match(r"curvafit unit=(\w+)", bytes(header["descrip"]).decode("latin-1"))
    if match is None:
        return None
    unit, _ = parse_unit(match[1])
    return unit, 1 / _TO_FILE[unit][1]


def _set_unit(header: Any, unit: str) -> None:
    """Set the unit of the lengths in a header, which are scaled only if NIfTI lacks the unit."""
    name, factor = parse_unit(unit)
    code, code_factor = _TO_FILE[name]
    scale, described = factor * code_factor, _described_unit(header)
    header.set_xyzt_units(code, header.get_xyzt_units()[1])
    if scale != 1:
        header["pixdim"][1:4] *= scale
        for key in ("srow_x", "srow_y", "srow_z", "qoffset_x", "qoffset_y", "qoffset_z"):
            header[key] = header[key] * scale
    if described or name in ("voxel", "nm"):  # an older description must not contradict the code
        header["descrip"] = f"curvafit unit={name}".encode() if name in ("voxel", "nm") else b""
