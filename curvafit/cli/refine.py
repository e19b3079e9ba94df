"""The command that makes a mask of a network's probabilities: refine."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, command
from curvafit.cli.segment import Epsilon, Job, OwnPrior, Steps, TileOption, Weight, WorkersOption, run_job

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.segmentation.result import Segmentation
    from curvafit.volumes.boxes import Boxes

_what = partial(typer.Option, rich_help_panel="What to do")


@command(
    "curvafit refine p.nii.gz --example mask2.nii.gz --example-probabilities p2.nii.gz -o mask.nii.gz",
    "curvafit refine case.npz --channel 1 --prior vessels/fit.json --weight 10 -o mask.nii.gz",
    "curvafit refine predicted --channel 1 --example mask2.nii.gz --example-probabilities p2.npz -o refined",
)
def refine(
    probabilities: Annotated[
        str, typer.Argument(help="Probability of the inside: NIfTI, TIFF, NPY, NPZ, Zarr …; or a folder of NPZ files.")
    ],
    out: Annotated[Path, typer.Option("-o", "--output", help="Mask to write: .nii.gz .tif …; for a folder, a folder.")],
    prior: OwnPrior = None,
    example: Annotated[Path | None, _what(help="True mask of another volume, to try law and weight out on it.")] = None,
    example_probabilities: Annotated[Path | None, _what(help="The network's probabilities for the example.")] = None,
    weight: Weight = None,
    epsilon: Epsilon = None,
    *,
    steps: Steps = 400,
    tile: TileOption = None,
    workers: WorkersOption = None,
    like: Annotated[Path | None, _what(help="Image of the same voxels; by default one of the NPZ's name.")] = None,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a mask of a network's probabilities, with a curvature prior where it helps; write mask, picture and record.

    Law and weight are those that do best on an example; where p > 1/2 does best, that is the mask. Of nnU-Net's
    NPZ files --channel takes the class; a folder of them becomes a folder of masks. --label is the example's.
    """
    from curvafit.segmentation.evidence import probability_evidence
    from curvafit.segmentation.refine import calibrate, check_judge, find_image, load_probabilities
    from curvafit.segmentation.refine import refine as refine_map
    from curvafit.segmentation.result import check_mask_target
    from curvafit.segmentation.slices import check_spacing
    from curvafit.volumes.boxes import read_whole
    from curvafit.volumes.read import load

    if (example is None) != (example_probabilities is None):
        raise ValueError("--example and --example-probabilities go together, got one of them")
    check_judge(example, weight)
    if prior is None and example is None:
        raise ValueError("give --prior or --example: the law, or a mask from which it is inferred")
    files = _list_files(probabilities, out)
    if like is not None and len(files) > 1:
        raise ValueError("--like is for one file; images of a folder lie beside its NPZ files")
    map_reading: dict[str, Any] = {name: reading[name] for name in reading if name != "label"} | {"like": like}
    example_reading = {name: value for name, value in map_reading.items() if name not in ("crop", "like")}
    mask_reading = {name: reading[name] for name in ("spacing", "unit", "label", "strict")}
    has_place = reading["spacing"] is not None or reading["unit"] is not None
    images = {source: like or (None if has_place else find_image(source)) for source, _ in files}
    named = {"example": example, "example_probabilities": example_probabilities, "like": like}
    options = {"epsilon": epsilon, "steps": steps}
    record: dict[str, Any] = {"job": "refine", "weight": weight, "tile": tile, **options}
    record |= {name: None if path is None else str(path) for name, path in named.items()}

    # Everything is read and checked before the first work, which may take minutes.
    inputs = [file for file in (*images, *images.values(), *named.values()) if file is not None]
    for _, target in files:
        check_mask_target(target, inputs=inputs, overwrite=overwrite)
    judge: dict[str, Any] = {"weight": weight}
    chances = None if example is None else load_probabilities(example_probabilities, **example_reading)  # type: ignore[arg-type]
    for source in images:
        field = load_probabilities(source, **map_reading)
        probability_evidence(field)
        if chances is not None:
            check_spacing(chances, field, "the probabilities")
    if chances is not None:
        mask = load(example, **mask_reading)  # type: ignore[arg-type]
        say_notes((*chances.notes, *mask.notes))
        with show_stages() as progress:
            judge = {"example": calibrate(chances, mask, prior, progress=progress, **options)}
        record["calibration"] = judge["example"].as_dict()

    def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
        return refine_map(read_whole(volume), prior, progress=progress, **judge, **tools, **options)

    for source, target in files:
        job = Job(source, target, prior, map_reading, record, overwrite, workers, images[source])
        run_job(job, compute, load_probabilities)


def _list_files(source: str, out: Path) -> list[tuple[str, Path]]:
    """Return the maps to read and the masks to write: those of a folder of NPZ files, or one."""
    maps = sorted(Path(source).glob("*.npz")) if Path(source).is_dir() else []
    return [(str(path), out / f"{path.stem}.nii.gz") for path in maps] or [(source, out)]
