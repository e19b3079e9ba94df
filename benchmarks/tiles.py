"""Volumes of any size: time and peak memory of `reconstruct` in tiles, and whether the tiles show.

    python -m benchmarks.tiles time [--edge 96,256,512] [--tile 192] [--workers 2] [--no-calibration] [-o tiles]
    python -m benchmarks.tiles chunks [--edge 384] [--tiles 96,128,192] [--laws tubes,trabec] [-o tiles]
    python -m benchmarks.tiles overlap [--laws tubes,trabec] [--edge 88] [--tile 44] [-o tiles]

The shape is a generated one of 64³ that is repeated along each axis (it is periodic) and cut at the edge, every 8th
slice known, the law the true one.

- `time`: `curvafit reconstruct` in a process of its own, from an NPY file to a Zarr store. Columns: edge, tile,
  seconds, peak memory of the process and of its largest worker in GB, what it says in the end. Bars: 96³ calibrated in
  60 s, 256³ in 8 minutes on 2 cores, 512³ under 4 GB.
- `chunks`: 1 - Dice between the volumes of one edge filled in tiles of several sizes. Bar: 1e-3. Tiles of one volume
  have equal sizes: an edge that all sizes divide compares just these.
- `overlap`: a volume in tiles against the whole, by the overlap. Columns: edge, tile, overlap in voxels, 1 - Dice,
  largest and mean difference of u. The share falls as the tile's edge grows: what differs lies near the cuts.

Masks that are finished stay in the folder, and tiles of a run that was stopped: a second run goes on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from itertools import combinations
from pathlib import Path

import numpy as np

from benchmarks.completion import EDGE, shape
from curvafit.core.files import write_atomically, write_content
from curvafit.segmentation import reconstruct, tiles
from curvafit.segmentation.completion import STIFFNESS

EVERY = 8
#: Runs the command line, and prints the peak memory of the process and of its largest child in KiB.
PROGRAM = """
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from curvafit.cli.app import app
try:
    app()
finally:
    print(*(getrusage(who).ru_maxrss for who in (RUSAGE_SELF, RUSAGE_CHILDREN)))
"""


def volume(law: str, edge: int, folder: Path) -> Path:
    """A shape of any edge, made once: that of 64³ repeated."""
    path = folder / f"volume-{law}-{edge}.npy"
    if not path.exists():
        numbers = np.arange(edge) % EDGE
        mask = shape(law, 0, folder)[np.ix_(numbers, numbers, numbers)].astype(np.uint8)
        write_atomically(path, lambda temporary: np.save(temporary, mask))
    return path


def dice(one: np.ndarray, other: np.ndarray) -> float:
    return 2 * float(np.count_nonzero(one & other)) / float(np.count_nonzero(one) + np.count_nonzero(other))


def timed(law: str, edge: int, args: argparse.Namespace) -> dict:
    """Time and memory of the command, in a process of its own, measured once."""
    name = f"time-{law}-{edge}-{args.tile}-{args.workers}-{'plain' if args.no_calibration else 'calibrated'}"
    record = args.output / f"{name}.json"
    if not record.exists():
        source, target = volume(law, edge, args.output), args.output / f"{name}.zarr"
        options = f"--every {EVERY} --prior {law} --workers {args.workers} --overwrite -o {target}".split()
        options += ["--tile", str(args.tile)] if args.tile else []
        options += ["--stiffness", str(STIFFNESS)] if args.no_calibration else []
        begun = time.monotonic()
        command = [sys.executable, "-c", PROGRAM, "reconstruct", str(source), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds, lines = time.monotonic() - begun, done.stdout.strip().splitlines()
        if done.returncode:
            raise SystemExit(done.stderr)
        own, worker = (int(n) * 1024 / 1e9 for n in lines[-1].split())
        said = next(line for line in lines if "volume is inside" in line)
        write_content(record, json.dumps({"seconds": seconds, "own": own, "worker": worker, "said": said}))
    return json.loads(record.read_text())


def filled(law: str, edge: int, tile: int | None, folder: Path) -> np.ndarray:
    """A volume filled in tiles, made once."""
    path = folder / f"filled-{law}-{edge}-{tile}.npy"
    if not path.exists():
        store = folder / f"store-{law}-{edge}-{tile}"
        found = reconstruct(volume(law, edge, folder), law, every=EVERY, stiffness=STIFFNESS, tile=tile, store=store)
        write_atomically(path, lambda temporary: np.save(temporary, found.mask.values))
    return np.load(path)


def chunks(law: str, edge: int, sizes: list[int], folder: Path) -> None:
    """Print how far volumes in tiles of several sizes differ."""
    masks = {size: filled(law, edge, size, folder) for size in sizes}
    for one, other in combinations(sizes, 2):
        print(f"{law:9}{edge:5}{one:6}{other:6}{1 - dice(masks[one], masks[other]):12.2e}", flush=True)


def overlap(law: str, edge: int, tile: int, folder: Path) -> None:
    """Print by how much a volume in tiles differs from the whole, by the overlap of the tiles."""
    options = {"every": EVERY, "stiffness": STIFFNESS}
    whole = reconstruct(volume(law, edge, folder), law, **options)
    for width in (4, 8, 12, 16, 20, 24, 28):
        tiles.OVERLAP = width
        found = reconstruct(volume(law, edge, folder), law, tile=tile, **options)
        moved = np.abs(found.phase.values - whole.phase.values)
        figures = f"{1 - dice(found.mask.values, whole.mask.values):12.2e}{moved.max():12.2e}{moved.mean():12.2e}"
        print(f"{law:9}{edge:5}{tile:5}{width:5}{figures}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("time", "chunks", "overlap"))
    parser.add_argument("--laws", default="tubes")
    parser.add_argument("--edge", help="edges of the volumes; by default 96 (384 for chunks, 88 for overlap)")
    parser.add_argument("--tile", type=int)
    parser.add_argument("--tiles", default="96,128,192")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--no-calibration", action="store_true", help="lower the law without trying it out")
    parser.add_argument("-o", "--output", type=Path, default=Path("tiles"))
    args = parser.parse_args()
    args.edge = args.edge or {"time": "96", "chunks": "384", "overlap": "88"}[args.what]
    args.output.mkdir(parents=True, exist_ok=True)
    for law in args.laws.split(","):
        if args.what == "overlap":
            overlap(law, int(args.edge), args.tile or int(args.edge) // 2, args.output)
            continue
        for edge in map(int, args.edge.split(",")):
            if args.what == "chunks":
                chunks(law, edge, [int(size) for size in args.tiles.split(",")], args.output)
                continue
            row = timed(law, edge, args)
            figures = f"{row['seconds']:9.0f} s{row['own']:8.2f}{row['worker']:8.2f} GB"
            print(f"{law:9}{edge:5}{args.tile or 'auto':>6}{figures}  {row['said']}", flush=True)


if __name__ == "__main__":
    main()
