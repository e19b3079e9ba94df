"""Surfaces of phase fields: extracted by marching cubes, capped, measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numba import njit
from skimage.measure import marching_cubes
from torch import Tensor

from curvafit.core.files import write_content
from curvafit.priors.grid import Grid

#: Fraction of the greatest value by which a capped surface's voxels are moved away from the level.
LEAST_PART = 5e-4
#: Greatest random relative change that makes equal values differ: marching cubes leaves holes where a face has ties.
TIE = np.float32(1e-4)
#: Suffixes that `write_surface` knows.
SUFFIXES = (".stl", ".ply")

Data = Mapping[str, np.ndarray]


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
        return self._triangles[0]

    @cached_property
    def _triangles(self) -> tuple[np.ndarray, np.ndarray]:
        return _measure_triangles(self.vertices, self.faces)


def surface(u: np.ndarray | Tensor, grid: Grid, level: float = 0.0) -> Surface:
    """Return the level set of `u` `(Z, Y, X)` by Lewiner's marching cubes.

    In a periodic box, the cells between the last and the first voxels are included; any other box ends at the centres
    of its outermost voxels. Raises ValueError if `u` is not a finite volume of the grid's shape, or does not cross the
    level.
    """
    values = _as_volume(u, grid)
    return march(np.pad(values, (0, 1), mode="wrap") if grid.periodic else values, grid.spacing, level)


def march(values: np.ndarray, spacing: Sequence[float], level: float = 0.0) -> Surface:
    """Return the level set of finite values (Z, Y, X), two or more along each axis, of a box that is not periodic."""
    low, high = float(values.min()), float(values.max())
    if not low < level < high:
        raise NoSurface(f"expected a field that crosses {level:g}, got values from {low:g} to {high:g}")
    vertices, faces, _, _ = marching_cubes(values, level, spacing=spacing, gradient_direction="descent")
    return Surface(vertices.astype(np.float64), faces.astype(np.int64))


def capped_surface(u: np.ndarray | Tensor, grid: Grid, level: float = 0.0) -> Surface:
    """Return the boundary of {u > level}, closed by flat caps on the box's faces, for printing and export.

    The mesh is watertight, also in float32: vertices keep some ten-thousandths of an edge away from voxels' centres.
    The caps of opposite faces of a periodic box are the same, so that copies tile. Raises ValueError as `surface` does.
    """
    values = _as_volume(u, grid).astype(np.float32) - np.float32(level)
    if not values.max() > 0:
        raise NoSurface(f"expected a field that exceeds {level:g}, got none over {float(np.max(u)):g}")
    values *= 1 + TIE * np.random.default_rng(0).random(values.shape, dtype=np.float32)
    for axis in range(3):
        values = _add_walls(values, axis, grid.periodic)
    values += np.copysign(LEAST_PART * np.abs(values).max(), values)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    positions = [_unpad(vertices[:, k], n) * h for k, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True))]
    return _weld(Surface(np.stack(positions, axis=1), faces.astype(np.int64)))


def solid_surface(u: np.ndarray | Tensor, grid: Grid) -> Surface:
    """Return the capped boundary of {u > 0} (`capped_surface`) that encloses the volume of the voxels in {u > 0}.

    Flat triangles enclose less than a curved surface, by 1 % of the volume for tubes 10 voxels thick. A small shift of
    the level, some hundredths of a voxel, corrects this. Raises ValueError as `surface` does.
    """
    values = _as_volume(u, grid)
    target = np.count_nonzero(values > 0) * grid.voxel_volume

    def attempt(level: float) -> tuple[float, Surface]:
        mesh = capped_surface(values, grid, level)
        return volume(mesh) - target, mesh

    highest = float(values.max())
    error, mesh = attempt(0.0)
    step = math.copysign(0.01 * highest, error)
    next_error, next_mesh = attempt(step)
    attempts = [(error, mesh), (next_error, next_mesh)]
    if next_error != error:  # a step of the secant method
        level = step * error / (error - next_error)
        attempts.append(attempt(min(max(level, -0.1 * highest), 0.1 * highest)))
    return min(attempts, key=lambda result: abs(result[0]))[1]


def areas(mesh: Surface) -> np.ndarray:
    """Return the area of each triangle, `(F,)`, in the grid's unit squared."""
    return np.linalg.norm(area_vectors(mesh), axis=1)


def area_vectors(mesh: Surface) -> np.ndarray:
    """Return half the cross product of each triangle's edges, `(F, 3)` in (x, y, z)."""
    return mesh._triangles[1]


