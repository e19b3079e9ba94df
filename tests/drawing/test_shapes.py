"""Shapes on disk: units, curvatures at the vertices of a surface."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from exact import Sphere, centres
from torch import Tensor

from curvafit.drawing.shapes import Output, write_field
from curvafit.priors.grid import Grid
from curvafit.volumes.read import load


def ball(boundary) -> tuple[Tensor, Grid]:
    """A ball of radius 9 voxels that leaves the box through one face."""
    grid = Grid((26, 26, 26), 0.01, boundary)
    distance = Sphere(0.09, (0.13, 0.13, 0.2)).distance(centres(Grid(grid.shape, grid.spacing, "replicate")))
    return torch.tanh(distance / (2**0.5 * 0.02)).float(), grid


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_ply_bears_the_curvatures_in_its_unit(tmp_path: Path, boundary: str) -> None:
    """1/R of the ball in 1/mm where its surface is, 0 on the caps."""
    path = write_field(*ball(boundary), tmp_path / "ball.ply", Output(0.5, "mm"))
    ply = trimesh.load(path, process=False)
    x, arrays = ply.vertices[:, 0], ply.metadata["_ply_raw"]["vertex"]["data"]
    on_ball = np.abs(x - 9.75) < 1.5
    for name in ("kappa1", "kappa2"):
        κ = arrays[name]
        assert np.median(κ[on_ball]) == pytest.approx(1 / 4.5, rel=0.02)
        assert np.ptp(κ[on_ball]) < 0.05
        assert (κ[np.abs(x - 12.75) < 1e-5] == 0).all()


def test_a_unit_is_named_and_converted_once(tmp_path: Path) -> None:
    how = Output(0.002, "cm")
    assert (how.voxel, how.unit) == (0.02, "mm")
    field = load(write_field(*ball("periodic"), tmp_path / "ball.nii", how))
    assert field.spacing == pytest.approx((0.02, 0.02, 0.02)) and field.unit == "mm"
