"""A case's command in a process of its own: forked from a warm one, with limits, its streams in files."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

#: Seconds of processor that a command may take, that it may do nothing, and that it may take at all.
PROCESSOR, IDLE, WAITING = 20, 20.0, 300.0
#: Bytes that a command may map beyond what the warm process has, and that it may fill.
ROOM, FILLED = 5 << 29, 3 << 29

Job = Callable[[], None]


@dataclass(frozen=True)
class Outcome:
    """How a process ended: its exit code (minus the signal that killed it), what it said, what it took."""

    code: int
    stdout: str
    stderr: str
    seconds: float
    filled: int
    hung: str = ""


@dataclass
class Running:
    """A process that was started."""

    pid: int
    folder: Path
    since: float

    def stop(self, number: int) -> None:
        """Send a signal, where the process is still there."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)


def run(job: Job, here: Path, said: Path, first: Sequence[Job] = ()) -> Outcome:
    """Start a job and wait for its end; `said` is a folder for its streams, `first` are calls made before the job."""
    return finish(start(job, here, said, first))


def start(job: Job, here: Path, said: Path, first: Sequence[Job] = ()) -> Running:
    """Fork, and do the job in the child."""
    said.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    since, pid = time.monotonic(), os.fork()
    if pid == 0:
        _child(job, here, said, first)
    return Running(pid, said, since)


def finish(running: Running) -> Outcome:
    """Wait for a process; kill one that hangs."""
    hung, pause, asked = "", 0.002, time.monotonic()
    worked, looked = 0.0, asked
    while True:
        pid, status, used = os.wait4(running.pid, os.WNOHANG)
        if pid:
            break
        now = time.monotonic()
        if not hung and (now > looked + IDLE or now > asked + WAITING):
            before, worked, looked = worked, _processor(running.pid), now
            if now > asked + WAITING or worked < before + 0.1:
                hung = f"no end within {now - asked:.0f} s"
                running.stop(signal.SIGKILL)
        time.sleep(pause)
        pause = min(0.02, pause * 1.2)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(running.pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGXCPU or used.ru_utime + used.ru_stime > PROCESSOR:
        hung = hung or f"more than {PROCESSOR} s of processor"
    filled = used.ru_maxrss * 1024 - _resident()
    if filled > FILLED:
        hung = hung or f"filled {filled / 2**30:.1f} GiB"
    out, err = (_text(running.folder / name) for name in ("stdout", "stderr"))
    return Outcome(code, out, err, time.monotonic() - running.since, filled, hung)


def commanding(arguments: Sequence[str]) -> Job:
    """The job of calling curvafit with these arguments."""

    def job() -> None:
        sys.argv = ["curvafit", *arguments]
        from curvafit.__main__ import main

        main()

    return job


def _child(job: Job, here: Path, said: Path, first: Sequence[Job]) -> None:
    code = 0
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _redirect(said)
        os.chdir(here)
        resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR + 1, PROCESSOR + 3))
        limit = _mapped() + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for each in first:
            each()
        job()
    except SystemExit as leaving:
        if isinstance(leaving.code, str):
            sys.stderr.write(f"{leaving.code}\n")
        code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except BaseException:  # what the interpreter would print
        code = 1
        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stdout.flush()
    with contextlib.suppress(BaseException):
        sys.stderr.flush()
    os._exit(code & 255)


def _redirect(said: Path) -> None:
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    for name, number in (("stdout", 1), ("stderr", 2)):
        handle = os.open(said / name, flags, 0o644)
        os.dup2(handle, number)
        os.close(handle)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", errors="surrogateescape", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False, buffering=1)


def _text(path: Path) -> str:
    with contextlib.suppress(OSError), path.open("rb") as stream:
        return stream.read(200_000).decode("utf-8", "replace")
    return ""


def _statm(column: int) -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[column]) * resource.getpagesize()
    except OSError:  # no such account on this system
        return (8 << 30) if column == 0 else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _mapped() -> int:
    return _statm(0)


def _resident() -> int:
    return _statm(1)


def _processor(pid: int) -> float:
    """Seconds of processor that another process has taken."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")
    except OSError:
        return 0.0
