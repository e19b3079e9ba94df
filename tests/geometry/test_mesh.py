"""Surfaces: seams, orientation, caps, topology."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from exact import Gyroid, Sphere, Torus, centres
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from curvafit.geometry.mesh import (
    NoSurface,
    Surface,
    areas,
    capped_surface,
    solid_surface,
    surface,
    volume,
)
from curvafit.priors.grid import Grid

SPACING = (0.1, 0.08, 0.12)


def field(shape, grid: Grid) -> torch.Tensor:
    return shape.distance(centres(grid))


def ball(radius: float = 1.0) -> tuple[torch.Tensor, Grid]:
    grid = Grid((28, 34, 24), SPACING, "replicate")
    return field(Sphere(radius, (1.4, 1.36, 1.44)), grid), grid


def euler_characteristic(mesh: Surface, grid: Grid) -> int:
    """V - E + F of a mesh; vertices on opposite faces of a periodic box are one."""
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


def test_a_balls_area_and_volume_from_below() -> None:
    """Vertices lie on a sphere (nearly), triangles inside it."""
    mesh = surface(*ball())
    assert 0.98 * 4 * math.pi < areas(mesh).sum() < 4 * math.pi
    assert 0.98 * 4 / 3 * math.pi < volume(mesh) < 4 / 3 * math.pi


def test_vertices_lie_on_the_level_set_in_the_grids_unit() -> None:
    """Linear interpolation of a distance errs by at most h² κ / 8 along an edge: 0.0023 at the smaller ball."""
    u, grid = ball()
    corner = torch.tensor(grid.spacing, dtype=torch.float64) / 2
    for level in (0.0, 0.2):
        mesh = surface(u, grid, level)
        found = Sphere(1.0, (1.4, 1.36, 1.44)).distance(torch.from_numpy(mesh.vertices) + corner)
        assert float((found - level).abs().max()) < 0.0023


def test_triangles_face_outwards() -> None:
    mesh = surface(*ball())
    corners = mesh.vertices[mesh.faces][:, :, ::-1]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = corners.mean(1) - corners.mean((0, 1))
    large = areas(mesh) > 1e-6
    assert ((normals * out).sum(1)[large] > 0).all()
    assert volume(surface(-ball()[0], ball()[1])) < 0


@settings(deadline=None, max_examples=8)
@given(shift=st.tuples(*[st.integers(0, 15)] * 3))
def test_a_periodic_surface_does_not_see_the_seam(shift: tuple[int, int, int]) -> None:
    """Each cell once, wherever the box is cut: the area and Euler characteristic stay."""
    grid = Grid((16, 16, 16), SPACING)
    u = field(Sphere(0.5, (0.8, 0.64, 0.96)), grid)
    whole, moved = surface(u, grid), surface(u.roll(shift, (0, 1, 2)), grid)
    assert areas(moved).sum() == pytest.approx(areas(whole).sum(), rel=1e-5)
    assert euler_characteristic(moved, grid) == euler_characteristic(whole, grid) == 2


def test_a_mirrored_box_ends_at_its_outermost_centres() -> None:
    """A slab's two faces, 7 centres' gaps on a side instead of 8."""
    u = torch.where(torch.arange(8).view(8, 1, 1).expand(8, 8, 8) < 4, 1.0, -1.0)
    open_box, torus = Grid((8, 8, 8), (1.0, 1.0, 1.0), "replicate"), Grid((8, 8, 8), (1.0, 1.0, 1.0))
    assert areas(surface(u, open_box)).sum() == pytest.approx(49)
    assert areas(surface(u, torus)).sum() == pytest.approx(2 * 64)


def test_euler_characteristics() -> None:
    grid = Grid((20, 44, 44), (0.1, 0.1, 0.1), "replicate")
    assert euler_characteristic(surface(*ball()), ball()[1]) == 2
    assert euler_characteristic(surface(field(Torus(1.3, 0.6, (1.0, 2.2, 2.2)), grid), grid), grid) == 0
    box = Grid((24, 24, 24), (1 / 24,) * 3)
    gyroid = surface(Gyroid(1.0).level(centres(box)), box)
    assert euler_characteristic(gyroid, box) == -8
    assert areas(gyroid).sum() == pytest.approx(3.0915, rel=0.01)  # the minimal surface's, which it approximates


def closed(mesh: Surface) -> bool:
    """Whether trimesh finds the mesh closed and evenly wound once its vertices are in float32, as files hold them."""
    read = trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces)
    return bool(read.is_watertight and read.is_winding_consistent)


def test_caps_close_the_box_on_its_faces() -> None:
    """A solid that leaves the box is cut where the voxels end, sharply."""
    grid = Grid((10, 12, 8), SPACING, "replicate")
    u = torch.ones(grid.shape)
    u[:, 3:9] = -1.0
    mesh = capped_surface(u, grid)
    assert closed(mesh)
    half = np.array(grid.spacing) / 2
    np.testing.assert_allclose(mesh.vertices.min(0), -half, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(0), np.array(grid.shape) * SPACING - half, atol=1e-6)
    assert volume(mesh) == pytest.approx(grid.volume / 2, rel=1e-4)
    thick, z, x = 0.24, 1.0, 0.96  # two slabs of half the box's 12 voxels together
    assert areas(mesh).sum() == pytest.approx(4 * z * x + 4 * thick * (z + x), rel=1e-3)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(("noise", "whole numbers", "signs", "blobs")),
    st.sampled_from(("periodic", "replicate")),
)
def test_whatever_the_field_its_capped_surface_is_closed(seed: int, kind: str, boundary) -> None:
    """Voxels on the level, ties and noise included: they are what leaves holes."""
    random = np.random.default_rng(seed)
    grid = Grid(tuple(random.integers(4, 11, 3)), (0.3, 0.1, 0.7), boundary)
    u = random.standard_normal(grid.shape)
    if kind == "whole numbers":
        u = random.integers(-1, 2, grid.shape).astype(float)
    elif kind == "signs":
        u = np.sign(u)
    elif kind == "blobs":
        u = gaussian_filter(u, 1.0, mode="wrap")
    assert closed(capped_surface(u, grid, float(u.mean()) if kind == "blobs" else 0.0))


def test_caps_of_opposite_faces_fit() -> None:
    """What one copy of a periodic box covers of its face, the next copy covers of its own."""
    grid = Grid((12, 10, 9), SPACING)
    u = gaussian_filter(np.random.default_rng(3).standard_normal(grid.shape), 1.5, mode="wrap")
    mesh = capped_surface(u, grid)
    for axis, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        low, high = (mesh.vertices[np.abs(mesh.vertices[:, axis] - place) < 1e-9] for place in (-h / 2, (n - 0.5) * h))
        assert len(low) > 3
        others = [k for k in range(3) if k != axis]
        np.testing.assert_allclose(np.unique(low[:, others], axis=0), np.unique(high[:, others], axis=0), atol=1e-9)


def test_capped_gyroid_is_watertight_and_holds_half_the_box() -> None:
    box = Grid((20, 20, 20), (1 / 20,) * 3)
    mesh = capped_surface(Gyroid(1.0).level(centres(box)), box)
    assert closed(mesh)
    assert volume(mesh) == pytest.approx(0.5, abs=0.002)


def test_a_solid_has_the_volume_of_its_voxels() -> None:
    """Those of a small ball lack 0.8 % of its volume, triangles 0.6 %: the solid follows the voxels, and stays within
    0.05 voxels of the level set."""
    _, grid = ball()
    u = torch.tanh(10 * field(Sphere(1.0, (1.4, 1.36, 1.44)), grid))
    wanted = float((u > 0).sum()) * grid.voxel_volume
    mesh = solid_surface(u, grid)
    assert closed(mesh)
    assert volume(capped_surface(u, grid)) > 1.001 * wanted
    assert volume(mesh) == pytest.approx(wanted, rel=2e-4)
    corner = torch.tensor(grid.spacing, dtype=torch.float64) / 2
    away = Sphere(1.0, (1.4, 1.36, 1.44)).distance(torch.from_numpy(mesh.vertices) + corner)
    assert float(away.abs().max()) < 0.05 * max(SPACING)


def test_a_solid_without_a_surface_is_the_box_or_refused() -> None:
    grid = Grid((6, 5, 4), (1.0, 1.0, 1.0))
    assert volume(solid_surface(np.ones(grid.shape), grid)) == pytest.approx(120)
    half = np.where(np.arange(4) < 2, 1.0, -1.0) + np.zeros(grid.shape)
    assert volume(solid_surface(half, grid)) == pytest.approx(60, rel=1e-4)
    with pytest.raises(NoSurface, match="exceeds"):
        solid_surface(-np.ones(grid.shape), grid)


def test_bad_input_is_one_sentence() -> None:
    u, grid = ball()
    with pytest.raises(NoSurface, match="crosses"):
        surface(u - 5, grid)
    with pytest.raises(ValueError, match="shape"):
        surface(torch.zeros(4, 4, 4), grid)
    u[3, 3, 3] = math.nan
    with pytest.raises(ValueError, match="finite"):
        surface(u, grid)


def test_areas_of_a_known_triangle() -> None:
    mesh = Surface(np.array([[0.0, 0, 0], [0, 3, 0], [0, 0, 4]]), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(areas(mesh), [6.0])
    np.testing.assert_allclose(mesh.barycentres, [[0, 1, 4 / 3]])
