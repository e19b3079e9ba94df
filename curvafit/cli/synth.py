"""The command that makes training sets."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli import forecast
from curvafit.cli.atlas import DashboardOption, SchedulerOption, WorkersOption
from curvafit.cli.forecast import cores, say_forecast
from curvafit.cli.reading import reading_of
from curvafit.cli.support import error_console, kept, numbers, plainly, say, say_notes, stages, whole_triple

if TYPE_CHECKING:
    import numpy as np

    from curvafit.data_synth.imaging.modality import Modality
    from curvafit.data_synth.sets.sets import Order
    from curvafit.data_synth.sets.sources import Source

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
Calibres = Annotated[
    str,
    _seen(
        help="LOW,HIGH: structures thinner and thicker than --voxel makes them, case by case, by factors in between."
    ),
]
Filled = Annotated[
    float | None,
    _what("--volume-fraction", help="Share of the volume that grown shapes fill. By default the scan's, with --prior."),
]
Kind = Annotated[str | None, _seen("--modality", help="confocal, two-photon, light-sheet, micro-ct, mra, em-membrane.")]
Like = Annotated[str | None, _seen(help="A scan to take noise, blur, contrast and spacing from, instead.")]
Voxel = Annotated[
    float | None, _seen(help="Edge of a shape's voxel, in --unit: how thick the structure is. By default the prior's.")
]
Like_mask = Annotated[str | None, _seen(help="Mask of --like's structure, where there is one: nearer estimates.")]
Visible = Annotated[
    str | None,
    _seen(
        help="Masks of what an image shows, as annotators draw: where this share of the structure's light arrives; "
        "auto: midway in the logarithm of the levels. By default masks hold the structure itself."
    ),
]
Spacing = Annotated[str | None, _seen(help="Voxel edges of --like, if its file does not tell: Z,Y,X or one number.")]
Unit = Annotated[str | None, _seen(help="nm, um, mm or m; of --spacing and --voxel.")]
Channel = Annotated[int | None, _seen(help="Which channel of --like, counted from 0, where its file has several.")]
Label = Annotated[int | None, _seen(help="The structure is where --like-mask has this value.")]
Crop = Annotated[str | None, _seen(help="Box of voxels of --like and --like-mask: z0:z1,y0:y1,x0:x1; : is all.")]
Strict = Annotated[bool, _seen("--strict", help="Refuse a scan for --like of which chunks or slices are missing.")]


def synth(
    out: Target,
    count: Count = 200,
    shape: Shape = "96",
    prior: Prior = None,
    atlas: Atlas = None,
    presets: Presets = None,
    volume_fraction: Filled = None,
    modality: Kind = None,
    like: Like = None,
    like_mask: Like_mask = None,
    visible: Visible = None,
    voxel: Voxel = None,
    calibres: Calibres = "1,1",
    spacing: Spacing = None,
    unit: Unit = None,
    channel: Channel = None,
    label: Label = None,
    crop: Crop = None,
    strict: Strict = False,
    layout: Layout = "nnunet",
    labels: Parts = None,
    seed: Seed = 0,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    dashboard: DashboardOption = None,
) -> None:
    """Make a training set: images of generated shapes with exact labels."""
    with plainly():
        from curvafit.data_synth.atlas.workers import check_workers

        box = whole_triple(shape, "--shape")
        if count < 1:
            raise ValueError(f"expected --count of at least 1, got {count}")
        check_workers(workers, scheduler)
        if unit is not None and spacing is None and voxel is None:
            raise ValueError("expected --unit beside --spacing or --voxel, got neither")
        source, edge, edge_unit = _source(prior, atlas, presets, volume_fraction)
        reading = reading_of(spacing=spacing, unit=unit, crop=crop, channel=channel, label=label, strict=strict)
        seen = _modality(modality, like, like_mask, visible, reading)
        from curvafit.data_synth.sets.case import Recipe
        from curvafit.data_synth.sets.sets import Order

        told, its = (edge, edge_unit) if voxel is None else (voxel, unit)
        low, high = numbers(calibres, "--calibres", 2)
        recipe = Recipe(source, seen, box, _edge(told, its, seen), seed, (low, high))
        _build(
            out,
            Order(recipe, layout, tuple(labels.split(",")) if labels else ()),
            count,
            (workers, scheduler, dashboard),
        )


def _build(out: Path, order: Order, count: int, how: tuple[int | None, str | None, int | None]) -> None:
    from curvafit.data_synth.atlas.workers import cluster
    from curvafit.data_synth.sets.picture import write_preview
    from curvafit.data_synth.sets.sets import MOST, build_set, cases_of
    from curvafit.files import check_folder
    from curvafit.generation.memory import FLOW, check_memory
    from curvafit.generation.schedule import schedule
    from curvafit.priors.bounds import whole

    whole(count, "a count of at least 1 case", 1, MOST)
    check_folder(out)
    _, scheduler, _ = how
    if scheduler is None and order.recipe.source.within == math.inf:
        check_memory(order.recipe.largest, FLOW, "a shape")
        steps = (count - len(cases_of(out))) * schedule("fast").steps
        size, share = order.recipe.largest, cores(how[0])
        say_forecast("synth", size, steps, forecast.FLOW, what="voxels a shape", workers=share)
    with kept(), stages() as progress:
        progress("starting workers", 0.0)
        with cluster(*how) as crew:
            build_set(out, order, count, lambda n, of: progress(f"{n} of {of} cases", n / of), workers=crew)
    preview = write_preview(out)
    if (held := len(cases_of(out))) > count:
        say(f"note: {out} holds {held} cases, more than --count {count}: all are listed", to=error_console())
    say(str(out / "dataset.json"))
    say(str(preview))


def _source(
    prior: Path | None, atlas: Path | None, presets: str | None, filled: float | None
) -> tuple[Source, float | None, str | None]:
    """Where shapes come from, and the edge and unit of their voxels where that is known."""
    given = [value for value in (prior, atlas, presets) if value is not None]
    if len(given) != 1:
        raise ValueError(f"expected one of --prior, --atlas and --presets, got {len(given)} of them")
    from curvafit.data_synth.sets.sources import Generated, Stored

    if presets is not None:
        from curvafit.priors.coefficients import preset

        names = tuple(presets.split(","))
        found = [preset(name) for name in names]
        points = tuple((*map(float, each.coefficients), each.mass) for each in found)  # type: ignore[arg-type]
        return Generated(points, names, fraction=filled), None, None
    if prior is not None:
        from curvafit.priors import read_fit

        fit = read_fit(prior)
        point = (*map(float, fit.coefficients), fit.mass)  # type: ignore[arg-type]
        filled = fit.volume_fraction if filled is None else filled
        return Generated((point,), (prior.name,), fraction=filled), fit.working_voxel, fit.unit
    assert atlas is not None
    if atlas.suffix.lower() != ".npz":
        if filled is not None:
            raise ValueError("expected --volume-fraction beside shapes that are grown, got a store of shapes")
        return Stored((atlas.resolve(),)), None, None
    from curvafit.inference.atlas import load_atlas

    held = load_atlas(atlas)
    points = tuple((*map(float, row), float(mass)) for row, mass in zip(held.coefficients, held.masses, strict=True))
    return Generated(points, held.ids, fraction=filled), None, None


def _modality(
    name: str | None, like: str | None, mask: str | None, visible: str | None, reading: dict[str, Any]
) -> Modality:
    """The named kind of image, or one like a scan; with the share of light that its masks ask for."""
    if (name is None) == (like is None):
        raise ValueError(f"expected either --modality or --like, got {'neither' if name is None else 'both'}")
    if like is None:
        lone = [key for key, value in reading.items() if value is not None and value is not False and key != "unit"]
        if lone or mask is not None:
            raise ValueError(f"expected --like beside {f'--{lone[0]}' if lone else '--like-mask'}, got none")
        return _visible(_named(str(name)), visible)
    from curvafit.data_synth.imaging import estimate
    from curvafit.volumes.scan import load

    if reading["label"] is not None and mask is None:
        raise ValueError("expected --like-mask beside --label, which is a value of that mask, got none")
    scan = load(like, **{**reading, "label": None})
    say_notes(scan.notes)
    found = estimate.like(scan, None if mask is None else _mask(load(mask, **{**reading, "channel": None}).values))
    return _visible(found, visible)


def _mask(values: np.ndarray) -> np.ndarray:
    import numpy as np

    kinds = len(np.unique(values))
    if kinds != 2:
        raise ValueError(f"expected a mask of two values beside --like-mask, got {kinds} values")
    return values > values.min()


def _named(name: str) -> Modality:
    from curvafit.data_synth.imaging.modalities import MODALITIES

    plain = {key.casefold().replace(" ", "-"): key for key in MODALITIES}
    found = plain.get(name.strip().casefold().replace(" ", "-"))
    if found is None:
        raise ValueError(f"expected --modality among {', '.join(plain)}, got {name!r}")
    return MODALITIES[found]


def _visible(seen: Modality, told: str | None) -> Modality:
    if told is None:
        return seen
    from curvafit.data_synth.imaging.modality import visible_share

    share = visible_share(seen.base) if told == "auto" else numbers(told, "--visible", 1)[0]
    return replace(seen, base=replace(seen.base, visible=share))


def _edge(edge: float | None, unit: str | None, seen: Modality) -> float:
    """The edge of a shape's voxel in the images' unit."""
    from curvafit.volumes.formats.base import convert_length

    return seen.voxel if edge is None else convert_length(edge, unit, seen.base.unit)
