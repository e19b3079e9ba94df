"""Helfrich's energy with spontaneous curvature: sheets, tubes and beads by one number (paper, eq. 3).

python examples/helfrich.py [--edge 64] [-o helfrich]

χ_b/2 (H - H0)² + χ_G K with H = κ1 + κ2, as `Coefficients.helfrich`. The mass is held: at -0.6 from noise (above), or
that of a disc (below). The table has the mean of κ1 + κ2 over the surface beside H0, and shares of tubes and spheres.
"""

from __future__ import annotations

import numpy as np
import torch
from common import CELL, parser, plan_of, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import surface_on, write_picture
from curvafit.generation.flow import generate
from curvafit.priors import WORKING_EPSILON, Coefficients, Grid, phase_field
from curvafit.scan import measure

SPONTANEOUS = (0.0, 20.0, 40.0)
#: Radius and half the thickness of the disc, as shares of the box's edge.
DISC = (0.375, 0.08)


def main() -> None:
    options = parser(__doc__, "helfrich").parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(1.6 * CELL * len(SPONTANEOUS), 3.4 * CELL), layout="constrained")
    lines = ["start\tH0\tmean of κ1 + κ2\tvolume fraction\ttubes\tspheres"]
    starts = {"noise": (-0.6, options.seed), "disc": (disc(options.edge), None)}
    for row, (name, (mass, seed)) in zip(figure.subplots(2, len(SPONTANEOUS)), starts.items(), strict=True):
        for axes, H0 in zip(row, SPONTANEOUS, strict=True):
            law = Coefficients.helfrich(bending=2.0, spontaneous=H0)
            u = generate(law, mass, options.edge, schedule=plan_of(options), seed=seed).field.numpy()
            found = measure(u, kind="field", spacing=0.01, periodic=True)
            numbers = (2 * found["H"].value, *(found[name].value for name in ("BV/TV", "tubes", "spheres")))
            lines.append("\t".join([name, f"{H0:g}", *(f"{number:.3g}" for number in numbers)]))
            surface_on(axes, u, width=600)
            axes.set_title(f"H0 = {H0:g}" if name == "noise" else "")
    write_picture(figure, options.output / "helfrich.png")
    write_table(options, "helfrich", lines)


def disc(edge: int) -> torch.Tensor:
    """The phase field of a disc across x in the middle of a cube."""
    z, y, x = np.indices((edge,) * 3) - (edge - 1) / 2
    radius, half = (share * edge for share in DISC)
    inside = (np.hypot(z, y) < radius) & (np.abs(x) < half)
    return phase_field(torch.from_numpy(inside), Grid(edge), WORKING_EPSILON)


if __name__ == "__main__":
    main()
