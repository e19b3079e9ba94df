"""The program that runs: its progress, messages, pictures, memory, and the signals that end it.

Ctrl-C, SIGTERM and a closed terminal become exceptions, which clean up on their way and wait while files change. The
program listens from its first line (`listen`); the library changes no signal's handler.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# ---- progress and messages -------------------------------------------------------------------------------------------

#: Called with a sentence on the present step, and with the share of the work that is done, from 0 to 1.
Progress = Callable[[str, float], None]


def silent(text: str, share: float) -> None:
    """Say nothing: the default progress."""


def log_stages() -> Progress:
    """Return a progress that logs each stage once, at level INFO of the logger `curvafit`."""
    stages: set[str] = set()

    def log(text: str, share: float) -> None:
        if (stage := re.sub(r"\d+", "", text)) not in stages:  # texts that differ in numbers are one stage
            stages.add(stage)
            logging.getLogger("curvafit").info("%s (%.0f %% done)", text, 100 * share)

    return log


def show_share(text: str, share: float) -> None:
    """Show a sentence and a bar on the error stream, on one line of a terminal."""
    start, end = ("\r", "" if share < 1 else "\n") if sys.stderr.isatty() else ("", "\n")
    print(f"{start}[{'#' * round(20 * share):.<20}] {text}", end=end, file=sys.stderr, flush=True)


def sub_progress(progress: Progress, start: float, stop: float) -> Progress:
    """Return the progress of a part of the work, from one share of the whole to another."""
    return lambda text, share: progress(text, start + (stop - start) * share)


def one_line(text: str) -> str:
    """Return a text on one line; characters that do not show, such as a line break in a name, are escaped."""
    plain = text.replace("\u00a0", " ").replace("\u202f", " ")
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in plain)


# ---- pictures --------------------------------------------------------------------------------------------------------

#: Pixels along the width of a picture in a notebook's cell.
SMALL = 320


class Pictured:
    """A result with a picture: `.plot()` returns a figure, and a notebook shows a small one.

    Functions in rooms above the result's draw it: `_FIGURES` in `curvafit/__init__.py` names that of each type. The
    first picture imports it, so that the rooms below import neither matplotlib nor the room that draws.
    """

    def plot(self, **options: Any) -> Figure:
        """Return a matplotlib `Figure`; the options are those of the function that draws this type.

        Raises ValueError if there is nothing to draw: no surface, or a field that is not finite.
        """
        figures = sys.modules[__name__.partition(".")[0]]._FIGURES
        target = next(figures[ancestor.__name__] for ancestor in type(self).__mro__ if ancestor.__name__ in figures)
        module, _, function = target.partition(":")
        return getattr(import_module(module), function)(self, **options)

    def _repr_html_(self) -> str:
        """Return one line and, where there is something to draw, a small picture."""
        import base64
        from html import escape

        line = f"<code>{escape(repr(self))}</code>"
        try:
            figure = self.plot()
        except ValueError:
            return line
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=2 * SMALL / figure.get_figwidth())
        content = base64.b64encode(buffer.getvalue()).decode("ascii")
        return f'{line}<br><img src="data:image/png;base64,{content}" width="{SMALL}" alt="">'


# ---- forks -----------------------------------------------------------------------------------------------------------

#: The id of this process if it was forked after this module was imported: it has its parent's memory, not its threads.
_FORKS: list[int] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: _FORKS.append(os.getpid()))


def is_forked() -> bool:
    """Return whether this process was forked from one that had imported this module."""
    return bool(_FORKS)


# ---- memory ----------------------------------------------------------------------------------------------------------


def memory() -> int:
    """Return the bytes of memory of this machine, or of its container; `sys.maxsize` where neither is known."""
    sizes = [sys.maxsize]
    with suppress(AttributeError, ValueError, OSError):
        sizes.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(ValueError, OSError):
        sizes.append(int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    return min(sizes)


#: Bytes that a voxel of a field takes in memory, and while the field is written, with its copy in the file's layout.
FIELD, FILE = 4, 8
#: The least bytes that a voxel of a flow takes. Compiled: A, Adam's two moments and the start, three float32 numbers
#: each; u, the gradient, and the field between two passes of the blur. In plain torch autograd stores more.
FLOW = 60


def check_memory(voxels: Sequence[int], each: int, what: str, device: Any = "cpu") -> None:
    """Raise ValueError where voxels along axes, of `each` bytes, need more memory than a device or this machine has."""
    need, capacity = math.prod(map(int, voxels)) * each, device_memory(device)
    if need > capacity:
        size = " x ".join(map(str, voxels))
        limit = f"there are {capacity / 2**30:.3g} GiB" if capacity < sys.maxsize else "no machine has them"
        raise ValueError(f"{what} of {size} voxels does not fit into memory: it needs {need / 2**30:.3g} GiB, {limit}")


def device_memory(device: Any = "cpu") -> int:
    """Return the bytes of memory of a torch device or of this machine; `sys.maxsize` where the number is unknown."""
    if str(device) != "cpu":
        import torch

        if torch.device(device).type == "cuda" and torch.cuda.is_available():
            return torch.cuda.get_device_properties(device).total_memory
    return memory()


# ---- signals ---------------------------------------------------------------------------------------------------------

#: Signals that end the program besides Ctrl-C, where the platform has them.
_ENDS = ("SIGTERM", "SIGHUP")
#: Seconds after which a signal whose exception was lost is sent again: the finaliser has ended by then.
_PAUSE = 0.02


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP; `code` is the exit code that shells expect."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


class _Pending:
    """The nesting depth of `hold_signals` blocks in the main thread, and the signal that is raised when they end."""

    depth = 0
    waiting: int | None = None


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code of a signal: 130 for Ctrl-C, 128 and its number for another."""
    return error.code if isinstance(error, Terminated) else 130


def listen() -> None:
    """Turn signals into exceptions in the main thread, held back while files change; ignored signals stay ignored.

    Python drops an exception that is raised in a finaliser or a callback: there the signal is sent again.
    """
    sys.unraisablehook = _resend_lost_signal
    for name in ("SIGINT", *_ENDS):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


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


def _handle(number: int, frame: FrameType | None) -> None:
    """Raise the exception of a signal, or note the signal while files change."""
    if _Pending.depth:
        _Pending.waiting = number
    else:
        raise _exception(number)


def _resend_lost_signal(unraisable: sys.UnraisableHookArgs) -> None:
    """Send a signal again if its exception was dropped; print other dropped exceptions, as Python does."""
    error = unraisable.exc_value
    if not isinstance(error, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    timer = threading.Timer(_PAUSE, signal.raise_signal, (exit_code(error) - 128,))  # the signal's number
    timer.daemon = True
    timer.start()


def _exception(number: int) -> KeyboardInterrupt:
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
