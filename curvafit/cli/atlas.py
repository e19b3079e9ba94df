"""The commands about atlases: collections of generated shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from curvafit.cli import forecast
from curvafit.cli.forecast import cores, say_forecast
from curvafit.cli.support import (
    OverwriteOption,
    command_line,
    device_of,
    error_console,
    kept,
    plainly,
    say,
    stages,
    whole_triple,
)

if TYPE_CHECKING:
    from curvafit.data_synth.atlas.build import Progress
    from curvafit.data_synth.atlas.design import Design
    from curvafit.data_synth.atlas.workers import Workers

atlas_app = typer.Typer(help="Collections of generated shapes to match scans against.", no_args_is_help=True)


WorkersOption = Annotated[
    int | None, typer.Option(help="Processes on this machine; as many as cores by default, 0 for none but this.")
]
SchedulerOption = Annotated[str | None, typer.Option(help="A running dask scheduler, tcp://HOST:PORT, instead.")]
DashboardOption = Annotated[
    int | None, typer.Option(help="Port of dask's own page on 127.0.0.1, for workers on this machine; none by default.")
]
_Store = Annotated[Path, typer.Argument(help="Folder of the Zarr store.")]


@atlas_app.command(
    "build",
    epilog="[bold]Examples[/bold]\n\n"
    "curvafit atlas build store.zarr --count 1000 --shape 64\n\n"
    "curvafit atlas build tubes.zarr --around tubes --spread 0.2 --count 100\n\n"
    "curvafit atlas build box.zarr --design box.yaml --scheduler tcp://node1:8786",
)
def build_atlas(
    store: Annotated[Path, typer.Argument(help="Folder of the Zarr store; resumed where it exists.")],
    count: Annotated[int, typer.Option(help="Viable shapes to end with.")] = 1000,
    shape: Annotated[str, typer.Option(help="Voxels: N or Z,Y,X.")] = "64",
    seed: Annotated[int, typer.Option(help="Of the design.")] = 0,
    design: Annotated[str, typer.Option(help="random, sobol, or a YAML file (docs/atlas.md).")] = "random",
    around: Annotated[str | None, typer.Option(help="A preset or fit.json to draw around, instead.")] = None,
    spread: Annotated[float | None, typer.Option(help="With --around: share of the random law's intervals.")] = None,
    schedule: Annotated[str, typer.Option(help="fast or paper.")] = "fast",
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    dashboard: DashboardOption = None,
) -> None:
    """Generate shapes into a store, until enough are viable. A killed build goes on where it was."""
    with plainly():
        box = whole_triple(shape, "--shape")
        law = _design(design, around, spread)
        from curvafit.data_synth.atlas.build import build, check_count, settings_of
        from curvafit.data_synth.atlas.store import open_store
        from curvafit.data_synth.atlas.workers import check_workers
        from curvafit.files import check_folder
        from curvafit.generation.memory import FLOW, check_memory
        from curvafit.generation.schedule import schedule as named

        check_count(count, 1)
        check_workers(workers, scheduler)
        if scheduler is None:
            check_memory(box, FLOW, "a shape")
        settings = settings_of(box, seed, schedule, law)
        if store.exists():
            open_store(store, settings)
        check_folder(store.parent)
        if scheduler is None and not store.exists():
            steps = count * named(schedule).steps
            say_forecast("atlas build", box, steps, forecast.FLOW, what="voxels a shape", workers=cores(workers))
        with _made(count, (workers, scheduler, dashboard)) as (crew, progress):
            build(store, count, box, seed, schedule, progress, design=law, workers=crew)
        say(str(store))


@atlas_app.command("extend", epilog="[bold]Example[/bold]\n\ncurvafit atlas extend store.zarr --count 500")
def extend_atlas(
    store: _Store,
    count: Annotated[int, typer.Option(help="Viable shapes to add; 0 goes on with what was stopped.")] = 100,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    dashboard: DashboardOption = None,
) -> None:
    """Add shapes to a store, of its own design and settings."""
    with plainly():
        from curvafit.data_synth.atlas.build import check_count, extend
        from curvafit.data_synth.atlas.store import open_store
        from curvafit.data_synth.atlas.workers import check_workers

        check_count(count, 0)
        check_workers(workers, scheduler)
        wanted = open_store(store).wanted + count

        def again() -> str:
            return "`--count 0`" if open_store(store).wanted == wanted else "the same command"

        with _made(wanted, (workers, scheduler, dashboard), again) as (crew, progress):
            extend(store, count, progress, workers=crew)
        say(str(store))


@atlas_app.command("info", epilog="[bold]Example[/bold]\n\ncurvafit atlas info store.zarr")
def atlas_info(store: _Store) -> None:
    """What a store holds, and how it was made."""
    with plainly():
        from curvafit.data_synth.atlas.census import census
        from curvafit.data_synth.atlas.store import open_store

        for name, value in census(open_store(store)).items():
            say(f"{name}: {value}")


@atlas_app.command("verify", epilog="[bold]Example[/bold]\n\ncurvafit atlas verify store.zarr --regenerate 5")
def verify_atlas(
    store: _Store,
    regenerate: Annotated[int, typer.Option(help="Draws to make again and compare.")] = 3,
    seed: Annotated[int, typer.Option(help="Of the choice of these.")] = 0,
) -> None:
    """Check every draw of a store. Exit code 1 where something is lost, torn, doubled or not what it says."""
    with plainly():
        from curvafit.data_synth.atlas.census import verify

        with stages() as progress:
            found = verify(store, regenerate, seed, progress)
        for note in found.notes:
            say(f"note: {note}")
        for problem in found.problems:
            say(f"error: {problem}", to=error_console())
        say(found.status)
    if found.problems:
        raise typer.Exit(1)


@atlas_app.command("extract", epilog="[bold]Example[/bold]\n\ncurvafit atlas extract store.zarr -o atlas.npz")
def extract_atlas(
    store: Annotated[Path, typer.Argument(help="A store made by `curvafit atlas build`.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="The atlas (.npz) to write.")],
    overwrite: OverwriteOption = False,
) -> None:
    """Measure a store's shapes, and write the atlas that `infer --atlas` reads."""
    with plainly():
        if out.suffix.lower() != ".npz":
            raise ValueError(f"expected a name ending in .npz, got {out.name!r}")
        from curvafit.atlas_map.extract import extract
        from curvafit.files import check_folder, check_free
        from curvafit.inference.atlas import is_atlas, save_atlas

        check_folder(out.parent)
        check_free([out], is_atlas, [store], overwrite)
        with stages() as progress:
            atlas = extract(
                store,
                [command_line()],
                progress=lambda done, count: progress(f"measuring {count} shapes", done / count),
            )
        out.parent.mkdir(parents=True, exist_ok=True)
        save_atlas(atlas, out)
        say(f"{len(atlas.ids)} shapes", to=error_console())
        say(str(out))


