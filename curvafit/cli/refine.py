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
    from curvafit.volumes.field import Field

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
    repair: Annotated[bool, typer.Option("--repair", hidden=True)] = False,
    logits: Annotated[bool, _what("--logits", help="The values are log-odds, before the sigmoid.")] = False,
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
    """Make a better mask of a network's probabilities; write it, a picture and a record.

    A curvature prior smooths: law and weight are those that do best on an example. Where p > 1/2 does best there, that
    is the mask. Of nnU-Net's NPZ files --channel takes the class; a folder of them becomes a folder of masks. --label
    is the example's.
    """
    from curvafit.segmentation.refine import check_judge, find_image, load_probabilities
    from curvafit.segmentation.refine import refine as refine_map
    from curvafit.segmentation.result import check_mask_target
    from curvafit.volumes.boxes import read_whole

    if repair:
        raise ValueError("--repair is gone, as a blur mended masks as well: give --example, or --prior and --weight")
    given = {"example": example, "example_probabilities": example_probabilities, "like": like}
    if (example is None) != (example_probabilities is None):
        raise ValueError("--example and --example-probabilities go together, got one of them")
    check_judge(example, weight)
    if prior is None and example is None:
        raise ValueError("give --prior or --example: the law, or a mask from which it is inferred")
    files = _list_files(probabilities, out)
    if like is not None and len(files) > 1:
        raise ValueError("--like is for one file; images of a folder lie beside its NPZ files")
    options: dict[str, Any] = {"epsilon": epsilon, "steps": steps}
    record: dict[str, Any] = {"job": "refine", "weight": weight, "tile": tile}
    record |= options | {name: None if path is None else str(path) for name, path in given.items()}
    has_place = reading["spacing"] is not None or reading["unit"] is not None
    images = {source: like or (None if has_place else find_image(source)) for source, _ in files}

    # Everything is read and checked before the first work, which may take minutes.
    inputs = [file for file in (*images, *images.values(), *given.values()) if file is not None]
    for _, target in files:
        check_mask_target(target, inputs=inputs, overwrite=overwrite)
    map_reading: dict[str, Any] = {name: reading[name] for name in reading if name != "label"}
    map_reading |= {"like": like, "logits": logits}
    chances = _load_maps(list(images), map_reading, example_probabilities)
    judge: dict[str, Any] = _try_out(chances, prior, weight, reading, example, record, **options)

    for source, target in files:

        def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
            return refine_map(read_whole(volume), prior, progress=progress, **judge, **tools, **options)

        job = Job(source, target, prior, map_reading, record, overwrite, workers, images[source])
        run_job(job, compute, load_probabilities)


def _load_maps(sources: list[str], reading: dict[str, Any], example: Path | None) -> Field | None:
    """Read all maps, which refuses those that are none, and return the example's."""
    from curvafit.segmentation.evidence import probability_evidence
    from curvafit.segmentation.refine import load_probabilities
    from curvafit.segmentation.slices import check_spacing

    alike = {name: value for name, value in reading.items() if name not in ("crop", "like")}
    chances = None if example is None else load_probabilities(example, **alike)
    for source in sources:
        field = load_probabilities(source, **reading)
        probability_evidence(field)
        if chances is not None:
            check_spacing(chances, field, "the probabilities")
    return chances


def _try_out(
    chances: Field | None,
    prior: str | None,
    weight: float | None,
    reading: dict[str, Any],
    example: Path | None,
    record: dict[str, Any],
    **options: Any,
) -> dict[str, Any]:
    """Return how maps are refined, as options of `refine`; on an example it is tried out, and the record says so."""
    from curvafit.segmentation.refine import calibrate
    from curvafit.volumes.read import load

    if chances is None or example is None:
        return {"weight": weight}
    mask = load(example, **{name: reading[name] for name in ("spacing", "unit", "label", "strict")})
    say_notes((*chances.notes, *mask.notes))
    with show_stages() as progress:
        found = calibrate(chances, mask, prior, progress=progress, **options)
    record["calibration"] = found.as_dict()
    return {"example": found}


def _list_files(source: str, out: Path) -> list[tuple[str, Path]]:
    """Return the maps to read and the masks to write: those of a folder of NPZ files, or one."""
    maps = sorted(Path(source).glob("*.npz")) if Path(source).is_dir() else []
    return [(str(path), out / f"{path.stem}.nii.gz") for path in maps] or [(source, out)]
