"""A step of the H⁻¹ Adam flow: fused against plain torch, and where the fused step's time goes.

    python -m benchmarks.step [--sizes 64,100] [--rounds 12] [--threads N]

The two programs alternate in one run, so that a busy machine slows both; medians over the rounds, and the least. The
breakdown gives for each pass the bytes a voxel that it must move (each array read or written once) and the time that
moving them takes at the bandwidth of a plain copy, measured here: the pass cannot be faster than that.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

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


def compare(size: int, rounds: int) -> tuple[Timing, Timing, dict[str, Timing]]:
    """Timings of the plain step, the fused step, and the fused step's passes, on a cube."""
    grid = Grid((size, size, size))
    shape = preset("tubes")
    start = white_noise(grid, 0)
    plain = TorchStepper(
        start, DivergenceForm(grid, BLUR, shape.mass), shape.coefficients, WORKING_EPSILON, SCHEDULES["fast"].betas, None, "cpu"
    )
    fused = FusedFlow(
        start.numpy(), shape.mass, list(shape.coefficients), grid, WORKING_EPSILON, BLUR, betas=SCHEDULES["fast"].betas, adam_eps=ADAM_EPS
    )
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
    slow, fast, parts = [], [], {name: [] for name in PASSES}
    for _ in range(rounds):
        slow += _times(lambda: plain.step(1e-3), 1)
        fast += _times(step, 4)
        for name, action in zip(PASSES, passes, strict=True):
            parts[name] += _times(action, 1)
    return Timing(slow), Timing(fast), {name: Timing(seconds) for name, seconds in parts.items()}


def copy_bandwidth(megabytes: int = 256) -> float:
    """Bytes a second, read and written, of a plain copy between arrays larger than any cache."""
    source = torch.ones(megabytes * 2**18)
    target = torch.empty_like(source)
    target.copy_(source)
    return 2 * source.numel() * 4 / min(_times(lambda: target.copy_(source), 10))


def _times(action: Callable[[], object], count: int) -> list[float]:
    seconds = []
    for _ in range(count):
        begun = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - begun)
    return seconds


def _report(size: int, rounds: int, bandwidth: float) -> None:
    plain, fused, parts = compare(size, rounds)
    voxels = size**3
    print(f"\n{size}³: ms a step, median (least) of {rounds} rounds")
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
    bandwidth = copy_bandwidth()
    print(f"{numba.get_num_threads()} threads; a plain copy moves {bandwidth / 1e9:.1f} GB/s (read and written)")
    for size in options.sizes.split(","):
        _report(int(size), options.rounds, bandwidth)


if __name__ == "__main__":
    main()
