"""Where filling between slices helps: the pictures of docs/limits.md, and the README's row.

python examples/helps.py [--small] [-o docs]

A generated shape is known in every 8th slice, or in every 24th. The network fills it (`curvafit.reconstruct`); beside
it stands the plain interpolation that is best in hindsight. Dice coefficients count the slices that were left out. The
slice that is drawn is half way in a gap, and of all gaps the one with the median gain.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pictures import write_webp
from scipy.ndimage import zoom

from curvafit.drawing.plot import CONTOUR, gallery_figure
from curvafit.generation.flow import generate
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.trials import dice

#: Voxels along an edge of a shape as it is generated.
EDGE, SMALL = 80, 32
#: Colours of what a mask shares with the truth, of what it lacks, and of what it has too much.
SHARED, MISSING, EXCESS = (0.72, 0.74, 0.78), (0.0, 0.45, 0.70), (0.84, 0.37, 0.0)


@dataclass(frozen=True)
class Case:
    """A preset of which every so many slices are known; its voxels are `scale` times as fine as generated."""

    name: str
    preset: str
    scale: float
    every: int


#: The rows of each picture.
PICTURES = {
    "helps_better": [Case("beads", "bilinear-spheres", 1.5, 8), Case("tubes", "tubes", 1.5, 8)],
    "helps_equal": [Case("thick branches", "metatubes", 1.0, 8), Case("sheets", "bilayers", 1.0, 8)],
    "helps_not": [Case("tubes", "tubes", 1.0, 24), Case("beads", "bilinear-spheres", 1.0, 24)],
}


class Filling:
    """The truth of a case (bool, Z, Y, X), and what fills it between its known slices."""

    def __init__(self, case: Case, edge: int, seed: int) -> None:
        u = generate(case.preset, grid=edge, seed=seed).field.numpy()
        mask = np.asarray(zoom(u, case.scale, order=1, mode="grid-wrap", grid_mode=True)) > 0
        self.case = case
        self.truth = mask[: (len(mask) - 1) // case.every * case.every + 1]
        self.places = tuple(range(0, len(self.truth), case.every))
        self.slices = Slices(self.truth[:: case.every], self.places, len(self.truth), (1.0, 1.0, 1.0))
        found = reconstruct(self.truth.astype(np.uint8), known=self.places)
        assert found.probability is not None
        self.filled, self.probability = found.mask.values, found.probability.values

    @property
    def known(self) -> np.ndarray:
        """The known slices alone."""
        mask = np.zeros_like(self.truth)
        mask[:: self.case.every] = self.truth[:: self.case.every]
        return mask

    @cached_property
    def best(self) -> str:
        """The plain way that is best in hindsight."""
        return max(WAYS, key=lambda way: self.dice(self.plain(way)))

    def plain(self, way: str) -> np.ndarray:
        return self.slices.level(way) > 0

    def dice(self, mask: np.ndarray) -> float:
        """The Dice coefficient on the slices that were left out."""
        return dice(mask[self.slices.between], self.truth[self.slices.between])

    @cached_property
    def place(self) -> int:
        """The slice half way in the gap with the median gain."""
        plain = self.plain(self.best)
        halves = [place + self.case.every // 2 for place in self.places[:-1]]
        gains = [dice(self.filled[k], self.truth[k]) - dice(plain[k], self.truth[k]) for k in halves]
        return halves[int(np.argsort(gains)[len(gains) // 2])]


def picture(fillings: list[Filling]) -> Figure:
    """Draw each filling as a row: two known slices, the truth between, the best plain way, the network."""
    figure = Figure(figsize=(10, 3.8), facecolor="white", layout="constrained")
    for filling, row in zip(fillings, figure.subplots(len(fillings), 6), strict=True):
        k, half, truth, plain = filling.place, filling.case.every // 2, filling.truth, filling.plain(filling.best)
        panels = [
            (f"known: slice {k - half}", colours(truth[k - half], truth[k - half])),
            (f"known: slice {k + half}", colours(truth[k + half], truth[k + half])),
            (f"truth: slice {k}", colours(truth[k], truth[k])),
            (f"{filling.best}: Dice {filling.dice(plain):.2f}", colours(plain[k], truth[k])),
            (f"filled: Dice {filling.dice(filling.filled):.2f}", colours(filling.filled[k], truth[k])),
            ("probability", None),
        ]
        for axes, (title, image) in zip(row, panels, strict=True):
            if image is not None:
                axes.imshow(image, interpolation="nearest")
            axes.set_title(title, fontsize=8.5)
            axes.set(xticks=[], yticks=[])
        row[-1].imshow(filling.probability[k], cmap="Greys", vmin=0, vmax=1, interpolation="nearest")
        row[-1].contour(truth[k], levels=[0.5], colors=CONTOUR, linewidths=0.8)
        row[0].set_ylabel(filling.case.name, fontsize=10)
    return figure


def colours(mask: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the colours of a mask against the truth, (Y, X, 3)."""
    image = np.ones((*mask.shape, 3))
    image[mask & truth], image[truth & ~mask], image[mask & ~truth] = SHARED, MISSING, EXCESS
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help=f"{SMALL} voxels along an edge: a try in half a minute")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"), help="folder of the pictures")
    options = parser.parse_args()
    for name, cases in PICTURES.items():
        fillings = [Filling(case, SMALL if options.small else EDGE, options.seed) for case in cases]
        for each in fillings:
            scores = {way: each.dice(each.plain(way)) for way in WAYS} | {"filled": each.dice(each.filled)}
            print(f"{name}, {each.case.name}:", ", ".join(f"{way} {score:.3f}" for way, score in scores.items()))
        write_webp(picture(fillings), options.output / f"{name}.webp", lossless=True)
        if name == "helps_better":
            write_webp(readme_row(fillings[0]), options.output / "filled.webp")


def readme_row(filling: Filling) -> Figure:
    """Draw the surfaces of the truth, of its known slices, of the spline and of the filled volume."""
    shapes = {
        "truth": filling.truth,
        f"every {filling.case.every}th slice": filling.known,
        f"spline: Dice {filling.dice(filling.plain('spline')):.2f}": filling.plain("spline"),
        f"filled: Dice {filling.dice(filling.filled):.2f}": filling.filled,
    }
    return gallery_figure(shapes, columns=4, width=1300)


if __name__ == "__main__":
    main()
