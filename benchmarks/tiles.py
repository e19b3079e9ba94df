"""Volumes of any size: whether the tiles of `reconstruct` show, its time and its peak memory.

The shape is a generated one of 64³ that is repeated along each axis (it is periodic) and cut at the edge, every 8th
slice known, the law the true one, not tried out.

- `--what overlap`: a core of 32³ voxels, interpolated and lowered in a part cut on all six sides at some distance,
  against the same core of a volume of 88³ that is lowered whole: 1 - Dice in the core, by the distance.
- `--what time`: `curvafit reconstruct` in a process of its own, from an NPY file to a Zarr store: seconds, and peak
  memory of the process and of its largest worker in GB.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.completion import EDGE, shape
from benchmarks.harness import Cases, Figure, Values, dice, run_python, show
from curvafit.segmentation.reconstruct import STIFFNESS, reconstruct

EVERY, WHOLE, CORE = 8, 88, 32
DISTANCES = (8, 12, 16, 24)
#: Runs the command line, and prints the peak memory of the process and of its largest child in KiB.
PROGRAM = """
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from curvafit.cli.app import app
try:
    app()
finally:
    print(*(getrusage(who).ru_maxrss for who in (RUSAGE_SELF, RUSAGE_CHILDREN)))
"""


def volume(law: str, edge: int, cases: Cases) -> np.ndarray:
    """Return a shape of any edge: that of 64³ repeated."""
    numbers = np.arange(edge) % EDGE
    return shape(law, 0, cases)[np.ix_(numbers, numbers, numbers)].astype(np.uint8)


def overlap(law: str, distance: int, cases: Cases) -> Values:
    """Return how far a core that is lowered within a margin alone lies from the same core of the whole."""

    def whole() -> np.ndarray:
        return reconstruct(volume(law, WHOLE, cases), law, every=EVERY, stiffness=STIFFNESS).mask.values > 0

    truth, start = cases.array(f"whole-{law}-{WHOLE}", whole), (WHOLE - CORE) // 2
    low, high = start - distance, start + CORE + distance
    first = -low % EVERY
    part = volume(law, WHOLE, cases)[low:high, low:high, low:high]
    mask = reconstruct(part, law, every=EVERY, first=first, stiffness=STIFFNESS).mask.values > 0
    core = (slice(distance, distance + CORE),) * 3
    return {"1 - Dice": 1 - dice(mask[core], truth[(slice(start, start + CORE),) * 3])}


def timed(law: str, edge: int, workers: int, cases: Cases) -> Values:
    source = cases.folder / f"volume-{law}-{edge}.npy"
    np.save(source, volume(law, edge, cases))
    options = f"--every {EVERY} --prior {law} --workers {workers} --overwrite --stiffness {STIFFNESS}".split()
    begun = time.monotonic()
    said = run_python("-c", PROGRAM, "reconstruct", source, *options, "-o", f"{source}.zarr")
    own, worker = (int(n) * 1024 / 1e9 for n in said.strip().splitlines()[-1].split())
    return {"seconds": time.monotonic() - begun, "GB": own, "worker's GB": worker}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--what", choices=("overlap", "time"), default="overlap")
    parser.add_argument("--laws", default="tubes,trabec")
    parser.add_argument("--edge", type=int, default=256, help="of the volume that is timed")
    parser.add_argument("--workers", type=int, default=0)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    laws = options.laws.split(",")[: 1 if options.quick else None]
    edge = 64 if options.quick else options.edge
    if options.what == "overlap":
        jobs = {f"overlap-{law}-{d}": lambda a=law, d=d: overlap(a, d, cases)
                for law in laws for d in DISTANCES[: 1 if options.quick else None]}  # fmt: skip
    else:
        jobs = {f"time-{law}-{edge}": lambda a=law: timed(a, edge, options.workers, cases) for law in laws}
    found = cases.all(jobs)
    show(["case", "figures"], [[name, " ".join(f"{k} {v:.3g}" for k, v in row.items())] for name, row in found.items()])
    if options.what != "overlap":
        return {}
    parts = {name: name.split("-") for name in found}
    return {f"margin.{distance}.{law}": Figure(found[name]["1 - Dice"]) for name, (_, law, distance) in parts.items()}
