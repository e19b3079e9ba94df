"""The map of an atlas: names, clusters, neighbours, the picture's lines, what the page holds, what is made but once."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shlex
import zlib
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused
from exact_store import FAMILIES, SETTINGS, exact_field, exact_record, exact_store, quick_map
from scipy.spatial.distance import cdist

import curvafit.atlas_map.layout as atlas_map
from curvafit.atlas_map.extract import extract
from curvafit.atlas_map.files import write_map
from curvafit.atlas_map.layout import NOISE, AtlasMap, embed, find_clusters, map_atlas
from curvafit.atlas_map.page import CUT, LEVELS, regrow_command, shrink, small_volume
from curvafit.atlas_map.picture import assign_slots, farthest_points, slot_places
from curvafit.generation.flow import generate
from curvafit.geometry.distances import wasserstein
from curvafit.priors import Coefficients, Grid
from curvafit.volumes.read import load

COUNT = 16


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> AtlasMap:
    atlas = extract([exact_store(tmp_path_factory.mktemp("map") / "s.zarr", COUNT)])
    apart = cdist(atlas.embeddings("field"), atlas.embeddings("field"))
    places = np.random.default_rng(0).normal(size=(len(atlas), 2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlas_map, "embed", lambda distances: places)
        return map_atlas(atlas, apart)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a written map."""
    folder = tmp_path_factory.mktemp("made")
    exact_store(folder / "s.zarr", COUNT)
    with pytest.MonkeyPatch.context() as patch:
        quick_map(patch)
        write_map([folder / "s.zarr"], folder / "map", command="curvafit atlas map <s>")
    return folder


# ---- the map ---------------------------------------------------------------------------------------------------------


def test_exact_shapes_get_their_family_s_name(mapped: AtlasMap) -> None:
    numbers = [int(name.split("-")[1]) for name in mapped.atlas.ids]
    assert len(numbers) == 14 and mapped.families == tuple(FAMILIES[number % 4] for number in numbers)


def test_neighbours_are_the_nearest_others(mapped: AtlasMap) -> None:
    near = mapped.neighbours(3)
    for k, row in enumerate(near):
        others = [j for j in range(len(mapped)) if j != k]
        assert row.tolist() == sorted(others, key=lambda j: mapped.distances[k, j])[:3]
    assert mapped.neighbours(99).shape == (14, 13)


def test_clusters_are_blobs_the_largest_first_and_what_lies_apart_is_noise() -> None:
    rng = np.random.default_rng(1)
    blobs = [rng.normal(middle, 0.1, (size, 2)) for middle, size in ((0, 15), (5, 40), (9, 25))]
    found = find_clusters(np.concatenate([*blobs, [[20.0, -20.0]]]))
    assert found.tolist() == [2] * 15 + [0] * 40 + [1] * 25 + [NOISE]
    assert find_clusters(blobs[0][:9]).tolist() == [NOISE] * 9


def test_a_cluster_is_named_by_the_diagrams_of_its_shapes(mapped: AtlasMap, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = np.array([FAMILIES.index(name) for name in mapped.families])
    monkeypatch.setattr(atlas_map, "find_clusters", lambda positions: np.where(kinds == 3, NOISE, kinds))
    monkeypatch.setattr(atlas_map, "embed", lambda distances: mapped.positions)
    assert map_atlas(mapped.atlas, mapped.distances).cluster_families == FAMILIES[:3]


@pytest.mark.slow
def test_umap_keeps_apart_what_is_far_and_takes_few_shapes() -> None:
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(3), 30)
    rows = rng.normal(size=(90, 3)) + 40 * np.eye(3)[groups]
    places = embed(cdist(rows, rows))
    middles = np.array([places[groups == k].mean(0) for k in range(3)])
    assert (cdist(places, middles).argmin(1) == groups).all()
    np.testing.assert_array_equal(places, embed(cdist(rows, rows)))
    assert embed(cdist(rows[:5], rows[:5])).shape == (5, 2)


@pytest.mark.slow
def test_distances_are_the_paper_s(mapped: AtlasMap) -> None:
    first = mapped.atlas.field_diagrams[:3]
    found = atlas_map.diagram_distances(first)
    truth = [wasserstein(first[0], other) for other in first[1:]]
    assert found[0, 1:] == pytest.approx(truth, rel=1e-4, abs=1e-5)


