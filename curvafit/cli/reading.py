"""The options of reading a volume file, the same for every command."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import typer

from curvafit.cli.support import triple, whole_triple

_read = partial(typer.Option, rich_help_panel="How to read the file")

Volume = Annotated[
    str, typer.Argument(help="NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr …")
]
Spacing = Annotated[str | None, _read(help="Voxel edges Z,Y,X, or one number for all; overrides the file.")]
Unit = Annotated[str | None, _read(help="Unit of lengths: nm, um, mm or m; overrides the file.")]
Channel = Annotated[int | None, _read(help="Channel to read, counted from 0, of several (colours, times).")]
Label = Annotated[int | None, _read(help="Label of the structure: the voxels with this value.")]
Crop = Annotated[str | None, _read(help="Box of voxels: z0:z1,y0:y1,x0:x1, counted from 0; : is all of an axis.")]
RawShape = Annotated[str | None, _read(help="Voxels Z,Y,X of a RAW file.")]
Dtype = Annotated[str | None, _read(help="Type of the numbers in a RAW file: u1, u2, f4 …")]
Key = Annotated[str | None, _read(help="Name of the array in an NPZ, HDF5 or Zarr file.")]
Strict = Annotated[bool, _read("--strict", help="Refuse a volume with missing chunks or slices.")]


def reading_of(
    *, spacing: str | None, unit: str | None, crop: str | None, raw_shape: str | None = None, **others: Any
) -> dict[str, Any]:
    """Return the options as `curvafit.load` takes them.

    Raises
    ------
    ValueError
        If an option does not have the form that its help states.
    """
    if unit is not None:
        from curvafit.volumes.formats import normalise_unit

        normalise_unit(unit)
    if crop is not None:
        from curvafit.volumes.formats.part import box_of

        box_of(crop)
    return {
        "spacing": None if spacing is None else triple(spacing, "--spacing"),
        "unit": unit,
        "crop": crop,
        "raw_shape": None if raw_shape is None else whole_triple(raw_shape, "--raw-shape"),
        **others,
    }
