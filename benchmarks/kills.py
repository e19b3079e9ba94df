"""Kills of `measure`, `segment` and `reconstruct` in tiles: what the same command writes afterwards is what it should be.

A command is killed (SIGKILL, with its workers) at a random moment, five times, then left to end: a case. Its table, mask
and probability are compared with those of a run that nobody killed, byte by byte. What a kill may leave is a hidden
folder of a file that was being written.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.core.files import remove
from curvafit.volumes import Volume, save

#: Kills of a case, the shape of the volume, and commands with the cases of each.
KILLS, SHAPE = 5, (96, 64, 64)
JOBS = {
    "measure scan.zarr --tile 32 -o table.csv": 10,
    "measure scan.zarr --tile 32 --workers 2 -o table.csv": 5,
    "segment scan.zarr --prior tubes --weight 1 --steps 20 --tile 24 -o mask.nii.gz": 10,
    "reconstruct mask.zarr --every 8 --tile 32 -o filled.zarr": 10,
    "reconstruct mask.zarr --every 8 --tile 32 --workers 2 -o filled.zarr": 5,
}


def start(words: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start a command in a folder, in a group of its own."""
    program = [sys.executable, "-m", "curvafit", *words.split()]
    pipe, threads = subprocess.PIPE, {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    more = {"env": os.environ | threads, "start_new_session": True}
    return subprocess.Popen(program, cwd=folder, stdout=pipe, stderr=pipe, **more)


def digest(folder: Path, inputs: set[Path]) -> dict[str, str]:
    """Return digests of what a command wrote, but for records and pictures, which have dates, and hidden folders."""
    files = {path: path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()}
    kept = {path: name for path, name in files.items() if path not in inputs and not str(name).startswith(".")}
    kept = {path: name for path, name in kept.items() if path.suffix not in (".png", ".html") and len(name.parts) > 1 or path.suffix in (".csv", ".gz")}
    return {str(name): hashlib.sha256(path.read_bytes()).hexdigest() for path, name in kept.items()}


def killed(words: str, seed: int, cases: Cases) -> Values:
    """Kill a command `KILLS` times; return the kills, and whether something was lost."""
    folder, chance = cases.folder / "work", random.Random(f"{words} {seed}")
    remove(folder)
    folder.mkdir(parents=True)
    noise = np.random.default_rng(1)
    smooth = ndimage.gaussian_filter(noise.normal(size=SHAPE), 3)
    mask = smooth > np.quantile(smooth, 0.6)
    grey = (100 * mask + noise.normal(0, 20, SHAPE)).astype(np.float32)
    for values, name in ((grey, "scan.zarr"), (mask.astype(np.uint8), "mask.zarr")):
        save(Volume(values, (0.5, 0.5, 0.5), "um"), folder / name)
    inputs = set(folder.rglob("*"))
    begun = time.monotonic()
    process = start(words, folder)
    errors = process.communicate()[1]
    if process.returncode:
        raise SystemExit(errors.decode())
    whole, expected = time.monotonic() - begun, digest(folder, inputs)
    for path in set(folder.iterdir()) - inputs:
        remove(path)
    kills = 0
    while kills < KILLS:
        process = start(words, folder)
        try:
            process.communicate(timeout=chance.uniform(0.3 * whole, whole))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
            continue
        if process.returncode or digest(folder, inputs) != expected:
            return {"kills": kills, "lost": 1}
        for path in set(folder.iterdir()) - inputs:
            remove(path)
    process = start(words, folder)
    process.communicate()
    return {"kills": kills, "lost": int(process.returncode != 0 or digest(folder, inputs) != expected)}


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    jobs = {f"{words}, {k}": partial(killed, words, k, cases) for words, count in JOBS.items() for k in range(count)}
    found = cases.all(dict(list(jobs.items())[:1]) if options.quick else jobs)
    show(["case", "kills", "lost"], [[name, *row.values()] for name, row in found.items()])
    return {"one.kills": Figure(sum(row["lost"] for row in found.values()))}
