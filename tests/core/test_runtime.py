"""Signals: exceptions that clean up, that wait while files change, and an exit code that tells of them."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from curvafit.core.files import move_together, temporary_folder
from curvafit.core.runtime import Terminated, exit_code, hold_signals, listen

ROOT = Path(__file__).resolve().parents[2]
HEARD = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
signals = pytest.mark.parametrize("number", HEARD)


@pytest.fixture
def listening() -> Iterator[None]:
    before = {number: signal.signal(number, signal.SIG_DFL) for number in HEARD}
    hook = sys.unraisablehook
    listen()
    yield
    sys.unraisablehook = hook
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(0.01)


@signals
@pytest.mark.parametrize("where", ["program", "finaliser"])
def test_a_signal_is_an_exception(number: int, where: str, listening: None, capfd: pytest.CaptureFixture) -> None:
    """Python drops it in a finaliser: there it comes again from a thread, and is seen between two sleeps."""

    class Ended:
        def __del__(self) -> None:
            send(number)

    with pytest.raises(KeyboardInterrupt) as caught:
        Ended() if where == "finaliser" else send(number)
        for _ in range(500):
            time.sleep(0.01)
    assert isinstance(caught.value, Terminated) == (number != signal.SIGINT)
    assert exit_code(caught.value) == 128 + number
    assert capfd.readouterr().err == ""


@signals
def test_it_waits_until_files_are_moved(number: int, listening: None, tmp_path: Path, monkeypatch) -> None:
    real = os.replace

    def disturbed(source: Path, target: Path) -> None:
        real(source, target)
        send(number)

    monkeypatch.setattr(os, "replace", disturbed)
    with pytest.raises(KeyboardInterrupt), temporary_folder(tmp_path / "out") as work:
        for name in "abc":
            (work / name).write_text(name)
        move_together([work / name for name in "abc"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_nested_blocks_end_with_the_outermost(listening: None) -> None:
    reached = []
    with pytest.raises(Terminated), hold_signals():
        with hold_signals():
            send(signal.SIGTERM)
            reached.append("inner")
        reached.append("outer")
    assert reached == ["inner", "outer"]


def test_what_is_ignored_stays_ignored(listening: None) -> None:
    """As under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    listen()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_other_threads_are_let_alone() -> None:
    """They get no signals; their changes hold none back."""
    both = threading.Barrier(2, timeout=5)

    def work() -> None:
        with hold_signals():
            both.wait()
            both.wait()

    with ThreadPoolExecutor(1) as other:
        other.submit(work)
        both.wait()
        with pytest.raises(KeyboardInterrupt), hold_signals():
            raise KeyboardInterrupt
        both.wait()


@pytest.mark.slow
@pytest.mark.parametrize(("number", "word"), [(signal.SIGTERM, "terminated"), (signal.SIGINT, "interrupted")])
def test_a_program_that_is_ended_leaves_nothing(number: int, word: str, tmp_path: Path) -> None:
    """At a moment when it is writing: the shape's temporary folder is there."""
    program = [sys.executable, "-c", SLOW, "generate", "--preset", "tubes", "--shape", "16", "--steps", "3"]
    program += ["-o", str(tmp_path / "out.nii.gz")]
    with subprocess.Popen(program, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None and "writing\n" in iter(process.stderr.readline, "")  # after its progress
        assert [path.name[:5] for path in tmp_path.iterdir()] == [".out."]
        process.send_signal(number)
        said = process.stderr.read()
    assert process.returncode == 128 + number
    assert said.splitlines()[-1] == f"{word}: nothing is left half-written"
    assert list(tmp_path.iterdir()) == []


SLOW = """
import signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM):  # a program in the background ignores Ctrl-C
    signal.signal(number, signal.SIG_DFL)
import curvafit.drawing.shapes
def slow(*_):
    print("writing", file=sys.stderr, flush=True)
    time.sleep(60)
curvafit.drawing.shapes.write_field = slow
from curvafit.__main__ import main
main()
"""