def fabric(mesh: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles' centres, `(F, 3)`, and columns `(F, 7)`, float32: area, and the parts zz zy zx yy yx xx of
    n⊗n dA with the normal n."""
    return mesh.barycentres, _measure_fabric(area_vectors(mesh))


@njit(cache=True, nogil=True)
def _measure_triangles(vertices, faces):  # pragma: no cover
    """Return the centres (z, y, x) of triangles, and half the cross products (x, y, z) of their edges, `(F, 3)`."""
    centres, vectors = np.empty((len(faces), 3)), np.empty((len(faces), 3))
    for k in range(len(faces)):
        (az, ay, ax), (bz, by, bx) = vertices[faces[k, 0]], vertices[faces[k, 1]]
        cz, cy, cx = vertices[faces[k, 2]]
        centres[k, 0], centres[k, 1], centres[k, 2] = (az + bz + cz) / 3, (ay + by + cy) / 3, (ax + bx + cx) / 3
        bz, by, bx, cz, cy, cx = bz - az, by - ay, bx - ax, cz - az, cy - ay, cx - ax
        vectors[k, 0], vectors[k, 1] = (by * cz - bz * cy) / 2, (bz * cx - bx * cz) / 2
        vectors[k, 2] = (bx * cy - by * cx) / 2
    return centres, vectors


@njit(cache=True, nogil=True)
def _measure_fabric(vectors):  # pragma: no cover
    """Return the columns of `fabric` of triangles with these vectors (x, y, z)."""
    columns = np.zeros((len(vectors), 7), np.float32)
    for k in range(len(vectors)):
        x, y, z = vectors[k]
        area = math.sqrt(x * x + y * y + z * z)
        if area > 0:
            columns[k] = area, z * z / area, z * y / area, z * x / area, y * y / area, y * x / area, x * x / area
    return columns


def volume(mesh: Surface) -> float:
    """Return the volume enclosed by a closed surface, by the divergence theorem, in the grid's unit cubed."""
    return float((mesh.barycentres[:, ::-1] * area_vectors(mesh)).sum() / 3)


def _as_volume(u: np.ndarray | Tensor, grid: Grid) -> np.ndarray:
    values = u.detach().cpu().numpy() if isinstance(u, Tensor) else np.asarray(u)
    if values.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("expected a field of finite numbers, got NaN or infinity")
    return values


def _add_walls(values: np.ndarray, axis: int, periodic: bool) -> np.ndarray:
    """Add two layers at both ends of an axis: the field on the box's face, and negative values right beyond it."""
    first, last = np.take(values, [0], axis), np.take(values, [-1], axis)
    if periodic:  # opposite faces have the same cap
        first = last = (first + last) / 2
    outside = np.full_like(first, -np.abs(values).max())
    return np.concatenate([outside, first, values, last, outside], axis)


def _unpad(index: np.ndarray, count: int) -> np.ndarray:
    """Convert positions along an axis with walls to voxels of the axis without; both layers of a wall lie on a face."""
    inner = np.arange(count, dtype=np.float64)
    knots = np.concatenate([[-0.5, -0.5], inner, [count - 0.5, count - 0.5]])
    return np.interp(index, np.arange(count + 4), knots)


def _weld(mesh: Surface) -> Surface:
    """Merge vertices with the same position, and drop the triangles that lose an edge."""
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    return Surface(vertices, faces[(a != b) & (b != c) & (c != a)])


def write_surface(
    mesh: Surface, path: str | Path, *, unit: str = "voxel", data: Data | None = None, grid: Grid | None = None
) -> Path:
    """Write a binary STL or PLY file by suffix; whole or not at all.

    The unit of the lengths is written as a remark, and the `grid`, if its voxels are cubes, in whose box the surface is
    capped: neither format has a field for them, and `volumes.load` reads the remark. `data` is numbers `(V,)` at the
    vertices by name, for PLY; STL cannot hold them. Another suffix or shape is a ValueError.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"expected a surface file ending in one of {', '.join(SUFFIXES)}, got {path.name!r}")
    for name, values in (data or {}).items():
        if np.shape(values) != (len(mesh.vertices),):
            raise ValueError(f"expected {name} of shape ({len(mesh.vertices)},), got {np.shape(values)}")
    encode = {".stl": _stl, ".ply": _ply}[suffix]
    remark = f"curvafit surface, lengths in {unit}"
    if grid is not None and len(set(grid.spacing)) == 1:
        remark += f", {' x '.join(map(str, grid.shape))} voxels of {grid.spacing[0]:.9g}"
    return write_content(path, encode(mesh, remark, data or {}))


def _stl(mesh: Surface, remark: str, _: Data) -> bytes:
    vectors = area_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.zeros(len(mesh.faces), dtype=record)
    triangles["normal"] = vectors / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces][:, :, ::-1]  # z, y, x, unlike the area vectors
    return remark.encode().ljust(80) + np.uint32(len(triangles)).astype("<u4").tobytes() + triangles.tobytes()


def _ply(mesh: Surface, remark: str, data: Data) -> bytes:
    properties = {**dict(zip("zyx", mesh.vertices.T, strict=True)), **data}
    names = ["x", "y", "z", *data]
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {remark}\nelement vertex {len(mesh.vertices)}\n"
        + "".join(f"property float {name}\n" for name in names)
        + f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    vertices = np.stack([properties[name] for name in names], axis=1).astype("<f4")
    return header.encode() + vertices.tobytes() + faces.tobytes()
