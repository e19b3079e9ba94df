"""The command that compares scans by group or by a number."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from curvafit.cli.console import command_line, print_table, say, say_notes, show_stages
from curvafit.cli.options import Group, OverwriteOption, Reading, Structure, command


def parse_tests(
    primary: Annotated[str | None, typer.Option(help="One number named beforehand, tested alone: Tb.Th.")] = None,
    permutations: Annotated[int, typer.Option(help="Permutations of subjects; all where there are fewer.")] = 9999,
    seed: Annotated[int, typer.Option(help="Seed of the permutations, where not all are tried.")] = 0,
) -> dict[str, Any]:
    """Return how `curvafit.compare` tests."""
    return {"primary": primary, "permutations": permutations, "seed": seed}


@command(
    "curvafit compare control/ treated/ --spacing 0.0195 --unit mm -o compared",
    "curvafit compare control/ low/ high/ -o compared",
    "curvafit compare control.csv drug.csv --primary V -o compared",
    "curvafit compare before/ after/ --paired -o compared",
    "curvafit compare study.csv --by age -o compared",
    "curvafit compare measured --by group -o compared",
    "curvafit compare study.csv --by treatment --paired -o compared",
    "curvafit compare day0.tif day7.tif day14.tif day28.tif day56.tif --by 0,7,14,28,56 -o healing",
)
def compare(
    scans: Annotated[
        list[Path],
        typer.Argument(help="Folders of scans, two or more; a CSV: scan, group, subject, roi; what measure wrote."),
    ],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for compare.html, figures and tables.")],
    by: Annotated[
        str | None, typer.Option(help="Column of the CSV: groups, or numbers (dose, age); or 0,7,14 for three scans.")
    ] = None,
    paired: Annotated[
        bool, typer.Option("--paired", help="Compare within subjects of one name (of a file, or in the CSV).")
    ] = False,
    *,
    structure: Structure,
    reading: Reading,
    tests: Annotated[dict[str, Any], Group(parse_tests)],
    workers: Annotated[int, typer.Option(help="Processes that measure; 0 is this one.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Tell whether groups of scans or bodies differ, or what goes with a number: in what, and by how much."""
    with show_stages() as progress:
        from curvafit.report.comparison import check_comparison, write_comparison
        from curvafit.studies.comparison import compare as compare_scans

        check_comparison(out, scans, overwrite, command_line())
        settings: dict[str, Any] = {**tests, "workers": workers, "progress": progress, "paired": paired}
        # `--by 0,7,14` has a number for each scan of one list; otherwise each argument is a group or a CSV.
        labels = by.split(",") if by and "," in by else by
        groups = [scans] if isinstance(labels, list) else scans
        comparison = compare_scans(*groups, by=labels, **structure, **settings, **reading)
        progress("drawing the page", 1.0)
        page = write_comparison(comparison, out, command=command_line(), overwrite=overwrite)
    say_notes(comparison.notes)
    say(comparison.status, style="bold")
    from curvafit.core.units import format_number, power_name

    rows = []
    for number in comparison.numbers:
        estimates = number.means or (number.difference,)  # the mean of each group, or the slope
        values = (*estimates, number.effect, number.p, number.family)
        unit = power_name(comparison.unit, number.power) if number.means else ""
        rows.append((number.name, number.symbol, unit, *map(format_number, values)))
    head = ("", "", "", *(comparison.groups or ("slope",)), comparison.effect, "p", "family-wise p")
    print_table(head, rows, right=range(3, len(head)))
    say(str(page))
