"""The command line: parse, call, print. Wrong input is one sentence on the error stream and exit code 2.

What a command needs is imported when it runs, so that help is quick.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.atlas import atlas_app
from curvafit.cli.generate import EXAMPLES, generate, presets
from curvafit.cli.hosts import EXAMPLE as NNUNET_EXAMPLE
from curvafit.cli.hosts import nnunet
from curvafit.cli.refusal import Commands
from curvafit.cli.samples import samples_app
from curvafit.cli.segment import RECONSTRUCT_EXAMPLES, SEGMENT_EXAMPLES, reconstruct, segment
from curvafit.cli.support import (
    OverwriteOption,
    command_line,
    output,
    plainly,
    reading_of,
    say,
    say_notes,
    stages,
    threshold_of,
)
from curvafit.cli.synth import EXAMPLES as SYNTH_EXAMPLES
from curvafit.cli.synth import synth

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference

app = typer.Typer(
    help="Shape texture of tubes and membranes in 3D: a scan in, its parameters out; parameters in, shapes out.",
    epilog="Start with `curvafit infer SCAN -o DIR` or `curvafit generate --preset tubes -o tubes.nii.gz`. "
    "CURVAFIT_DEBUG=1 shows where an error came from.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    cls=Commands,
)
app.command(epilog=EXAMPLES)(generate)
app.command()(presets)
app.command(epilog=NNUNET_EXAMPLE)(nnunet)
app.command(epilog=SEGMENT_EXAMPLES)(segment)
app.command(epilog=RECONSTRUCT_EXAMPLES)(reconstruct)
app.command(epilog=SYNTH_EXAMPLES)(synth)
app.add_typer(samples_app, name="samples")
app.add_typer(atlas_app, name="atlas")


def main() -> None:
    """The entry point."""
    app(prog_name="curvafit")


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"curvafit {version('curvafit')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    pass


# ---- infer -----------------------------------------------------------------------------------------------------------


@app.command(
    epilog="[bold]Examples[/bold]\n\n"
    "curvafit infer bone.tif --spacing 0.0195 --unit mm -o bone\n\n"
    "curvafit infer vessels.nii.gz --kind mask -o vessels\n\n"
    "curvafit infer cells.h5 --key raw --dark --threshold 90 -o cells\n\n"
    "curvafit infer fibres.raw --raw-shape 128,128,128 --dtype u1 -o fibres"
)
def infer(
    scan: Annotated[
        str, typer.Argument(help="NIfTI, TIFF (or folder of slices), NPY, NPZ, HDF5 (file.h5::key), RAW, Zarr …")
    ],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for fit.json, report.html, regenerated.nii.gz.")],
    kind: Annotated[str, typer.Option(help="auto, field, mask or image.")] = "auto",
    periodic: Annotated[bool, typer.Option("--periodic", help="The box repeats (generated fields).")] = False,
    atlas: Annotated[Path | None, typer.Option(help="Another atlas (.npz) than the packaged one.")] = None,
    threshold: Annotated[str, typer.Option(help="Grey level, or otsu.")] = "otsu",
    dark: Annotated[bool, typer.Option("--dark", help="The structure is the dark phase.")] = False,
    roi: Annotated[Path | None, typer.Option(help="Mask of what counts, of the scan's shape.")] = None,
    label: Annotated[int | None, typer.Option(help="The structure is where the scan has this value.")] = None,
    spacing: Annotated[str | None, typer.Option(help="Voxel edges z,y,x, or one for all; overrides the file.")] = None,
    unit: Annotated[str | None, typer.Option(help="nm, um, mm or m; overrides the file.")] = None,
    raw_shape: Annotated[str | None, typer.Option(help="Z,Y,X of a RAW file.")] = None,
    dtype: Annotated[str | None, typer.Option(help="Type of a RAW file: u1, u2, f4 …")] = None,
    key: Annotated[str | None, typer.Option(help="Array within an NPZ, HDF5 or Zarr file.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Refuse a scan with chunks or slices missing.")] = False,
    seed: Annotated[int, typer.Option(help="Of the shapes that are regrown for comparison.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Infer the parameters of a scanned volume, and write a report."""
    with plainly():
        reading = reading_of(spacing, unit, raw_shape, dtype, key, strict)
        level = threshold_of(threshold)
        what = {"kind": kind, "periodic": periodic, "threshold": level, "dark": dark, "roi": roi, "label": label}
        found, report = _inferred(scan, out, {**what, "atlas": atlas, "seed": seed, **reading}, overwrite)
        _show(found)
        say(str(report))


def _inferred(scan: str, out: Path, options: dict[str, Any], overwrite: bool) -> tuple[Inference, Path]:
    """The inference and the path of its report, with progress."""
    with stages() as progress:
        from curvafit.inference.infer import infer as find
        from curvafit.report.page import check_report, with_command, write_inference

        read = [each for each in (scan, options["roi"], options["atlas"]) if each is not None]
        check_report(out, read, overwrite)

        found = find(scan, progress=progress, **options)
        progress("drawing the report", 1.0)
        say_notes(found.scan.notes)
        return found, write_inference(with_command(found, command_line()), out, overwrite=overwrite)


def _show(found: Inference) -> None:
    """The sentence, the verdict, a small table."""
    from curvafit.report.page import parameter_table
    from curvafit.report.wording import describe
    from curvafit.units import length, number

    fit = found.fit
    say(f"{describe(found)}.", style="bold")
    say(fit.status)
    output(("", "working units", "±", f"with lengths in {fit.length_unit}"), parameter_table(found), right=range(1, 4))
    names = {"match": "nearest match", "fit": "refined", "seed_noise": "two seeds"}
    apart = ", ".join(f"{names[name]} {number(value, 2)}" for name, value in fit.distances.items())
    say(f"Distances in 1/working unit ({length(fit.length, fit.length_unit, 3)}): {apart}.")
