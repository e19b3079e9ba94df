"""The rows of the corpus: each command and each public call on a small input."""

import contextlib
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.calling import done
from tests.damage import FORMATS, VALUES
from tests.golden import FOLDER
from tests.golden.frozen import CLOSE, exact, files, rounded, volume

Row = Callable[[Path], dict[str, Any]]
#: Commands, as they are typed in a folder with the inputs.
COMMANDS = {
    "measure-mask": "measure mask.nii.gz -o out.csv", "measure-field": "measure field.nii.gz --periodic -o out.csv",
    "measure-image": "measure scan.tif -o out.csv",
    "measure-dark": "measure scan.tif --dark --threshold 115 -o out.csv",
    "measure-roi": "measure scan.tif --roi halves.nii.gz -o out.csv",
    "measure-labels": "measure cells.tif --labels -o out.csv",
    "measure-tiles": "measure mask.nii.gz --tile 32 -o out.csv",
    "measure-many": "measure control/0.nii.gz treated/0.nii.gz -o out",
    "measure-windows": "measure mask.nii.gz --windows 16 --stride 8 -o out",
    "compare": "compare control treated -o out",
    "compare-number": "compare control/0.nii.gz control/2.nii.gz treated/1.nii.gz --by 0,7,14 -o out",
    "compare-paired": "compare control treated --paired -o out", "infer-fast": "infer mask.nii.gz -o out",
    "infer-match": "infer mask.nii.gz --method match -o out",
    "generate-preset": "generate --preset tubes --shape 20 --steps 30 -o out.nii.gz",
    "generate-law": "generate --coefficients 1,2,6,-40,-40,400 --mass=-0.6 --shape 16,18,20 --steps 30 -o out.tif",
    "generate-maps": "generate --maps maps.npz --steps 30 -o out.npy",
    "generate-mesh": "generate --prior fit.json --shape 20 --steps 40 -o out.stl", "presets": "presets",
    "samples": "samples", "segment": "segment scan.tif --prior tubes --steps 40 -o out.nii.gz",
    "segment-weight": "segment scan.tif --prior tubes --weight 0.02 --steps 40 -o out.nii.gz",
    "segment-probabilities": "segment probabilities.nii.gz --probabilities --prior tubes --weight 0.02 -o out.nii.gz",
    "reconstruct": "reconstruct mask.nii.gz --every 5 -o out.nii.gz",
    "reconstruct-image": "reconstruct mask.nii.gz --every 5 --image scan.tif -o out.nii.gz",
    "reconstruct-labels": "reconstruct cells.tif --every 4 --labels all -o out.tif",
    "reconstruct-cells": "reconstruct cells.tif --every 4 --labels all --image light.tif -o out.tif",
    "synth": "synth -o out --atlas store --modality confocal --shape 8,10,10 --count 2 --workers 0",
    "synth-like": "synth -o out --atlas store --like scan.tif --shape 10 --count 2 --workers 0 --layout monai",
    "atlas-build": "atlas build out --shape 16 --design near.yaml --steps 40 --count 2 --workers 0",
    "atlas-info": "atlas info store", "atlas-verify": "atlas verify store",
    "atlas-extract": "atlas extract store -o out.npz",
}  # fmt: skip
#: Rows that agree less closely. A flow from noise is chaotic: on another processor it grows another shape of the law,
#: of which few numbers are alike. An emulator's optimum is flat along some directions.
CLOSENESS = {
    **dict.fromkeys(("generate-preset", "generate-law", "generate-maps", "generate-mesh", "flows"), 0.25),
    "atlas-build": 1.0,
    **dict.fromkeys(("infer-fast", "infer-match"), 0.05),
}


def run(name: str, folder: Path) -> dict[str, Any]:
    """Return what comes of a row, in a folder that gets the inputs."""
    return ROWS[name](folder)


def closeness(name: str) -> float:
    """Return the relative difference within which a row's numbers agree."""
    return CLOSENESS.get(name, CLOSE)


def _run_command(line: str) -> Row:
    def run_line(folder: Path) -> dict[str, Any]:
        shutil.copytree(FOLDER, folder, dirs_exist_ok=True)
        before = set(folder.rglob("*"))
        with contextlib.chdir(folder):
            result = done(*line.split())
        return files(folder, before) or {"lines": len(result.stdout.splitlines())}

    return run_line


