"""A run that is killed goes on where it was, and ends in the same array."""

import dataclasses
import io
import os
import random
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from kernel_cases import assert_same

from curvafit.generation.flow import Execution, descend, generate
from curvafit.generation.loop import Checkpoint, identity
from curvafit.generation.schedule import SCHEDULES, Schedule
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

ROOT = Path(__file__).resolve().parents[2]
TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
GRID = Grid((14, 15, 16))
PLAN = Schedule("test", 60, 1e-2, 1e-3, "cosine")
make = partial(generate, TUBES, grid=GRID, schedule=PLAN)
#: Makes a shape, saves after every step and tells of every tenth.
SCRIPT = """
import sys
from curvafit.generation import Execution, Schedule, generate
from curvafit.priors import kernels
kernels.has_kernel = {"torch": lambda device: False, "fused": kernels.has_kernel}[sys.argv[1]]
plan = Schedule("test", 200, 1e-2, 1e-3, "cosine")
generate(
    "tubes", grid=(14, 15, 16), volume_fraction=0.2, schedule=plan, seed=5,
    callbacks=[lambda step, *rest: print(step, flush=True)],
    execution=Execution(checkpoint=sys.argv[2], checkpoint_every=0),
)
"""


@pytest.fixture(scope="module")
def start() -> torch.Tensor:
    return make(MASS).field


def stop(at: int) -> dict:
    """The option of a callback that stops a flow after some steps."""
    return {"callbacks": [lambda step, *rest: step == at]}


def interrupted(make, path: Path, after: int):
    """The flow's end, made in two runs: the first dies at a step."""

    def die(step, total, state):
        if step == after:
            raise InterruptedError

    saved = Execution(checkpoint=path, checkpoint_every=0)
    with pytest.raises(InterruptedError):
        make(execution=saved, callbacks=[die])
    assert path.exists()
    flow = make(execution=saved)
    assert list(path.parent.iterdir()) == []
    return flow


def steps_in(path: Path) -> int:
    """The steps made, by a checkpoint."""
    return torch.load(io.BytesIO(path.read_bytes().partition(b"\n")[2]), weights_only=True)["content"]["made"]


@pytest.mark.slow
def test_a_killed_program_goes_on(backend, tmp_path):
    """SIGKILL at a random step after the first save, anywhere in it; then the same end as of a run in one go."""
    path, steps = tmp_path / "run.ckpt", random.SystemRandom().randrange(2, 9)
    command = [sys.executable, "-c", SCRIPT, backend, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(steps):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    saved, seen = steps_in(path), []
    assert 10 * (steps - 1) <= saved < 200
    plan = Schedule("test", 200, 1e-2, 1e-3, "cosine")
    whole = partial(make, volume_fraction=0.2, schedule=plan, seed=5)
    watched = [lambda step, *rest: seen.append(step) or None]
    resumed = whole(callbacks=watched, execution=Execution(checkpoint=path))
    assert seen[0] == -(-saved // 10) * 10
    assert list(tmp_path.iterdir()) == []
    assert_same(resumed, whole())


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_flows_from_a_field_go_on(method, start, tmp_path):
    make = partial(descend, start, TUBES, GRID, method=method, steps=40)
    assert_same(interrupted(make, tmp_path / "run", 20), make())


@pytest.mark.usefixtures("backend")
def test_a_flow_goes_on_within_any_phase(tmp_path):
    plan = dataclasses.replace(SCHEDULES["fast"], steps=60)
    assert plan.bounds == (12, 24)
    phased = partial(make, MASS, schedule=plan)
    whole = phased()
    for after in (10, 20, 30):
        assert_same(interrupted(phased, tmp_path / "run", after), whole)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("seed", {"seed": 1}), ("mass", {"mass": -0.5}), ("epsilon", {"epsilon": 0.021}),
        ("coefficients", {"law": Coefficients(1, 2, 6, -40, -40, torch.full(GRID.shape, 400.0))}),
        ("schedule", {"schedule": Schedule("test", 61, 1e-2, 1e-3, "cosine")}), ("stepper", {}),
    ],
)  # fmt: skip
def test_another_runs_checkpoint_is_refused(name, changed, tmp_path, monkeypatch):
    """Also where it is the same flow by other operations, which ends in other bits."""
    path, given = tmp_path / "run", {"law": TUBES, "mass": MASS, "grid": GRID, "schedule": PLAN}
    generate(**given, **stop(20), execution=Execution(checkpoint=path))
    kept = path.read_bytes()
    if name == "stepper":
        monkeypatch.setattr(kernels, "has_kernel", lambda device: False)
    with pytest.raises(ValueError, match=rf"\b{name} .* instead"):
        generate(**given | changed, execution=Execution(checkpoint=path))
    assert path.read_bytes() == kept


