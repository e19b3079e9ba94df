"""The program that runs: its progress, its messages on one line, the machine's memory, and the signals that end it.

Ctrl-C, SIGTERM and a closed terminal become exceptions, which clean up on their way and wait while files change. The
program listens from its first line (`listen`); the library changes no signal's handler.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

# ---- progress and messages -------------------------------------------------------------------------------------------

#: Called with a sentence on the present step, and with the share of the work that is done, from 0 to 1.
Progress = Callable[[str, float], None]


def silent(text: str, share: float) -> None:
    """Say nothing: the default progress."""


def sub_progress(progress: Progress, start: float, stop: float) -> Progress:
    """Return the progress of a part of the work, from one share of the whole to another."""
    return lambda text, share: progress(text, start + (stop - start) * share)


def one_line(text: str) -> str:
    """Return a text on one line; signs that do not show, such as a line break in a name, are escaped."""
    return "".join(_visible(sign) for sign in text)


def _visible(sign: str) -> str:
    if sign.isprintable():
        return sign
    spaces = {"\u00a0": " ", "\u202f": " "}
    return spaces.get(sign) or sign.encode("unicode_escape").decode()


# ---- memory ----------------------------------------------------------------------------------------------------------


def memory() -> int:
    """Return the bytes of memory of this machine, or of its container; `sys.maxsize` where neither is known."""
    return min(_installed(), _allowed())


def _installed() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return sys.maxsize


def _allowed() -> int:
    """Return the bytes that a container may use."""
    try:
        return int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return sys.maxsize


#: Bytes for each voxel of a field; and of one that is written: the field and a copy in the file's layout.
FIELD, FILE = 4, 8
#: The least bytes for each voxel of a flow: A, Adam's two moments and the start, three float32 numbers each; u, the
#: gradient, and the field between two passes of the blur. And those in plain torch, where autograd stores what the
#: energy's gradient needs.
FLOW, EAGER = 60, 400


def check_memory(voxels: Sequence[int], each: int, what: str, device: Any = "cpu") -> None:
    """Raise ValueError where voxels along axes, of `each` bytes, need more memory than a device or this machine has."""
    need, capacity = math.prod(map(int, voxels)) * each, device_memory(device)
    if need > capacity:
        size = " x ".join(map(str, voxels))
        limit = f"where there are {_gibibytes(capacity)}" if capacity < sys.maxsize else "more than any machine has"
        least = f"which need at least {_gibibytes(need)}, {limit}"
        raise ValueError(f"expected {what} that fits into memory, got {size} voxels, {least}")


def device_memory(device: Any = "cpu") -> int:
    """Return the bytes of memory of a torch device or of this machine; `sys.maxsize` where the number is unknown."""
    if str(device) != "cpu":
        import torch

        if torch.device(device).type == "cuda" and torch.cuda.is_available():
            return torch.cuda.get_device_properties(device).total_memory
    return memory()


def _gibibytes(size: int) -> str:
    """Return a number of bytes in GiB."""
    return f"{size / 2**30:.3g} GiB"


# ---- signals ---------------------------------------------------------------------------------------------------------

#: Signals that end the program besides Ctrl-C, where the platform has them.
_ENDS = ("SIGTERM", "SIGHUP")
#: Seconds after which a signal whose exception was lost comes again: the finaliser has ended by then.
_PAUSE = 0.02


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP; `code` is the exit code that shells expect."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


class _Pending:
    """The number of file changes under way in the main thread, and the signal that waits for their end."""

    depth = 0
    waiting: int | None = None


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code of a signal: 130 for Ctrl-C, 128 and its number for another."""
    return error.code if isinstance(error, Terminated) else 130


def listen() -> None:
    """Turn signals into exceptions of the main thread, which wait while files change; ignored signals stay ignored.

    Where such an exception is raised in a finaliser or a callback, from which Python lets nothing rise, it comes again.
    """
    sys.unraisablehook = _again
    for name in ("SIGINT", *_ENDS):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _arrive)


def leave() -> None:
    """Ignore the signals that `listen` listens to, at the program's exit."""
    for name in ("SIGINT", *_ENDS):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextmanager
def hold_signals() -> Iterator[None]:
    """Hold back the signals that `listen` listens to until the block ends, for changes that are all or nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _Pending.depth += 1
    try:
        yield
    finally:
        _Pending.depth -= 1
        if _Pending.depth == 0 and _Pending.waiting is not None:
            number, _Pending.waiting = _Pending.waiting, None
            raise _exception(number)


def _arrive(number: int, frame: FrameType | None) -> None:
    if _Pending.depth:
        _Pending.waiting = number
    else:
        raise _exception(number)


def _again(unraisable: sys.UnraisableHookArgs) -> None:
    """Send a signal anew whose exception was lost; print other lost exceptions, as Python does."""
    error = unraisable.exc_value
    if not isinstance(error, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    later = threading.Timer(_PAUSE, signal.raise_signal, (exit_code(error) - 128,))
    later.daemon = True
    later.start()


def _exception(number: int) -> KeyboardInterrupt:
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
