"""Tubes along a direction and layers that contain it (paper, "Extensions", Fig. "Including orientation").

python examples/orientation.py [--small] [--edge 100] [--schedule fast] [-o orientation]

Tubes a = (1, 2, 6, -40, -40, 400), m₀ = -0.6, μ = 0 or 1000; layers a = (1, 1, 1, 0, 0, 0), m₀ = -0.4, μ = 0 or 800;
θ along z, upwards in the picture. The table has the mean of (θ·n)² over the surface (1/3 where there is no preferred
direction), and how far curvatures are from those of a perfect cylinder, (20, 0), or plane, (0, 0): the root of the mean
square, and the median. Finished shapes are kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from common import CELL, DIAGRAM, KINDS, SURFACE, draw, grown, parser, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import DIAGONAL, write_picture
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.mesh import area_vectors, surface
from curvafit.priors.energies import orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

#: θ along (z, y, x).
DIRECTION = (1, 0, 0)


class Case(NamedTuple):
    """A preset, the strength μ, and the (κ1, κ2) of its perfect shape."""

    name: str
    preset: str
    strength: float
    ideal: tuple[float, float]


CASES = (
    Case("tubes", "tubes", 0, (20, 0)),
    Case("tubes-aligned", "tubes", 1000, (20, 0)),
    Case("layers", "bilayers", 0, (0, 0)),
    Case("layers-aligned", "bilayers", 800, (0, 0)),
)


def main() -> None:
    options = parser(__doc__, "orientation").parse_args()
    shapes, lines = {}, [HEAD]
    for case in CASES:
        law = preset(case.preset)
        a, mass = law.coefficients, law.mass
        Q = orientation(DIRECTION, case.strength) if case.strength else None
        shape = shapes[case] = grown(options.output / f"{case.name}.npz", a, mass, options, orientation=Q)
        line = f"{case.name:14} {case.strength:5g} {lean(shape.field):9.3f}"
        for kind in shape.diagrams:
            line += "{:9.2f} {:7.2f}".format(*spread(shape.diagrams[kind], case.ideal))
        lines.append(f"{line}   {shape.facts['status']}")
    write_table(options, "orientation", lines, [shape.facts["program"] for shape in shapes.values()])
    figure = Figure(figsize=(CELL * len(CASES), SURFACE + DIAGRAM), layout="constrained")
    titles = {case: f"{case.name.partition('-')[0]}, μ = {case.strength:g}" for case in CASES}
    draw(figure, {titles[case]: (s.field, s.diagrams.get(options.curvature)) for case, s in shapes.items()}, len(CASES))
    arrow = {"arrowstyle": "->", "color": DIAGONAL, "linewidth": 1.6}
    for axes, case in zip(figure.axes, CASES, strict=False):
        if case.strength:
            axes.annotate("", (-0.04, 0.65), (-0.04, 0.35), "axes fraction", "axes fraction", arrowprops=arrow)
            axes.text(-0.04, 0.66, "θ", color=DIAGONAL, ha="center", transform=axes.transAxes)
    print(write_picture(figure, options.output / "orientation.png"))


HEAD = f"{'shape':14} {'μ':>5} {'(θ·n)²':>9}" + "".join(f" {kind + ' rms':>13} {'median':>7}" for kind in KINDS)


def lean(u: np.ndarray) -> float:
    """The mean of (θ·n)² over the surface."""
    vectors = area_vectors(surface(u, Grid(u.shape)))[:, ::-1]
    sizes = np.linalg.norm(vectors, axis=1)
    along = vectors @ (np.array(DIRECTION) / np.linalg.norm(DIRECTION))
    return float((along**2 / np.maximum(sizes, 1e-30)).sum() / sizes.sum())


def spread(seen: Diagram, ideal: tuple[float, float]) -> tuple[float, float]:
    """Distance of curvatures to one point: root of the mean square over the area, and median."""
    away = np.linalg.norm(seen.points - np.array(ideal), axis=1)
    order = np.argsort(away)
    half = np.searchsorted(np.cumsum(seen.weights[order]), seen.area / 2)
    return float(np.sqrt(seen.normalised.weights @ away**2)), float(away[order][half])


if __name__ == "__main__":
    main()
