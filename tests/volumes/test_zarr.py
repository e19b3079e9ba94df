"""Zarr: OME-NGFF 0.5 level by level, and chunks that are not stored."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr

from curvafit.volumes import Field, ScanError, load, save
from curvafit.volumes.read import read_values


def image(path: Path) -> dict:
    """The one image of a group's metadata, its namespace checked."""
    content = json.loads((path / "zarr.json").read_text())
    assert (content["zarr_format"], content["node_type"]) == (3, "group")
    ome = content["attributes"]["ome"]
    assert ome["version"] == "0.5" and len(ome["multiscales"]) == 1
    return ome["multiscales"][0]


@pytest.mark.parametrize(("unit", "named"), [("nm", "nanometer"), ("um", "micrometer"), ("voxel", None)])
def test_axes_have_a_name_a_type_and_a_unit(tmp_path: Path, unit: str, named: str | None) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    path = save(Field(values, (3.0, 2.0, 0.5), unit), tmp_path / "scan.zarr")
    found = image(path)
    assert found["axes"] == [{"name": name, "type": "space", **({"unit": named} if named else {})} for name in "zyx"]
    scale = {"type": "scale", "scale": [3.0, 2.0, 0.5]}
    assert found["datasets"] == [{"path": "0", "coordinateTransformations": [scale]}]
    array = zarr.open_array(path / "0", mode="r")
    assert array.metadata.dimension_names == ("z", "y", "x")
    np.testing.assert_array_equal(array[...], values)


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


def test_a_store_replaces_a_longer_one_and_has_all_its_chunks(tmp_path: Path) -> None:
    save(Field(np.random.default_rng(0).random((130, 8, 8))), tmp_path / "scan.zarr")
    mask = np.zeros((70, 70, 70), np.uint8)
    mask[:5] = 1
    path = save(Field(mask[:, :, :50], 1.0, "um"), tmp_path / "scan.zarr")
    assert sorted(p.name for p in path.iterdir()) == ["0", "1", "zarr.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["scan.zarr"]
    assert load(path, strict=True).notes == ()


def test_groups_and_scales_are_read(tmp_path: Path) -> None:
    group = zarr.create_group(tmp_path / "scan.zarr")
    for path, size in (("0", 8), ("1", 4)):
        group.create_array(path, data=np.arange(size**3, dtype=np.uint16).reshape(1, size, size, size))
    levels = [
        {"path": path, "coordinateTransformations": [{"type": "scale", "scale": [1.0, 4 * f, 2 * f, f]}]}
        for path, f in (("0", 0.5), ("1", 1.0))
    ]
    axes = [{"name": n, "type": "space", "unit": "micrometer"} for n in "czyx"]
    group.attrs["ome"] = {"multiscales": [{"axes": axes, "datasets": levels}]}
    field = load(tmp_path / "scan.zarr")
    assert (field.shape, field.spacing, field.unit) == ((8, 8, 8), (2, 1, 0.5), "um")
    assert load(f"{tmp_path}/scan.zarr::1").spacing == (4, 2, 1)
    with pytest.raises(ScanError, match="0, 1"):
        load(f"{tmp_path}/scan.zarr::2")


# ---- chunks ----------------------------------------------------------------------------------------------------------

VALUES = (np.random.default_rng(0).random((9, 10, 11)) * 200 + 1).astype(np.uint16)


@pytest.mark.parametrize("kind", ["v2", "v3", "slashes", "group", "sharded"])
def test_missing_chunks_are_said_or_refused(tmp_path: Path, kind: str) -> None:
    path = folder = tmp_path / "scan.zarr"
    options: dict = {
        "v2": {"zarr_format": 2},
        "slashes": {"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}},
        "sharded": {"shards": (8, 10, 12)},
    }.get(kind, {})
    if kind == "group":
        zarr.create_group(path).create_array("a/b", data=VALUES, chunks=(4, 5, 6), fill_value=7)
        folder = path / "a" / "b"
    else:
        zarr.create_array(path, data=VALUES, chunks=(4, 5, 6), fill_value=7, **options)
    assert load(path, spacing=1.0).notes == () and np.array_equal(load(path, strict=True).values, VALUES)
    names = {"v2": "1.0.1", "slashes": "1/0/1", "sharded": "c/1/0/0"}
    (folder / names.get(kind, "c/1/0/1")).unlink()
    lost = 4 if kind == "sharded" else 1
    note = f"{lost} of 12 chunks are not stored: their voxels have the fill value 7."
    field = load(path, spacing=1.0)
    assert field.notes == (note,)
    assert np.count_nonzero(field.values != VALUES) <= lost * 4 * 5 * 6
    with pytest.raises(ScanError, match=f"{lost} of 12 chunks"):
        load(path, strict=True)
    with pytest.warns(UserWarning, match=f"{lost} of 12 chunks"):
        read_values(path)


def test_chunks_that_a_shard_lacks_are_counted(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[:4, :5, :6] = 0  # Zarr leaves out what is its fill value
    zarr.create_array(tmp_path / "a.zarr", data=values, chunks=(4, 5, 6), shards=(8, 10, 12))
    (note,) = load(tmp_path / "a.zarr", spacing=1.0).notes
    assert note == "1 of 12 chunks are not stored: their voxels have the fill value 0."
