"""One shape in every modality, beside the real thing's look: a slice across, a slice along z, a maximum projection.

python examples/modalities.py [--small] [--edge 96] [--seed 0] [-o modalities]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from curvafit.data_synth.imaging.modality import MODALITIES, Modality, image, regrid
from curvafit.drawing.plot import CONTOUR, write_picture
from curvafit.generation.flow import generate
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

#: The preset whose shape each modality images.
SHAPES = {"micro-ct": "trabec", "em-membrane": "bilayers"}
#: Of those that are not named.
SHAPE = "tubes"
#: What is drawn of each image; the projection is of a quarter of the depth, the minimum where structures are dark.
ROWS = ("across z", "outline", "along z", "projection")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=96, help="voxels along an edge of the shapes")
    parser.add_argument("--small", action="store_const", const=32, dest="edge", help="--edge 32")
    parser.add_argument("--seed", type=int, default=0, help="of the images; the shapes' is 0")
    parser.add_argument("-o", "--output", type=Path, default=Path("modalities"), help="folder of modalities.png")
    options = parser.parse_args()
    fields = {name: shape(name, options.edge) for name in {SHAPE, *SHAPES.values()}}
    figure = Figure(figsize=(2.6 * len(MODALITIES), 2.6 * len(ROWS) + 0.4), layout="constrained")
    axes = figure.subplots(len(ROWS), len(MODALITIES), squeeze=False)
    for name, column in zip(MODALITIES, axes.T, strict=True):
        draw(column, MODALITIES[name], fields[SHAPES.get(name, SHAPE)], options.seed)
        column[0].set_title(name)
    for words, first in zip(ROWS, axes[:, 0], strict=True):
        first.set_ylabel(words)
    print(write_picture(figure, options.output / "modalities.png"))


def shape(name: str, edge: int) -> torch.Tensor:
    flow = generate(preset(name).coefficients, preset(name).mass, Grid((edge, edge, edge)), seed=0)
    print(f"{name}: {flow.status}")
    return flow.field


def draw(axes: np.ndarray, modality: Modality, field: torch.Tensor, seed: int) -> None:
    """A column: one drawn image of a modality."""
    imaging = modality.draw(seed)
    seen = image(field, modality.voxel, imaging, seed).numpy()
    truth = regrid(field, modality.voxel, imaging).numpy()
    z, y = seen.shape[0] // 2, seen.shape[1] // 2
    project = np.max if imaging.contrast.foreground > imaging.contrast.background else np.min
    slab = seen[z - len(seen) // 8 : z + len(seen) // 8]
    pictures = (seen[z], seen[z], seen[:, y], project(slab, axis=0))
    steps = ((1, 2), (1, 2), (0, 2), (1, 2))
    for each, picture, (down, right) in zip(axes, pictures, steps, strict=True):
        limits = np.percentile(picture, (0.2, 99.8))
        aspect = imaging.spacing[down] / imaging.spacing[right]
        each.imshow(picture, cmap="gray", vmin=limits[0], vmax=limits[1], aspect=aspect, interpolation="nearest")
        each.set_xticks([])
        each.set_yticks([])
    axes[1].contour(truth[z], levels=[0], colors=[CONTOUR], linewidths=0.8)


if __name__ == "__main__":
    main()