def test_wrong_distances_and_too_few_shapes_are_refused(mapped: AtlasMap) -> None:
    for wrong in (mapped.distances[1:], np.triu(mapped.distances), np.full((14, 14), np.nan)):
        with pytest.raises(ValueError, match="distances"):
            map_atlas(mapped.atlas, wrong)
    with pytest.raises(ValueError, match="5"):
        atlas_map.check_size(4)


# ---- the picture -----------------------------------------------------------------------------------------------------


def test_no_two_lines_of_the_picture_cross() -> None:
    slots = slot_places()
    assert len(slots) == 20 and len({tuple(slot) for slot in slots.round(6)}) == 20
    for seed in range(20):
        places = np.random.default_rng(seed).uniform(0.2, 0.8, (20, 2))
        ends = slots[assign_slots(places, slots)]
        assert not any(cross(places[i], ends[i], places[j], ends[j]) for i in range(20) for j in range(i))


def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Whether the segments ab and cd cross."""

    def side(p, q, r):
        return np.sign((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) != side(a, b, d) and side(c, d, a) != side(c, d, b)


def test_the_shapes_shown_are_spread_out() -> None:
    grid = np.array([(x, y) for x in range(11) for y in range(11)], dtype=float)
    chosen = grid[farthest_points(grid, 5)]
    assert {tuple(place) for place in chosen} == {(5, 5), (0, 0), (0, 10), (10, 0), (10, 10)}
    assert len(farthest_points(grid[:3], 20)) == 3


# ---- one shape -------------------------------------------------------------------------------------------------------


def test_the_command_grows_the_very_field(tmp_path: Path) -> None:
    law, mass, seed = Coefficients(1.0, 1.9, 6.1, -40.3, -40.0, 400 / 7), -0.61, 4042424242
    flow = generate(law, mass, Grid((20, 16, 24)), schedule="fast", seed=seed)
    settings = dataclasses.replace(SETTINGS, shape=(20, 16, 24), schedule=flow.schedule.as_dict())
    record = dataclasses.replace(exact_record(0), coefficients=law, mass=mass, seed=seed)
    command = shlex.split(regrow_command(record, settings, str(tmp_path / "a.npy")))
    assert command[:2] == ["curvafit", "generate"] and "--steps" not in command and "--epsilon" not in command
    assert call(*command[1:]).exit_code == 0
    np.testing.assert_array_equal(load(tmp_path / "a.npy").values, flow.field.numpy())


def test_a_command_says_what_is_not_the_default() -> None:
    said = regrow_command(exact_record(4), dataclasses.replace(SETTINGS, epsilon=0.03), "a.tif")
    assert said.endswith("--shape 24 --seed 1000000004 --schedule cosine --steps 30 --epsilon 0.03 -o a.tif")
    with pytest.raises(ValueError, match="blur"):
        regrow_command(exact_record(4), dataclasses.replace(SETTINGS, blur=0.03), "a.tif")


def test_a_small_volume_has_the_surface_where_it_was() -> None:
    steps = (np.arange(64) - 31.75) / 64 * 2 * np.pi
    z, y, x = np.meshgrid(steps, steps[::2], steps, indexing="ij")
    u = np.tanh(4 * (np.sin(z) + np.sin(y) + np.cos(x))).astype(np.float32)
    small = small_volume(u)
    assert small.shape == (32, 16, 32) and small.dtype == np.uint8 and small.max() == LEVELS
    values, truth = small / LEVELS * 2 * CUT - CUT, np.clip(u[::2, ::2, ::2], -CUT, CUT)
    np.testing.assert_allclose(values, truth, atol=0.06)  # at a slope of up to 0.8 a small voxel: under a tenth of one
    kept = shrink(u)
    assert kept.thumbnail[:4] == b"RIFF" and kept.thumbnail[8:12] == b"WEBP"
    assert zlib.decompress(kept.volume) == small.tobytes()


# ---- the files -------------------------------------------------------------------------------------------------------


def test_both_files_say_how_they_were_made(made: Path) -> None:
    from PIL import Image

    assert sorted(path.name for path in (made / "map").iterdir()) == ["atlas.html", "atlas.png", "cache"]
    with Image.open(made / "map" / "atlas.png") as picture:
        told = json.loads(picture.text["Description"])  # type: ignore[attr-defined]
        assert picture.width > 2000 and picture.text["Title"] == "Atlas of 14 shapes"  # type: ignore[attr-defined]
    assert told["map"]["umap"] == {
        "n_neighbors": 13, "min_dist": 0.05, "spread": 1.0, "random_state": 1, "metric": "precomputed"
    }  # fmt: skip
    assert told["map"]["hdbscan"] == {"min_cluster_size": 10, "min_samples": 10}
    assert told["atlas"]["stores"]["s"]["settings"]["seed"] == 3 and "umap-learn" in told["map"]["versions"]
    page = (made / "map" / "atlas.html").read_text()
    for said in (
        "curvafit atlas map &lt;s&gt;",
        "blur 1.0, reach 20.0",
        "random_state 1",
        "14 of the shapes",
    ):
        assert said in page, said


def test_the_page_is_whole_and_asks_for_nothing(made: Path) -> None:
    page = (made / "map" / "atlas.html").read_text()
    outside = re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)""", page)
    assert outside == ["data:,"] and not re.search(r"https?://|url\(|@import|\bfetch\(|XMLHttpRequest", page)
    assert "default-src 'none'" in page and page.count("<script") == page.count("</script") == 6


