"""Nothing of the program that calls is changed: threads, random numbers, precision, warnings, environment, the rest."""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import host_state
import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
NAMES = list(host_state.calls(Path(tempfile.gettempdir())))


def run(*arguments: str) -> str:
    """The last line that a Python program prints, in a process of its own."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    own = {"PYTHONPATH": path, "NUMBA_NUM_THREADS": str(host_state.NUMBA_THREADS)}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, env=os.environ | own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def found() -> dict[str, dict]:
    """What each call changed, all made in one process."""
    return json.loads(run(str(ROOT / "tests" / "host_state.py")))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_call_changes_nothing_of_the_host(name: str, found) -> None:
    if name == "infer" and importlib.util.find_spec("optimistix") is None:
        pytest.skip("needs optimistix")
    assert found[name] == {}


def test_a_change_is_seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The snapshot's own test: of what may be changed and put back here."""
    before = host_state.snapshot()
    assert host_state.changes(before, host_state.snapshot()) == {}
    monkeypatch.setenv("CURVAFIT_TEST", "1")
    monkeypatch.chdir(tmp_path)
    with torch.random.fork_rng(), torch.no_grad():
        torch.rand(1)
        changed = host_state.changes(before, host_state.snapshot())
    assert {"torch random", "torch gradients", "process environment", "process folder"} <= set(changed)


SETTLED = """
import multiprocessing, torch
from curvafit.priors import CurvaturePrior
CurvaturePrior("tubes")(torch.rand(1, 1, 8, 8, 8))
multiprocessing.set_start_method("spawn")
print(multiprocessing.get_start_method())
"""


@pytest.mark.slow
def test_a_program_may_choose_how_processes_start_afterwards() -> None:
    assert run("-c", SETTLED) == "spawn"
