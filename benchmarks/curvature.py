"""Curvatures against exact shapes: of exact profiles, and of masks, which are what scans give.

1. Exact tanh profiles of a sphere, a cylinder and a torus of tube radius R = 8 ε: mean error over max(|κ1|, |κ2|),
   geometric and diffuse curvature, at 2 voxels an ε.
2. Masks of spheres and cylinders of radius 4 to 16 voxels, as `measure` takes them (`profile_mask`, ε = 2 voxels):
   bias of the mean of κ1 + κ2, and root mean square error of (κ1, κ2), in 1 / R; five random centres.
3. Masks of grown presets on voxels half as long, structures 10 to 20 voxels thick, as `measure` takes them, and by one
   width of smoothing (`phase_field`): root mean square error of (κ1, κ2), of the root mean square of the field's own,
   and ∫H² dA over the field's, less 1. Widths and the bound were chosen on seed 5.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch
from scipy import ndimage

from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from benchmarks.texture import PRESETS
from curvafit.generation.flow import generate
from curvafit.geometry.diagrams import diagram
from curvafit.priors.curvature import geometric_curvatures, jet
from curvafit.priors.grid import Grid
from curvafit.priors.profile import phase_field, profile_distance
from curvafit.scan.grids import profile_mask
from tests.exact import Cylinder, Shape, Sphere, Torus, centres, profile

#: Shapes with the octant's size, in ε; the rest is mirror image.
EXACT: dict[str, tuple[Shape, tuple[int, int, int]]] = {
    "sphere": (Sphere(8.0), (12, 12, 12)),
    "cylinder": (Cylinder(8.0), (4, 12, 12)),
    "torus": (Torus(16.0, 8.0), (12, 28, 28)),
}
KINDS = ("geometric", "diffuse")
RADII = (4, 6, 8, 12, 16)
#: Edge and seed of grown shapes.
EDGE, SEED = 64, 3


def exact_errors(voxels: int) -> Values:
    """Mean of |κ - exact| / max(|κ1|, |κ2|), of each shape and kind of curvature."""
    found = {}
    for name, (shape, size) in EXACT.items():
        nz, ny, nx = (edge * voxels for edge in size)
        grid = Grid((nz, ny, nx), (1 / voxels,) * 3, "replicate")
        for kind in KINDS:
            measured = diagram(profile(shape, centres(grid), 1.0), grid, 1.0, curvature=kind, margin=0)  # type: ignore[arg-type]
            truth = torch.stack(shape.curvatures(torch.from_numpy(measured.places) + 0.5 / voxels), -1).numpy()
            error = np.abs(measured.points - truth) / np.abs(truth).max(1, keepdims=True)
            found[f"{name}, {kind}"] = float(error.mean())
    return found


def mask_errors(kind: str, radius: int, seeds: int) -> Values:
    """Relative bias of the mean of κ1 + κ2, and root mean square error of (κ1, κ2) in 1 / R, of a re-profiled mask."""
    n, random = 2 * radius + 24, np.random.default_rng(radius)
    grid, truth = Grid((n, n, n), (1.0, 1.0, 1.0), "replicate"), np.array([1.0, kind == "sphere"])
    sums, squares = [], []
    for _ in range(seeds):
        middle = tuple(n / 2 + random.uniform(-0.5, 0.5, 3))
        shape = Sphere(radius, middle) if kind == "sphere" else Cylinder(radius, tuple(random.normal(size=3)), middle)
        phase = profile_mask((shape.distance(centres(grid)) > 0).numpy())
        found = diagram(phase, grid, 2.0, margin=10).normalised
        sums.append(found.mean().sum() * radius / truth.sum() - 1)
        squares.append(found.weights @ ((found.points * radius - truth) ** 2).sum(1))
    return {"bias": float(np.mean(sums)), "error": math.sqrt(np.mean(squares))}


def texture_errors(name: str) -> Values:
    """Errors of the mask of a preset's shape, as `measure` takes it and as one width smooths it."""
    field = ndimage.zoom(
        generate(name, grid=EDGE, schedule="deep", seed=SEED).field.numpy(), 2, order=3, mode="nearest", grid_mode=True
    )
    grid = Grid(field.shape, (1.0, 1.0, 1.0), "replicate")
    exact = geometric_curvatures(jet(profile_distance(torch.from_numpy(field), 4.0), grid))[:2]
    values = {}
    ways = {"": profile_mask(field > 0), "one_": phase_field(torch.from_numpy(field > 0), grid, 2.0)}
    for way, phase in ways.items():
        found = diagram(phase, grid, 2.0, margin=10).normalised
        truth = np.stack([ndimage.map_coordinates(each.numpy(), found.places.T, order=1) for each in exact], 1)
        squares = [found.weights @ (points**2).sum(1) for points in (found.points - truth, truth)]
        bending = [found.weights @ points.sum(1) ** 2 for points in (found.points, truth)]
        values |= {f"{way}error": math.sqrt(squares[0] / squares[1]), f"{way}bending": bending[0] / bending[1] - 1}
    return values


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    radii, seeds = (RADII[:1], 1) if options.quick else (RADII, 5)
    exact = cases.all({"exact": lambda: exact_errors(2)})["exact"]
    jobs = {
        f"{kind}-{radius}-{seeds}": lambda k=kind, r=radius: mask_errors(k, r, seeds)
        for kind in ("sphere", "cylinder")
        for radius in radii
    }
    masks = cases.all(jobs)
    show(["exact profile, R = 16 voxels", "mean error"], list(exact.items()))
    show(["mask, radius", "bias of κ1 + κ2", "error"], [[name, *row.values()] for name, row in masks.items()])
    textures = cases.all(
        {f"grown-{name}": lambda n=name: texture_errors(n) for name in PRESETS[: 1 if options.quick else None]}
    )
    columns = ("error", "bending", "one_error", "one_bending")
    show(["mask of a preset", *columns], [[name, *row.values()] for name, row in textures.items()])
    figures = {
        "curvature.sphere.geometric": Figure(100 * exact["sphere, geometric"]),
        "curvature.sphere.diffuse": Figure(100 * exact["sphere, diffuse"]),
    }
    for name, row in masks.items():
        kind, radius, _ = name.split("-")
        figures[f"masks.{kind}_{radius}.bias"] = Figure(100 * row["bias"])
        figures[f"masks.{kind}_{radius}.error"] = Figure(100 * row["error"])
    for key in columns:
        figures[f"masks.grown.{key}"] = bootstrap([100 * abs(row[key]) for row in textures.values()])
    return figures
