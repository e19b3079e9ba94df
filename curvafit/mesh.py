"""Surfaces of phase fields: extracted by marching cubes, measured, capped, written as STL or PLY."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from skimage.measure import marching_cubes
from torch import Tensor

from curvafit.priors.grid import Grid

#: Suffixes that `write_surface` knows.
SUFFIXES = (".stl", ".ply")


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
        """Centre of each triangle, `(F, 3)`."""
        return self.vertices[self.faces].mean(1)


def surface(u: np.ndarray | Tensor, grid: Grid, level: float = 0.0) -> Surface:
    """The level set of `u` `(Z, Y, X)` by Lewiner's marching cubes.

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
    """The boundary of {u > level} within the box, closed by flat caps on the box's faces; for printing and export.

    Raises
    ------
    ValueError
        As `surface` does.
    """
    values = _checked(u, grid)
    padded = np.pad(values, 1, mode="edge")
    outer = np.ones(padded.shape, dtype=bool)
    outer[1:-1, 1:-1, 1:-1] = False
    # The mirrored value puts the crossing half a voxel beyond the last centre: on the box's face.
    padded[outer] = level - np.abs(padded[outer] - level)
    found = _march(padded, grid, level)
    return Surface(found.vertices - np.array(grid.spacing), found.faces)


def areas(mesh: Surface) -> np.ndarray:
    """Area of each triangle, `(F,)`, in the grid's unit squared."""
    return np.linalg.norm(_area_vectors(mesh), axis=1)


def volume(mesh: Surface) -> float:
    """Volume enclosed by a closed surface, by the divergence theorem, in the grid's unit cubed."""
    return float((mesh.barycentres[:, ::-1] * _area_vectors(mesh)).sum() / 3)


def euler_characteristic(mesh: Surface, grid: Grid) -> int:
    """V - E + F; vertices on opposite faces of a periodic box are one."""
    spacing = np.array(grid.spacing)
    keys = np.rint(mesh.vertices / spacing * 2**20).astype(np.int64)
    if grid.periodic:
        keys %= np.array(grid.shape) * 2**20
    _, merged = np.unique(keys, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return len(np.unique(faces)) - len(np.unique(edges, axis=0)) + len(faces)


def write_surface(mesh: Surface, path: str | Path) -> Path:
    """Write a binary STL or PLY file by suffix, in (x, y, z) order and the grid's unit; whole or not at all.

    Raises
    ------
    ValueError
        If the suffix is neither `.stl` nor `.ply`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"expected a surface file ending in {' or '.join(SUFFIXES)}, got {path.name!r}")
    content = _stl(mesh) if suffix == ".stl" else _ply(mesh)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


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


def _area_vectors(mesh: Surface) -> np.ndarray:
    """Half the cross product of each triangle's edges, `(F, 3)` in (x, y, z)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]][:, ::-1] for k in range(3))
    return np.cross(b - a, c - a) / 2


def _stl(mesh: Surface) -> bytes:
    vectors = _area_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.zeros(len(mesh.faces), dtype=record)
    triangles["normal"] = vectors / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces][:, :, ::-1]
    header = b"curvafit surface, x y z".ljust(80)
    return header + np.uint32(len(triangles)).astype("<u4").tobytes() + triangles.tobytes()


def _ply(mesh: Surface) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment curvafit surface\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    return header.encode() + mesh.vertices[:, ::-1].astype("<f4").tobytes() + faces.tobytes()
