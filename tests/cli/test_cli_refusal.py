"""Refusals on the command line: one line, exit code 2, nothing on the other stream, nothing begun."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calling import call, refused
from exact_store import exact_store

from curvafit.cli.console import LONGEST, error_console, sentence, show_stages, writable
from curvafit.volumes.field import Field
from curvafit.volumes.write import save

SYNTH = ["--presets", "tubes", "--modality", "confocal", "--workers", "0", "--count", "1"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("frob", "'frob'"),
        ("atlas frob", "(see curvafit atlas --help)"),
        ("--frob", "--frob"),
        ("generate --frob", "--frob"),
        ("generate --preset tubes", "--output"),
        ("generate --preset tubes --seed x -o a.npy", "(see curvafit generate --help)"),
        ("generate a b -o c.npy", "argument"),
        ("generate --preset", "argument"),
        ("infer", "(see curvafit infer --help)"),
        ("segment a.npy -o b.npy --prior tubes --steps 0", "(see curvafit segment --help)"),
        ("synth -o set --count many", "(see curvafit synth --help)"),
        ("samples get", "(see curvafit samples get --help)"),
        ("presets all", "argument"),
        (f"refine {__file__} --repair -o mask.npy", "gone"),
        (f"windows {__file__} --laws -o maps", "must end in"),
    ],
)
def test_wrong_use_is_one_line(arguments: str, word: str) -> None:
    refused(call(*arguments.split()), word)


@pytest.mark.parametrize("group", [[], ["atlas"]])
def test_without_a_command_help_is_shown(group: list[str]) -> None:
    result = call(*group)
    assert "Usage:" in result.output and "error:" not in result.output


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--count", str(10**9)], "count"),
        (["--around", "tubes", "--spread", "1e300"], "spread"),
        (["--around", "tubes", "--spread", "nan"], "spread"),
        (["--workers", str(10**6)], "workers"),
        (["--workers", "2", "--scheduler", "tcp://x:1"], "scheduler"),
        (["--shape", "1e5"], "memory"),
        (["--design", "box.yaml"], "a10"),
    ],
)
def test_an_atlas_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], word: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.yaml").write_text("box:\n  a10: [0, 1e300]\n")
    refused(call("atlas", "build", "s.zarr", *arguments), word)
    assert [path.name for path in tmp_path.iterdir()] == ["box.yaml"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("--voxel 1e300", "voxel"),
        ("--calibres 1,1e300", "calibres"),
        ("--calibres 1,900 --shape 16", "images"),
        ("--shape 1", "images"),
        ("--shape 1e9", "images"),
        ("--unit mm", "--unit"),
        ("--unit furlong --voxel 1", "furlong"),
        (f"--count {10**9}", "count"),
        ("--scheduler tcp://x:1", "scheduler"),
        ("--volume-fraction nan", "volume fraction"),
    ],
)
def test_a_set_is_not_begun(tmp_path: Path, arguments: str, word: str) -> None:
    refused(call("synth", "-o", tmp_path / "a" / "set", *SYNTH, *arguments.split()), word)
    assert list(tmp_path.iterdir()) == []


def test_a_set_without_any_case_is_removed(tmp_path: Path) -> None:
    """All that such images show of the stored shapes is background."""
    store = exact_store(tmp_path / "s.zarr", 1).path
    words = ["synth", "--atlas", store, "--modality", "confocal", "--workers", "0", "--shape", "1,1,2", "--voxel", 0.5]
    result = call(*words, "-o", tmp_path / "a" / "set")
    assert result.exit_code == 2 and "error: " in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["s.zarr"]
    (tmp_path / "mine").mkdir()
    assert call(*words, "-o", tmp_path / "mine").exit_code == 2
    assert list((tmp_path / "mine").iterdir()) == []


def test_reconstruct_refuses_what_it_would_ignore(tmp_path: Path) -> None:
    save(Field(np.indices((9, 9, 9)).sum(0) // 12), tmp_path / "scan.npy")
    words = ["reconstruct", tmp_path / "scan.npy", "--prior", "tubes", "-o", tmp_path / "out.npy", "--known", "0,8"]
    refused(call(*words, "--first", "2"), "--first")


# ---- lines -----------------------------------------------------------------------------------------------------------


def test_a_job_that_fails_at_its_start_says_why_alone(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OSError, match="gone"), show_stages() as progress:
        progress("reading", 0.0)
        raise OSError("gone")
    assert capsys.readouterr().err == ""
    with show_stages() as progress:
        progress("reading", 0.0)
    assert capsys.readouterr().err == "[  0 %] reading\n"


def test_a_stage_that_counts_on_is_a_line_every_five_percent(capsys: pytest.CaptureFixture[str]) -> None:
    """Progress where there is no terminal: lines that a log can hold."""
    with show_stages() as progress:
        for k in range(1000):
            progress(f"{k} of 1000 draws checked", 0.9 * k / 1000)
        progress("making draw 12 again", 0.9)
        progress("making draw 12 again", 0.9)
    lines = capsys.readouterr().err.splitlines()
    assert 15 <= len(lines) <= 21
    assert lines[0] == "[  0 %] 0 of 1000 draws checked" and lines[-1] == "[ 90 %] making draw 12 again"


def test_a_sentence_is_one_line_that_shows() -> None:
    assert sentence("a\n b\tc") == "error: a b c"
    assert sentence("\x1b[2J \u202e \ud800", "note") == r"note: \x1b[2J \u202e \ud800"
    assert sentence("κ1 ≥ κ2, é") == "error: κ1 ≥ κ2, é"
    assert len(sentence("expected " + "x" * 10**6)) < LONGEST + 20
    writable("\udcff é", error_console()).encode(error_console().encoding)
