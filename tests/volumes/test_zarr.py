"""Zarr: OME-NGFF level by level, chunks that are not stored, and transforms of coordinates."""

import json
import pickle
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import zarr
from calling import call, done, refused
from disk import tree, unreadable

from curvafit.volumes import ScanError, Volume, load, save

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


def content(path: Path) -> dict[str, Any]:
    """The attributes of a group in OME's namespace."""
    return json.loads((path / "zarr.json").read_text())["attributes"]["ome"]


@pytest.mark.parametrize(("unit", "named"), [("nm", "nanometer"), ("um", "micrometer"), ("voxel", None)])
def test_axes_have_a_name_a_type_and_a_unit(tmp_path: Path, unit: str, named: str | None) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    path = save(Volume(values, (3.0, 2.0, 0.5), unit), tmp_path / "scan.zarr")
    (found,) = content(path)["multiscales"]
    assert content(path)["version"] == "0.5"
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
    path = save(Volume(z[:, None, None] * np.ones((1, 70, 8), dtype), (2.0, 1.0, 0.5), "um"), tmp_path / "scan.zarr")
    levels = content(path)["multiscales"][0]["datasets"]
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
    save(Volume(np.random.default_rng(0).random((130, 8, 8))), tmp_path / "scan.zarr")
    mask = np.zeros((70, 70, 70), np.uint8)
    mask[:5] = 1
    path = save(Volume(mask[:, :, :50], 1.0, "um"), tmp_path / "scan.zarr")
    assert sorted(p.name for p in path.iterdir()) == ["0", "1", "zarr.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["scan.zarr"]
    assert load(path, strict=True).notes == ()


def test_groups_and_scales_are_read(tmp_path: Path) -> None:
    group = zarr.create_group(tmp_path / "scan.zarr")
    for path, size in (("0", 8), ("1", 4)):
        group.create_array(path, data=np.arange(size**3, dtype=np.uint16).reshape(1, size, size, size))
    scales = [{"type": "scale", "scale": [1.0, 4 * f, 2 * f, f]} for f in (0.5, 1.0)]
    levels = [{"path": str(k), "coordinateTransformations": [scale]} for k, scale in enumerate(scales)]
    axes = [{"name": n, "type": "space", "unit": "micrometer"} for n in "czyx"]
    group.attrs["ome"] = {"multiscales": [{"axes": axes, "datasets": levels}]}
    field = load(tmp_path / "scan.zarr")
    assert (field.shape, field.spacing, field.unit) == ((8, 8, 8), (2, 1, 0.5), "um")
    assert load(f"{tmp_path}/scan.zarr::1").spacing == (4, 2, 1)
    unreadable(f"{tmp_path}/scan.zarr::2", "0, 1")


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
    unreadable(path, f"{lost} of 12 chunks", strict=True)


def test_chunks_that_a_shard_lacks_are_counted(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[:4, :5, :6] = 0  # Zarr leaves out what is its fill value
    zarr.create_array(tmp_path / "a.zarr", data=values, chunks=(4, 5, 6), shards=(8, 10, 12))
    (note,) = load(tmp_path / "a.zarr", spacing=1.0).notes
    assert note == "1 of 12 chunks are not stored: their voxels have the fill value 0."


SHAPE, SPACING = (20, 70, 66), (0.5, 0.25, 0.25)


@pytest.fixture(params=["0.4", "0.5"])
def image(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A tube in noise, as the second of two channels, with two levels; the first voxel is not at 0."""
    z, y, x = np.mgrid[: SHAPE[0], : SHAPE[1], : SHAPE[2]]
    tube = np.hypot(y - 30 + 5 * np.sin(z / 5), x - 32) < 12
    grey = (60 + 100 * tube + 10 * np.random.default_rng(0).standard_normal(SHAPE)).astype(np.uint8)
    old, path = request.param == "0.4", tmp_path / "scan.zarr"
    naming: dict[str, Any] = {"chunk_key_encoding": {"name": "v2", "separator": "/"}} if old else {}
    group, levels = zarr.open_group(path, mode="w", zarr_format=2 if old else 3), []
    for k, n in enumerate((1, 2)):
        values = np.stack([np.zeros_like(grey), grey])[None, :, ::n, ::n, ::n]
        group.create_array(str(k), data=values, chunks=(1, 1, 16, 32, 32), **naming)
        scale = {"type": "scale", "scale": [1, 1, *(n * h / 2 for h in SPACING)]}
        levels.append({"path": str(k), "coordinateTransformations": [scale]})
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}]
    axes += [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    all_levels = [{"type": "scale", "scale": [1, 1, 2, 2, 2]}, {"type": "translation", "translation": [0, 0, 3, 2, 1]}]
    scales = {"axes": axes, "datasets": levels, "coordinateTransformations": all_levels}
    named = {"version": request.param, "multiscales": [scales | ({"version": "0.4"} if old else {})]}
    group.attrs.update(named if old else {"ome": named})
    return path


def test_steps_of_all_levels_place_each(image: Path) -> None:
    field = load(image, channel=1)
    assert (field.shape, field.spacing, field.unit) == (SHAPE, SPACING, "um")
    assert field.affine is not None and field.affine[:3, 3].tolist() == [1, 2, 3]
    coarse = load(f"{image}::1", channel=1)
    assert coarse.spacing == (1.0, 0.5, 0.5)
    assert coarse.affine is not None and coarse.affine[:3, 3].tolist() == [1, 2, 3]


def test_a_mask_lies_where_its_part_of_the_image_does(image: Path) -> None:
    """In a store of its own: nothing is written into the image's."""
    before = tree(image)
    part = load(image, channel=1, crop="4:14,:,:")
    mask = Volume(part.values > 110, part.spacing, part.unit, part.affine)
    back = load(save(mask, image.with_name("mask.zarr")))
    assert np.array_equal(back.values, mask.values) and back.affine is not None
    assert back.affine[:3, 3].tolist() == [1, 2, 5]
    for target in (image / "labels" / "tube", image / "labels" / "tube.zarr", image / "0" / "mask.nii.gz"):
        with pytest.raises(ValueError, match="in the Zarr store"):
            save(mask, target, overwrite=True)
    segment = ("segment", image, "--channel", 1, "--prior", "tubes", "-o", image / "labels" / "tube.zarr")
    refused(call(*segment), "in the Zarr store", progress=True)
    assert tree(image) == before


# ---- axes, transforms, addresses -------------------------------------------------------------------------------------


def states(folder: Path, ome: dict, values: np.ndarray, **options: Any) -> Volume:
    group = zarr.open_group(folder, mode="w")
    group.create_array("0", data=values)
    group.attrs["ome"] = ome
    return load(folder, **options)


SPACE = [{"name": axis, "type": "space", "unit": "micrometer"} for axis in "zyx"]
SCALE = {"type": "scale", "scale": [2, 1, 0.5]}


def test_transforms_of_coordinates_are_applied_or_refused(tmp_path: Path) -> None:
    """Scales and translations, in order. Others are refused, and so is a version that has others, unless a caller
    states spacing and unit."""
    values = np.arange(60, dtype=np.float32).reshape(3, 4, 5)

    def read(name: str, transforms: list[dict], version: str = "0.5", images: int = 1, **options: Any) -> Volume:
        image = {"axes": SPACE, "datasets": [{"path": "0", "coordinateTransformations": transforms}]}
        return states(tmp_path / name, {"version": version, "multiscales": [image] * images}, values, **options)

    moved = {"type": "translation", "translation": [3, 4, 5]}
    for name, transforms, corner in (
        ("scale", [SCALE, {"type": "identity"}], (0, 0, 0)), ("both", [SCALE, moved], (3, 4, 5)),
        ("moved", [moved, SCALE], (6, 4, 2.5)),
    ):  # fmt: skip
        field = read(name, transforms)
        assert np.array_equal(field.values, values) and field.unit == "um" and not field.notes
        assert field.spacing == (2, 1, 0.5)
        place = np.eye(4) if field.affine is None else field.affine
        assert place[:3, 3].tolist() == [*corner[::-1]]
    odd = [SCALE, {"type": "displacements", "path": "field"}]
    for name, transforms, version, word in (
        ("odd", odd, "0.5", "displacements"), ("path", [{"type": "scale"}], "0.4", "'scale'"),
        ("new", [SCALE], "0.6", "OME-Zarr 0.6"), ("newer", [SCALE], "1.0", "OME-Zarr 1.0"),
    ):  # fmt: skip
        with pytest.raises(ScanError, match=word):
            read(name, transforms, version)
        field = read(name, transforms, version, images=2, spacing=2.0, unit="um")
        assert field.spacing == (2, 2, 2) and "2 images" in field.notes[0]


def test_names_of_dimensions_order_axes(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    zarr.create_array(tmp_path / "three.zarr", data=values, dimension_names=("x", "z", "y"))
    old = zarr.create_array(tmp_path / "two.zarr", data=values, zarr_format=2)
    old.attrs["_ARRAY_DIMENSIONS"] = ["x", "z", "y"]
    for name in ("three", "two"):
        assert np.array_equal(load(tmp_path / f"{name}.zarr").values, values.transpose(1, 2, 0))
    group = zarr.create_group(tmp_path / "both.zarr")
    group.create_array("0", data=values, dimension_names=("x", "z", "y"))
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": SPACE, "datasets": [{"path": "0"}]}]}
    field = load(tmp_path / "both.zarr")
    assert np.array_equal(field.values, values) and "x, z, y" in field.notes[0]


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """The address of a folder that a server of this machine shows."""
    pytest.importorskip("aiohttp")
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        handler.func.log_message = lambda *_: None  # type: ignore[assignment]
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_store_at_an_address_is_read_as_on_disk(tmp_path: Path, address: str) -> None:
    """By boxes, by level, and by the command; a chunk that is cut short, or no store there, is one sentence."""
    values = np.random.default_rng(0).random((70, 20, 20)).astype(np.float32)
    save(Volume(values, (2.0, 1.0, 1.0), "um"), tmp_path / "scan.zarr")
    here, there = load(tmp_path / "scan.zarr"), load(f"{address}/scan.zarr")
    assert np.array_equal(there.values, here.values) and (there.spacing, there.unit) == (here.spacing, here.unit)
    assert any("not on this machine" in note for note in there.notes)
    assert load(f"{address}/scan.zarr::1").shape == (35, 10, 10)
    lazy = pickle.loads(pickle.dumps(load(f"{address}/scan.zarr", lazy=True)))
    assert lazy.in_file and np.array_equal(lazy.read((slice(60, 70), slice(0, 2), slice(3, 5))), values[60:, :2, 3:5])
    zarr.create_array(tmp_path / "bare.zarr", data=values)
    assert np.array_equal(load(f"{address}/bare.zarr", spacing=1.0).values, values)
    result = done("measure", f"{address}/scan.zarr", "--threshold", 0.5, "--kind", "image")
    assert "BV/TV" in result.stdout
    unreadable(f"{address}/none.zarr", "none.zarr")
    unreadable(f"{address}/scan.zarr::9", "scan.zarr")
    unreadable(f"{address}/scan.zarr", "not whole", strict=True)
    chunk = next(path for path in (tmp_path / "scan.zarr" / "0" / "c").rglob("*") if path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:100])
    unreadable(f"{address}/scan.zarr", "scan.zarr")
