"""The commands that make shapes: generate and presets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, error_console, print_table, resumable, say, say_notes, show_stages
from curvafit.cli.options import Group, OverwriteOption, command, parse_numbers, parse_whole_triple

if TYPE_CHECKING:
    from torch import Tensor

    from curvafit.generation.result import Flow
    from curvafit.priors.law import Law
    from curvafit.volumes.volume import Volume

    #: Parameters that vary in space, by name; see `volumes.read_maps`.
    Maps3D = dict[str, float | Tensor]

#: Number of voxels along an edge by default.
EDGE = 100

_what = partial(typer.Option, rich_help_panel="What to make")
_how = partial(typer.Option, rich_help_panel="How")
_out = partial(typer.Option, rich_help_panel="What to write")


def parse_law(
    preset: Annotated[str | None, _what(help="A published shape; see `curvafit presets`.")] = None,
    coefficients: Annotated[str | None, _what(help="a20,a11,a02,a10,a01,a00 in working units; needs a mass.")] = None,
    helfrich: Annotated[str | None, _what(help="Bending energy κ,κ_G,H0, as 2,0,40; needs a mass or start.")] = None,
    prior: Annotated[str | None, _what(help="fit.json of `curvafit infer`, or a preset's name.")] = None,
    start: Annotated[str | None, _what(help="Mask or phase field to begin from, in place of noise.")] = None,
    free_mass: Annotated[bool, _what("--free-mass", help="With --start: let the volume change (L-BFGS).")] = False,
    mass: Annotated[float | None, _what(help="Mean of the field, in (-1, 1); by default the start's or law's.")] = None,
    volume_fraction: Annotated[float | None, _what(help="Share of the volume inside, instead of a mass.")] = None,
    orientation: Annotated[str | None, _what(help="θz,θy,θx,μ: tubes and layers lie along θ if μ is large.")] = None,
    maps: Annotated[Path | None, _what(help="An .npz of volumes a20 … a00, mass, theta_z … theta_x, mu.")] = None,
    epsilon: Annotated[float | None, _what(help="Interface width in working units; by default 0.02.")] = None,
) -> dict[str, Any]:
    """Return the options that determine which shape is grown, by name."""
    if free_mass and start is None:
        raise ValueError("--free-mass needs --start")
    law = {"preset": preset, "coefficients": coefficients, "helfrich": helfrich, "prior": prior, "epsilon": epsilon}
    law |= {"mass": mass, "volume_fraction": volume_fraction, "orientation": orientation, "maps": maps}
    return law | {"start": start, "free_mass": free_mass}


def parse_run(
    schedule: Annotated[
        str | None,
        _how(help="fast (1500 steps), deep (1500, longer; a fit's default), paper (8000) or cosine (1000)."),
    ] = None,
    steps: Annotated[int | None, _how(help="Number of steps, instead of the schedule's.")] = None,
    device: Annotated[str, _how(help="cpu, cuda, cuda:1 …")] = "cpu",
    checkpoint: Annotated[Path | None, _how(help="File to save the run in, and to resume it from.")] = None,
    checkpoint_every: Annotated[float | None, _how(help="Seconds between two checkpoints; 60 by default.")] = None,
) -> dict[str, Any]:
    """Return the options of the run that grows a shape; raise ValueError where options do not go together."""
    if checkpoint is None and checkpoint_every is not None:
        raise ValueError(f"--checkpoint-every {checkpoint_every:g} needs --checkpoint")
    run = {"schedule": schedule, "steps": steps, "device": device, "checkpoint": checkpoint}
    return run if checkpoint_every is None else {**run, "checkpoint_every": checkpoint_every}


def parse_output(
    spacing: Annotated[str | None, _out(help="Edge of a voxel, in --unit; else 1, or the start's or prior's.")] = None,
    unit: Annotated[str | None, _out(help="nm, um, mm or m; needs --spacing.")] = None,
) -> dict[str, Any]:
    """Return voxel edge and unit of the file to write; raise ValueError where options do not go together."""
    if unit is not None and spacing is None:
        raise ValueError("--unit needs --spacing")
    edge = None if spacing is None else parse_numbers(spacing, "--spacing", 1)[0]
    return {"edge": edge, "unit": unit}


@command(
    "curvafit generate --preset tubes -o tubes.nii.gz",
    "curvafit generate --preset tubes --spacing 0.0195 --unit mm -o tubes.stl",
    "curvafit generate --preset sponge --volume-fraction 0.3 --shape 64 -o sponge.zarr",
    "curvafit generate --prior bone/fit.json --shape 128 --seed 3 -o more_bone.tif",
    "curvafit generate --preset tubes --shape 300 --checkpoint run.pt -o large.nii.gz",
    "curvafit generate --helfrich 2,0,40 --start disc.nii.gz -o beads.nii.gz",
)
def generate(
    out: Annotated[
        Path, _out("-o", "--output", help="Volume (.nii.gz .nii .tif .npy .mrc .zarr) or surface (.stl .ply).")
    ],
    what: Annotated[dict[str, Any], Group(parse_law)],
    shape: Annotated[str | None, _what(help=f"Voxels: N or Z,Y,X; else {EDGE}, or the start's or maps'.")] = None,
    boundary: Annotated[str, _what(help="periodic, or replicate (walls, met at right angles).")] = "periodic",
    seed: Annotated[int | None, _what(help="Seed of the noise that the shape grows from; by default 0.")] = None,
    *,
    running: Annotated[dict[str, Any], Group(parse_run)],
    writing: Annotated[dict[str, Any], Group(parse_output)],
    picture: Annotated[bool, _out("--picture/--no-picture", help="Draw a picture (.png), or do not.")] = True,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a shape from parameters, with a record (.json) and a picture (.png) beside it."""
    from curvafit.drawing.shapes import Output, check_target, shape_record
    from curvafit.generation import flow as flows
    from curvafit.generation.schedule import choose_schedule
    from curvafit.generation.schedule import schedule as make_schedule
    from curvafit.priors.grid import Grid
    from curvafit.volumes.read import map_shape, read_maps

    size = None if shape is None else parse_whole_triple(shape, "--shape")
    start = None if what["start"] is None else _read_start(what, running, writing, {"shape": shape, "seed": seed})
    size = size if start is None else start.shape
    maps = {} if what["maps"] is None else read_maps(what["maps"], size)
    law = _read_law(what, maps)
    options = _choose_parameters(law, maps, what) | {"seed": seed or 0}
    options["grid"] = Grid(size or map_shape(maps) or EDGE, boundary=boundary)  # type: ignore[arg-type]
    steps = running.pop("steps")
    options["schedule"] = make_schedule(choose_schedule([law], running.pop("schedule")), steps)
    running["checkpoint"] = checkpoint = _locate_checkpoint(running["checkpoint"], out)
    options["execution"] = flows.Execution(keep_checkpoint=True, **running)
    output = Output(writing["edge"] or law.working_voxel or 1.0, writing["unit"] or law.length_unit or "voxel")
    output = output if start is None else Output(start.spacing[0], start.unit, start.affine)
    law_file = None if not law.fitted else what["prior"] or what["preset"]
    inputs = [str(path) for path in (law_file, what["maps"], what["start"]) if path is not None]
    check_target(out, output, inputs=inputs, picture=picture, overwrite=overwrite)
    notes = () if start is None else _begin_at(start, law, options)
    grow = partial(flows.generate, **options)
    if what["free_mass"]:
        kept = {name: options[name] for name in ("law", "grid", "epsilon", "execution")}
        grow = partial(flows.descend, options["mass"], **kept, **({} if steps is None else {"steps": steps}))
    flow = _grow(grow, checkpoint)
    facts: dict[str, Any] = {name: what[name] and str(what[name]) for name in ("maps", "start")}
    facts |= {"start_digest": start and start.digest, "orientation": options["orientation"], "origin": law.origin}
    facts |= {"wanted_volume_fraction": what["volume_fraction"], "command": command_line()}
    record = shape_record(flow, mass=options["mass"] if start is None else None, output=output, **facts)
    say_notes(notes)
    _write(flow, out, record, output=output, picture=picture, overwrite=overwrite)
    _remove(checkpoint)


