"""Our generated shapes against the author's volumes of the same parameters, by curvature-diagram distance.

    CURVAFIT_DATA=… python -m benchmarks.gallery [--presets tubes,sponge,bilayers,pearls] [--seeds 3] [--schedule fast]

For each preset: the mean distance from our seeds to the author's file, the mean distance between our seeds, and their
ratio, under both curvatures. `pearls` is floored to 1/100 on our side because the author's file is.
"""

from __future__ import annotations

import argparse
import os
from itertools import combinations
from pathlib import Path

import nibabel
import numpy as np
import torch

from curvafit.generation.flow import generate
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.transport import wasserstein
from curvafit.priors.coefficients import preset
from curvafit.priors.grid import WORKING_EPSILON, Grid

#: Gallery files that were saved unquantised; the others were floored to 1/100.
UNQUANTISED = ("bilayers", "sponge", "tubes")


def author_volume(folder: Path, name: str) -> torch.Tensor:
    (path,) = folder.glob(f"{name} coeffs*.nii.gz")
    return torch.from_numpy(np.asarray(nibabel.load(path).dataobj, dtype=np.float32))


def diagrams_of(u: torch.Tensor) -> dict[str, Diagram]:
    grid = Grid(tuple(u.shape))
    return {kind: diagram(u, grid, WORKING_EPSILON, curvature=kind) for kind in ("geometric", "diffuse")}


def compare(folder: Path, name: str, seeds: int, schedule: str) -> list[tuple[str, str, float, float]]:
    """Rows (preset, curvature, mean distance to the author's, mean distance between seeds)."""
    author = diagrams_of(author_volume(folder, name))
    parameters = preset(name)
    ours = []
    for seed in range(seeds):
        u = generate(parameters.coefficients, parameters.mass, Grid((100,) * 3), schedule=schedule, seed=seed).field
        ours.append(diagrams_of(u if name in UNQUANTISED else torch.floor(u * 100) / 100))
    rows = []
    for kind in author:
        to_author = np.mean([wasserstein(author[kind], d[kind]) for d in ours])
        between = np.mean([wasserstein(a[kind], b[kind]) for a, b in combinations(ours, 2)])
        rows.append((name, kind, float(to_author), float(between)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default="tubes,sponge,bilayers,pearls")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--schedule", default="fast")
    options = parser.parse_args()
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "gallery"
    if not folder.is_dir():
        parser.error(f"expected $CURVAFIT_DATA to hold a folder gallery/, found none at {folder}")
    print(f"{'preset':10} {'curvature':10} {'to author':>10} {'seed to seed':>13} {'ratio':>6}")
    for name in options.presets.split(","):
        for row in compare(folder, name, options.seeds, options.schedule):
            print(f"{row[0]:10} {row[1]:10} {row[2]:10.3f} {row[3]:13.3f} {row[2] / row[3]:6.2f}", flush=True)


if __name__ == "__main__":
    main()
