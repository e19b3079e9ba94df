"""The two curvatures against exact shapes, and shapes known only as masks against themselves.

    python -m benchmarks.curvature

1. Exact tanh profiles of a sphere, a cylinder and a torus of tube radius 8 ε at 4 and 2 voxels an ε: the mean of κ·R
   over the mesh, the mean and the largest error over max(|κ1|, |κ2|), geometric and diffuse.
2. Masks of spheres and cylinders of radius 4 to 10 voxels, re-profiled by `phase_field` at ε = 2 voxels: bias of the
   mean of κ1 + κ2 and scatter of (κ1, κ2), in 1 / R; five random centres.
3. Distance between the curvature diagrams of a published field and of its mask (with $CURVAFIT_DATA set).
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import torch

from curvafit.geometry.diagram import diagram, surface_curvatures
from curvafit.geometry.transport import wasserstein
from curvafit.priors.grid import Grid
from curvafit.priors.profile import phase_field
from tests.exact import Cylinder, Shape, Sphere, Torus, centres, profile

#: Shapes with the octant's size, in ε; the rest is mirror image.
EXACT: dict[str, tuple[Shape, tuple[int, int, int]]] = {
    "sphere": (Sphere(8.0), (12, 12, 12)),
    "cylinder": (Cylinder(8.0), (4, 12, 12)),
    "torus": (Torus(16.0, 8.0), (12, 28, 28)),
}
KINDS = ("geometric", "diffuse")


def exact_errors(name: str, voxels: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Area-weighted mean of κ·R `(2,)`, and |κ - exact| / max(|κ1|, |κ2|) a triangle `(N, 2)`."""
    shape, size = EXACT[name]
    nz, ny, nx = (edge * voxels for edge in size)
    grid = Grid((nz, ny, nx), (1 / voxels,) * 3, "replicate")
    found = surface_curvatures(profile(shape, centres(grid), 1.0), grid, 1.0, curvature=kind, margin=0)  # type: ignore[arg-type]
    truth = torch.stack(shape.curvatures(torch.from_numpy(found.centres) + 0.5 / voxels), -1).numpy()
    error = np.abs(found.points - truth) / np.abs(truth).max(1, keepdims=True)
    return 8 * found.areas @ found.points / found.areas.sum(), error


def mask_errors(kind: str, radius: int, seeds: int = 5) -> tuple[float, float]:
    """Relative bias of the mean of κ1 + κ2, and root mean square error of (κ1, κ2) in 1 / R, of a re-profiled mask."""
    n, generator = 2 * radius + 14, np.random.default_rng(radius)
    grid, truth = Grid((n, n, n), (1.0, 1.0, 1.0), "replicate"), np.array([1.0, kind == "sphere"])
    sums, squares = [], []
    for _ in range(seeds):
        middle = tuple(n / 2 + generator.uniform(-0.5, 0.5, 3))
        shape = (
            Sphere(radius, middle) if kind == "sphere" else Cylinder(radius, tuple(generator.normal(size=3)), middle)
        )
        found = diagram(phase_field(shape.distance(centres(grid)) > 0, grid, 2.0), grid, 2.0, margin=5).normalised
        sums.append(found.mean().sum() * radius / truth.sum() - 1)
        squares.append(found.weights @ ((found.points * radius - truth) ** 2).sum(1))
    return float(np.mean(sums)), math.sqrt(np.mean(squares))


def gallery_gaps(folder: Path) -> list[tuple[str, float, float]]:
    """Name, geometric and diffuse distance between field and mask, for each published field."""
    import nibabel

    rows = []
    for path in sorted(folder.glob("*.nii.gz")):
        u = torch.from_numpy(nibabel.Nifti1Image.from_filename(path).get_fdata(dtype=np.float32))
        grid = Grid(tuple(u.shape), (0.01,) * 3)  # type: ignore[arg-type]
        profiled = phase_field(u > 0, grid, 0.02)
        pairs = ([diagram(field, grid, 0.02, curvature=kind) for field in (u, profiled)] for kind in KINDS)
        gaps = (wasserstein(*pair) for pair in pairs)
        rows.append((path.name.split(" coeffs")[0], *gaps))
    return rows


def main() -> None:
    print("1. exact profiles, tube radius R = 8 ε")
    print(
        f"{'shape':>9} {'ε':>3} {'R':>3}  {'kind':>9}  {'mean κ1·R':>9} {'κ2·R':>7}  {'mean error':>10} {'largest':>8}"
    )
    for voxels in (4, 2):
        for name in EXACT:
            for kind in KINDS:
                mean, error = exact_errors(name, voxels, kind)
                row = f"{mean[0]:9.3f} {mean[1]:7.3f}  {error.mean():10.4f} {error.max():8.4f}"
                print(f"{name:>9} {voxels:3d} {8 * voxels:3d}  {kind:>9}  {row}")
    print("\n2. re-profiled masks, ε = 2 voxels: bias of the mean of κ1 + κ2, scatter of (κ1, κ2) in 1/R")
    for radius in (4, 5, 6, 8, 10):
        parts = (f"{kind} {bias:+.3f} {scatter:.3f}" for kind in EXACT if kind != "torus"
                 for bias, scatter in [mask_errors(kind, radius)])  # fmt: skip
        print(f"  R = {radius:2d}: " + "   ".join(parts))
    if "CURVAFIT_DATA" in os.environ:
        print("\n3. published fields against their masks: geometric, diffuse distance (1 / working unit)")
        for name, geometric, diffuse in gallery_gaps(Path(os.environ["CURVAFIT_DATA"]) / "gallery"):
            print(f"  {name:>10} {geometric:6.2f} {diffuse:6.2f}")


if __name__ == "__main__":
    main()
