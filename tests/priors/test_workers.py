"""The loss beside kernels elsewhere: in a loader's workers by both start methods, and in several Python threads."""

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
data = TextureDataset("tubes", "micro-ct", 24, length=2, shapes=1, transform=as_dict)

def look(batch):
    return prior(torch.randn(1, 1, 48, 48, 48, requires_grad=True)) + batch["image"].mean()

def main(start):
    for workers, persistent in (((1, False), (2, True)) if start == "fork" else ((2, True),)):
        options = {"num_workers": workers, "persistent_workers": persistent, "multiprocessing_context": start}
        look({"image": torch.zeros(1)}).backward()
        train(options)
    from curvafit.priors.kernels.threads import count_threads
    print("threads", count_threads())

def train(options):
    loader = torch.utils.data.DataLoader(data, batch_size=1, **options)
    for epoch in range(2):
        for batch in loader:
            look(batch).backward()

if __name__ == "__main__":
    main(sys.argv[1])
"""


def run(program: Path, *arguments: str, **environment: str) -> tuple[str, str]:
    """The last line that a program prints, and all that it says beside; it runs in a process of two threads."""
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)} | environment
    threads["MKL_NUM_THREADS"] = threads["OMP_NUM_THREADS"]  # torch follows MKL's number, which dask sets to 1
    command = [sys.executable, str(program), *arguments]
    done = subprocess.run(command, env=os.environ | threads, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1], done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_grow_shapes_beside_the_loss(start, tmp_path) -> None:
    """Two workers that persist, and forked also one that does not; the main process keeps its threads."""
    if start not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this platform has no {start}")
    program = tmp_path / "train.py"
    program.write_text(TRAINING)
    assert run(program, start)[0] == "threads 2"


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
    program = tmp_path / "threads.py"
    program.write_text(THREADS)
    assert run(program, **environment)[0] == f"15 1 {started}"


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
    program = tmp_path / "forked.py"
    program.write_text(FORKED)
    assert run(program)[0] == "2 1 True"


FIRST = """
import importlib.util, logging, sys
if "bare" in sys.argv:
    find = importlib.util.find_spec
    importlib.util.find_spec = lambda name, *rest: None if name == "numba" else find(name, *rest)
import torch
from curvafit.priors import CurvaturePrior

for _ in range(2):
    CurvaturePrior("tubes", sigmoid=True)(torch.zeros(1, 1, 8, 8, 8, requires_grad=True)).backward()
print("done")
"""


@pytest.mark.slow
def test_what_takes_long_is_logged_once(tmp_path) -> None:
    """That the kernels are being compiled, where no cache has them; that there are none."""
    program, cache = tmp_path / "first.py", str(tmp_path / "cache")
    program.write_text(FIRST)
    said = [run(program, *bare, NUMBA_CACHE_DIR=cache)[1] for bare in ([], [], ["bare"])]
    assert [text.count("compiling") for text in said] == [1, 0, 0]
    assert [text.count("numba is not installed") for text in said] == [0, 0, 1]
