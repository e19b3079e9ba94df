"""Zarr as OME-NGFF 0.5 describes it, level by level."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr

from curvafit.volumes.field import Field
from curvafit.volumes.read import load
from curvafit.volumes.write import save


def image(path: Path) -> dict:
    """The one image of a group's metadata, its namespace checked."""
    content = json.loads((path / "zarr.json").read_text())
    assert (content["zarr_format"], content["node_type"]) == (3, "group")
    ome = content["attributes"]["ome"]
    assert ome["version"] == "0.5" and len(ome["multiscales"]) == 1
    return ome["multiscales"][0]


@pytest.mark.parametrize(
    ("unit", "named"), [("nm", "nanometer"), ("um", "micrometer"), ("mm", "millimeter"), ("m", "meter")]
)
def test_axes_have_a_name_a_type_and_a_unit(tmp_path: Path, unit: str, named: str) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    path = save(Field(values, (3.0, 2.0, 0.5), unit), tmp_path / "scan.zarr")
    found = image(path)
    assert found["axes"] == [{"name": name, "type": "space", "unit": named} for name in "zyx"]
    scale = {"type": "scale", "scale": [3.0, 2.0, 0.5]}
    assert found["datasets"] == [{"path": "0", "coordinateTransformations": [scale]}]
    array = zarr.open_array(path / "0", mode="r")
    assert array.metadata.dimension_names == ("z", "y", "x")
    np.testing.assert_array_equal(array[...], values)


def test_voxels_without_a_unit_state_none(tmp_path: Path) -> None:
    found = image(save(Field(np.arange(60.0).reshape(3, 4, 5)), tmp_path / "scan.zarr"))
    assert found["axes"] == [{"name": name, "type": "space"} for name in "zyx"]


@pytest.mark.parametrize("dtype", ["float32", "uint16"])
def test_halved_levels_lie_where_the_whole_one_does(tmp_path: Path, dtype: str) -> None:
    """A ramp along z stays the same function of the place that scale and translation give a voxel."""
    z = np.arange(130, dtype=dtype)
    path = save(Field(z[:, None, None] * np.ones((1, 70, 8), dtype), (2.0, 1.0, 0.5), "um"), tmp_path / "scan.zarr")
    levels = image(path)["datasets"]
    shapes = [zarr.open_array(path / level["path"], mode="r").shape for level in levels]
    assert shapes == [(130, 70, 8), (65, 35, 4), (33, 18, 2)]
    for level, (n, _, _) in zip(levels, shapes, strict=True):
        scale, *moved = level["coordinateTransformations"]
        first = moved[0]["translation"][0] if moved else 0.0
        place = first + scale["scale"][0] * np.arange(n)
        found = zarr.open_array(path / level["path"], mode="r")[:, 0, 0]
        inner = slice(0, 32)  # the last voxel of an odd axis counts twice
        np.testing.assert_allclose(found[inner], place[inner] / 2.0, rtol=1e-6)
        assert found.dtype == dtype
    assert load(f"{path}::1").spacing == (4.0, 2.0, 1.0)
    back = load(path)
    assert back.spacing == (2.0, 1.0, 0.5) and back.unit == "um" and back.notes == ()


def test_a_store_replaces_a_longer_one(tmp_path: Path) -> None:
    save(Field(np.random.default_rng(0).random((130, 8, 8))), tmp_path / "scan.zarr")
    path = save(Field(np.arange(60.0).reshape(3, 4, 5)), tmp_path / "scan.zarr")
    assert sorted(p.name for p in path.iterdir()) == ["0", "zarr.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["scan.zarr"]
