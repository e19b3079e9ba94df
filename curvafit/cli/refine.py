"""The command that makes a mask of a network's probabilities: refine."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import plain_errors, say_notes
from curvafit.cli.options import OverwriteOption, Reading, examples, takes_groups
from curvafit.cli.segment import Epsilon, Job, OwnPrior, Steps, TileOption, Weight, WorkersOption, run_job

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.segmentation.refine import Calibration
    from curvafit.segmentation.result import Segmentation
    from curvafit.volumes.boxes import Boxes

EXAMPLES = examples(
    "curvafit refine p.nii.gz --example mask2.nii.gz --example-probabilities p2.nii.gz -o mask.nii.gz",
    "curvafit refine case.npz --channel 1 --prior vessels/fit.json --weight 10 -o mask.nii.gz",
    "curvafit refine predicted --channel 1 --example mask2.nii.gz --example-probabilities p2.npz -o refined",
)

_what = partial(typer.Option, rich_help_panel="What to do")


@takes_groups
def refine(
    probabilities: Annotated[
        str, typer.Argument(help="Probability of the inside: NIfTI, TIFF, NPY, NPZ, Zarr …; or a folder of NPZ files.")
    ],
    out: Annotated[Path, typer.Option("-o", "--output", help="Mask to write: .nii.gz .tif …; for a folder, a folder.")],
    prior: OwnPrior = None,
    example: Annotated[
        Path | None, _what(help="True mask of another volume: law and weight are tried out on it.")
    ] = None,
    example_probabilities: Annotated[
        Path | None, _what(help="The same network's probabilities for the example.")
    ] = None,
    weight: Weight = None,
    epsilon: Epsilon = None,
    *,
    steps: Steps = 400,
    tile: TileOption = None,
    workers: WorkersOption = None,
    like: Annotated[
        Path | None, _what(help="Image of the same voxels; by default one beside an NPZ, of its name.")
    ] = None,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a mask of a network's probabilities, with a curvature prior where it helps; write mask, picture and record.

    Law and weight are those that do best on an example; where p > 1/2 does best, that is the mask. Of nnU-Net's
    NPZ files --channel takes the class; a folder of them becomes a folder of masks. --label is the example's.
    """
    with plain_errors():
        from curvafit.segmentation.refine import calibrate, check_judge, find_image, load_probabilities
        from curvafit.segmentation.refine import refine as refine_map
        from curvafit.segmentation.slices import check_spacing

        if (example is None) != (example_probabilities is None):
            raise ValueError("--example and --example-probabilities go together, got one of them")
        check_judge(example, weight)
        if prior is None and example is None:
            raise ValueError("give --prior or --example: the law, or a mask from which it is inferred")
        files = _list_files(probabilities, out)
        if like is not None and len(files) > 1:
            raise ValueError("--like is for one file; images of a folder lie beside its NPZ files")
        maps = {name: value for name, value in reading.items() if name != "label"}
        others = {name: value for name, value in maps.items() if name != "crop"}
        place = {name: reading[name] for name in ("spacing", "unit", "label", "strict")}
        options = {"epsilon": epsilon, "steps": steps}
        calibrations: list[Calibration] = []

        def calibrate_on_example(volume: Boxes, progress: Progress) -> Calibration:
            from curvafit.core.runtime import sub_progress
            from curvafit.volumes.read import load

            chances, mask = load_probabilities(example_probabilities, **others), load(example, **place)  # type: ignore[arg-type]
            check_spacing(chances, volume.frame, "the probabilities")
            say_notes((*chances.notes, *mask.notes))
            tried = calibrate(chances, mask, prior, progress=sub_progress(progress, 0.0, 0.7), **options)
            record["calibration"] = tried.as_dict()
            return tried

        def compute(volume: Boxes, progress: Progress, **tools: Any) -> Segmentation:
            from curvafit.volumes.boxes import read_whole

            if example is not None and not calibrations:
                calibrations.append(calibrate_on_example(volume, progress))
            judge: dict[str, Any] = {"example": calibrations[0]} if calibrations else {"weight": weight}
            return refine_map(read_whole(volume), prior, progress=progress, **judge, **tools, **options)

        named = {"example": example, "example_probabilities": example_probabilities, "like": like}
        record: dict[str, Any] = {"job": "refine", "weight": weight, "tile": tile, **options}
        record |= {name: None if path is None else str(path) for name, path in named.items()}
        images = {source: like or (find_image(source) if _is_unplaced(reading) else None) for source, _ in files}
        if len(files) > 1:
            _check_all(files, [*images.values(), *named.values()], maps, overwrite)
        for source, target in files:
            job = Job(source, target, prior, {**maps, "like": like}, record, overwrite, workers, images[source])
            run_job(job, compute, load_probabilities)


def _is_unplaced(reading: dict[str, Any]) -> bool:
    """Return whether the options leave the place of the voxels to a file."""
    return reading["spacing"] is None and reading["unit"] is None


def _list_files(source: str, out: Path) -> list[tuple[str, Path]]:
    """Return the maps to read and the masks to write: those of a folder of NPZ files, or one."""
    maps = sorted(Path(source).glob("*.npz")) if Path(source).is_dir() else []
    return [(str(path), out / f"{path.stem}.nii.gz") for path in maps] or [(source, out)]


def _check_all(
    files: list[tuple[str, Path]], more: list[Path | None], reading: dict[str, Any], overwrite: bool
) -> None:
    """Read all maps and check all targets before the first is worked on."""
    from curvafit.segmentation.evidence import probability_evidence
    from curvafit.segmentation.refine import load_probabilities
    from curvafit.segmentation.result import check_mask_target

    inputs = [*(source for source, _ in files), *(path for path in more if path is not None)]
    for source, target in files:
        check_mask_target(target, inputs=inputs, overwrite=overwrite)
        probability_evidence(load_probabilities(source, **reading))
