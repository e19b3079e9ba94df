"""The command that measures scans."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from curvafit.cli.console import print_table, say, say_notes, show_stages
from curvafit.cli.options import FILES, OverwriteOption, Reading, Structure, command

if TYPE_CHECKING:
    from curvafit.scan.measure import Measures


@command(
    "curvafit measure bone.tif --spacing 0.0195 --unit mm",
    "curvafit measure mouse1.nii.gz mouse2.nii.gz mouse3.nii.gz -o measures.csv",
    "curvafit measure femur.nii.gz --roi cortex_and_marrow.nii.gz -o compartments.csv",
    "curvafit measure cells.ome.zarr --channel 1 --dark --threshold 90 -o measures.parquet",
)
def measure(
    scans: Annotated[list[str], typer.Argument(help=FILES)],
    out: Annotated[Path | None, typer.Option("-o", "--output", help="Table to write: .csv .json .parquet.")] = None,
    roi: Annotated[
        Path | None, typer.Option(help="Region to measure, of the scan's shape; each label by itself.")
    ] = None,
    *,
    structure: Structure,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure scans in seconds: morphometry, fabric and curvature in physical units, with 95 % intervals."""
    with show_stages() as progress:
        from curvafit.scan.measure import measure as measure_scan
        from curvafit.studies.tables import check_table, write_table

        if out is not None:
            check_table(out, scans if roi is None else [*scans, roi], overwrite)
        found: list[Measures] = []

        def watch(text: str, share: float) -> None:
            progress(f"{scans[len(found)]}: {text}", (len(found) + share) / len(scans))

        for scan in scans:
            found.append(measure_scan(scan, roi=roi, progress=watch, **structure, **reading))
    for measures in found:
        if len(scans) > 1:
            say(measures.source, style="bold")
        parts = list(measures.compartments.values()) or [measures]
        say_notes(dict.fromkeys(note for part in parts for note in part.notes))
        for part in parts:
            _print_measures(part)
    if out is not None:
        say(str(write_table(found, out, overwrite=overwrite)))


def _print_measures(measures: Measures) -> None:
    """Print the numbers of a scan or a part of it."""
    if measures.part is not None:
        say(" ".join(map(str, measures.part)), style="bold")
    rows = [(each.name, each.symbol, *each.format(measures.unit)) for each in measures.quantities]
    print_table(("", "", "value", "95 %", "unit"), rows, right=(2, 3))
    z, y, x = measures.direction
    if math.isfinite(z):
        say(f"The surface is most nearly parallel to the direction {z:.2f}, {y:.2f}, {x:.2f} (z, y, x).")
