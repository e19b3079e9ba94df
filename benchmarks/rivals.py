"""Rivals that want environments of their own: DeeSse between known slices, and Biomedisa between annotated ones.

- `--deesse PYTHON`, an interpreter with `geone` (DeeSse: free for research): on one block of each structure
  of `completion`, the mean of 8 realisations of multiple-point statistics, 24 neighbours, from the fullest block of the
  other side; beside the best plain way in hindsight and `reconstruct` without an example.
- `--biomedisa PYTHON`, an interpreter with `biomedisa`, `pyopencl` and an OpenCL platform ($OPENCL, such as
  `opencl_Portable_CPU`): random walkers on the scans of `image`, by its defaults; beside `reconstruct --image`.

Every eighth slice is known; Dice counts unknown slices alone. $CURVAFIT_DATA names the scans.
"""

from __future__ import annotations

import argparse
import os
import time
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import image
from benchmarks.completion import CHOSEN_ON, FEW, STRUCTURES, blocks, interpolated, plain_ways
from benchmarks.harness import Cases, Figure, Values, bootstrap, run_python, show
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.trials import dice

EVERY = 8
DEESSE = """
import sys
import geone as gn
import numpy as np
given = np.load(sys.argv[1])
example, known = given["example"].astype(float), given["known"]
def image(values):
    nz, ny, nx = values.shape
    return gn.img.Img(nx=nx, ny=ny, nz=nz, nv=1, val=values[None], varname=["inside"])
nz, ny, nx = known.shape
asked = gn.deesseinterface.DeesseInput(
    nx=nx, ny=ny, nz=nz, nv=1, varname="inside", TI=image(example), dataImage=image(known),
    distanceType="categorical", nneighboringNode=24, distanceThreshold=0.05, maxScanFraction=0.1,
    npostProcessingPathMax=1, seed=444, nrealization=8)
found = gn.deesseinterface.deesseRun(asked, nthreads=1, verbose=0)
np.save(sys.argv[2], np.mean([each.val[0] for each in found["sim"]], axis=0))
"""
BIOMEDISA = """
import os
import sys
import numpy as np
from biomedisa.interpolation import smart_interpolation
given = np.load(sys.argv[1])
found = smart_interpolation(given["image"], given["labels"], platform=os.environ.get("OPENCL"))
np.save(sys.argv[2], found["regular"])
"""


def run_elsewhere(python: Path, program: str, folder: Path, **arrays: np.ndarray) -> tuple[np.ndarray, float]:
    """Return what a program makes of arrays in another interpreter, and its seconds."""
    given, found, begun = folder / "given.npz", folder / "found.npy", time.perf_counter()
    np.savez(given, allow_pickle=False, **arrays)
    run_python("-c", program, given, found, python=python)
    return np.load(found), time.perf_counter() - begun


def deesse(python: Path, name: str, side: int, cases: Cases) -> Values:
    block = blocks(name, side)[0]
    axis = int(block.shape[0] < FEW)
    truth, example = (np.moveaxis(each.values > 0, axis, 0) for each in (block, blocks(name, 1 - side)[0]))
    places = range(0, len(truth), EVERY)
    known = np.where(np.isin(np.arange(len(truth)), places)[:, None, None], truth.astype(float), np.nan)
    likely, seconds = run_elsewhere(python, DEESSE, cases.folder, example=example, known=known)
    slices, rows = Slices.of(block, places, axis), [k for k in range(places[-1]) if k % EVERY]
    plain = max(dice(interpolated(slices, way)[rows], truth[rows]) for way in plain_ways())
    filled = np.moveaxis(reconstruct(block, known=places, axis=axis).mask.values, axis, 0)
    return {"dice": dice(likely[rows] > 0.5, truth[rows]), "plain": plain, "ours": dice(filled[rows], truth[rows]),
            "seconds": seconds}  # fmt: skip


def biomedisa(python: Path, name: str, cases: Cases) -> Values:
    scan, mask = image.read(name)
    axis = image.SCANS[name].axis
    grey, truth = (np.moveaxis(each.values, axis, 0) for each in (scan, mask))
    truth, rows = truth > 0, [k for k in range((len(truth) - 1) // EVERY * EVERY) if k % EVERY]
    labels = np.where((np.arange(len(truth)) % EVERY == 0)[:, None, None], truth, 0).astype(np.uint8)
    low, high = np.percentile(grey, (0.1, 99.9))
    bytes_ = (255 * np.clip((grey - low) / (high - low), 0, 1)).astype(np.uint8)
    found, seconds = run_elsewhere(python, BIOMEDISA, cases.folder, image=bytes_, labels=labels)
    filled = reconstruct(mask, every=EVERY, axis=axis, image=scan).mask.values
    return {"dice": dice(found[rows] > 0, truth[rows]), "ours": dice(np.moveaxis(filled, axis, 0)[rows], truth[rows]),
            "seconds": seconds}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--deesse", type=Path, help="an interpreter that has geone")
    parser.add_argument("--biomedisa", type=Path, help="an interpreter that has biomedisa")
    parser.add_argument("--scans", default=",".join(image.SCANS), help="for Biomedisa")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if "CURVAFIT_DATA" not in os.environ:
        raise SystemExit("set CURVAFIT_DATA to the folder that holds scans/")
    jobs, figures = {}, {}
    if options.deesse:
        jobs |= {f"deesse-{name}-{side}": partial(deesse, options.deesse, name, side, cases)
                 for name in STRUCTURES for side in sorted({0, 1} - set(CHOSEN_ON.get(name, ())))[-1:]}  # fmt: skip
    if options.biomedisa:
        jobs |= {f"biomedisa-{n}": partial(biomedisa, options.biomedisa, n, cases) for n in options.scans.split(",")}
    found = cases.all(dict(list(jobs.items())[:1]) if options.quick else jobs)
    show(["case", "Dice", "reconstruct", "seconds"],
         [[name, row["dice"], row["ours"], row["seconds"]] for name, row in found.items()])  # fmt: skip
    for rival in ("deesse", "biomedisa"):
        rows = [row for name, row in found.items() if name.startswith(rival)]
        if len(rows) > 1:
            figures[f"rivals.{rival}.dice"] = bootstrap([row["dice"] for row in rows])
            figures[f"rivals.{rival}.gain"] = bootstrap([100 * (row["ours"] - row["dice"]) for row in rows])
            figures[f"rivals.{rival}.seconds"] = bootstrap([row["seconds"] for row in rows])
    return figures
