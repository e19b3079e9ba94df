"""A step of the H⁻¹ Adam flow: fused against plain torch, where the fused step's time goes, and its memory.

    python -m benchmarks.step [--sizes 64,100,200,400] [--rounds 12] [--threads N]

The two programs alternate in one run, so that a busy machine slows both; medians over the rounds, and the least. The
breakdown gives for each pass the bytes a voxel that it must move (each array read or written once) and the time that
moving them takes at the bandwidth of a plain copy, the best seen in the same rounds: from main memory the pass cannot
be faster than that (from the cache it can). Bytes a voxel at peak are those of all arrays alive at once, from the
start's making to the end of the first step.
"""

from __future__ import annotations

import argparse
import platform
import re
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding as llvm
import numba
import numpy as np
import torch
from numba.core import config

from curvafit.generation.initial import white_noise
from curvafit.generation.parametrization import DivergenceForm
from curvafit.generation.schedule import SCHEDULES
from curvafit.generation.stepper import ADAM_EPS, TorchStepper
from curvafit.priors.coefficients import preset
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels import loops
from curvafit.priors.kernels.cpu import FusedFlow

BLUR = 0.02
#: Floats of the array that is copied to measure bandwidth: more than any cache holds.
COPIED = 2**26
#: The largest cube for plain torch, which takes some 0.3 µs and 700 bytes a voxel.
PLAIN = 200
#: Voxels that a benchmark steps through, about: larger cubes get fewer repetitions.
WORK = 10**8
#: Bytes a voxel that each pass must move: floats read and written.
PASSES = {
    "blur along z": 4 * 2,
    "energy and gradient": 4 * 2,
    "gradient's blur along z": 4 * 2,
    "blur along y and x, -∇, Adam, div A, blur": 4 * (1 + 2 * 9 + 1),
}


@dataclass(frozen=True)
class Timing:
    """Seconds of each repetition."""

    seconds: list[float]

    @property
    def median(self) -> float:
        return 1e3 * float(np.median(self.seconds))

    @property
    def least(self) -> float:
        return 1e3 * min(self.seconds)


class Comparison(NamedTuple):
    """Timings of the plain step (empty where it was skipped), the fused step and its passes; the copy's bandwidth in
    bytes a second; bytes at peak of the fused flow."""

    plain: Timing
    fused: Timing
    parts: dict[str, Timing]
    bandwidth: float
    peak: int


def fused_flow(size: int) -> FusedFlow:
    """Make the flow of the benchmark on a cube."""
    grid, shape = Grid((size, size, size)), preset("tubes")
    a, betas = [float(value) for value in shape.coefficients], SCHEDULES["fast"].betas
    start = white_noise(grid, 0).numpy()
    return FusedFlow(start, shape.mass, a, grid, WORKING_EPSILON, BLUR, betas=betas, adam_eps=ADAM_EPS)


def plain_stepper(size: int) -> TorchStepper:
    """Make the same in plain torch."""
    grid, shape = Grid((size, size, size)), preset("tubes")
    form = DivergenceForm(grid, BLUR, shape.mass)
    betas = SCHEDULES["fast"].betas
    return TorchStepper(white_noise(grid, 0), form, shape.coefficients, WORKING_EPSILON, betas, None, "cpu")


def peak_bytes(size: int) -> tuple[FusedFlow, int]:
    """Return a flow after its first step, and the most bytes that its arrays and the start took at once."""
    tracemalloc.start()
    flow = fused_flow(size)
    step(flow)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return flow, peak + flow.vector.nbytes


def step(flow: FusedFlow) -> None:
    flow.evaluate()
    flow.update(1e-3)