def test_what_is_no_checkpoint_is_refused(tmp_path):
    path, saved = tmp_path / "run", Checkpoint(tmp_path / "run", 0, identity(seed=1))
    saved.save({"made": torch.zeros(1000)})
    kept = path.read_bytes()
    flipped = kept[:-2000] + bytes([kept[-2000] ^ 1]) + kept[-1999:]
    for said, contents in {
        "a damaged one": (kept[:500], flipped, kept + b"0"),
        "another kind of file": (b".....\n", b"", b"\x80\x02c"),
    }.items():
        for content in contents:
            path.write_bytes(content)
            with pytest.raises(ValueError, match=said):
                saved.load()
            assert path.read_bytes() == content and [each.name for each in tmp_path.iterdir()] == ["run"]


def test_a_checkpoint_may_be_kept(tmp_path):
    execution = Execution(checkpoint=tmp_path / "run", checkpoint_every=0, keep_checkpoint=True)
    kept = partial(make, MASS, execution=execution)
    first = kept()
    assert (tmp_path / "run").exists()
    assert_same(first, kept())


def test_a_callback_pauses_a_run(tmp_path):
    """It stops with the state of that step saved, however long ago the last checkpoint was; a done run leaves none."""
    path = tmp_path / "deep" / "run"
    paused = make(MASS, execution=Execution(checkpoint=path), **stop(30))
    assert paused.status == "stopped by a callback after 30 of 60 steps"
    assert steps_in(path) == 31
    resumed = make(MASS, execution=Execution(checkpoint=path))
    assert not path.exists()
    assert_same(resumed, make(MASS))


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
    assert saved.is_due() and not Checkpoint(tmp_path / "a", 3600, {}).is_due()


def test_links_are_followed_and_stay(tmp_path):
    """One that leads nowhere yet, too; what is no file is refused."""
    (tmp_path / "run").symlink_to(tmp_path / "there" / "run")
    (tmp_path / "there").mkdir()
    make(MASS, execution=Execution(checkpoint=tmp_path / "run"), **stop(20))
    assert steps_in(tmp_path / "there" / "run") == 21 and (tmp_path / "run").is_symlink()
    make(MASS, execution=Execution(checkpoint=tmp_path / "run"))
    assert list((tmp_path / "there").iterdir()) == [] and (tmp_path / "run").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("pipe", "loop", "there"):
        with pytest.raises(ValueError, match="regular file"):
            Checkpoint(tmp_path / name, 0, {})


def test_two_runs_do_not_share_a_file_and_what_is_not_theirs_stays(tmp_path):
    """The second is refused while the first is at it. What a killed save left goes, and nobody else's file."""
    path = tmp_path / "run"
    for name in ("run.lock", ".0123abcd.run2", ".0123abcd.run"):
        (tmp_path / name).write_text("mine")

    def other(step, total, state):
        with pytest.raises(ValueError, match="in use"):
            make(MASS, execution=Execution(checkpoint=path))

    make(MASS, callbacks=[other], execution=Execution(checkpoint=path))
    make(MASS, execution=Execution(checkpoint=path))
    assert sorted(each.name for each in tmp_path.iterdir()) == [".0123abcd.run2", "run.lock"]
