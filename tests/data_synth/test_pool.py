"""A pool: each shape grown once, by whoever wants it first, for all workers and epochs."""

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from pool_run import SHAPES, balls

from curvafit.data_synth import sources

SCRIPT = Path(__file__).parents[1] / "pool_run.py"


def start(*arguments: object, **room: str) -> subprocess.Popen[str]:
    room = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"} | room
    command, pipe = [sys.executable, str(SCRIPT), *map(str, arguments)], subprocess.PIPE
    return subprocess.Popen(command, env=room, text=True, stdout=pipe, stderr=pipe, start_new_session=os.name != "nt")


def grown(log: Path) -> list[int]:
    return sorted(int(line.split()[0]) for line in log.read_text().splitlines())


@pytest.mark.slow
@pytest.mark.parametrize(("method", "persistent"), [("fork", 0), ("spawn", 1)])
def test_workers_and_epochs_share_shapes(tmp_path, method, persistent):
    """Two workers, which stay or are new in each of two epochs, grow no shape twice."""
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system has no {method}")
    run = start(method, 2, persistent, tmp_path / "log")
    alone = balls(str(tmp_path / "other"))
    expected = sorted(alone[k] for k in range(24))
    out, errors = run.communicate()
    assert run.returncode == 0, errors
    found = json.loads(out)
    assert grown(tmp_path / "log") == list(range(SHAPES)) and f"{SHAPES} of {SHAPES} shapes grown" in errors
    assert found["samples"] == expected
    assert found["there"] and not Path(found["room"]).exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C of a terminal goes to a group of processes")
def test_an_interrupted_training_leaves_nothing(tmp_path):
    log, temporary = tmp_path / "log", tmp_path / "temporary"
    temporary.mkdir()
    run = start("fork", 2, 0, log, TMPDIR=str(temporary))
    while not log.exists() and run.poll() is None:
        time.sleep(0.05)
    assert list(temporary.glob("*"))
    os.killpg(run.pid, signal.SIGINT)
    assert "KeyboardInterrupt" in run.communicate()[1]
    assert not list(temporary.glob("*"))


def test_threads_and_other_sets_share_shapes(tmp_path, capsys):
    first = balls(str(tmp_path / "log"))
    others = [first, pickle.loads(pickle.dumps(first)), balls(str(tmp_path / "log"))]
    with ThreadPoolExecutor(3) as crew:
        samples = list(crew.map(lambda pairs: [pairs[k] for k in range(8)], others))
    assert samples[0] == samples[1] == samples[2]
    assert grown(tmp_path / "log") == sorted(set(grown(tmp_path / "log")))
    assert "shapes grown" in capsys.readouterr().err
    assert [first[k] for k in range(8)] == samples[0]
    assert not capsys.readouterr().err  # what is there is read in silence


@pytest.mark.parametrize("fault", ["read-only", "full"])
def test_without_room_a_process_keeps_its_own_shapes(tmp_path, monkeypatch, fault):
    def refuse(*arguments: object, **options: object) -> str:
        raise OSError(28, "No space left on device")

    expected = [balls(str(tmp_path / "log"))[k] for k in range(4)]
    monkeypatch.setattr(sources, "get_temp_dir" if fault == "read-only" else "write_content", refuse)
    pairs = balls(str(tmp_path / "own"))
    with pytest.warns(UserWarning, match="each process grows its own"):
        assert [pairs[k] for k in range(4)] == expected
    assert grown(tmp_path / "own") == grown(tmp_path / "log")
