"""The commands that segment without a neural network: segment and reconstruct."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from curvafit.cli.console import command_line, keep_parts, say, say_notes, show_stages
from curvafit.cli.options import (
    Group,
    Input,
    OverwriteOption,
    Reading,
    Working,
    command,
    parse_threshold,
    parse_whole_numbers,
)

if TYPE_CHECKING:
    from curvafit.segmentation.result import Segmentation
    from curvafit.volumes.volume import Volume

_what = partial(typer.Option, rich_help_panel="What to do")

Target = Annotated[Path, typer.Option("-o", "--output", help="Mask to write: .nii.gz .nii .tif .npy .mrc .zarr.")]


def parse_network(
    probabilities: Annotated[bool, _what("--probabilities", help="The values are a network's probabilities.")] = False,
    logits: Annotated[bool, _what("--logits", help="They are log-odds, before the sigmoid.")] = False,
    example: Annotated[Path | None, _what(help="True mask of another volume, to try law and weight out on it.")] = None,
    example_probabilities: Annotated[Path | None, _what(help="The network's probabilities for the example.")] = None,
    like: Annotated[Path | None, _what(help="Image of the same voxels; by default one of the NPZ's name.")] = None,
) -> dict[str, Any]:
    """Return the options on a network's output, by name; raise ValueError where they do not go together."""
    if (example is None) != (example_probabilities is None):
        raise ValueError("--example and --example-probabilities go together, got one of them")
    kind: bool | str = "logits" if logits else probabilities
    if like is not None and not kind:
        raise ValueError("--like goes with --probabilities")
    return {"kind": kind, "example": example, "example_probabilities": example_probabilities, "like": like}


def parse_known(
    every: Annotated[int | None, _what(help="Distance of known slices; by default those with labels.")] = None,
    first: Annotated[int | None, _what(help="Number of the first known slice, with --every; by default 0.")] = None,
    known: Annotated[str | None, _what(help="Or also: numbers of known slices, 0,7,15.")] = None,
    ignore: Annotated[int | None, _what(help="Or: the label of voxels that nobody annotated.")] = None,
    axis: Annotated[str, _what(help="Axis across the slices: z, y or x (first, second, last axis of an array).")] = "z",
) -> dict[str, Any]:
    """Return which slices are known, as `reconstruct` takes it; raise ValueError where options do not go together."""
    if axis.lower() not in ("z", "y", "x"):
        raise ValueError(f"--axis must be z, y or x, got {axis!r}")
    if every is None and first is not None:
        raise ValueError(f"--first {first} goes with --every")
    slices = None if known is None else list(parse_whole_numbers(known, "--known"))
    rhythm = every if first is None else slice(first, None, every)
    return {"every": rhythm, "known": slices, "ignore": ignore, "axis": "zyx".index(axis.lower())}


def parse_labels(
    labels: Annotated[str | None, _what(help="Several structures: all, or their labels, 1,2,5; writes labels.")] = None,
    instances: Annotated[bool | None, _what(help="Labels are of one kind, such as cells; by default as drawn.")] = None,
) -> dict[str, Any] | None:
    """Return the options of `reconstruct_labels` on labels, and their text; None where one structure is filled."""
    if labels is None:
        if instances is not None:
            raise ValueError("--instances goes with --labels and --image")
        return None
    chosen = None if labels == "all" else list(parse_whole_numbers(labels, "--labels"))
    return {"labels": labels, "chosen": chosen, "instances": instances}


def parse_learning(
    image: Annotated[str | None, _what(help="The grey levels of the volume, on the same voxels.")] = None,
    example: Annotated[Path | None, _what(help="Mask of another such volume, to tune the network.")] = None,
    filler: Annotated[Path | None, _what(help="Weights of `examples/teach.py`, not the packaged ones.")] = None,
) -> dict[str, str | None]:
    """Return the paths of the files that improve the filling, by name."""
    paths = {"image": image, "example": example, "filler": filler}
    return {name: None if path is None else str(path) for name, path in paths.items()}


