"""What `curvafit generate` costs beside its flow, warm and cold, and beside another checkout.

    python -m benchmarks.command [--sizes 100,256] [--runs 3] [--beside FOLDER] [--cold] [--whole 100]

Seconds from the shell and back. `fixed` is a run of one step: start, imports, start of the flow, files, picture.
`whole` is a run of all steps of the schedule, of the sizes that `--whole` names; `flow` is what remains without the
fixed cost. `--cold` also starts with nothing compiled: an empty folder for the kernels' cache. Checkouts take turns in
one run, so that a busy machine slows both; medians, and the least and the most.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def seconds(checkout: Path, size: int, *options: str, cold: bool = False) -> float:
    """One run of a checkout's command, in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        if cold:
            environment["NUMBA_CACHE_DIR"] = f"{folder}/cache"
        arguments = ["generate", "--preset", "tubes", "--shape", str(size), "-o", f"{folder}/tubes.nii.gz", *options]
        begun = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "curvafit", *arguments], check=True, capture_output=True, cwd=folder, env=environment
        )
        return time.perf_counter() - begun


def show(label: str, times: list[float]) -> None:
    print(f"{label:28}{np.median(times):8.1f}{min(times):8.1f}{max(times):8.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="100,256")
    parser.add_argument("--whole", default="100", help="sizes of which all steps are made, between commas")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--beside", type=Path, help="the folder of another checkout")
    parser.add_argument("--cold", action="store_true")
    options = parser.parse_args()
    checkouts = {"now": Path(__file__).resolve().parents[1]}
    if options.beside is not None:
        checkouts["beside"] = options.beside.resolve()
    sizes, whole = ({int(n) for n in each.split(",") if n} for each in (options.sizes, options.whole))
    print(f"{'seconds':28}{'median':>8}{'least':>8}{'most':>8}")
    for size in sorted(sizes | whole):
        for checkout in checkouts.values():
            seconds(checkout, size, "--steps", "1")  # the kernels are compiled
        kinds = {"fixed": ("--steps", "1")} | ({"whole": ()} if size in whole else {})
        for kind, arguments in kinds.items():
            times: dict[str, list[float]] = {name: [] for name in checkouts}
            for _ in range(options.runs):
                for name, checkout in checkouts.items():
                    times[name].append(seconds(checkout, size, *arguments))
            for name, each in times.items():
                show(f"{size}³ {kind}, {name}", each)
    if options.cold:
        for name, checkout in checkouts.items():
            each = [seconds(checkout, min(sizes | whole), "--steps", "1", cold=True) for _ in range(options.runs)]
            show(f"{min(sizes | whole)}³ fixed, cold, {name}", each)


if __name__ == "__main__":
    main()
