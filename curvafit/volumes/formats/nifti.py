"""NIfTI: x,y,z in the file, z,y,x here; zooms, units and affine both ways."""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel.volumeutils import apply_read_scaling

from curvafit.volumes.formats.base import Raw, ScanError, complaints, normalise_unit
from curvafit.volumes.formats.part import Part, part_of
from curvafit.volumes.formats.streams import mapped, read_numbers

#: Our unit -> (NIfTI's, factor to it).
_TO_FILE = {
    "voxel": ("unknown", 1.0),
    "nm": ("micron", 1e-3),
    "um": ("micron", 1.0),
    "mm": ("mm", 1.0),
    "m": ("meter", 1.0),
}


def read_nifti(path: Path, *, part: Part | None = None, **_: object) -> Raw:
    """Values, zooms, unit and affine. Without a unit, zooms other than 1 are taken for mm, as NIfTI's readers do."""
    with complaints("nibabel.global") as said:
        image: Any = nibabel.load(path)
        raw = _values(image, path, part)
    zooms = tuple(float(f"{h:.7g}") for h in image.header.get_zooms())[:3]  # stored as float32
    if len(zooms) < 3:
        raise ScanError(f"expected a 3D volume, got {len(image.shape)}D of shape {image.shape[::-1]} in {path}")
    unit = image.header.get_xyzt_units()[0]
    affine = np.array(image.affine, dtype=np.float64)
    spacing: tuple[float, ...] | None = (1.0,) * (raw.values.ndim - 3) + zooms[::-1]
    guesses = [f"The file's header is mended: {text}." for text in dict.fromkeys(said)]
    wrote = _own_unit(image.header)
    if wrote:
        unit, factor = wrote
        affine[:3] *= factor
        spacing = (1.0,) * (raw.values.ndim - 3) + tuple(h * factor for h in zooms[::-1])
    elif unit == "unknown" and all(h == 1 for h in zooms):
        spacing = None
    elif unit == "unknown":
        unit = "mm"
        guesses.append("The file names no unit of length: mm is assumed.")
    lengths = np.linalg.norm(affine[:3, :3], axis=0)[::-1]
    if spacing is not None and not np.allclose(lengths, spacing[-3:], rtol=0.01):
        guesses.append("The file's affine and voxel sizes disagree: the voxel sizes are used.")
    return raw._replace(spacing=spacing, unit=unit, affine=affine, guesses=tuple(guesses))


def _values(image: Any, path: Path, part: Part | None) -> Raw:
    """The scaled values, z first, of a file that ends with them and whose checksum, if it is compressed, holds.

    Of one that is not compressed a part is read alone.
    """
    stored, packed = image.dataobj, path.name.lower().endswith(".gz")
    shape = stored.shape[::-1]
    long = [axis for axis, n in enumerate(shape[:-3]) if n != 1]
    channels = long[0] if len(long) == 1 else None
    if part is not None and not packed:
        raw = part_of(mapped(path, stored.offset, shape, stored.dtype), part, path, channels)
    else:
        with gzip.open(path) if packed else path.open("rb") as stream:
            stream.seek(stored.offset)
            raw = Raw(read_numbers(stream, shape, stored.dtype, path), channels=channels)
    scaled = apply_read_scaling(raw.values, np.asanyarray(stored.slope), np.asanyarray(stored.inter))
    return raw._replace(values=scaled)


def write_nifti(field: Any, path: Path) -> None:
    """`field` with qform and sform set to its affine (or to its spacing) and the unit named."""
    values = field.values.view(np.uint8) if field.values.dtype == bool else field.values
    if values.dtype == np.float16:
        values = values.astype(np.float32)
    unit, factor = _TO_FILE[field.unit]
    affine = np.diag([*field.spacing[::-1], 1.0]) if field.affine is None else field.affine.copy()
    affine[:3] *= factor
    image = nibabel.Nifti1Image(values.T, affine, dtype=values.dtype)
    image.header.set_xyzt_units(unit)
    image.header.set_zooms([h * factor for h in field.spacing[::-1]])
    image.set_qform(affine, code="aligned")
    image.set_sform(affine, code="aligned")
    if field.unit in ("voxel", "nm"):
        image.header["descrip"] = f"curvafit unit={field.unit}".encode()
    nibabel.save(image, path)


def write_nifti_like(values: np.ndarray, like: Path, path: Path, unit: str | None = None) -> None:
    """`values` (Z, Y, X) with the header of another NIfTI file of that shape: its affines, codes and zooms to the bit.

    Only what tells of its values (type, scale, range, intent) is set anew, and the unit, if one is named: what the
    numbers of that file then are. NIfTI has neither nm nor cm, which alone are converted.

    Raises
    ------
    ScanError
        If the other file has another number of voxels.
    """
    with complaints("nibabel.global"):
        image: Any = nibabel.load(like)
    header = image.header.copy()
    if math.prod(image.shape) != values.size:
        raise ScanError(f"expected values of the file's shape {image.shape[::-1]}, got {values.shape}")
    header.set_data_dtype(values.dtype)
    header.set_slope_inter(1, 0)
    header.set_intent("none")
    header["cal_min"] = header["cal_max"] = 0
    if unit is not None:
        _rename(header, unit)
    nibabel.save(type(image)(values.T.reshape(image.shape), None, header), path)


def _own_unit(header: Any) -> tuple[str, float] | None:
    """The unit that `write_nifti` left in the description because NIfTI has no code for it, and the factor to it."""
    wrote = re.match(r"curvafit unit=(\w+)", bytes(header["descrip"]).decode("latin-1"))
    if wrote is None:
        return None
    unit, _ = normalise_unit(wrote[1])
    return unit, 1 / _TO_FILE[unit][1]


def _rename(header: Any, unit: str) -> None:
    """Name the unit of lengths that `read_nifti` would give."""
    name, factor = normalise_unit(unit)
    code, into = _TO_FILE[name]
    own = _own_unit(header)
    scale = factor * into * (own[1] if own else 1.0)
    header.set_xyzt_units(code, header.get_xyzt_units()[1])
    if scale != 1:
        header["pixdim"][1:4] *= scale
        for key in ("srow_x", "srow_y", "srow_z", "qoffset_x", "qoffset_y", "qoffset_z"):
            header[key] = header[key] * scale
    if own or name in ("voxel", "nm"):
        header["descrip"] = f"curvafit unit={name}".encode() if name in ("voxel", "nm") else b""
