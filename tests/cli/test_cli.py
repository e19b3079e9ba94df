"""The command line: what parses, what is written, and one sentence with exit code 2 for everything else."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import QUICK, call, refused
from found import made_inference, without_drawing

from curvafit.volumes.field import Field
from curvafit.volumes.write import save

# ---- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["generate", "infer", "segment", "atlas build", "samples get"])
def test_help_of_a_command_has_an_example(command: str) -> None:
    result = call(*command.split(), "--help")
    assert result.exit_code == 0
    assert f"curvafit {command}" in result.stdout and "xample" in result.stdout


def test_presets_are_listed_with_their_numbers() -> None:
    lines = {line.split()[0]: line.split() for line in call("presets").stdout.splitlines()}
    assert lines["name"] == ["name", "a20", "a11", "a02", "a10", "a01", "a00", "mass", "source"]
    assert lines["tubes"][1:8] == ["1", "2", "6", "-40", "-40", "400", "-0.6"]


def test_samples_are_listed_with_their_licences() -> None:
    result = call("samples")
    assert result.exit_code == 0 and re.search(r"^bone .* MIT ", result.stdout, re.MULTILINE)
    refused(call("samples", "get", "nothing"), "sample")
    assert re.fullmatch(r"curvafit \d+\.\d+\.\d+\S*\n", call("--version").stdout)


# ---- infer -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    without_drawing(monkeypatch)


@pytest.fixture
def finding(monkeypatch: pytest.MonkeyPatch, undrawn: None) -> dict[str, Any]:
    """Puts a made inference in the place of the real one, and keeps what it was called with."""
    calls: dict[str, Any] = {}

    def find(scan: str, *, progress: Any, **given: Any) -> Any:
        progress("reading the scan", 0.0)
        calls.update(scan=scan, **given)
        return made_inference()

    monkeypatch.setattr(importlib.import_module("curvafit.inference.infer"), "infer", find)
    return calls


def test_infer_writes_three_files_and_says_what_it_found(tmp_path: Path, finding: dict[str, Any]) -> None:
    (tmp_path / "scan.h5").touch()
    scan = f"{tmp_path / 'scan.h5'}::raw"
    result = call("infer", scan, "-o", tmp_path / "out", "--spacing", "2,1,1", "--unit", "um", "--dark")
    assert result.exit_code == 0, (result.output, result.exception)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["fit.json", "regenerated.nii.gz", "report.html"]
    lines = result.stdout.splitlines()
    assert lines[0].startswith("Tubes, radius") and lines[-1] == str(tmp_path / "out" / "report.html")
    assert re.search(r"a11 +1\.80 +0\.40 +\S+ to \S+ +1\.80", result.stdout)
    assert re.search(r"a10 +-38\.5 +6\.0 +\S+ to \S+ +-19\.7 1/mm", result.stdout)
    assert "[  0 %] reading the scan" in result.stderr
    assert finding["scan"] == scan and finding["spacing"] == (2.0, 1.0, 1.0)
    assert finding["unit"] == "um" and finding["dark"] is True and finding["threshold"] == "otsu"


def test_infer_hands_every_option_on(tmp_path: Path, finding: dict[str, Any]) -> None:
    options = "--kind mask --periodic --threshold -12.5 --label 3 --raw-shape 4,5,6 --dtype u1 --key k --seed 9"
    options += " --channel 2 --crop 1:3,:,-4: --method match"
    scan, roi = tmp_path / "a.raw", tmp_path / "r.npy"
    for file in (scan, roi):
        file.touch()
    result = call("infer", scan, "-o", tmp_path / "out", *options.split(), "--spacing", "0.5", "--roi", roi)
    assert result.exit_code == 0, (result.output, result.exception)
    wanted = {"kind": "mask", "periodic": True, "threshold": -12.5, "label": 3, "raw_shape": (4, 5, 6), "dtype": "u1"}
    wanted |= {"key": "k", "seed": 9, "spacing": (0.5, 0.5, 0.5), "roi": roi, "atlas": None}
    wanted |= {"channel": 2, "crop": "1:3,:,-4:", "method": "match"}
    assert {name: finding[name] for name in wanted} == wanted


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("--spacing 1,0,1", "--spacing"),
        ("--spacing 1,1", "--spacing"),
        ("--spacing a", "--spacing"),
        ("--threshold high", "--threshold"),
        ("--raw-shape 4,5", "--raw-shape"),
        ("--unit furlong", "unit"),
        ("--kind drawing", "kind"),
        ("--method nearest", "method"),
        ("--seed -1", "seed"),
        ("--kind mask --threshold 4", "threshold"),
        ("--label 1 --threshold 4", "label"),
        ("--atlas nowhere.npz", "atlas"),
        ("--roi nowhere.npy", "no such file"),
        ("--label 77", "label"),
        ("--crop 1:4", "crop"),
        ("--crop 1:4,:,0:21", "crop"),
        ("--channel 0", "channel"),
        ("--threshold 5", "threshold"),
    ],
)
def test_infer_refuses_options_in_one_sentence(tmp_path: Path, arguments: str, word: str) -> None:
    values = np.random.default_rng(0).normal(size=(20, 20, 20)).astype(np.float32)
    scan = save(Field(values), tmp_path / "scan.npy")
    refused(call("infer", scan, "-o", tmp_path / "out", *arguments.split()), word, progress=True)
    assert not (tmp_path / "out").exists()


def test_infer_checks_before_it_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: object, **__: object) -> None:
        raise AssertionError("the scan was read")

    monkeypatch.setattr(importlib.import_module("curvafit.inference.infer"), "read_scan", read)
    scan = tmp_path / "scan.npy"
    scan.touch()
    for option in (("--seed", "-1"), ("--kind", "drawing"), ("--unit", "furlong")):
        refused(call("infer", scan, "-o", tmp_path / "out", *option), option[0].strip("-"))
    assert list(tmp_path.iterdir()) == [scan]


BAD_VOLUMES: dict[str, Any] = {
    "flat": np.zeros((20, 20)),
    "four": np.zeros((5, 5, 5, 5)),
    "nan": np.full((20, 20, 20), np.nan),
    "constant": np.ones((20, 20, 20)),
    "thin": np.indices((30, 30, 30)).sum(0) % 8 == 0,
}


@pytest.mark.parametrize("name", BAD_VOLUMES)
def test_infer_refuses_volumes_in_one_sentence(tmp_path: Path, name: str) -> None:
    np.save(tmp_path / f"{name}.npy", BAD_VOLUMES[name])
    refused(call("infer", tmp_path / f"{name}.npy", "-o", tmp_path / "out"), progress=True)
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.npy"]


def test_infer_refuses_missing_unknown_and_truncated_files(tmp_path: Path) -> None:
    (tmp_path / "scan.xyz").write_bytes(b"12345")
    np.save(tmp_path / "cut.npy", np.random.default_rng(0).normal(size=(9, 9, 9)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cut.npy").read_bytes()[:900])
    for name, word in (("none.tif", "no such file"), ("scan.xyz", "scan.xyz"), ("cut.npy", "cut.npy")):
        refused(call("infer", tmp_path / name, "-o", tmp_path / "out"), word, progress=True)
    refused(call("infer", tmp_path / "cut.npy", "-o", tmp_path / "scan.xyz"), "folder")
    assert not (tmp_path / "out").exists()


# ---- interruptions and mistakes --------------------------------------------------------------------------------------


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Let `generate` raise."""

    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(importlib.import_module("curvafit.generation.flow"), "generate", fail)


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 2, "memory"),
        (RuntimeError("not enough memory: you tried to allocate"), 2, "memory"),
        (ModuleNotFoundError("expected pynrrd, got none: pip install curvafit[io]", name="nrrd"), 2, "pip install"),
        (PermissionError(13, "Permission denied", "out"), 2, "permission denied: out"),
    ],
)
def test_an_interruption_or_a_limit_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, word: str
) -> None:
    failing(monkeypatch, error)
    result = call("generate", *QUICK, "-o", tmp_path / "out.npy")
    assert result.exit_code == code
    assert word in result.stderr and "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


def test_our_own_mistakes_keep_their_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, RuntimeError("a tensor of another shape"))
    assert isinstance(call("generate", *QUICK, "-o", tmp_path / "out.npy").exception, RuntimeError)


@pytest.mark.filterwarnings("default::UserWarning")
def test_a_warning_becomes_a_note_where_the_command_succeeds(tmp_path: Path) -> None:
    law = ["--coefficients", "-1,2,6,-40,-40,400", "--shape", "12", "-o", tmp_path / "out.npy"]
    result = call("generate", *law, "--steps", "1", "--mass", "0")
    assert result.exit_code in (0, 1) and "note: a20 > 0 and a02 > 0" in result.stderr
    refused(call("generate", *law, "--steps", "1", "--mass", "7"), "mass")
    refused(call("generate", *law, "--mass", "0", "--steps", "0"), "steps")
