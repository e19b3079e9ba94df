"""The command that shows what the package does, on a real scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import error_console, plain_errors, say, show_stages
from curvafit.cli.options import OverwriteOption, examples

EXAMPLES = examples("curvafit demo", "curvafit demo shell -o shell_out")


def demo(
    sample: Annotated[str | None, typer.Argument(help="A sample; by default bone, or else the synthetic scan.")] = None,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for demo.html and its files.")] = Path("demo_out"),
    seed: Annotated[int, typer.Option(help="Seed of the reading.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure a real scan, fill it from every 8th slice, and read its texture: one page, in minutes."""
    with plain_errors():
        with show_stages() as progress:
            from curvafit.cli.samples import SYNTHETIC, fetch_or_make
            from curvafit.data_synth.samples import SampleUnavailable
            from curvafit.report.demo import write_demo
            from curvafit.volumes.read import load

            name = sample or "bone"
            progress(f"fetching {name}", 0.0)
            try:
                path = fetch_or_make(name)
            except SampleUnavailable as error:
                if sample is not None:
                    raise
                say(f"{error}; taking the synthetic scan", to=error_console())
                name = SYNTHETIC
                path = fetch_or_make(name)
            title = f"A first look: {name}"
            found = write_demo(load(path), out, title=title, seed=seed, overwrite=overwrite, progress=progress)
        dice, every = found.completion.dice, found.completion.every
        say(f"Filled from every {every}th slice: Dice {dice['curvafit']:.3f} with the slices that were left out.")
        say(f"Read: {found.fit.status}")
        say(str(found.page))
