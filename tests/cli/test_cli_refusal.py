"""Refusals on the command line: one line, exit code 2, nothing on the other stream, nothing begun."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
from calling import LAW, call, refused
from exact_store import exact_store

from curvafit.cli.refusal import LONGEST, sentence, writable
from curvafit.cli.support import error_console, stages
from curvafit.volumes.scan import Field, save

SYNTH = ["--presets", "tubes", "--modality", "confocal", "--workers", "0", "--count", "1"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["frob"], "no such command 'frob'"),
        (["atlas", "frob"], "(see curvafit atlas --help)"),
        (["--frob"], "no such option: --frob"),
        (["generate", "--frob"], "no such option: --frob"),
        (["generate", "--preset", "tubes"], "--output"),
        (["generate", "--preset", "tubes", "--seed", "x", "-o", "a.npy"], "(see curvafit generate --help)"),
        (["generate", "a", "b", "-o", "c.npy"], "unexpected extra argument"),
        (["generate", "--preset"], "requires an argument"),
        (["infer"], "(see curvafit infer --help)"),
        (["segment", "a.npy", "-o", "b.npy", "--prior", "tubes", "--steps", "0"], "(see curvafit segment --help)"),
        (["reconstruct"], "(see curvafit reconstruct --help)"),
        (["synth", "-o", "set", "--count", "many"], "(see curvafit synth --help)"),
        (["nnunet"], "--prior"),
        (["samples", "get"], "(see curvafit samples get --help)"),
        (["atlas", "build"], "(see curvafit atlas build --help)"),
        (["presets", "all"], "unexpected extra argument"),
    ],
)
def test_wrong_use_is_one_line(arguments: list[str], said: str) -> None:
    refused(call(*arguments), said)


@pytest.mark.parametrize("group", [[], ["atlas"]])
def test_without_a_command_help_is_shown(group: list[str]) -> None:
    result = call(*group)
    assert "Usage:" in result.output and "error:" not in result.output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--coefficients", "1e300,0,1e300,0,0,0", "--mass", "0"], "expected |a20| of at most 1e+06"),
        ([*LAW, "--epsilon", "1e30"], "expected an epsilon from 0.1 of a voxel"),
        ([*LAW, "--steps", str(10**18)], "expected a whole number of steps, at least 1, at most 1e+07"),
        ([*LAW, "--seed", str(2**64)], "expected a seed that is a whole number from 0, at most"),
        ([*LAW, "--shape", "1e9"], "fits into memory"),
        ([*LAW, "--shape", "8", "--tile", "1e6,1e6,1"], "expected a file that fits into memory"),
        ([*LAW, "--spacing", "1e300"], "expected a positive voxel edge, at most 1e+12, got 1e+300"),
        ([*LAW, "--spacing", "1e-300"], "expected a positive voxel edge, at least 1e-12"),
        ([*LAW, "--orientation", "0,0,1,1e30"], "expected |the orientation| epsilon² of at most 1e+06"),
        ([*LAW, "--snapshots", "1e300"], "expected snapshots at 0 to 1500 steps"),
        ([*LAW, "--checkpoint", "c.pt", "--checkpoint-every", "nan"], "expected a finite number of seconds"),
        ([*LAW[:2], "--volume-fraction", "nan"], "expected a volume fraction in (0, 1), got nan"),
        ([*LAW, "--checkpoint-every", "5"], "expected --checkpoint beside --checkpoint-every"),
        ([*LAW, "--no-cap"], "expected --no-cap beside a surface (.stl, .ply, .vtp), got 'out.npy'"),
        (["--preset", "x" * 5000], "expected a preset among"),
        (["--preset", "tu\nbes\x1b[31m\u202e"], r"\x1b[31m\u202e"),
    ],
)
def test_generate_refuses_magnitudes_and_what_it_would_ignore(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(call("generate", *arguments, "-o", "out.npy"), said)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--count", str(10**9)], "expected a count of at least 1 shape, at most 1e+07"),
        (["--around", "tubes", "--spread", "1e300"], "expected a positive spread, at most 100"),
        (["--around", "tubes", "--spread", "nan"], "expected a positive spread, got nan"),
        (["--workers", str(10**6)], "expected a number of workers from 0, at most 1024"),
        (["--workers", "2", "--scheduler", "tcp://x:1"], "expected either workers or a scheduler"),
        (["--shape", "1e5"], "expected a shape that fits into memory, got 100000 x 100000 x 100000 voxels"),
        (["--design", "box.yaml"], "box.yaml: expected |a10| epsilon of at most 1e+06"),
    ],
)
def test_an_atlas_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.yaml").write_text("box:\n  a10: [0, 1e300]\n")
    refused(call("atlas", "build", "s.zarr", *arguments), said)
    assert [path.name for path in tmp_path.iterdir()] == ["box.yaml"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--voxel", "1e300"], "expected a shape's voxel of positive length, at most 1e+12"),
        (["--calibres", "1,1e300"], "expected calibres as two positive factors, the lower first, at most 1000"),
        (["--calibres", "1,900", "--shape", "16"], "expected images that span 4 voxels of a shape or more"),
        (["--shape", "1"], "expected images of 2 to 1e+09 voxels, got 1 x 1 x 1"),
        (["--shape", "1e9"], "expected images of 2 to 1e+09 voxels"),
        (["--unit", "furlong"], "expected --unit beside --spacing or --voxel"),
        (["--unit", "furlong", "--voxel", "1"], "expected a unit of voxel, nm, um, mm or m, got 'furlong'"),
        (["--count", str(10**9)], "expected a count of at least 1 case, at most 1e+07"),
        (["--scheduler", "tcp://x:1"], "expected either workers or a scheduler"),
        (["--volume-fraction", "nan"], "expected a volume fraction in (0, 1), got nan"),
    ],
)
def test_a_set_is_not_begun(tmp_path: Path, arguments: list[str], said: str) -> None:
    refused(call("synth", "-o", tmp_path / "a" / "set", *SYNTH, *arguments), said)
    assert list(tmp_path.iterdir()) == []


def test_a_set_without_any_case_is_removed(tmp_path: Path) -> None:
    """All that such images show of the stored shapes is background."""
    store = exact_store(tmp_path / "s.zarr", 1).path
    told = ["synth", "--atlas", store, "--modality", "confocal", "--workers", "0", "--shape", "1,1,2", "--voxel", "0.5"]
    result = call(*told, "-o", tmp_path / "a" / "set")
    assert result.exit_code == 2 and "error: expected" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["s.zarr"]
    (tmp_path / "mine").mkdir()
    assert call(*told, "-o", tmp_path / "mine").exit_code == 2
    assert list((tmp_path / "mine").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seed", "-1"], "expected a seed that is a whole number from 0, got -1"),
        (["--kind", "mask", "--threshold", "4"], "expected a threshold beside grey levels, got kind mask"),
        (["--label", "1", "--threshold", "4"], "expected a label, which tells the structure, without"),
        (["--unit", "furlong"], "expected a unit of voxel, nm, um, mm or m, got 'furlong'"),
        (["--kind", "drawing"], "expected kind auto, field, mask or image, got 'drawing'"),
    ],
)
def test_infer_checks_before_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    def read(*_: object, **__: object) -> None:
        raise AssertionError("the scan was read")

    monkeypatch.setattr(importlib.import_module("curvafit.inference.infer"), "field_of", read)
    refused(call("infer", "scan.npy", "-o", tmp_path / "out", *arguments), said)
    assert list(tmp_path.iterdir()) == []


def test_reconstruct_refuses_what_it_would_ignore(tmp_path: Path) -> None:
    save(Field(np.indices((9, 9, 9)).sum(0) // 12), tmp_path / "scan.npy")
    told = ["reconstruct", tmp_path / "scan.npy", "--prior", "tubes", "-o", tmp_path / "out.npy", "--slices", "0,8"]
    refused(call(*told, "--first", "2"), "expected --first beside --every, got 2 beside --known")


@pytest.mark.filterwarnings("default::UserWarning")
def test_no_note_stands_beside_an_error(tmp_path: Path) -> None:
    law = ["--coefficients", "-1,2,6,-40,-40,400", "--mass", "0", "--shape", "8", "-o", tmp_path / "out.npy"]
    refused(call("generate", *law, "--steps", "0"), "expected a whole number of steps")
    assert "note: a20 > 0 and a02 > 0" in call("generate", *law, "--steps", "1").stderr


def test_a_job_that_fails_at_its_start_says_why_alone(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OSError, match="gone"), stages() as progress:
        progress("reading", 0.0)
        raise OSError("gone")
    assert capsys.readouterr().err == ""
    with stages() as progress:
        progress("reading", 0.0)
    assert capsys.readouterr().err == "[  0 %] reading\n"


def test_a_sentence_is_one_line_that_shows() -> None:
    assert sentence("a\n b\tc") == "error: a b c"
    assert sentence("\x1b[2J \u202e \ud800", "note") == r"note: \x1b[2J \u202e \ud800"
    assert sentence("κ1 ≥ κ2, é") == "error: κ1 ≥ κ2, é"
    assert len(sentence("expected " + "x" * 10**6)) < LONGEST + 20
    writable("\udcff é", error_console()).encode(error_console().encoding)
