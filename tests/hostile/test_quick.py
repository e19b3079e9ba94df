"""The quick part of the hostile suite, in a process of its own: nothing lost, torn, misread, hung or left unsaid."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="cases are forked from a warm process")

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="cases are forked from a warm process"),
]


def test_nothing_goes_wrong(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "tests.hostile", "--quick", "--report", str(report)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert report.is_file(), done.stdout + done.stderr
    found = {
        row["again"]: "; ".join(f"{fault['column']}: {fault['said']}" for fault in row["faults"])
        for row in json.loads(report.read_text())
    }
    assert found == {}
    assert done.returncode == 0, done.stdout + done.stderr
