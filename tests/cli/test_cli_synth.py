"""`curvafit synth`: sets from the command line, and what it says of bad input."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, done, refused
from exact_store import exact_store
from found import made_fit

from curvafit.priors.law import FORMAT
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

ONE = ["--count", "1", "--shape", "16", "--workers", "0", "--modality", "micro-CT"]
QUICK = ["--modality", "confocal", "--count", "2", "--shape", "8,16,16", "--workers", "0", "--voxel", "0.5"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exact_store(tmp_path_factory.mktemp("shapes") / "s", 8).path


def made(folder: Path, *options: object) -> Any:
    return done("synth", "-o", folder, *options)


def listed(folder: Path) -> dict:
    return json.loads((folder / "dataset.json").read_text())


def recipe(folder: Path) -> dict:
    return json.loads((folder / "curvafit.json").read_text())["order"]["recipe"]


def test_a_set_from_a_store(tmp_path, store):
    out = tmp_path / "Dataset001_S"
    lines = made(out, "--atlas", store, *QUICK).stdout.splitlines()
    assert [Path(line).name for line in lines] == ["dataset.json", "preview.png"]
    assert all(Path(line).is_file() for line in lines)
    assert listed(out)["numTraining"] == 2 and listed(out)["channel_names"] == {"0": "confocal"}
    assert json.loads((out / "curvafit.json").read_text())["command"].startswith("curvafit synth")
    image = load(out / "imagesTr" / "case_00001_0000.nii.gz")
    assert image.shape == (8, 16, 16) and image.spacing == (1.0, 0.5, 0.5) and image.unit == "um"
    (out / "cases" / ".1a2b.case_00002.json").write_text("torn")  # a killed run's
    fewer = made(out, "--atlas", store, *QUICK, "--count", "1")
    assert listed(out)["numTraining"] == 2
    assert "note: " in fewer.stderr and "2 cases" in " ".join(fewer.stderr.split())


@pytest.mark.slow
def test_a_set_of_inferred_shapes_like_a_scan(tmp_path):
    rng, edges = np.random.default_rng(0), (0.002, 0.001, 0.001)
    z, y, x = np.mgrid[:24, :40, :40]
    inside = (np.hypot(y - 20, x - 20) < 7) | (np.hypot(z - 12, y - 8) < 4)
    save(Volume(rng.poisson(np.where(inside, 90.0, 12.0)).astype(np.uint8), edges, "mm"), tmp_path / "scan.nii.gz")
    save(Volume(inside.astype(np.uint8), edges, "mm"), tmp_path / "mask.nii.gz")
    working = {"a20": 1, "a11": 2, "a02": 6, "a10": -40, "a01": -40, "a00": 400}
    fit = {"format": FORMAT, "coefficients": working, "coefficients_physical": working, "mass": -0.5}
    fit |= {"epsilon_physical": 0.002, "working_voxel": 0.001, "length_unit": "mm"}
    (tmp_path / "fit.json").write_text(json.dumps(fit | {"morphometry": {"volume_fraction": 0.2}}))
    out, told = tmp_path / "set", ["--prior", tmp_path / "fit.json", "--like", tmp_path / "scan.nii.gz", "--label", "1"]
    told += ["--like-mask", tmp_path / "mask.nii.gz", "--visible", "auto", "--voxel", "1", "--unit", "um"]
    # the unit is of the shape's voxel alone
    ended = made(out, *told, "--count", "1", "--shape", "8,16,16", "--workers", "0")
    assert "mm thick, " in ended.stderr and f"{100 * inside.mean():.1f} %\n" in ended.stderr
    image = load(out / "imagesTr" / "case_00000_0000.nii.gz")
    assert image.spacing == pytest.approx(edges) and image.unit == "mm"
    record = json.loads((out / "cases" / "case_00000.json").read_text())
    assert record["source"]["parameters"]["a02"] == 6 and record["voxel"] == pytest.approx(0.001)
    assert 0.01 <= record["imaging"]["visible"] < 0.5 and recipe(out)["source"]["fraction"] == 0.2


#: What is typed (FIT, STORE, MASK, TAKEN and NONE are files and folders), and a word of what is said of it.
REFUSALS = {
    "--modality confocal": {
        "--atlas NONE": "none", "": "--prior", "--prior tube": "--prior", "--presets tubes --voxel 0.001": "1e+09",
        "--presets tubes --volume-fraction 2": "volume fraction",
        "-o TAKEN --presets tubes": "folder",
    },
    "--atlas STORE": {
        "": "--modality", "--modality x-ray": "two-photon", "--like MASK --label 0": "--label",
        "--like MASK --crop 0:4": "crop",
    },
    "--atlas STORE --modality confocal": {
        "--count 0 --shape 8,16,16 --voxel 0.5": "count", "--presets tubes": "--prior", "--calibres 2": "--calibres",
        "--shape 2,8,8 --labels betti": "4 voxels", "--visible 1.5": "visible", "--like-mask MASK": "--like-mask",
        "--channel 0": "--channel", "--volume-fraction 0.2": "--volume-fraction", "--unit um": "--voxel",
        "--shape 8 --labels depth": "labels", "--shape 8 --layout bids": "layout",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory, store: Path) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("places")
    (folder / "taken").mkdir()
    (folder / "taken" / "notes.txt").write_text("mine")
    (folder / "m.nii.gz").touch()
    made_fit().save(folder / "fit.json")
    names = {"FIT": "fit.json", "MASK": "m.nii.gz", "TAKEN": "taken", "NONE": "none", "OUT": "set"}
    return {"STORE": store, **{name: folder / file for name, file in names.items()}}


@pytest.mark.parametrize("common", REFUSALS)
def test_bad_input(places: dict[str, Path], common: str) -> None:
    for typed, key in REFUSALS[common].items():
        words = f"{common} {typed} --workers 0"
        for name, path in places.items():
            words = words.replace(name, str(path))
        refused(call("synth", "-o", places["OUT"], *words.split()), key)
        assert not places["OUT"].exists(), typed
