"""Time and peak memory of `curvafit reconstruct` at 256³, every eighth slice known, alone and with an image.

A generated shape of 64³ is repeated along each axis; the image is its mask, blurred, under noise of one contrast. The
command runs in a process of its own, from NPY files to NIfTI.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy import ndimage

from benchmarks.completion import EDGE, shape
from benchmarks.harness import Cases, Figure, Values, run_python, show

EVERY = 8
#: Runs the command line, and prints the peak memory in KiB.
PROGRAM = """
from resource import RUSAGE_SELF, getrusage
from curvafit.cli.app import app
try:
    app()
finally:
    print(getrusage(RUSAGE_SELF).ru_maxrss)
"""


def timed(law: str, edge: int, image: bool, cases: Cases) -> Values:
    numbers = np.arange(edge) % EDGE
    mask = shape(law, 0, cases)[np.ix_(numbers, numbers, numbers)].astype(np.uint8)
    labels, scan = (cases.folder / f"{name}-{law}-{edge}.npy" for name in ("labels", "scan"))
    np.save(labels, mask)
    noise = np.random.default_rng(0).standard_normal(mask.shape, dtype=np.float32)
    np.save(scan, ndimage.gaussian_filter(mask.astype(np.float32), 1.0) + noise)
    begun, with_image = time.monotonic(), ("--image", scan) if image else ()
    said = run_python(
        "-c", PROGRAM, "reconstruct", labels, "--every", EVERY, *with_image,
        "-o", cases.folder / f"filled-{law}-{edge}.nii.gz", "--overwrite",
    )  # fmt: skip
    return {"seconds": time.monotonic() - begun, "memory": int(said.strip().splitlines()[-1]) * 1024 / 1e9}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--law", default="tubes")
    parser.add_argument("--edge", type=int, default=256)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    edge = 64 if options.quick else options.edge
    ways = {"filled": False, "image": True}
    found = cases.all(
        {f"{way}-{options.law}-{edge}": lambda i=i: timed(options.law, edge, i, cases) for way, i in ways.items()}
    )
    show(["case", "seconds", "GB"], [[name, *row.values()] for name, row in found.items()])
    return {f"{name.split('-')[0]}.{key}": Figure(value) for name, row in found.items() for key, value in row.items()}
