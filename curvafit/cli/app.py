"""The command line: a module for each command parses, calls and prints.

Wrong input gives one sentence on the error stream and exit code 2. A command imports its libraries when it runs, so
that help is quick.
"""

from __future__ import annotations

from typing import Annotated

import typer

from curvafit.cli import compare, generate, infer, measure, samples, segment, synth
from curvafit.cli.atlas import atlas_app
from curvafit.cli.console import Commands, say
from curvafit.cli.options import add_commands

app = typer.Typer(
    help="Shape texture of tubes and membranes in 3D: a scan in, its parameters out; parameters in, shapes out.",
    epilog="Start with `curvafit infer SCAN -o DIR` or `curvafit generate --preset tubes -o tubes.nii.gz`. "
    "CURVAFIT_DEBUG=1 shows where an error came from.", no_args_is_help=True, pretty_exceptions_enable=False,
    rich_markup_mode="rich", context_settings={"help_option_names": ["-h", "--help"]}, cls=Commands,
)  # fmt: skip
add_commands(app, samples.demo, infer.infer, measure.measure, compare.compare)
add_commands(app, generate.generate, generate.presets, synth.synth)
add_commands(app, segment.segment, segment.reconstruct)
app.add_typer(samples.samples_app, name="samples")
app.add_typer(atlas_app, name="atlas")


def main() -> None:
    """Run the command line."""
    app(prog_name="curvafit")


def _show_version(version_only: bool) -> None:
    if version_only:
        from importlib.metadata import version

        say(f"curvafit {version('curvafit')}")
        raise typer.Exit


@app.callback()
def _take_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    pass
