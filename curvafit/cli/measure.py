"""The command that measures scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, keep_parts, print_table, say, say_notes, show_stages
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
) -> dict[str, Any] | None:
    """Return size and stride of windows, as `curvafit.windows` takes them; None without `--windows`."""
    if windows is None:
        if stride is not None:
            raise ValueError("--stride goes with --windows")
        return None
    size = parse_whole_triple(windows, "--windows")
    halves = tuple(n if n % 2 else n // 2 for n in size)  # a stride divides the size: an odd one has no half
    steps = halves if stride is None else parse_whole_triple(stride, "--stride")
    return {"size": size, "stride": steps}


def parse_page(
    maps: Annotated[
        bool, typer.Option("--maps", help="Of one scan: structure and thickness at each voxel, into the folder -o.")
    ] = False,
    graph: Annotated[
        bool, typer.Option("--graph", help="Of one scan: its centreline with branches, into the folder -o.")
    ] = False,
) -> dict[str, Any]:
    """Return what stands in the folder of a page besides the numbers."""
    return {"maps": maps, "graph": graph}


@command(
    "curvafit measure bone.tif --spacing 0.0195 --unit mm",
    "curvafit measure mouse1.nii.gz mouse2.nii.gz mouse3.nii.gz --subjects mice.csv -o measures.csv",
    "curvafit measure femur.nii.gz --roi compartments.nii.gz -o femur.csv",
    "curvafit measure mitochondria_labels.tif --labels --spacing 5 --unit nm -o mitochondria.csv",
    "curvafit measure lung_2048.ome.zarr --workers 2 -o lung.csv",
    "curvafit measure cell.stl --spacing 0.1 --unit um",
    "curvafit measure bone.tif --maps -o bone",
    "curvafit measure vessels.tif --graph --spacing 0.002 --unit mm -o vessels",
    "curvafit measure bone.tif --windows 64 --stride 32 -o maps",
)
def measure(
    scans: Annotated[list[str], typer.Argument(help=FILES)],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Table (.csv), or a folder for page, figures, table."),
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
    page: Annotated[dict[str, Any], Group(parse_page)],
    structure: Structure,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure scans in seconds: morphometry, fabric and curvature in physical units, with 95 % intervals."""
    folder = _choose_folder(out, labels, subjects)
    if any(page.values()) and (grid is not None or folder is None or len(scans) > 1):
        raise ValueError(
            "--maps and --graph are for the page of a single scan, with a name without a suffix at -o, and no --windows"
        )
    if page["graph"] and (roi is not None or structure["periodic"]):
        raise ValueError("--graph traces a whole scan that does not repeat: leave out --roi and --periodic, or --crop")
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
    with keep_parts(store):
        if folder is None:
            _write_table(scans, out, subjects, overwrite, options, reading)
        else:
            _write_page(scans, folder, subjects, page, overwrite, options, reading)


def _write_page(
    scans: list[str], folder: Path, subjects: Path | None, shown: dict[str, Any], overwrite: bool,
    options: dict[str, Any], reading: dict[str, Any],
) -> None:  # fmt: skip
    """Measure scans, and write a page of them."""
    with show_stages() as progress:
        from curvafit.core.runtime import sub_progress
        from curvafit.report.measures import check_measures, write_measures
        from curvafit.studies.scans import check_units, count_notes, measure_each, read_columns

        options["maps"] = shown["maps"] or shown["graph"]
        inputs = [*scans, *filter(None, (options.get("roi"), subjects))]
        check_measures(folder, inputs, overwrite, command_line())
        check_units(scans, sub_progress(progress, 0.0, 0.05), **reading)
        columns = None if subjects is None else read_columns(subjects, scans)
        measuring = sub_progress(progress, 0.05, 1.0)
        # A page is for scans, of which each has one result; instances have a table only.
        results = [measures for (measures,) in measure_each(scans, progress=measuring, **options, **reading)]
        traced: dict[str, Any] = {"maps": shown["maps"]}
        if shown["graph"]:
            from curvafit.scan.centreline import trace

            progress("tracing the centreline", 1.0)
            traced["centreline"] = trace(results[0])
        progress("drawing the page", 1.0)
        recorded = {name: value for name, value in options.items() if name not in ("store", "labels", "workers")}
        recorded |= {"maps": shown["maps"], "graph": shown["graph"]}
        settings: dict[str, Any] = {"options": recorded | reading, "command": command_line(), "overwrite": overwrite}
        page = write_measures(results, folder, columns=columns, **traced, **settings)
    if len(results) == 1:
        _print_results([(results[0],)], labels=False)
    else:
        say_notes(tuple(count_notes(results)))
    say(str(page))


