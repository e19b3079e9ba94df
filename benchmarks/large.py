"""Time and peak memory of `curvafit measure`, `infer`, `segment` or `reconstruct` on a volume in Zarr, of any size.

A generated shape of 64³ is repeated along each axis: for all but `reconstruct` blurred, under noise of a quarter of its
contrast; for `reconstruct` as labels, of which every eighth slice is known. The store is written chunk by chunk. The
command runs in a process of its own with its workers; the memory is that of the largest worker times their number, and
the main process's.
"""

from __future__ import annotations

import argparse
import time
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.completion import EDGE, shape
from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.core.files import remove
from curvafit.segmentation.result import hidden_store

#: Distance of known slices, and the longest side of a volume that is filled in one piece.
EVERY, WHOLE = 8, 256
#: Steps of `segment`: the time of one step does not depend on their number.
STEPS = 5
#: Runs the command line, and prints the peak memory of the main process and of its largest worker in KiB.
PROGRAM = """
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from curvafit.cli.app import app
try:
    app()
finally:
    print(*(getrusage(who).ru_maxrss for who in (RUSAGE_SELF, RUSAGE_CHILDREN)))
"""


def write_scan(edge: int, path: Path, cases: Cases, *, labels: bool = False) -> None:
    """Write an image of a repeated shape, or its labels, uint8, in chunks of two periods."""
    import zarr

    mask = shape("tubes", 0, cases).astype(np.float32)
    period = np.tile(mask, (2, 2, 2)) if labels else ndimage.gaussian_filter(np.tile(mask, (2, 2, 2)), 1.0, mode="wrap")
    array = zarr.create_array(path, shape=(edge,) * 3, chunks=(2 * EDGE,) * 3, dtype="u1", overwrite=True)
    for number, start in enumerate(product(range(0, edge, 2 * EDGE), repeat=3)):
        box = tuple(slice(a, min(a + 2 * EDGE, edge)) for a in start)
        part = period[tuple(slice(0, b.stop - b.start) for b in box)]
        if labels:
            array[box] = part.astype(np.uint8)
            continue
        noise = np.random.default_rng(number).standard_normal(part.shape, dtype=np.float32)
        array[box] = np.clip(60 + 100 * part + 25 * noise, 0, 255).astype(np.uint8)


def timed(job: str, edge: int, workers: int, cases: Cases, flag: str = "") -> Values:
    """Return the seconds and the memory in GB of one command."""
    fills = job == "reconstruct"
    path = cases.folder / f"{'labels' if fills else 'scan'}-{edge}.zarr"
    write_scan(edge, path, cases, labels=fills)
    workers = 0 if fills and edge <= WHOLE else workers  # it is filled in one piece
    crew = ("--workers", workers) if workers else ()
    how = {
        "measure": (*crew, "-o", cases.folder / f"measured-{edge}.csv"),
        "infer": ("-o", cases.folder / f"fit-{edge}", *filter(None, [flag])),
        "segment": (*crew, "--steps", STEPS, "-o", cases.folder / f"segmented-{edge}.zarr"),
        "reconstruct": (*crew, "--every", EVERY, "-o", cases.folder / f"filled-{edge}.zarr"),
    }[job]
    remove(hidden_store(cases.folder / f"filled-{edge}.zarr"))  # of a run that was stopped
    begun = time.monotonic()
    said = run_python("-c", PROGRAM, job, path, *how, "--overwrite")
    main, worker = map(int, said.strip().splitlines()[-1].split())
    return {"seconds": time.monotonic() - begun, "memory": (main + max(workers, 0) * worker) * 1024 / 1e9}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--command", choices=["measure", "infer", "segment", "reconstruct"], default="measure")
    parser.add_argument("--edge", type=int, default=1024)
    parser.add_argument("--of-infer", choices=["test"], default="", help="an option that `infer` is given")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    job, edge, workers = options.command, options.edge, 0 if options.command == "infer" else 2
    if options.quick:
        edge, workers = 64 if job == "reconstruct" else 208, 0
    before = {"measure": "", "infer": "inferred-", "segment": "segmented-", "reconstruct": "filled-"}[job]
    before += f"{options.of_infer}-" if options.of_infer else ""
    flag = f"--{options.of_infer}" if options.of_infer else ""
    found = cases.all({f"{before}tubes-{edge}-{workers}": lambda: timed(job, edge, workers, cases, flag)})
    show(["case", "seconds", "GB"], [[case, *row.values()] for case, row in found.items()])
    return {f"{before}{edge}.{key}": Figure(value) for each in found.values() for key, value in each.items()}
