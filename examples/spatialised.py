"""Four textures that pass into each other: parameters that vary in space (paper, "Extensions", Fig. 1).

python examples/spatialised.py [--small] [--edge 100] [--schedule fast] [-o spatialised]

Six cubes along x hold p1, p1, p2, p3, p4, p4 at their middles (presets `spatial-1` to `spatial-4`), interpolated
linearly and periodically; the first and the last cube are cropped. The table sets the middle half of each cube, where
the parameters are nearest to the preset's, against a cube of the pure preset. A killed run goes on where it was.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping

import common
import numpy as np
import torch
from common import DIAGRAM, Shape, grown, kept, parser, plan_of, write_table
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from curvafit.drawing.plot import INK, diagram_on, shared_limits, surface_on, write_picture
from curvafit.drawing.rendering import view
from curvafit.generation.flow import Execution, Flow, generate
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.distances import wasserstein
from curvafit.geometry.mesh import NoSurface
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import preset

#: The preset in the middle of each cube; the first and the last cube are cropped.
ORDER = (1, 1, 2, 3, 4, 4)
#: The view in degrees, and the picture's width in inches.
AZIMUTH, ELEVATION, WIDTH = 14.0, 18.0, 11.0


def main() -> None:
    options = parser(__doc__, "spatialised").parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    about = {"order": ORDER, "edge": options.edge, "plan": plan_of(options).as_dict(), "seed": options.seed}
    whole = kept(options.output / "spatialised.npz", about, lambda: made(options))
    pure = {}
    for n in ORDER[1:-1]:
        law = preset(f"spatial-{n}")
        pure[n] = grown(options.output / f"spatial-{n}.npz", law.coefficients, law.mass, options)
    parts = {n: middle(whole, k, options) for k, n in enumerate(ORDER) if 0 < k < len(ORDER) - 1}
    lines = [HEAD, *(row(n, *parts[n], pure[n], options.curvature) for n in pure), whole.facts["status"]]
    write_table(options, "spatialised", lines, [shape.facts["program"] for shape in (whole, *pure.values())])
    heights = [0.45 * WIDTH, 2 * DIAGRAM]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=heights, squeeze=False).flat
    draw_cubes(above.subplots(), whole.field[..., options.edge : -options.edge])
    diagrams = {f"p{n}, in its cube": seen for n, (seen, _) in parts.items()}
    diagrams |= {f"p{n} alone": shape.diagrams.get(options.curvature) for n, shape in pure.items()}
    draw_diagrams(below, diagrams, len(pure))
    print(write_picture(figure, options.output / "spatialised.png"))


def made(options: Namespace) -> Flow:
    """The flow in all six cubes."""
    grid = Grid((options.edge, options.edge, len(ORDER) * options.edge))
    a, mass = maps(options.edge)
    file = options.output / "spatialised.checkpoint"
    execution = Execution(device=options.device, checkpoint=file)
    return generate(a, mass, grid, schedule=plan_of(options), seed=options.seed, execution=execution)


def maps(edge: int) -> tuple[Coefficients, torch.Tensor]:
    """Coefficients and mass of the six cubes, each `(1, 1, 6 edge)`: they vary along x."""
    place, middles = (np.arange(len(ORDER) * edge) + 0.5) / edge, np.arange(len(ORDER)) + 0.5
    stated = [preset(f"spatial-{n}") for n in ORDER]
    columns = np.array([[*shape.coefficients, shape.mass] for shape in stated]).T
    rows = (np.interp(place, middles, values, period=len(ORDER)) for values in columns)
    *a, mass = (torch.from_numpy(values).reshape(1, 1, -1) for values in rows)
    return Coefficients(*a), mass


def middle(whole: Shape, cube: int, options: Namespace) -> tuple[Diagram | None, float]:
    """The diagram of the middle half of a cube, None where it has no surface, and the part of it that is inside."""
    first, last = round((cube + 0.25) * options.edge), round((cube + 0.75) * options.edge)
    where = np.zeros(whole.field.shape, dtype=bool)
    where[..., first:last] = True
    inside = float((whole.field[..., first:last] > 0).mean())
    try:
        return diagram(
            whole.field, Grid(whole.field.shape), WORKING_EPSILON, curvature=options.curvature, where=where
        ), inside
    except NoSurface:
        return None, inside


HEAD = f"{'middle of':10} {'κ1':>7} {'κ2':>7} {'u > 0':>6} | {'pure: κ1':>8} {'κ2':>7} {'u > 0':>6} | {'distance':>8}"


def row(number: int, seen: Diagram | None, inside: float, pure: Shape, kind: str) -> str:
    """Figures of the middle of a cube beside those of the pure preset's."""
    if seen is None:
        return f"p{number:<9} no surface, {inside:.3f} inside"
    line = "p{:<9} {:7.1f} {:7.1f} {:6.3f}".format(number, *seen.mean(), inside)
    if not pure.diagrams:
        return f"{line} | {pure.facts['status']}"
    alone = pure.diagrams[kind]
    line += " | {:8.1f} {:7.1f} {:6.3f}".format(*alone.mean(), pure.facts["fraction"])
    return f"{line} | {wasserstein(seen, alone):8.2f}"


def draw_cubes(axes: Axes, u: np.ndarray) -> None:
    """The four cubes with dashed lines between them."""
    width, cubes = 4 * common.PIXELS, len(ORDER) - 2
    surface_on(axes, u, width=width, azimuth=AZIMUTH, elevation=ELEVATION)
    camera = view(u.shape, azimuth=AZIMUTH, elevation=ELEVATION)
    size = np.array([width, round(width * camera.half[1] / camera.half[0])])
    for cube in range(1, cubes):
        corners = np.array([(0, 0, cube / cubes), (1, 0, cube / cubes), (1, 1, cube / cubes)])
        axes.plot(*(camera.project(corners) * size).T, color=INK, linestyle=(0, (5, 4)), linewidth=1, zorder=4)
    for cube in range(cubes):
        place = camera.project(np.array([(0, 0, (cube + 0.5) / cubes)]))[0] * size
        axes.annotate(f"p{ORDER[cube + 1]}", place, (0, -14), textcoords="offset points", ha="center", fontsize=12)


def draw_diagrams(figure: FigureBase, diagrams: Mapping[str, Diagram | None], columns: int) -> None:
    limits = shared_limits([seen for seen in diagrams.values() if seen is not None])
    for axes, (name, seen) in zip(figure.subplots(2, columns).flat, diagrams.items(), strict=True):
        axes.set_title(name, fontsize=11)
        if seen is not None:
            diagram_on(axes, seen, limits=limits)
            axes.set(xlabel="κ₁", ylabel="κ₂")


if __name__ == "__main__":
    main()
