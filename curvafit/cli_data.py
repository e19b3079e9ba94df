"""The commands about data: sample volumes and atlases."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli_support import command_line, error_console, output, plainly, say, stages, whole_triple

#: The sample that needs no network, and what the list says of it.
SYNTHETIC = "synthetic"
_SYNTHETIC_SAYS = ("a generated trabecular shape, imaged with blur and noise", "MIT", "made on the spot")

samples_app = typer.Typer(help="Volumes to try things on, with their licences.", invoke_without_command=True)
atlas_app = typer.Typer(help="Collections of generated shapes to match scans against.", no_args_is_help=True)


@samples_app.callback()
def list_samples(context: typer.Context) -> None:
    """Volumes to try things on. Without a command: list them."""
    if context.invoked_subcommand is None:
        with plainly():
            from curvafit.samples import samples

            rows = [(each.name, each.description, each.licence, each.source) for each in samples()]
            output(("name", "what", "licence", "source"), [*rows, (SYNTHETIC, *_SYNTHETIC_SAYS)])


@samples_app.command("get", epilog="[bold]Example[/bold]\n\ncurvafit infer $(curvafit samples get bone) -o bone")
def get_sample(
    name: Annotated[str, typer.Argument(help="See `curvafit samples`.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--output", help="Copy it here; else it stays in the cache.")
    ] = None,
) -> None:
    """Fetch a sample (once), check it, and print its path."""
    with plainly():
        from curvafit.samples import fetch, samples

        about = {each.name: (each.description, each.licence, each.source) for each in samples()}
        about[SYNTHETIC] = _SYNTHETIC_SAYS
        if name not in about:
            raise ValueError(f"expected a sample named {', '.join(about)}, got {name!r}")
        what, licence, source = about[name]
        say(f"{name}: {what}; licence {licence}; {source}", to=error_console())
        path = _synthetic() if name == SYNTHETIC else fetch(name)
        say(str(path if out is None else _copied(path, out)))


def _synthetic() -> Path:
    """The synthetic scan, made once."""
    from curvafit.samples import cache_folder, synthetic_scan

    path = cache_folder() / "synthetic.nii.gz"
    return path if path.is_file() else synthetic_scan(path)


def _copied(path: Path, target: Path) -> Path:
    """A copy under the name asked for, which must end as the file does."""
    from curvafit.scan import write_atomically

    target = target / path.name if target.is_dir() else target
    suffix = path.name[path.name.index(".") :]
    if not target.name.lower().endswith(suffix):
        raise ValueError(f"expected a name ending in {suffix} for this sample, got {target.name!r}")
    return write_atomically(target, lambda temporary: _copy(path, temporary))


def _copy(source: Path, target: Path) -> None:
    shutil.copyfile(source, target)


@atlas_app.command("build", epilog="[bold]Example[/bold]\n\ncurvafit atlas build store.zarr --count 240 --shape 56")
def build_atlas(
    store: Annotated[Path, typer.Argument(help="Folder of the Zarr store; resumed where it exists.")],
    count: Annotated[int, typer.Option(help="Viable shapes to end with.")] = 240,
    shape: Annotated[str, typer.Option(help="Voxels: N or Z,Y,X.")] = "56",
    seed: Annotated[int, typer.Option(help="Of the random law.")] = 0,
    schedule: Annotated[str, typer.Option(help="fast or paper.")] = "fast",
) -> None:
    """Generate shapes of the random law into a store, until enough are viable."""
    with plainly():
        box = whole_triple(shape, "--shape")
        from curvafit.data_synth.atlas import build

        with stages() as progress:
            build(
                store,
                count,
                box,
                seed,
                schedule,
                lambda record, viable, draws: progress(f"{viable} viable of {draws} draws", viable / count),
            )
        say(str(store))


@atlas_app.command("extract", epilog="[bold]Example[/bold]\n\ncurvafit atlas extract store.zarr -o atlas.npz")
def extract_atlas(
    store: Annotated[Path, typer.Argument(help="A store made by `curvafit atlas build`.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="The atlas (.npz) to write.")],
) -> None:
    """Measure a store's shapes, and write the atlas that `infer --atlas` reads."""
    with plainly():
        if out.suffix.lower() != ".npz":
            raise ValueError(f"expected a name ending in .npz, got {out.name!r}")
        from curvafit.index import extract, save_atlas
        from curvafit.shape_files import check_folder

        check_folder(out.parent)
        atlas = extract(store, [command_line()])
        out.parent.mkdir(parents=True, exist_ok=True)
        save_atlas(atlas, out)
        say(f"{len(atlas.ids)} shapes", to=error_console())
        say(str(out))
