"""The command about sample volumes."""

from __future__ import annotations

import filecmp
import shutil
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import error_console, plain_errors, print_table, say
from curvafit.cli.options import OverwriteOption, examples

#: The sample that needs no network, and its line in the list.
SYNTHETIC = "synthetic"
_SYNTHETIC_ABOUT = ("a generated trabecular shape, imaged with blur and noise", "MIT", "made on the spot")

samples_app = typer.Typer(help="Sample volumes, with their licences.", invoke_without_command=True)


@samples_app.callback()
def list_samples(context: typer.Context) -> None:
    """List sample volumes, or fetch one with `get`."""
    if context.invoked_subcommand is None:
        with plain_errors():
            from curvafit.data_synth.samples import samples

            rows = [(each.name, each.description, each.licence, each.source) for each in samples()]
            print_table(("name", "what", "licence", "source"), [*rows, (SYNTHETIC, *_SYNTHETIC_ABOUT)])


@samples_app.command("get", epilog=examples("curvafit infer $(curvafit samples get bone) -o bone"))
def get_sample(
    name: Annotated[str, typer.Argument(help="Name of the sample; `curvafit samples` lists the names.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--output", help="Copy it here; by default it stays in the cache.")
    ] = (None),
    overwrite: OverwriteOption = False,
) -> None:
    """Download a sample once, check it, and print its path."""
    with plain_errors():
        from curvafit.data_synth.samples import samples

        about = {each.name: (each.description, each.licence, each.source) for each in samples()}
        about[SYNTHETIC] = _SYNTHETIC_ABOUT
        if name not in about:
            raise ValueError(f"the samples are {', '.join(about)}, got {name!r}")
        what, licence, source = about[name]
        say(f"{name}: {what}; licence {licence}; {source}", to=error_console())
        path = fetch_or_make(name)
        say(str(path if out is None else _copy_to(path, out, overwrite)))


def fetch_or_make(name: str) -> Path:
    """Return the path of a sample, which is downloaded, or of the synthetic scan, which is made; both once."""
    from curvafit.data_synth.samples import cache_folder, fetch, synthetic_scan

    if name != SYNTHETIC:
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
