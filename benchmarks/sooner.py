"""Ways to the published flow's end, of which `fast` is one, and whether they come near to it.

    python -m benchmarks.sooner [--presets sponge,bilayers] [--ways fast,deep,coarse,…] [--seeds 3] [--first 0]
                                [--edge 64] [--author] [-o sooner]

`coarse`: all published steps on half the grid (ε is one voxel there), from the mean of eight voxels of `generate`'s
start, then 500 on the full grid. `noise`: `deep` with A shaken every ten steps, by less and less until step 1000.
`restart`: `deep` with its momentum forgotten whenever the energy rises. `settled`: `deep` until ten steps lower the
energy by less than 1 %. `level`: steps as long in all as those of `paper`. `fourier`: `deep`'s published steps, then
400 with momentum, the gradient divided in Fourier space by F_ε's second derivative at rest.

`cost` is in steps of the full grid (a Fourier step counts as three). E, `noise` and `/noise` are those of
`benchmarks.texture`, beside `paper`, whose folder may be shared: shapes are kept. With `--author` (and --edge 100)
`distance` is the mean distance to the author's volume, as in `benchmarks.gallery`; there one seed is enough.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy import fft, ndimage

from benchmarks.gallery import author_volume, is_floored
from benchmarks.texture import Shape, compare, shape_of
from curvafit.core.files import write_atomically
from curvafit.generation.flow import WORKING_BLUR
from curvafit.generation.initial import white_noise
from curvafit.generation.schedule import SCHEDULES, Schedule
from curvafit.generation.stepper import ADAM_EPS
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.transport import wasserstein
from curvafit.priors.coefficients import preset
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.kernels.cpu import FusedFlow, energy_gradient

PAPER, FAST, DEEP = (SCHEDULES[name] for name in ("paper", "fast", "deep"))
_PEAK = 1.18e-2
LEVEL = replace(DEEP, start=_PEAK, opening=(DEEP.opening[0], replace(DEEP.opening[1], stop=_PEAK)))
#: What is asked after a step, of the flow, the energies before the steps so far and a generator: whether to stop.
Question = Callable[[FusedFlow, list[float], np.random.Generator], bool]


def fused(name: str, grid: Grid, start: np.ndarray) -> FusedFlow:
    """Begin a flow. Its slopes are as large as a voxel, and so is the number that Adam adds to their root."""
    law, small = preset(name), ADAM_EPS * grid.voxel_volume / WORKING_SPACING**3
    cost = law.coefficients, grid, WORKING_EPSILON, WORKING_BLUR
    return FusedFlow(start, law.mass, *cost, betas=DEEP.betas, adam_eps=small)


def steps(flow: FusedFlow, plan: Schedule, count: int, ask: Question = lambda *_: False, seed: int = 0) -> int:
    """Make the first steps of a schedule until a yes; return their number."""
    energies, rng = [], np.random.default_rng(seed)
    while len(energies) < count:
        flow.betas = plan.betas_at(len(energies))
        energies.append(flow.evaluate())
        flow.update(plan.rate(len(energies) - 1))
        if ask(flow, energies, rng):
            break
    return len(energies)


def along(name: str, edge: int, seed: int, ask: Question = lambda *_: False, plan: Schedule = DEEP) -> tuple:
    """Follow `deep`, or another plan; return energy, u and cost, as the other ways do."""
    flow = fused(name, Grid(edge), white_noise(Grid(edge), seed).numpy())
    count = steps(flow, plan, plan.steps, ask, seed)
    return flow.evaluate(), flow.field, count


def coarse(name: str, edge: int, seed: int, rest: int = 500) -> tuple:
    start = white_noise(Grid(edge), seed).numpy().reshape(3, *(edge // 2, 2) * 3).mean((2, 4, 6))
    half = fused(name, Grid((edge // 2,) * 3, (2 * WORKING_SPACING,) * 3), start)
    steps(half, PAPER, PAPER.steps)
    state = half.state()
    for moment, power in (("vector", 0), ("first", 1), ("second", 2)):
        parts = [ndimage.zoom(each, 2, order=1, mode="grid-wrap", grid_mode=True) for each in state[moment]]
        state[moment] = np.array(parts) / 8**power
    flow = fused(name, Grid(edge), state["vector"])
    flow.restore(state)
    steps(flow, PAPER, rest)
    return flow.evaluate(), flow.field, PAPER.steps / 8 + rest


def shaken(flow: FusedFlow, energies: list[float], rng: np.random.Generator) -> bool:
    k, until = len(energies) - 1, 1000
    if k % 10 == 0 and k < until:
        flow.vector[...] += rng.uniform(-0.05, 0.05, flow.vector.shape) * (1 - k / until)
    return False


def restarted(flow: FusedFlow, energies: list[float], _) -> bool:
    if energies[-1] > energies[-2:][0]:
        state = flow.state()
        flow.restore({**state, "first": 0 * state["first"]})
    return False


def settled(_, energies: list[float], __) -> bool:
    regular = len(energies) % 10 == 1 and len(energies) > 10
    return regular and energies[-11] - energies[-1] < 0.01 * abs(energies[-1])


def fourier(name: str, edge: int, seed: int, count: int = 400, length: float = 0.2, momentum: float = 0.9) -> tuple:
    grid, law, opening = Grid(edge), preset(name), DEEP.bounds[0]
    flow = fused(name, grid, white_noise(grid, seed).numpy())
    steps(flow, DEEP, opening)
    flow.evaluate()
    axis = 2 * np.pi * fft.fftfreq(edge, WORKING_SPACING)
    k2 = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis[: edge // 2 + 1] ** 2).astype(np.float32)
    a20, _, a02, *_ = law.coefficients
    stiffness = WORKING_EPSILON * (a20 + a02) * (k2 + 2 / WORKING_EPSILON**2) ** 2 * grid.voxel_volume
    factor = np.exp(-k2 * WORKING_BLUR**2) / stiffness
    factor[0, 0, 0] = 0  # the mass stays
    u, speed, energy = flow.field.copy(), np.zeros(grid.shape, np.float32), np.nan
    for _ in range(count):
        energy, slope = energy_gradient(u + momentum * speed, law.coefficients, grid, WORKING_EPSILON)
        speed = momentum * speed - length * fft.irfftn(factor * fft.rfftn(slope), grid.shape)
        u += speed
    return energy, u, opening + 3 * count


WAYS: dict[str, Callable[[str, int, int], tuple]] = {
    "fast": lambda *case: along(*case, plan=FAST),
    "deep": along,
    "level": lambda *case: along(*case, plan=LEVEL),
    "coarse": coarse,
    "noise": lambda *case: along(*case, shaken),
    "restart": lambda *case: along(*case, restarted),
    "settled": lambda *case: along(*case, settled),
    "fourier": fourier,
}


def shape_along(way: str, name: str, seed: int, *, edge: int, folder: Path, floored: bool) -> tuple[Shape, float]:
    """Follow a way, or read what an earlier run kept; return the shape and the cost."""
    path = folder / f"{name}-{way}-way-{edge}-{seed}{'-floored' * floored}.npz"
    if not path.exists():
        energy, u, cost = WAYS[way](name, edge, seed)
        u = torch.from_numpy(np.floor(u * 100) / 100 if floored else u)
        found = diagram(u, Grid(edge), WORKING_EPSILON)
        kept = {"figures": np.array([energy, cost]), "points": found.points, "weights": found.weights}
        write_atomically(path, lambda temporary: np.savez_compressed(temporary, **kept))
    with np.load(path) as kept:
        energy, cost = kept["figures"].tolist()
        return Shape(energy, 0.0, True, Diagram(kept["points"], kept["weights"]), ""), cost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default="sponge,bilayers")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--edge", type=int, default=64)
    parser.add_argument("--author", action="store_true", help="beside the author's volumes in $CURVAFIT_DATA/gallery")
    parser.add_argument("-o", "--output", type=Path, default=Path("sooner"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.seeds)
    print(f"{options.edge}³, seeds {[*seeds]}")
    heads = ("cost", "E", "distance") if options.author else ("cost", "E", "noise", "/noise")
    print(f"{'preset':18}{'way':10}" + "".join(f"{head:>10}" for head in heads))
    for name in options.presets.split(","):
        u = author_volume(Path(os.environ["CURVAFIT_DATA"]) / "gallery", name) if options.author else None
        of = {"edge": options.edge, "folder": options.output, "floored": u is not None and is_floored(u)}
        paper = [] if options.author else [shape_of(name, "paper", seed=seed, **of) for seed in seeds]
        for way in options.ways.split(","):
            ends, costs = zip(*(shape_along(way, name, seed, **of) for seed in seeds), strict=True)
            figures = [np.mean(costs), np.mean([end.energy for end in ends])]
            if u is None:
                row = compare(paper, [*ends])
                figures += [row.noise, row.bias / row.noise]
            else:
                author = diagram(u, Grid(options.edge), WORKING_EPSILON)
                figures.append(np.mean([wasserstein(author, end.diagram) for end in ends]))
            print(f"{name:18}{way:10}" + "".join(f"{figure:10.2f}" for figure in figures), flush=True)


if __name__ == "__main__":
    main()
