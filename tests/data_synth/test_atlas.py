"""`verify` finds what is lost, torn, changed, foreign or unlike its design; and nothing in a sound store."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest

from curvafit.data_synth import build, extend
from curvafit.data_synth.atlas import summarise, verify
from curvafit.data_synth.store import Store, open_store
from curvafit.generation.schedule import schedule

QUICK = schedule("cosine", steps=40)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A store of four shapes, and of draws that were none."""
    return build(tmp_path_factory.mktemp("sound") / "s.zarr", 4, 16, seed=1, schedule=QUICK).path


@pytest.fixture
def path(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "s.zarr")


def viable(path) -> list[int]:
    store = open_store(path)
    return [index for index in store.indices() if store.record(index).viability.viable]


def changed(path, index: int, **attributes) -> None:
    file = path / "draws" / f"{index:06d}" / "zarr.json"
    content = json.loads(file.read_text())
    content["attributes"] |= attributes
    file.write_text(json.dumps(content))


def test_nothing_is_wrong_with_a_sound_store(path):
    found = verify(path)
    assert (found.problems, found.notes) == ((), ())
    assert found.status.endswith("nothing is wrong")
    told = summarise(open_store(path))
    assert (told["shapes"], told["wanted"], told["voxels"]) == ("4", "4", "16 x 16 x 16")
    assert told["schedule"] == "cosine, 40 steps"


def test_a_summary_names_schedules_as_they_are_named_today(path):
    """Version 0.1 called `fast` what is `cosine` now."""
    settings = open_store(path).settings
    old = dataclasses.replace(settings, schedule=settings.schedule | {"name": "fast"})
    assert summarise(Store(path, old))["schedule"] == "cosine, 40 steps"


def test_an_extended_store_is_as_if_built_at_once(path, tmp_path):
    extend(path, 1)
    open_store(path).want(6)  # as if stopped at once
    longer = extend(path, 0)
    whole = build(tmp_path / "whole.zarr", 6, 16, seed=1, schedule=QUICK)
    assert longer.indices() == whole.indices() and longer.wanted == whole.wanted == 6
    assert all((longer.field(i) == whole.field(i)).all() for i in viable(path))
    assert verify(path).problems == ()


def test_a_lost_draw_is_found_and_made_again(path):
    shutil.rmtree(path / "draws" / f"{viable(path)[1]:06d}")
    found = verify(path)
    assert found.problems == () and "1 draws are missing" in found.notes[0]  # as if the build had been stopped
    build(path, 4, 16, seed=1, schedule=QUICK)
    assert verify(path).notes == ()


def test_a_draw_lost_from_a_whole_store_is_a_problem(path):
    store = open_store(path)
    barren = next(index for index in store.indices() if not store.record(index).viability.viable)
    shutil.rmtree(path / "draws" / f"{barren:06d}")
    assert "1 draws are missing" in verify(path).problems[0]


def test_a_torn_draw_is_found(path):
    torn = viable(path)[0]
    (path / "draws" / f"{torn:06d}" / "field" / "c" / "0" / "0" / "0").unlink()
    (path / "draws" / ".partial-killed").mkdir()
    (problem,) = verify(path).problems
    assert f"draw {torn} is torn" in problem


def test_a_draw_that_a_build_adds_meanwhile_is_no_stranger(path, tmp_path):
    last = sorted((path / "draws").glob("0*"))[-1]
    last.rename(tmp_path / last.name)

    def add(text, share):
        if (tmp_path / last.name).exists():
            (tmp_path / last.name).rename(last)

    assert not any("torn" in problem for problem in verify(path, progress=add).problems)
    assert last.exists() and verify(path).problems == ()


def test_changed_bytes_and_numbers_are_found(path):
    first, second = viable(path)[:2]
    chunk = path / "draws" / f"{first:06d}" / "field" / "c" / "0" / "0" / "0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    changed(path, second, mass=-0.1)
    problems = verify(path).problems
    for index, problem in zip((first, second), problems, strict=True):
        assert f"draw {index}" in problem and "checksum" in problem


def test_a_record_that_has_lost_a_name_is_found(path):
    for index, name in zip(viable(path), ("mass", "sha256", "viability"), strict=False):
        file = path / "draws" / f"{index:06d}" / "zarr.json"
        file.write_text(file.read_text().replace(f'"{name}"', '"lost"'))
    problems = verify(path).problems
    assert ["checksum" in each or "is torn" in each for each in problems] == [True] * 3


def test_a_draw_in_another_place_is_found(path):
    one, other = (path / "draws" / f"{index:06d}" for index in viable(path)[:2])
    shutil.rmtree(other)
    shutil.copytree(one, other)
    assert any(f"draw {int(other.name)} is torn" in each for each in verify(path).problems)
