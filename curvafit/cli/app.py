"""The command line: a module for each command parses, calls and prints.

Wrong input gives one sentence on the error stream and exit code 2. A command imports its libraries when it runs, so
that help is quick.
"""

from __future__ import annotations

from typing import Annotated

import typer

from curvafit.cli.atlas import atlas_app
from curvafit.cli.console import Commands, say
from curvafit.cli.demo import EXAMPLES as DEMO_EXAMPLES
from curvafit.cli.demo import demo
from curvafit.cli.generate import EXAMPLES as GENERATE_EXAMPLES
from curvafit.cli.generate import generate, presets
from curvafit.cli.infer import EXAMPLES as INFER_EXAMPLES
from curvafit.cli.infer import infer
from curvafit.cli.measure import EXAMPLES as MEASURE_EXAMPLES
from curvafit.cli.measure import measure
from curvafit.cli.nnunet import EXAMPLE as NNUNET_EXAMPLE
from curvafit.cli.nnunet import nnunet
from curvafit.cli.refine import EXAMPLES as REFINE_EXAMPLES
from curvafit.cli.refine import refine
from curvafit.cli.samples import samples_app
from curvafit.cli.segment import RECONSTRUCT_EXAMPLES, SEGMENT_EXAMPLES, reconstruct, segment
from curvafit.cli.synth import EXAMPLES as SYNTH_EXAMPLES
from curvafit.cli.synth import synth

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
app.command(epilog=DEMO_EXAMPLES)(demo)
app.command(epilog=INFER_EXAMPLES)(infer)
app.command(epilog=MEASURE_EXAMPLES)(measure)
app.command(epilog=GENERATE_EXAMPLES)(generate)
app.command()(presets)
app.command(epilog=NNUNET_EXAMPLE)(nnunet)
app.command(epilog=SEGMENT_EXAMPLES)(segment)
app.command(epilog=REFINE_EXAMPLES)(refine)
app.command(epilog=RECONSTRUCT_EXAMPLES)(reconstruct)
app.command(epilog=SYNTH_EXAMPLES)(synth)
app.add_typer(samples_app, name="samples")
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
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    pass
