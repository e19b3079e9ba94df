"""The Willmore flow towards the known minimisers of genus 0, 1 and 2 (paper, Experiment 1).

python examples/willmore.py [--cases sphere,torus,smaller-torus,genus-2] [--scale 1] [--steps 0] [-o willmore]

The L² flow under L-BFGS with a = (1, 2, 1, 0, 0, 0), walls, ε of four voxels. The sphere starts at a sphere, the others
at holed cubes. The sphere and a smaller torus also run on a coarser grid and with a wider ε, and the energies are
extrapolated to ε = 0 and to voxels that are small against ε: what is left of terms in ε² and (Δx/ε)². A sphere's error
is all (Δx/ε)², the same at every ε; a torus as large as the published ε allows is torn by its mirror images at a wider.
Genus 2 begins on a grid half as
fine; it is followed to where it is nearest to rest, for conformal images of a minimiser cost the same, and F_ε prefers
those with a thin handle. `--scale 0.5` runs everything on grids half as fine.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.progress import Progress

from curvafit.drawing.plot import gallery_figure, write_picture
from curvafit.generation.flow import Execution, Flow, descend
from curvafit.geometry.mesh import surface
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import cahn_hilliard_area
from curvafit.priors.grid import Grid
from curvafit.priors.profile import SIGMA, optimal_profile
from curvafit.priors.stencils import refine_axis

#: Grids as multiples of the full one, and ε in voxels. The last is the published one: 200 voxels, spacing 0.01, ε 0.04.
RUNS, EXTRAPOLATED = ((0.75, 4), (1, 16 / 3), (1, 4)), ("sphere", "smaller-torus")
#: Radius of the sphere, and half edges of a cube and of its hole, in units of half the box's shortest edge. Larger
#: shapes have smaller errors, by the square of ε over their size; they must leave the walls some seven or eight ε.
RADIUS, CUBES = 0.66, {"torus": (0.68, 0.255), "smaller-torus": (0.64, 0.24), "genus-2": (0.8, 0.3)}
#: Least known Willmore energies, ∫ H² dA with H the sum of the curvatures (genus 2: Hsu, Kusner and Sullivan).
MINIMA = {"sphere": 16 * math.pi, "torus": 8 * math.pi**2, "smaller-torus": 8 * math.pi**2, "genus-2": 4 * 21.89}
#: Most iterations of L-BFGS.
STEPS = {"sphere": 100, "torus": 800, "smaller-torus": 600, "genus-2": 200}
#: And before these on a grid half as fine, where a step costs an eighth.
WARM = {"genus-2": 1500}


class Row(NamedTuple):
    """A finished flow: ε over half the box, energy over σ, area over σ, and the surface's extents."""

    epsilon: float
    energy: float
    area: float
    ratio: float
    flow: Flow


