"""Tubes along a direction and layers that contain it (paper, "Extensions", Fig. "Including orientation").

python examples/orientation.py [--small] [--edge 100] [--schedule fast] [-o orientation]

Tubes a = (1, 2, 6, -40, -40, 400), m₀ = -0.6, μ = 0 or 1000; layers a = (1, 1, 1, 0, 0, 0), m₀ = -0.4, μ = 0 or 800;
θ along z, upwards in the picture. A second picture has both in boxes with walls where θ turns by 90°: it runs along
circles about an edge of the box, and meets the walls squarely. The table has the mean of (θ·n)² over the surface (1/3
where there is no preferred direction), and how far curvatures are from those of a perfect cylinder, (20, 0), or plane,
(0, 0): the root of the mean square, and the median. Finished shapes are kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from common import CELL, DIAGRAM, KINDS, SURFACE, Shape, draw, grown, kept, parser, plan_of, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import DIAGONAL, surface_on, write_picture
from curvafit.generation.flow import Execution, generate
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.mesh import area_vectors, surface
from curvafit.priors.energies import orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

#: θ along (z, y, x).
DIRECTION = (1, 0, 0)
#: θ at points `(N, 3)`, of any length.
Direction = Callable[[np.ndarray], np.ndarray]


class Case(NamedTuple):
    """A preset, the strength μ, the (κ1, κ2) of its perfect shape, and whether θ turns."""

    name: str
    preset: str
    strength: float
    ideal: tuple[float, float]
    turns: bool = False


CASES = (
    Case("tubes", "tubes", 0, (20, 0)),
    Case("tubes-aligned", "tubes", 1000, (20, 0)),
    Case("layers", "bilayers", 0, (0, 0)),
    Case("layers-aligned", "bilayers", 800, (0, 0)),
    Case("tubes-turning", "tubes", 1000, (20, 0), turns=True),
    Case("layers-turning", "bilayers", 800, (0, 0), turns=True),
)


def main() -> None:
    options = parser(__doc__, "orientation").parse_args()
    shapes, lines = {}, [HEAD]
    for case in CASES:
        shape = shapes[case] = turned(case, options) if case.turns else straight(case, options)
        line = f"{case.name:14} {case.strength:5g} {lean(shape.field, circling if case.turns else None):9.3f}"
        for kind in shape.diagrams:
            line += "{:9.2f} {:7.2f}".format(*spread(shape.diagrams[kind], case.ideal))
        lines.append(f"{line}   {shape.facts['status']}")
    write_table(options, "orientation", lines, [shape.facts["program"] for shape in shapes.values()])
    plain = {case: shape for case, shape in shapes.items() if not case.turns}
    figure = Figure(figsize=(CELL * len(plain), SURFACE + DIAGRAM), layout="constrained")
    titles = {case: f"{case.name.partition('-')[0]}, μ = {case.strength:g}" for case in plain}
    draw(figure, {titles[case]: (s.field, s.diagrams.get(options.curvature)) for case, s in plain.items()}, len(plain))
    arrow = {"arrowstyle": "->", "color": DIAGONAL, "linewidth": 1.6}
    for axes, case in zip(figure.axes, plain, strict=False):
        if case.strength:
            axes.annotate("", (-0.04, 0.65), (-0.04, 0.35), "axes fraction", "axes fraction", arrowprops=arrow)
            axes.text(-0.04, 0.66, "θ", color=DIAGONAL, ha="center", transform=axes.transAxes)
    print(write_picture(figure, options.output / "orientation.png"))
    turning = [shape for case, shape in shapes.items() if case.turns]
    figure = Figure(figsize=(2 * CELL * len(turning), 2 * CELL), layout="constrained")
    for axes, shape in zip(figure.subplots(1, len(turning)), turning, strict=True):
        surface_on(axes, shape.field, width=900)
    print(write_picture(figure, options.output / "turning_direction.png"))


def straight(case: Case, options: argparse.Namespace) -> Shape:
    """Grow a shape with θ upwards, or without a direction."""
    law, Q = preset(case.preset), orientation(DIRECTION, case.strength) if case.strength else None
    return grown(options.output / f"{case.name}.npz", law.coefficients, law.mass, options, orientation=Q)


def turned(case: Case, options: argparse.Namespace) -> Shape:
    """Grow a shape in a box with walls, with θ along circles about an edge of it."""
    grid, plan, law = Grid(options.edge, boundary="replicate"), plan_of(options), preset(case.preset)
    voxels = np.moveaxis(np.indices(grid.shape), 0, -1)
    Q = orientation(torch.from_numpy(circling(voxels)).moveaxis(-1, 0), case.strength)
    more = {"schedule": plan, "seed": options.seed, "execution": Execution(device=options.device)}
    about = {"a": law.point, "grid": grid.shape, "plan": plan.as_dict(), "seed": options.seed, "μ": case.strength}
    make = lambda: generate(law, grid=grid, orientation=Q, **more)  # noqa: E731
    return kept(options.output / f"{case.name}.npz", about, make)


def upwards(points: np.ndarray) -> np.ndarray:
    """θ along z at points (z, y, x)."""
    return np.broadcast_to(np.array(DIRECTION, dtype=float), points.shape)


def circling(points: np.ndarray) -> np.ndarray:
    """θ along circles about the edge z = x = 0 of the box, whose first voxel's centre is (0, 0, 0)."""
    z, y, x = np.moveaxis(points + 0.5, -1, 0)
    return np.stack((-x, 0 * y, z), -1)


HEAD = f"{'shape':14} {'μ':>5} {'(θ·n)²':>9}" + "".join(f" {kind + ' rms':>13} {'median':>7}" for kind in KINDS)


def lean(u: np.ndarray, direction: Direction | None = None) -> float:
    """The mean of (θ·n)² over the surface: of a periodic box with θ upwards, or one with walls and a `direction`."""
    mesh = surface(u, Grid(u.shape, 1.0, "replicate" if direction else "periodic"))
    vectors, θ = area_vectors(mesh)[:, ::-1], (direction or upwards)(mesh.barycentres)
    sizes = np.linalg.norm(vectors, axis=1)
    along = (vectors * θ).sum(1) / np.linalg.norm(θ, axis=1)
    return float((along**2 / np.maximum(sizes, 1e-30)).sum() / sizes.sum())


def spread(seen: Diagram, ideal: tuple[float, float]) -> tuple[float, float]:
    """Distance of curvatures to one point: root of the mean square over the area, and median."""
    away = np.linalg.norm(seen.points - np.array(ideal), axis=1)
    order = np.argsort(away)
    half = np.searchsorted(np.cumsum(seen.weights[order]), seen.area / 2)
    return float(np.sqrt(seen.normalised.weights @ away**2)), float(away[order][half])


if __name__ == "__main__":
    main()
