"""The command line: what parses, what is written, and one sentence with exit code 2 for everything else."""

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import LAW, QUICK, call, done, refused
from exact_store import exact_store
from found import made_inference, without_drawing

from curvafit.cli.console import LONGEST, error_console, sentence, show_stages, writable
from curvafit.cli.options import _check_inputs

# ---- what is refused -------------------------------------------------------------------------------------------------

#: In `folder`: words that a command refuses, and one of its sentence.
REFUSALS: dict[str, dict[str, str]] = {
    "": {"frob": "'frob'", "--frob": "--frob", "presets all": "argument",
         "samples get": "(see curvafit samples get --help)", "samples get nothing": "sample"},
    "generate": {
        "--frob": "--frob", "--preset tubes": "--output", "a b -o c.npy": "argument", "--preset": "argument",
        "--preset tubes --seed x -o a.npy": "(see curvafit generate --help)",
    },
    f"generate {' '.join(LAW)} -o out.npy": {
        "--epsilon 1e30": "epsilon", f"--steps {10**18}": "steps", f"--seed {2**64}": "seed", "--shape 1e9": "memory",
        "--spacing 1e300": "1e+12", "--spacing 1e-300": "1e-12",
        "--orientation 0,0,1,1e30": "orientation", "--snapshots 1e300": "snapshots",
        "--checkpoint-every 5": "--checkpoint",
        "--checkpoint c.pt --checkpoint-every nan": "seconds", "--no-cap": "--no-cap", "--shape 10,10": "--shape",
        "--shape 10.5": "--shape", "--schedule slow": "schedule", "--steps 0": "steps", "--unit mm": "--spacing",
        "--volume-fraction 0.3": "--volume-fraction", "--spacing 1 --unit furlong": "furlong", "--epsilon 0": "epsilon",
        "--spacing 1,2,2": "--spacing",
        "--orientation 1,0,0": "--orientation", "--orientation 0,0,0,5": "direction", "--checkpoint .": "checkpoint",
        "--device abacus": "device", "--maps nowhere.npz": "nowhere.npz", "--preset tubes": "--preset",
    },
    f"generate {' '.join(QUICK)}": {"-o a.xyz": "a.xyz", "-o a.mrc": "unit", "-o torn.json/a.npy": "file"},
    "generate -o out.npy": {
        f"{' '.join(LAW[:2])} --volume-fraction nan": "volume fraction",
        "--coefficients 1e300,0,1e300,0,0,0 --mass 0": "a20", f"--preset {'x' * 5000}": "preset",
        "--preset tu\nbes\x1b[31m\u202e": r"\x1b[31m\u202e", "": "--preset", "--preset other": "bilayers",
        "--preset tube": "did you mean tubes?",
        f"{' '.join(LAW[:2])}": "mass", f"{' '.join(LAW[:2])} --mass -1.5": "mass",
        "--coefficients 1,2,6 --mass -0.6": "--coefficients",
        "--coefficients 1,2,6,-40,nan,400 --mass 0": "--coefficients",
        **{f"--prior {name}.json": f"{name}.json" for name in ("nowhere", "empty", "torn", "other")},
    },
    "infer -o out": {
        "none.tif": "no such file", "scan.xyz": "scan.xyz", "cut.npy": "cut.npy", "flat.npy": "", "four.npy": "",
        "nan.npy": "", "constant.npy": "", "thin.npy": "",
    },
    "infer": {"": "(see curvafit infer --help)", "scan.npy -o scan.xyz": "folder"},
    "infer scan.npy -o out": {
        "--spacing 1,0,1": "--spacing", "--spacing 1,1": "--spacing", "--spacing a": "--spacing",
        "--threshold high": "--threshold", "--raw-shape 4,5": "--raw-shape", "--unit furlong": "unit",
        "--kind drawing": "kind", "--method nearest": "method", "--seed -1": "seed",
        "--kind mask --threshold 4": "threshold",
        "--label 1 --threshold 4": "label", "--atlas nowhere.npz": "atlas", "--roi nowhere.npy": "no such file",
        "--label 77": "label", "--crop 1:4": "crop", "--crop 1:4,:,0:21": "crop", "--channel 0": "channel",
        "--threshold 5": "threshold", "flat.npy": "unexpected extra argument",
    },
    "segment scan.npy -o b.npy --prior tubes": {"--steps 0": "(see curvafit segment --help)"},
    "reconstruct scan.npy --prior tubes -o out.npy": {"--known 0,8 --first 2": "--first"},
    "atlas": {"frob": "(see curvafit atlas --help)"},
    "atlas build s": {
        f"--count {10**9}": "count", "--design wide.yaml": "spread", "--design odd.yaml": "spread",
        f"--workers {10**6}": "workers", "--workers 2 --scheduler tcp://x:1": "scheduler", "--shape 1e5": "memory",
        "--design box.yaml": "a10", "--design laughs.yaml": "", "--design nest.yaml": "", "--design code.yaml": "",
    },
    "synth -o a/set --presets tubes --modality confocal --workers 0 --count 1": {
        "--voxel 1e300": "voxel", "--calibres 1,1e300": "calibres", "--calibres 1,900 --shape 16": "images",
        "--shape 1": "images", "--shape 1e9": "images", "--unit mm": "--unit", "--unit furlong --voxel 1": "furlong",
        "--scheduler tcp://x:1": "scheduler", f"--count {10**9}": "count",
        "--count many": "(see curvafit synth --help)",
        "--volume-fraction nan": "volume fraction",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Volumes that have no shape, and designs that are none."""
    here = tmp_path_factory.mktemp("refused")
    volumes: dict[str, Any] = {
        "scan": np.random.default_rng(0).normal(size=(20, 20, 20)).astype(np.float32),
        "flat": np.zeros((20, 20)), "four": np.zeros((5, 5, 5, 5)), "nan": np.full((20, 20, 20), np.nan),
        "constant": np.ones((20, 20, 20)), "thin": np.indices((30, 30, 30)).sum(0) % 8 == 0,
    }  # fmt: skip
    for name, values in volumes.items():
        np.save(here / f"{name}.npy", values)
    (here / "cut.npy").write_bytes((here / "scan.npy").read_bytes()[:900])
    laughs = "".join(f", &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9))
    texts = {
        "scan.xyz": "12345", "empty.json": "{}", "torn.json": "[1", "other.json": '{"format": "x"}',
        "wide.yaml": "around: tubes\nspread: 1e300\n", "odd.yaml": "around: tubes\nspread: .nan\n",
        "box.yaml": "box:\n  a10: [0, 1e300]\n",
        "laughs.yaml": f"around: tubes\nspread: [&a0 [1, 1]{laughs}]\n",
        "nest.yaml": "box: " + "[" * 3000,
        "code.yaml": "box: !!python/object/apply:os.system ['touch ran']\n",
    }  # fmt: skip
    for name, text in texts.items():
        (here / name).write_text(text)
    return here


@pytest.mark.parametrize("command", REFUSALS)
def test_a_refusal_is_one_sentence_and_nothing_is_begun(
    folder: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    for words, key in REFUSALS[command].items():
        refused(call(*command.split(), *words.split(" ") if words else ()), key, progress=True)
        assert sorted(folder.iterdir()) == before, words


def test_a_set_without_any_case_is_removed(tmp_path: Path) -> None:
    """All that such images show of the stored shapes is background."""
    store = exact_store(tmp_path / "s", 1).path
    words = ["synth", "--atlas", store, "--modality", "confocal", "--workers", "0", "--shape", "1,1,2", "--voxel", 0.5]
    result = call(*words, "-o", tmp_path / "a" / "set")
    assert result.exit_code == 2 and "error: " in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
    (tmp_path / "mine").mkdir()
    assert call(*words, "-o", tmp_path / "mine").exit_code == 2
    assert list((tmp_path / "mine").iterdir()) == []


# ---- infer -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def finding(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Puts a made inference in the place of the real one, and keeps what it was called with."""
    without_drawing(monkeypatch)
    calls: dict[str, Any] = {}

    def find(scan: str, *, progress: Any, **given: Any) -> Any:
        progress("reading the scan", 0.0)
        calls.update(scan=scan, **given)
        return made_inference()

    monkeypatch.setattr(importlib.import_module("curvafit.inference.inference"), "infer", find)
    return calls


def test_infer_writes_three_files_and_says_what_it_found(tmp_path: Path, finding: dict[str, Any]) -> None:
    """And hands every option on."""
    (tmp_path / "scan.h5").touch()
    scan = f"{tmp_path / 'scan.h5'}::raw"
    result = done("infer", scan, "-o", tmp_path / "out", "--spacing", "2,1,1", "--unit", "um", "--dark")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["fit.json", "regenerated.nii.gz", "report.html"]
    lines = result.stdout.splitlines()
    assert lines[0].startswith("Tubes, radius") and lines[-1] == str(tmp_path / "out" / "report.html")
    assert re.search(r"a11 +1\.80 +0\.40 +\S+ to \S+ +1\.80", result.stdout)
    assert re.search(r"a10 +-38\.5 +6\.0 +\S+ to \S+ +-19\.7 1/mm", result.stdout)
    assert "[  0 %] reading the scan" in result.stderr
    assert finding["scan"] == scan and finding["spacing"] == (2.0, 1.0, 1.0)
    assert finding["unit"] == "um" and finding["dark"] is True and finding["threshold"] == "otsu"
    options = "--kind mask --periodic --threshold -12.5 --label 3 --raw-shape 4,5,6 --dtype u1 --key k --seed 9"
    options += " --channel 2 --crop 1:3,:,-4: --method match"
    scan, roi = tmp_path / "a.raw", tmp_path / "r.npy"
    for file in (scan, roi):
        file.touch()
    done("infer", scan, "-o", tmp_path / "more", *options.split(), "--spacing", "0.5", "--roi", roi)
    wanted = {"kind": "mask", "periodic": True, "threshold": -12.5, "label": 3, "raw_shape": (4, 5, 6), "dtype": "u1"}
    wanted |= {"key": "k", "seed": 9, "spacing": (0.5, 0.5, 0.5), "roi": roi, "atlas": None}
    wanted |= {"channel": 2, "crop": "1:3,:,-4:", "method": "match"}
    assert {name: finding[name] for name in wanted} == wanted


# ---- interruptions, mistakes, lines ----------------------------------------------------------------------------------


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


def test_a_line_tells_the_time_that_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = iter((0.0, 10.0, 60.0, 150.0, 240.0))
    monkeypatch.setattr("time.monotonic", lambda: next(seconds))
    with show_stages() as progress:
        for text, share in (("reading", 0.1), ("growing", 0.2), ("testing", 0.5), ("drawing", 0.9)):
            progress(text, share)
    told = ["reading", "growing, about 4 min left", "testing, about 2 min left", "drawing, under a minute left"]
    assert [line.partition("] ")[2] for line in capsys.readouterr().err.splitlines()] == told


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
    with pytest.raises(OSError, match="gone"), show_stages() as progress:
        progress("reading", 0.0)
        raise OSError("gone")
    assert capsys.readouterr().err == ""
    with show_stages() as progress:
        progress("reading", 0.0)
    assert capsys.readouterr().err == "[  0 %] reading\n"


def test_a_sentence_is_one_line_that_shows() -> None:
    assert sentence("a\n b\tc") == "error: a b c"
    assert sentence("\x1b[2J \u202e \ud800", "note") == r"note: \x1b[2J \u202e \ud800"
    assert sentence("κ1 ≥ κ2, é") == "error: κ1 ≥ κ2, é"
    assert len(sentence("expected " + "x" * 10**6)) < LONGEST + 20
    writable("\udcff é", error_console()).encode(error_console().encoding)


def test_a_file_that_is_not_there_is_named_before_slow_imports() -> None:
    with pytest.raises(FileNotFoundError, match="no such file: mixt"):
        _check_inputs({"example": "mixt"})
