"""The forecast of a command's time and memory: one line before the work begins.

The time of a command is the time of its flows: steps times voxels times the time of a step, which is measured on this
machine, in some 0.1 s on a small box. The memory is that of the process with its libraries, and a number of bytes per
voxel: of a flow, what its arrays and its file take; of the others, measured once at 128³ (`infer` at 40³ and 64³).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

from curvafit.cli.console import error_console, say
from curvafit.core.units import number
from curvafit.generation import memory

#: Least work, in steps times voxels, that has a forecast: some seconds.
SHORT = 2e8
#: Edge of the box in which a step is timed, and the two numbers of steps whose difference is timed.
EDGE, STEPS = 64, (2, 12)
#: Least and greatest time of a job over that of its steps: others share the machine, and some flows end early.
RANGE = (0.7, 2.0)


class Cost(NamedTuple):
    """The memory of a kind of job in bytes: a base, and a number per voxel."""

    base: float
    voxel: float


FLOW = Cost(0.4e9, memory.FLOW + memory.FILE)
SEGMENTATION = Cost(0.6e9, 130)
INFERENCE = Cost(0.75e9, 1300)


def say_forecast(
    name: str,
    shape: Sequence[int],
    steps: float,
    cost: Cost,
    *,
    what: str = "voxels",
    workers: int = 1,
    device="cpu",
    held: int | None = None,
) -> None:
    """Print the time and memory of a long command on the error stream; a short one has no forecast.

    Parameters
    ----------
    name
        Name of the command.
    shape, what
        Voxels (z, y, x) of a flow, and their name in the line.
    steps
        Steps of all flows together.
    workers
        Processes that share the flows, each with its own memory.
    held
        Voxels that a process holds at once, by default all.
    """
    voxels = math.prod(shape)
    if steps * voxels < SHORT:
        return
    seconds = steps * voxels * step_time(device) / workers
    size, space = " x ".join(map(str, shape)), number(workers * (cost.base + cost.voxel * (held or voxels)) / 1e9, 2)
    say(f"{name}: {size} {what}, about {_span(seconds)} and {space} GB on this machine", to=error_console())


def step_time(device: str = "cpu") -> float:
    """Return the seconds per voxel of a flow's step, measured now on this machine."""
    from curvafit.generation.flow import generate
    from curvafit.generation.schedule import schedule
    from curvafit.priors.grid import Grid
    from curvafit.priors.law import preset

    law, grid, times = preset("tubes"), Grid((EDGE, EDGE, EDGE)), []
    for steps in (STEPS[0], *STEPS):  # the first loads and compiles
        start = time.perf_counter()
        generate(law.coefficients, law.mass, grid, seed=0, schedule=schedule("fast", steps), device=device)
        times.append(time.perf_counter() - start)
    return max(times[2] - times[1], 1e-6) / (STEPS[1] - STEPS[0]) / EDGE**3


def _span(seconds: float) -> str:
    """Return a range of time in one unit, as `"2 to 4 min"`."""
    low, high = (share * seconds for share in RANGE)
    size, unit = next(((s, u) for s, u in ((3600, "h"), (60, "min")) if high >= 2 * s), (1, "s"))
    return f"{number(max(low / size, 1 if size == 1 else 0), 1)} to {number(max(high / size, 2), 1)} {unit}"
