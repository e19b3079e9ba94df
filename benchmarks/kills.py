"""Kills of `measure`, `segment` and `reconstruct` in tiles: the same command then writes what it would have written.

A command is killed (SIGKILL, with its workers) at a random moment, five times, then left to end: a case. Its table,
mask and probability are compared with those of a run that nobody killed, byte by byte. What a kill may leave is a
hidden folder of a file that was being written.
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
    "measure scan.zarr --tile 32 -o out/table.csv": 10,
    "measure scan.zarr --tile 32 --workers 2 -o out/table.csv": 5,
    "segment scan.zarr --prior tubes --weight 1 --steps 20 --tile 24 -o out/mask.nii.gz": 10,
    "reconstruct mask.zarr --every 8 --tile 32 -o out/filled.zarr": 10,
    "reconstruct mask.zarr --every 8 --tile 32 --workers 2 -o out/filled.zarr": 5,
}


def write_inputs(folder: Path) -> None:
    """Write a mask, and it under noise."""
    noise = np.random.default_rng(1)
    smooth = ndimage.gaussian_filter(noise.normal(size=SHAPE), 3)
    mask = smooth > np.quantile(smooth, 0.6)
    grey = (100 * mask + noise.normal(0, 20, SHAPE)).astype(np.float32)
    for values, name in ((grey, "scan.zarr"), (mask.astype(np.uint8), "mask.zarr")):
        save(Volume(values, (0.5, 0.5, 0.5), "um"), folder / name)


def start(words: str, folder: Path) -> subprocess.Popen:
    """Start a command in a folder, in a group of its own."""
    (folder / "out").mkdir(exist_ok=True)
    program, threads = [sys.executable, "-m", "curvafit", *words.split()], {"OMP_NUM_THREADS": "1"}
    pipe, more = subprocess.PIPE, {"env": os.environ | threads, "start_new_session": True}
    return subprocess.Popen(program, cwd=folder, stdout=pipe, stderr=pipe, **more)


def digest(folder: Path) -> dict[str, str]:
    """Return digests of tables and volumes; records and pictures have dates, and hidden folders are no output."""
    names = {path: str(path.relative_to(folder)) for path in sorted(folder.rglob("*")) if path.is_file()}
    kept = {
        path: name
        for path, name in names.items()
        if name[0] != "." and ("zarr/" in name or name[-3:] in ("csv", ".gz"))
    }
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for path, name in kept.items()}


def finish(words: str, folder: Path) -> dict[str, str]:
    """Let a command end, and return the digests of what it wrote, which is removed; nothing where it failed."""
    process = start(words, folder)
    failed = process.communicate() and process.returncode
    found = {} if failed else digest(folder / "out")
    remove(folder / "out")
    return found


def killed(words: str, seed: int, cases: Cases) -> Values:
    """Kill a command `KILLS` times, then let it end; return the kills, and whether something was lost."""
    folder, chance, kills = cases.folder / "work", random.Random(f"{words} {seed}"), 0
    remove(folder)
    folder.mkdir(parents=True)
    write_inputs(folder)
    begun = time.monotonic()
    expected, whole = finish(words, folder), time.monotonic() - begun
    while kills < KILLS:
        process = start(words, folder)
        try:
            process.communicate(timeout=chance.uniform(0.3 * whole, whole))
            remove(folder / "out")  # it had ended
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
    return {"kills": kills, "lost": int(not expected or finish(words, folder) != expected)}


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    jobs = {f"{words}, {k}": partial(killed, words, k, cases) for words, count in JOBS.items() for k in range(count)}
    found = cases.all(dict(list(jobs.items())[:1]) if options.quick else jobs)
    show(["case", "kills", "lost"], [[name, *row.values()] for name, row in found.items()])
    return {"one.kills": Figure(sum(row["lost"] for row in found.values()))}