def _write_table(
    scans: list[str], out: Path | None, subjects: Path | None, overwrite: bool, options: dict[str, Any],
    reading: dict[str, Any],
) -> None:  # fmt: skip
    """Measure scans, print the numbers, and write them into a table, if there is an output."""
    with show_stages() as progress:
        from curvafit.studies.scans import check_table, measure_each, read_columns, write_table

        if out is not None:
            check_table(out, [*scans, *filter(None, (options.get("roi"), subjects))], overwrite)
        columns = None if subjects is None else read_columns(subjects, scans)
        results = measure_each(scans, progress=progress, **options, **reading)
    _print_results(results, options["labels"])
    if out is not None:
        if columns is not None:  # a label image has several rows, one for each instance
            columns = [row for row, measures in zip(columns, results, strict=True) for _ in measures]
        flat = [measures for of_scan in results for measures in of_scan]
        say(str(write_table(flat, out, columns=columns, overwrite=overwrite)))


def _map_windows(scan: str, folder: Path, overwrite: bool, options: dict[str, Any]) -> None:
    """Measure a scan in windows, and write its maps."""
    with show_stages() as progress:
        from curvafit.report.measures import check_windows, write_windows
        from curvafit.studies.windowed import windows as measure_windows

        check_windows(folder, [scan], overwrite, command_line())
        windows = measure_windows(scan, progress=progress, **options)
        progress("drawing the page", 1.0)
        page = write_windows(windows, folder, command=command_line(), overwrite=overwrite)
    say_notes(windows.notes)
    say(windows.status, style="bold")
    say(str(page))


def _choose_folder(out: Path | None, labels: bool, subjects: Path | None) -> Path | None:
    """Return the output if it is a folder, None if it is a table; raise ValueError where an option contradicts it."""
    if subjects is not None and out is None:
        raise ValueError("--subjects is for the table: give its name with -o")
    if out is None or (out.suffix and not out.is_dir()):
        return None
    if labels:
        raise ValueError("--labels measures instances, which have no page: give the name of a table with -o")
    if not out.name:
        raise ValueError(f"give the name of a table or of a folder of its own with -o, got {out}")
    return out


def _print_results(results: Sequence[tuple[Measures, ...]], labels: bool) -> None:
    """Print notes and measures of each scan and its compartments; with `labels` a summary of each image's instances."""
    for of_scan in results:
        if len(results) > 1:
            say(of_scan[0].source, style="bold")
        if labels:
            _print_instances(of_scan)
            continue
        compartments = list(of_scan[0].compartments.values()) or of_scan
        say_notes(dict.fromkeys(note for measures in compartments for note in measures.notes))
        for measures in compartments:
            if measures.part is not None:
                say(" ".join(map(str, measures.part)), style="bold")
            rows = [
                (quantity.name, quantity.symbol, *quantity.format(measures.unit)) for quantity in measures.quantities
            ]
            print_table(("", "", "value", "95 %", "unit"), rows, right=(2, 3))
            z, y, x = measures.direction
            if math.isfinite(z):
                say(f"The surface is most nearly parallel to the direction {z:.2f}, {y:.2f}, {x:.2f} (z, y, x).")


def _print_instances(instances: Sequence[Measures]) -> None:
    """Print the least, the median and the greatest value of each quantity of instances."""
    from curvafit.core.units import format_number, power_name

    rows = []
    say_notes(instances[0].notes if len(instances) == 1 else ())
    for k, quantity in enumerate(instances[0].quantities):
        values = [instance.quantities[k].value for instance in instances]
        known = sorted(filter(math.isfinite, values)) or [math.nan]
        figures = (format_number(value, 4) for value in (known[0], median(known), known[-1]))
        rows.append((quantity.name, quantity.symbol, *figures, power_name(instances[0].unit, quantity.power)))
    print_table(("", "", "least", "median", "greatest", "unit"), rows, right=(2, 3, 4))
    cut = sum(instance["S.cut"].value > 0 for instance in instances)
    thin = sum(math.isnan(instance["H"].value) for instance in instances)
    bodies = "1 body" if len(instances) == 1 else f"{len(instances)} bodies"
    say(f"{bodies}; {cut} cut by the border, {thin} too thin for curvature.")
