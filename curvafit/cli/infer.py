"""The command that infers the parameters of a scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, print_table, say, say_notes, show_stages
from curvafit.cli.options import Group, Input, OverwriteOption, Reading, Structure, command

if TYPE_CHECKING:
    from curvafit.inference.inference import Inference


def parse_inference(
    atlas: Annotated[Path | None, typer.Option(help="Atlas (.npz) instead of the packaged one.")] = None,
    posterior: Annotated[Path | None, typer.Option(help="Posterior (.npz) instead of the packaged one.")] = None,
    method: Annotated[str, typer.Option(help="posterior, or match: the nearest shape, refined.")] = "posterior",
    test: Annotated[bool, typer.Option("--test", help="Grow shapes of the law beside the scan: a minute.")] = False,
) -> dict[str, Any]:
    """Return the options by which a law is inferred and tested, by name."""
    return {"atlas": atlas, "posterior": posterior, "method": method, "test": test}


@command(
    "curvafit infer bone.tif --spacing 0.0195 --unit mm -o bone",
    "curvafit infer vessels.nii.gz --kind mask --test -o vessels",
    "curvafit infer cells.ome.zarr --channel 1 --crop 0:64,100:300,100:300 --dark --threshold 90 -o cells",
    "curvafit infer fibres.raw --raw-shape 128,128,128 --dtype u1 -o fibres",
)
def infer(
    scan: Input,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")],
    *,
    law: Annotated[dict[str, Any], Group(parse_inference)],
    roi: Annotated[Path | None, typer.Option(help="Mask of the region to measure, placed by its affine.")] = None,
    structure: Structure,
    reading: Reading,
    seed: Annotated[int, typer.Option(help="Seed of the shapes that are generated for comparison.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Infer the parameters of a scanned volume, and write a report."""
    files = [path for path in (roi, law["atlas"], law["posterior"]) if path is not None]
    with show_stages() as progress:
        from curvafit.inference.candidates import Growth
        from curvafit.inference.inference import infer as infer_scan
        from curvafit.report.inference import check_report, write_inference

        law["growth"] = Growth() if law.pop("test") else None
        options = {**structure, **law, "roi": roi, "seed": seed, **reading}
        check_report(out, [scan, *files], overwrite, command_line())
        inference = infer_scan(scan, progress=progress, **options)
        progress("drawing the report", 1.0)
        say_notes(inference.scan.notes)
        report = write_inference(inference, out, command=command_line(), overwrite=overwrite)
    _print_result(inference)
    say(str(report))


def _print_result(inference: Inference) -> None:
    """Print the description, the verdict, the table of parameters, and the distances of the regrown shapes."""
    from curvafit.core.units import format_length, format_number, unit_name
    from curvafit.inference.candidates import TITLES
    from curvafit.report.inference import describe, parameter_table

    fit = inference.fit
    say(f"{describe(inference)}.", style="bold")
    say(fit.status)
    for combination in fit.combinations:
        say(str(combination))
    if table := parameter_table(inference):
        rows = [(*row[:3], interval, f"{physical} {unit}".strip()) for *row, interval, physical, unit in table]
        heads = ("", "working units", "±", "90 % of the posterior", f"with lengths in {unit_name(fit.length_unit)}")
        print_table(heads, rows, right=range(1, 5))
    if inference.twins:
        distances = [
            f"{TITLES.get(candidate.name, candidate.name)} {format_number(candidate.distance, 2)}"
            for candidate in fit.candidates
        ]
        unit = format_length(fit.length, fit.length_unit, 3)
        say(f"Distances in 1/working unit ({unit}): {', '.join(distances)}.")
