"""Surfaces in files: what other programs read of them."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from disk import vtk_array
from exact import Sphere, centres

from curvafit.geometry.mesh import Surface, capped_surface, volume, write_surface
from curvafit.priors.grid import Grid

SPACING = (0.1, 0.08, 0.12)
CENTRE = (1.4, 1.36, 1.2)


def ball() -> Surface:
    grid = Grid((28, 34, 20), SPACING, "replicate")
    return capped_surface(Sphere(1.0, CENTRE).distance(centres(grid)), grid)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".PLY"])
def test_files_are_read_back_by_another_program(tmp_path: Path, suffix: str) -> None:
    """In x, y, z order, closed, with the volume's sign kept."""
    mesh = ball()
    path = write_surface(mesh, tmp_path / f"ball{suffix}", unit="mm")
    found = trimesh.load_mesh(path)
    assert isinstance(found, trimesh.Trimesh)
    assert found.is_watertight
    assert found.volume == pytest.approx(volume(mesh), rel=1e-5) and found.volume > 4
    np.testing.assert_allclose(found.bounds.mean(0), np.array(CENTRE[::-1]) - np.array(SPACING[::-1]) / 2, atol=0.01)
    assert b"lengths in mm" in path.read_bytes()[:200]
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_vtp_is_poly_data_as_vtk_describes_it(tmp_path: Path) -> None:
    mesh = ball()
    kappa = np.arange(len(mesh.vertices)) / 7
    root = ElementTree.parse(write_surface(mesh, tmp_path / "ball.vtp", unit="um", data={"kappa1": kappa})).getroot()
    assert (root.tag, root.attrib["type"], root.attrib["byte_order"]) == ("VTKFile", "PolyData", "LittleEndian")
    assert root.attrib["header_type"] == "UInt64"
    (piece,) = root.findall("PolyData/Piece")
    counts = {name: int(piece.attrib[f"NumberOf{name}"]) for name in ("Points", "Polys", "Verts", "Lines", "Strips")}
    assert counts == {"Points": len(mesh.vertices), "Polys": len(mesh.faces), "Verts": 0, "Lines": 0, "Strips": 0}
    arrays = {node.attrib["Name"]: vtk_array(node) for node in piece.iter("DataArray")}
    np.testing.assert_array_equal(arrays["Points"], mesh.vertices[:, ::-1].astype("f4"))
    np.testing.assert_array_equal(arrays["connectivity"].reshape(-1, 3), mesh.faces)
    np.testing.assert_array_equal(arrays["offsets"].ravel(), 3 * np.arange(1, len(mesh.faces) + 1))
    np.testing.assert_array_equal(arrays["kappa1"].ravel(), kappa.astype("f4"))


def test_ply_carries_numbers_at_the_vertices(tmp_path: Path) -> None:
    mesh = ball()
    kappa = np.arange(len(mesh.vertices)) / 7
    found = trimesh.load(write_surface(mesh, tmp_path / "ball.ply", data={"kappa2": kappa}), process=False)
    np.testing.assert_array_equal(found.metadata["_ply_raw"]["vertex"]["data"]["kappa2"], kappa.astype("f4"))
    np.testing.assert_allclose(found.vertices, mesh.vertices[:, ::-1], atol=1e-6)


def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="stl"):
        write_surface(ball(), tmp_path / "ball.obj")
    with pytest.raises(ValueError, match="kappa1"):
        write_surface(ball(), tmp_path / "ball.vtp", data={"kappa1": np.zeros(3)})
    assert list(tmp_path.iterdir()) == []


def test_a_surface_replaces_the_one_before(tmp_path: Path) -> None:
    path = write_surface(ball(), tmp_path / "ball.stl")
    write_surface(Surface(ball().vertices * 2, ball().faces), path)
    assert trimesh.load_mesh(path).volume == pytest.approx(8 * volume(ball()), rel=1e-5)
    assert path.stat().st_size == 84 + 50 * len(ball().faces)
