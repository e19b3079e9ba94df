"""A run that is killed goes on where it was, and ends in the same array."""

from __future__ import annotations

import dataclasses
import io
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_cases import relax

from curvafit.generation.checkpoint import Checkpoint, identity
from curvafit.generation.flow import descend, generate
from curvafit.generation.schedule import SCHEDULES, Schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

ROOT = Path(__file__).resolve().parents[2]
TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
GRID = Grid((14, 15, 16))
PLAN = Schedule("test", 60, 1e-2, 1e-3, "cosine")
#: Makes a shape, saves after every step and tells of every tenth.
SCRIPT = """
import sys
from curvafit.generation.flow import generate
from curvafit.generation.schedule import Schedule
from curvafit.priors import Grid, preset
plan = Schedule("test", 200, 1e-2, 1e-3, "cosine")
tubes = preset("tubes")
flow = generate(
    tubes.coefficients, None, Grid((14, 15, 16)), volume_fraction=0.2, schedule=plan, seed=5, backend=sys.argv[1],
    checkpoint=sys.argv[2], checkpoint_every=0, callbacks=[lambda step, *rest: print(step, flush=True)],
    snapshots=(10, 100),
)
"""


class Killed(Exception):
    """Raised inside a run."""


def interrupted(make, path: Path, after: int):
    """The flow's end, made in two runs: the first dies at a step."""

    def die(step, total, state):
        if step == after:
            raise Killed

    with pytest.raises(Killed):
        make(checkpoint=path, checkpoint_every=0, callbacks=[die])
    assert path.exists()
    flow = make(checkpoint=path, checkpoint_every=0)
    assert list(path.parent.iterdir()) == []
    return flow


def assert_same(one, other) -> None:
    assert torch.equal(one.field, other.field)
    for name in ("step", "energy", "gradient_max", "gradient_mean", "mass"):
        np.testing.assert_array_equal(getattr(one.history, name), getattr(other.history, name))
    assert one.status == other.status
    assert one.mass == other.mass
    assert one.snapshots.keys() == other.snapshots.keys()
    assert all(torch.equal(one.snapshots[step], other.snapshots[step]) for step in one.snapshots)


def steps_in(path: Path) -> int:
    """The steps made, by a checkpoint."""
    return torch.load(io.BytesIO(path.read_bytes().partition(b"\n")[2]), weights_only=True)["content"]["made"]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["torch", "fused"])
