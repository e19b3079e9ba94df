"""The commands that segment without a neural network: segment and reconstruct."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import (
    OverwriteOption,
    command_line,
    kept,
    plainly,
    say,
    say_notes,
    stages,
    threshold_of,
    whole_numbers,
)
from curvafit.cli.forecast import SEGMENTATION, say_forecast
from curvafit.cli.options import Reading, Volume, reads_volume

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.inference.infer import Inference
    from curvafit.segmentation.result import Segmentation
    from curvafit.segmentation.tiles import Tiling, Workers
    from curvafit.volumes.boxes import Boxes
    from curvafit.volumes.field import Field

SEGMENT_EXAMPLES = "[bold]Examples[/bold]\n\n" + "\n\n".join(
    (
        "curvafit segment bone.nii.gz --prior bone/fit.json -o mask.nii.gz",
        "curvafit segment cells.h5 --key raw --dark --prior sponge --spacing 0.2 --unit um -o mask.tif",
    )
)
RECONSTRUCT_EXAMPLES = "[bold]Examples[/bold]\n\n" + "\n\n".join(
    (
        "curvafit reconstruct labels.nii.gz --every 8 --prior bone/fit.json -o volume.nii.gz",
        "curvafit reconstruct labels.nii.gz --every 8 --example whole.nii.gz -o volume.nii.gz",
        "curvafit reconstruct labels.tif --known 0,7,15 --axis x --prior tubes -o volume.tif",
        "curvafit reconstruct organelles.nii.gz --every 8 --labels all --example whole.nii.gz -o volume.nii.gz",
        "curvafit reconstruct labels.nii.gz --every 8 --prior bone/fit.json --suggest 3 -o volume.nii.gz",
    )
)

_what = partial(typer.Option, rich_help_panel="What to do")

Target = Annotated[Path, typer.Option("-o", "--output", help="Mask to write: .nii.gz .nii .tif .npy .mrc .zarr.")]
Prior = Annotated[str, _what(help="fit.json of `curvafit infer`, or a preset's name (see `curvafit presets`).")]
Weight = Annotated[float | None, _what(help="Cost of a unit of the energy, in nats; by default chosen, with the law.")]
Threshold = Annotated[str, _what(help="Grey level between the phases, or otsu.")]
Dark = Annotated[bool, _what("--dark", help="The structure is the dark phase.")]
OwnPrior = Annotated[str | None, _what("--prior", help="As in segment; by default inferred from the example.")]
Example = Annotated[Path | None, _what(help="Mask of another such volume, known whole: the prior is tried out on it.")]
Stiffness = Annotated[float | None, _what(help="Stiffness of springs on the known slices: try nothing out.")]
Periodic = Annotated[bool, _what("--periodic", help="The volume repeats, as generated ones do.")]
Runs = Annotated[int, _what(help="Further runs that tell the probability of the inside; 8 are a good number.", min=0)]
Suggest = Annotated[int, _what(help="Number of slices to suggest for annotation; needs --runs, by default 8.", min=0)]
Epsilon = Annotated[float | None, _what(help="ε in the scan's unit; by default twice the smallest voxel edge.")]
Steps = Annotated[int, _what(help="Steps of the flow.", min=1)]
TileOption = Annotated[
    int | None,
    _what("--tile", help="Longest side of a tile, in working voxels; by default one tile up to 256³, else 192.", min=8),
]
WorkersOption = Annotated[
    int | None,
    _what("--workers", help="Processes that lower tiles at once; by default this one, a tile at a time.", min=0),
]
Every = Annotated[int | None, _what(help="Distance of known slices: with 8, every eighth slice is known.")]
First = Annotated[int | None, _what(help="Number of the first known slice, with --every; by default 0.")]
Labels = Annotated[
    str | None, _what(help="Several structures that exclude each other: all, or their labels, 1,2,5; writes labels.")
]
Axis = Annotated[str, _what(help="Axis across the slices: z, y or x (first, second, last axis of an array).")]

#: Laws that are tried of an example's fit, which is not known yet.
INFERRED = 2
#: Bytes for each voxel of the whole volume, beside its tiles: the scan, and the mask in the file's layout.
ASSEMBLED = 6
#: Entries of a record that name files of an example.
EXAMPLES = ("example", "example_probabilities")
#: Steps of the flows, as in `curvafit.segmentation`, which help must not import.
STEPS = 400
#: Number of runs for suggestions, as in `curvafit.segmentation`.
RUNS = 8


@reads_volume
def segment(
    scan: Volume,
    out: Target,
    prior: Prior,
    weight: Weight = None,
    threshold: Threshold = "otsu",
    dark: Dark = False,
    epsilon: Epsilon = None,
    steps: Steps = STEPS,
    tile: TileOption = None,
    workers: WorkersOption = None,
    *,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Find the structure of a noisy scan under a curvature prior; write its mask, a picture and a record."""
    with plainly():
        options: dict[str, Any] = {"weight": weight, "epsilon": epsilon}
        options |= {"threshold": threshold_of(threshold), "dark": dark}

        def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
            from curvafit.segmentation.segment import segment as segment_scan

            return segment_scan(volume, prior, steps=steps, progress=progress, **tools, **options)

        def tried(laws: int, voxels: int) -> float:
            from curvafit.segmentation.trials import trial_steps

            return trial_steps(laws + 1, steps, voxels) if weight is None else 0.0

        record = {"job": "segment", "steps": steps, "tile": tile, **options}
        run_job(scan, out, prior, reading, compute, record, overwrite=overwrite, tried=tried, workers=workers)


