"""Volume files to `Field` and back."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from curvafit.files import check_free, write_atomically
from curvafit.volumes.field import Field
from curvafit.volumes.formats import READERS, WRITERS, ScanError, pick_writer
from curvafit.volumes.formats.ngff import is_ours, mark
from curvafit.volumes.source import Source, field_of, load, read_values

__all__ = ["READABLE", "WRITABLE", "Field", "ScanError", "load", "read_values", "save"]

#: Suffixes that `load` and `save` know.
READABLE = tuple(READERS)
WRITABLE = tuple(WRITERS)


def save(
    source: Source,
    path: str | os.PathLike[str],
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    kind: str = "volume",
    overwrite: bool = False,
) -> Path:
    """Write a volume as NIfTI, TIFF, NPY, MRC or Zarr, by suffix.

    A file of that name is replaced once the new one is whole; a folder only if it is empty or a Zarr store that `save`
    wrote with the same `kind`, or with `overwrite`.

    NIfTI keeps the affine (qform and sform) and the unit; TIFF (ImageJ's or OME's metadata), MRC (in Å) and Zarr
    (OME-NGFF 0.5, with halved copies of a large volume) spacing and unit; NPY the values only.

    Parameters
    ----------
    source
        A `Field`, an array or tensor (Z, Y, X), or the path of another volume file.
    spacing, unit
        Of an array, or in place of what another file says: see `field_of`.

    Raises
    ------
    ScanError
        If the suffix is unknown, the format cannot hold the values' type, or it needs a unit and there is none; or if
        the source is no volume.
    ValueError
        If another folder stands there.
    """
    field = field_of(source, spacing=spacing, unit=unit)
    target = Path(path)
    writer = pick_writer(target, field.unit)
    check_free([target], lambda there: not there.is_dir() or is_ours(there, kind), overwrite=overwrite)

    def write(temporary: Path) -> None:
        writer(field, temporary)
        if temporary.is_dir():
            mark(temporary, kind)

    return write_atomically(target, write)
