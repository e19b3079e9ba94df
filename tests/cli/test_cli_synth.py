"""`curvafit synth`: sets from the command line, and what it says of bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused
from exact_store import exact_store
from found import made_fit

from curvafit.inference.fit import to_columns
from curvafit.priors.law import FORMAT
from curvafit.volumes.field import Field
from curvafit.volumes.read import load
from curvafit.volumes.write import save

QUICK = ["--count", "2", "--shape", "8,16,16", "--workers", "0", "--voxel", "0.5"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exact_store(tmp_path_factory.mktemp("shapes") / "s.zarr", 8).path


def listed(folder: Path) -> dict:
    return json.loads((folder / "dataset.json").read_text())


def test_a_set_from_a_store(tmp_path, store):
    out = tmp_path / "Dataset001_S"
    result = call("synth", "-o", out, "--atlas", store, "--modality", "confocal", *QUICK)
    assert result.exit_code == 0, (result.output, result.exception)
    assert [Path(line).name for line in result.stdout.splitlines()] == ["dataset.json", "preview.png", "card.md"]
    assert listed(out)["numTraining"] == 2 and listed(out)["channel_names"] == {"0": "confocal"}
    assert (out / "preview.png").read_bytes().startswith(b"\x89PNG")
    image = load(out / "imagesTr" / "case_00001_0000.nii.gz")
    assert image.shape == (8, 16, 16) and image.spacing == (1.0, 0.5, 0.5) and image.unit == "um"
    (out / "cases" / ".1a2b.case_00002.json").write_text("torn")  # a killed run's
    fewer = call("synth", "-o", out, "--atlas", store, "--modality", "confocal", *QUICK, "--count", "1")
    assert fewer.exit_code == 0 and listed(out)["numTraining"] == 2
    assert "note: " in fewer.stderr and "2 cases" in " ".join(fewer.stderr.split())


def test_names_of_modalities_are_forgiving(tmp_path, store):
    quick = ["--count", "1", "--shape", "8", "--workers", "0"]
    result = call("synth", "-o", tmp_path / "s", "--atlas", store, "--modality", "EM_membrane", *quick)
    assert result.exit_code == 0 and listed(tmp_path / "s")["channel_names"] == {"0": "em-membrane"}


@pytest.mark.slow
def test_a_set_of_inferred_shapes_like_a_scan(tmp_path, store):
    rng = np.random.default_rng(0)
    z, y, x = np.mgrid[:24, :40, :40]
    inside = (np.hypot(y - 20, x - 20) < 7) | (np.hypot(z - 12, y - 8) < 4)
    grey = rng.poisson(np.where(inside, 90.0, 12.0)).astype(np.uint8)
    save(Field(grey, (0.002, 0.001, 0.001), "mm"), tmp_path / "scan.nii.gz")
    told = {"mass": -0.5, "epsilon_physical": 0.002, "working_voxel": 0.001, "length_unit": "mm"}
    working = {"a20": 1, "a11": 2, "a02": 6, "a10": -40, "a01": -40, "a00": 400}
    fit = told | {"format": FORMAT, "coefficients": working, "coefficients_physical": working}
    fit["morphometry"] = {"volume_fraction": 0.2}
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    save(Field(inside.astype(np.uint8), (0.002, 0.001, 0.001), "mm"), tmp_path / "mask.nii.gz")
    quick = ["--count", "1", "--shape", "8,16,16", "--workers", "0"]
    out, scan = tmp_path / "set", tmp_path / "scan.nii.gz"
    told = ["--like", scan, "--like-mask", tmp_path / "mask.nii.gz", "--label", "1", "--visible", "auto"]
    told += ["--voxel", "1", "--unit", "um"]  # of the shape's voxel alone: the scan stays in mm
    result = call("synth", "-o", out, "--prior", tmp_path / "fit.json", *told, *quick)
    assert result.exit_code == 0, (result.output, result.exception)
    image = load(out / "imagesTr" / "case_00000_0000.nii.gz")
    assert image.spacing == pytest.approx((0.002, 0.001, 0.001)) and image.unit == "mm"
    record = json.loads((out / "cases" / "case_00000.json").read_text())
    assert record["source"][0]["parameters"]["a02"] == 6 and record["voxel"] == pytest.approx(0.001)
    assert 0.01 <= record["imaging"]["visible"] < 0.5
    order = json.loads((out / "curvafit.json").read_text())["order"]["recipe"]
    assert order["source"]["fraction"] == 0.2


def test_a_set_of_presets_and_of_an_atlas_file(tmp_path):
    quick = ["--count", "1", "--shape", "16", "--workers", "0", "--modality", "micro-CT"]
    out = tmp_path / "presets"
    assert call("synth", "-o", out, "--preset", "tubes,sponge", *quick).exit_code == 0
    assert json.loads((out / "cases" / "case_00000.json").read_text())["source"][0]["name"] == "tubes"


def test_shells_around_a_lumen(tmp_path, store):
    some = ["synth", "-o", tmp_path / "set", "--atlas", store, "--modality", "confocal", *QUICK]
    result = call(*some, "--wall", "800", "--unit", "nm", "--levels", "1,0.2", "--voxel", "500")
    assert result.exit_code == 0, (result.output, result.exception)
    assert listed(tmp_path / "set")["labels"] == {"background": 0, "wall": 1, "lumen": 2}
    recipe = json.loads((tmp_path / "set" / "curvafit.json").read_text())["order"]["recipe"]
    assert recipe["composition"]["wall"] == pytest.approx(0.8) and recipe["voxel"] == pytest.approx(0.5)
    other = ["--wall", "0.8", "--levels", "1,0.3"]
    refused(call(*some, *other), "another")


def test_classes_of_two_laws(tmp_path):
    quick = ["--count", "1", "--shape", "16", "--workers", "0", "--modality", "micro-CT"]
    assert call("synth", "-o", tmp_path / "s", "--presets", "sponge,tubes", "--classes", *quick).exit_code == 0
    assert listed(tmp_path / "s")["labels"] == {"background": 0, "sponge": 1, "tubes": 2}


def test_laws_are_drawn_from_a_posterior(tmp_path):
    fit = made_fit()
    fit.save(tmp_path / "fit.json")
    quick = ["--count", "1", "--shape", "16", "--workers", "0", "--modality", "micro-CT"]
    result = call("synth", "-o", tmp_path / "s", "--prior", tmp_path / "fit.json", "--draws", "3", *quick)
    assert result.exit_code == 0, (result.output, result.exception)
    source = json.loads((tmp_path / "s" / "curvafit.json").read_text())["order"]["recipe"]["source"]
    assert len(source["points"]) == 3 and source["fraction"] == pytest.approx(0.187)
    columns = to_columns(fit.draws)
    ratios = np.array(source["scales"]) * columns[6, [0, 30, 59]]  # every shape is as thick as the scan
    assert ratios == pytest.approx(np.full(3, ratios[0])) and min(source["scales"]) < 1 < max(source["scales"])
    assert all("fit.json" in name for name in source["names"])
    for point, row in zip(source["points"], (0, 30, 59), strict=True):
        assert point[0] == 1 and point[1:6] == pytest.approx(columns[:5, row], rel=1e-4)
    refused(call("synth", "-o", tmp_path / "t", "--preset", "tubes", "--draws", "3", *quick), "posterior")
    two = ["--prior", f"{tmp_path / 'fit.json'},{tmp_path / 'fit.json'}", "--draws", "3"]
    refused(call("synth", "-o", tmp_path / "t", *two, *quick), "one fit")
    refused(
        call("synth", "-o", tmp_path / "t", *two[:1], tmp_path / "fit.json", *two[2:], "--classes", *quick), "--draws"
    )
    refused(call("synth", "-o", tmp_path / "t", "--prior", tmp_path / "fit.json", "--draws", "99", *quick), "60 draws")


def test_bad_input(tmp_path, store):
    out, kind = tmp_path / "set", ["--modality", "confocal"]
    some = ["synth", "-o", out, "--atlas", store]
    refused(call(*some, *kind, *QUICK, "--count", "0"), "count")
    refused(call(*some, *kind, "--shape", "64"), "24")
    refused(call("synth", "-o", out, "--atlas", tmp_path / "none.zarr", *kind), "none.zarr")
    refused(call("synth", "-o", out, *kind), "--prior")
    refused(call(*some, *kind, "--presets", "tubes"), "--prior")
    refused(call(*some), "--modality")
    refused(call(*some, "--modality", "x-ray"), "two-photon")
    refused(call("synth", "-o", out, "--prior", "tube", *kind), "preset")
    refused(call(*some, *kind, "--shape", "2,8,8", "--labels", "betti"), "4 voxels")
    refused(call("synth", "-o", out, "--presets", "tubes", *kind, "--voxel", "0.001"), "1e+09")
    refused(call(*some, *kind, "--calibres", "2"), "--calibres")
    refused(call(*some, *kind, *QUICK, "--calibres", "2,1"), "calibres")
    refused(call(*some, *kind, "--visible", "1.5"), "visible")
    mask = tmp_path / "m.nii.gz"
    mask.touch()
    refused(call(*some, *kind, "--like-mask", mask), "--like-mask")
    refused(call(*some, *kind, "--channel", "0"), "--channel")
    refused(call(*some, "--like", mask, "--label", "0"), "--label")
    refused(call(*some, "--like", mask, "--crop", "0:4"), "crop")
    refused(call(*some, *kind, "--volume-fraction", "0.2"), "--volume-fraction")
    refused(call("synth", "-o", out, "--presets", "tubes", *kind, "--volume-fraction", "2"), "volume fraction")
    refused(call(*some, *kind, "--draws", "3"), "--draws")
    refused(call(*some, *kind, *QUICK, "--wall", "0"), "wall")
    refused(call(*some, *kind, *QUICK, "--wall", "1", "--classes"), "classes")
    refused(call(*some, *kind, *QUICK, "--classes"), "classes")
    refused(call(*some, *kind, *QUICK, "--levels", "1,0"), "level")
    refused(call(*some, *kind, "--unit", "um"), "--wall")
    refused(call(*some, *kind, *QUICK, "--labels", "depth"), "labels")
    refused(call(*some, *kind, *QUICK, "--layout", "bids"), "layout")
    refused(call(*some, *kind, *QUICK, "--seed", "-1"), "seed")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    refused(call("synth", "-o", tmp_path / "other", "--presets", "tubes", *kind, "--workers", "0"), "folder")
    assert not out.exists()