@reads_volume
def reconstruct(
    slices: Volume,
    out: Target,
    prior: OwnPrior = None,
    every: Every = None,
    first: First = None,
    known: Annotated[str | None, _what("--known", "--slices", help="Or: numbers of the known slices, 0,7,15.")] = None,
    axis: Axis = "z",
    *,
    labels: Labels = None,
    example: Example = None,
    stiffness: Stiffness = None,
    periodic: Periodic = False,
    runs: Runs = 0,
    suggest: Suggest = 0,
    epsilon: Epsilon = None,
    steps: Steps = STEPS,
    tile: TileOption = None,
    workers: WorkersOption = None,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a mask between known slices, with a curvature prior where it helps; write mask, picture and record."""
    with plainly():
        if axis.lower() not in ("z", "y", "x"):
            raise ValueError(f"expected --axis z, y or x, got {axis!r}")
        if (every is None) == (known is None):
            raise ValueError(f"expected either --every or --known, got {'neither' if every is None else 'both'}")
        if prior is None and example is None:
            raise ValueError("expected --prior or --example, got neither")
        if labels is not None and (reading["label"] is not None or runs or suggest):
            raise ValueError(
                "expected --labels without --label, --runs and --suggest, which are of one structure, got both"
            )
        several = None if labels in (None, "all") else list(whole_numbers(labels, "--labels"))
        numbers = None if known is None else list(whole_numbers(known, "--known"))
        if known is not None and first is not None:
            raise ValueError(f"expected --first beside --every, got {first} beside --known")
        place = {"every": every, "first": first or 0, "known": numbers, "axis": "zyx".index(axis.lower())}
        options: dict[str, Any] = {**place, "stiffness": stiffness, "periodic": periodic, "epsilon": epsilon}
        options |= {"runs": runs, "suggest": suggest}

        def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
            from curvafit.segmentation.reconstruct import reconstruct as fill
            from curvafit.volumes.boxes import read_whole
            from curvafit.volumes.read import load

            alike = {name: reading[name] for name in ("spacing", "unit", "label", "strict")}
            whole = None if example is None else load(example, **alike)
            say_notes(() if whole is None else whole.notes)
            slices = read_whole(volume)
            if labels is not None:
                from curvafit.segmentation.reconstruct import reconstruct_labels

                laws = prior if prior is not None else inferred_of_each(whole, several, progress)
                one = {name: value for name, value in options.items() if name not in ("runs", "suggest")}
                common = {"example": whole, "steps": steps, "progress": progress}
                return reconstruct_labels(slices, laws, chosen=several, **common, **tools, **one)
            law = prior if prior is not None else inferred(whole, progress)
            return fill(slices, law, example=whole, steps=steps, progress=progress, **tools, **options)

        more = {"example": None if example is None else str(example), **options}
        record = {"job": "reconstruct", "steps": steps, "tile": tile, **({"labels": labels} if labels else {}), **more}

        def tried(laws: int, voxels: int) -> float:
            return ((laws if stiffness is None else 0) + 2 * (runs or RUNS * bool(suggest))) * steps

        run_job(slices, out, prior, reading, compute, record, overwrite=overwrite, tried=tried, workers=workers)


def inferred(example: Field | None, progress: Progress) -> Inference:
    """Return what an example's mask says of its law, without a twin."""
    from curvafit.inference.infer import infer

    return infer(example, kind="mask", fast=True, progress=progress)  # type: ignore[arg-type]


def inferred_of_each(example: Field | None, chosen: list[int] | None, progress: Progress) -> dict[int, Any]:
    """Return what an example says of the law of each label; the Willmore energy where it says nothing."""
    from dataclasses import replace

    from curvafit.priors.coefficients import Coefficients
    from curvafit.segmentation.reconstruct import labels_of
    from curvafit.volumes.field import ScanError

    laws: dict[int, Any] = {}
    for number in labels_of(example.values, chosen):  # type: ignore[union-attr]
        try:
            laws[number] = inferred(replace(example, values=example.values == number), progress)  # type: ignore[arg-type, union-attr]
        except ScanError as reason:
            say_notes([f"Label {number} of the example has no law ({reason}): the Willmore energy is tried."])
            laws[number] = Coefficients.willmore()
    return laws


def run_job(
    source: str,
    out: Path,
    prior: str | None,
    reading: dict[str, Any],
    compute: Callable[..., Segmentation],
    record: dict[str, Any],
    *,
    overwrite: bool,
    tried: Callable[[int, int], float],
    workers: int | None = None,
    read: Callable[..., Field] | None = None,
    image: Path | None = None,
) -> None:
    """Check, read, compute, write and print. Tiles stay beside the output until it is written.

    Parameters
    ----------
    tried
        Says how many steps it takes to try laws out, given their number and that of the working voxels.
    workers
        Number of processes that lower tiles at once; this one by default.
    read
        Reads the source, with the options in `reading`; by default its boxes are read where they are asked for.
    image
        The file whose header the mask gets; by default the source.
    """
    from curvafit.core.files import remove
    from curvafit.priors.law import Law, preset_name
    from curvafit.segmentation.engine import laws_of
    from curvafit.segmentation.result import check_mask_target, write_mask
    from curvafit.segmentation.tiles import Tiling
    from curvafit.volumes.boxes import boxes_of, read_whole

    law_file = None if preset_name(prior) else prior
    inputs = [each for each in (source, law_file, image, *map(record.get, EXAMPLES)) if each is not None]
    more: dict[str, Any] = {"overwrite": overwrite, "probability": bool(record.get("runs") or record.get("suggest"))}
    check_mask_target(out, inputs=inputs, **more)
    if prior is not None:
        Law.of(prior)
    with stages() as progress:
        progress("reading", 0.0)
        boxes = boxes_of(source, **reading) if read is None else boxes_of(read(source, **reading))
        check_mask_target(out, boxes.frame.unit, **more)
        tiling = Tiling.of(boxes.frame, record["epsilon"], record["tile"], periodic=record.get("periodic", False))
        laws = INFERRED if prior is None else len(laws_of(prior, boxes.frame)[0])
        _say_forecast(record, tiling, laws, tried, workers)
        store = out.with_name(f".{out.name}.curvafit-tiles") if tiling.count > 1 else None
        with kept() if store is not None else nullcontext(), _crew(workers, tiling) as crew:
            result = compute(boxes, progress, tile=record["tile"], store=store, workers=crew)
        progress("writing", 1.0)
        content = {"command": command_line(), "prior": prior, **record}
        place = ("spacing", "crop") if image else ("spacing", "crop", "channel")
        like = (image or source) if all(reading[name] is None for name in place) else None
        whole = read_whole(boxes)
        files = write_mask(result, whole, out, like=like, unit=reading["unit"], record=content, overwrite=overwrite)
        if store is not None:
            remove(store)
    for note in result.notes:
        say(note)
    say(f"{result.status[0].upper()}{result.status[1:]}.", style="bold")
    for path in files:
        say(str(path))


def _say_forecast(
    record: dict[str, Any], tiling: Tiling, laws: int, tried: Callable[[int, int], float], workers: int | None
) -> None:
    """Print the forecast: of tiles, the time counts the overlap, and the memory is that of those lowered at once."""
    shape = tuple(n * times for n, times in zip(tiling.shape, tiling.place.times, strict=True))
    voxels, job, steps, several = math.prod(shape), record["job"], record["steps"], tiling.count > 1
    trials = tried(laws, voxels)
    if not several:
        say_forecast(job, shape, steps + trials, SEGMENTATION, what="working voxels")
        return
    share, at_once = sum(tiling.voxels) / voxels, max(1, min(workers or 1, tiling.count))
    what = f"working voxels in {tiling.count} tiles"
    cost = SEGMENTATION._replace(base=SEGMENTATION.base + ASSEMBLED * math.prod(tiling.shape) / at_once)
    held = max(tiling.voxels)
    say_forecast(job, shape, steps * share + trials, cost, what=what, workers=at_once, held=held)


@contextmanager
def _crew(workers: int | None, tiling: Tiling) -> Iterator[Workers | None]:
    """Start workers for tiles, where they are asked for and there are several tiles."""
    if not workers or tiling.count == 1:
        yield None
        return
    from curvafit.core.workers import cluster

    with cluster(workers) as crew:
        yield _OneThread(crew)


class _OneThread:
    """Workers of one thread each."""

    def __init__(self, workers: Workers) -> None:
        self._workers = workers

    @property
    def places(self) -> int:
        return self._workers.places

    def submit(self, make: Callable[..., list[Any]], path: Path, indices: Sequence[int]) -> None:
        self._workers.submit(partial(_on_one_thread, make), path, indices)

    def done(self) -> list[Any]:
        return self._workers.done()


def _on_one_thread(make: Callable[..., list[Any]], path: Path, indices: Sequence[int]) -> list[Any]:
    from curvafit.priors.kernels.threads import one_thread

    with one_thread():
        return make(path, indices)
