"""Closed meshes are volumes: what they enclose, on voxels of a stated edge, in the place and unit that they have."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from calling import call, done, refused
from disk import unreadable
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

import curvafit
from curvafit.drawing.shapes import Output, write_field
from curvafit.priors.grid import Grid
from curvafit.scan import measure_instances
from curvafit.studies.scans import list_cases
from curvafit.volumes import Volume, load

R = 3.0


def ball(radius: float = R, centre: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(4, radius=radius)
    return mesh.apply_translation(centre[::-1])


def written(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def enclosed(mesh: trimesh.Trimesh, folder: Path, spacing: float = 0.1) -> float:
    volume = load(written(mesh, folder / "a.ply"), spacing=spacing, unit="um")
    return float(volume.values.sum()) * math.prod(volume.spacing)


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".off"])
def test_a_ball_has_its_volume_its_place_and_its_axes(tmp_path: Path, suffix: str) -> None:
    mesh = ball(centre=(10, 20, 30)).apply_scale((1, 1, 0.5))  # x, y, z: flat in z
    volume = load(written(mesh, tmp_path / f"ball{suffix}"), spacing=0.1, unit="um")
    assert (volume.spacing, volume.unit) == ((0.1, 0.1, 0.1), "um") and volume.shape[0] < volume.shape[1]
    assert volume.values.sum() * 0.1**3 == pytest.approx(mesh.volume, rel=5e-3)  # whole voxels
    centre = [*np.argwhere(volume.values).mean(0)[::-1], 1]
    assert volume.affine is not None
    assert (volume.affine @ centre)[:3] == pytest.approx([30, 20, 5], abs=1e-3)


def test_a_ball_measures_as_the_analytic_one(tmp_path: Path) -> None:
    path = written(ball(centre=(5, 6, 7)), tmp_path / "ball.stl")
    found = curvafit.measure(path, spacing=0.1, unit="um")
    box = math.prod(load(path, spacing=0.1, unit="um").shape) * 0.1**3
    assert found["BV/TV"].value == pytest.approx(4 / 3 * math.pi * R**3 / box, rel=5e-3)
    assert found["Tb.Th"].value == pytest.approx(2 * R, abs=0.2)  # balls on the grid are up to two voxels too thin
    assert found["BS/BV"].value == pytest.approx(3 / R, rel=0.02)
    assert (found["H"].value, found["C"].value) == pytest.approx((1 / R, 1 / R), rel=0.02)
    assert found["K"].value == pytest.approx(1 / R**2, rel=0.04)
    (body,) = measure_instances(path, spacing=0.1, unit="um")
    assert (body["V"].value, body["S.cut"].value) == pytest.approx((4 / 3 * math.pi * R**3, 0), rel=5e-3)


def test_bodies_are_joined_and_cavities_left(tmp_path: Path) -> None:
    """Closed forms of two balls that overlap; a body's triangles may all face inwards, or some of them."""
    whole, small = 4 / 3 * math.pi * R**3, 4 / 3 * math.pi * 2**3
    lens = math.pi * (4 * R + R) * R**2 / 12  # of two balls a radius apart
    for mesh, volume in (
        (join(ball(), ball(centre=(0, R, 0))), 2 * whole - lens), (join(ball(), ball(centre=(0, 0, 8))), 2 * whole),
        (join(ball(), turned(ball(2.0))), whole - small), (join(ball(), ball(2.0)), whole), (turned(ball()), whole),
    ):  # fmt: skip
        assert enclosed(mesh, tmp_path) == pytest.approx(volume, rel=0.01)
    mixed = ball()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    assert enclosed(mixed, tmp_path) == pytest.approx(whole, rel=0.01)
    assert any("both ways" in note for note in load(tmp_path / "a.ply").notes)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_no_row_leaks(tmp_path_factory: pytest.TempPathFactory, seed: int, whole: bool) -> None:
    """Voxel centres on vertices, edges and faces of boxes included: voxels outside a body's own box stay empty."""
    random, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("boxes")
    sides = random.integers(2, 7, 3) if whole else random.uniform(2, 7, 3)
    box = trimesh.creation.box(sides).subdivide()
    volume = load(written(box, folder / "a.ply"), spacing=0.5, unit="um")
    filled = np.argwhere(volume.values)
    assert len(filled) == math.prod(np.ptp(filled, axis=0) + 1)
    assert np.ptp(filled, axis=0) + 1 == pytest.approx(sides[::-1] / 0.5, abs=1)


