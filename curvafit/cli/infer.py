"""The command that infers the parameters of a scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from curvafit.cli.console import command_line, print_table, say, say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, Structure, Volume, command

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference


@command(
    "curvafit infer bone.tif --spacing 0.0195 --unit mm -o bone",
    "curvafit infer vessels.nii.gz --kind mask -o vessels",
    "curvafit infer cells.ome.zarr --channel 1 --crop 0:64,100:300,100:300 --dark --threshold 90 -o cells",
    "curvafit infer vessels.nii.gz --method match -o vessels",
    "curvafit infer fibres.raw --raw-shape 128,128,128 --dtype u1 -o fibres",
)
def infer(
    scan: Volume,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for fit.json, report.html, regenerated.nii.gz.")],
    atlas: Annotated[Path | None, typer.Option(help="Atlas (.npz) instead of the packaged one.")] = None,
    posterior: Annotated[Path | None, typer.Option(help="Posterior (.npz) instead of the packaged one.")] = None,
    method: Annotated[str, typer.Option(help="posterior, or match: the nearest shape, refined.")] = "posterior",
    fast: Annotated[bool, typer.Option("--fast", help="Seconds, not minutes: nothing is grown or checked.")] = False,
    roi: Annotated[Path | None, typer.Option(help="Mask of the region to measure, of the scan's shape.")] = None,
    *,
    structure: Structure,
    reading: Reading,
    seed: Annotated[int, typer.Option(help="Seed of the shapes that are generated for comparison.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Infer the parameters of a scanned volume, and write a report."""
    files = {"roi": roi, "atlas": atlas, "posterior": posterior}
    with show_stages() as progress:
        from curvafit.inference.infer import infer as infer_scan
        from curvafit.report.page import check_report, with_command, write_inference

        inputs = [scan, *(file for file in files.values() if file is not None)]
        check_report(out, inputs, overwrite, command_line())
        how = {"method": method, "fast": fast, "seed": seed, "progress": progress}
        inference = infer_scan(scan, **structure, **files, **how, **reading)
        progress("drawing the report", 1.0)
        say_notes(inference.scan.notes)
        report = write_inference(with_command(inference, command_line()), out, overwrite=overwrite)
    _print_result(inference)
    say(str(report))


def _print_result(inference: Inference) -> None:
    """Print the description, the verdict and a small table."""
    from curvafit.core.units import format_length, format_number
    from curvafit.inference.candidates import TITLES
    from curvafit.report.page import describe, parameter_table

    fit = inference.fit
    say(f"{describe(inference)}.", style="bold")
    say(fit.status)
    if rows := parameter_table(inference):
        heads = ("", "working units", "±", "90 % of the posterior", f"with lengths in {fit.length_unit}")
        print_table(heads, rows, right=range(1, 5))
    for sentence in fit.weak_directions:
        say(sentence)
    if inference.twins:
        distances = [f"{TITLES.get(each.name, each.name)} {format_number(each.distance, 2)}" for each in fit.candidates]
        unit = format_length(fit.length, fit.length_unit, 3)
        say(f"Distances in 1/working unit ({unit}): {', '.join(distances)}.")
