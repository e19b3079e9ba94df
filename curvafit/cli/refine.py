"""The command that makes a mask of a network's probabilities: refine."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import say_notes, show_stages
from curvafit.cli.options import OverwriteOption, Reading, command, parse_whole_numbers
from curvafit.cli.segment import Epsilon, Job, OwnPrior, Steps, TileOption, Weight, WorkersOption, run_job

if TYPE_CHECKING:
    from curvafit.core.runtime import Progress
    from curvafit.segmentation.result import Segmentation
    from curvafit.volumes.boxes import Boxes
    from curvafit.volumes.field import Field

_what = partial(typer.Option, rich_help_panel="What to do")


@command(
    "curvafit refine p.nii.gz --repair -o mask.nii.gz",
    "curvafit refine p.nii.gz --repair --example mask2.nii.gz --example-probabilities p2.nii.gz -o mask.nii.gz",
    "curvafit refine case.npz --repair --classes 1,2,5 -o labels.nii.gz",
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
    repair: Annotated[
        bool, _what("--repair", help="A network repairs the mask, in place of a law; an example tunes it.")
    ] = False,
    repairer: Annotated[
        Path | None, _what(help="Weights of `curvafit atlas teach --repair`; by default the packaged ones.")
    ] = None,
    classes: Annotated[str | None, _what(help="With --repair: several channels, 1,2,5, which become labels.")] = None,
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

    --repair closes breaks, opens false bridges, fills holes and drops specks, by a network that generated shapes have
    taught. Or a curvature prior smooths: law and weight are those that do best on an example. Where p > 1/2 does best
    there, that is the mask. Of nnU-Net's NPZ files --channel takes the class; a folder of them becomes a folder of
    masks. --label is the example's.
    """
    from curvafit.segmentation.refine import find_image, load_probabilities, repair_classes
    from curvafit.segmentation.refine import refine as refine_map
    from curvafit.segmentation.result import check_mask_target
    from curvafit.volumes.boxes import read_whole

    given = {"repairer": repairer, "example": example, "example_probabilities": example_probabilities, "like": like}
    numbers = list(parse_whole_numbers(classes, "--classes")) if classes else None
    _check_choice(prior, repair, weight, numbers, reading["channel"], given)
    if repair and (epsilon, tile, workers, steps) != (None, None, None, 400):
        raise ValueError("--epsilon, --steps, --tile and --workers go with a law, not with --repair")
    files = _list_files(probabilities, out)
    if like is not None and len(files) > 1:
        raise ValueError("--like is for one file; images of a folder lie beside its NPZ files")
    options: dict[str, Any] = {"epsilon": epsilon, "steps": steps}
    record: dict[str, Any] = {"job": "refine", "repair": repair, "classes": classes, "weight": weight, "tile": tile}
    record |= options | {name: None if path is None else str(path) for name, path in given.items()}
    has_place = reading["spacing"] is not None or reading["unit"] is not None
    images = {source: like or (None if has_place else find_image(source)) for source, _ in files}

    # Everything is read and checked before the first work, which may take minutes.
    inputs = [file for file in (*images, *images.values(), *given.values()) if file is not None]
    for _, target in files:
        check_mask_target(target, inputs=inputs, overwrite=overwrite, maps=["probability"] if repair else [])
    map_reading: dict[str, Any] = {name: reading[name] for name in reading if name != "label"}
    map_reading |= {"like": like, "logits": logits}
    chances = _load_maps(list(images), numbers, map_reading, example_probabilities)
    judge: dict[str, Any] = _try_out(chances, prior, repair, weight, reading, given, record, **options)

    for source, target in files:

        def compute(volume: Boxes, progress: Progress, source: str = source, **tools: Any) -> Segmentation:
            if numbers:
                alike = {name: value for name, value in map_reading.items() if name != "channel"}
                return repair_classes(source, numbers, repairer=judge["repair"], progress=progress, **alike)
            return refine_map(read_whole(volume), prior, progress=progress, **judge, **tools, **options)

        place = map_reading | ({"channel": numbers[0]} if numbers else {})
        job = Job(source, target, prior, place, record, overwrite, workers, images[source])
        run_job(job, compute, load_probabilities)


def _check_choice(
    prior: str | None,
    repair: bool,
    weight: float | None,
    classes: list[int] | None,
    channel: int | None,
    given: dict[str, Path | None],
) -> None:
    """Refuse options that do not go together."""
    from curvafit.segmentation.refine import check_judge

    example = given["example"]
    if (example is None) != (given["example_probabilities"] is None):
        raise ValueError("--example and --example-probabilities go together, got one of them")
    if not repair and (classes or given["repairer"] is not None):
        raise ValueError("--classes and --repairer go with --repair")
    if classes and (example is not None or channel is not None):
        raise ValueError("--classes goes with neither --example nor --channel")
    check_judge(example, weight, repair, prior)
    if prior is None and example is None and not repair:
        raise ValueError("give --repair, or --prior or --example: the law, or a mask from which it is inferred")


def _load_maps(
    sources: list[str], classes: list[int] | None, reading: dict[str, Any], example: Path | None
) -> Field | None:
    """Read all maps, which refuses those that are none, and return the example's."""
    from curvafit.segmentation.evidence import probability_evidence
    from curvafit.segmentation.refine import load_probabilities
    from curvafit.segmentation.slices import check_spacing

    alike = {name: value for name, value in reading.items() if name not in ("crop", "like")}
    chances = None if example is None else load_probabilities(example, **alike)
    for source in sources:
        for number in classes or [reading["channel"]]:
            field = load_probabilities(source, **{**reading, "channel": number})
            probability_evidence(field)
            if chances is not None:
                check_spacing(chances, field, "the probabilities")
    return chances


def _try_out(
    chances: Field | None,
    prior: str | None,
    repair: bool,
    weight: float | None,
    reading: dict[str, Any],
    given: dict[str, Path | None],
    record: dict[str, Any],
    **options: Any,
) -> dict[str, Any]:
    """Return how maps are refined, as options of `refine`; on an example it is tried out, and the record says so."""
    from curvafit.segmentation.refine import calibrate, tune_repairer
    from curvafit.segmentation.repair import Repairer
    from curvafit.volumes.read import load

    repairer = Repairer.load(given["repairer"]) if repair else None
    if chances is None:
        return {"weight": weight} if repairer is None else {"repair": repairer}
    mask = load(given["example"], **{name: reading[name] for name in ("spacing", "unit", "label", "strict")})  # type: ignore[arg-type]
    say_notes((*chances.notes, *mask.notes))
    with show_stages() as progress:
        if repairer is not None:
            return {"repair": tune_repairer(chances, mask, repairer, progress=progress)}
        found = calibrate(chances, mask, prior, progress=progress, **options)
    record["calibration"] = found.as_dict()
    return {"example": found}


def _list_files(source: str, out: Path) -> list[tuple[str, Path]]:
    """Return the maps to read and the masks to write: those of a folder of NPZ files, or one."""
    maps = sorted(Path(source).glob("*.npz")) if Path(source).is_dir() else []
    return [(str(path), out / f"{path.stem}.nii.gz") for path in maps] or [(source, out)]
