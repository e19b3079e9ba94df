"""`curvafit generate` and the files it touches: resumed, failed, other people's, named in odd ways."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from calling import QUICK, call, made, refused
from found import made_fit

from curvafit.volumes.read import load

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curvafit.drawing.shapes.surface_picture", lambda u, path: path.write_bytes(b""))


def test_an_interrupted_run_goes_on_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def interrupting() -> Iterator[Any]:
        def watch(text: str, share: float) -> None:
            if share > 0.5:
                raise KeyboardInterrupt

        yield watch

    saving = [*QUICK, "--checkpoint", tmp_path / "run.pt", "--checkpoint-every", 0]
    with monkeypatch.context() as patch:
        patch.setattr("curvafit.cli.generate.show_stages", interrupting)
        result = call("generate", *saving, "-o", tmp_path / "out.npy")
    assert result.exit_code == 130 and "resume" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.pt"]
    refused(call("generate", *saving, "--seed", 9, "-o", tmp_path / "out.npy"), "checkpoint")
    made(*saving, "-o", tmp_path / "out.npy")
    made(*QUICK, "-o", tmp_path / "whole.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(tmp_path / "whole.npy"))
    assert not (tmp_path / "run.pt").exists()


def test_a_failure_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device", "out")

    monkeypatch.setattr("curvafit.drawing.shapes.write_field", full)
    result = call("generate", *QUICK, "-o", tmp_path / "out.zarr")
    assert result.exit_code == 2 and "no space left" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("default:no picture was drawn")
def test_a_picture_that_fails_is_one_line_and_undoes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The former one, of another shape, goes."""

    def full(u: np.ndarray, path: Path) -> None:
        assert [each.name for each in path.parent.iterdir()] == ["out.npy"]
        raise OSError(28, "No space left on device", "out")

    made(*QUICK, "-o", tmp_path / "out.npy")
    monkeypatch.setattr("curvafit.drawing.shapes.surface_picture", full)
    result = call("generate", *QUICK, "--seed", 1, "-o", tmp_path / "out.npy")
    assert result.exit_code == 0 and "note: " in result.stderr and "picture" in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.json", "out.npy"]
    assert json.loads((tmp_path / "out.json").read_bytes())["files"] == ["out.npy", "out.json"]


def test_a_shape_without_a_picture_leaves_that_of_others_and_no_former_one(tmp_path: Path) -> None:
    bare = [*QUICK, "--no-picture", "-o", tmp_path / "out.npy"]
    (tmp_path / "out.png").write_bytes(b"mine")
    assert made(*bare)["files"] == ["out.npy", "out.json"]
    assert (tmp_path / "out.png").read_bytes() == b"mine"
    refused(call("generate", *QUICK, "-o", tmp_path / "out.npy"), "free")
    (tmp_path / "out.png").unlink()
    assert made(*bare[:-3], *bare[-2:])["files"] == ["out.npy", "out.json", "out.png"]
    made(*bare)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.json", "out.npy"]


def test_a_checkpoint_outlives_a_write_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk at the very end costs no run: the same command goes on, and then removes the file."""
    saved, out = tmp_path / "run.pt", tmp_path / "out.npy"
    command = ["generate", *QUICK, "--checkpoint", saved, "--checkpoint-every", 0, "-o", out]

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("curvafit.drawing.shapes.write_field", full)
        assert call(*command).exit_code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["run.pt"]
    assert call(*command).exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.json", "out.npy", "out.png"]


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "scan.png").write_bytes(b"mine")
    refused(call("generate", *QUICK, "-o", tmp_path / "scan.npy"), "free")
    for name in ("out.json", "out.png"):
        options = ["--checkpoint", tmp_path / name, "-o", tmp_path / "out.npy"]
        refused(call("generate", *QUICK, *options), "checkpoint")
    assert [path.name for path in tmp_path.iterdir()] == ["scan.png"]


def test_names_with_two_suffixes(tmp_path: Path) -> None:
    made(*QUICK, "--snapshots", 10, "-o", tmp_path / "a.ome.zarr")
    names = ["a.json", "a.ome.zarr", "a.png", "a_step00010.ome.zarr"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


@pytest.mark.parametrize(
    ("name", "spacing", "ome"), [("a.tif", 0.02, False), ("a.ome.tif", 0.02, True), ("b.tif", 2e-10, True)]
)
def test_tiff_is_ome_by_name_or_need(tmp_path: Path, name: str, spacing: float, ome: bool) -> None:
    made(*QUICK, "--spacing", spacing, "--unit", "m", "-o", tmp_path / name)
    with tifffile.TiffFile(tmp_path / name) as file:
        assert bool(file.is_ome) == ome
    field = load(tmp_path / name)
    assert field.spacing == pytest.approx((spacing,) * 3) and field.unit == "m"


def test_a_prior_keeps_its_unit_at_another_spacing(tmp_path: Path) -> None:
    prior = tmp_path / "fit.json"
    prior.write_text(made_fit().to_json())
    options = ["--prior", prior, "--shape", 20, "--steps", 40, "--spacing", 0.04]
    record = made(*options, "-o", tmp_path / "out.npy")
    assert (record["voxel"], record["unit"], record["working_spacing"]) == (0.04, "mm", [0.01] * 3)
