"""A scan beside its regrown twin (the README's picture).

python examples/twin.py [--edge 96] [-o docs/twin.png]

The scan is made, so that what made it is known: the preset `sponge`, imaged as by micro-CT with blur, uneven light,
rings and noise. `curvafit.infer` is given the image alone. The twin is grown from the answer and from other noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from curvafit.data_synth.imaging.image import image
from curvafit.data_synth.imaging.modality import modality
from curvafit.drawing.plot import surface_on, write_picture
from curvafit.generation.flow import generate
from curvafit.inference.infer import Inference, infer
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.volumes.field import Field

PRESET = "sponge"
#: A typical micro-CT image: levels of grey, blur in µm, uneven light and rings as shares, noise in grey levels.
IMAGING = {
    "contrast.background": 45.0,
    "contrast.foreground": 112.0,
    "optics.blur": (12.0, 12.0, 12.0),
    "illumination.bias": 0.03,
    "detector.rings": 0.06,
    "noise.gaussian": 8.0,
}


def scan(edge: int) -> Field:
    """Return the micro-CT image of the preset's shape, by the voxel that the modality gives it."""
    truth = preset(PRESET)
    flow = generate(truth.coefficients, truth.mass, Grid((edge, edge, edge)), seed=0)
    kind = modality("micro-ct")
    imaging = kind.base.assign(IMAGING)
    values = image(flow.field, kind.voxel, imaging, 0).numpy()
    return Field(values, imaging.spacing, imaging.unit)


def draw(inference: Inference, twin: np.ndarray, path: Path) -> None:
    """Write a slice of the scan, the scan's surface and the twin's, side by side."""
    values = inference.scan.values
    smooth = gaussian_filter(values, 1.0)
    level = (smooth[inference.prepared.mask].mean() + smooth[~inference.prepared.mask].mean()) / 2
    figure = Figure(figsize=(12, 4.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.imshow(
        values[len(values) // 2], cmap="gray", vmin=np.percentile(values, 0.5), vmax=np.percentile(values, 99.5)
    )
    left.set_axis_off()
    surface_on(middle, smooth, level=float(level), width=640)
    surface_on(right, twin, width=640)
    titles = ("the scan: a slice", "the scan: its surface", "the twin: grown from what was inferred")
    for axes, title in zip((left, middle, right), titles, strict=True):
        axes.set_title(title, fontsize=13)
    write_picture(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=96, help="voxels along an edge")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/twin.png"))
    options = parser.parse_args()
    inference = infer(scan(options.edge), kind="image", seed=1)
    print(inference.fit.status)
    if inference.best is None:
        raise SystemExit(f"expected a shape from the inferred parameters: {inference.fit.status}")
    for name, value in inference.to_law().coefficients.as_dict().items():
        print(f"{name} {value:.3g}, truth {preset(PRESET).coefficients.as_dict()[name]:.3g}")
    draw(inference, inference.best, options.output)
    print(options.output)


if __name__ == "__main__":
    main()
