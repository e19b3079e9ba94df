"""The commands about atlases: collections of generated shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import command_line, error_console, say, show_stages
from curvafit.cli.options import OverwriteOption, Workers, add_commands, command, parse_whole_triple

atlas_app = typer.Typer(help="Collections of generated shapes to match scans against.", no_args_is_help=True)

_Store = Annotated[Path, typer.Argument(help="Folder of the store.")]


@command(
    "curvafit atlas build store --count 1000 --shape 64",
    "curvafit atlas build store --count 1500 --shape 64",
    "curvafit atlas build box --design box.yaml --scheduler tcp://node1:8786",
)
def build_atlas(
    store: Annotated[Path, typer.Argument(help="Folder of the store; a store that exists is resumed.")],
    count: Annotated[int, typer.Option(help="Number of viable shapes in the store at the end.")] = 1000,
    shape: Annotated[str, typer.Option(help="Voxels of a shape: N or Z,Y,X.")] = "64",
    seed: Annotated[int, typer.Option(help="Seed of the design.")] = 0,
    design: Annotated[str, typer.Option(help="random, sobol, or a YAML file (docs/howto/atlas.md).")] = "random",
    schedule: Annotated[str, typer.Option(help="Schedule of the flow: fast, paper, deep or cosine.")] = "fast",
    steps: Annotated[int | None, typer.Option(help="Number of steps, instead of the schedule's.")] = None,
    *,
    crew: Workers,
) -> None:
    """Generate shapes into a store until enough are viable. The same command resumes; a larger --count adds to it."""
    size = parse_whole_triple(shape, "--shape")
    from curvafit.core.files import check_folder
    from curvafit.data_synth.atlas import build
    from curvafit.data_synth.design import design_box, read_design
    from curvafit.generation.schedule import schedule as make_schedule

    rule = design_box(design) if design in ("random", "sobol") else read_design(design)  # type: ignore[arg-type]
    crew.check_memory(size)
    plan = make_schedule(schedule, steps)
    check_folder(store.parent)
    with crew.start(store) as (workers, progress):
        build(store, count, size, seed, plan, progress, design=rule, workers=workers)
    say(str(store))


@command("curvafit atlas info store")
def info_atlas(store: _Store) -> None:
    """Show the content of a store, and how it was made."""
    from curvafit.data_synth.atlas import summarise
    from curvafit.data_synth.store import open_store

    for name, value in summarise(open_store(store)).items():
        say(f"{name}: {value}")


@command("curvafit atlas verify store")
def verify_atlas(store: _Store) -> None:
    """Check every draw of a store; exit with code 1 where one is missing, torn or changed."""
    from curvafit.data_synth.atlas import verify

    with show_stages() as progress:
        verdict = verify(store, progress)
    for problem in verdict.problems:
        say(f"error: {problem}", to=error_console())
    say(verdict.status)
    if verdict.problems:
        raise typer.Exit(1)


@command("curvafit atlas extract store -o atlas.npz", "curvafit atlas extract box corner -o atlas.npz")
def extract_atlas(
    stores: Annotated[list[Path], typer.Argument(help="Stores made by `curvafit atlas build`, of one grid.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="The atlas (.npz) to write.")],
    overwrite: OverwriteOption = False,
) -> None:
    """Measure the shapes of stores, and write the atlas that `infer --atlas` reads."""
    from curvafit.core.records import can_write
    from curvafit.data_synth.atlas import extract
    from curvafit.inference.atlas import ATLAS_FILE, save_atlas

    if out.suffix.lower() != ".npz":
        raise ValueError(f"the output's name must end in .npz, got {out.name!r}")
    can_write(out, ATLAS_FILE, inputs=stores, overwrite=overwrite)
    with show_stages() as progress:
        atlas = extract(stores, [command_line()], progress=progress)
    save_atlas(atlas, out)
    say(f"{len(atlas.ids)} shapes", to=error_console())
    say(str(out))


@command(
    "curvafit atlas map store -o map.html",
    "curvafit atlas map box corner --fit bone/fit.json --fit lung/fit.json -o map.html",
)
def map_atlas(
    stores: Annotated[list[Path], typer.Argument(help="Stores made by `curvafit atlas build`, of one grid.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="The page (.html) to write.")],
    fit: Annotated[list[Path] | None, typer.Option(help="fit.json of a scan to place among the shapes.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Draw a map of the shapes of stores, with scans among them: a page to look at them, and to turn each."""
    with show_stages() as progress:
        from curvafit.report.atlas import write_map

        settings = {"fits": fit or (), "command": command_line(), "overwrite": overwrite, "progress": progress}
        page = write_map(stores, out, **settings)
    say(str(page))


add_commands(atlas_app, build_atlas, info_atlas, verify_atlas, extract_atlas, map_atlas)