@command()
def presets() -> None:
    """List the published shapes: coefficients in working units, mass, source."""
    from curvafit.priors.coefficients import NAMES
    from curvafit.priors.law import PRESETS

    rows = [
        (name, *(f"{value:g}" for value in preset.coefficients.as_dict().values()), f"{preset.mass:g}", preset.source)
        for name, preset in PRESETS.items()
    ]
    print_table(("name", *NAMES, "mass", "source"), rows, right=range(1, 8))


def _read_start(
    what: dict[str, Any], running: dict[str, Any], writing: dict[str, Any], noise: dict[str, Any]
) -> Volume:
    """Return the volume that the flow begins from; raise ValueError for options that it leaves no use for."""
    from curvafit.volumes.read import load

    useless = {**noise, "volume-fraction": what["volume_fraction"]}
    if what["free_mass"]:
        useless |= {"schedule": running["schedule"], **{name: what[name] for name in ("mass", "orientation", "maps")}}
    if names := [name for name, value in useless.items() if value is not None]:
        raise ValueError(f"--{names[0]} has no use with --start{' --free-mass' * what['free_mass']}: leave it out")
    return load(what["start"], spacing=writing["edge"], unit=writing["unit"])


def _read_law(what: dict[str, Any], maps: Maps3D) -> Law:
    """Return the law that one of the options gives, or a placeholder where maps give all six coefficients."""
    from curvafit.priors.coefficients import NAMES, Coefficients
    from curvafit.priors.law import Law

    options = ("preset", "coefficients", "helfrich", "prior")
    laws = {name: what[name] for name in options if what[name] is not None}
    if len(laws) > 1 or (not laws and not set(NAMES) <= maps.keys()):
        raise ValueError(f"give one of --preset, --coefficients, --helfrich and --prior, got {len(laws)} of them")
    if not laws:
        return Law(Coefficients(1, 0, 1), None, "maps")
    ((name, text),) = laws.items()
    if name == "coefficients":
        return Law.of(Coefficients(*parse_numbers(text, "--coefficients", 6)))
    if name == "helfrich":
        return Law.of(Coefficients.helfrich(*parse_numbers(text, "--helfrich", min(text.count(",") + 1, 3))))
    return Law.of(text)


