"""The command that measures scans."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, print_table, resumable, say, say_notes, show_stages
from curvafit.cli.options import (
    FILES,
    Group,
    OverwriteOption,
    Reading,
    Structure,
    command,
    parse_structure,
    parse_whole_triple,
)

if TYPE_CHECKING:
    from curvafit.scan.measures import Measures


def parse_windows(
    windows: Annotated[
        str | None,
        typer.Option(help="Map the numbers over windows of so many voxels, or Z,Y,X, into a folder: -o.", metavar="N"),
    ] = None,
    stride: Annotated[
        str | None,
        typer.Option(help="Voxels from window to window, by default half of one; divides --windows.", metavar="N"),
    ] = None,
    clusters: Annotated[int | None, typer.Option(help="Clusters of windows, by default 2.")] = None,
) -> dict[str, Any] | None:
    """Return the windows over which numbers are mapped, as `curvafit.windows` takes them; None for none."""
    if windows is None:
        if (stride, clusters) != (None, None):
            raise ValueError("--stride and --clusters go with --windows")
        return None
    size = parse_whole_triple(windows, "--windows")
    halves = tuple(n if n % 2 else n // 2 for n in size)
    steps = halves if stride is None else parse_whole_triple(stride, "--stride")
    return {"size": size, "stride": steps, "clusters": 2 if clusters is None else clusters}


@command(
    "curvafit measure bone.tif --spacing 0.0195 --unit mm",
    "curvafit measure mouse1.nii.gz mouse2.nii.gz mouse3.nii.gz --subjects mice.csv -o measures.csv",
    "curvafit measure femur.nii.gz --roi compartments.nii.gz -o femur.csv",
    "curvafit measure mitochondria_labels.tif --labels --spacing 5 --unit nm -o mitochondria.csv",
    "curvafit measure lung_2048.ome.zarr --workers 2 -o lung.csv",
    "curvafit measure bone.tif --windows 64 --stride 32 -o maps",
)
def measure(
    scans: Annotated[list[str], typer.Argument(help=FILES)],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Table (.csv .json .parquet), or a folder for page, figures, table."),
    ] = None,
    roi: Annotated[
        Path | None, typer.Option(help="Region to measure, placed by its affine; each label by itself.")
    ] = None,
    labels: Annotated[bool, typer.Option("--labels", help="Scans are label images: measure each instance.")] = False,
    subjects: Annotated[
        Path | None, typer.Option(help="CSV: scan, and columns for the table, such as subject, group, time.")
    ] = None,
    *,
    grid: Annotated[dict[str, Any] | None, Group(parse_windows)],
    tile: Annotated[
        int | None,
        typer.Option(help="Voxels a side of a tile; by default so many that a process takes a good GB.", min=32),
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes that share scans, or one scan's tiles; 0 is this one.", min=0)
    ] = 0,
    structure: Structure,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure scans in seconds: morphometry, fabric and curvature in physical units, with 95 % intervals."""
    folder = _choose_folder(out, labels, subjects)
    if labels and (roi is not None or tile is not None or structure != parse_structure()):
        raise ValueError(
            "--labels states the structure of instances, each in a box of its own: leave out --roi, --tile, --kind, "
            "--periodic, --threshold and --dark"
        )
    if grid is not None:
        if folder is None or len(scans) > 1 or labels or workers or roi or subjects or tile:
            raise ValueError(
                "--windows maps one scan as a whole into a folder: give one scan, and a name without a suffix with -o; "
                "leave out --labels, --roi, --subjects, --tile and --workers"
            )
        _map_windows(scans[0], folder, overwrite, {**grid, **structure, **reading})
        return
    store = None if out is None else out.with_name(f".{out.name}.curvafit-tiles")
    options = {} if labels else {"roi": roi, "tile": tile, "store": store, **structure}
    options |= {"labels": labels, "workers": workers}
    with _keep_tiles(store):
        if folder is None:
            _write_table(scans, out, subjects, overwrite, options, reading)
        else:
            _write_page(scans, folder, subjects, overwrite, options, reading)


def _write_page(
    scans: list[str], folder: Path, subjects: Path | None, overwrite: bool, options: dict[str, Any],
    reading: dict[str, Any],
) -> None:  # fmt: skip
    """Measure scans, and write a page of them."""
    with show_stages() as progress:
        from curvafit.core.runtime import sub_progress
        from curvafit.report.measures import check_measures, write_measures
        from curvafit.studies.scans import check_units, count_notes, measure_each

        check_measures(folder, [*scans, *_files(options.get("roi"), subjects)], overwrite, command_line())
        check_units(scans, sub_progress(progress, 0.0, 0.05), **reading)
        columns = _read_subjects(subjects, scans)
        part = sub_progress(progress, 0.05, 1.0)
        whole = [measures for (measures,) in measure_each(scans, progress=part, **options, **reading)]
        progress("drawing the page", 1.0)
        shown = {name: value for name, value in options.items() if name not in ("store", "labels", "workers")}
        more = {"columns": columns, "options": shown | reading, "command": command_line(), "overwrite": overwrite}
        page = write_measures(whole, folder, **more)
    say_notes(tuple(count_notes(whole)))
    say(str(page))


