"""Zarr: OME-NGFF level by level, chunks that are not stored, and labels on the voxels of an image."""

import json
import pickle
import warnings
from collections.abc import Iterator
from dataclasses import replace
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
from curvafit.volumes.read import read_values

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


def content(path: Path, version: str) -> dict[str, Any]:
    """The attributes of a group, of OME's namespace where the version has one."""
    if version == "0.4":
        return json.loads((path / ".zattrs").read_text())
    return json.loads((path / "zarr.json").read_text())["attributes"]["ome"]


@pytest.mark.parametrize(("unit", "named"), [("nm", "nanometer"), ("um", "micrometer"), ("voxel", None)])
def test_axes_have_a_name_a_type_and_a_unit(tmp_path: Path, unit: str, named: str | None) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    path = save(Volume(values, (3.0, 2.0, 0.5), unit), tmp_path / "scan.zarr")
    (found,) = content(path, "0.5")["multiscales"]
    assert content(path, "0.5")["version"] == "0.5"
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
    levels = content(path, "0.5")["multiscales"][0]["datasets"]
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
    with pytest.warns(UserWarning, match=f"{lost} of 12 chunks"):
        read_values(path)


def test_chunks_that_a_shard_lacks_are_counted(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[:4, :5, :6] = 0  # Zarr leaves out what is its fill value
    zarr.create_array(tmp_path / "a.zarr", data=values, chunks=(4, 5, 6), shards=(8, 10, 12))
    (note,) = load(tmp_path / "a.zarr", spacing=1.0).notes
    assert note == "1 of 12 chunks are not stored: their voxels have the fill value 0."


SHAPE, SPACING = (20, 70, 66), (0.5, 0.25, 0.25)


@pytest.fixture(params=["0.4", "0.5"])
def image(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
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
    return path, request.param


def tube_of(path: Path, **part: Any) -> Volume:
    """The mask of the tube, on the voxels of the image or a part of it."""
    field = load(path, channel=1, **part)
    return Volume(field.values > 110, field.spacing, field.unit, field.affine)


def test_steps_of_all_levels_place_each(image: tuple[Path, str]) -> None:
    field = load(image[0], channel=1)
    assert (field.shape, field.spacing, field.unit) == (SHAPE, SPACING, "um")
    assert field.affine is not None and field.affine[:3, 3].tolist() == [1, 2, 3]
    coarse = load(f"{image[0]}::1", channel=1)
    assert coarse.spacing == (1.0, 0.5, 0.5)
    assert coarse.affine is not None and coarse.affine[:3, 3].tolist() == [1, 2, 3]


def test_labels_lie_on_the_image_and_are_listed(image: tuple[Path, str]) -> None:
    path, version = image
    before, mask, part = tree(path), tube_of(path), tube_of(path, crop="4:14,:,:")
    assert save(mask, path / "labels/tube") == path / "labels/tube"
    save(Volume(part.values.astype(np.uint16) * 700, part.spacing, part.unit, part.affine), path / "labels/part")
    assert {name: data for name, data in tree(path).items() if not name.startswith("labels")} == before
    assert content(path / "labels", version)["labels"] == ["tube", "part"]
    own = content(path / "labels/tube", version)
    assert own["image-label"]["source"] == {"image": "../../"}
    (scales,) = own["multiscales"]
    assert scales["name"] == "tube" and [axis["name"] for axis in scales["axes"]] == list("zyx")
    steps = [level["coordinateTransformations"] for level in scales["datasets"]]
    for k, (scale, first) in enumerate(steps):
        assert scale["scale"] == [2**k * h for h in SPACING] and first["translation"] == [3, 2, 1]
    back = load(f"{path}::labels/tube")
    assert back.values.dtype == np.uint8 and np.array_equal(back.values, mask.values)
    np.testing.assert_array_equal(back.affine, mask.affine)
    low = load(f"{path}::labels/part")
    assert low.values.max() == 700 and low.affine is not None and low.affine[:3, 3].tolist() == [1, 2, 5]
    assert load(path, channel=1).shape == SHAPE  # the image is still what the store is read as
    np.testing.assert_allclose(load(save(part, path.parent / "part.zarr")).affine, part.affine)


def test_labels_are_replaced_by_what_wrote_them_alone_and_a_consolidated_store_shows_them(image) -> None:
    path, version = image
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)
    mask = tube_of(path)
    for _ in range(2):
        save(mask, path / "labels/tube", kind="ours")
    assert content(path / "labels", version)["labels"] == ["tube"]
    assert "labels/tube/0" in dict(zarr.open_group(path, mode="r").members(max_depth=None))
    with pytest.raises(ValueError, match="not free"):
        save(mask, path / "labels/tube", kind="other")


@pytest.mark.parametrize(
    ("change", "name", "words"),
    [
        *(({name: value}, "tube", "voxels of a level")  # without a place it begins before the image does
          for name, value in (("spacing", (0.5, 0.25, 0.2)), ("unit", "mm"), ("affine", None))),
        ({"array": np.ones(SHAPE, np.float32)}, "tube", "whole numbers"),
        ({}, ".tube", "name of labels"),
    ],
)  # fmt: skip
def test_other_voxels_are_refused(image: tuple[Path, str], change: dict[str, Any], name: str, words: str) -> None:
    path, field = image[0], load(image[0], channel=1)
    before = tree(path)
    with pytest.raises(ScanError, match=words):
        save(replace(field, **change), path / "labels" / name)
    assert tree(path) == before


def test_an_image_of_another_version_or_none_is_refused(tmp_path: Path) -> None:
    group, mask = zarr.open_group(tmp_path / "scan.zarr", mode="w"), Volume(np.indices((4, 4, 4))[0] > 1)
    newer = {"version": "0.6", "multiscales": [{}]}
    for attributes, words in (({}, "no image of OME-Zarr"), (newer, r"OME-Zarr 0\.6")):
        group.attrs["ome"] = attributes
        with pytest.raises(ScanError, match=words):
            save(mask, tmp_path / "scan.zarr/labels/a")


def test_levels_that_disagree_are_said_and_one_can_be_named(image: tuple[Path, str]) -> None:
    path = image[0]
    group: Any = zarr.open_group(path, mode="r+")
    attributes = group.attrs.asdict()
    scales = attributes.get("ome", attributes)["multiscales"][0]
    scales["datasets"][1]["coordinateTransformations"][0]["scale"][3] *= 2
    group.attrs.update(attributes)
    refused(call("measure", path, "--channel", 1), "levels of", progress=True)
    assert load(f"{path}::0", channel=1).shape == SHAPE
    scales["datasets"][1]["path"] = "9"
    group.attrs.update(attributes)
    unreadable(path, "level 9, which is not there", channel=1)


def test_an_interrupted_writing_is_made_whole_by_the_next(image: tuple[Path, str], monkeypatch) -> None:
    path, version = image
    mask = tube_of(path)
    with monkeypatch.context() as patch:
        patch.setattr("curvafit.volumes.formats.zarr.write_content", lambda *_: (_ for _ in ()).throw(OSError("full")))
        with pytest.raises(OSError, match="full"):
            save(mask, path / "labels/tube")
    save(mask, path / "labels/tube")
    assert content(path / "labels", version)["labels"] == ["tube"]
    assert np.array_equal(load(f"{path}::labels/tube").values, mask.values)
    assert [place.name for place in path.parent.iterdir()] == ["scan.zarr"]


def test_a_command_writes_labels_and_the_rest_beside_the_store(image: tuple[Path, str], monkeypatch) -> None:
    path, version = image
    monkeypatch.chdir(path.parent)
    command = ("segment", "scan.zarr", "--channel", 1, "--prior", "tubes", "--weight", 0.1, "--steps", 2)
    done(*command, "-o", "scan.zarr/labels/tube")
    assert sorted(place.name for place in path.parent.iterdir()) == ["scan.zarr", "scan_tube.json", "scan_tube.png"]
    assert content(path / "labels", version)["labels"] == ["tube"]
    record = json.loads(Path("scan_tube.json").read_text())
    assert record["files"] == ["scan_tube.png", "scan_tube.json"]
    truth = load(path, channel=1).values > 110
    assert (load(f"{path}::labels/tube").values == truth).mean() > 0.97
    before = tree(path.parent)
    target = ("-o", "scan.zarr/labels/tube")
    refused(call(*command, "--spacing", 0.3, "--unit", "um", *target), "voxels of a level", progress=True)
    refused(call("segment", "scan.zarr::labels/tube", *command[4:], *target), "write over the input")
    assert tree(path.parent) == before


# ---- axes, transforms, addresses -------------------------------------------------------------------------------------


def states(folder: Path, ome: dict, values: np.ndarray, **options: Any) -> Volume:
    group = zarr.open_group(folder, mode="w")
    group.create_array("0", data=values)
    group.attrs["ome"] = ome
    return load(folder, **options)


SPACE = [{"name": axis, "type": "space", "unit": "micrometer"} for axis in "zyx"]
SCALE, ONE = {"type": "scale", "scale": [2, 1, 0.5]}, {"type": "translation", "translation": [1, 1, 1]}


def test_transforms_of_coordinates_are_applied_or_refused(tmp_path: Path) -> None:
    """Those of version 0.6 lead from a level to a system of coordinates; one that is not known is refused."""
    values = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    turn = np.eye(3)[[0, 2, 1]] * [1, -1, 1]  # about z, in the order z, y, x
    for name, steps, spacing, corner in (
        ("scale", [SCALE], (2, 1, 0.5), (0, 0, 0)),
        ("identity", [{"type": "identity"}], (1, 1, 1), (0, 0, 0)),
        ("both", [SCALE, {"type": "translation", "translation": [3, 4, 5]}], (2, 1, 0.5), (3, 4, 5)),
        ("sequence", [{"type": "sequence", "transformations": [ONE, SCALE]}], (2, 1, 0.5), (2, 1, 0.5)),
        ("affine", [{"type": "affine", "affine": [[2, 0, 0, 7], [0, 1, 0, 8], [0, 0, 3, 9]]}], (2, 1, 3), (7, 8, 9)),
        ("rotation", [SCALE, {"type": "rotation", "rotation": turn.tolist()}], (2, 1, 0.5), (0, 0, 0)),
    ):  # fmt: skip
        for system in (False, True):
            given = [{**step, "input": "0", "output": "world"} for step in steps]
            level = {"path": "0", "coordinateTransformations": given}
            axes = {"coordinateSystems": [{"name": "world", "axes": SPACE}]} if system else {"axes": SPACE}
            ome = {"version": "0.6" if system else "0.5", "multiscales": [{**axes, "datasets": [level]}]}
            field = states(tmp_path / f"{name}{system}.zarr", ome, values)
            assert np.array_equal(field.values, values) and field.unit == "um" and not field.notes
            assert field.spacing == pytest.approx(spacing)
            place = np.diag([*spacing[::-1], 1.0]) if field.affine is None else field.affine
            assert place[:3, 3] == pytest.approx(corner[::-1], abs=1e-12)
            if name == "rotation":
                assert place[:3, :3] == pytest.approx((turn * spacing)[::-1, ::-1])
    odd = [{"type": "displacements", "path": "field"}]
    image = {"axes": SPACE, "datasets": [{"path": "0", "coordinateTransformations": odd}]}
    ome = {"version": "0.6", "multiscales": [image] * 2}
    with pytest.raises(ScanError, match="displacements"):
        states(tmp_path / "odd.zarr", ome, values)
    field = states(tmp_path / "odd.zarr", ome, values, spacing=2.0, unit="um")
    assert field.spacing == (2, 2, 2) and "2 images" in field.notes[0]
    assert "0.9" in states(tmp_path / "new.zarr", {**ome, "version": "0.9"}, values, spacing=2.0, unit="um").notes[1]
    tilted = [{"type": "affine", "affine": [[1, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}]
    image = {"axes": SPACE, "datasets": [{"path": "0", "coordinateTransformations": tilted}]}
    with pytest.raises(ScanError, match="right angles"):
        states(tmp_path / "tilted.zarr", {"version": "0.6", "multiscales": [image]}, values)


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
