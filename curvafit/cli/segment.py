"""The commands that segment without a neural network: segment and reconstruct."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, resumable, say, say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, Volume, command, parse_threshold, parse_whole_numbers

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.segmentation.result import Segmentation
    from curvafit.volumes.boxes import Boxes
    from curvafit.volumes.field import Field

_what = partial(typer.Option, rich_help_panel="What to do")

Target = Annotated[
    Path,
    typer.Option("-o", "--output", help="Mask to write: .nii.gz .nii .tif .npy .mrc .zarr; or IMAGE.zarr/labels/NAME."),
]
Weight = Annotated[float | None, _what(help="Cost of a unit of the energy, in nats; by default chosen, with the law.")]
OwnPrior = Annotated[
    str | None, _what("--prior", help="A law as in segment, which is tried from the network's volume; by default none.")
]
Stiffness = Annotated[float | None, _what(help="Stiffness of springs on the known slices: try nothing out.")]
Epsilon = Annotated[float | None, _what(help="ε in the scan's unit; by default twice the smallest voxel edge.")]
Steps = Annotated[int, _what(help="Steps of the flow.", min=1)]
TileOption = Annotated[
    int | None, _what("--tile", help="Longest side of a tile, in working voxels; by default 192 beyond 256³.", min=8)
]
WorkersOption = Annotated[int | None, _what("--workers", help="Processes that lower tiles; by default one.", min=0)]
Axis = Annotated[str, _what(help="Axis across the slices: z, y or x (first, second, last axis of an array).")]


@command(
    "curvafit segment bone.nii.gz --prior bone/fit.json -o mask.nii.gz",
    "curvafit segment cells.h5 --key raw --dark --prior sponge --spacing 0.2 --unit um -o mask.tif",
)
def segment(
    scan: Volume,
    out: Target,
    prior: Annotated[str, _what(help="fit.json of `curvafit infer`, or a preset's name (see `curvafit presets`).")],
    weight: Weight = None,
    threshold: Annotated[str, _what(help="Grey level between the phases, or otsu.")] = "otsu",
    dark: Annotated[bool, _what("--dark", help="The structure is the dark phase.")] = False,
    epsilon: Epsilon = None,
    steps: Steps = 400,
    tile: TileOption = None,
    workers: WorkersOption = None,
    *,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Find the structure of a noisy scan under a curvature prior; write its mask, a picture and a record."""
    options: dict[str, Any] = {"weight": weight, "epsilon": epsilon}
    options |= {"threshold": parse_threshold(threshold), "dark": dark}

    def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
        from curvafit.segmentation.segment import segment as segment_scan

        return segment_scan(volume, prior, steps=steps, progress=progress, **tools, **options)

    record = {"job": "segment", "steps": steps, "tile": tile, **options}
    run_job(Job(scan, out, prior, reading, record, overwrite, workers), compute)


