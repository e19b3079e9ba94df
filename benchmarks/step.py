"""A step of the H⁻¹ flow: fused against plain torch, and the floor that its bytes set.

The two programs take turns, so that a busy machine slows both, in a process of their own, under the allocator's
defaults, which give large arrays back to the system at each step. The floor is the time that the bytes which the fused
step must move take at the bandwidth of a plain copy, the best seen in the same rounds: from main memory no step is
faster than that.

`--author FOLDER` names a checkout of the paper's program (github.com/annasongmaths/curvatubes, MIT; it needs matplotlib
and nibabel): its step on this processor, by turns with ours, in processes of their own. It asks for a GPU, so its types
and transfers are replaced by those of a processor; nothing else is changed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.harness import Cases, Figure, in_turns, run_python, show
from curvafit.generation.problem import Cost, DivergenceForm, white_noise
from curvafit.generation.schedule import SCHEDULES
from curvafit.generation.stepper import ADAM_EPS, TorchStepper
from curvafit.priors import kernels
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.cpu import FusedFlow
from curvafit.priors.law import preset

BLUR = 0.02
#: Floats of the array that is copied to measure bandwidth: more than any cache holds.
COPIED = 2**26
#: The largest cube for plain torch, which takes some 0.3 µs and 700 bytes a voxel.
PLAIN = 200
#: Rounds, and voxels that a measurement steps through, about: larger cubes get fewer rounds.
ROUNDS, WORK = 10, 10**8
#: The edge of the paper's shapes.
PUBLISHED = 100
#: Bytes a voxel that a step must move: floats read and written by the blur, the energy, its blur, Adam and blurs.
BYTES = 4 * (2 + 2 + 2 + 20)


def fused_flow(size: int) -> FusedFlow:
    """Return the fused flow of the preset tubes on a cube."""
    grid, shape = Grid((size, size, size)), preset("tubes")
    a, betas = [float(value) for value in shape.coefficients], SCHEDULES["fast"].betas_at(0)
    start = white_noise(grid, 0).numpy()
    return FusedFlow(start, shape.mass, a, grid, WORKING_EPSILON, BLUR, betas=betas, adam_eps=ADAM_EPS)


def plain_stepper(size: int) -> TorchStepper:
    """Return the same flow in plain torch."""
    grid, shape = Grid((size, size, size)), preset("tubes")
    form, betas = DivergenceForm(grid, BLUR, shape.mass), SCHEDULES["fast"].betas_at(0)
    cost = Cost(shape.coefficients, grid, WORKING_EPSILON, None, BLUR)
    return TorchStepper(white_noise(grid, 0), form, cost, betas, "cpu")


def measure(size: int, rounds: int) -> dict[str, float]:
    """Return the median milliseconds of both programs, and GB/s of a copy."""

    def step(flow: FusedFlow) -> None:
        flow.evaluate()
        flow.update(1e-3)

    step(fused_flow(8))
    fused, source = fused_flow(size), torch.ones(COPIED)
    target = source.clone()
    actions: dict[str, Callable[[], object]] = {"fused": lambda: step(fused), "copy": lambda: target.copy_(source)}
    if size <= PLAIN:
        plain = plain_stepper(size)
        # A plain step leaves the caches full: the fused one before the measured one fills them anew.
        actions = {"plain": lambda: plain.step(1e-3), "again": actions["fused"], **actions}
    with patch.object(kernels, "has_kernel", return_value=False):
        times = in_turns(actions, max(2, min(rounds, WORK // size**3)))
    found = {name: 1e3 * float(np.median(times[name])) for name in ("fused", "plain") if name in times}
    return found | {"GB/s": 2e-9 * source.nbytes / float(times["copy"].min())}


def apart(size: int, rounds: int) -> dict[str, float]:
    """Measure in a process of its own."""
    script = f"import json; from benchmarks.step import measure; print(json.dumps(measure({size}, {rounds})))"
    return json.loads(run_python("-c", script).splitlines()[-1])


#: The paper's program on a processor: the median milliseconds of a step, between two updates by Adam.
AUTHOR = """
import json, sys, time, matplotlib
matplotlib.use("Agg")
import numpy as np, torch
torch.cuda.FloatTensor = torch.FloatTensor
torch.Tensor.cuda = torch.nn.Module.cuda = lambda self, *others: self
from cvtub import generator
times, step = [], torch.optim.Adam.step
def timed(self, *others):
    times.append(time.perf_counter())
    return step(self, *others)
torch.optim.Adam.step = timed
generator.slices = generator.plt.show = lambda *others, **more: None
folder, edge = sys.argv[1], int(sys.argv[2])
start = 40 * 0.01 * torch.rand((3, edge, edge, edge))
plan = dict(maxeval=24, sigma_blur=2, display_it_nb=10**9, fill_curve_nb=1, betas=(0.9, 0.999), lr=1e-3, eps_adam=1e-2,
            weight_decay=0, amsgrad=False)
generator._generate_shape(start, (0.02, 1, 2, 6, -40, -40, 400), 0.01, 1e-6, "adam", plan, "cons", "periodic", M0=-0.6,
                          snapshot_folder=folder + "/", display_all=False)
print(json.dumps(1e3 * float(np.median(np.diff(times)[4:]))))
"""


def author(folder: str, size: int, rounds: int = 3) -> dict[str, float]:
    """Return the milliseconds of a step of the paper's program and of ours, medians of turns."""
    found: dict[str, list[float]] = {"author": [], "ours": []}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as results:
            Path(results, "Curves").mkdir()
            printed = run_python("-c", AUTHOR, results, size, PYTHONPATH=str(Path(folder).resolve()))
        found["author"].append(json.loads(printed.splitlines()[-1]))
        found["ours"].append(apart(size, 4)["fused"])
    return {name: float(np.median(times)) for name, times in found.items()}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sizes", default="64,100")
    parser.add_argument("--author", metavar="FOLDER", help="of the paper's program, to run beside ours at 100³")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.author is not None:
        ms = cases.all({f"author-{PUBLISHED}": lambda: author(options.author, PUBLISHED)})[f"author-{PUBLISHED}"]
        figures = {"step.author": Figure(ms["author"] / ms["ours"]), "step.author_ms": Figure(ms["author"])}
        # 8000 steps, as published: 150 s on a GPU.
        figures |= {"step.shape_seconds": Figure(8 * ms["ours"]), "step.published": Figure(150 / (8 * ms["ours"]))}
        show(["a step at 100³", "figure"], list(figures.items()), f"{torch.get_num_threads()} threads")
        return figures
    sizes = [32] if options.quick else [int(size) for size in options.sizes.split(",")]
    found = cases.all({f"{size}-default": lambda size=size: apart(size, ROUNDS) for size in sizes})
    figures: dict[str, Figure] = {}
    for name, ms in found.items():
        floor = BYTES * int(name.partition("-")[0]) ** 3 / ms["GB/s"] / 1e6
        figures |= {f"step.ms.{name}": Figure(ms["fused"]), f"step.floor.{name}": Figure(ms["fused"] / floor)}
        if "plain" in ms:
            figures[f"step.ratio.{name}"] = Figure(ms["plain"] / ms["fused"])
    show(["a step", "figure"], list(figures.items()), f"{torch.get_num_threads()} threads")
    return figures
