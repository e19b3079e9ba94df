"""The command that makes training sets."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli_atlas import SchedulerOption, WorkersOption
from curvafit.cli_support import kept, plainly, reading_of, say, stages, whole_triple

if TYPE_CHECKING:
    from curvafit.data_synth.modality import Modality
    from curvafit.data_synth.sources import Source

EXAMPLES = "[bold]Examples[/bold]\n\n" + "\n\n".join(
    (
        "curvafit synth -o Dataset101_Tubes --presets tubes,sponge --modality confocal --count 200 --shape 96",
        "curvafit synth -o Dataset102_Bone --prior bone/fit.json --like bone.nii.gz --count 200 --shape 64",
        "curvafit synth -o set --atlas store.zarr --layout monai --labels distance,centreline --shape 48",
    )
)

_what = partial(typer.Option, rich_help_panel="What is shown: one of these")
_seen = partial(typer.Option, rich_help_panel="How it is imaged")
_out = partial(typer.Option, rich_help_panel="What to write")

Target = Annotated[Path, _out("-o", "--output", help="Folder of the set; a set that was begun goes on.")]
Count = Annotated[int, _out(help="Cases to end with.")]
Shape = Annotated[str, _out(help="Voxels of an image: N or Z,Y,X.")]
Layout = Annotated[str, _out(help="nnunet (v2, raw), monai (decathlon's list) or zarr.")]
Parts = Annotated[
    str | None,
    _out("--labels", help="Besides masks: distance, skeleton, instances, kappa1, kappa2, radius, betti, centreline."),
]
Seed = Annotated[int, _out(help="The same seed makes the same voxels.")]
Prior = Annotated[Path | None, _what(help="fit.json of `curvafit infer`.")]
Atlas = Annotated[
    Path | None,
    _what(help="Store of `curvafit atlas build`, cropped; or an atlas (.npz), whose shapes are grown anew."),
]
Presets = Annotated[str | None, _what(help="Published shapes, by name: tubes,sponge. See `curvafit presets`.")]
Kind = Annotated[str | None, _seen("--modality", help="confocal, two-photon, light-sheet, micro-ct, mra, em-membrane.")]
Like = Annotated[str | None, _seen(help="A scan to take noise, blur, contrast and spacing from, instead.")]
Voxel = Annotated[
    float | None, _seen(help="Edge of a shape's voxel, in --unit: how thick the structure is. By default the prior's.")
]
Spacing = Annotated[str | None, _seen(help="Voxel edges of --like, if its file does not tell: Z,Y,X or one number.")]
Unit = Annotated[str | None, _seen(help="nm, um, mm or m; of --spacing and --voxel.")]


def synth(
    out: Target,
    count: Count = 200,
    shape: Shape = "96",
    prior: Prior = None,
    atlas: Atlas = None,
    presets: Presets = None,
    modality: Kind = None,
    like: Like = None,
    voxel: Voxel = None,
    spacing: Spacing = None,
    unit: Unit = None,
    layout: Layout = "nnunet",
    labels: Parts = None,
    seed: Seed = 0,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Make a training set: images of generated shapes with exact labels."""
    with plainly():
        box = whole_triple(shape, "--shape")
        if count < 1:
            raise ValueError(f"expected --count of at least 1, got {count}")
        source, edge, edge_unit = _source(prior, atlas, presets)
        seen = _modality(modality, like, reading_of(spacing, unit, None, None, None))
        from curvafit.data_synth.case import Recipe
        from curvafit.data_synth.sets import Order, build_set
        from curvafit.data_synth.workers import cluster
        from curvafit.set_picture import write_preview
        from curvafit.shape_files import check_folder

        told, its = (edge, edge_unit) if voxel is None else (voxel, unit)
        recipe = Recipe(source, seen, box, _edge(told, its, seen), seed)
        order = Order(recipe, layout, tuple(labels.split(",")) if labels else ())
        check_folder(out)
        with kept(), stages() as progress:
            progress("starting workers", 0.0)
            with cluster(workers, scheduler) as crew:
                build_set(out, order, count, lambda n, of: progress(f"{n} of {of} cases", n / of), workers=crew)
        say(str(out / "dataset.json"))
        say(str(write_preview(out)))


def _source(prior: Path | None, atlas: Path | None, presets: str | None) -> tuple[Source, float | None, str | None]:
    """Where shapes come from, and the edge and unit of their voxels where that is known."""
    given = [value for value in (prior, atlas, presets) if value is not None]
    if len(given) != 1:
        raise ValueError(f"expected one of --prior, --atlas and --presets, got {len(given)} of them")
    from curvafit.data_synth.sources import Generated, Stored

    if presets is not None:
        from curvafit.priors.coefficients import preset

        names = tuple(presets.split(","))
        found = [preset(name) for name in names]
        return Generated(tuple((*map(float, each.coefficients), each.mass) for each in found), names), None, None  # type: ignore[arg-type]
    if prior is not None:
        from curvafit.priors import read_fit

        fit = read_fit(prior)
        point = (*map(float, fit.coefficients), fit.mass)  # type: ignore[arg-type]
        return Generated((point,), (str(prior),)), fit.working_voxel, fit.unit
    assert atlas is not None
    if atlas.suffix.lower() != ".npz":
        return Stored((atlas.resolve(),)), None, None
    from curvafit.index import load_atlas

    held = load_atlas(atlas)
    points = tuple((*map(float, row), float(mass)) for row, mass in zip(held.coefficients, held.masses, strict=True))
    return Generated(points, held.ids), None, None


def _modality(name: str | None, like: str | None, reading: dict[str, Any]) -> Modality:
    """The named kind of image, or one like a scan."""
    if (name is None) == (like is None):
        raise ValueError(f"expected either --modality or --like, got {'neither' if name is None else 'both'}")
    if like is not None:
        from curvafit.data_synth import estimate
        from curvafit.scan import load

        return estimate.like(load(like, **reading))
    if any(value is not None for key, value in reading.items() if key != "unit"):
        raise ValueError("expected --like beside --spacing, got none")
    from curvafit.data_synth.modalities import MODALITIES

    plain = {key.casefold().replace(" ", "-"): key for key in MODALITIES}
    assert name is not None
    found = plain.get(name.strip().casefold().replace(" ", "-"))
    if found is None:
        raise ValueError(f"expected --modality among {', '.join(plain)}, got {name!r}")
    return MODALITIES[found]


def _edge(edge: float | None, unit: str | None, seen: Modality) -> float:
    """The edge of a shape's voxel in the images' unit."""
    from curvafit.formats.base import convert_length

    return seen.voxel if edge is None else convert_length(edge, unit, seen.base.unit)
