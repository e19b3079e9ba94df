"""What a map keeps beside it: nothing is measured twice, what is damaged is made anew, what grows meanwhile mixes up
nothing."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from exact_store import exact_field, exact_store, quick_map

import curvafit.atlas_map.files as atlas_files
from curvafit.atlas_map.files import write_map
from curvafit.atlas_map.layout import diagram_distances
from curvafit.data_synth.store import Record
from curvafit.geometry.diagram import Diagram


def test_nothing_is_measured_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick_map(monkeypatch)
    looked: list[int] = []
    real = atlas_files._measure

    def look(store, record: Record):
        looked.append(record.index)
        return real(store, record)

    monkeypatch.setattr(atlas_files, "_measure", look)
    monkeypatch.setattr(atlas_files, "map_picture", lambda mapped, field, path: path)
    exact_store(tmp_path / "s.zarr", 7)
    _, page = write_map([tmp_path / "s.zarr"], tmp_path / "map")
    assert looked == [0, 1, 3, 4, 5, 6]
    before = page.read_text()
    exact_store(tmp_path / "s.zarr", 9, first=7)
    kept = sorted((tmp_path / "map" / "cache").glob("shape-s-00004-*"))
    kept[0].write_bytes(kept[0].read_bytes()[:100])
    write_map([tmp_path / "s.zarr"], tmp_path / "map")
    assert looked == [0, 1, 3, 4, 5, 6, 4, 7, 8] and page.read_text() != before
    assert not list((tmp_path / "map").rglob(".*"))


def test_a_damaged_file_of_distances_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick_map(monkeypatch)
    quick = atlas_files.diagram_distances

    def careful(diagrams, saved, **options):
        if saved.exists():
            raise ValueError(f"expected a file of distances, got {saved}, which is something else")
        return quick(diagrams)

    monkeypatch.setattr(atlas_files, "diagram_distances", careful)
    monkeypatch.setattr(atlas_files, "map_picture", lambda mapped, field, path: path)
    exact_store(tmp_path / "s.zarr", 7)
    (tmp_path / "map" / "cache").mkdir(parents=True)
    (tmp_path / "map" / "cache" / "distances.npz").write_bytes(b"torn")
    _, page = write_map([tmp_path / "s.zarr"], tmp_path / "map", overwrite=True)
    assert page.exists() and not (tmp_path / "map" / "cache" / "distances.npz").exists()


def test_shapes_that_a_build_adds_meanwhile_mix_up_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick_map(monkeypatch)
    store = exact_store(tmp_path / "s.zarr", 10, first=3)
    real, shown_of = atlas_files.read_draws, {}

    def read_early(*arguments, **options):
        draws = real(*arguments, **options)
        exact_store(tmp_path / "s.zarr", 2)
        return draws

    def picture(mapped, field, path):
        shown_of.update({name: field(k) for k, name in enumerate(mapped.atlas.ids)})
        return path

    monkeypatch.setattr(atlas_files, "read_draws", read_early)
    monkeypatch.setattr(atlas_files, "map_picture", picture)
    _, page = write_map([store], tmp_path / "map")
    assert len(shown_of) == 6
    for name, u in shown_of.items():
        np.testing.assert_array_equal(u, exact_field(int(name.split("-")[1])))
    data = json.loads(re.findall(r'id="data">(.*?)</script>', page.read_text())[0])
    assert [f"shape_{name}.nii.gz" in line for name, line in zip(data["ids"], data["commands"], strict=True)] == [
        True
    ] * 6


def test_a_map_of_two_stores_shows_the_shapes_of_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick_map(monkeypatch)
    shown_of = {}

    def picture(mapped, field, path):
        shown_of.update({name: field(k) for k, name in enumerate(mapped.atlas.ids)})
        return path

    monkeypatch.setattr(atlas_files, "map_picture", picture)
    stores = [exact_store(tmp_path / "one.zarr", 7), exact_store(tmp_path / "other.zarr", 9, first=7)]
    _, page = write_map(stores, tmp_path / "map")
    assert {name.split("-")[0] for name in shown_of} == {"one", "other"}
    for name, u in shown_of.items():
        np.testing.assert_array_equal(u, exact_field(int(name.split("-")[1])))
    said = page.read_text()
    assert all(f"<dt>{name}: draws</dt>" in said for name in ("one", "other"))


# ---- distances in a file ---------------------------------------------------------------------------------------------


def clouds() -> list[Diagram]:
    """Five sets of points with weights over six orders of magnitude."""
    rng = np.random.default_rng(0)
    return [Diagram(rng.normal(4 * k, 10.0, (30 + k, 2)), 10 ** rng.uniform(-6, 0, 30 + k)) for k in range(5)]


def interrupt(text: str, share: float) -> None:
    raise KeyboardInterrupt


def test_rows_in_a_file_follow_their_diagrams(tmp_path: Path) -> None:
    """In another order, without some, and with one changed by a single weight or point."""
    path, every, order = tmp_path / "distances.npz", clouds(), [3, 1, 4]
    truth = diagram_distances(every, saved=path)
    assert [each.name for each in tmp_path.iterdir()] == ["distances.npz"]
    again = diagram_distances([every[k] for k in order], saved=path, progress=interrupt)
    np.testing.assert_array_equal(again, truth[np.ix_(order, order)])
    for change in ({"points": every[3].points + 1}, {"weights": every[3].weights[::-1].copy()}):
        changed = [every[1], dataclasses.replace(every[3], **change), every[4]]
        np.testing.assert_allclose(
            diagram_distances(changed, saved=path), diagram_distances(changed), rtol=1e-5, atol=0.01
        )


def test_a_file_of_other_distances_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "distances.npz"
    diagram_distances(clouds()[:2], saved=path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="distances"):
        diagram_distances(clouds()[:2], saved=path)
    with pytest.raises(OSError):
        diagram_distances(clouds()[:2], saved=path / "below" / "distances.npz", progress=interrupt)
