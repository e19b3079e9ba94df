"""The command that compares two groups of scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import command_line, print_table, say, say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, Structure, command


@command(
    "curvafit compare control/ treated/ --spacing 0.0195 --unit mm -o compared",
    "curvafit compare control/ treated/ --subjects mice.csv -o compared",
    "curvafit compare --subjects study.csv -o compared",
)
def compare(
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for compare.html, figures and tables.")],
    group_a: Annotated[Path | None, typer.Argument(help="Folder of scans.")] = None,
    group_b: Annotated[Path | None, typer.Argument(help="Folder of the other scans.")] = None,
    subjects: Annotated[Path | None, typer.Option(help="CSV: scan, subject; without folders scan, group.")] = None,
    *,
    structure: Structure,
    reading: Reading,
    laws: Annotated[
        bool, typer.Option("--laws", help="Read each scan's law too: what it tells of six combinations of parameters.")
    ] = False,
    primary: Annotated[str | None, typer.Option(help="One number named beforehand, tested alone: Tb.Th.")] = None,
    permutations: Annotated[int, typer.Option(help="Permutations of subjects; all where there are fewer.")] = 9999,
    seed: Annotated[int, typer.Option(help="Seed of the permutations, where not all are tried.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes that measure; 0 is this one.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Tell whether two groups of scans differ, in which direction of curvature, and by how much."""
    with show_stages() as progress:
        from curvafit.report.comparison import check_comparison, write_comparison
        from curvafit.studies.compare import compare as compare_groups

        inputs = [place for place in (group_a, group_b, subjects) if place is not None]
        check_comparison(out, inputs, overwrite, command_line())
        how = {"laws": laws, "primary": primary, "permutations": permutations, "seed": seed}
        how |= {"workers": workers, "progress": progress}
        comparison = compare_groups(group_a, group_b, subjects=subjects, **structure, **how, **reading)
        progress("drawing the page", 1.0)
        page = write_comparison(comparison, out, command=command_line(), overwrite=overwrite)
    say_notes(comparison.notes)
    say(comparison.status, style="bold")
    from curvafit.core.units import format_number

    rows = [
        (each.name, each.symbol, *(format_number(value) for value in (*each.means, each.effect, each.p, each.family)))
        for each in comparison.numbers
    ]
    print_table(("", "", *comparison.groups, "Hedges' g", "p", "family-wise p"), rows, right=range(2, 7))
    say(str(page))