def field(shape: tuple[int, int, int]) -> torch.Tensor:
    u = gaussian_filter(np.random.default_rng(0).standard_normal(shape), 4, mode="wrap")
    return torch.from_numpy(np.tanh(2 * u / u.std() - 0.8).astype(np.float32))


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
@pytest.mark.parametrize("unit", ["voxel", "mm"])
def test_a_surface_that_was_generated_is_its_field_again(tmp_path: Path, suffix: str, unit: str) -> None:
    """On the field's voxels, without caps: all but those that the solid's level, moved to keep the volume, passes."""
    u, edge = field((40, 44, 48)), 1.0 if unit == "voxel" else 0.0195
    path = write_field(u, Grid(u.shape), tmp_path / f"a{suffix}", Output(edge, unit))  # type: ignore[arg-type]
    volume = load(path)
    assert (volume.shape, volume.spacing, volume.unit, volume.notes) == (u.shape, (edge,) * 3, unit, ())
    assert volume.affine is not None and not volume.affine[:3, 3].any()
    assert np.mean(volume.values != (u.numpy() > 0)) < 3e-3
    mine, own = curvafit.measure(path), curvafit.measure(Volume(u.numpy() > 0, (edge,) * 3, unit))
    for symbol in ("BV/TV", "Tb.Th", "Tb.Sp", "BS/TV", "H.SD", "C"):
        assert mine[symbol].value == pytest.approx(own[symbol].value, rel=0.01)
    assert mine["χ"].value == own["χ"].value
    if unit == "mm":
        finer = load(path, spacing=9.75, unit="um")
        assert (finer.shape, finer.spacing, finer.unit) == ((80, 88, 96), (9.75,) * 3, "um")
        assert load(path, unit="um").spacing == pytest.approx((19.5,) * 3)


def test_edges_and_units(tmp_path: Path) -> None:
    path = written(ball(), tmp_path / "ball.stl")
    counted, named = load(path), load(path, unit="nm")
    assert (counted.spacing, counted.unit) == ((1, 1, 1), "voxel") and counted.shape == named.shape == (192,) * 3
    assert named.spacing == pytest.approx((2 * R / 128,) * 3, rel=0.01)
    assert any("0.0469" in note and "--spacing" in note for note in counted.notes)
    assert any("voxels" in note for note in counted.notes) and not any("no spacing" in note for note in named.notes)
    assert load(path, spacing=0.1, unit="cm").spacing == (1, 1, 1)
    slicer = written(ball(centre=(10, 20, 30)), tmp_path / "slicer.stl")
    content = slicer.read_bytes()
    slicer.write_bytes(b"3D Slicer output. SPACE=LPS".ljust(80) + content[80:])
    volume = load(slicer, spacing=0.2, unit="mm")
    assert volume.affine is not None
    assert (volume.affine @ [*np.argwhere(volume.values).mean(0)[::-1], 1])[:3] == pytest.approx(
        [-30, -20, 10], abs=1e-3
    )


def test_what_is_no_closed_surface_is_refused(tmp_path: Path) -> None:
    hole = ball()
    hole.update_faces(np.arange(len(hole.faces)) != 5)
    for suffix in (".stl", ".ply", ".obj", ".off"):
        unreadable(written(hole, tmp_path / f"hole{suffix}"), "3 of its 7680 edges")
    trimesh.PointCloud(ball().vertices).export(tmp_path / "points.ply")
    unreadable(tmp_path / "points.ply", "no triangles")
    path = written(ball(), tmp_path / "ball.stl")
    for spacing, word in ((1e-6, "memory"), (1e-300, "memory"), (100.0, "smaller"), ((1, 2), "spacing")):
        unreadable(path, word, spacing=spacing, unit="um")
    unreadable(path, "unit", spacing=0.1)
    path.write_bytes(path.read_bytes()[:-100])
    unreadable(path, "damaged")


def test_the_command_takes_a_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, table = written(ball(), tmp_path / "ball.obj"), tmp_path / "table.csv"
    done("measure", path, "--spacing", 0.2, "--unit", "um", "-o", table)
    assert "mean curvature" in table.read_text(encoding="utf-8")
    refused(call("measure", path, "--spacing", 1e-9, "--unit", "um"), "memory", progress=True)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    refused(call("measure", path, "--unit", "um"), 'pip install "curvafit[io]"', progress=True)


def test_in_a_folder_of_volumes_a_surface_is_no_scan(tmp_path: Path) -> None:
    """It is likely to be that of one of them; in a folder of its own it is."""
    for group in ("a", "b"):
        (tmp_path / group).mkdir()
        for k in range(2):
            written(ball(R + k), tmp_path / group / f"{k}.stl")
    surfaces, notes = list_cases((tmp_path / "a", tmp_path / "b"), None, False)
    assert [case.name for case in surfaces] == ["a/0.stl", "a/1.stl", "b/0.stl", "b/1.stl"] and "left aside" not in str(
        notes
    )
    for k in range(2):
        np.save(tmp_path / "a" / f"{k}.npy", np.ones((8, 8, 8)))
    cases, notes = list_cases((tmp_path / "a", tmp_path / "b"), None, False)
    assert [case.name for case in cases] == ["0.npy", "1.npy", "0.stl", "1.stl"]
    assert any("2 other files in a were left aside: 0.stl" in note for note in notes)