def test_a_killed_program_goes_on(backend, tmp_path):
    """SIGKILL at a random step after the first save, anywhere in it; then the same end as of a run in one go."""
    if backend == "fused":
        pytest.importorskip("numba")
    path, steps = tmp_path / "run.ckpt", random.SystemRandom().randrange(2, 9)
    command = [sys.executable, "-c", SCRIPT, backend, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(steps):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    saved = steps_in(path)
    assert 10 * (steps - 1) <= saved < 200
    seen = []
    plan = Schedule("test", 200, 1e-2, 1e-3, "cosine")
    told = {"volume_fraction": 0.2, "schedule": plan, "seed": 5, "backend": backend, "snapshots": (10, 100)}
    resumed = generate(
        TUBES, None, GRID, **told, checkpoint=path, callbacks=[lambda step, *rest: seen.append(step) or None]
    )
    assert seen[0] == -(-saved // 10) * 10
    assert list(tmp_path.iterdir()) == []
    assert_same(resumed, generate(TUBES, None, GRID, **told))


@pytest.mark.slow
@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
@pytest.mark.parametrize("flow", ["l2", "h-1"])
def test_flows_from_a_field_go_on(flow, optimiser, tmp_path):
    start = generate(TUBES, MASS, GRID, schedule=PLAN).field

    def make(**more):
        return descend(start, TUBES, GRID, flow=flow, optimiser=optimiser, steps=40, **more)

    assert_same(interrupted(make, tmp_path / "run", 20), make())


@pytest.mark.parametrize("backend", ["torch", "fused"])
def test_a_flow_goes_on_within_any_phase(backend, tmp_path):
    if backend == "fused":
        pytest.importorskip("numba")
    plan = dataclasses.replace(SCHEDULES["fast"], steps=60)
    assert plan.bounds == (12, 24)

    def make(**more):
        return generate(TUBES, MASS, GRID, schedule=plan, backend=backend, **more)

    for after in (10, 20, 30):
        assert_same(interrupted(make, tmp_path / "run", after), make())


def test_relaxing_with_frozen_voxels_goes_on(tmp_path):
    start = generate(TUBES, MASS, GRID, schedule=PLAN).field
    frozen = torch.zeros(GRID.shape, dtype=torch.bool)
    frozen[:4] = True

    def make(**more):
        return relax(start, TUBES, GRID, schedule=PLAN, frozen=frozen, **more)

    assert_same(interrupted(make, tmp_path / "run", 30), make())


def test_another_runs_checkpoint_is_refused(tmp_path):
    path = tmp_path / "run"

    def make(**more):
        told = {"schedule": PLAN, "seed": 0, "epsilon": 0.02, **more}
        return generate(told.pop("coefficients", TUBES), told.pop("mass", MASS), GRID, **told)

    make(checkpoint=path, callbacks=[lambda step, *rest: step == 20])
    kept = path.read_bytes()
    other = Coefficients(1, 2, 6, -40, -40, torch.full(GRID.shape, 400.0))
    for name, changed in (
        ("seed", {"seed": 1}),
        ("mass", {"mass": -0.5}),
        ("epsilon", {"epsilon": 0.021}),
        ("snapshots", {"snapshots": (3,)}),
        ("coefficients", {"coefficients": other}),
        ("schedule", {"schedule": Schedule("test", 61, 1e-2, 1e-3, "cosine")}),
        ("stepper", {"backend": "torch"}),
    ):
        if name == "stepper":
            pytest.importorskip("numba")
        with pytest.raises(ValueError, match=rf"\b{name} .* instead"):
            make(checkpoint=path, **changed)
        assert path.read_bytes() == kept
    flipped = bytearray(kept)
    flipped[-2000] ^= 1
    for content, said in (
        (kept[:500], "a damaged one"),
        (bytes(flipped), "a damaged one"),
        (kept + b"0", "a damaged one"),
        (b".....\n", "another kind of file"),
        (b"", "another kind of file"),
        (b"\x80\x02c", "another kind of file"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=said):
            make(checkpoint=path)
        assert path.read_bytes() == content and [each.name for each in tmp_path.iterdir()] == ["run"]


def test_a_checkpoint_is_its_backends(tmp_path):
    """The same flow by other operations ends in other bits."""
    path, start = tmp_path / "run", generate(TUBES, MASS, GRID, schedule=PLAN).field
    told = {"optimiser": "adam", "steps": 40, "checkpoint": path}
    descend(start, TUBES, GRID, **told, callbacks=[lambda step, *rest: step == 20], backend="torch")
    with pytest.raises(ValueError, match="backend"):
        descend(start, TUBES, GRID, **told)


def test_a_checkpoint_may_be_kept(tmp_path):
    path = tmp_path / "run"

    def make():
        told = {"checkpoint": path, "checkpoint_every": 0, "keep_checkpoint": True}
        return generate(TUBES, MASS, GRID, schedule=PLAN, **told)

    first = make()
    assert path.exists()
    assert_same(first, make())


def test_a_callback_pauses_a_run(tmp_path):
    """It stops with the state of that step saved, however long ago the last checkpoint was; a done run leaves none."""
    path = tmp_path / "deep" / "run"

    def make(**more):
        return generate(TUBES, MASS, GRID, schedule=PLAN, **more)

    paused = make(checkpoint=path, callbacks=[lambda step, *rest: step == 30])
    assert paused.status == "stopped by a callback after 30 of 60 steps"
    assert steps_in(path) == 31
    resumed = make(checkpoint=path)
    assert not path.exists()
    assert_same(resumed, make())


def test_a_file_is_whole_or_old(tmp_path, monkeypatch):
    """A write that fails half-way leaves the last one."""
    saved = Checkpoint(tmp_path / "run", 0, identity(seed=1))
    saved.save({"made": 1})

    def fail(content, file):
        file.write(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="no space"):
        saved.save({"made": 2})
    assert saved.load() == {"made": 1}


def test_links_are_followed_and_stay(tmp_path):
    """One that leads nowhere yet, too; what is no file is refused."""
    for name in ("here", "run"):
        (tmp_path / name).symlink_to(tmp_path / "there" / name)
    (tmp_path / "there").mkdir()
    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=tmp_path / "run", callbacks=[lambda step, *rest: step == 20])
    assert steps_in(tmp_path / "there" / "run") == 21 and (tmp_path / "run").is_symlink()
    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=tmp_path / "run")
    assert list((tmp_path / "there").iterdir()) == [] and (tmp_path / "run").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("pipe", "loop", "there"):
        with pytest.raises(ValueError, match="regular file"):
            Checkpoint(tmp_path / name, 0, {})


def test_two_runs_do_not_share_a_file(tmp_path):
    """The second is refused while the first is at it, and may have it afterwards."""
    path = tmp_path / "run"

    def other(step, total, state):
        with pytest.raises(ValueError, match="in use"):
            generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=path)

    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=path, callbacks=[other])
    assert list(tmp_path.iterdir()) == []
    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=path)


def test_a_users_own_lock_stays(tmp_path):
    (tmp_path / "flake.lock").write_text("mine")
    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=tmp_path / "flake")
    assert (tmp_path / "flake.lock").read_text() == "mine"


def test_what_a_killed_save_left_goes(tmp_path):
    (tmp_path / ".0123abcd.run").write_bytes(b"half")
    (tmp_path / ".0123abcd.run2").write_bytes(b"another's")
    generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=tmp_path / "run")
    assert [path.name for path in tmp_path.iterdir()] == [".0123abcd.run2"]


def test_seconds_between_checkpoints(tmp_path):
    assert Checkpoint(tmp_path / "a", 0, {}).is_due()
    assert not Checkpoint(tmp_path / "a", 3600, {}).is_due()
    with pytest.raises(ValueError, match="seconds"):
        generate(TUBES, MASS, GRID, schedule=PLAN, checkpoint=tmp_path / "a", checkpoint_every=-1)