def test_the_page_holds_what_was_measured(made: Path) -> None:
    page = (made / "map" / "atlas.html").read_text()
    texts = dict(re.findall(r'<script type="[a-z/]+" id="(\w+)">(.*?)</script>', page, re.DOTALL))
    data = json.loads(texts["data"])
    atlas = extract([made / "s.zarr"])

    def piece(name: str, k: int) -> bytes:
        first, last = data["offsets"][name][k : k + 2]
        return base64.b64decode(texts[name][first:last], validate=True)

    assert data["ids"] == list(atlas.ids) and len(data["commands"]) == 14
    columns = {column["key"]: column["values"] for column in data["columns"]}
    assert columns["a02"] == atlas.coefficients[:, 2].tolist() and columns["volume"] == atlas.volume_fractions.tolist()
    for k, diagram in enumerate(atlas.field_diagrams):
        packed = np.frombuffer(piece("diagrams", k), "<i2").reshape(3, -1)
        np.testing.assert_allclose(packed[:2].T * data["diagram"]["scale"], diagram.points, atol=0.002)
        np.testing.assert_allclose(packed[2].view("<u2") / 65535, diagram.normalised.weights, atol=1e-5)
    for k, view in enumerate(("field", "mask")):
        rows = np.frombuffer(piece("embeddings", k), "<i2").reshape(14, -1) * data["embedding"]["scale"]
        np.testing.assert_allclose(rows, atlas.embeddings(view), atol=1e-3)
    number = int(atlas.ids[5].split("-")[1])
    assert zlib.decompress(piece("volumes", 5)) == small_volume(exact_field(number)).tobytes()
    places = np.array(data["places"])
    assert places.min() >= 0 and places.max() <= 1 and np.ptp(places, axis=0).max() == pytest.approx(1, abs=1e-4)


def test_what_cannot_be_mapped_is_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(call("atlas", "map", tmp_path / "none", "-o", tmp_path / "m"), "none")
    exact_store(tmp_path / "s.zarr", 5)
    few = call("atlas", "map", tmp_path / "s.zarr", "-o", tmp_path / "m")
    refused(few, "5 shapes")
    (tmp_path / "file").write_text("mine")
    refused(call("atlas", "map", tmp_path / "s.zarr", "-o", tmp_path / "file"), "folder")
    refused(call("atlas", "map", tmp_path / "s.zarr", "-o", tmp_path / "m", "--device", "cuda:9"), "--device")
    assert not (tmp_path / "m").exists()
    monkeypatch.setattr(atlas_map, "find_spec", lambda name: None)
    refused(call("atlas", "map", tmp_path / "s.zarr", "-o", tmp_path / "m"), 'pip install "curvafit[atlas]"')
    assert len(list(tmp_path.iterdir())) == 2
