"""The options that say how a volume file is read, the same at every command that reads one."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import typer

from curvafit.cli.support import triple, whole_triple

_read = partial(typer.Option, rich_help_panel="How to read the file")

Volume = Annotated[
    str, typer.Argument(help="NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr …")
]
Spacing = Annotated[str | None, _read(help="Voxel edges z,y,x, or one for all; overrides the file.")]
Unit = Annotated[str | None, _read(help="nm, um, mm or m; overrides the file.")]
Channel = Annotated[int | None, _read(help="Which channel, counted from 0, of a file of several (colours, times).")]
Label = Annotated[int | None, _read(help="The structure is where the volume has this value.")]
Crop = Annotated[str | None, _read(help="Box of voxels: z0:z1,y0:y1,x0:x1, counted from 0; : is all of an axis.")]
RawShape = Annotated[str | None, _read(help="Z,Y,X of a RAW file.")]
Dtype = Annotated[str | None, _read(help="Type of a RAW file: u1, u2, f4 …")]
Key = Annotated[str | None, _read(help="Array within an NPZ, HDF5 or Zarr file.")]
Strict = Annotated[bool, _read("--strict", help="Refuse a volume of which chunks or slices are missing.")]


def reading_of(
    *, spacing: str | None, unit: str | None, crop: str | None, raw_shape: str | None = None, **others: Any
) -> dict[str, Any]:
    """Return the options as `curvafit.load` takes them.

    Raises
    ------
    ValueError
        If one is not what its help says.
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
