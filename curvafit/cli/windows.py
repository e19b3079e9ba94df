"""The command that measures a scan in windows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import command_line, say, say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, Structure, Volume, command, parse_whole_triple


@command(
    "curvafit windows bone.tif --spacing 0.0195 --unit mm -o maps",
    "curvafit windows bone.nii.gz --size 96 --stride 24 --clusters 3 -o maps",
    "curvafit windows bone.nii.gz --laws -o maps",
    "curvafit windows lung.ome.zarr --size 16,64,64 --stride 8,32,32 -o maps",
)
def windows(
    scan: Volume,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for windows.html, maps and the table.")],
    size: Annotated[str, typer.Option(help="Edge of a window in voxels, or Z,Y,X.")] = "64",
    stride: Annotated[str, typer.Option(help="Voxels from window to window, or Z,Y,X; divides the size.")] = "32",
    clusters: Annotated[int, typer.Option(help="Clusters of windows.")] = 2,
    laws: Annotated[
        bool,
        typer.Option("--laws", help="Read each window's law too: what it tells of six combinations of parameters."),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the clusters.")] = 0,
    *,
    structure: Structure,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Map a scan's numbers over windows, and part the windows into clusters: where does its texture differ?"""
    grid = (parse_whole_triple(size, "--size"), parse_whole_triple(stride, "--stride"))
    with show_stages() as progress:
        from curvafit.report.windows import check_windows, write_windows
        from curvafit.studies.windows import windows as measure_windows

        check_windows(out, scan, overwrite, command_line())
        how = {"clusters": clusters, "laws": laws, "seed": seed, "progress": progress}
        found = measure_windows(scan, *grid, **how, **structure, **reading)
        progress("drawing the page", 1.0)
        page = write_windows(found, out, command=command_line(), overwrite=overwrite)
    say_notes(found.notes)
    say(found.status, style="bold")
    say(str(page))
