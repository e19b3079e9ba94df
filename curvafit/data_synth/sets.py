"""Training sets on disk: cases that are made once, whole or not at all, by any number of workers."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import as_tuple, check_choice, check_int, check_type
from curvafit.core.files import remove, write_content
from curvafit.core.records import Format
from curvafit.core.runtime import Progress, hold_signals, silent
from curvafit.core.units import unit_name
from curvafit.core.workers import Cluster, run_jobs
from curvafit.data_synth.atlas import versions
from curvafit.data_synth.dataset import Case, Recipe
from curvafit.data_synth.labels import NAMES, labels_of
from curvafit.data_synth.store import check_same
from curvafit.drawing.plot import grey_limits, make_figure, section_on, write_picture
from curvafit.geometry.centreline import centreline, write_graphml
from curvafit.geometry.morphology import local_thickness
from curvafit.priors.grid import Grid
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

SET = Format("curvafit set", 4, "a set of curvafit", remedy="begin it anew in another folder")
#: The record of the set, the folder of its cases' records, and the list that readers of its layout look for.
HEADER, RECORDS, LIST = "curvafit.json", "cases", "dataset.json"
#: Labels besides the mask that a set can have.
PARTS = (*(name for name in NAMES if name != "mask"), "centreline")
#: Cases in the picture, and in a row of it.
SHOWN, ROW = 8, 4


class Layout(NamedTuple):
    """Paths in a set, with `{case}` for a case's name and `{part}` for a further label's; and whether the list is
    nnU-Net's or the decathlon's."""

    image: str
    label: str
    part: str
    nnunet: bool = False


#: nnU-Net v2's raw data sets; the Medical Segmentation Decathlon's, which MONAI reads; OME-Zarr with that list.
LAYOUTS: dict[str, Layout] = {
    "nnunet": Layout(
        "imagesTr/{case}_0000.nii.gz", "labelsTr/{case}.nii.gz", "parts/{part}/{case}.nii.gz", nnunet=True
    ),
    "monai": Layout("imagesTr/{case}.nii.gz", "labelsTr/{case}.nii.gz", "parts/{part}/{case}.nii.gz"),
    "zarr": Layout("images/{case}.zarr", "labels/{case}.zarr", "parts/{part}/{case}.zarr"),
}


@dataclass(frozen=True)
class SetSpec:
    """The specification of a set: recipe, layout (in `LAYOUTS`) and labels besides the mask (`parts`, in `PARTS`)."""

    recipe: Recipe
    layout: str = "nnunet"
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_type(self.recipe, Recipe, "a Recipe")
        check_choice(self.layout, LAYOUTS, f"a layout among {', '.join(LAYOUTS)}")
        object.__setattr__(self, "parts", as_tuple(self.parts, "labels"))
        for part in self.parts:
            check_choice(part, PARTS, f"labels among {', '.join(PARTS)}")
        if self.parts and min(self.recipe.shape) < 4:
            edges = " x ".join(map(str, self.recipe.shape))
            raise ValueError(f"labels need images of at least 4 voxels along each axis, got {edges}")

    def as_dict(self) -> dict[str, Any]:
        return {"recipe": self.recipe.as_dict(), "layout": self.layout, "parts": list(self.parts)}

    @staticmethod
    def from_dict(content: Any) -> SetSpec:
        return SetSpec(**content | {"recipe": Recipe.from_dict(content["recipe"])})


def build_set(
    folder: str | Path,
    spec: SetSpec,
    count: int,
    progress: Progress = silent,
    *,
    workers: Cluster | None = None,
    command: str = "",
) -> Path:
    """Make those of cases 0 to `count` - 1 of a set that are missing, and the list that readers of its layout look for.

    The folder is new, empty, or a set of the same specification to go on with. Case i depends on the specification and
    i alone. The folder holds a valid set at any time; the list may lack cases after a killed run, and the next run
    completes it. `command` is the command line, for the set's record.

    Raises ValueError where the folder holds something else or a set of another spec; OSError where it can't be written
    or the workers are gone. Finished cases are kept.
    """
    check_int(count, "a count of at least 1 case", 1, 10**7)
    folder = Path(folder)
    check_set(folder, spec)
    if not (folder / HEADER).exists():
        first = spec.recipe.case(0)  # where none can be made, nothing is written
        SET.write(folder / HEADER, {"command": command, "versions": versions(), "order": spec.as_dict()})
        check_set(folder, spec)  # another process may have begun it meanwhile
        _write_case(folder, spec, 0, first)
    cases, listed = set(list_cases(folder)), -math.inf
    missing = (index for index in range(count) if index not in cases)
    try:
        for case in run_jobs(partial(make_case, folder.resolve()), missing, workers):
            cases.add(case)
            progress(f"{min(len(cases), count)} of {count} cases", min(len(cases), count) / count)
            if time.monotonic() > listed + 1:
                _write_list(folder, spec)
                listed = time.monotonic()
        return folder
    finally:
        _write_list(folder, spec)


def make_case(folder: Path, index: int) -> int:
    """Make a case of a set, a worker's part of `build_set`, and return its index; one that fails leaves no file."""
    spec = read_spec(folder)
    try:
        _write_case(folder, spec, index, spec.recipe.case(index))
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or str(folder)) from error
    return index


