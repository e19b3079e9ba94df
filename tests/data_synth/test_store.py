"""The store: whole draws or none, what goes in comes out; `verify` finds what is lost, torn, changed or foreign."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from curvafit.core.records import encode_json
from curvafit.data_synth import Store, build, open_store
from curvafit.data_synth.atlas import summarise, verify
from curvafit.data_synth.store import DRAW, Record, Settings
from curvafit.generation.result import Viability
from curvafit.generation.schedule import schedule
from curvafit.priors.coefficients import Coefficients

SHAPE = (6, 5, 4)
PLAN = {"name": "cosine", "steps": 10, "start": 2e-2, "stop": 1e-4, "shape": "cosine", "momentum": 0.97, "memory": 0.97}
SETTINGS = Settings(SHAPE, (0.01,) * 3, 0.02, 0.02, {"law": "random"}, 7, PLAN)


def record(index: int, viable: bool = True, energy: float = 1.5) -> Record:
    viability = Viability(0.2 if viable else math.nan, 1.0, -1.0, viable, "" if viable else "no second phase")
    coefficients = Coefficients(1, 2, 6, -40, -40, 400.125)
    return Record(index, coefficients, -0.6, 12345 + index, 10, viability, energy, "done", {"torch": "2.13"}, 0.5)


def field(index: int) -> np.ndarray:
    return np.random.default_rng(index).uniform(-1, 1, SHAPE).astype(np.float32)


@pytest.fixture
def store(tmp_path) -> Store:
    """A store with draw 0, a shape, and draw 1, which was none and has no finite figures."""
    made = open_store(tmp_path / "s", SETTINGS)
    assert made.write(record(0), field(0)) and made.write(record(1, viable=False, energy=math.nan), None)
    return made


def changed(file: Path, change: Callable[[dict], object]) -> None:
    """Change the record in a draw's file, whose checksums are right afterwards."""
    header, arrays = DRAW.read(file)
    change(header)
    np.savez(file, header=encode_json(header), **arrays)


def test_a_draw_comes_back_as_it_went_in_and_is_not_written_twice(store):
    """A rejected draw is remembered without a field, and NaN as such."""
    again = open_store(store.path)
    assert again.settings == SETTINGS and again.indices() == [0, 1]
    assert again.record(0) == record(0) and again.field(0).dtype == np.float32
    assert not store.write(record(0), field(1))
    np.testing.assert_array_equal(again.field(0), field(0))
    assert b"NaN" not in np.load(store.path / "000001.npz")["header"].tobytes()
    back = store.record(1)
    assert math.isnan(back.energy) and math.isnan(back.viability.discrepancy) and not back.viability.viable
    with pytest.raises(KeyError, match="viable"):
        store.field(1)


def test_a_store_goes_on_with_its_own_settings_alone(store):
    """Version 0.1 called `fast` what is `cosine`."""
    then = replace(SETTINGS, schedule=PLAN | {"name": "fast"})
    assert open_store(store.path, then).settings == SETTINGS
    for name, value in (("schedule", PLAN | {"steps": 11}), ("seed", 8)):
        with pytest.raises(ValueError, match=name):
            open_store(store.path, replace(SETTINGS, **{name: value}))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 10**7), st.tuples(*[st.floats(-1e4, 1e4)] * 4), st.floats(-1, 1), st.integers(0, 2**63 - 1))
def test_any_record_survives_the_store_exactly(tmp_path, index, values, mass, seed):
    viability = Viability(0.8, 0.05, -1.0, False, "κ too high: “odd” text\n")
    coefficients = Coefficients(1, values[0], 0.1, *values[1:])
    put = Record(index, coefficients, mass, seed, 5, viability, -1e300, "stopped", {}, 1e-9)
    store = open_store(tmp_path / f"{time.monotonic_ns()}", SETTINGS)
    store.write(put, None)
    assert open_store(store.path).record(index) == put


def test_a_draw_that_another_process_ends_at_this_moment_stays(tmp_path, monkeypatch):
    store, other = open_store(tmp_path / "s", SETTINGS), open_store(tmp_path / "s", SETTINGS)
    # at the first question the other one writes
    answers = chain([lambda index: not other.write(record(0), field(0))], repeat(other.has))
    monkeypatch.setattr(Store, "has", lambda self, index: next(answers)(index))
    assert not store.write(record(0), field(1))
    np.testing.assert_array_equal(store.field(0), field(0))


def test_a_process_killed_while_writing_loses_only_its_own_draw(tmp_path):
    open_store(tmp_path / "s", SETTINGS).write(record(0), field(0))
    script = """
        import os, signal, sys
        sys.path.insert(0, sys.argv[2])
        import test_store
        from curvafit.data_synth import store as module
        store = module.open_store(sys.argv[1])
        store.write(test_store.record(1), test_store.field(1))
        module._publish = lambda file, target: os.kill(os.getpid(), signal.SIGKILL)
        store.write(test_store.record(2), test_store.field(2))
    """
    here = os.path.dirname(__file__)
    arguments = [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "s"), here]
    ended = subprocess.run(arguments, check=False, cwd=os.path.dirname(here))
    assert ended.returncode == -signal.SIGKILL
    store = open_store(tmp_path / "s")
    assert len(list(store.path.glob(".*/000002.npz"))) == 1  # which nobody takes for a draw
    assert store.indices() == [0, 1]
    np.testing.assert_array_equal(store.field(1), field(1))
    assert store.write(record(2), field(2))
    assert store.indices() == [0, 1, 2]


