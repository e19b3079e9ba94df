"""Eight textures from published parameters, as one picture (the README's).

python examples/textures.py [--edge 80] [-o docs/textures.webp]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pictures import write_webp

from curvafit.drawing.plot import gallery_figure
from curvafit.generation.flow import generate
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

NAMES = ("tubes", "sponge", "bilayers", "pearls", "trabec", "metatubes", "exp-0366", "weird")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=80, help="voxels along an edge")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/textures.webp"))
    options = parser.parse_args()
    grid = Grid((options.edge,) * 3)
    fields = {}
    for name in NAMES:
        shape = preset(name)
        flow = generate(shape.coefficients, shape.mass, grid, seed=options.seed)
        print(f"{name}: {flow.status}")
        fields[name] = flow.field.numpy()
    write_webp(gallery_figure(fields), options.output)


if __name__ == "__main__":
    main()
