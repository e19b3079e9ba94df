"""`verify` finds what is lost, torn, changed, foreign or unlike its design; and nothing in a sound store."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

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


def test_nothing_is_wrong_with_a_sound_store(path):
    found = verify(path)
    assert (found.problems, found.notes) == ((), ())
    assert found.status.endswith("nothing is wrong")
    store = open_store(path)
    old = dataclasses.replace(store.settings, schedule=store.settings.schedule | {"name": "fast"})
    for told in (summarise(store), summarise(Store(path, old))):  # version 0.1 called `fast` what is `cosine` now
        assert (told["shapes"], told["wanted"], told["voxels"]) == ("4", "4", "16 x 16 x 16")
        assert told["schedule"] == "cosine, 40 steps"


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


def test_a_draw_that_a_build_adds_meanwhile_is_no_stranger(path, tmp_path):
    last = sorted((path / "draws").glob("0*"))[-1]
    last.rename(tmp_path / last.name)

    def add(text, share):
        if (tmp_path / last.name).exists():
            (tmp_path / last.name).rename(last)

    assert not any("torn" in problem for problem in verify(path, progress=add).problems)
    assert last.exists() and verify(path).problems == ()


def flip_a_bit(path: Path, draw: Path) -> None:
    chunk = draw / "field" / "c" / "0" / "0" / "0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)


def rename(name: str, other: str) -> Callable[[Path, Path], None]:
    def change(path: Path, draw: Path) -> None:
        (draw / "zarr.json").write_text((draw / "zarr.json").read_text().replace(name, other))

    return change


def move_here(path: Path, draw: Path) -> None:
    other = path / "draws" / f"{viable(path)[1]:06d}"
    shutil.rmtree(draw)
    shutil.copytree(other, draw)


def tear(path: Path, draw: Path) -> None:
    (draw / "field" / "c" / "0" / "0" / "0").unlink()
    (path / "draws" / ".partial-killed").mkdir()


def lose_another(path: Path, draw: Path) -> None:
    store = open_store(path)
    barren = next(index for index in store.indices() if not store.record(index).viability.viable)
    shutil.rmtree(path / "draws" / f"{barren:06d}")


FAULTS = {
    "changed bytes": (flip_a_bit, "draw {draw} does not match its checksum"),
    "a changed number": (rename('"mass": -', '"mass": -1'), "draw {draw} does not match its checksum"),
    "no mass": (rename('"mass"', '"lost"'), "draw {draw} does not match its checksum"),
    "no checksum": (rename('"sha256"', '"lost"'), "draw {draw} is torn"),
    "no viability": (rename('"viability"', '"lost"'), "draw {draw} is torn"),
    "another draw": (move_here, "draw {draw} is torn"),
    "a torn draw": (tear, "draw {draw} is torn"),
    "a draw lost from a whole store": (lose_another, "1 draws are missing"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found(path, fault):
    change, told = FAULTS[fault]
    draw = viable(path)[0]
    change(path, path / "draws" / f"{draw:06d}")
    (problem,) = verify(path).problems
    assert told.format(draw=draw) in problem
