"""The H⁻¹ flow on an NVIDIA device: time a step, against the bytes that must move and against the processor.

    python -m benchmarks.gpu --all [-o gpu.json]
    python -m benchmarks.gpu --table gpu.json
    python -m benchmarks.gpu [--sizes 64,100,200,300] [--tune 100]

`--all` measures everything, writes a JSON to send, after each part, and prints it as a table; where it was stopped, it
goes on. Needs a CUDA device and a torch that brings triton; without them it says so and exits with 2. `--table` prints
such a JSON, and needs no device. The first use of a blur
and a boundary compiles the kernels, which is timed apart. `--tune N` instead times a step at N³ for other divisions of
the work.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.gpu_parts import Part, distances, machine, measure, table, textures, training, transfers
from curvafit.generation.initial import white_noise
from curvafit.generation.schedule import SCHEDULES
from curvafit.generation.stepper import ADAM_EPS
from curvafit.priors.coefficients import preset
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels import cuda

BLUR = 0.02
#: Bytes a voxel that any step must move: A, m, v read and written, A read once more, u, its gradient, and their blurs.
FLOOR = 100
#: Bytes of the array that is copied to measure bandwidth: more than any cache holds.
COPIED = 2**30
SHAPES, SHAPE_SIZE = 64, 64


def flow(size: int, batch: int = 1, tuning: cuda.Tuning | None = None) -> cuda.CudaFlow:
    """A batch of flows on a cube, from seeds of their own."""
    grid, shape = Grid((size, size, size)), preset("tubes")
    start = torch.stack([white_noise(grid, seed) for seed in range(min(batch, 4))])
    start = start.repeat(-(-batch // len(start)), 1, 1, 1, 1)[:batch]
    a = [float(value) for value in shape.coefficients]
    betas = SCHEDULES["fast"].betas
    return cuda.CudaFlow(
        start, shape.mass, a, grid, WORKING_EPSILON, BLUR, betas=betas, adam_eps=ADAM_EPS, tuning=tuning
    )


def seconds(action: Callable[[], object], rounds: int) -> float:
    """Least time of an action on the device, by its clock."""
    times = []
    for _ in range(rounds):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        action()
        end.record()
        end.synchronize()
        times.append(1e-3 * begin.elapsed_time(end))
    return min(times)


def step_seconds(moved: cuda.CudaFlow, steps: int = 200, rounds: int = 3) -> float:
    """Seconds a step, in graphs, once all is compiled and recorded."""
    moved.run([1e-3] * 20)
    return seconds(lambda: moved.run([1e-3] * steps), rounds) / steps


def bandwidth() -> float:
    """Bytes a second that a copy reads and writes."""
    source = torch.rand(COPIED // 4, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPIED / seconds(lambda: target.copy_(source), 10)


def run_seconds(size: int, steps: int) -> float:
    """Seconds of a whole run by the clock on the wall: rates sent, steps made, field brought back."""
    moved = flow(size)
    moved.run([1e-3] * 20)
    torch.cuda.synchronize()
    begun = time.perf_counter()
    moved.run([1e-3] * steps)
    moved.field.cpu()
    return time.perf_counter() - begun


def launch_seconds(moved: cuda.CudaFlow, times: int = 50) -> list[float]:
    """Seconds of each launch of a step, from a graph of so many in a row."""
    moved.run([1e-3])
    found = []
    for launch in moved.launches():
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(times):
                launch()
        found.append(seconds(graph.replay, 3) / times)
    return found


def disagreement(size: int = 48, steps: int = 20) -> float | None:
    """Greatest difference of u from the processor's after some steps, over u's deviation; None without numba."""
    if importlib.util.find_spec("numba") is None:
        return None
    from curvafit.priors.kernels.cpu import FusedFlow

    device, shape = flow(size), preset("tubes")
    start, a = device.vector[0].cpu().numpy(), [float(value) for value in shape.coefficients]
    betas = SCHEDULES["fast"].betas
    processor = FusedFlow(start, shape.mass, a, device.grid, WORKING_EPSILON, BLUR, betas=betas, adam_eps=ADAM_EPS)
    for _ in range(steps):
        processor.evaluate()
        processor.update(1e-3)
    processor.evaluate()
    device.run([1e-3] * steps)
    device.observe()
    return float(np.abs(device.field[0].cpu().numpy() - processor.field).max() / processor.field.std())


def report(sizes: list[int]) -> None:
    copied = bandwidth()
    print(f"{torch.cuda.get_device_name()}: a copy moves {copied / 1e12:.2f} TB/s; torch {torch.__version__}")
    begun = time.perf_counter()
    flow(sizes[0]).run([1e-3] * 20)
    print(f"first steps, kernels compiled or found on disk: {time.perf_counter() - begun:.1f} s")
    moved = sum(cuda.BYTES.values())
    titles = f"{'floor B':>8} {'ms':>8} {'share':>6} {'planned B':>10} {'ms':>8} {'share':>6}"
    print(f"\n{'size':>6} {'ms a step':>10} {titles}")
    for size in sizes:
        taken = step_seconds(flow(size))
        floor, planned = FLOOR * size**3 / copied, moved * size**3 / copied
        print(
            f"{size:5d}³ {1e3 * taken:10.4f} {FLOOR:8d} {1e3 * floor:8.4f} {floor / taken:6.0%}"
            f" {moved:10d} {1e3 * planned:8.4f} {planned / taken:6.0%}"
        )
    for size in (100, 300):
        breakdown(size, copied)
    print(f"\n8000 steps at 100³: {run_seconds(100, 8000):.3f} s (wanted: 0.5)")
    print(f"2000 steps at 300³: {run_seconds(300, 2000):.3f} s (wanted: 3)")
    single, batch = step_seconds(flow(SHAPE_SIZE)), step_seconds(flow(SHAPE_SIZE, SHAPES), 50)
    least = FLOOR * SHAPES * SHAPE_SIZE**3 / copied
    print(
        f"{SHAPES} shapes at {SHAPE_SIZE}³: {1e3 * batch:.3f} ms a step of all, {1e3 * single:.4f} of one alone: "
        f"{SHAPES * single / batch:.1f} times its rate (at the byte floor: {SHAPES * single / least:.1f})"
    )
    difference = disagreement()
    said = "numba is not installed" if difference is None else f"{difference:.1e} of u's deviation after 20 steps"
    print(f"greatest difference from the processor's u: {said}")


def parts(sizes: list[int]) -> dict[str, Part]:
    """What `--all` measures, by name."""

    def steps() -> dict[str, float]:
        return {f"{size}³ ms": 1e3 * step_seconds(flow(size)) for size in sizes}

    def bytes_() -> dict[str, float]:
        copied = bandwidth()
        floors = {f"{size}³ floor ms": 1e3 * FLOOR * size**3 / copied for size in sizes}
        return {"copy TB/s": copied / 1e12, "a step's bytes a voxel": sum(cuda.BYTES.values()), **floors}

    def runs() -> dict[str, float]:
        return {
            "8000 of 100³ s (wanted 0.5)": run_seconds(100, 8000),
            "2000 of 300³ s (wanted 3)": run_seconds(300, 2000),
        }

    def batch() -> dict[str, float]:
        single, many = step_seconds(flow(SHAPE_SIZE)), step_seconds(flow(SHAPE_SIZE, SHAPES), 50)
        return {"alone ms": 1e3 * single, "all ms": 1e3 * many, "times (wanted 20)": SHAPES * single / many}

    def loop() -> dict[str, float]:
        recorded = flow(100)
        return transfers(lambda: recorded.run([1e-3] * 200), 200)

    return {
        "a step": steps,
        "bytes": bytes_,
        "whole runs": runs,
        f"{SHAPES} shapes of {SHAPE_SIZE}³ at once": batch,
        "the loop, copies and graphs": loop,
        "greatest difference from the processor's u": lambda: {"of its deviation": disagreement()},
        "textures of both devices": textures,
        "the training loss, forward and backward, ms": training,
        "distances of diagrams, a pair": distances,
    }


def breakdown(size: int, copied: float) -> None:
    """Each launch by itself; small ones find more in the cache than within a step."""
    moved = flow(size)
    times = launch_seconds(moved)
    print(f"\n{size}³, each launch by itself, many times in a row")
    print(f"  {'launch':26} {'µs':>7} {'B/voxel':>8} {'floor µs':>9} {'programs':>9} {'threads':>8}")
    for (name, bytes_), launch, taken in zip(cuda.BYTES.items(), moved.launches(), times, strict=True):
        floor = bytes_ * size**3 / copied
        print(
            f"  {name:26} {1e6 * taken:7.1f} {bytes_:8d} {1e6 * floor:9.1f} {launch.programs[0]:9d} {launch.lanes:8d}"
        )
    print(f"  {len(times)} launches a step, {sum(cuda.BYTES.values())} bytes a voxel")


def tune(size: int) -> None:
    """Other divisions of the work, one number changed at a time, the best kept."""
    choices = {
        "rows": (4, 8, 16),
        "last_rows": (2, 4, 8),
        "width": tuple(width for width in (1, 2, 4) if size % width == 0),
        "planes": (4, 6, 8, 12, 16, 24, 32),
        "lanes": (64, 128, 256),
    }
    best = cuda.Tuning()
    least = step_seconds(flow(size, tuning=best))
    print(f"{1e3 * least:.4f} ms {best}")
    for name, values in choices.items():
        for value in values:
            tuning = best._replace(**{name: value})
            taken = step_seconds(flow(size, tuning=tuning))
            print(f"{1e3 * taken:.4f} ms {tuning}", flush=True)
            if taken < least:
                best, least = tuning, taken
    print(f"best: {1e3 * least:.4f} ms {best}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="64,100,200,300")
    parser.add_argument("--tune", type=int, metavar="N")
    parser.add_argument("--all", action="store_true", help="measure all parts, and write a JSON of them")
    parser.add_argument("--table", type=Path, metavar="JSON", help="print the table of a JSON")
    parser.add_argument("-o", "--output", type=Path, default=Path("gpu.json"), help="the JSON of --all")
    options = parser.parse_args()
    if options.table:
        print(table(json.loads(options.table.read_text(encoding="utf-8"))))
        return
    if not cuda.available("cuda"):
        print("no GPU: this benchmark needs an NVIDIA device, and a torch that brings triton", file=sys.stderr)
        sys.exit(2)
    if options.all:
        print(table(measure(options.output, machine(), parts([int(size) for size in options.sizes.split(",")]))))
    elif options.tune:
        tune(options.tune)
    else:
        report([int(size) for size in options.sizes.split(",")])


if __name__ == "__main__":
    main()
