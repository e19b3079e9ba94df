"""`curvafit reconstruct` in blocks: how far it is from the whole, and what is lost when processes are killed.

A generated shape of 64³ is repeated along each axis, with a rest that leaves a last block of 3 voxels; every eighth
slice is known. Blocks of 64, 96, 128 and 51 voxels are compared with the volume filled at once, the worst counts. Then
four workers fill it in blocks of 32, and at random moments one of them is killed (SIGKILL), or now and then the whole
command, which is run again, until there were so many kills; the files are compared with those of an undisturbed run.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.completion import EDGE, shape
from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.segmentation.trials import dice

EVERY, REST = 8, 3
#: Edges of blocks.
BLOCKS = (64, 96, 128, 51)
#: Seconds between two kills, at most; one kill in so many is that of the whole command.
PAUSE, ALL = 4.0, 10
COMMAND = ("-m", "curvafit", "reconstruct")


def write_labels(law: str, edge: int, cases: Cases) -> Path:
    """Write labels of a repeated shape, uint8, and return the path."""
    path, numbers = cases.folder / f"labels-{law}-{edge}.npy", np.arange(edge) % EDGE
    np.save(path, shape(law, 0, cases)[np.ix_(numbers, numbers, numbers)].astype(np.uint8))
    return path


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return mask and probability."""
    from curvafit.volumes import load

    return load(path).values > 0, load(path.with_name(f"{path.stem}_probability.zarr")).values


def compare(law: str, edge: int, block: int, cases: Cases) -> Values:
    """Return the Dice of the mask in blocks with that of the whole, and the largest difference of a probability."""
    from curvafit.segmentation.reconstruct import reconstruct
    from curvafit.volumes import load

    labels, out = write_labels(law, edge, cases), cases.folder / f"blocks-{block}.zarr"
    whole = reconstruct(load(labels), every=EVERY)
    run_python(*COMMAND, labels, "--every", EVERY, "--tile", block, "-o", out, "--overwrite")
    mask, likely = read(out)
    assert whole.probability is not None
    differ = float(np.abs(likely - whole.probability.values).max())
    return {"dice": dice(mask, whole.mask.values), "differ": differ}


def kill(law: str, edge: int, count: int, cases: Cases) -> Values:
    """Return how many voxels a run that is killed so many times loses, its kills, and the files it leaves besides."""
    labels, names = write_labels(law, edge, cases), ("undisturbed", "killed")
    files = {name: cases.folder / name / "mask.zarr" for name in names}
    options = ("--every", EVERY, "--tile", 32, "--workers", 4)
    run_python(*COMMAND, labels, *options, "-o", files["undisturbed"], "--overwrite")
    rng, kills, ended = np.random.default_rng(0), 0, False
    while kills < count or not ended:
        command = [sys.executable, *map(str, (*COMMAND, labels, *options, "-o", files["killed"], "--overwrite"))]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None:
                time.sleep(rng.uniform(0, PAUSE))
                kills += kills < count and _kill_one(process.pid, rng)
        ended = process.returncode == 0
    one, other = (read(files[name]) for name in names)
    lost = sum(int(np.count_nonzero(a != b)) for a, b in zip(one, other, strict=True))
    kept, found = ({each.relative_to(path.parent) for each in path.parent.rglob("*")} for path in files.values())
    return {"lost": lost, "kills": kills, "left": len(found ^ kept)}


def _kill_one(pid: int, rng: np.random.Generator) -> bool:
    """Kill a process that fills blocks for a command, or the command itself; return whether there was one."""
    import psutil

    try:
        main = psutil.Process(pid)
        workers = [each for each in main.children(recursive=True) if "spawn_main" in " ".join(each.cmdline())]
        chosen = main if rng.integers(ALL) == 0 else workers[rng.integers(len(workers))] if workers else None
        if chosen is not None:
            chosen.kill()
        return chosen is not None
    except psutil.NoSuchProcess:
        return False


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--law", default="tubes")
    parser.add_argument("--edge", type=int, default=256)
    parser.add_argument("--kills", type=int, default=200)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    law, edge = options.law, (64 if options.quick else options.edge) + REST
    blocks, kills = ((64,), 1) if options.quick else (BLOCKS, options.kills)
    jobs = {f"{law}-{edge}-{block}": lambda block=block: compare(law, edge, block, cases) for block in blocks}
    found = cases.all(jobs)
    small = (1 if options.quick else 2) * EDGE + REST
    killed = cases.all({f"kills-{law}-{kills}": lambda: kill(law, small, kills, cases)} if kills else {})
    show(["case", "Dice", "largest difference"], [[name, *row.values()] for name, row in found.items()])
    show(["case", "voxels lost", "kills", "files left"], [[name, *row.values()] for name, row in killed.items()])
    figures: dict[str, Figure] = {}
    if found:
        figures["equal.dice"] = Figure(min(row["dice"] for row in found.values()))
        figures["equal.differ"] = Figure(max(row["differ"] for row in found.values()))
    for row in killed.values():
        figures |= {f"killed.{key}": Figure(value) for key, value in row.items()}
    return figures
