"""Surfaces: seams, orientation, caps, topology; and in files, as other programs read them."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from exact import Gyroid, Sphere, Torus, centres
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from curvafit.geometry.mesh import Surface, areas, capped_surface, solid_surface, surface, volume, write_surface
from curvafit.priors.grid import Grid

SPACING = (0.1, 0.08, 0.12)
BALL, CENTRE = Sphere(1.0, (1.4, 1.36, 1.44)), (1.4, 1.36, 1.44)
HALF = torch.tensor(SPACING, dtype=torch.float64) / 2  # from the box's corner to the first voxel's centre


def field(shape, grid: Grid) -> torch.Tensor:
    return shape.distance(centres(grid))


def ball() -> tuple[torch.Tensor, Grid]:
    grid = Grid((28, 34, 24), SPACING, "replicate")
    return field(BALL, grid), grid


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


def test_a_ball_s_area_and_volume_from_below_and_its_triangles_outwards() -> None:
    """Vertices lie on a sphere (nearly), triangles inside. Linear interpolation of a distance errs by at most h² κ / 8
    along an edge: 0.0023 at the smaller ball."""
    u, grid = ball()
    mesh = surface(u, grid)
    assert 0.98 * 4 * math.pi < areas(mesh).sum() < 4 * math.pi
    assert 0.98 * 4 / 3 * math.pi < volume(mesh) < 4 / 3 * math.pi and volume(surface(-u, grid)) < 0
    for level in (0.0, 0.2):
        away = BALL.distance(torch.from_numpy(surface(u, grid, level).vertices) + HALF) - level
        assert float(away.abs().max()) < 0.0023
    corners = mesh.vertices[mesh.faces][:, :, ::-1]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out, large = corners.mean(1) - corners.mean((0, 1)), areas(mesh) > 1e-6
    assert ((normals * out).sum(1)[large] > 0).all()
    known = Surface(np.array([[0.0, 0, 0], [0, 3, 0], [0, 0, 4]]), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(areas(known), [6.0])
    np.testing.assert_allclose(known.barycentres, [[0, 1, 4 / 3]])


@settings(deadline=None, max_examples=8)
@given(shift=st.tuples(*[st.integers(0, 15)] * 3))
def test_a_periodic_surface_does_not_see_the_seam(shift: tuple[int, int, int]) -> None:
    """Each cell once, wherever the box is cut: the area and Euler characteristic stay."""
    grid = Grid((16, 16, 16), SPACING)
    u = field(Sphere(0.5, (0.8, 0.64, 0.96)), grid)
    whole, moved = surface(u, grid), surface(u.roll(shift, (0, 1, 2)), grid)
    assert areas(moved).sum() == pytest.approx(areas(whole).sum(), rel=1e-5)
    assert euler_characteristic(moved, grid) == euler_characteristic(whole, grid) == 2


def test_euler_characteristics() -> None:
    grid = Grid((20, 44, 44), (0.1, 0.1, 0.1), "replicate")
    assert euler_characteristic(surface(*ball()), ball()[1]) == 2
    assert euler_characteristic(surface(field(Torus(1.3, 0.6, (1.0, 2.2, 2.2)), grid), grid), grid) == 0
    box = Grid((24, 24, 24), (1 / 24,) * 3)
    gyroid = surface(Gyroid(1.0).level(centres(box)), box)
    assert euler_characteristic(gyroid, box) == -8
    assert areas(gyroid).sum() == pytest.approx(3.0915, rel=0.01)  # the minimal surface's, which it approximates
    capped = capped_surface(Gyroid(1.0).level(centres(box)), box)
    assert closed(capped) and volume(capped) == pytest.approx(0.5, abs=0.002)
    u = torch.where(torch.arange(8).view(8, 1, 1).expand(8, 8, 8) < 4, 1.0, -1.0)
    open_box, torus = Grid((8, 8, 8), (1.0, 1.0, 1.0), "replicate"), Grid((8, 8, 8), (1.0, 1.0, 1.0))
    assert areas(surface(u, open_box)).sum() == pytest.approx(49)
    assert areas(surface(u, torus)).sum() == pytest.approx(2 * 64)


def closed(mesh: Surface) -> bool:
    """Whether trimesh finds the mesh closed and evenly wound once its vertices are in float32, as files hold them."""
    read = trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces)
    return bool(read.is_watertight and read.is_winding_consistent)


def test_caps_close_the_box_on_its_faces() -> None:
    """A solid that leaves the box is cut where the voxels end, sharply; opposite faces of a periodic box fit."""
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
    grid = Grid((12, 10, 9), SPACING)
    u = gaussian_filter(np.random.default_rng(3).standard_normal(grid.shape), 1.5, mode="wrap")
    mesh = capped_surface(u, grid)
    for axis, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        low, high = (mesh.vertices[np.abs(mesh.vertices[:, axis] - place) < 1e-9] for place in (-h / 2, (n - 0.5) * h))
        assert len(low) > 3
        others = [k for k in range(3) if k != axis]
        np.testing.assert_allclose(np.unique(low[:, others], axis=0), np.unique(high[:, others], axis=0), atol=1e-9)


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


def test_a_solid_has_the_volume_of_its_voxels() -> None:
    """Those of a small ball lack 0.8 % of its volume, triangles 0.6 %: the solid follows the voxels, and stays within
    0.05 voxels of the level set."""
    _, grid = ball()
    u = torch.tanh(10 * field(BALL, grid))
    wanted = float((u > 0).sum()) * grid.voxel_volume
    mesh = solid_surface(u, grid)
    assert closed(mesh)
    assert volume(capped_surface(u, grid)) > 1.001 * wanted
    assert volume(mesh) == pytest.approx(wanted, rel=2e-4)
    assert float(BALL.distance(torch.from_numpy(mesh.vertices) + HALF).abs().max()) < 0.05 * max(SPACING)
    grid = Grid((6, 5, 4), (1.0, 1.0, 1.0))  # a box without a surface, and half of it
    assert volume(solid_surface(np.ones(grid.shape), grid)) == pytest.approx(120)
    half = np.where(np.arange(4) < 2, 1.0, -1.0) + np.zeros(grid.shape)
    assert volume(solid_surface(half, grid)) == pytest.approx(60, rel=1e-4)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".PLY"])
def test_files_are_read_back_by_another_program(tmp_path: Path, suffix: str) -> None:
    """In x, y, z order, closed, with the volume's sign kept; a surface replaces the one before."""
    mesh, path = capped_surface(*ball()), tmp_path / f"ball{suffix}"
    write_surface(Surface(mesh.vertices * 2, mesh.faces), path)
    found = trimesh.load_mesh(write_surface(mesh, path, unit="mm"))
    assert found.is_watertight
    assert found.volume == pytest.approx(volume(mesh), rel=1e-5) and found.volume > 4
    np.testing.assert_allclose(found.bounds.mean(0), (np.array(CENTRE) - HALF.numpy())[::-1], atol=0.01)
    assert b"lengths in mm" in path.read_bytes()[:200] and [p.name for p in tmp_path.iterdir()] == [path.name]
    if suffix == ".stl":
        assert path.stat().st_size == 84 + 50 * len(mesh.faces)


def test_ply_carries_numbers(tmp_path: Path) -> None:
    mesh = capped_surface(*ball())
    kappa = np.arange(len(mesh.vertices)) / 7
    ply = trimesh.load(write_surface(mesh, tmp_path / "ball.ply", data={"kappa2": kappa}), process=False)
    np.testing.assert_array_equal(ply.metadata["_ply_raw"]["vertex"]["data"]["kappa2"], kappa.astype("f4"))
    np.testing.assert_allclose(ply.vertices, mesh.vertices[:, ::-1], atol=1e-6)
