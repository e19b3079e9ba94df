"""A step of the H⁻¹ Adam flow: fused against plain torch, and where the fused step's time goes.

    python -m benchmarks.step [--sizes 64,100] [--rounds 12] [--threads N]

The two programs alternate in one run, so that a busy machine slows both; medians over the rounds, and the least. The
breakdown gives for each pass the bytes a voxel that it must move (each array read or written once) and the time that
moving them takes at the bandwidth of a plain copy, the best seen in the same rounds: from main memory the pass cannot
be faster than that (from the cache it can).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import torch

from curvafit.generation.initial import white_noise
from curvafit.generation.parametrization import DivergenceForm
from curvafit.generation.schedule import SCHEDULES
from curvafit.generation.stepper import ADAM_EPS, TorchStepper
from curvafit.priors.coefficients import preset
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.cpu import FusedFlow

BLUR = 0.02
#: Floats of the array that is copied to measure bandwidth: more than any cache holds.
COPIED = 2**26
#: Bytes a voxel that each pass must move: floats read and written.
PASSES = {
    "div A, blur along y and x": 4 * (3 + 1),
    "blur along z": 4 * 2,
    "energy and gradient": 4 * 2,
    "gradient's blur along z": 4 * 2,
    "blur along y and x, -∇, Adam": 4 * (1 + 2 * 9),
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
    """Timings of the plain step, the fused step and its passes; the copy's bandwidth in bytes a second."""

    plain: Timing
    fused: Timing
    parts: dict[str, Timing]
    bandwidth: float


def programs(size: int) -> tuple[TorchStepper, FusedFlow]:
    """The same flow twice, on a cube: in plain torch and fused."""
    grid, shape, betas = Grid((size, size, size)), preset("tubes"), SCHEDULES["fast"].betas
    start, form = white_noise(grid, 0), DivergenceForm(grid, BLUR, shape.mass)
    plain = TorchStepper(start, form, shape.coefficients, WORKING_EPSILON, betas, None, "cpu")
    a = [float(value) for value in shape.coefficients]
    fused = FusedFlow(start.numpy(), shape.mass, a, grid, WORKING_EPSILON, BLUR, betas=betas, adam_eps=ADAM_EPS)
    return plain, fused


def compare(size: int, rounds: int) -> Comparison:
    """The two programs in turn."""
    plain, fused = programs(size)
    passes = (
        fused.blur_divergence,
        fused.blur_along_z,
        fused.energy_gradient,
        fused.blur_gradient_along_z,
        lambda: fused.blur_adam(1e-3),
    )

    def step() -> None:
        fused.evaluate()
        fused.update(1e-3)

    for warm in (lambda: plain.step(1e-3), step, step):
        warm()
    source = torch.ones(COPIED)
    target = source.clone()
    slow, fast, copies, parts = [], [], [], {name: [] for name in PASSES}
    for _ in range(rounds):
        slow += _times(lambda: plain.step(1e-3), 1)
        fast += _times(step, 4)
        for name, action in zip(PASSES, passes, strict=True):
            parts[name] += _times(action, 1)
        copies += _times(lambda: target.copy_(source), 2)
    bandwidth = 2 * source.nbytes / min(copies)
    return Comparison(Timing(slow), Timing(fast), {name: Timing(times) for name, times in parts.items()}, bandwidth)


def _times(action: Callable[[], object], count: int) -> list[float]:
    seconds = []
    for _ in range(count):
        begun = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - begun)
    return seconds


def _report(size: int, rounds: int) -> None:
    plain, fused, parts, bandwidth = compare(size, rounds)
    voxels = size**3
    print(f"\n{size}³: ms a step, median (least) of {rounds} rounds; a copy moves {bandwidth / 1e9:.1f} GB/s")
    print(f"  plain torch {plain.median:8.2f} ({plain.least:.2f})")
    print(f"  fused       {fused.median:8.2f} ({fused.least:.2f})   {1e6 * fused.median / voxels:.2f} ns a voxel")
    print(f"  ratio       {plain.median / fused.median:8.1f} ({plain.least / fused.least:.1f})")
    print(f"  {'pass':30} {'ms':>7} {'least':>7} {'share':>6} {'B/voxel':>8} {'floor ms':>9}")
    total = sum(part.median for part in parts.values())
    for name, part in parts.items():
        floor = 1e3 * PASSES[name] * voxels / bandwidth
        share = part.median / total
        print(f"  {name:30} {part.median:7.2f} {part.least:7.2f} {share:6.0%} {PASSES[name]:8d} {floor:9.2f}")
    moved = sum(PASSES.values())
    floor = 1e3 * moved * voxels / bandwidth
    least = sum(part.least for part in parts.values())
    print(
        f"  {'all':30} {total:7.2f} {least:7.2f} {'':6} {moved:8d} {floor:9.2f}   {total / floor:.1f} times the floor"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="64,100")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--threads", type=int, default=0, help="of both programs; all by default")
    options = parser.parse_args()
    if options.threads:
        numba.set_num_threads(options.threads)
        torch.set_num_threads(options.threads)
    print(f"{numba.get_num_threads()} threads")
    for size in options.sizes.split(","):
        _report(int(size), options.rounds)


if __name__ == "__main__":
    main()