def compare(size: int, rounds: int) -> Comparison:
    """Time the two programs in turn."""
    step(fused_flow(8))
    fused, peak = peak_bytes(size)
    plain = plain_stepper(size) if size <= PLAIN else None
    passes = (
        fused.blur_along_z,
        fused.energy_gradient,
        fused.blur_gradient_along_z,
        lambda: fused.blur_adam(1e-3),
    )
    if plain:
        plain.step(1e-3)
    source = torch.ones(COPIED)
    target = source.clone()
    slow, fast, copies, parts = [], [], [], {name: [] for name in PASSES}
    for _ in range(rounds):
        if plain:
            slow += _times(lambda: plain.step(1e-3), 1)
        fast += _times(lambda: step(fused), 5)[1:]  # the first finds the caches full of the plain step
        for name, action in zip(PASSES, passes, strict=True):
            parts[name] += _times(action, 1)
        copies += _times(lambda: target.copy_(source), 2)
    bandwidth = 2 * source.nbytes / min(copies)
    return Comparison(
        Timing(slow), Timing(fast), {name: Timing(times) for name, times in parts.items()}, bandwidth, peak
    )


def processor() -> str:
    """Name the processor and its caches, and what numba compiles for where that is another."""
    try:
        name = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
        named = name.group(1) if name else platform.machine()
        folders = sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"))
        caches = [f"L{(f / 'level').read_text().strip()} {(f / 'size').read_text().strip()}" for f in folders]
    except OSError:
        named, caches = platform.processor() or platform.machine(), []
    given = getattr(config, "CPU_NAME", None)
    target = f"compiled for {given or llvm.get_host_cpu_name()}, {8 if loops.WIDE == 8 else 16} floats a vector"
    return ", ".join([named, *caches, target])


def _times(action: Callable[[], object], count: int) -> list[float]:
    seconds = []
    for _ in range(count):
        begun = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - begun)
    return seconds


def _report(size: int, rounds: int) -> None:
    rounds = max(2, min(rounds, WORK // size**3))
    plain, fused, parts, bandwidth, peak = compare(size, rounds)
    voxels = size**3
    print(f"\n{size}³: ms a step, median (least) of {rounds} rounds; a copy moves {bandwidth / 1e9:.1f} GB/s")
    if plain.seconds:
        print(f"  plain torch {plain.median:8.2f} ({plain.least:.2f})")
        print(f"  ratio       {plain.median / fused.median:8.1f} ({plain.least / fused.least:.1f})")
    else:
        print(f"  Plain torch is skipped above {PLAIN}³: it would take minutes and about {0.7e-6 * voxels:.0f} GB.")
    print(f"  fused       {fused.median:8.2f} ({fused.least:.2f})")
    print(f"  a voxel     {1e6 * fused.median / voxels:8.2f} ns, {peak / voxels:.1f} bytes at peak")
    moved = sum(PASSES.values())
    floor = 1e3 * moved * voxels / bandwidth
    share = floor / fused.median
    print(f"  floor       {floor:8.2f}: {moved} bytes a voxel must move; the step is at {1 / share:.2f} times that")
    _report_parts(parts, voxels, bandwidth)


def _report_parts(parts: dict[str, Timing], voxels: int, bandwidth: float) -> None:
    print(f"  {'pass':42} {'ms':>7} {'least':>7} {'share':>6} {'B/voxel':>8} {'floor ms':>9}")
    total = sum(part.median for part in parts.values())
    for name, part in parts.items():
        floor = 1e3 * PASSES[name] * voxels / bandwidth
        share = part.median / total
        print(f"  {name:42} {part.median:7.2f} {part.least:7.2f} {share:6.0%} {PASSES[name]:8d} {floor:9.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="64,100")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--threads", type=int, default=0, help="of both programs; all by default")
    options = parser.parse_args()
    if options.threads:
        numba.set_num_threads(options.threads)
        torch.set_num_threads(options.threads)
    print(f"{processor()}; {numba.get_num_threads()} threads")
    for size in options.sizes.split(","):
        _report(int(size), options.rounds)


if __name__ == "__main__":
    main()
