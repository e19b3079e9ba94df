"""One shape over several processes: each voxel is that of one process."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.generation.slabs import divide
from curvafit.priors.grid import Grid
from curvafit.priors.kernels.cpu import halo

ROOT = Path(__file__).resolve().parents[2]


def start(count: int, *command: str) -> list[subprocess.Popen]:
    """Start a command as `torchrun` would."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    common = {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1"}
    common |= {"MASTER_PORT": str(port), "PYTHONPATH": path}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return [
        subprocess.Popen([sys.executable, *command], env=os.environ | common | {"RANK": str(k)}, **pipes)
        for k in range(count)
    ]


@pytest.mark.parametrize(("count", "shape", "boundary"), [(2, "32,24,24", "periodic"), (3, "48,24,20", "replicate")])
def test_slabs_are_one_box_bit_for_bit(count: int, shape: str, boundary: str, tmp_path: Path) -> None:
    processes = start(count, str(ROOT / "tests" / "slabs_run.py"), str(tmp_path), shape, boundary)
    ends = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0] * count, ends
    found = json.loads(ends[0][0].splitlines()[-1])
    assert found["field"] and all(found["snapshots"])
    assert found["figures"] < 1e-12
    assert found["onward"]
    assert found["moved"] > 0.1


def test_a_process_that_dies_ends_the_flow_in_a_sentence(tmp_path: Path) -> None:
    out = tmp_path / "shape.npy"
    options = ("--preset", "tubes", "--shape", "48", "--no-picture", "--checkpoint", str(tmp_path / "run.pt"))
    first, second = start(2, "-m", "curvafit", "generate", *options, "--checkpoint-every", "0", "-o", str(out))
    saved = time.monotonic() + 200
    while not (tmp_path / "run.pt").exists() and time.monotonic() < saved and first.poll() is None:
        time.sleep(0.1)
    second.kill()
    _, complaint = first.communicate(timeout=200)
    second.communicate()
    assert first.returncode == 2, complaint
    assert "a process of the flow is gone" in " ".join(complaint.split())
    assert not out.exists()


@given(st.integers(2, 6), st.integers(10, 40), st.integers(0, 5), st.sampled_from(["periodic", "replicate"]))
@settings(deadline=None)
def test_each_plane_is_one_processs_own_and_its_neighbours_beyond(
    count: int, planes: int, more: int, boundary: str
) -> None:
    grid = Grid((count * planes + more, 4, 4), boundary=boundary)  # type: ignore[arg-type]
    reach = min(planes, halo(grid, 0.02))
    slabs = divide(grid, count, reach)
    owned = np.concatenate([slab.places[slab.own] for slab in slabs])
    assert owned.tolist() == list(range(grid.shape[0]))
    for k, slab in enumerate(slabs):
        before, after = slabs[k - 1], slabs[(k + 1) % count]
        assert slab.places[slab.below].tolist() == before.places[before.own][-reach:].tolist()
        assert slab.places[slab.above].tolist() == after.places[after.own][:reach].tolist()
        assert len(slab.places) == slab.last - slab.first + 2 * reach