def _volumes(folder: Path) -> dict[str, Any]:
    """Every format that is read, and those that are written, read again: values, type, spacing and unit."""
    import curvafit

    for name, write in FORMATS.items():
        write(folder / name)
    for name in ("out.nii.gz", "out.tif", "out.ome.tif", "out.npy", "out.zarr", "out.mrc"):
        curvafit.save(FOLDER / "mask.nii.gz", folder / name)
    fields = {path.name: curvafit.load(path) for path in sorted(folder.iterdir())}
    VALUES.tofile(folder / "bare.raw")
    fields["bare.raw"] = curvafit.load(folder / "bare.raw", raw_shape=VALUES.shape, dtype="u2", spacing=2.0, unit="um")
    return {name: [exact(field.values), *rounded(field.spacing), field.unit] for name, field in fields.items()}


def _loss(_: Path) -> dict[str, Any]:
    """The training loss and its gradient, by preset and option."""
    from curvafit.priors import CombinedLoss, CurvaturePrior

    field = torch.from_numpy(_field("field.nii.gz").copy())[None, None]
    target, found = (field > 0).long(), {}
    ways: dict[str, dict[str, Any]] = {
        "plain": {}, "thick": {"spacing": (2.0, 1.0, 1.0)}, "sum": {"reduction": "sum", "border": 2},
        "ignored": {"ignore_index": 0},
    }  # fmt: skip
    for law in ("tubes", "sponge", str(FOLDER / "fit.json")):
        for way, options in ways.items():
            logits = (3 * field).requires_grad_()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of an axis that is interpolated
                prior = CurvaturePrior(law, sigmoid=True, **options)
            value = prior(logits, target)
            value.backward()
            found[f"{Path(law).name} {way}"] = rounded([value.item(), float(logits.grad.norm())])
    both = CombinedLoss(lambda a, b: (a - b).square().mean(), CurvaturePrior("tubes", sigmoid=True), 0.5, warmup=2)
    found["combined"] = rounded([float(both(field, target.float()).detach()) for _ in range(3)])
    return found


def _geometry(_: Path) -> dict[str, Any]:
    """Diagrams, their distance, and instances."""
    import curvafit
    from curvafit.priors import Grid

    first, second = (
        torch.from_numpy(_field("field.nii.gz")[axes].copy()) for axes in (slice(None), slice(None, None, -1))
    )
    grid = Grid(tuple(first.shape), 0.01)
    one, two = (curvafit.diagram(u, grid, 0.02) for u in (first, torch.roll(-second, 3, 1)))
    cells = curvafit.measure_instances(FOLDER / "cells.tif")
    return {
        "diagram": rounded([one.weights.sum(), *np.average(one.points, axis=0, weights=one.weights)]),
        "wasserstein": rounded([float(curvafit.wasserstein(one, two))]),
        "instances": rounded([[cell["volume"].value, cell["thickness"].value, cell["H"].value] for cell in cells]),
    }


def _flows(_: Path) -> dict[str, Any]:
    """Two shapes grown, and a field lowered."""
    import curvafit
    from curvafit.generation.schedule import schedule
    from curvafit.priors import Grid

    plan = schedule("fast", steps=30)
    batch = [curvafit.generate("tubes", grid=16, schedule=plan, seed=seed) for seed in (1, 2)]
    field = torch.from_numpy(_field("field.nii.gz").copy())
    lowered = curvafit.descend(field, "tubes", Grid((24, 24, 24)), steps=10)
    return {"batch": [volume((flow.field > 0).numpy()) for flow in (*batch, lowered)]}


def _training(_: Path) -> dict[str, Any]:
    """Samples of a set without end."""
    from curvafit.data_synth import TextureDataset

    pairs = TextureDataset(FOLDER / "store", ["confocal", "micro-ct"], (8, 10, 10), length=4, seed=3)
    samples = [pairs.sample(number) for number in range(3)]
    return {
        "images": [volume(sample.image.numpy()) for sample in samples],
        "labels": [volume(sample.label.numpy()) for sample in samples],
        "spacing": rounded([sample.spacing for sample in samples]),
    }


def _field(name: str) -> np.ndarray:
    import curvafit

    return curvafit.load(FOLDER / name).values


CALLS = {"volumes": _volumes, "loss": _loss, "geometry": _geometry, "flows": _flows, "training": _training}
ROWS: dict[str, Row] = {name: _run_command(line) for name, line in COMMANDS.items()} | CALLS
