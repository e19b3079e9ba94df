"""Seeds of one parameter against random shapes (paper, Fig. "Same generation parameters" and Experiment 4).

python examples/seeds.py [--small] [--edge 100] [--count 100] [--schedule fast] [-o seeds]

Five seeds of preset `seeds`, a = (1, -0.35, 1.02, -40, 100, 1600), m₀ = -0.69; viable shapes of the random law, each
from its own noise; and the mean distance between the former over the mean distance between the latter, all pairs of
each. The distance is the paper's, by `curvafit.geometry.distances`: the square root of geomloss's Sinkhorn divergence
with p = 2, blur 1 and reach 20. Finished shapes are kept: a killed run goes on where it was.
"""

from __future__ import annotations

from argparse import Namespace

import numpy as np
from common import CELL, DIAGRAM, KINDS, SURFACE, Shape, draw, grown, parser, write_table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from curvafit.data_synth.design import design_box
from curvafit.drawing.plot import CONTOUR, DIAGONAL, write_picture
from curvafit.geometry.distances import pairwise
from curvafit.priors.law import preset

SEEDS = 5


def main() -> None:
    takes = parser(__doc__, "seeds")
    takes.add_argument("--count", type=int, default=100, help="random viable shapes")
    options = takes.parse_args()
    law = preset("seeds")
    a, mass = law.coefficients, law.mass
    seeds = [options.seed + k for k in range(SEEDS)]
    same = [grown(options.output / f"seed-{seed}.npz", a, mass, options, seed=seed) for seed in seeds]
    if not all(shape.diagrams for shape in same):
        raise SystemExit("expected a shape from every seed, got none from some: more steps or a larger edge")
    drawn, tried = random_shapes(options)
    apart = {kind: (distances(same, kind), distances(drawn, kind)) for kind in KINDS}
    lines = [f"{tried} draws of the random law for {len(drawn)} viable shapes"]
    lines.append(f"{'curvature':10} {'seeds':>7} {'(sd)':>7} {'random':>7} {'(sd)':>7} {'ratio':>7}   published 10.7 %")
    for kind, (near, far) in apart.items():
        line = f"{kind:10} {near.mean():7.3f} {near.std():7.3f} {far.mean():7.3f} {far.std():7.3f}"
        lines.append(f"{line} {near.mean() / far.mean():7.1%}")
    lines += [f"seed {seed}: {shape.facts['status']}" for seed, shape in zip(seeds, same, strict=True)]
    write_table(options, "seeds", lines, [shape.facts["program"] for shape in (*same, *drawn)])
    figure = Figure(figsize=(CELL * SEEDS, SURFACE + DIAGRAM + 3), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[SURFACE + DIAGRAM, 3], squeeze=False).flat
    shown = {f"seed {seed}": (s.field, s.diagrams[options.curvature]) for seed, s in zip(seeds, same, strict=True)}
    draw(above, shown, SEEDS)
    for axes, (kind, (near, far)) in zip(below.subplots(1, len(KINDS)), apart.items(), strict=True):
        histogram(axes, kind, near, far)
    print(write_picture(figure, options.output / "seeds.png"))


def random_shapes(options: Namespace) -> tuple[list[Shape], int]:
    """Draws 0, 1, 2 … of the law until enough are viable; and how many were drawn."""
    found: list[Shape] = []
    index = 0
    while len(found) < options.count:
        a, mass, seed = design_box().draw(options.seed, index)
        path = options.output / f"random-{index:04d}.npz"
        shape = grown(path, a, mass, options, keep=False, seed=seed, reject_early=True)
        found += [shape] if shape.facts["viable"] else []
        index += 1
    return found, index


def distances(shapes: list[Shape], kind: str) -> np.ndarray:
    """The distance of every pair."""
    return pairwise([shape.diagrams[kind] for shape in shapes])[np.triu_indices(len(shapes), 1)]


def histogram(axes: Axes, kind: str, near: np.ndarray, far: np.ndarray) -> None:
    """The random pairs, with a mark at every pair of seeds and at both means."""
    axes.hist(far, bins=40, color="#A9CBE3")
    top = axes.get_ylim()[1]
    axes.vlines(near, 0, 0.12 * top, color=DIAGONAL, linewidth=1)
    axes.axvline(near.mean(), color=DIAGONAL, label=f"seeds, mean {near.mean():.2f}")
    axes.axvline(far.mean(), color=CONTOUR, label=f"random shapes, mean {far.mean():.2f}")
    axes.set(title=f"{kind} curvature: ratio {near.mean() / far.mean():.1%}", xlabel="distance", ylabel="pairs")
    axes.set(xlim=(0, None), ylim=(0, 1.3 * top))
    axes.legend(loc="upper right", edgecolor="none", framealpha=0.9)


if __name__ == "__main__":
    main()
