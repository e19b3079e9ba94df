"""Writing a `Field` to a volume file; reading is in `curvafit.volumes.source`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from curvafit.core.files import check_free, write_atomically
from curvafit.core.records import is_own_zarr
from curvafit.volumes.field import Field
from curvafit.volumes.formats import READERS, WRITERS, ScanError, pick_writer
from curvafit.volumes.formats.ngff import mark
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

    A file of that name is replaced once the new one is whole. A folder is replaced only if it is empty, if it is a Zarr
    store that `save` wrote with the same `kind`, or with `overwrite`.

    NIfTI keeps the affine (qform and sform) and the unit. TIFF (ImageJ's or OME's metadata), MRC (in Å) and Zarr
    (OME-NGFF 0.5, with halved copies of a large volume) keep spacing and unit. NPY keeps the values only.

    Parameters
    ----------
    source
        A `Field`, an array or tensor (Z, Y, X), or the path of another volume file.
    spacing, unit
        Spacing and unit of an array, or in place of those of another file: see `field_of`.
    kind
        The mark of a Zarr store: what the store is for.
    overwrite
        Whether any other folder of that name may be replaced.

    Raises
    ------
    ScanError
        If the suffix is unknown, the format cannot hold the values' type, the format needs a unit and the volume has
        none, or the source is not a volume.
    ValueError
        If another folder has that name.
    """
    field = field_of(source, spacing=spacing, unit=unit)
    target = Path(path)
    writer = pick_writer(target, field.unit)
    check_free([target], lambda there: not there.is_dir() or is_own_zarr(there, kind), overwrite=overwrite)

    def write(temporary: Path) -> None:
        writer(field, temporary)
        if temporary.is_dir():
            mark(temporary, kind)

    return write_atomically(target, write)
