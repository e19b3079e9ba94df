"""The command that makes training sets."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, error_console, say, say_notes
from curvafit.cli.options import Group, Reading, Workers, command, parse_numbers, parse_whole_triple

if TYPE_CHECKING:
    from curvafit.data_synth.imaging.modality import Modality

_what = partial(typer.Option, rich_help_panel="Shapes: one of these")
_image = partial(typer.Option, rich_help_panel="Images")
_out = partial(typer.Option, rich_help_panel="Output")

Laws = Annotated[
    str | None, _what("--prior", "--preset", "--presets", help="Presets or fit.json files, several between commas.")
]
Kind = Annotated[
    str | None, _image("--modality", help="confocal, two-photon, light-sheet, micro-ct, mra or em-membrane.")
]
Parts = Annotated[
    str | None,
    _out(help="Labels besides masks: distance, skeleton, instances, kappa1, kappa2, radius, betti, centreline."),
]


def choose_shapes(
    laws: Laws = None,
    atlas: Annotated[Path | None, _what(help="Store of shapes to crop.")] = None,
    volume_fraction: Annotated[float | None, _what(help="Share of the volume inside; by default the fit's.")] = None,
) -> tuple[Any, list[str]]:
    """Return the source of shapes that the options name, and the laws whose fits state the size of a voxel."""
    names = [] if laws is None else laws.split(",")
    if bool(names) == (atlas is not None):
        raise ValueError(f"give either --prior (or --preset) or --atlas, got {'both' if names else 'neither'}")
    from curvafit.data_synth.sources import Generated, Stored

    if atlas is None:
        return Generated.of(names, volume_fraction), names
    if volume_fraction is not None:
        raise ValueError("--volume-fraction is for shapes that are grown, not for those of a store")
    return Stored((atlas.resolve(),)), []


def parse_imaging(
    modality: Kind = None,
    like: Annotated[str | None, _image(help="Scan to take noise, blur and contrast from.")] = None,
    like_mask: Annotated[str | None, _image(help="Mask of the structure in --like, for better estimates.")] = None,
    visible: Annotated[str | None, _image(help="Masks as seen: where this share of light arrives, or auto.")] = None,
) -> dict[str, Any]:
    """Return the options on imaging, by name."""
    return {"name": modality, "like": like, "mask": like_mask, "visible": visible}


@command(
    "curvafit synth -o Dataset101_Tubes --preset tubes,sponge --modality confocal --count 200 --shape 96",
    "curvafit synth -o Dataset102_Bone --prior bone/fit.json --like bone.nii.gz --count 200 --shape 64",
    "curvafit synth -o set --atlas store --modality micro-ct --layout monai --labels distance --shape 48",
)
def synth(
    out: Annotated[Path, _out("-o", "--output", help="Folder of the set; a set that exists is resumed.")],
    count: Annotated[int, _out(help="Number of cases in the set at the end.")] = 200,
    *,
    shapes: Annotated[tuple[Any, list[str]], Group(choose_shapes)],
    imaging: Annotated[dict[str, Any], Group(parse_imaging)],
    shape: Annotated[str, _out(help="Voxels of an image: N or Z,Y,X.")] = "96",
    voxel: Annotated[float | None, _image(help="Edge of a shape's voxel, in --unit; by default the law's.")] = None,
    calibres: Annotated[str, _image(help="LOW,HIGH: a case is thicker by a factor in between.")] = "1,1",
    reading: Reading,
    layout: Annotated[str, _out(help="nnunet (v2, raw), monai (decathlon's list) or zarr.")] = "nnunet",
    labels: Parts = None,
    seed: Annotated[int, _out(help="Seed of shapes and images; the same seed gives the same voxels.")] = 0,
    crew: Workers,
) -> None:
    """Make a training set: images of generated shapes with exact labels."""
    unit = reading["unit"]
    if unit is not None and reading["spacing"] is None:
        if voxel is None:
            raise ValueError("--unit needs --spacing or --voxel")
        reading["unit"] = None  # it is that of --voxel, not of --like
    source, laws = shapes
    modality, mask = _choose_modality(**imaging, reading=reading)
    from curvafit.core.files import check_folder
    from curvafit.core.units import convert_length
    from curvafit.data_synth import sets
    from curvafit.data_synth.dataset import Recipe
    from curvafit.data_synth.sources import choose_voxel

    edge = choose_voxel(laws, modality) if voxel is None else convert_length(voxel, unit, modality.base.unit)
    low, high = parse_numbers(calibres, "--calibres", 2)
    recipe = Recipe(source, modality, parse_whole_triple(shape, "--shape"), edge, seed, (low, high))
    spec = sets.SetSpec(recipe, layout, tuple(labels.split(",")) if labels else ())
    check_folder(out)
    sets.check_set(out, spec)
    if source.edge == math.inf:  # shapes are grown at any size, not cropped from a store
        crew.check_memory(recipe.largest)
    with crew.start(out) as (workers, progress):
        sets.build_set(out, spec, count, progress, workers=workers, command=command_line())
    if (total := len(sets.list_cases(out))) > count:
        say(f"note: {out} holds {total} cases, more than --count {count}: all are listed", to=error_console())
    say_notes(sets.describe_set(out, mask))
    for path in (out / "dataset.json", sets.write_preview(out)):
        say(str(path))


def _choose_modality(
    name: str | None, like: str | None, mask: str | None, visible: str | None, reading: dict[str, Any]
) -> tuple[Modality, Any]:
    """Return the modality of a name, or one fitted to the scan `like`, and that scan's mask if there is one.

    If `visible` is given, masks end where less than this share of the structure's light arrives.
    """
    if (name is None) == (like is None):
        raise ValueError(f"give either --modality or --like, got {'neither' if name is None else 'both'}")
    if like is None:
        for option, value in {**reading, "like_mask": mask}.items():
            if value is not None and value is not False:
                raise ValueError(f"--{option.replace('_', '-')} needs --like")
        from curvafit.data_synth.imaging.modality import modality as named_modality

        modality, inside = named_modality(str(name)), None
    else:
        modality, inside = _fit_to_scan(like, mask, reading)
    if visible is None:
        return modality, inside
    from curvafit.data_synth.imaging.modality import annotator_threshold

    share = annotator_threshold(modality.base) if visible == "auto" else parse_numbers(visible, "--visible", 1)[0]
    return replace(modality, base=replace(modality.base, visible=share)), inside


def _fit_to_scan(like: str, mask: str | None, reading: dict[str, Any]) -> tuple[Modality, Any]:
    """Return a modality fitted to a scan, by a mask of two values if there is one, and the middle of that mask."""
    import numpy as np

    from curvafit.data_synth.imaging.like import crop_middle, fit_modality
    from curvafit.volumes.read import load

    if reading["label"] is not None and mask is None:
        raise ValueError("--label needs --like-mask: it is a value of that mask")
    scan = load(like, **{**reading, "label": None})
    say_notes(scan.notes)
    if mask is None:
        return fit_modality(scan), None
    values = load(mask, **{name: reading[name] for name in ("spacing", "unit", "label", "crop", "strict")}).values
    if (count := len(np.unique(values))) != 2:
        raise ValueError(f"--like-mask must have two values, got {count}: choose one with --label")
    inside = values > values.min()
    return fit_modality(scan, inside), crop_middle(scan, inside)[1]
