"""Parsing, progress and plain errors for the command line."""

from __future__ import annotations

import math
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from curvafit.cli.refusal import sentence, writable
from curvafit.core.runtime import Terminated, exit_code

#: Whether files of other programs, or of other commands, may be replaced.
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace files or folders of the output's names, whatever wrote them.")
]
#: The environment variable that lets an error keep its traceback.
DEBUG = "CURVAFIT_DEBUG"
#: Signs that look better on a page than in a terminal, where they are copied and some encodings lack them.
_PLAIN = str.maketrans({"\u2212": "-", "\u2013": "-", "\u202f": " ", "\u00a0": " "})


@contextmanager
def plainly() -> Iterator[None]:
    """Turn an expected exception into its sentence and exit code 2, and a signal into the exit code of `exit_code`.

    Warnings become notes, printed at the end of a command that succeeds; one that fails prints its error alone.
    """
    notes: dict[str, None] = {}
    try:
        with warnings.catch_warnings():
            warnings.showwarning = partial(_note, notes)
            yield
        _say_notes(notes)
    except typer.Exit:
        _say_notes(notes)
        raise
    except KeyboardInterrupt as signal:
        say(f"{_ended(signal)}: nothing is left half-written", to=error_console())
        raise typer.Exit(exit_code(signal)) from None
    except (ValueError, OSError, ImportError, MemoryError, RuntimeError) as error:
        if os.environ.get(DEBUG) or not _expected(error):
            raise
        say(_sentence(error), to=error_console())
        raise typer.Exit(2) from None


@contextmanager
def kept(again: Callable[[], str] = lambda: "the same command") -> Iterator[None]:
    """On a signal, print that nothing is lost and which command resumes the work."""
    try:
        yield
    except KeyboardInterrupt as signal:
        say(f"{_ended(signal)}: what is made is kept, and {again()} goes on with it", to=error_console())
        raise typer.Exit(exit_code(signal)) from None


def _ended(signal: KeyboardInterrupt) -> str:
    return "terminated" if isinstance(signal, Terminated) else "interrupted"


def _expected(error: Exception) -> bool:
    """Return whether an exception tells of the input or the machine rather than of a fault of the program."""
    if isinstance(error, ImportError):
        return not (error.name or "").startswith("curvafit")
    return not isinstance(error, RuntimeError) or "memory" in str(error).lower()


def _sentence(error: Exception) -> str:
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "memory" in str(error).lower()):
        return "error: expected a volume that fits into memory, got a larger one"
    if isinstance(error, OSError) and error.strerror:
        return sentence(f"{error.strerror.lower()}: {error.filename or ''}")
    return sentence(str(error) or type(error).__name__)


def _note(notes: dict[str, None], message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, UserWarning):
        notes[sentence(str(message), "note")] = None


def _say_notes(notes: Iterable[str]) -> None:
    for note in notes:
        say(note, to=error_console())


def command_line() -> str:
    """Return the command as typed."""
    return shlex.join(["curvafit", *sys.argv[1:]])


# ---- parsing ---------------------------------------------------------------------------------------------------------


def numbers(text: str, option: str, count: int) -> tuple[float, ...]:
    """Return a text as `count` finite numbers between commas."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        what = "a number" if count == 1 else f"{count} numbers between commas"
        raise ValueError(f"expected {option} as {what}, got {text!r}")
    return values


def triple(text: str, option: str) -> tuple[float, float, float]:
    """Return a text as three positive numbers; one counts for all axes."""
    values = numbers(text, option, 1) * 3 if "," not in text else numbers(text, option, 3)
    if min(values) <= 0:
        raise ValueError(f"expected {option} as positive numbers, got {text!r}")
    return values  # type: ignore[return-value]


def whole_triple(text: str, option: str) -> tuple[int, int, int]:
    """Return a text as three positive whole numbers; one counts for all axes."""
    values = triple(text, option)
    if any(value != int(value) for value in values):
        raise ValueError(f"expected {option} as whole numbers, got {text!r}")
    return tuple(int(value) for value in values)  # type: ignore[return-value]


def whole_numbers(text: str, option: str) -> tuple[int, ...]:
    """Return a text as whole numbers from 0."""
    values = numbers(text, option, text.count(",") + 1)
    if min(values) < 0 or any(value != int(value) for value in values):
        raise ValueError(f"expected {option} as whole numbers from 0, got {text!r}")
    return tuple(int(value) for value in values)


def device_of(text: str) -> str:
    """Return the name of a device, or raise ValueError where this machine does not have it."""
    import torch

    try:
        kind = torch.device(text).type
    except RuntimeError:
        kind = ""
    devices = {"cpu": True, "cuda": torch.cuda.is_available()}
    if not devices.get(kind):
        names = ", ".join(name for name, available in devices.items() if available)
        raise ValueError(f"expected --device to be one of this machine's ({names}), got {text!r}")
    return text


def threshold_of(text: str) -> float | str:
    """Return a text as a grey level, or `"otsu"`."""
    return text.lower() if text.lower() == "otsu" else numbers(text, "--threshold", 1)[0]


# ---- printing --------------------------------------------------------------------------------------------------------


def error_console() -> Console:
    """Return a console on the error stream."""
    return Console(stderr=True, highlight=False)


def say(text: str, *, to: Console | None = None, style: str | None = None) -> None:
    """Print one line without markup or wrapping, so that paths can be copied."""
    console = to or Console(highlight=False)
    console.print(writable(text.translate(_PLAIN), console), style=style, markup=False, soft_wrap=True)


def say_notes(notes: Iterable[str]) -> None:
    """Print sentences on assumptions about a file on the error stream."""
    for note in notes:
        say(f"note: {note}", to=error_console())


def output(heads: Sequence[str], rows: Iterable[Sequence[str]], right: Iterable[int] = ()) -> None:
    """Print a table without a frame; the columns in `right` are aligned to the right."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    rights = set(right)
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k in rights else "left", no_wrap=k in rights or k == 0)
    for row in rows:
        table.add_row(*(Text(cell.translate(_PLAIN)) for cell in row))
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=160)).print(table)


@contextmanager
def stages() -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar for a job that names its stages; call it with a sentence and the share done.

    Without a terminal each new sentence is a line, and one that differs only in its numbers is a line every 5 %. A line
    at share 0 waits for the next line, so that a job that fails at its start prints its error alone.
    """
    console = error_console()
    if not console.is_terminal:
        kind, last = "", 0.0
        waiting: list[str] = []

        def write(text: str, share: float) -> None:
            nonlocal kind, last
            now = re.sub(r"\d+", "", text)
            if now != kind or share >= last + 0.05:
                kind, last = now, share
                waiting.append(f"[{100 * share:3.0f} %] {text}")
                while len(waiting) > (share == 0):
                    say(waiting.pop(0), to=console)

        yield write
        for line in waiting:
            say(line, to=console)
        return
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console, transient=True
    ) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


@contextmanager
def flow_progress(steps: int) -> Iterator[Callable[..., None]]:
    """Show a progress bar that is a flow's callback."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} steps"),
    )
    console = error_console()
    quiet = not console.is_terminal
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True, disable=quiet) as bar:
        task = bar.add_task("starting (a first run compiles the kernels for this processor)", total=steps)
        yield lambda step, total, state: bar.update(task, completed=step, description="growing")