@command(
    "curvafit segment bone.nii.gz --prior bone/fit.json -o mask.nii.gz",
    "curvafit segment cells.h5 --key raw --dark --prior sponge --spacing 0.2 --unit um -o mask.tif",
    "curvafit segment p.nii.gz --probabilities --example mask2.nii.gz --example-probabilities p2.nii.gz -o mask.nii.gz",
)
def segment(
    scan: Input,
    out: Target,
    prior: Annotated[str | None, _what(help="fit.json or a preset's name; by default the Willmore energy.")] = None,
    weight: Annotated[float | None, _what(help="Nats of a unit of the energy; else 0.3 for a20 + a02 = 2.")] = None,
    threshold: Annotated[str, _what(help="Grey level between the phases, or otsu.")] = "otsu",
    dark: Annotated[bool, _what("--dark", help="The structure is the dark phase.")] = False,
    *,
    network: Annotated[dict[str, Any], Group(parse_network)],
    working: Working,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Find the structure of a noisy scan under a curvature prior; write its mask, a picture and a record.

    With --probabilities a network's output is improved: law and weight are those that do best on an example, or p > 1/2
    is. Of nnU-Net's NPZ files --channel takes the class; a folder of them becomes a folder of masks.
    """
    from curvafit.segmentation.flow import Working as Settings
    from curvafit.segmentation.segmentation import calibrate, check_given
    from curvafit.segmentation.segmentation import segment as segment_scan
    from curvafit.volumes.read import load

    kind, example = network["kind"], network["example"]
    phases: dict[str, Any] = {"threshold": parse_threshold(threshold), "dark": dark}
    check_given(kind, weight, example, **phases, label=reading["label"])
    options: dict[str, Any] = {"weight": weight}
    record = {"job": "segment", **options, **_without(working, "workers")}
    if not kind:
        job = _Job(scan, out, prior, reading, {**record, **phases}, overwrite)
        compute = partial(segment_scan, prior=prior, **options, **phases)
        _run(job, compute, partial(load, scan, **reading, lazy=True), working)
        return
    files = {name: None if path is None else str(path) for name, path in _without(network, "kind").items()}
    record |= {"probabilities": kind, **files}
    jobs, read, probabilities = _list_jobs(_Job(scan, out, prior, reading, record, overwrite), files)
    if probabilities is not None:
        mask = load(example, **{name: reading[name] for name in ("spacing", "unit", "label", "strict")})
        say_notes((*probabilities.notes, *mask.notes))
        with show_stages() as progress:
            calibration = calibrate(probabilities, mask, prior, working=Settings(**working), progress=progress)
        options["example"] = calibration
        jobs = [replace(job, record={**job.record, "calibration": calibration.as_dict()}) for job in jobs]
    for job in jobs:
        compute = partial(segment_scan, prior=prior, probabilities=True, **options)
        _run(job, compute, partial(read, job.source), working)


def _without(options: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in options.items() if key != name}


def _list_jobs(job: _Job, files: dict[str, str | None]) -> tuple[list[_Job], Callable[..., Volume], Volume | None]:
    """Return a job for each probability map, of which a folder of NPZ files has several, a function to read one, and
    the example's map.

    Every map is read once here, so that a bad one is refused before the first job, which may take minutes.
    """
    from curvafit.segmentation.evidence import find_image, load_probabilities, probability_evidence
    from curvafit.segmentation.slices import check_spacing

    like, reading = files["like"], job.reading
    maps = sorted(Path(job.source).glob("*.npz")) if Path(job.source).is_dir() else []
    targets = {str(path): job.out / f"{path.stem}.nii.gz" for path in maps} or {job.source: job.out}
    if like is not None and len(targets) > 1:
        raise ValueError("--like is for one file; images of a folder lie beside its NPZ files")
    has_spacing = reading["spacing"] is not None or reading["unit"] is not None
    images = {path: like or (None if has_spacing else find_image(path)) for path in targets}
    inputs = [path for path in (*targets, *images.values(), *files.values()) if path is not None]
    jobs = [replace(job, source=path, out=out, inputs=inputs, image=images[path]) for path, out in targets.items()]
    for map_job in jobs:
        map_job.check()
    logits = job.record["probabilities"] == "logits"
    read = partial(load_probabilities, **_without(reading, "label"), like=like, logits=logits)
    example_file = files["example_probabilities"]
    example = None if example_file is None else read(example_file, like=None, crop=None)
    for map_job in jobs:
        probabilities = read(map_job.source)
        probability_evidence(probabilities)  # raises an error where values are not probabilities
        if example is not None:
            check_spacing(example, probabilities, "the probabilities")
    return jobs, read, example


@command(
    "curvafit reconstruct labels.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.nii.gz --every 8 --image scan.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.nii.gz --every 8 --example whole.nii.gz -o volume.nii.gz",
    "curvafit reconstruct labels.tif --known 0,7,15 --axis x --suggest 3 -o volume.tif",
    "curvafit reconstruct organelles.nii.gz --every 8 --labels all -o volume.nii.gz",
)
def reconstruct(
    slices: Input,
    out: Target,
    prior: Annotated[str | None, _what(help="A law as in segment, to be tried; by default none.")] = None,
    *,
    which: Annotated[dict[str, Any], Group(parse_known)],
    several: Annotated[dict[str, Any] | None, Group(parse_labels)],
    learning: Annotated[dict[str, Any], Group(parse_learning)],
    stiffness: Annotated[float | None, _what(help="Stiffness of springs on the known slices: try nothing out.")] = None,
    suggest: Annotated[int, _what(help="Number of slices to suggest for annotation next.", min=0)] = 0,
    working: Working,
    reading: Reading,
    overwrite: OverwriteOption = False,
) -> None:
    """Fill a mask between known slices; write it, the probability of each voxel, a picture and a record."""
    from curvafit.volumes.read import load

    if several is not None and reading["label"] is not None:
        raise ValueError("--labels is for several structures; --label is for one")
    if several is not None and several["instances"] is not None and learning["image"] is None:
        raise ValueError("--instances goes with --labels and --image")
    filler, every = learning["filler"], which["every"]
    volume_files = _without(learning, "filler")
    record: dict[str, Any] = {"job": "reconstruct", "suggest": suggest, **which, **volume_files}
    record |= {"filler": filler, "stiffness": stiffness, **_without(working, "workers")}
    # JSON has no slices: their step and start are recorded.
    record |= {"every": every.step, "first": every.start} if isinstance(every, slice) else {"first": 0}
    record |= {} if several is None else _without(several, "chosen")
    inputs = [path for path in learning.values() if path is not None]

    def compute(volume: Volume, **options: Any) -> Segmentation:
        from curvafit.segmentation.labels import reconstruct_labels
        from curvafit.segmentation.reconstruction import reconstruct as fill

        # The options of reading that hold for each file as they do for the slices.
        shared = {"example": ("spacing", "unit", "label", "strict"), "image": ("spacing", "unit", "crop")}
        for name, path in volume_files.items():
            if path is not None:
                options[name] = load(path, **{option: reading[option] for option in shared[name]})
                say_notes(options[name].notes)
        options |= {**which, "suggest": suggest}
        if several is not None:
            return reconstruct_labels(volume.load(), prior, **_without(several, "labels"), **options)
        return fill(volume, prior, **options)

    job = _Job(slices, out, prior, reading, record, overwrite, inputs, probability=True)
    working |= {"filler": filler, "stiffness": stiffness}
    _run(job, compute, partial(load, slices, **reading, lazy=True), working)


@dataclass(frozen=True)
class _Job:
    """A volume to read, a mask to write, and a record of the command's options."""

    source: str
    out: Path
    prior: str | None
    reading: dict[str, Any]
    record: dict[str, Any]
    overwrite: bool
    inputs: Sequence[str | Path] = ()  # other files that are read
    probability: bool = False  # whether it goes beside the mask
    image: Path | None = None  # the file whose header the mask gets; by default the source

    def check(self, frame: Volume | None = None) -> None:
        """Raise ValueError where the mask cannot be written, or the prior is none."""
        from curvafit.priors.law import Law, preset_name
        from curvafit.segmentation.result import check_mask_target

        law = [] if self.prior is None or preset_name(self.prior) else [self.prior]
        check_mask_target(
            self.out, frame, [self.source, *law, *self.inputs], self.overwrite, probability=self.probability
        )
        if self.prior is not None:
            Law.of(self.prior)


def _run(job: _Job, compute: Callable[..., Segmentation], read: Callable[[], Volume], working: dict[str, Any]) -> None:
    """Compute a volume's mask and write it; finished tiles are kept until then."""
    from curvafit.segmentation.flow import Working
    from curvafit.segmentation.result import hidden_store, write_mask
    from curvafit.volumes.write import check_labels, note_lost

    reading = job.reading
    job.check()
    with show_stages() as progress:
        progress("reading", 0.0)
        volume = read()
        job.check(volume)  # again: only now is the unit known, which the output's format may not hold
        if job.record.get("labels"):
            volume = volume.load()
            check_labels(job.out, volume)
        lost = note_lost(job.out, volume)  # what the output's format does not hold
        say_notes(lost)
        with keep_parts(store := hidden_store(job.out)):
            result = compute(volume, progress=progress, working=Working(**working, store=store))
            progress("writing", 1.0)
            # The mask gets the source's header unless an option of reading makes that wrong for its voxels.
            changing = ("spacing", "crop") if job.image else ("spacing", "crop", "channel", "time")
            like = (job.image or job.source) if all(reading[name] is None for name in changing) else None
            record = {"command": command_line(), "prior": job.prior, **job.record}
            record |= {"not_held": lost} if lost else {}
            settings = {"like": like, "unit": reading["unit"], "overwrite": job.overwrite}
            paths = write_mask(result, volume, job.out, record=record, **settings)
    for note in result.notes:
        say(note)
    say(f"{result.status[0].upper()}{result.status[1:]}.", style="bold")
    for path in paths:
        say(str(path))
