"""The commands about sample volumes: samples and demo."""

from __future__ import annotations

import filecmp
import shutil
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import error_console, print_table, say, show_stages
from curvafit.cli.options import OverwriteOption, add_commands, command

samples_app = typer.Typer(help="Sample volumes, with their licences.", invoke_without_command=True)


@samples_app.callback()
@command()
def list_samples(context: typer.Context) -> None:
    """List sample volumes, or fetch one with `get`."""
    if context.invoked_subcommand is None:
        from curvafit.data_synth.samples import list_samples

        print_table(("name", "what", "licence", "source"), [(name, *facts) for name, facts in list_samples().items()])


@command("curvafit infer $(curvafit samples get bone) -o bone")
def get_sample(
    name: Annotated[str, typer.Argument(help="Name of the sample; `curvafit samples` lists the names.")],
    out: Annotated[Path | None, typer.Option("-o", "--output", help="Copy it here, out of the cache.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Download a sample once, check it, and print its path."""
    from curvafit.data_synth.samples import fetch, list_samples

    if name in (samples := list_samples()):
        description, licence, source = samples[name]
        say(f"{name}: {description}; licence {licence}; {source}", to=error_console())
    path = fetch(name)
    say(str(path if out is None else _copy_to(path, out, overwrite)))


add_commands(samples_app, get_sample)


@command("curvafit demo", "curvafit demo bone -o bone_out")
def demo(
    sample: Annotated[str | None, typer.Argument(help="A sample; by default shell, else the synthetic one.")] = None,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for demo.html and its files.")] = Path("demo_out"),
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a real scan from every 8th slice, measure and read it: one page, in a minute."""
    from curvafit.core.checks import require

    require("zuko", "infer", "reading a posterior")
    with show_stages() as progress:
        from curvafit.data_synth.samples import SYNTHETIC, SampleUnavailable, fetch
        from curvafit.report.demo import EVERY, write_demo
        from curvafit.volumes.read import load

        name = sample or "shell"
        progress(f"fetching {name}", 0.0)
        try:
            path = fetch(name)
        except SampleUnavailable as error:
            if sample is not None:
                raise
            say(f"{error}; taking the synthetic scan", to=error_console())
            path = fetch(SYNTHETIC)
        page, scores = write_demo(load(path), out, overwrite=overwrite, progress=progress)
    network, *others = scores.values()
    say(f"Filled from every {EVERY}th slice: Dice {network:.3f}; by the best plain interpolation {max(others):.3f}.")
    say(str(page))


def _copy_to(path: Path, target: Path, overwrite: bool) -> Path:
    """Copy a sample to a file or into a folder; raise ValueError where a file's suffix is not the sample's."""
    from curvafit.core.files import write_atomically
    from curvafit.core.records import can_write

    target = target / path.name if target.is_dir() else target
    suffix = path.name[path.name.index(".") :]
    if not target.name.lower().endswith(suffix):
        raise ValueError(f"the name of this sample must end in {suffix}, got {target.name!r}")
    # An earlier copy of the sample may be replaced without `overwrite`.
    can_write(
        target, lambda old: old.is_file() and filecmp.cmp(path, old, shallow=False), inputs=[path], overwrite=overwrite
    )
    return write_atomically(target, lambda temporary: shutil.copyfile(path, temporary))
