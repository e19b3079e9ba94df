"""Good inputs, made once: volumes, a fit, a store, an atlas, a checkpoint, a training set."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from .damage import write_truths
from .moments import killing
from .sandbox import commanding, run
from .volumes import write_all

#: A law whose shapes are viable, on few voxels, in few steps.
LAW = ("--coefficients", "1,2,6,-40,-40,400", "--mass=-0.6")
QUICK = (*LAW, "--shape", "16", "--steps", "30")
LONG = (*LAW, "--shape", "16", "--steps", "120", "--checkpoint", "run.pt", "--checkpoint-every", "0")
BUILD = ("atlas", "build", "store.zarr", "--shape", "16", "--around", "tubes", "--spread", "0.05", "--workers", "0")
SYNTH = ("synth", "-o", "set", "--atlas", "{store}", "--modality", "confocal", "--shape", "6,6,6", "--workers", "0")
NAMES = ("a20", "a11", "a02", "a10", "a01", "a00")


def fill(folder: Path) -> None:
    """Make everything in a new folder.

    Raises
    ------
    RuntimeError
        If one of the commands that are needed fails: there is nothing to test then.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_all(folder)
    write_truths(folder)
    _write_scans(folder)
    (folder / "fit.json").write_text(json.dumps(fit(), indent=2))
    (folder / "design.yaml").write_text("around: tubes\nspread: 0.05\n")
    numbers = {name: np.full((8, 8, 8), value, np.float32) for name, value in zip(NAMES, COEFFICIENTS, strict=True)}
    np.savez(folder / "maps.npz", **numbers, mass=np.float32(-0.6))
    _command(folder, *BUILD, "--count", "3")
    _command(folder, "atlas", "extract", "store.zarr", "-o", "atlas.npz")
    _command(folder, *(part.replace("{store}", str(folder / "store.zarr")) for part in SYNTH), "--count", "3")
    _command(folder, "generate", *QUICK, "-o", "shape.nii.gz")
    _command(folder, "generate", *LONG, "-o", "long.npy")
    _write_channels(folder)
    _checkpoint(folder)
    cache = Path(os.environ["CURVAFIT_CACHE"])
    cache.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(folder / "scan.nii.gz", cache / "synthetic.nii.gz")  # the real one takes long to make


COEFFICIENTS = (1.0, 2.0, 6.0, -40.0, -40.0, 400.0)


def fit() -> dict[str, Any]:
    """A `fit.json` as an inference writes it."""
    length = 1.95
    six = dict(zip(NAMES, COEFFICIENTS, strict=True))
    own = {"name": "posterior", "coefficients": six, "mass": -0.6, "uncertainty": dict.fromkeys(NAMES, 0.5)}
    physical = [value / length**power for value, power in zip(COEFFICIENTS, (0, 0, 0, 1, 1, 2), strict=True)]
    return {
        "format": "curvafit-fit-3",
        "kind": "image",
        "family": "tubes",
        "coefficients": six,
        "mass": -0.6,
        "chosen": "posterior",
        "uncertainty": dict.fromkeys(NAMES, 0.5),
        "scale": [1.0, 1.0, 1.0],
        "working_voxel": 0.0195,
        "length_unit": "mm",
        "thickness": 0.156,
        "coefficients_physical": dict(zip(NAMES, physical, strict=True)),
        "epsilon_physical": 0.039,
        "matches": [],
        "intervals": None,
        "intervals_physical": None,
        "combinations": [],
        "misfit": None,
        "drift": None,
        "candidates": [own | {"thickness": 8.0, "distance": 1.6, "seed_noise": 1.1, "twins": [], "status": ""}],
        "status": "Supported.",
        "morphometry": {"volume_fraction": 0.187},
        "notes": [],
        "provenance": {"seed": 0},
        "posterior": None,
        "diagram": None,
    }


def _write_scans(folder: Path) -> None:
    """Tubes through a box: a noisy scan, a mask, a field, a network's probabilities beside its mask."""
    import nibabel

    z, y, x = np.meshgrid(*(np.arange(n) for n in (16, 17, 18)), indexing="ij")
    away = np.minimum(np.hypot((y % 9) - 4, (x % 9) - 4), np.hypot((z % 8) - 4, (y % 9) - 4))
    phase = np.tanh((2.5 - away) / 2.8).astype(np.float32)
    grey = np.clip(110 + 60 * phase + np.random.default_rng(1).normal(0, 10, phase.shape), 0, 255)
    volumes = {"scan": grey.astype(np.uint8), "mask": (phase > 0).astype(np.uint8), "field": phase}
    for name, values in volumes.items():
        image = nibabel.Nifti1Image(values.T, np.diag([0.0195] * 3 + [1.0]))
        image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / f"{name}.nii.gz")
    inside = (0.5 + 0.45 * phase).astype(np.float16)
    np.savez_compressed(folder / "chances.npz", probabilities=np.stack((1 - inside, inside)))
    shutil.copyfile(folder / "mask.nii.gz", folder / "chances.nii.gz")


def _write_channels(folder: Path) -> None:
    """Labels 0, 1 and 2, and files of two channels."""
    import nibabel

    phase, grey = np.load(folder / "long.npy"), nibabel.load(folder / "scan.nii.gz")
    labels = (phase > 0) + (phase > np.quantile(phase, 0.95)).astype(np.uint8)
    np.save(folder / "labels.npy", labels)
    np.save(folder / "long-channels.npy", np.stack((phase, -phase)))
    values = np.asarray(grey.dataobj)  # type: ignore[attr-defined]
    image = nibabel.Nifti1Image(np.stack((values, 255 - values), axis=-1), grey.affine)  # type: ignore[attr-defined]
    image.header.set_xyzt_units("mm")
    nibabel.save(image, folder / "channels.nii.gz")


def _command(folder: Path, *arguments: str) -> None:
    outcome = run(commanding(arguments), folder, folder.parent / "said")
    if outcome.code != 0:
        raise RuntimeError(f"expected `curvafit {' '.join(arguments)}` to succeed, got: {outcome.stderr[-2000:]}")


def _checkpoint(folder: Path) -> None:
    """What a run leaves that is killed once it has saved some steps."""
    work = folder / "checkpoint"
    work.mkdir()
    job = commanding(("generate", *LONG, "-o", "long.npy"))
    run(job, work, folder.parent / "said", (killing(9, work, 24),))
    if not (work / "run.pt").is_file():
        raise RuntimeError("expected a checkpoint of a run that was killed, got none")
    os.replace(work / "run.pt", folder / "run.pt")
    for each in work.iterdir():
        each.unlink()
    work.rmdir()
