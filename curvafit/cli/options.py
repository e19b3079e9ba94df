"""The options of reading a volume file, the same for every command."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer

from curvafit.cli.console import plainly, triple, whole_triple

_read = partial(typer.Option, rich_help_panel="How to read the file")

Volume = Annotated[
    str, typer.Argument(help="NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr …")
]
#: The options as `curvafit.load` takes them, which `reads_volume` gives to a command.
Reading = dict[str, Any]


def reading_of(
    spacing: Annotated[str | None, _read(help="Voxel edges Z,Y,X, or one number for all; overrides the file.")] = None,
    unit: Annotated[str | None, _read(help="Unit of lengths: nm, um, mm or m; overrides the file.")] = None,
    channel: Annotated[int | None, _read(help="Channel to read, counted from 0, of several (colours, times).")] = None,
    label: Annotated[int | None, _read(help="Label of the structure: the voxels with this value.")] = None,
    crop: Annotated[
        str | None, _read(help="Box of voxels: z0:z1,y0:y1,x0:x1, counted from 0; : is all of an axis.")
    ] = None,
    raw_shape: Annotated[str | None, _read(help="Voxels Z,Y,X of a RAW file.")] = None,
    dtype: Annotated[str | None, _read(help="Type of the numbers in a RAW file: u1, u2, f4 …")] = None,
    key: Annotated[str | None, _read(help="Name of the array in an NPZ, HDF5 or Zarr file.")] = None,
    strict: Annotated[bool, _read("--strict", help="Refuse a volume with missing chunks or slices.")] = False,
) -> Reading:
    """Return the options as `curvafit.load` takes them.

    Raises
    ------
    ValueError
        If an option does not have the form that its help states.
    """
    if unit is not None:
        from curvafit.core.units import parse_unit

        parse_unit(unit)
    if crop is not None:
        from curvafit.volumes.formats.part import parse_box

        parse_box(crop)
    return {
        "spacing": None if spacing is None else triple(spacing, "--spacing"),
        "unit": unit,
        "channel": channel,
        "label": label,
        "crop": crop,
        "raw_shape": None if raw_shape is None else whole_triple(raw_shape, "--raw-shape"),
        "dtype": dtype,
        "key": key,
        "strict": strict,
    }


def reads_volume(command: Callable[..., None]) -> Callable[..., None]:
    """Put the options of reading a volume in the place of a command's parameter `reading`."""
    options = inspect.signature(reading_of, eval_str=True).parameters
    own = inspect.signature(command, eval_str=True).parameters

    @functools.wraps(command)
    def reader(**arguments: Any) -> None:
        with plainly():
            reading = reading_of(**{name: arguments.pop(name) for name in options})
        command(**arguments, reading=reading)

    parameters = [each for name in own for each in (options.values() if name == "reading" else (own[name],))]
    reader.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    )
    reader.__annotations__ = {each.name: each.annotation for each in parameters}
    return reader
