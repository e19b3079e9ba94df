"""How long a command will take, and how much memory: one line before the work begins.

A command's time is that of its flows: their steps and voxels are counted, and a step is timed on this machine, which
takes some 0.1 s on a small box. Its memory is what the process holds once its libraries are loaded, and so many bytes a
voxel: measured once, at 128³ voxels (of `infer` at 40³ and 64³), and written here.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from typing import NamedTuple

from curvafit.cli.support import error_console, say
from curvafit.units import number

#: Work below which nothing is said, in steps times voxels: some seconds.
SHORT = 2e8
#: Edge of the box in which a step is timed, and the numbers of steps whose difference is taken.
EDGE, STEPS = 64, (2, 12)
#: Between what the count of steps says and what a job takes: others share the machine, some flows end early.
RANGE = (0.7, 2.0)


class Cost(NamedTuple):
    """What a kind of job holds, in bytes: before the first voxel, and for each."""

    base: float
    voxel: float


FLOW = Cost(0.4e9, 70)
SEGMENTATION = Cost(0.6e9, 130)
INFERENCE = Cost(0.75e9, 1300)


def say_forecast(
    name: str, shape: Sequence[int], steps: float, cost: Cost, *, what: str = "voxels", workers: int = 1, device="cpu"
) -> None:
    """Say on the error stream how long a command will take and how much memory, where that is long.

    Parameters
    ----------
    name
        Of the command.
    shape, what
        Voxels (z, y, x) of a flow, and what they are called.
    steps
        Of all flows together.
    workers
        Processes that share them, each with its own memory.
    """
    voxels = math.prod(shape)
    if steps * voxels < SHORT:
        return
    seconds = steps * voxels * step_time(device) / workers
    memory = workers * (cost.base + cost.voxel * voxels) / 1e9
    size = " x ".join(map(str, shape))
    say(f"{name}: {size} {what}, about {_span(seconds)} and {number(memory, 2)} GB on this machine", to=error_console())


def step_time(device: str = "cpu") -> float:
    """Return the seconds that a flow's step takes for each voxel on this machine, timed now."""
    from curvafit.generation.flow import generate
    from curvafit.generation.schedule import schedule
    from curvafit.priors.coefficients import preset
    from curvafit.priors.grid import Grid

    law, grid, times = preset("tubes"), Grid((EDGE, EDGE, EDGE)), []
    for steps in (STEPS[0], *STEPS):  # the first loads and compiles
        start = time.perf_counter()
        generate(law.coefficients, law.mass, grid, seed=0, schedule=schedule("fast", steps), device=device)
        times.append(time.perf_counter() - start)
    return max(times[2] - times[1], 1e-6) / (STEPS[1] - STEPS[0]) / EDGE**3


def cores(workers: int | None) -> int:
    """Return how many processes a command starts that was given so many, or none."""
    return max(1, (os.cpu_count() or 1) if workers is None else workers)


def _span(seconds: float) -> str:
    """A range of time in one unit: `"2 to 4 min"`."""
    low, high = (share * seconds for share in RANGE)
    size, unit = next(((s, u) for s, u in ((3600, "h"), (60, "min")) if high >= 2 * s), (1, "s"))
    return f"{number(max(low / size, 1 if size == 1 else 0), 1)} to {number(max(high / size, 2), 1)} {unit}"
