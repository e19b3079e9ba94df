"""The commands about sample volumes: samples and demo."""

from __future__ import annotations

import filecmp
import shutil
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import error_console, print_table, say, show_stages
from curvafit.cli.options import OverwriteOption, add_commands, command

#: The sample of the first look.
_FIRST = "shell"
#: The sample that needs no network, and its line in the list.
_SYNTHETIC = "synthetic"
_ABOUT = ("a generated trabecular shape, imaged with blur and noise", "MIT", "made on the spot")

samples_app = typer.Typer(help="Sample volumes, with their licences.", invoke_without_command=True)


@samples_app.callback()
@command()
def list_samples(context: typer.Context) -> None:
    """List sample volumes, or fetch one with `get`."""
    if context.invoked_subcommand is None:
        print_table(("name", "what", "licence", "source"), [(name, *about) for name, about in _list_samples().items()])


@command("curvafit infer $(curvafit samples get bone) -o bone")
def get_sample(
    name: Annotated[str, typer.Argument(help="Name of the sample; `curvafit samples` lists the names.")],
    out: Annotated[Path | None, typer.Option("-o", "--output", help="Copy it here, out of the cache.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Download a sample once, check it, and print its path."""
    about = _list_samples()
    if name not in about:
        raise ValueError(f"the samples are {', '.join(about)}, got {name!r}")
    what, licence, source = about[name]
    say(f"{name}: {what}; licence {licence}; {source}", to=error_console())
    path = _fetch_or_make(name)
    say(str(path if out is None else _copy_to(path, out, overwrite)))


add_commands(samples_app, get_sample)


@command("curvafit demo", "curvafit demo bone -o bone_out")
def demo(
    sample: Annotated[str | None, typer.Argument(help="A sample; by default shell, else the synthetic one.")] = None,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for demo.html and its files.")] = Path("demo_out"),
    seed: Annotated[int, typer.Option(help="Seed of the reading.")] = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a real scan from every 8th slice, measure it, and find textures like it: one page, in a minute."""
    with show_stages() as progress:
        from curvafit.data_synth.samples import SampleUnavailable
        from curvafit.report.demo import write_demo
        from curvafit.volumes.read import load

        name = sample or _FIRST
        progress(f"fetching {name}", 0.0)
        try:
            path = _fetch_or_make(name)
        except SampleUnavailable as error:
            if sample is not None:
                raise
            say(f"{error}; taking the synthetic scan", to=error_console())
            name = _SYNTHETIC
            path = _fetch_or_make(name)
        found = write_demo(load(path), out, seed=seed, overwrite=overwrite, progress=progress)
    dice, every = found.completion.dice, found.completion.every
    plain = max(value for way, value in dice.items() if way != "curvafit")
    say(f"Filled from every {every}th slice: Dice {dice['curvafit']:.3f}; by the best plain interpolation {plain:.3f}.")
    say(str(found.page))


def _list_samples() -> dict[str, tuple[str, str, str]]:
    """Return description, licence and source of each sample by name."""
    from curvafit.data_synth.samples import SAMPLES

    about = {each.name: (each.description, each.licence, each.source) for each in SAMPLES.values()}
    return about | {_SYNTHETIC: _ABOUT}


def _fetch_or_make(name: str) -> Path:
    """Return the path of a sample, which is downloaded, or of the synthetic scan, which is made; both once."""
    from curvafit.data_synth.samples import cache_folder, fetch, synthetic_scan

    if name != _SYNTHETIC:
        return fetch(name)
    path = cache_folder() / "synthetic.nii.gz"
    return path if path.is_file() else synthetic_scan(path)


def _copy_to(path: Path, target: Path, overwrite: bool) -> Path:
    """Copy a sample to a target, whose suffix must be the sample's."""
    from curvafit.core.files import write_atomically
    from curvafit.core.records import can_write

    target = target / path.name if target.is_dir() else target
    suffix = path.name[path.name.index(".") :]
    if not target.name.lower().endswith(suffix):
        raise ValueError(f"the name of this sample must end in {suffix}, got {target.name!r}")

    def is_same(there: Path) -> bool:
        return there.is_file() and filecmp.cmp(path, there, shallow=False)

    can_write(target, is_same, inputs=[path], overwrite=overwrite)
    return write_atomically(target, lambda temporary: shutil.copyfile(path, temporary))