def _write_table(
    scans: list[str], out: Path | None, subjects: Path | None, overwrite: bool, options: dict[str, Any],
    reading: dict[str, Any],
) -> None:  # fmt: skip
    """Measure scans, print the numbers, and write them into a table, if there is an output."""
    with show_stages() as progress:
        from curvafit.studies.scans import check_table, measure_each, write_table

        if out is not None:
            check_table(out, [*scans, *_files(options.get("roi"), subjects)], overwrite)
        columns = _read_subjects(subjects, scans)
        measured = measure_each(scans, progress=progress, **options, **reading)
    _print_measured(measured, options["labels"])
    if out is not None:
        rows = None if columns is None else [row for row, parts in zip(columns, measured, strict=True) for _ in parts]
        say(str(write_table([part for parts in measured for part in parts], out, columns=rows, overwrite=overwrite)))


def _files(*paths: Path | None) -> list[Path]:
    return [path for path in paths if path is not None]


def _read_subjects(subjects: Path | None, scans: list[str]) -> Any:
    """Return the columns that a table of subjects has for each scan, None without a table."""
    from curvafit.scan.measures import COLUMNS
    from curvafit.studies.scans import OF_PARTS, read_columns

    return None if subjects is None else read_columns(subjects, scans, (*COLUMNS, *OF_PARTS))


def _map_windows(scan: str, folder: Path, overwrite: bool, options: dict[str, Any]) -> None:
    """Measure a scan in windows, and write its maps."""
    with show_stages() as progress:
        from curvafit.report.measures import check_windows, write_windows
        from curvafit.studies.windowed import windows as measure_windows

        check_windows(folder, scan, overwrite, command_line())
        found = measure_windows(scan, progress=progress, **options)
        progress("drawing the page", 1.0)
        page = write_windows(found, folder, command=command_line(), overwrite=overwrite)
    say_notes(found.notes)
    say(found.status, style="bold")
    say(str(page))


def _choose_folder(out: Path | None, labels: bool, subjects: Path | None) -> Path | None:
    """Return the folder that an output names, None where it is a table; refuse what does not go with it."""
    if subjects is not None and out is None:
        raise ValueError("--subjects is for the table: give its name with -o")
    if out is None or (out.suffix and not out.is_dir()):
        return None
    if labels:
        raise ValueError("--labels measures instances, which have no page: give the name of a table with -o")
    if not out.name:
        raise ValueError(f"give the name of a table or of a folder of its own with -o, got {out}")
    return out


@contextmanager
def _keep_tiles(store: Path | None) -> Iterator[None]:
    """Keep a folder of finished tiles while the command is at work, and where a signal or an error ends it."""
    from curvafit.core.files import is_empty, remove

    saved = store is not None and store.exists
    with resumable(lambda: "the same command" if saved and saved() else ""):
        try:
            yield
        except ValueError:
            if store is not None and store.is_dir() and is_empty(store):
                remove(store)
            raise
    if store is not None and store.exists():
        remove(store)


def _print_measured(found: Sequence[tuple[Measures, ...]], labels: bool) -> None:
    """Print the notes and the numbers of scans and compartments, or of the bodies of label images."""
    for measures in found:
        if len(found) > 1:
            say(measures[0].source, style="bold")
        if labels:
            _print_instances(measures)
            continue
        parts = list(measures[0].compartments.values()) or measures
        say_notes(dict.fromkeys(note for part in parts for note in part.notes))
        for part in parts:
            _print_measures(part)


def _print_instances(instances: Sequence[Measures]) -> None:
    """Print the least, the median and the greatest of each number of instances."""
    from curvafit.core.units import format_number, power_name

    rows = []
    for same in zip(*(instance.quantities for instance in instances), strict=True):
        values = sorted(each.value for each in same if math.isfinite(each.value)) or [math.nan]
        shown = (format_number(each, 4) for each in (values[0], median(values), values[-1]))
        rows.append((same[0].name, same[0].symbol, *shown, power_name(instances[0].unit, same[0].power)))
    print_table(("", "", "least", "median", "greatest", "unit"), rows, right=(2, 3, 4))
    cut = sum(instance["S.cut"].value > 0 for instance in instances)
    thin = sum(math.isnan(instance["H"].value) for instance in instances)
    say(f"{len(instances)} instances; {cut} are cut by the border, {thin} too thin for curvature.")


def _print_measures(measures: Measures) -> None:
    if measures.part is not None:
        say(" ".join(map(str, measures.part)), style="bold")
    rows = [(quantity.name, quantity.symbol, *quantity.format(measures.unit)) for quantity in measures.quantities]
    print_table(("", "", "value", "95 %", "unit"), rows, right=(2, 3))
    z, y, x = measures.direction
    if math.isfinite(z):
        say(f"The surface is most nearly parallel to the direction {z:.2f}, {y:.2f}, {x:.2f} (z, y, x).")
