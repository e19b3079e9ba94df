"""Time to texture: a schedule against the published one, in seconds, energy and curvature diagram.

    python -m benchmarks.texture [--presets tubes,seeds,…] [--schedule fast] [--seeds 3] [--first 0] [--edge 100]
                                 [-o texture] [--start]

For each preset and schedule: the mean energy, and the seconds of one shape. Distances are those of geometric diagrams:
`noise` between two seeds of `paper`, `cross` from a seed of the schedule to one of `paper`, `bias` between the two
pooled diagrams (all seeds' surfaces together), which is what a schedule changes on top of a seed's noise; between twice
three shapes of one schedule it is some 0.6 of the noise. `--first` is the first seed: choose a schedule on some, report
it on others. Shapes are kept in the folder with the commit and the schedule that made them: a killed run begins with
the shape it was at, and a second one only prints.

`--start` times the command line, start-up included, against 8000 steps of plain torch (timed over a few).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from itertools import combinations, product
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import torch
from rich.progress import Progress

from benchmarks.step import plain_stepper
from curvafit.core.files import write_atomically
from curvafit.generation.flow import generate
from curvafit.generation.schedule import SCHEDULES
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.transport import wasserstein
from curvafit.priors.grid import WORKING_EPSILON, Grid

#: Tubes of three kinds, layers, spheres of two kinds, sponges of two kinds, trabeculae, metatubes, the paper's flow.
PRESETS = (
    "tubes", "seeds", "bilinear-tubes", "bilayers", "bilinear-spheres", "pearls", "sponge", "sieve", "trabec",
    "metatubes", "flow",
)  # fmt: skip


class Shape(NamedTuple):
    """What is kept of a generated shape: F_ε, seconds, whether it is viable, diagram, commit."""

    energy: float
    seconds: float
    viable: bool
    diagram: Diagram
    commit: str


class Row(NamedTuple):
    """A preset's comparison."""

    energies: tuple[float, float]
    seconds: tuple[float, float]
    noise: float
    cross: float
    bias: float


def shape_of(name: str, schedule: str, seed: int, edge: int, folder: Path, *, floored: bool = False) -> Shape:
    """Generate and measure, or read what an earlier run kept; `floored` rounds u down to 1/100 first."""
    stem = f"{name}-{schedule}-{edge}-{seed}{'-floored' * floored}"
    path, plan = folder / f"{stem}.npz", repr(SCHEDULES[schedule])
    if not path.exists() or _plan(path) != plan:
        grid = Grid((edge,) * 3)
        begun = time.perf_counter()
        with Progress(transient=True) as progress:
            task = progress.add_task(path.stem)
            flow = generate(
                name,
                grid=grid,
                schedule=schedule,
                seed=seed,
                callbacks=[lambda made, total, state: progress.update(task, completed=made, total=total)],
            )
        seconds = time.perf_counter() - begun
        u = torch.floor(flow.field * 100) / 100 if floored else flow.field
        found = diagram(u, grid, WORKING_EPSILON)
        figures = np.array([flow.history.energy[-1], seconds, flow.viability.viable])
        kept = {"figures": figures, "points": found.points, "weights": found.weights, "commit": _commit(), "plan": plan}
        write_atomically(path, lambda temporary: np.savez_compressed(temporary, **kept))
    with np.load(path) as kept:
        energy, seconds, viable = kept["figures"]
        found = Diagram(kept["points"], kept["weights"])
        return Shape(float(energy), float(seconds), bool(viable), found, str(kept["commit"]))


def _plan(path: Path) -> str:
    """The schedule that made a kept shape; nothing in files that do not say."""
    with np.load(path) as kept:
        return str(kept.get("plan", ""))


def _commit() -> str:
    asked = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return asked.stdout.strip() or "unknown"


def compare(paper: list[Shape], other: list[Shape]) -> Row:
    """Distances within and between two schedules' shapes."""
    cross = np.mean([wasserstein(a.diagram, b.diagram) for a, b in product(other, paper)])
    bias = wasserstein(_pooled(other), _pooled(paper))
    energies = tuple(float(np.mean([shape.energy for shape in shapes])) for shapes in (paper, other))
    seconds = tuple(float(np.median([shape.seconds for shape in shapes])) for shapes in (paper, other))
    return Row(energies, seconds, noise_of(paper), float(cross), float(bias))


def noise_of(shapes: list[Shape]) -> float:
    """Mean distance between two seeds."""
    return float(np.mean([wasserstein(a.diagram, b.diagram) for a, b in combinations(shapes, 2)]))


def _pooled(shapes: list[Shape]) -> Diagram:
    parts = [shape.diagram.normalised for shape in shapes]
    return Diagram(np.concatenate([d.points for d in parts]), np.concatenate([d.weights for d in parts]))


def start_up(edge: int) -> tuple[float, float]:
    """Seconds of `curvafit generate`, from the shell and back, and of 8000 steps in plain torch."""
    plain = plain_stepper(edge)
    plain.step(1e-3)
    begun = time.perf_counter()
    for _ in range(3):
        plain.step(1e-3)
    slow = (time.perf_counter() - begun) / 3 * SCHEDULES["paper"].steps
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        out = f"{folder}/tubes.nii.gz"
        command = [sys.executable, "-m", "curvafit", "generate", "--preset", "tubes", "--shape", str(edge), "-o", out]
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - begun, slow


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--schedule", choices=[name for name in SCHEDULES if name != "paper"], default="fast")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--edge", type=int, default=100)
    parser.add_argument("--start", action="store_true", help="only time a start from the shell")
    parser.add_argument("-o", "--output", type=Path, default=Path("texture"))
    options = parser.parse_args()
    if options.start:
        ours, plain = start_up(options.edge)
        print(
            f"{options.edge}³: curvafit generate {ours:.1f} s, 8000 plain steps {plain:.0f} s, {plain / ours:.0f} times"
        )
        return
    options.output.mkdir(parents=True, exist_ok=True)
    pair, seeds = ("paper", options.schedule), range(options.first, options.first + options.seeds)
    plans = ", ".join(f"{name} {SCHEDULES[name].steps}" for name in pair)
    threads = numba.get_num_threads()
    print(f"{options.edge}³, seeds {[*seeds]}; steps: {plans}; {threads} threads; {_commit()}")
    names = (*(f"E {name}" for name in pair), "noise", "cross", "bias", "/noise", *(f"s {name}" for name in pair))
    print(f"{'preset':17}" + "".join(f"{name:>9}" for name in names))
    for name in options.presets.split(","):
        paper, other = ([shape_of(name, plan, k, options.edge, options.output) for k in seeds] for plan in pair)
        row = compare(paper, other)
        distances = (row.noise, row.cross, row.bias, row.bias / row.noise)
        print(
            f"{name:17}"
            + "".join(f"{energy:9.1f}" for energy in row.energies)
            + "".join(f"{distance:9.2f}" for distance in distances)
            + "".join(f"{seconds:9.1f}" for seconds in row.seconds),
            flush=True,
        )


if __name__ == "__main__":
    main()
