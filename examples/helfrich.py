"""Helfrich's energy with spontaneous curvature: sheets, tubes and beads by one number (paper, eq. 3).

python examples/helfrich.py [--edge 64] [-o helfrich]

χ_b/2 (H - H0)² + χ_G K with H = κ1 + κ2, as `Coefficients.helfrich`; the mass is held at -0.6. The table has the mean
of κ1 + κ2 over the surface beside H0, and the shares of tubes and spheres.
"""

from __future__ import annotations

from common import CELL, parser, plan_of, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import surface_on, write_picture
from curvafit.generation.flow import generate
from curvafit.priors.coefficients import Coefficients
from curvafit.scan import measure

SPONTANEOUS = (0.0, 20.0, 40.0)


def main() -> None:
    options = parser(__doc__, "helfrich").parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(1.6 * CELL * len(SPONTANEOUS), 1.7 * CELL), layout="constrained")
    lines = ["H0\tmean of κ1 + κ2\tvolume fraction\ttubes\tspheres"]
    for axes, H0 in zip(figure.subplots(1, len(SPONTANEOUS)), SPONTANEOUS, strict=True):
        law = Coefficients.helfrich(bending=2.0, spontaneous=H0)
        u = generate(law, -0.6, options.edge, schedule=plan_of(options), seed=options.seed).field.numpy()
        found = measure(u, kind="field", spacing=0.01, periodic=True)
        numbers = (2 * found["H"].value, *(found[name].value for name in ("BV/TV", "tubes", "spheres")))
        lines.append("\t".join([f"{H0:g}", *(f"{number:.3g}" for number in numbers)]))
        surface_on(axes, u, width=600)
        axes.set_title(f"H0 = {H0:g}")
    write_picture(figure, options.output / "helfrich.png")
    write_table(options, "helfrich", lines)


if __name__ == "__main__":
    main()
