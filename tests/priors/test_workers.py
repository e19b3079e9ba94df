"""The loss beside kernels elsewhere: in a loader's workers by every start method, and in several Python threads."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: A loss on two of numba's threads, and data whose shapes workers grow.
TRAINING = """
import sys
import torch
from curvafit.data_synth import TextureDataset, as_dict
from curvafit.priors import CurvaturePrior

prior = CurvaturePrior("tubes", sigmoid=True)

def look(batch):
    (prior(torch.randn(1, 1, 48, 48, 48, requires_grad=True)) + batch["image"].mean()).backward()

if __name__ == "__main__":
    for workers, persistent in ((1, False), (2, True)):
        options = {"num_workers": workers, "persistent_workers": persistent, "multiprocessing_context": sys.argv[1]}
        look({"image": torch.zeros(1)})
        data = TextureDataset("tubes", "micro-ct", 24, length=2, shapes=1, transform=as_dict)
        loader = torch.utils.data.DataLoader(data, batch_size=1, **options)
        for epoch in range(2):
            for batch in loader:
                look(batch)
    from curvafit.priors.kernels.threads import count_threads
    print("threads", count_threads())
"""


def run(program: str, folder: Path, *arguments: str, **environment: str) -> str:
    """The last line that a program prints; it runs in a process of two threads."""
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)} | environment
    threads["MKL_NUM_THREADS"] = threads["OMP_NUM_THREADS"]  # torch follows MKL's number, which dask sets to 1
    path = folder / "program.py"
    path.write_text(program)
    command = [sys.executable, str(path), *arguments]
    done = subprocess.run(command, env=os.environ | threads, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn", "forkserver"])
def test_workers_grow_shapes_beside_the_loss(start, tmp_path) -> None:
    """One worker, and two that persist, two epochs each; the main process keeps its threads."""
    if start not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this platform has no {start}")
    assert run(TRAINING, tmp_path, start) == "threads 2"


THREADS = """
import threading, torch, numba
from curvafit.priors import CurvaturePrior

prior, values = CurvaturePrior("tubes", sigmoid=True), []
x = torch.randn(1, 1, 48, 48, 48, generator=torch.Generator().manual_seed(0))

def work():
    for _ in range(5):
        leaf = x.clone().requires_grad_()
        value = prior(leaf)
        value.backward()
        values.append((float(value.detach()), float(leaf.grad.double().norm())))

crew = [threading.Thread(target=work) for _ in range(3)]
[each.start() for each in crew]
[each.join() for each in crew]
started = getattr(numba.np.ufunc.parallel, "_is_initialized")
print(len(values), len(set(values)), started)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "started"),
    [({"NUMBA_THREADING_LAYER": "workqueue"}, True), ({"OMP_NUM_THREADS": "1"}, False)],
    ids=["one caller at a time", "torchrun's"],
)
def test_several_threads_may_call_the_loss(environment, started, tmp_path) -> None:
    """On numba's queue, which serves one caller at a time; and with one thread, where numba starts none."""
    assert run(THREADS, tmp_path, **environment) == f"15 1 {started}"


FORKED = """
import multiprocessing
import numpy as np
from curvafit.priors import Grid
from curvafit.priors.kernels.cpu import fused_energy_gradient
from curvafit.priors.kernels.threads import count_threads

grid = Grid((48, 48, 48))
u = np.random.default_rng(0).standard_normal(grid.shape).astype(np.float32)

def work(queue):
    queue.put((count_threads(), fused_energy_gradient(u, (1, 2, 6, -40, -40, 400), grid, 0.02)[0]))

context = multiprocessing.get_context("fork")
queue = context.Queue()
work(queue)
child = context.Process(target=work, args=(queue,))
child.start()
(here, value), (there, same) = queue.get(), queue.get()
print(here, there, abs(value / same - 1) < 1e-5)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this platform has no fork")
def test_a_forked_process_takes_one_thread(tmp_path) -> None:
    """Whatever torch's number is there; the energies' sums have one order."""
    assert run(FORKED, tmp_path) == "2 1 True"
