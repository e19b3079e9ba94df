"""The commands that segment without a neural network: segment and reconstruct."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.forecast import SEGMENTATION, say_forecast
from curvafit.cli.reading import Reading, Volume, reads_volume
from curvafit.cli.support import (
    OverwriteOption,
    command_line,
    plainly,
    say,
    say_notes,
    stages,
    threshold_of,
    whole_numbers,
)

if TYPE_CHECKING:
    from curvafit.progress import Progress
    from curvafit.segmentation.segment import Segmentation
    from curvafit.volumes.scan import Field

SEGMENT_EXAMPLES = "[bold]Examples[/bold]\n\n" + "\n\n".join(
    (
        "curvafit segment bone.nii.gz --prior bone/fit.json -o mask.nii.gz",
        "curvafit segment cells.h5 --key raw --dark --prior sponge --spacing 0.2 --unit um -o mask.tif",
        "curvafit segment vessels.nii.gz --probability network.nii.gz --prior vessels/fit.json -o mask.nii.gz",
    )
)
RECONSTRUCT_EXAMPLES = "[bold]Examples[/bold]\n\n" + "\n\n".join(
    (
        "curvafit reconstruct labels.nii.gz --every 8 --prior bone/fit.json -o volume.nii.gz",
        "curvafit reconstruct labels.tif --slices 0,7,15 --axis x --prior tubes -o volume.tif",
    )
)

_what = partial(typer.Option, rich_help_panel="What to do")

Target = Annotated[Path, typer.Option("-o", "--output", help="Mask to write: .nii.gz .nii .tif .npy .mrc .zarr.")]
Prior = Annotated[str, _what(help="fit.json of `curvafit infer`, or a preset's name (see `curvafit presets`).")]
Probability = Annotated[Path | None, _what(help="Probability of the inside, a volume, instead of grey levels.")]
Weight = Annotated[float | None, _what(help="Cost of a unit of the energy, in nats; by default 2 / (a20 + a02).")]
Threshold = Annotated[str, _what(help="Grey level between the phases, or otsu.")]
Dark = Annotated[bool, _what("--dark", help="The structure is the dark phase.")]
Epsilon = Annotated[float | None, _what(help="ε in the scan's unit; by default twice the smallest voxel edge.")]
Steps = Annotated[int, _what(help="Steps of the flow.", min=1)]
Every = Annotated[int | None, _what(help="Distance of known slices: with 8, every eighth slice is known.")]
First = Annotated[int | None, _what(help="Number of the first known slice, with --every; by default 0.")]
Axis = Annotated[str, _what(help="Axis across the slices: z, y or x (first, second, last axis of an array).")]

#: Steps of the flow, as in `curvafit.segmentation.segment`, which help must not import.
STEPS = 150


@reads_volume
def segment(
    scan: Volume,
    out: Target,
    prior: Prior,
    probability: Probability = None,
    weight: Weight = None,
    threshold: Threshold = "otsu",
    dark: Dark = False,
    epsilon: Epsilon = None,
    steps: Steps = STEPS,
    *,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Find the structure of a noisy scan under a curvature prior; write its mask, a picture and a record."""
    with plainly():
        options: dict[str, Any] = {"weight": weight, "epsilon": epsilon}
        if probability is None:
            options |= {"threshold": threshold_of(threshold), "dark": dark}
        elif dark or threshold.lower() != "otsu":
            extra = "--dark" if dark else f"--threshold {threshold}"
            raise ValueError(f"expected neither --threshold nor --dark with --probability, got {extra}")

        def compute(volume: Field, progress: Progress) -> Segmentation:
            from curvafit.segmentation.evidence import cropped_map
            from curvafit.segmentation.segment import segment as segment_scan
            from curvafit.volumes.scan import load

            alike = {name: reading[name] for name in ("spacing", "unit", "strict")}
            chances = None if probability is None else cropped_map(load(probability, **alike), reading["crop"])
            say_notes(() if chances is None else chances.notes)
            return segment_scan(volume, prior, probability=chances, steps=steps, progress=progress, **options)

        more = {"probability": None if probability is None else str(probability), **options}
        _run(scan, out, prior, reading, compute, {"job": "segment", "steps": steps, **more}, overwrite)


@reads_volume
def reconstruct(
    slices: Volume,
    out: Target,
    prior: Prior,
    every: Every = None,
    first: First = None,
    known: Annotated[str | None, _what("--slices", help="Or: the numbers of the known slices, 0,7,15.")] = None,
    axis: Axis = "z",
    epsilon: Epsilon = None,
    steps: Steps = STEPS,
    *,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a mask between known slices under a curvature prior; write the mask, a picture and a record."""
    with plainly():
        if axis.lower() not in ("z", "y", "x"):
            raise ValueError(f"expected --axis z, y or x, got {axis!r}")
        if (every is None) == (known is None):
            raise ValueError(f"expected either --every or --slices, got {'neither' if every is None else 'both'}")
        numbers = None if known is None else list(whole_numbers(known, "--slices"))
        if known is not None and first is not None:
            raise ValueError(f"expected --first beside --every, got {first} beside --slices")
        options = {"every": every, "first": first or 0, "known": numbers, "axis": "zyx".index(axis.lower())}

        def compute(volume: Field, progress: Progress) -> Segmentation:
            from curvafit.segmentation.segment import reconstruct as fill

            return fill(volume, prior, epsilon=epsilon, steps=steps, progress=progress, **options)  # type: ignore[arg-type]

        record = {"job": "reconstruct", "steps": steps, "epsilon": epsilon, **options}
        _run(slices, out, prior, reading, compute, record, overwrite)


def _run(
    source: str,
    out: Path,
    prior: str,
    reading: dict[str, Any],
    compute: Callable[[Field, Progress], Segmentation],
    record: dict[str, Any],
    overwrite: bool,
) -> None:
    """Check, read, compute, write and print."""
    from curvafit.priors.coefficients import preset_name
    from curvafit.priors.law import texture_of
    from curvafit.segmentation.mask_files import check_mask_target, write_mask
    from curvafit.segmentation.working import WorkingGrid
    from curvafit.volumes.scan import load

    law_file = None if preset_name(prior) else prior
    inputs = [each for each in (source, law_file, record.get("probability")) if each is not None]
    check_mask_target(out, inputs=inputs, overwrite=overwrite)
    texture_of(prior)
    with stages() as progress:
        progress("reading", 0.0)
        volume = load(source, **reading)
        check_mask_target(out, volume.unit, overwrite=overwrite)
        working = WorkingGrid.of(volume, record["epsilon"])
        say_forecast(record["job"], working.grid.shape, record["steps"], SEGMENTATION, what="working voxels")
        result = compute(volume, progress)
        progress("writing", 1.0)
        content = {"command": command_line(), "prior": prior, **record}
        place = ("spacing", "crop", "channel")
        like = source if all(reading[name] is None for name in place) else None
        more = {"record": content, "overwrite": overwrite}
        files = write_mask(result, volume, out, like=like, unit=reading["unit"], **more)
    for note in result.notes:
        say(note)
    say(f"{result.status[0].upper()}{result.status[1:]}.", style="bold")
    for path in files:
        say(str(path))
