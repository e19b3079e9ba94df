"""Building an atlas: shapes an hour and peak memory with 1 and 2 workers; kills that must lose nothing.

    python -m benchmarks.atlas [--count 24] [--shape 64] [--workers 1,2]
    python -m benchmarks.atlas --kills 5 [--count 12] [--shape 48]

With `--kills`, a build by two workers is begun and, again and again, first one of its workers and then the whole build,
workers included, are killed (SIGKILL) at random moments; after every kill the store is verified, and in the end it is
compared, bit for bit, with one built without a kill.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from curvafit.data_synth import build, cluster, open_store
from curvafit.data_synth.atlas.census import verify


def begun(path: Path, count: int, shape: int, workers: int) -> subprocess.Popen:
    """A build, in a process of its own."""
    options = ["--count", str(count), "--shape", str(shape), "--workers", str(workers)]
    command = [sys.executable, "-m", "curvafit", "atlas", "build", str(path), *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def family(process: subprocess.Popen) -> list[psutil.Process]:
    """A process and those it began."""
    try:
        parent = psutil.Process(process.pid)
        return [parent, *parent.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def memory(process: subprocess.Popen) -> float:
    """What a process and those it began hold now, in GB; pages that they share count once."""
    total = 0
    for each in family(process):
        try:
            total += each.memory_full_info().pss
        except psutil.NoSuchProcess:
            continue
    return total / 1e9


def throughput(folder: Path, count: int, shape: int, workers: int) -> tuple[float, float, float]:
    """Viable shapes an hour from the first draw's end on, seconds until then, and peak memory in GB."""
    path, peak, start = folder / f"{workers}.zarr", 0.0, time.perf_counter()
    process, first = begun(path, count, shape, workers), 0.0
    while process.poll() is None:
        peak = max(peak, memory(process))
        if not first and path.exists() and open_store(path).indices():
            first = time.perf_counter()
        time.sleep(0.2)
    if process.returncode:
        raise SystemExit(f"expected a build that ends well, got exit code {process.returncode}")
    return 3600 * count / (time.perf_counter() - first), first - start, peak


def kill(process: subprocess.Popen, whole: bool, chance: random.Random) -> None:
    """Kill a build with its workers, or one of its workers."""
    workers = [
        each for each in family(process)[1:] if "forkserver" in (name := " ".join(each.cmdline())) or "spawn" in name
    ]
    for each in family(process) if whole else chance.sample(workers, min(1, len(workers))):
        try:
            each.kill()
        except psutil.NoSuchProcess:
            continue
    if whole:
        process.wait()


def kills(folder: Path, rounds: int, count: int, shape: int) -> None:
    """Builds killed at random moments end as one that is left alone."""
    path, chance = folder / "killed.zarr", random.Random(0)
    for number in range(rounds):
        process = begun(path, count, shape, 2)
        for whole in (False, True):
            there = len(open_store(path).indices()) if path.exists() else 0
            while process.poll() is None and not (path.exists() and len(open_store(path).indices()) > there):
                time.sleep(0.1)
            time.sleep(chance.uniform(0, 3))
            kill(process, whole, chance)
            found = verify(path, 0)
            print(
                f"round {number + 1}, {'build' if whole else 'worker'} killed: {found.status} {list(found.problems)}",
                flush=True,
            )
    with cluster(2) as crew:
        killed = build(path, count, shape, workers=crew)
        alone = build(folder / "alone.zarr", count, shape, workers=crew)
    found = verify(path, 2)
    print(f"in the end: {found.status} {list(found.problems + found.notes)}")
    same = killed.indices() == alone.indices() and all(
        np.array_equal(killed.field(k), alone.field(k)) for k in alone.indices() if alone.record(k).viability.viable
    )
    print(f"as a build that was left alone: {same}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--shape", type=int, default=64)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--kills", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.kills:
            return kills(Path(folder), options.kills, options.count, options.shape)
        print("workers  shapes an hour  times  seconds to the first draw  peak GB")
        rates: list[float] = []
        for workers in map(int, options.workers.split(",")):
            rate, wait, peak = throughput(Path(folder), options.count, options.shape, workers)
            rates.append(rate)
            print(f"{workers:7} {rate:15.0f} {rate / rates[0]:6.2f} {wait:26.1f} {peak:8.2f}", flush=True)


if __name__ == "__main__":
    main()
