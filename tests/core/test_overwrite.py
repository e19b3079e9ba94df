"""What no such command wrote stays, until --overwrite says otherwise; what is read stays always: for every command."""

import importlib
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from calling import QUICK, call, done, made, refused
from disk import tree
from exact_store import SETTINGS, exact_store
from found import made_inference

from curvafit.data_synth.store import open_store
from curvafit.drawing.plot import make_figure
from curvafit.report.inference import FILES, write_inference
from curvafit.volumes import Volume, load, save

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

TAKEN = "overwrite"
MASK = Volume((np.indices((12, 12, 12)).sum(0) % 12 < 6).astype(np.uint8))


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curvafit.drawing.shapes.surface_figure", lambda u, width: make_figure(1, 1))


def thesis(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "thesis.txt").write_text("mine")
    return folder


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(MASK, tmp_path_factory.mktemp("scan") / "slices.npy")


def commands(scan: Path) -> dict[str, list[object]]:
    segmenting = [scan, "--prior", "tubes", "--steps", 1]
    return {
        "generate": ["generate", *QUICK, "--shape", 12, "--steps", 4],
        "segment": ["segment", *segmenting],
        "probabilities": ["segment", *segmenting, "--weight", 1, "--probabilities"],
        "reconstruct": ["reconstruct", *segmenting, "--every", 4],
    }


@pytest.mark.parametrize("command", ["generate", "segment", "probabilities", "reconstruct"])
def test_a_command_replaces_its_own_output_alone(command: str, scan: Path, tmp_path: Path) -> None:
    """Not a thesis, an atlas, the volume of another command, nor a picture or a record of the same name."""
    words = [*commands(scan)[command], "-o"]
    other = [*commands(scan)["segment" if command == "generate" else "generate"], "-o"]
    thesis(tmp_path / "home.zarr")
    exact_store(tmp_path / "atlas.zarr", 2)
    save(MASK, tmp_path / "volume.zarr")
    for name in ("a.npy", "b.png", "c.json"):
        (tmp_path / name).write_text("mine")
    before = tree(tmp_path)
    for name in ("home.zarr", "atlas.zarr", "volume.zarr", "a.npy", "b.npy", "c.npy"):
        refused(call(*words, tmp_path / name), TAKEN)
    assert tree(tmp_path) == before
    (tmp_path / "new.zarr").mkdir()
    for name in ("new.zarr", "new.zarr", "own.npy", "own.npy"):
        done(*words, tmp_path / name)
    refused(call(*other, tmp_path / "own.npy"), TAKEN)
    (tmp_path / "new.zarr" / "notes.txt").write_text("mine")
    before = tree(tmp_path)
    refused(call(*words, tmp_path / "new.zarr"), TAKEN)
    assert tree(tmp_path) == before
    done(*words, tmp_path / "new.zarr", "--overwrite")
    assert load(tmp_path / "new.zarr").shape == (12, 12, 12)
    assert not (tmp_path / "new.zarr" / "notes.txt").exists()


def test_a_record_speaks_for_its_own_files_alone(tmp_path: Path) -> None:
    """A shape beside a scan of the same stem does not make the scan replaceable."""
    quick = commands(tmp_path)["generate"][1:]
    made(*quick, "-o", tmp_path / "a.tif")
    (tmp_path / "a.nii.gz").write_text("mine")
    refused(call("generate", *quick, "-o", tmp_path / "a.nii.gz"), TAKEN)
    assert (tmp_path / "a.nii.gz").read_text() == "mine"
    for _ in range(2):
        made(*quick, "-o", tmp_path / "b.tif")
    refused(call("generate", *quick, "-o", tmp_path / "b.stl"), "b.json")
    (tmp_path / "a.json").write_text('{"format": "curvafit-shape-1", "files": 5}')
    refused(call("generate", *quick, "-o", tmp_path / "a.tif"), TAKEN)


def test_infer_leaves_other_peoples_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = '<meta name="generator" content="curvafit 0">'
    monkeypatch.setattr("curvafit.report.inference.report_html", lambda found: page)
    monkeypatch.setattr(
        importlib.import_module("curvafit.inference.inference"), "infer", lambda *_, **__: made_inference()
    )
    told = ["infer", save(MASK, tmp_path / "scan.npy")]
    for name in FILES:
        folder = thesis(tmp_path / name.replace(".", ""))
        (folder / name).write_text("mine")
        before = tree(folder)
        refused(call(*told, "-o", folder), TAKEN)
        with pytest.raises(ValueError, match=TAKEN):
            write_inference(made_inference(), folder)
        assert tree(folder) == before
        done(*told, "-o", folder, "--overwrite")
        done(*told, "-o", folder)
        assert sorted(tree(folder)) == sorted([*FILES, "thesis.txt"])
        (folder / "report.html").write_text("mine")  # beside a fit.json that was copied there
        refused(call(*told, "-o", folder), TAKEN)
        refused(call("infer", folder / "regenerated.nii.gz", "-o", folder, "--overwrite"), "input")


def test_atlases_leave_other_peoples_files(tmp_path: Path) -> None:
    store, folder = tmp_path / "store", thesis(tmp_path / "home.zarr")
    exact_store(store, 7)
    (tmp_path / "atlas.npz").write_text("mine")
    before = tree(tmp_path)
    refused(call("atlas", "build", folder, "--count", 1, "--workers", 0), "store")
    refused(call("atlas", "extract", store, "-o", tmp_path / "atlas.npz"), TAKEN)
    assert before.items() <= tree(tmp_path).items()
    for _ in range(2):
        done("atlas", "extract", store, "-o", tmp_path / "new.npz")


def test_a_store_may_begin_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And records the number of steps that was asked for."""
    monkeypatch.setattr("curvafit.data_synth.atlas.build", build := Mock())
    (tmp_path / "s").mkdir()
    assert open_store(tmp_path / "s", SETTINGS).indices() == open_store(tmp_path / "s").indices() == []
    told = ["atlas", "build", tmp_path / "other", "--count", 1, "--shape", 12, "--workers", 0, "--schedule", "paper"]
    done(*told, "--steps", 700)
    plan = build.call_args.args[4]
    assert (plan.name, plan.steps) == ("paper", 700)


def test_a_sample_is_copied_over_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = tmp_path / "cache" / "synthetic.nii.gz"
    sample.parent.mkdir()
    sample.write_text("a sample")
    monkeypatch.setenv("CURVAFIT_CACHE", str(sample.parent))
    (tmp_path / "mine.nii.gz").write_text("mine")
    told = ["samples", "get", "synthetic", "-o"]
    result = call(*told, tmp_path / "mine.nii.gz")
    assert result.exit_code == 2 and TAKEN in result.stderr and (tmp_path / "mine.nii.gz").read_text() == "mine"
    for _ in range(2):
        done(*told, tmp_path / "new.nii.gz")
    done(*told, tmp_path / "mine.nii.gz", "--overwrite")
    assert (tmp_path / "mine.nii.gz").read_text() == "a sample"