@command(
    "curvafit reconstruct labels.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.nii.gz --every 8 --image scan.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.nii.gz --every 8 --example whole.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.tif --known 0,7,15 --axis x --suggest 3 -o volume.tif",
    "curvafit reconstruct labels.nii.gz --ignore 255 -o volume.nii.gz",
    "curvafit reconstruct organelles.nii.gz --every 8 --labels all -o volume.nii.gz",
    "curvafit reconstruct labels.nii.gz --every 8 --prior bone/fit.json -o volume.nii.gz",
)
def reconstruct(
    slices: Volume,
    out: Target,
    prior: OwnPrior = None,
    every: Annotated[
        int | None, _what(help="Distance of known slices, 8: every eighth. By default those with labels are known.")
    ] = None,
    first: Annotated[int | None, _what(help="Number of the first known slice, with --every; by default 0.")] = None,
    known: Annotated[str | None, _what(help="Or also: numbers of known slices, 0,7,15.")] = None,
    ignore: Annotated[
        int | None, _what(help="Or: the label of voxels that nobody annotated; all others are known.")
    ] = None,
    axis: Axis = "z",
    *,
    labels: Annotated[
        str | None,
        _what(help="Several structures that exclude each other: all, or their labels, 1,2,5; writes labels."),
    ] = None,
    image: Annotated[str | None, _what(help="The grey levels of the volume, on the same voxels.")] = None,
    instances: Annotated[
        bool | None,
        _what(help="With --labels and --image: labels are instances of one kind, such as cells; by default as drawn."),
    ] = None,
    example: Annotated[
        Path | None, _what(help="Mask of another such volume, known whole: it tunes the network for a minute.")
    ] = None,
    careful: Annotated[bool, _what("--careful", help="Average eight mirror images: eight times as long.")] = False,
    filler: Annotated[
        Path | None, _what(help="Weights of `curvafit atlas teach`; by default the packaged ones.")
    ] = None,
    stiffness: Stiffness = None,
    periodic: Annotated[bool, _what("--periodic", help="The volume repeats, as generated ones do.")] = False,
    suggest: Annotated[int, _what(help="Number of slices to suggest for annotation next.", min=0)] = 0,
    sure: Annotated[
        float | None,
        _what(help="Also write labels for nnU-Net, to be ignored where less probable than, say, 0.9.", min=0.5, max=1),
    ] = None,
    epsilon: Epsilon = None,
    steps: Steps = 400,
    tile: Annotated[
        int | None,
        _what(help="Side of a block, in voxels, of a volume filled into Zarr; with a law as in segment.", min=8),
    ] = None,
    workers: Annotated[int | None, _what(help="Processes for blocks or tiles; by default one.", min=0)] = None,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a mask between known slices; write it, the probability of each voxel, a picture and a record."""
    if axis.lower() not in ("z", "y", "x"):
        raise ValueError(f"--axis must be z, y or x, got {axis!r}")
    if (every is not None or known is not None) and ignore is not None:
        raise ValueError("give either --every and --known, which slices are known, or --ignore, what is not")
    if labels is not None and reading["label"] is not None:
        raise ValueError("--labels is for several structures; --label is for one")
    if instances is not None and None in (labels, image):
        raise ValueError("--instances and --no-instances go with --labels and --image")
    several = None if labels in (None, "all") else list(parse_whole_numbers(labels, "--labels"))
    numbers = None if known is None else list(parse_whole_numbers(known, "--known"))
    if every is None and first is not None:
        raise ValueError(f"--first {first} goes with --every")
    place = {"every": every, "first": first or 0, "known": numbers, "ignore": ignore, "axis": "zyx".index(axis.lower())}
    how: dict[str, Any] = {"stiffness": stiffness, "periodic": periodic, "epsilon": epsilon, "careful": careful}

    def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
        from curvafit.segmentation.reconstruct import reconstruct as fill
        from curvafit.segmentation.reconstruct import reconstruct_labels
        from curvafit.volumes.boxes import read_whole
        from curvafit.volumes.read import load

        alike = {name: reading[name] for name in ("spacing", "unit", "label", "strict")}
        whole = None if example is None else load(example, **alike)
        say_notes(() if whole is None else whole.notes)
        seen = None if image is None else load(image, **{name: reading[name] for name in ("spacing", "unit", "crop")})
        say_notes(() if seen is None else seen.notes)
        common = {
            "image": seen,
            "example": whole,
            "filler": filler,
            "steps": steps,
            "suggest": suggest,
            "progress": progress,
            **tools,
            **place,
            **how,
        }
        if labels is None:
            return fill(read_whole(volume), prior, **common)
        return reconstruct_labels(read_whole(volume), prior, chosen=several, instances=instances, **common)

    record: dict[str, Any] = {"job": "reconstruct", "steps": steps, "tile": tile}
    record |= {"labels": labels, "instances": instances} if labels else {}
    record |= {
        "image": image,
        "example": None if example is None else str(example),
        **place,
        **how,
        "suggest": suggest,
        "sure": sure,
    }
    record["filler"] = None if filler is None else str(filler)
    job = Job(slices, out, prior, reading, record, overwrite, workers)
    alone = not (prior or labels or image or example or periodic or ignore is not None or sure or stiffness)
    if not (alone and _fill_blocks(job, {**place, "careful": careful, "epsilon": epsilon, "suggest": suggest})):
        run_job(job, compute)


def _fill_blocks(job: Job, options: dict[str, Any]) -> bool:
    """Fill a volume between known slices in blocks, if it is so large, and return whether it is."""
    from curvafit.segmentation.blocks import fits_blocks, reconstruct_file
    from curvafit.segmentation.result import check_mask_target
    from curvafit.volumes.boxes import boxes_of

    reading, tile, filler = dict(job.reading), job.record["tile"], job.record["filler"]
    options = {**options, "label": reading.pop("label"), "tile": tile, "filler": filler, "workers": job.workers}
    del options["ignore"]
    if not fits_blocks(job.out, (), 1):
        return False
    inputs = [] if filler is None else [filler]
    check_mask_target(job.out, None, [job.source, *inputs], job.overwrite, maps=["probability"])
    with show_stages() as progress:
        progress("reading", 0.0)
        if not fits_blocks(job.out, boxes_of(job.source, **reading).frame.shape, tile):
            return False
        content = {"command": command_line(), "prior": None, **job.record}
        options |= {"inputs": inputs, "overwrite": job.overwrite, "record": content, "progress": progress}
        with resumable():
            filled = reconstruct_file(job.source, job.out, **options, **reading)
    _print_mask(filled.notes, filled.status, filled.paths)
    return True


@dataclass(frozen=True)
class Job:
    """A volume to read, with the options of reading, and a mask to write, with a record of the command's options."""

    source: str
    out: Path
    prior: str | None  # a preset's name or a file; None where an example says what the law is
    reading: dict[str, Any]
    record: dict[str, Any]
    overwrite: bool
    workers: int | None = None
    image: Path | None = None  # the file whose header the mask gets; by default the source


def run_job(job: Job, compute: Callable[..., Segmentation], read: Callable[..., Field] | None = None) -> None:
    """Check, read, compute, write and print. Finished tiles are kept beside the output until it is written.

    `read` reads the source; by default its boxes are read where they are asked for.
    """
    from curvafit.core.files import remove
    from curvafit.priors.law import Law, preset_name
    from curvafit.segmentation.result import check_mask_target, hidden_store, write_mask
    from curvafit.segmentation.tiles import Tiling
    from curvafit.volumes.boxes import boxes_of, check_fits, read_whole
    from curvafit.volumes.write import check_labels

    record, reading = job.record, job.reading
    law_file = None if preset_name(job.prior) else job.prior
    named = ("image", "example", "example_probabilities", "filler")
    shown = (job.image, *(record.get(name) for name in named))
    options = {"inputs": [file for file in (job.source, law_file, *shown) if file], "overwrite": job.overwrite}
    least = record.get("sure")
    likely = record["job"] == "reconstruct"
    options["maps"] = (["probability"] if likely else []) + (["sure"] if least else [])
    check_mask_target(job.out, **options)
    if job.prior is not None:
        Law.of(job.prior)
    with show_stages() as progress:
        progress("reading", 0.0)
        boxes = boxes_of(job.source, **reading) if read is None else boxes_of(read(job.source, **reading))
        check_fits(boxes)  # the mask is written from memory
        check_mask_target(job.out, boxes.frame, **options)  # again, as a format may not hold the unit
        if record.get("labels"):
            boxes = boxes_of(whole := read_whole(boxes))
            check_labels(job.out, whole)
        tiling = Tiling.of(boxes.frame, record["epsilon"], record["tile"], periodic=record.get("periodic", False))
        store = hidden_store(job.out)
        tiles = tiling.count > 1 and (not likely or job.prior is not None)
        with resumable() if tiles else nullcontext():
            result = compute(boxes, progress, tile=record["tile"], store=store, workers=job.workers)
        progress("writing", 1.0)
        sure = result.keep_sure(least) if least else None
        result = result if sure is None else replace(result, notes=(*result.notes, *sure.notes))
        # The header is kept where it says where the voxels are; one of a file of channels is of all of them.
        stated = ("spacing", "crop") if job.image else ("spacing", "crop", "channel", "time")
        like = (job.image or job.source) if all(reading[name] is None for name in stated) else None
        content = {"command": command_line(), "prior": job.prior, **record}
        how = {"sure": sure, "like": like, "unit": reading["unit"], "record": content, "overwrite": job.overwrite}
        paths = write_mask(result, read_whole(boxes), job.out, **how)
        remove(store)
    _print_mask(result.notes, result.status, paths)


def _print_mask(notes: Sequence[str], status: str, paths: Sequence[Path]) -> None:
    """Print what is said of a mask, and where it is."""
    for note in notes:
        say(note)
    say(f"{status[0].upper()}{status[1:]}.", style="bold")
    for path in paths:
        say(str(path))