@atlas_app.command("map", epilog="[bold]Example[/bold]\n\ncurvafit atlas map store.zarr -o map")
def map_atlas(
    store: Annotated[Path, typer.Argument(help="A store made by `curvafit atlas build`.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for atlas.html, atlas.png and a cache.")],
    device: Annotated[str, typer.Option(help="For the distances: cpu, cuda, cuda:1 …")] = "cpu",
    overwrite: OverwriteOption = False,
) -> None:
    """Lay a store's shapes out on a map: a picture, and a page to explore them in and to place scans on."""
    with plainly():
        with kept(), stages() as progress:
            from curvafit.atlas_map.files import check_map, write_map

            check_map(out, store, overwrite)
            told = {"device": device_of(device), "command": command_line(), "overwrite": overwrite}
            files = write_map(store, out, **told, progress=progress)
        for path in files:
            say(str(path))


def _design(name: str, around: str | None, spread: float | None) -> Design:
    """The design that the options name."""
    from curvafit.data_synth.atlas import design, design_file

    if around is not None:
        if name not in ("random", "sobol"):
            raise ValueError(f"expected either --around or a design's file, got {around} and {name}")
        share = design_file.SPREAD if spread is None else spread
        return design.around(design_file.point_of(around), share, name)  # type: ignore[arg-type]
    if spread is not None:
        raise ValueError("expected --around beside --spread, got none")
    if name in ("random", "sobol"):
        return design.boxed(name)  # type: ignore[arg-type]
    return design_file.read_design(name)


@contextmanager
def _made(
    count: int, how: tuple[int | None, str | None, int | None], again: Callable[[], str] = lambda: "the same command"
) -> Iterator[tuple[Workers, Progress]]:
    """Workers, and a progress bar for them."""
    from curvafit.data_synth.atlas.workers import cluster

    with kept(again), stages() as progress:
        progress("starting workers", 0.0)
        with cluster(*how) as crew:
            yield crew, lambda _, viable, draws: progress(f"{viable} viable of {draws} draws", viable / count)
