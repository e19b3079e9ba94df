"""Layers, spheres, tubes and sponges, and what lies between them (paper, Experiment 3).

python examples/interpolation.py [--small] [--edge 100] [--count 5] [--schedule fast] [-o interpolation]

Coefficients and masses of four presets are interpolated bilinearly in a table of 5 × 5; all shapes start from the same
noise. Finished shapes are kept: a killed run goes on where it was.
"""

from __future__ import annotations

from itertools import combinations

import common
import numpy as np
from common import CELL, KINDS, Shape, grown, parser, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import diagram_on, shared_limits, surface_on, write_picture
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import wasserstein
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset

#: Presets at the table's corners (0, 0), (0, 1), (1, 0) and (1, 1), row by row.
CORNERS = ("layers", "spheres", "sponges", "tubes")

Table = dict[tuple[int, int], Shape]


def main() -> None:
    takes = parser(__doc__, "interpolation")
    takes.add_argument("--count", type=int, default=5, help="shapes along a side of the table, at least 2")
    options = takes.parse_args()
    shapes: Table = {}
    for place in np.ndindex(options.count, options.count):
        a, mass = between(*(k / (options.count - 1) for k in place))
        shapes[place] = grown(options.output / f"shape-{place[0]}-{place[1]}.npz", a, mass, options)
    lines = [row(place, shape, options.count) for place, shape in shapes.items()]
    lines += [line for kind in KINDS for line in closeness(shapes, options.count, kind)]
    write_table(options, "interpolation", [HEAD, *lines], [shape.facts["program"] for shape in shapes.values()])
    size = CELL * options.count
    surfaces, diagrams = (Figure(figsize=(size, size), layout="constrained") for _ in range(2))
    for place, axes in np.ndenumerate(surfaces.subplots(options.count, options.count)):
        surface_on(axes, shapes[place].field, width=common.PIXELS)
        axes.set_title(named(place, options.count), fontsize=12)
    print(write_picture(surfaces, options.output / "interpolation.png"))
    draw_diagrams(diagrams, {place: shape.diagrams.get(options.curvature) for place, shape in shapes.items()})
    print(write_picture(diagrams, options.output / "interpolation-diagrams.png"))


def between(down: float, right: float) -> tuple[Coefficients, float]:
    """Coefficients and mass at a place in the table, both coordinates in [0, 1]."""
    weights = np.outer([1 - down, down], [1 - right, right]).ravel()
    corners = [preset(f"bilinear-{name}") for name in CORNERS]
    *a, mass = weights @ np.array([[*shape.coefficients, shape.mass] for shape in corners])
    return Coefficients(*a), float(mass)


HEAD = f"{'place':6} {'energy':>9} {'discrep.':>8} {'area/vol':>8} {'κ1':>7} {'κ2':>7} {'u > 0':>6}"


def row(place: tuple[int, int], shape: Shape, count: int) -> str:
    """Figures of a shape; the mean curvatures are geometric."""
    facts, line = shape.facts, f"{place[0]}, {place[1]:<3}"
    line += f" {facts['energy']:9.2f} {facts['discrepancy']:8.3f}"
    if not shape.diagrams:
        return f"{line} {facts['status']}"
    κ1, κ2 = shape.diagrams["geometric"].mean()
    return f"{line} {facts['density']:8.2f} {κ1:7.1f} {κ2:7.1f} {facts['fraction']:6.3f} {named(place, count)}".rstrip()


def named(place: tuple[int, int], count: int) -> str:
    """The name of a corner."""
    if any(k not in (0, count - 1) for k in place):
        return ""
    return CORNERS[2 * (place[0] > 0) + (place[1] > 0)]


def closeness(shapes: Table, count: int, kind: str) -> list[str]:
    """Neighbours in a row or a column against the four corners."""
    places = [place for place, shape in shapes.items() if shape.diagrams]
    pairs = list(combinations(places, 2))
    near = [pair for pair in pairs if sum(abs(a - b) for a, b in zip(*pair, strict=True)) == 1]
    far = [pair for pair in pairs if all(named(place, count) for place in pair)]
    close, wide = (
        float(np.mean([wasserstein(*(shapes[place].diagrams[kind] for place in pair)) for pair in group]))
        for group in (near, far)
    )
    return [
        f"{kind}: {len(near)} pairs of neighbours {close:.3f}, {len(far)} pairs of corners {wide:.3f}, "
        f"ratio {close / wide:.3f}",
        f"Neighbours in the table are on average {close / wide:.1%} as far apart as its corners.",
    ]


def draw_diagrams(figure: Figure, diagrams: dict[tuple[int, int], Diagram | None]) -> None:
    limits = shared_limits([seen for seen in diagrams.values() if seen is not None])
    count = max(row for row, _ in diagrams) + 1
    for (down, right), axes in np.ndenumerate(figure.subplots(count, count, sharex=True, sharey=True)):
        seen = diagrams[down, right]
        if seen is None:
            axes.set_axis_off()
            continue
        diagram_on(axes, seen, limits=limits)
        axes.set(xlabel="κ₁" if down == count - 1 else "", ylabel="κ₂" if right == 0 else "")
        axes.set_title(named((down, right), count), fontsize=12)


if __name__ == "__main__":
    main()
