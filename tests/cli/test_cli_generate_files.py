"""`curvafit generate` and the files it touches: resumed, failed, other people's, named in odd ways."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import QUICK, call, made, refused

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curvafit.drawing.shapes.surface_picture", lambda u, path: path.write_bytes(b""))


def full(*_: Any, **__: Any) -> None:
    raise OSError(28, "No space left on device", "out")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_interrupted_run_goes_on_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a full disk at the very end costs no run: the same command goes on, and then removes the checkpoint."""

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
    refused(call("generate", *saving, "--seed", 9, "-o", tmp_path / "out.npy"), "checkpoint")
    with monkeypatch.context() as patch:
        patch.setattr("curvafit.drawing.shapes.write_field", full)
        assert call("generate", *saving, "-o", tmp_path / "out.npy").exit_code == 2
    assert names(tmp_path) == ["run.pt"]
    made(*saving, "-o", tmp_path / "out.npy")
    assert names(tmp_path) == ["out.json", "out.npy", "out.png"]
    made(*QUICK, "-o", tmp_path / "whole.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(tmp_path / "whole.npy"))


@pytest.mark.filterwarnings("default:no picture was drawn")
def test_a_picture_that_fails_is_one_line_and_undoes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The former one, of another shape, goes."""

    def drawn(u: np.ndarray, path: Path) -> None:
        assert names(path.parent) == ["out.npy"]
        full()

    made(*QUICK, "-o", tmp_path / "out.npy")
    monkeypatch.setattr("curvafit.drawing.shapes.surface_picture", drawn)
    result = call("generate", *QUICK, "--seed", 1, "-o", tmp_path / "out.npy")
    assert result.exit_code == 0 and "note: " in result.stderr and "picture" in result.stderr
    assert names(tmp_path) == ["out.json", "out.npy"]
    assert json.loads((tmp_path / "out.json").read_bytes())["files"] == ["out.npy", "out.json"]


def test_a_shape_without_a_picture_leaves_that_of_others_and_no_former_one(tmp_path: Path) -> None:
    bare = [*QUICK, "--no-picture", "-o", tmp_path / "out.npy"]
    (tmp_path / "out.png").write_bytes(b"mine")
    assert made(*bare)["files"] == ["out.npy", "out.json"]
    assert (tmp_path / "out.png").read_bytes() == b"mine"
    refused(call("generate", *QUICK, "-o", tmp_path / "out.npy"), "free")
    (tmp_path / "out.png").unlink()
    assert made(*QUICK, "-o", tmp_path / "out.npy")["files"] == ["out.npy", "out.json", "out.png"]
    made(*bare)
    assert names(tmp_path) == ["out.json", "out.npy"]


def test_other_files_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scan.png").write_bytes(b"mine")
    refused(call("generate", *QUICK, "-o", tmp_path / "scan.npy"), "free")
    for name in ("out.json", "out.png"):
        options = ["--checkpoint", tmp_path / name, "-o", tmp_path / "out.npy"]
        refused(call("generate", *QUICK, *options), "checkpoint")
    assert names(tmp_path) == ["scan.png"]
    monkeypatch.setattr("curvafit.drawing.shapes.write_field", full)
    refused(call("generate", *QUICK, "-o", tmp_path / "out.zarr"), "no space left", progress=True)
    assert names(tmp_path) == ["scan.png"]
