"""The benchmark on a GPU, as far as none is needed: the refusal, the file of its figures, and their table."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from benchmarks import gpu_parts

ROOT = Path(__file__).parent.parent
ABOUT = {"device": "some GPU", "driver": "1", "torch": "2", "triton": "3", "commit": "abc"}


def run(*options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.gpu", *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_without_a_device_it_says_so() -> None:
    done = run("--all")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr == "no GPU: this benchmark needs an NVIDIA device, and a torch that brings triton\n"


def test_figures_are_kept_and_what_failed_is_tried_again(tmp_path: Path) -> None:
    """After each part; figures of another machine are not taken for this one's."""
    path, calls = tmp_path / "gpu.json", []

    def first() -> dict[str, float]:
        calls.append("first")
        return {"ms": 1.25}

    def second() -> dict[str, float]:
        calls.append("second")
        assert json.loads(path.read_text())["parts"]["first"] == {"ms": 1.25}
        if calls.count("second") == 1:
            raise RuntimeError("out of memory")
        return {"times": 20}

    parts = {"first": first, "second": second}
    assert gpu_parts.measure(path, ABOUT, parts)["parts"]["second"] == {"failed": "RuntimeError: out of memory"}
    record = gpu_parts.measure(path, ABOUT, parts)
    assert calls == ["first", "second", "second"] and record == json.loads(path.read_text())
    assert gpu_parts.table(record).splitlines() == [
        "some GPU, driver 1, torch 2, triton 3, commit abc",
        "",
        "| what | figure |",
        "|---|---|",
        "| first | ms 1.25 |",
        "| second | times 20 |",
    ]
    assert run("--table", str(path)).stdout == gpu_parts.table(record) + "\n"
    gpu_parts.measure(path, {**ABOUT, "commit": "def"}, {"first": first})
    assert calls[3:] == ["first"]
