"""A shape over several processes of this machine: seconds a step, and the peak memory of each, against one process.

`torchrun` starts the processes of `curvafit.generation.slabs`; one process has as many threads as there are cores, two
share them.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from resource import RUSAGE_SELF, getrusage

from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.generation import generate, slabs
from curvafit.generation.schedule import schedule

#: The first steps, which start kernels and threads, are not timed.
WARM = 2


def grow(edge: int, steps: int, backend: str) -> Values:
    """Return seconds a step of a flow, statistics of two steps included, and the end of its energy."""
    begun = []

    def watch(step: int, total: int, state: object) -> None:
        begun.append(time.monotonic())

    flow = generate("tubes", grid=edge, schedule=schedule("fast", WARM), backend=backend)
    flow = generate("tubes", grid=edge, schedule=schedule("fast", steps), backend=backend, callbacks=[watch])
    return {"seconds": (begun[-1] - begun[0]) / steps, "energy": float(flow.history.energy[-1])}


def lead(edge: int, steps: int) -> None:
    """Print the figures of a flow as JSON: of this process alone, or as the first of several."""
    rank, count = slabs.count_processes()
    found: Values = {}
    if rank:
        slabs.serve()
    elif count > 1:
        with slabs.lead():
            found = grow(edge, steps, "slabs")
    else:
        found = grow(edge, steps, "auto")
    print(json.dumps(found | {"memory": getrusage(RUSAGE_SELF).ru_maxrss * 1024 / 1e9}), flush=True)


def timed(edge: int, steps: int, count: int) -> Values:
    call = f"from benchmarks.slabs import lead; lead({edge}, {steps})"
    start = ("-m", "torch.distributed.run", "--no-python", "--nproc-per-node", count, "python") if count > 1 else ()
    # Two processes may print on one line.
    rows = list(map(json.loads, re.findall(r"{[^{}]*}", run_python(*start, "-c", call))))
    first = next(row for row in rows if "seconds" in row)
    return first | {"memory": max(row["memory"] for row in rows)}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--edge", type=int, default=512)
    parser.add_argument("--steps", type=int, default=10)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    edge = 48 if options.quick else options.edge
    found = cases.all({f"{n}-{edge}": lambda n=n: timed(edge, options.steps, n) for n in (1, 2)})
    one, two = (found[f"{n}-{edge}"] for n in (1, 2))
    rows = [[n, row["seconds"], row["memory"]] for n, row in ((1, one), (2, two))]
    show(["processes", "seconds a step", "GB, the largest"], rows)
    figures = {
        "slabs.seconds": Figure(two["seconds"]),
        "slabs.ratio": Figure(two["seconds"] / one["seconds"]),
        "slabs.memory": Figure(two["memory"]),
        "slabs.alone": Figure(one["memory"]),
        "slabs.energy": Figure(abs(two["energy"] / one["energy"] - 1)),
    }
    return {} if options.quick else figures
