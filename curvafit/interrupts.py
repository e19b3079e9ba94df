"""Ctrl-C, SIGTERM and a closed terminal: exceptions that clean up on their way, but never amid a change of files.

The program listens from its first line (`listen`); the library changes no signal's handler.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: What ends the program besides Ctrl-C, where the platform has it.
_ENDS = ("SIGTERM", "SIGHUP")


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP; `code` is the exit code that shells expect."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


class _Held:
    """How many changes of files are under way in the main thread, and the signal that waits for their end."""

    depth = 0
    waiting: int | None = None


def exit_code(error: KeyboardInterrupt) -> int:
    """130 for Ctrl-C, 128 + its number for another signal."""
    return error.code if isinstance(error, Terminated) else 130


def listen() -> None:
    """Turn signals into exceptions of the main thread, which wait while files change; ignored ones stay ignored."""
    for name in ("SIGINT", *_ENDS):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _arrive)


def leave() -> None:
    """Ignore these signals: the program's work is done, and it is at its exit."""
    for name in ("SIGINT", *_ENDS):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Hold signals back that `listen` listens to, until the block is done: for changes that are all or nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _Held.depth += 1
    try:
        yield
    finally:
        _Held.depth -= 1
        if _Held.depth == 0 and _Held.waiting is not None:
            number, _Held.waiting = _Held.waiting, None
            raise _exception(number)


def _arrive(number: int, frame: FrameType | None) -> None:
    if _Held.depth:
        _Held.waiting = number
    else:
        raise _exception(number)


def _exception(number: int) -> KeyboardInterrupt:
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