def test_what_a_killed_process_left_is_cleared_once_it_is_old(store):
    old, new = store.path / ".000002.npz.01234567", store.path / ".000003.npz.89abcdef"
    old.mkdir()
    new.mkdir()
    os.utime(old, (0, 0))
    store.write(record(2), field(2))
    assert not old.exists() and new.exists()


def test_an_incomplete_draw_does_not_count_and_is_made_again(store):
    folder = store.path / ".000000.npz.01234567"
    folder.mkdir()
    (store.path / "000000.npz").rename(folder / "000000.npz")
    assert store.indices() == [1]
    with pytest.raises(KeyError, match="draw 0"):
        store.record(0)
    assert store.write(record(0), field(0))
    np.testing.assert_array_equal(store.field(0), field(0))


BAD_SETTINGS = {"shape": [6, 5], "epsilon": None, "seed": [], "schedule": 3, "spacing": 10**30}
BOMBS = ("[" * 100_000, '{"format": "curvafit shapes", "settings": ' + "9" * 5000 + "}", "[]", '{"settings": NaN}')


@pytest.mark.parametrize("wrong", [*BAD_SETTINGS.items(), ("version", 99), *BOMBS])
def test_a_damaged_header_is_one_sentence(store, wrong):
    file = store.path / "curvafit.json"
    content = json.loads(file.read_text())
    if not isinstance(wrong, str):
        (content if wrong[0] == "version" else content["settings"]).update([wrong])
    file.write_text(wrong if isinstance(wrong, str) else json.dumps(content))
    with pytest.raises(ValueError, match="version 99|not a store"):
        open_store(store.path)


BAD_RECORDS = {"mass": "x", "coefficients": {}, "versions": 7, "seed": 1.5, "viability": {"viable": True}}


@pytest.mark.parametrize("wrong", BAD_RECORDS)
def test_a_damaged_record_is_one_sentence(store, wrong):
    changed(store.path / "000000.npz", lambda header: header.update({wrong: BAD_RECORDS[wrong]}))
    with pytest.raises(ValueError, match="draw 0"):
        store.record(0)
    assert not store.intact(0)


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("damage", [flip_a_bit, lambda file: file.write_bytes(b"{}")])
def test_damaged_bytes_of_a_field_are_noticed(store, damage):
    damage(store.path / "000000.npz")
    with pytest.raises(ValueError, match="draw 0"):
        store.field(0)
    assert not store.intact(0)


QUICK = schedule("cosine", steps=40)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A store of four shapes, and of draws that were none."""
    return build(tmp_path_factory.mktemp("sound") / "s", 4, 16, seed=1, schedule=QUICK).path


@pytest.fixture
def path(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "s")


def viable(path) -> list[int]:
    store = open_store(path)
    return [index for index in store.indices() if store.record(index).viability.viable]


def test_nothing_is_wrong_with_a_sound_store(path):
    """And one that lost a draw, as if the build had been stopped, is whole again after another."""
    found = verify(path)
    assert found.problems == ()
    assert found.status.endswith("nothing is wrong")
    told = summarise(open_store(path))
    assert (told["shapes"], told["voxels"], told["schedule"]) == ("4", "16 x 16 x 16", "cosine, 40 steps")
    (path / f"{viable(path)[1]:06d}.npz").unlink()
    assert "1 draws are missing" in verify(path).problems[0]
    build(path, 4, 16, seed=1, schedule=QUICK)
    assert verify(path).problems == ()


def test_an_extended_store_is_as_if_built_at_once(path, tmp_path):
    """A larger count adds to a store."""
    build(path, 5, 16, seed=1, schedule=QUICK)
    longer = build(path, 6, 16, seed=1, schedule=QUICK)
    whole = build(tmp_path / "whole", 6, 16, seed=1, schedule=QUICK)
    assert longer.indices() == whole.indices()
    assert all((longer.field(i) == whole.field(i)).all() for i in viable(path))
    assert verify(path).problems == ()


def test_a_draw_that_a_build_adds_meanwhile_is_no_stranger(path, tmp_path):
    last = sorted(path.glob("0*"))[-1]
    last.rename(tmp_path / last.name)

    def add(text, share):
        if (tmp_path / last.name).exists():
            (tmp_path / last.name).rename(last)

    assert verify(path, progress=add).problems == ()
    assert last.exists() and verify(path).problems == ()


def rename(old: str, new: str) -> Callable[[Path], object]:
    return lambda draw: changed(draw, lambda header: header.update({new: header.pop(old)}))


def move_here(draw: Path) -> None:
    shutil.copyfile(draw.with_name(f"{viable(draw.parent)[1]:06d}.npz"), draw)


def lose_the_field(draw: Path) -> None:
    np.savez(draw, header=np.load(draw)["header"])


def lose_another(draw: Path) -> None:
    barren = set(open_store(draw.parent).indices()) - set(viable(draw.parent))
    draw.with_name(f"{min(barren):06d}.npz").unlink()


DAMAGED = "draw {} is damaged"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flip_a_bit, DAMAGED), (rename("mass", "lost"), DAMAGED), (rename("viability", "lost"), DAMAGED),
        (move_here, DAMAGED), (lose_the_field, DAMAGED), (lose_another, "1 draws are missing"),
    ],
)  # fmt: skip
def test_a_fault_is_found(path, change, said):
    draw = viable(path)[0]
    change(path / f"{draw:06d}.npz")
    (problem,) = verify(path).problems
    assert said.format(draw) in problem
