"""Our generated shapes against the author's volumes of the same parameters, by curvature-diagram distance.

    CURVAFIT_DATA=… python -m benchmarks.gallery [--presets tubes,pearls,…] [--seeds 3] [--first 0] [--schedule fast]
                                                 [-o texture]

For each volume, under geometric curvature: `distance`, the mean distance from our seeds to the author's file; `noise`,
the mean distance between our seeds; and in units of that noise the `ratio` of the two and the `excess`,
√max(distance² - noise², 0). Two draws of one law are a noise apart, so that the ratio of a schedule without any fault
is 1 and its excess 0. Where the author's file is floored to 1/100 our fields are too. Shapes are kept as those of
`benchmarks.texture`, and may share its folder.
"""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path
from typing import NamedTuple

import nibabel
import numpy as np
import torch

from benchmarks.texture import noise_of, shape_of
from curvafit.generation.schedule import SCHEDULES
from curvafit.geometry.diagram import diagram
from curvafit.geometry.transport import wasserstein
from curvafit.priors.coefficients import preset_name
from curvafit.priors.grid import WORKING_EPSILON, Grid

#: What stands between name and coefficients in the name of a file.
_COEFFICIENTS = " coeffs"


class Row(NamedTuple):
    """A volume's comparison: mean distance to the author's, mean distance between seeds, mean seconds of a shape."""

    distance: float
    noise: float
    seconds: float

    @property
    def ratio(self) -> float:
        """Distance over noise: 1 between two draws of one law."""
        return self.distance / self.noise

    @property
    def excess(self) -> float:
        """What the distance has above a seed's noise, in units of it: 0 between two draws of one law."""
        return math.sqrt(max(self.ratio**2 - 1, 0))


def presets_of(folder: Path) -> list[str]:
    """The presets of the folder's volumes, by their files' names."""
    names = (preset_name(path.name.partition(_COEFFICIENTS)[0]) for path in sorted(folder.glob("*.nii.gz")))
    return [name for name in names if name is not None]


def author_volume(folder: Path, name: str) -> torch.Tensor:
    (path,) = (path for path in folder.glob("*.nii.gz") if preset_name(path.name.partition(_COEFFICIENTS)[0]) == name)
    return torch.from_numpy(np.asarray(nibabel.Nifti1Image.from_filename(path).dataobj, dtype=np.float32))


def is_floored(u: torch.Tensor) -> bool:
    """Whether a volume is rounded to 1/100."""
    return bool((100 * u - (100 * u).round()).abs().max() < 1e-3)


def compare(folder: Path, name: str, schedule: str, seeds: range, shapes: Path) -> Row:
    """Compare an author's volume with our shapes of some seeds."""
    u = author_volume(folder, name)
    grid, floored = Grid(tuple(u.shape)), is_floored(u)
    author = diagram(u, grid, WORKING_EPSILON)
    ours = [shape_of(name, schedule, seed, grid.shape[0], shapes, floored=floored) for seed in seeds]
    distance = np.mean([wasserstein(author, shape.diagram) for shape in ours])
    return Row(float(distance), noise_of(ours), float(np.mean([shape.seconds for shape in ours])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", help="of the volumes in the gallery; by default all")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--schedule", choices=SCHEDULES, default="fast")
    parser.add_argument("-o", "--output", type=Path, default=Path("texture"))
    options = parser.parse_args()
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "gallery"
    if not folder.is_dir():
        parser.error(f"expected $CURVAFIT_DATA to hold a folder gallery/, found none at {folder}")
    options.output.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.seeds)
    print(f"schedule {options.schedule}, seeds {[*seeds]}")
    print(f"{'preset':12}" + "".join(f"{name:>10}" for name in ("distance", "noise", "ratio", "excess", "seconds")))
    for name in options.presets.split(",") if options.presets else presets_of(folder):
        row = compare(folder, name, options.schedule, seeds, options.output)
        figures = (row.distance, row.noise, row.ratio, row.excess, row.seconds)
        print(f"{name:12}" + "".join(f"{figure:10.2f}" for figure in figures), flush=True)


if __name__ == "__main__":
    main()
