"""The quick part of the hostile suite, in a process of its own: nothing lost, torn, misread, hung or left unsaid."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="cases are forked from a warm process")

from .catalogue import SHARES

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="cases are forked from a warm process"),
]


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What went wrong, by class: the command that plays a case again, and what was found."""
    report = tmp_path_factory.mktemp("hostile") / "report.json"
    command = [sys.executable, "-m", "tests.hostile", "--quick", "--report", str(report)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert report.is_file(), done.stdout + done.stderr
    found: dict[str, list[str]] = {}
    for row in json.loads(report.read_text()):
        said = "; ".join(f"{fault['column']}: {fault['said']}" for fault in row["faults"])
        found.setdefault(row["class"], []).append(f"{row['again']}: {said}")
    assert (done.returncode == 0) == (not found), done.stdout + done.stderr
    return found


@pytest.mark.parametrize("kind", SHARES)
def test_nothing_goes_wrong(wrong: dict[str, list[str]], kind: str) -> None:
    assert wrong.get(kind, []) == []
