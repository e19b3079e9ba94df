"""Surfaces of phase fields: extracted by marching cubes, capped, measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from skimage.measure import marching_cubes
from torch import Tensor

from curvafit.priors.grid import Grid

#: Part of the greatest value by which a capped surface's voxels are moved away from the level.
LEAST_PART = 5e-4
#: Greatest relative change that makes voxels of equal values differ: marching cubes leaves holes where a face ties.
TIE = np.float32(1e-4)


class NoSurface(ValueError):
    """There is no level set where one was asked for."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh.

    `vertices` `(V, 3)` float64 are (z, y, x) in the grid's unit, the first voxel's centre at the origin; `faces`
    `(F, 3)` int64 index them, counter-clockwise seen from outside (where u < level) in right-handed (x, y, z) axes.
    """

    vertices: np.ndarray
    faces: np.ndarray

    @property
    def barycentres(self) -> np.ndarray:
        """Return the centre of each triangle, `(F, 3)`."""
        return self.vertices[self.faces].mean(1)


def surface(u: np.ndarray | Tensor, grid: Grid, level: float = 0.0) -> Surface:
    """Return the level set of `u` `(Z, Y, X)` by Lewiner's marching cubes.

    The cells between the last and the first voxels of a periodic box belong to it, each once; a box with other borders
    ends at its outermost voxels' centres.

    Raises
    ------
    ValueError
        If `u` is not a finite volume of the grid's shape, or nowhere crosses the level.
    """
    values = _checked(u, grid)
    if grid.periodic:
        values = np.pad(values, (0, 1), mode="wrap")
    return _march(values, grid, level)


def capped_surface(u: np.ndarray | Tensor, grid: Grid, level: float = 0.0) -> Surface:
    """Return the boundary of {u > level}, closed by flat caps on the box's faces, for printing and export.

    It is watertight, and stays so in float32: no vertex comes closer to a voxel's centre than some ten-thousandths of
    an edge, and none stands twice. The caps of opposite faces of a periodic box are the same, so that copies tile.

    Raises
    ------
    ValueError
        As `surface` does.
    """
    values = _checked(u, grid).astype(np.float32) - np.float32(level)
    if not values.max() > 0:
        raise NoSurface(f"expected a field that exceeds {level:g}, got none over {float(np.max(u)):g}")
    values *= 1 + TIE * np.random.default_rng(0).random(values.shape, dtype=np.float32)
    for axis in range(3):
        values = _with_walls(values, axis, grid.periodic)
    values += np.copysign(LEAST_PART * np.abs(values).max(), values)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    places = [_unpadded(vertices[:, k], n) * h for k, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True))]
    return _welded(Surface(np.stack(places, axis=1), faces.astype(np.int64)))


def solid_surface(u: np.ndarray | Tensor, grid: Grid) -> Surface:
    """Return the boundary of {u > 0}, closed as `capped_surface` closes it, around the volume of the voxels in {u > 0}.

    Flat triangles cut a curved surface short, by 1 % of the volume of tubes 10 voxels thick. The level is moved by as
    little as makes up for it, some hundredths of a voxel.

    Raises
    ------
    ValueError
        As `surface` does.
    """
    values = _checked(u, grid)
    target = np.count_nonzero(values > 0) * grid.voxel_volume

    def attempt(level: float) -> tuple[float, Surface]:
        mesh = capped_surface(values, grid, level)
        return volume(mesh) - target, mesh

    attempts = [attempt(0.0)]
    error, highest = attempts[0][0], float(values.max())
    step = math.copysign(0.01 * highest, error)
    attempts.append(attempt(step))
    if attempts[1][0] != error:
        level = step * error / (error - attempts[1][0])  # where the line through both has its zero
        attempts.append(attempt(min(max(level, -0.1 * highest), 0.1 * highest)))
    return min(attempts, key=lambda each: abs(each[0]))[1]


def areas(mesh: Surface) -> np.ndarray:
    """Return the area of each triangle, `(F,)`, in the grid's unit squared."""
    return np.linalg.norm(area_vectors(mesh), axis=1)


def area_vectors(mesh: Surface) -> np.ndarray:
    """Return half the cross product of each triangle's edges, `(F, 3)` in (x, y, z)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]][:, ::-1] for k in range(3))
    return np.cross(b - a, c - a) / 2


def volume(mesh: Surface) -> float:
    """Return the volume enclosed by a closed surface, by the divergence theorem, in the grid's unit cubed."""
    return float((mesh.barycentres[:, ::-1] * area_vectors(mesh)).sum() / 3)


def _checked(u: np.ndarray | Tensor, grid: Grid) -> np.ndarray:
    values = u.detach().cpu().numpy() if isinstance(u, Tensor) else np.asarray(u)
    if values.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("expected a field of finite numbers, got NaN or infinity")
    return values


def _march(values: np.ndarray, grid: Grid, level: float) -> Surface:
    low, high = float(values.min()), float(values.max())
    if not low < level < high:
        raise NoSurface(f"expected a field that crosses {level:g}, got values from {low:g} to {high:g}")
    vertices, faces, _, _ = marching_cubes(values, level, spacing=grid.spacing, gradient_direction="descent")
    return Surface(vertices.astype(np.float64), faces.astype(np.int64))


def _with_walls(values: np.ndarray, axis: int, periodic: bool) -> np.ndarray:
    """Add two layers on both sides of an axis: the field on the box's face, and the outside right beyond it."""
    first, last = np.take(values, [0], axis), np.take(values, [-1], axis)
    if periodic:
        first = last = (first + last) / 2
    outside = np.full_like(first, -np.abs(values).max())
    return np.concatenate([outside, first, values, last, outside], axis)


def _unpadded(index: np.ndarray, count: int) -> np.ndarray:
    """Return positions in a padded axis as voxels of the unpadded one: both layers of a side are on the box's face."""
    inner = np.arange(count, dtype=np.float64)
    knots = np.concatenate([[-0.5, -0.5], inner, [count - 0.5, count - 0.5]])
    return np.interp(index, np.arange(count + 4), knots)


def _welded(mesh: Surface) -> Surface:
    """Merge the vertices that lie in one place, and drop the triangles that this closes."""
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    return Surface(vertices, faces[(a != b) & (b != c) & (c != a)])