def _choose_parameters(law: Law, maps: Maps3D, what: dict[str, Any]) -> dict[str, Any]:
    """Return law, mass or volume fraction, ε and Q as arguments of `generate`; maps take the place of numbers."""
    import torch

    from curvafit.priors.coefficients import NAMES
    from curvafit.priors.grid import WORKING_EPSILON

    for other in ("mass", "start"):
        if what[other] is not None and "mass" in maps:
            raise ValueError(f"give either --{other} or a map of the mass, got both")
    if "mass" in maps and not bool((torch.as_tensor(maps["mass"]).abs() < 1).all()):
        raise ValueError("the map of the mass must be in (-1, 1)")
    mass, fraction = maps.get("mass", what["mass"]), what["volume_fraction"]
    if mass is not None and fraction is not None:
        raise ValueError("give either a mass or --volume-fraction, got both")
    if mass is None and fraction is None and what["start"] is None:
        mass = law.mass
    coefficients = replace(law.coefficients, **{name: maps[name] for name in NAMES if name in maps})
    ε = WORKING_EPSILON if what["epsilon"] is None else what["epsilon"]
    Q = _choose_orientation(what["orientation"], maps)
    return {"law": coefficients, "mass": mass, "volume_fraction": fraction, "epsilon": ε, "orientation": Q}


def _choose_orientation(text: str | None, maps: Maps3D) -> Tensor | None:
    """Return Q of the option's direction and strength and of maps, which take the place of its numbers, or None."""
    from curvafit.priors.energies import orientation
    from curvafit.volumes.read import ORIENTATION

    parts: Maps3D = {name: maps[name] for name in ORIENTATION if name in maps}
    if text is not None:
        parts = dict(zip(ORIENTATION, parse_numbers(text, "--orientation", 4), strict=True)) | parts
    if not parts:
        return None
    if missing := [name for name in ORIENTATION if name not in parts]:
        raise ValueError(f"an orientation in maps needs {', '.join(missing)} too, or --orientation for numbers")
    *direction, strength = (parts[name] for name in ORIENTATION)
    return orientation(direction, strength)


def _begin_at(start: Volume, law: Law, options: dict[str, Any]) -> tuple[str, ...]:
    """Make the start's field the mass m(x) of a flow without noise, with the mean that is stated; return notes."""
    from curvafit.scan.preparation import make_start

    options["grid"], field, notes = make_start(start, law, options["grid"].boundary, options["epsilon"])
    mass = options["mass"]
    options |= {"mass": field if mass is None else field + (mass - field.mean()), "seed": None}
    return notes


def _locate_checkpoint(file: Path | None, out: Path) -> Path | None:
    """Return the path of the checkpoint, None without one; raise ValueError if it is that of an output."""
    from curvafit.core.records import sibling
    from curvafit.generation.loop import resolve_place

    if file is None:
        return None
    checkpoint = resolve_place(file)
    if checkpoint in [path.resolve() for path in (out, sibling(out, ".json"), sibling(out, ".png"))]:
        raise ValueError(f"the checkpoint {checkpoint} would be written over by an output: choose another name")
    return checkpoint


def _grow(grow: Callable[..., Flow], checkpoint: Path | None) -> Flow:
    """Run the flow with progress; exit with code 1 where it failed or has no surface."""
    with resumable(checkpoint), show_stages() as progress:
        progress("starting (a first run compiles the kernels for this processor)", 0.0)
        flow = grow(callbacks=[lambda step, total, _: progress("growing", step / total)])
    # The surface is the level 0 of the field: without values on both sides there is none.
    if not (flow.finite and flow.viability.lowest < 0 < flow.viability.highest):
        _remove(checkpoint)
        say(f"{flow.status}; nothing was written", to=error_console())
        raise typer.Exit(1)
    return flow


def _remove(checkpoint: Path | None) -> None:
    """Remove the checkpoint, which the flow leaves until the results are written."""
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)


def _write(flow: Flow, out: Path, record: dict[str, Any], **settings: Any) -> None:
    """Write the files, and print the flow's status and the paths."""
    from curvafit.drawing.shapes import write_shape

    files = write_shape(flow, out, record=record, **settings)
    say_notes([] if flow.viability.viable else [flow.status])
    say(f"{flow.status}; {100 * record['volume_fraction']:.2f} % of the volume")
    for path in files:
        say(str(path))
