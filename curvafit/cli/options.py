"""Options that several commands share, and the parsing of their texts."""

from __future__ import annotations

import functools
import inspect
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_args

import typer

from curvafit.cli.console import plain_errors, resumable, show_stages

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.core.workers import Cluster

#: Whether files of other programs, or of other commands, may be replaced.
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace files that another command wrote.")]


#: Parameters of commands that are volumes to read; those that are laws, each with the name of its option.
_VOLUMES = ("scan", "scans", "slices", "roi", "image", "example", "example_probabilities", "like",
            "like_mask", "start")  # fmt: skip
_LAWS = {"preset": "--preset", "prior": "--prior", "laws": "--prior (or --preset)"}


# ---- commands --------------------------------------------------------------------------------------------------------


def command(*examples: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a function a command, with examples at the end of its help.

    The command prints expected errors as one sentence. In place of a parameter that is a `Group` it has the
    options from which the group's value is made.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        parameters = inspect.signature(function, eval_str=True).parameters
        makers = {
            name: extra.make for name, value in parameters.items() for extra in get_args(value.annotation)[1:]
            if isinstance(extra, Group)
        }  # fmt: skip
        groups = {name: inspect.signature(make, eval_str=True).parameters for name, make in makers.items()}

        @functools.wraps(function)
        def run(**arguments: Any) -> None:
            with plain_errors():
                _check_inputs(arguments)
                for name, make in makers.items():
                    arguments[name] = make(**{option: arguments.pop(option) for option in groups[name]})
                function(**arguments)

        # typer reads a command's options from signature and annotations: these list a group's options in its place.
        options = [option for name in parameters for option in groups.get(name, {name: parameters[name]}).values()]
        keywords = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
        run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
        run.__annotations__ = {option.name: option.annotation for option in options}
        run.examples = "\n\n".join(["[bold]Examples[/bold]", *examples]) if examples else None  # type: ignore[attr-defined]
        return run

    return decorate


class Group(NamedTuple):
    """A parameter that is made from several options, `Annotated[dict[str, Any], Group(make)]`: those of `make`."""

    make: Callable[..., Any]


def _check_inputs(values: Mapping[str, Any]) -> None:
    """Raise an error if an option names a missing volume or an unknown law, before slow libraries are imported."""
    from curvafit.core.files import is_url

    for volumes in filter(None, map(values.get, _VOLUMES)):
        for path in map(str, volumes if isinstance(volumes, list) else [volumes]):
            file = path.rpartition("::")[0] or path  # without the key of an array, as in file.h5::key
            if not (os.path.exists(path) or os.path.exists(file) or is_url(path)):
                raise FileNotFoundError(f"no such file: {file}")
    from curvafit.core.checks import simplify_name
    from curvafit.priors.published import PUBLISHED, no_law

    for parameter, option in _LAWS.items():
        text = values.get(parameter)  # laws between commas, or a file, which may have a comma in its name
        for law in [] if text is None or text.endswith(".json") else text.split(","):
            if simplify_name(law) not in PUBLISHED and not law.endswith(".json") and not os.path.isfile(str(text)):
                raise no_law(law, f"{option} takes")


def add_commands(app: typer.Typer, *functions: Callable[..., None]) -> None:
    """Add commands to a group, each under the first word of its function's name."""
    for function in functions:
        app.command(function.__name__.partition("_")[0], epilog=getattr(function, "examples", None))(function)


_read = partial(typer.Option, rich_help_panel="How to read the file")
_work = partial(typer.Option, rich_help_panel="How to work")

FILES = "NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr, STL …"
Input = Annotated[str, typer.Argument(help=FILES)]


def parse_reading(
    spacing: Annotated[str | None, _read(help="Voxel edges Z,Y,X, or one number for all; overrides the file.")] = None,
    unit: Annotated[str | None, _read(help="Unit of lengths: nm, um, mm or m; overrides the file.")] = None,
    channel: Annotated[int | None, _read(help="Channel to read, counted from 0, of several (colours).")] = None,
    time: Annotated[int | None, _read(help="Time to read, counted from 0, of several.")] = None,
    label: Annotated[int | None, _read(help="Label of the structure: the voxels with this value.")] = None,
    crop: Annotated[str | None, _read(help="Box of voxels from 0: z0:z1,y0:y1,x0:x1; : is a whole axis.")] = None,
    raw_shape: Annotated[str | None, _read(help="Voxels Z,Y,X of a RAW file.")] = None,
    dtype: Annotated[str | None, _read(help="Type of the numbers in a RAW file: u1, u2, f4 …")] = None,
    key: Annotated[str | None, _read(help="Name of the array in an NPZ, HDF5 or Zarr file.")] = None,
    strict: Annotated[bool, _read("--strict", help="Refuse a volume with missing chunks or slices.")] = False,
) -> dict[str, Any]:
    """Return the options as `curvafit.load` takes them; raise ValueError where one is malformed."""
    edges = None if spacing is None else parse_triple(spacing, "--spacing")
    voxels = None if raw_shape is None else parse_whole_triple(raw_shape, "--raw-shape")
    reading = {"spacing": edges, "unit": unit, "channel": channel, "time": time, "label": label, "crop": crop}
    return reading | {"raw_shape": voxels, "dtype": dtype, "key": key, "strict": strict}


Reading = Annotated[dict[str, Any], Group(parse_reading)]


def parse_structure(
    kind: Annotated[str, typer.Option(help="Kind of volume: auto, field, mask or image.")] = "auto",
    periodic: Annotated[bool, typer.Option("--periodic", help="The box repeats (generated fields).")] = False,
    threshold: Annotated[str, typer.Option(help="Grey level between the phases, or otsu.")] = "otsu",
    dark: Annotated[bool, typer.Option("--dark", help="The structure is the dark phase.")] = False,
) -> dict[str, Any]:
    """Return the options on what is structure in a scan; raise ValueError where one is malformed."""
    return {"kind": kind, "periodic": periodic, "threshold": parse_threshold(threshold), "dark": dark}


Structure = Annotated[dict[str, Any], Group(parse_structure)]


def parse_working(
    epsilon: Annotated[float | None, _work(help="ε in the scan's unit; by default twice the smallest edge.")] = None,
    steps: Annotated[int, _work(help="Steps of the flow.", min=1)] = 400,
    tile: Annotated[int | None, _work(help="Side of a tile or block in voxels: large files have some.", min=8)] = None,
    workers: Annotated[int | None, _work(help="Processes for tiles; by default this one.", min=0)] = None,
) -> dict[str, Any]:
    """Return the options of a flow and its tiles, as `curvafit.segmentation.Working` takes them."""
    return {"epsilon": epsilon, "steps": steps, "tile": tile, "workers": workers}


Working = Annotated[dict[str, Any], Group(parse_working)]


@dataclass(frozen=True)
class Crew:
    """The workers that the options ask for."""

    workers: Annotated[int | None, typer.Option(help="Worker processes; by default one per core, 0 is this one.")] = (
        None
    )
    scheduler: Annotated[str | None, typer.Option(help="Address of a dask scheduler, tcp://HOST:PORT.")] = None

    def check_memory(self, shape: Sequence[int]) -> None:
        """Raise ValueError where a shape does not fit into this machine's memory, if it is made here."""
        from curvafit.core.runtime import FLOW, check_memory

        if self.scheduler is None:
            check_memory(shape, FLOW, "a shape")

    @contextmanager
    def start(self, kept: Path) -> Iterator[tuple[Cluster | None, Progress]]:
        """Start the workers and their progress bar; after an interrupt the same command resumes what is `kept`."""
        from curvafit.core.workers import cluster

        with resumable(kept), show_stages() as progress:
            progress("starting workers", 0.0)
            with cluster(self.workers, self.scheduler) as workers:
                yield workers, progress


Workers = Annotated[Crew, Group(Crew)]


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
    return _round(parse_triple(text, option), option)  # type: ignore[return-value]


def parse_whole_numbers(text: str, option: str) -> tuple[int, ...]:
    """Return a text as whole numbers from 0."""
    # Digits alone are read as integers, as a float does not hold the labels of 64 bits.
    if all(part.strip().isdecimal() for part in text.split(",")):
        return tuple(map(int, text.split(",")))
    return _round(parse_numbers(text, option, text.count(",") + 1), option)


def _round(values: tuple[float, ...], option: str) -> tuple[int, ...]:
    """Return numbers as integers; raise ValueError where one is negative or not whole."""
    if min(values) < 0 or any(value != int(value) for value in values):
        raise ValueError(f"{option} must be whole numbers from 0, got {', '.join(f'{value:g}' for value in values)}")
    return tuple(int(value) for value in values)


def parse_threshold(text: str) -> float | str:
    """Return a text as a grey level, or `"otsu"`."""
    return text.lower() if text.lower() == "otsu" else parse_numbers(text, "--threshold", 1)[0]
