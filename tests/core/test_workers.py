"""Draws by workers: the same store whoever makes it; killed workers and builds lose their own draw at most."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
import types
from concurrent.futures import CancelledError
from unittest.mock import MagicMock

import pytest

from curvafit.core.workers import cluster
from curvafit.data_synth import Design, build, open_store
from curvafit.data_synth import store as storing
from curvafit.data_synth.atlas import verify
from curvafit.generation.schedule import schedule

distributed = pytest.importorskip("distributed", reason="needs dask.distributed")
psutil = pytest.importorskip("psutil")
CommClosedError = pytest.importorskip("distributed.comm").CommClosedError

COUNT, EDGE, PLAN = 8, 16, schedule("cosine", steps=60)
#: As a script: builds with two workers, and says where it is.
SCRIPT = f"""
import sys
from curvafit.core.workers import cluster
from curvafit.data_synth import build
from curvafit.generation.schedule import schedule
if __name__ == "__main__":
    with cluster(2) as crew:
        plan = schedule("cosine", steps={PLAN.steps})
        build(sys.argv[1], {COUNT}, {EDGE}, 1, plan, lambda text, share: print(text, flush=True), workers=crew)
"""


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    return build(tmp_path_factory.mktemp("serial") / "s", COUNT, EDGE, 1, PLAN)


def assert_same(one, other) -> None:
    assert one.indices() == other.indices()
    kept = (i for i in one.indices() if one.record(i).viability.viable)
    assert all((one.field(i) == other.field(i)).all() for i in kept)
    assert verify(one.path).problems == ()


def listening() -> set[str]:
    """The addresses on which this process and its children wait for others."""
    here = psutil.Process()
    sockets = (each for process in (here, *here.children(recursive=True)) for each in process.net_connections("inet"))
    return {each.laddr.ip for each in sockets if each.status == psutil.CONN_LISTEN}


@pytest.mark.slow
def test_two_workers_make_the_store_that_one_process_makes_though_one_is_killed(tmp_path, serial):
    with cluster(2) as crew:
        heard = crew._client.run(lambda: (os.getpid(), signal.getsignal(signal.SIGINT)))
        pids, interrupts = zip(*heard.values(), strict=True)
        assert set(interrupts) == {signal.SIG_IGN}  # they leave the interrupt to the build
        assert listening() == {"127.0.0.1"}
        killed = []

        def kill_once(text, share):
            if not killed:
                killed.append(os.kill(pids[0], signal.SIGKILL))

        store = build(tmp_path / "s", COUNT, EDGE, 1, PLAN, kill_once, workers=crew)
        crew._client = types.SimpleNamespace(nthreads=dict)
        assert crew.places == 1  # also while all are gone
    assert killed
    assert_same(store, serial)


@pytest.mark.slow
def test_a_build_killed_at_random_goes_on_to_the_same_store(tmp_path, serial):
    script, path = tmp_path / "build.py", tmp_path / "s"
    script.write_text(SCRIPT)
    begun = subprocess.Popen([sys.executable, str(script), str(path)], stdout=subprocess.PIPE, text=True)
    assert begun.stdout is not None and begun.stdout.readline()
    time.sleep(random.Random(0).uniform(0, 0.3))
    begun.kill()
    begun.wait()
    begun.stdout.close()
    if path.exists():
        assert verify(path).problems == ()
    assert_same(build(path, COUNT, EDGE, 1, PLAN), serial)


@pytest.mark.parametrize(
    ("options", "kind", "word"),
    [
        ({"scheduler": "tcp://127.0.0.1:9"}, OSError, "tcp://127.0.0.1:9"), ({"count": -1}, ValueError, "workers"),
        ({"count": 2, "dask": None}, ImportError, "pip install"),
    ],
)  # fmt: skip
def test_a_scheduler_that_is_not_there_and_too_few_workers_are_one_sentence(monkeypatch, options, kind, word):
    monkeypatch.setattr("curvafit.core.workers.PATIENCE", 1)
    if "dask" in options:
        monkeypatch.setitem(sys.modules, "distributed", options.pop("dask"))
    with pytest.raises(kind, match=word):
        cluster(**options).__enter__()


@pytest.mark.parametrize("error", [CommClosedError, CancelledError])
def test_a_scheduler_that_goes_is_one_sentence(monkeypatch, error):
    client = MagicMock(**{"nthreads.return_value": {1: 1}, "__exit__.return_value": None})
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: client)
    monkeypatch.setattr(distributed, "as_completed", list)
    with pytest.raises(OSError, match="there:1"), cluster(scheduler="tcp://there:1"):
        raise error("gone")


def test_a_barren_design_ends(tmp_path, monkeypatch):
    monkeypatch.setattr("curvafit.data_synth.atlas.BARREN", 3)
    empty = Design("list", points=((1.0, 0.0, 1.0, 0.0, 0.0, 1e9, -0.9),))
    with pytest.raises(ValueError, match="viable"):
        build(tmp_path / "s", 1, 8, schedule=PLAN, design=empty)
    assert len(open_store(tmp_path / "s").indices()) == 4


def test_a_full_disk_is_named_and_what_is_made_is_kept(tmp_path, serial, monkeypatch):
    store = build(tmp_path / "s", 2, EDGE, 1, PLAN)
    with monkeypatch.context() as patch, pytest.raises(OSError, match=tmp_path.name):
        patch.setattr(storing, "_publish", MagicMock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        build(store.path, COUNT, EDGE, 1, PLAN)
    assert verify(store.path).problems == () and not list(store.path.glob(".*"))
    assert_same(build(store.path, COUNT, EDGE, 1, PLAN), serial)
