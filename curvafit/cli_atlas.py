"""The commands about atlases: collections of generated shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli_support import command_line, error_console, plainly, say, stages, whole_triple

atlas_app = typer.Typer(help="Collections of generated shapes to match scans against.", no_args_is_help=True)


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
