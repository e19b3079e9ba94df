"""A step of the H⁻¹ flow: fused against plain torch, and the floor that its bytes set.

The two programs take turns, so that a busy machine slows both, in a process of their own, under the allocator's
defaults, which give large arrays back to the system at each step. The floor is the time that the bytes which the fused
step must move take at the bandwidth of a plain copy, the best seen in the same rounds: from main memory no step is
faster than that.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.harness import Cases, Figure, in_turns, run_python, show
from curvafit.generation.problem import Cost, DivergenceForm, white_noise
from curvafit.generation.schedule import SCHEDULES
from curvafit.generation.stepper import ADAM_EPS, TorchStepper
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
    return TorchStepper(white_noise(grid, 0), form, cost, betas, None, "cpu")


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
    times = in_turns(actions, max(2, min(rounds, WORK // size**3)))
    found = {name: 1e3 * float(np.median(times[name])) for name in ("fused", "plain") if name in times}
    return found | {"GB/s": 2e-9 * source.nbytes / float(times["copy"].min())}


def apart(size: int, rounds: int) -> dict[str, float]:
    """Measure in a process of its own."""
    script = f"import json; from benchmarks.step import measure; print(json.dumps(measure({size}, {rounds})))"
    return json.loads(run_python("-c", script).splitlines()[-1])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sizes", default="64,100")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
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