def read_spec(folder: str | Path) -> SetSpec:
    """Return the specification that a set was begun with, or raise ValueError."""
    try:
        return SET.read(Path(folder) / HEADER, lambda header, _: SetSpec.from_dict(header["order"]))
    except FileNotFoundError as error:
        raise ValueError(f"{folder} is not a set of curvafit: it has no {HEADER}") from error


def list_cases(folder: Path) -> list[int]:
    """Return the indices of the complete cases: those with a record, which is written last."""
    names = (path.stem.removeprefix("case_") for path in (folder / RECORDS).glob("case_*.json"))
    return sorted(int(name) for name in names if name.isdigit())


def case_name(index: int) -> str:
    """Return the name of a case in files."""
    return f"case_{index:05d}"


def check_set(folder: Path, spec: SetSpec) -> None:
    """Raise ValueError unless a folder is new, empty, or holds a set of this spec."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: name a folder for the set")
    if (folder / HEADER).exists():
        check_same(read_spec(folder).as_dict(), spec.as_dict(), folder)
    elif folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} holds other things than a set: name a new or an empty folder")


def _write_list(folder: Path, spec: SetSpec) -> None:
    names, layout = list(map(case_name, list_cases(folder))), LAYOUTS[spec.layout]
    files = {name: (layout.image.format(case=name), layout.label.format(case=name)) for name in names}
    about = {"name": folder.resolve().name, "description": "synthetic; made by curvafit", "numTraining": len(names)}
    channels = {"0": spec.recipe.modality.name}
    if layout.nnunet:  # cases by name, since the folders may hold a killed run's temporary files too
        labels = {"background": 0, "structure": 1}
        cases = {name: {"images": [image], "label": label} for name, (image, label) in files.items()}
        content = {"channel_names": channels, "labels": labels, "file_ending": ".nii.gz", **about, "dataset": cases}
    else:
        pairs = [{"image": image, "label": label} for image, label in files.values()]
        labels = {"0": "background", "1": "structure"}
        content = {**about, "tensorImageSize": "3D", "modality": channels, "labels": labels}
        content |= {"numTest": 0, "training": pairs, "test": []}
    write_content(folder / LIST, json.dumps(content, indent=2) + "\n")


def _write_case(folder: Path, spec: SetSpec, index: int, case: Case) -> None:
    """Write labels and image of a case, then its record, which completes it; a case that fails leaves no file."""
    layout, name = LAYOUTS[spec.layout], case_name(index)
    record = folder / RECORDS / f"{name}.json"
    if record.exists():
        return
    labels = _measure_labels(case, spec.parts) if spec.parts else {}
    graph = labels.pop("centreline", None)
    betti = {"betti": labels.pop("betti")} if "betti" in labels else {}
    graph_path = layout.part.partition("{case}")[0].format(part="centreline") + f"{name}.graphml"
    volumes = {layout.part.format(part=part, case=name): values for part, values in labels.items()}
    volumes |= {layout.label.format(case=name): case.labels, layout.image.format(case=name): case.image}
    try:
        if graph is not None:
            write_graphml(graph, folder / graph_path, case.unit)
        for path, values in volumes.items():
            save(Volume(values, case.spacing, case.unit), folder / path)
        arrays = {"image": case.image, "label": case.labels}
        checksums = {part: hashlib.sha256(array.tobytes()).hexdigest() for part, array in arrays.items()}
        content = case.record | betti | {"sha256": checksums, "versions": versions()}
        write_content(record, json.dumps(content, indent=2) + "\n")
    except BaseException:
        with hold_signals():
            if not record.exists():  # unless another process has completed the case
                for path in (graph_path, *volumes):
                    remove(folder / path)
        raise


def _measure_labels(case: Case, parts: Sequence[str]) -> dict[str, Any]:
    """Return the labels besides the mask: arrays, Betti numbers, and the centreline as a graph."""
    grid = Grid(case.image.shape, case.spacing, "replicate")  # type: ignore[arg-type]
    needed = set(parts) - {"centreline"} | ({"skeleton", "distance"} if "centreline" in parts else set())
    labels = labels_of(case.field, grid, case.epsilon, needed)
    if "centreline" in parts:
        labels["centreline"] = centreline(labels["skeleton"], labels["distance"], case.spacing)
    return {part: labels[part] for part in parts}


def describe_set(folder: Path, mask: np.ndarray | None = None) -> list[str]:
    """Return notes on a set: how many shapes had not come to rest; and, of its first labels beside a mask (Z, Y, X) on
    voxels of the same edges, how thick the structure is and how much of the volume it fills."""
    spec, names = read_spec(folder), list(map(case_name, list_cases(folder)))
    records = [json.loads((folder / RECORDS / f"{name}.json").read_text("utf-8")) for name in names]
    moving = sum(record["source"].get("status", "").startswith("still moving") for record in records)
    notes = [f"{moving} of {len(names)} shapes had not come to rest"] if moving else []
    if mask is None:
        return notes
    label, base, figures = LAYOUTS[spec.layout].label, spec.recipe.modality.base, []
    for masks in ([load(folder / label.format(case=name)).values > 0 for name in names[:SHOWN]], [mask]):
        thickness = np.concatenate([local_thickness(inside, base.spacing)[inside] for inside in masks]).mean()
        figures += [f"{thickness:.2g}", f"{100 * np.mean([inside.mean() for inside in masks]):.1f} %"]
    thick, share, *yours = figures
    return [*notes, f"labels: {thick} {unit_name(base.unit, 2)} thick, {share} inside; your mask: {', '.join(yours)}"]


def write_preview(folder: Path) -> Path:
    """Write `preview.png` into a set's folder. It shows the first cases, each by the slice with most of the structure,
    without and with the label's outline."""
    layout = LAYOUTS[read_spec(folder).layout]
    names = [case_name(index) for index in list_cases(folder)[:SHOWN]]
    columns, rows = min(ROW, len(names)), -(-len(names) // ROW)
    figure = make_figure(2.4 * columns, 5.0 * rows + 0.3, layout="constrained")
    axes = np.atleast_2d(figure.subplots(2 * rows, columns, squeeze=False))
    for axis in axes.flat:
        axis.set_axis_off()
    for k, name in enumerate(names):
        image, label = (load(folder / template.format(case=name)) for template in (layout.image, layout.label))
        row, column = 2 * (k // ROW), k % ROW
        inside = label.values > 0
        plane = int(np.argmax(inside.sum((1, 2))))
        limits, aspect = grey_limits(image.values), image.spacing[1] / image.spacing[2]
        for axis, outline in ((axes[row, column], None), (axes[row + 1, column], inside[plane])):
            section_on(axis, image.values[plane], outline, limits, aspect)
        axes[row, column].set_title(name, fontsize=8)
    return write_picture(figure, folder / "preview.png")
