"""Options that several commands share, and the parsing of their texts."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from curvafit.cli.console import plain_errors, resumable, show_stages

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.core.workers import Workers

#: Whether files of other programs, or of other commands, may be replaced.
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace files or folders of the output's names, whatever wrote them.")
]


def examples(*lines: str) -> str:
    """Return the end of a command's help."""
    return "[bold]Examples[/bold]\n\n" + "\n\n".join(lines)


# ---- reading a volume ------------------------------------------------------------------------------------------------

_read = partial(typer.Option, rich_help_panel="How to read the file")

Volume = Annotated[
    str, typer.Argument(help="NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr …")
]
#: The options as `curvafit.load` takes them, which `reads_volume` gives to a command.
Reading = dict[str, Any]


def parse_reading(
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
    """Return the options as `curvafit.load` takes them; raise ValueError where one is malformed."""
    if unit is not None:
        from curvafit.core.units import parse_unit

        parse_unit(unit)
    if crop is not None:
        from curvafit.volumes.formats.part import parse_box

        parse_box(crop)
    return {
        "spacing": None if spacing is None else parse_triple(spacing, "--spacing"),
        "unit": unit,
        "channel": channel,
        "label": label,
        "crop": crop,
        "raw_shape": None if raw_shape is None else parse_whole_triple(raw_shape, "--raw-shape"),
        "dtype": dtype,
        "key": key,
        "strict": strict,
    }


def reads_volume(command: Callable[..., None]) -> Callable[..., None]:
    """Put the options of reading a volume in the place of a command's parameter `reading`."""
    options = inspect.signature(parse_reading, eval_str=True).parameters
    own = inspect.signature(command, eval_str=True).parameters

    @functools.wraps(command)
    def reader(**arguments: Any) -> None:
        with plain_errors():
            reading = parse_reading(**{name: arguments.pop(name) for name in options})
        command(**arguments, reading=reading)

    parameters = [each for name in own for each in (options.values() if name == "reading" else (own[name],))]
    reader.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    )
    reader.__annotations__ = {each.name: each.annotation for each in parameters}
    return reader


# ---- workers ---------------------------------------------------------------------------------------------------------

WorkersOption = Annotated[
    int | None,
    typer.Option(help="Worker processes on this machine; by default one per core, 0 for this process alone."),
]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Address of a running dask scheduler, tcp://HOST:PORT, instead of --workers.")
]
DashboardOption = Annotated[
    int | None,
    typer.Option(help="Port of dask's dashboard on 127.0.0.1, for workers on this machine; by default none."),
]


class Crew(NamedTuple):
    """The workers that the options ask for."""

    workers: int | None
    scheduler: str | None
    dashboard: int | None

    def check(self, shape: Sequence[int] | None = None) -> None:
        """Raise ValueError where the options contradict each other, or a shape does not fit into memory."""
        from curvafit.core.runtime import FLOW, check_memory
        from curvafit.core.workers import check_workers

        check_workers(self.workers, self.scheduler)
        if shape is not None and self.scheduler is None:
            check_memory(shape, FLOW, "a shape")

    @contextmanager
    def at_work(self, again: Callable[[], str] = lambda: "the same command") -> Iterator[tuple[Workers, Progress]]:
        """Start the workers and their progress bar; `again` returns the command that resumes after an interrupt."""
        from curvafit.core.workers import cluster

        with resumable(again), show_stages() as progress:
            progress("starting workers", 0.0)
            with cluster(*self) as workers:
                yield workers, progress


# ---- parsing ---------------------------------------------------------------------------------------------------------


def parse_numbers(text: str, option: str, count: int) -> tuple[float, ...]:
    """Return a text as `count` finite numbers between commas."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        what = "a number" if count == 1 else f"{count} numbers between commas"
        raise ValueError(f"{option} must be {what}, got {text!r}")
    return values


def parse_triple(text: str, option: str) -> tuple[float, float, float]:
    """Return a text as three positive numbers; one counts for all axes."""
    values = parse_numbers(text, option, 1) * 3 if "," not in text else parse_numbers(text, option, 3)
    if min(values) <= 0:
        raise ValueError(f"{option} must be positive, got {text!r}")
    return values  # type: ignore[return-value]


def parse_whole_triple(text: str, option: str) -> tuple[int, int, int]:
    """Return a text as three positive whole numbers; one counts for all axes."""
    values = parse_triple(text, option)
    if any(value != int(value) for value in values):
        raise ValueError(f"{option} must be whole numbers, got {text!r}")
    return tuple(int(value) for value in values)  # type: ignore[return-value]


def parse_whole_numbers(text: str, option: str) -> tuple[int, ...]:
    """Return a text as whole numbers from 0."""
    values = parse_numbers(text, option, text.count(",") + 1)
    if min(values) < 0 or any(value != int(value) for value in values):
        raise ValueError(f"{option} must be whole numbers from 0, got {text!r}")
    return tuple(int(value) for value in values)


def parse_device(text: str) -> str:
    """Return the name of a device, or raise ValueError where this machine does not have it."""
    import torch

    try:
        kind = torch.device(text).type
    except RuntimeError:
        kind = ""
    devices = {"cpu": True, "cuda": torch.cuda.is_available()}
    if not devices.get(kind):
        names = ", ".join(name for name, available in devices.items() if available)
        raise ValueError(f"--device must be one of this machine's ({names}), got {text!r}")
    return text


def parse_threshold(text: str) -> float | str:
    """Return a text as a grey level, or `"otsu"`."""
    return text.lower() if text.lower() == "otsu" else parse_numbers(text, "--threshold", 1)[0]
