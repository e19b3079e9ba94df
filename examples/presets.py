"""Thumbnails and parameters of all presets: docs/presets.webp and docs/presets.md.

python examples/presets.py [--small] [-o docs]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from pictures import write_webp

from curvafit.core.files import write_atomically
from curvafit.drawing.plot import gallery_figure
from curvafit.generation.flow import generate
from curvafit.priors.coefficients import NAMES
from curvafit.priors.grid import Grid
from curvafit.priors.law import PRESETS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=64, help="voxels along an edge")
    parser.add_argument("--small", action="store_true", help="32 voxels along an edge: a try in half a minute")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"), help="folder of presets.webp and presets.md")
    options = parser.parse_args()
    edge = 32 if options.small else options.edge
    fields: dict[str, np.ndarray] = {}
    lines = [row("name", *NAMES, "mass", "volume inside", "viable", "source"), row("---", *["---:"] * 8, "---", "---")]
    for name, shape in PRESETS.items():
        flow = generate(shape.coefficients, shape.mass, Grid((edge, edge, edge)), seed=options.seed)
        print(f"{name}: {flow.status}")
        fields[name] = flow.field.numpy()
        numbers = [f"{value:g}" for value in (*shape.coefficients.as_dict().values(), shape.mass)]
        inside = f"{100 * np.mean(fields[name] > 0):.1f} %"
        lines.append(row(name, *numbers, inside, "yes" if flow.viability.viable else "no", shape.source))
    write_webp(gallery_figure(fields, columns=6, width=1800), options.output / "presets.webp")
    page = write_atomically(options.output / "presets.md", lambda path: write_page(path, lines, edge, options.seed))
    print(page)


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def write_page(path: Path, lines: list[str], edge: int, seed: int) -> None:
    path.write_text(
        "# Presets\n\n"
        "Published parameters, in working units (a voxel is 0.01 wide, ε is 0.02). `curvafit presets` lists them, "
        "`curvafit generate --preset NAME -o FILE` makes one.\n\n"
        "![One shape of every preset](presets.webp)\n\n"
        f"Each at {edge}³ voxels, schedule `fast`, seed {seed}; `python examples/presets.py` makes this page.\n\n"
        + "\n".join(lines)
        + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
