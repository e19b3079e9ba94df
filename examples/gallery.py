"""The shapes of the gallery, each with its curvature diagram (paper, Experiment 2).

python examples/gallery.py [--small] [--edge 100] [--schedule fast] [-o gallery]

Where `$CURVAFIT_DATA/gallery` holds the author's volumes, ours are compared with them: the distances of diagrams, and
for scale the distance between two seeds of ours. Finished shapes are kept: a killed run goes on where it was.
"""

from __future__ import annotations

import os
from pathlib import Path

import nibabel
import numpy as np
from common import CELL, DIAGRAM, KINDS, SURFACE, Shape, draw, grown, parser, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import write_picture
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.distances import wasserstein
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import PRESETS

NAMES = tuple(name for name, shape in PRESETS.items() if "gallery" in shape.source)
#: The author's files that were saved as they are; the others were floored to 1/100, and so are ours beside them.
UNQUANTISED = ("bilayers", "sponge", "tubes")
COLUMNS = 6


def main() -> None:
    options = parser(__doc__, "gallery").parse_args()
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "gallery"
    compared = bool(os.environ.get("CURVAFIT_DATA")) and folder.is_dir()
    lines, shapes = [HEAD + (AGAINST if compared else "")], {}
    for name in NAMES:
        a, mass = PRESETS[name].coefficients, PRESETS[name].mass
        shapes[name] = grown(options.output / f"{name}.npz", a, mass, options)
        line = row(name, shapes[name])
        if compared:
            other = grown(options.output / f"{name}-second.npz", a, mass, options, seed=options.seed + 1)
            line += against(folder, name, shapes[name], other)
        lines.append(line)
    if compared:
        lines.append("author: distance of our diagram to the author's file's; seeds: between two of our seeds")
    write_table(options, "gallery", lines, [shape.facts["program"] for shape in shapes.values()])
    rows = -(-len(NAMES) // COLUMNS)
    figure = Figure(figsize=(CELL * COLUMNS, rows * (SURFACE + DIAGRAM)), layout="constrained")
    draw(figure, {name: (s.field, s.diagrams.get(options.curvature)) for name, s in shapes.items()}, COLUMNS)
    print(write_picture(figure, options.output / "gallery.png"))


HEAD = f"{'preset':10} {'energy':>10} {'discrep.':>8} {'area/vol':>8} {'κ1':>7} {'κ2':>7} {'u > 0':>6}"
AGAINST = "".join(f" | {kind:>9}: {'author':>6} {'seeds':>6}" for kind in KINDS)


def row(name: str, shape: Shape) -> str:
    """Figures of our shape; the mean curvatures are geometric."""
    facts = shape.facts
    line = f"{name:13} {facts['energy']:10.2f} {facts['discrepancy']:8.3f}"
    if not shape.diagrams:
        return f"{line} {facts['status']}"
    κ1, κ2 = shape.diagrams["geometric"].mean()
    return f"{line} {facts['density']:8.2f} {κ1:7.1f} {κ2:7.1f} {facts['fraction']:6.3f}"


def against(folder: Path, name: str, ours: Shape, other: Shape) -> str:
    """Distances to the author's file and between our seeds, under both curvatures."""
    (path,) = folder.glob(f"{name.replace('-', ' ')} coeffs*.nii.gz")
    author = np.asarray(nibabel.load(path).dataobj, dtype=np.float32)  # type: ignore[attr-defined]
    text = ""
    for kind in KINDS:
        seen = [measured(as_saved(name, shape.field), kind) for shape in (ours, other)]
        text += f" | {'':10} {wasserstein(seen[0], measured(author, kind)):6.2f} {wasserstein(*seen):6.2f}"
    return text


def as_saved(name: str, u: np.ndarray) -> np.ndarray:
    return u if name in UNQUANTISED else np.floor(u * 100) / 100


def measured(u: np.ndarray, kind) -> Diagram:
    return diagram(u, Grid(u.shape), WORKING_EPSILON, curvature=kind)


if __name__ == "__main__":
    main()