def start(name: str, edge: int, width: float) -> tuple[torch.Tensor, Grid]:
    """The field that the flow starts from, on a grid whose shortest edge has length 2, ε in voxels."""
    shape = (edge, 3 * edge // 2, 2 * edge) if name == "genus-2" else (edge, edge, edge)
    grid = Grid(shape, (2 / edge,) * 3, "replicate")
    z, y, x = torch.meshgrid(*(2 / edge * (torch.arange(n) - (n - 1) / 2) for n in shape), indexing="ij")
    if name == "sphere":
        distance = RADIUS - (z**2 + y**2 + x**2).sqrt()
    elif name != "genus-2":
        distance = _holed(z, y, x, *CUBES[name])
    else:
        cube, hole = CUBES[name]
        apart = (cube + hole) / 2  # so far from the middle that the two share a wall
        distance = torch.maximum(_holed(z, y, x - apart, cube, hole), _holed(z, y, x + apart, cube, hole))
    return optimal_profile(distance, width * grid.spacing[0]), grid


def _holed(z: torch.Tensor, y: torch.Tensor, x: torch.Tensor, cube: float, hole: float) -> torch.Tensor:
    """Distance to a flat block with a square hole along z, positive inside."""
    across = torch.maximum(x.abs(), y.abs())
    return torch.minimum(torch.minimum(cube - across, across - hole), cube / 2 - z.abs())


def warm_start(name: str, edge: int, width: float, steps: int, folder: Path) -> torch.Tensor:
    """The end of the same flow on a grid half as fine, ε the same, resampled."""
    path = folder / f"{name}-{edge // 2}.npy"
    if not path.is_file():
        np.save(path, flow_of(name, edge // 2, width / 2, steps, folder).flow.field.numpy())
    field = torch.from_numpy(np.load(path))
    for axis in range(3):
        field = refine_axis(field, axis, 2)
    return field


def flow_of(name: str, edge: int, width: float, steps: int, folder: Path) -> Row:
    """Run one case on one grid; a killed run goes on where it was."""
    field, grid = start(name, edge, width)
    if name in WARM and width > 2:
        field = warm_start(name, edge, width, WARM[name], folder)
    ε = width * grid.spacing[0]
    with Progress() as progress:
        task = progress.add_task(f"{name} {grid.shape} ε {ε:.3f}", total=steps)
        flow = descend(
            field,
            Coefficients.willmore(),
            grid,
            steps=steps,
            epsilon=ε,
            callbacks=[lambda made, total, state: progress.update(task, completed=made)],
            execution=Execution(checkpoint=folder / f"{name}-{edge}-{width:.3g}.checkpoint"),
        )
    area = float(cahn_hilliard_area(flow.field, grid, ε)) / SIGMA
    return Row(ε, float(flow.history.energy[-1]) / SIGMA, area, _radius_ratio(flow), flow)


def _radius_ratio(flow: Flow) -> float:
    """Of a torus about z: the generating circle's radius over its distance from the axis."""
    vertices = surface(flow.field, flow.grid).vertices
    centred = vertices - (vertices.max(0) + vertices.min(0)) / 2
    radii = np.hypot(centred[:, 1], centred[:, 2])
    return float((radii.max() - radii.min()) / (radii.max() + radii.min()))


def genus(flow: Flow) -> int:
    """Of the surface where it ends, by its Euler number: vertices less half the triangles, for a closed mesh."""
    shape = surface(flow.field, flow.grid)
    return round(1 - (len(shape.vertices) - len(shape.faces) / 2) / 2)


def extrapolated(rows: list[Row]) -> float:
    """The energy at ε = 0 and Δx/ε = 0, by terms in 1, ε² and (Δx/ε)²."""
    terms = [(1, row.epsilon**2, (row.flow.grid.spacing[0] / row.epsilon) ** 2) for row in rows]
    return float(np.linalg.lstsq(np.array(terms), np.array([row.energy for row in rows]), rcond=None)[0][0])


def report(name: str, rows: list[Row]) -> list[str]:
    """Lines of the table."""
    least, lines = MINIMA[name], []
    for row in rows:
        line = f"{name:13} {row.flow.grid.shape!s:16} {row.epsilon:6.3f} {row.energy:9.3f} {least:9.3f} "
        line += f"{row.energy / least - 1:+8.2%}  genus {genus(row.flow)}, {row.flow.status}"
        lines.append(line)
    last = rows[-1]
    if len(rows) > 1:
        value = extrapolated(rows)
        lines.append(f"{name:13} {'ε, Δx/ε → 0':16} {0:6.3f} {value:9.3f} {least:9.3f} {value / least - 1:+8.2%}")
    if name == "sphere":
        exact = 4 * math.pi * RADIUS**2
        lines.append(f"{name:13} area {last.area:.4f}, exact {exact:.4f}, {last.area / exact - 1:+.2%}")
    if name.endswith("torus"):
        lines.append(f"{name:13} ratio of radii {last.ratio:.4f}, 1/√2 = 0.7071, {last.ratio * math.sqrt(2) - 1:+.2%}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(MINIMA))
    parser.add_argument("--scale", type=float, default=1.0, help="of all grids; 1 is the published 200 voxels")
    parser.add_argument("--steps", type=int, default=0, help="iterations of L-BFGS; 0: what each case needs")
    parser.add_argument("-o", "--output", type=Path, default=Path("willmore"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    lines = [f"{'case':13} {'grid':16} {'ε':>6} {'F_ε/σ':>9} {'least':>9} {'error':>8}"]
    print(lines[0])
    for name in options.cases.split(","):
        runs = [(2 * round(100 * options.scale * part), width) for part, width in RUNS]
        runs = runs if name in EXTRAPOLATED else runs[-1:]
        rows = [flow_of(name, *run, options.steps or STEPS[name], options.output) for run in runs]
        found = report(name, rows)
        lines += found
        print("\n".join(found), flush=True)
        begun, _ = start(name, *runs[-1])
        pictures = {f"{name}: start": begun.numpy(), f"{name}: end": rows[-1].flow.field.numpy()}
        write_picture(gallery_figure(pictures, columns=2, width=1400), options.output / f"{name}.png")
    (options.output / "willmore.txt").write_text("\n".join(lines) + "\n")
    print(options.output)


if __name__ == "__main__":
    main()
