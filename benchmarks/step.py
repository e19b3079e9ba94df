"""A step of the H⁻¹ flow: fused against plain torch, the time of each pass, memory.

The two programs take turns, so that a busy machine slows both. Plain torch is measured under the default allocator,
which gives large arrays back to the system at each step, and under one that keeps them. The floor is the time that the
bytes which the fused step must move take at the bandwidth of a plain copy, the best seen in the same rounds: from main
memory no step is faster than that.
"""

from __future__ import annotations

import argparse
import json
import tracemalloc

import numpy as np
import torch

from benchmarks.harness import Cases, Figure, in_turns, run_python, show
from curvafit.generation.forms import DivergenceForm, white_noise
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
#: Voxels that a measurement steps through, about: larger cubes get fewer rounds.
WORK = 10**8
#: Bytes a voxel that each pass must move: floats read and written.
PASSES = {"blur z": 4 * 2, "energy": 4 * 2, "gradient's blur z": 4 * 2, "Adam and blurs": 4 * (1 + 2 * 9 + 1)}
#: Allocators: what glibc is told.
ALLOCATORS = {
    "default": {},
    "kept": {"MALLOC_MMAP_THRESHOLD_": "4000000000", "MALLOC_TRIM_THRESHOLD_": "8000000000"},
}


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
    return TorchStepper(white_noise(grid, 0), form, shape.coefficients, WORKING_EPSILON, betas, None, "cpu")


def measure(size: int, rounds: int) -> dict[str, float]:
    """Return milliseconds (medians, and `least`) of both programs and of each pass; GB/s of a copy; bytes a voxel."""

    def step(flow: FusedFlow) -> None:
        flow.evaluate()
        flow.update(1e-3)

    step(fused_flow(8))
    tracemalloc.start()
    fused = fused_flow(size)
    step(fused)
    peak = (tracemalloc.get_traced_memory()[1] + fused.vector.nbytes) / size**3
    tracemalloc.stop()
    source = torch.ones(COPIED)
    target = source.clone()
    passes = (fused.blur_along_z, fused.fill_gradient, fused.blur_gradient_along_z, lambda: fused.blur_adam(1e-3))
    actions = {"fused": lambda: step(fused), "copy": lambda: target.copy_(source)}
    actions |= dict(zip(PASSES, passes, strict=True))
    if size <= PLAIN:
        plain = plain_stepper(size)
        # A plain step leaves the caches full: the fused one before the measured one fills them anew.
        actions = {"plain": lambda: plain.step(1e-3), "again": actions["fused"], **actions}
    times = in_turns(actions, max(2, min(rounds, WORK // size**3)))
    found = {name: 1e3 * float(np.median(taken)) for name, taken in times.items() if name not in ("copy", "again")}
    found |= {f"{name}, least": 1e3 * float(times[name].min()) for name in ("fused", "plain") if name in times}
    return found | {"GB/s": 2e-9 * source.nbytes / float(times["copy"].min()), "bytes a voxel": peak}


def apart(size: int, rounds: int, allocator: str) -> dict[str, float]:
    """Measure in a process of its own, under an allocator."""
    script = f"import json; from benchmarks.step import measure; print(json.dumps(measure({size}, {rounds})))"
    return json.loads(run_python("-c", script, **ALLOCATORS[allocator]).splitlines()[-1])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sizes", default="64,100")
    parser.add_argument("--rounds", type=int, default=10)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    sizes = [32] if options.quick else [int(size) for size in options.sizes.split(",")]
    jobs = {
        f"{size}-{name}": lambda s=size, a=name: apart(s, options.rounds, a) for size in sizes for name in ALLOCATORS
    }
    found = cases.all(jobs)
    rows, figures = [], {}
    for name, ms in found.items():
        voxels = int(name.split("-")[0]) ** 3
        floor = sum(PASSES.values()) * voxels / ms["GB/s"] / 1e6
        ratio = Figure(ms["plain"] / ms["fused"]) if "plain" in ms else None
        least = ms["plain, least"] / ms["fused, least"] if ratio else ""
        rows.append(
            [name, ms.get("plain", ""), ms["fused"], ratio or "", least, ms["fused"] / floor, ms["bytes a voxel"]]
        )
        if ratio:
            figures[f"step.ratio.{name}"] = ratio
        figures[f"step.floor.{name}"] = Figure(ms["fused"] / floor)
        figures[f"step.ms.{name}"] = Figure(ms["fused"])
    columns = ["size, allocator", "plain ms", "fused ms", "ratio", "of the least", "over floor", "bytes a voxel"]
    show(columns, rows, f"a step, {torch.get_num_threads()} threads")
    show(["size, allocator", *PASSES], [[name, *(ms[part] for part in PASSES)] for name, ms in found.items()])
    return figures
