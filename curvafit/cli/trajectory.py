"""The command that follows one thing through a series of scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import command_line, print_table, say, say_notes, show_stages
from curvafit.cli.options import FILES, OverwriteOption, Reading, Structure, command, parse_numbers


@command(
    "curvafit trajectory day0.tif day7.tif day14.tif --times 0,7,14 --unit-of-time d -o healing",
    "curvafit trajectory t0.nii t1.nii t2.nii t3.nii t4.nii --spacing 0.0195 --unit mm -o healing",
)
def trajectory(
    scans: Annotated[list[str], typer.Argument(help=f"From the first to the last. {FILES}")],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for trajectory.html, figures and tables.")],
    times: Annotated[
        str | None, typer.Option(help="When each was made, between commas: 0,7,14. By default 0,1,2.")
    ] = None,
    unit_of_time: Annotated[str, typer.Option(help="Unit of times, any text: d.")] = "",
    *,
    structure: Structure,
    reading: Reading,
    laws: Annotated[
        bool, typer.Option("--laws", help="Read each scan's law too: what it tells of six combinations of parameters.")
    ] = False,
    permutations: Annotated[int, typer.Option(help="Orders of the scans to try; all where there are fewer.")] = 9999,
    seed: Annotated[int, typer.Option(help="Seed of the orders, where not all are tried.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes that measure; 0 is this one.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Follow one thing through scans at several times: its numbers with bands, its curvature, its trends."""
    moments = None if times is None else parse_numbers(times, "--times", len(scans))
    with show_stages() as progress:
        from curvafit.report.trajectory import check_trajectory, write_trajectory
        from curvafit.studies.trajectory import say_change
        from curvafit.studies.trajectory import trajectory as follow

        check_trajectory(out, scans, overwrite, command_line())
        how = {"laws": laws, "permutations": permutations, "seed": seed, "workers": workers, "progress": progress}
        found = follow(scans, moments, unit_of_time=unit_of_time, **structure, **how, **reading)
        progress("drawing the page", 1.0)
        page = write_trajectory(found, out, command=command_line(), overwrite=overwrite)
    say_notes(found.notes)
    say(found.status, style="bold")
    from curvafit.core.units import format_number

    rows = [
        (
            each.name,
            each.symbol,
            say_change(each, found.unit),
            *map(format_number, (each.correlation, each.p, each.family)),
        )
        for each in found.changes
    ]
    print_table(("", "", "change", "r with time", "p", "family-wise p"), rows, right=range(2, 6))
    say(str(page))
