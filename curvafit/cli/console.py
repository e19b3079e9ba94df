"""What commands print: results, notes, progress, and one sentence with exit code 2 for every expected error."""

from __future__ import annotations

import os
import re
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from curvafit.core.runtime import Terminated, exit_code, one_line

#: The environment variable that lets an error keep its traceback.
DEBUG = "CURVAFIT_DEBUG"
#: Most characters of a sentence; a longer one is cut in its middle.
LONGEST = 700
#: Seconds after which the time that is left is told.
TOLD = 20.0
#: Characters that look better on a page, but are copied from a terminal, and that some encodings lack.
_PLAIN = str.maketrans({"\u2212": "-", "\u2013": "-", "\u202f": " ", "\u00a0": " "})
#: The exception of an option that typer cannot parse; its name and module change with typer's versions.
_UsageError: type[Exception] = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")


# ---- errors ----------------------------------------------------------------------------------------------------------


class Commands(TyperGroup):
    """A group of commands whose usage errors are one line, as all other errors."""

    def main(self, *args: Any, **more: Any) -> NoReturn:
        """Run a command and exit, as `click.Group.main` does."""
        try:
            code = super().main(*args, **more | {"standalone_mode": False})
        except _UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # a group without a command: show its help
                error.show()  # type: ignore[attr-defined]
            else:
                say(_explain_usage(error), to=error_console())
            sys.exit(2)
        except typer.Abort as error:  # a signal while no command was at work
            signal = error.__cause__
            sys.exit(exit_code(signal) if isinstance(signal, KeyboardInterrupt) else 1)
        sys.exit(code if isinstance(code, int) else 0)


def _explain_usage(error: Any) -> str:
    """Return typer's usage error as a sentence that names the help to read."""
    text = error.format_message().rstrip(".")
    context = getattr(error, "ctx", None)
    hint = "" if context is None else f" (see {' '.join(['curvafit', *context.command_path.split()[1:], '--help'])})"
    return sentence(f"{text[:1].lower()}{text[1:]}{hint}")


@contextmanager
def plain_errors() -> Iterator[None]:
    """Print an expected exception as one sentence and exit with code 2; after a signal, with the code of `exit_code`.

    Warnings become notes, printed at the end of a command that succeeds; one that fails prints its error alone.
    """
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            yield
        _say_warnings(caught)
    except typer.Exit:
        _say_warnings(caught)
        raise
    except (KeyboardInterrupt, SystemError) as error:
        signal = _signal_of(error)
        say(f"{_name_signal(signal)}: nothing is left half-written", to=error_console())
        raise typer.Exit(exit_code(signal)) from None
    except (ValueError, OSError, ImportError, MemoryError, RuntimeError) as error:
        if os.environ.get(DEBUG) or not (text := _explain(error)):
            raise
        say(text, to=error_console())
        raise typer.Exit(2) from None


@contextmanager
def resumable(kept: Path | None) -> Iterator[None]:
    """On a signal, say that the same command resumes, if finished parts are in the file or folder `kept`."""
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        signal = _signal_of(error)
        if kept is None or not kept.exists():
            raise
        say(f"{_name_signal(signal)}: finished parts are saved. Run the same command to resume", to=error_console())
        raise typer.Exit(exit_code(signal)) from None


@contextmanager
def keep_parts(store: Path | None) -> Iterator[None]:
    """Delete the folder of finished parts once the block succeeds; after a signal or an error it stays, to resume."""
    from curvafit.core.files import is_empty, remove

    with resumable(store):
        try:
            yield
        except ValueError:  # raised before the first part: there is nothing to resume
            if store is not None and is_empty(store):
                remove(store)
            raise
    if store is not None:
        remove(store)


def _signal_of(error: KeyboardInterrupt | SystemError) -> KeyboardInterrupt:
    """Return the signal that ended a command, or that compiled code met, whose SystemError it causes; raise another."""
    signal = error.__cause__ if isinstance(error, SystemError) else error
    if not isinstance(signal, KeyboardInterrupt):
        raise error
    return signal


def _name_signal(signal: KeyboardInterrupt) -> str:
    return "terminated" if isinstance(signal, Terminated) else "interrupted"


def _explain(error: Exception) -> str:
    """Return the sentence of an exception; an empty text where the program is at fault."""
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "memory" in str(error).lower()):
        return "error: the volume does not fit into memory"
    ours = isinstance(error, ImportError) and (error.name or "").startswith("curvafit")
    if ours or isinstance(error, RuntimeError):
        return ""
    if isinstance(error, OSError) and error.strerror:
        return sentence(f"{error.strerror.lower()}: {error.filename or ''}")
    return sentence(str(error) or type(error).__name__)


def _say_warnings(caught: list[warnings.WarningMessage]) -> None:
    """Print the warnings that are for users, each once."""
    say_notes(dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)))


def command_line() -> str:
    """Return the command as typed, without `--overwrite`: with it or not, a command's results are the same."""
    return shlex.join(["curvafit", *(word for word in sys.argv[1:] if word != "--overwrite")])


# ---- printing --------------------------------------------------------------------------------------------------------


def error_console() -> Console:
    """Return a console on the error stream."""
    return Console(stderr=True, highlight=False)


def sentence(text: str, start: str = "error") -> str:
    """Return a message as one line of limited length, in which characters that do not show are escaped."""
    line = one_line(" ".join(text.split()))
    if len(line) > LONGEST:
        line = f"{line[: LONGEST * 2 // 3]} … {line[-LONGEST // 3 :]}"
    return f"{start}: {line}"


def writable(text: str, console: Console) -> str:
    """Return a text in which characters that a console cannot encode are escaped."""
    return text.encode(console.encoding, "backslashreplace").decode(console.encoding)


def say(text: str, *, to: Console | None = None, style: str | None = None) -> None:
    """Print one line without markup or wrapping, so that paths can be copied."""
    console = to or Console(highlight=False)
    console.print(writable(text.translate(_PLAIN), console), style=style, markup=False, soft_wrap=True)


def say_notes(notes: Iterable[str]) -> None:
    """Print notes, such as assumptions about a file, on the error stream."""
    for note in notes:
        say(sentence(note, "note"), to=error_console())


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> None:
    """Print a table without a frame; the columns in `right` are aligned to the right."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k in right else "left", no_wrap=k in right or k == 0)
    for row in rows:
        table.add_row(*(Text(cell.translate(_PLAIN)) for cell in row))
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=160)).print(table)


def _time_left(elapsed: float, share: float) -> str:
    """Return how many minutes are left of a job that is so far after so many seconds, where that can be told."""
    if elapsed < TOLD or not 0 < share < 1:
        return ""
    minutes = elapsed * (1 - share) / share / 60
    return f", {'under a minute' if minutes < 1 else f'about {minutes:.0f} min'} left"


@contextmanager
def show_stages() -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar for a job that names its stages; call it with a sentence and the share done.

    Without a terminal each new sentence is a line, and one that differs only in its numbers is a line every 5 %, with
    the time that is left once that can be told. A line at share 0 waits for the next line, so that a job that fails at
    its start prints its error alone.
    """
    console = error_console()
    if not console.is_terminal:
        stage, last_share, begun = "", 0.0, time.monotonic()
        waiting: list[str] = []  # lines that are not printed yet

        def write(text: str, share: float) -> None:
            nonlocal stage, last_share
            without_numbers = re.sub(r"\d+", "", text)
            if without_numbers != stage or share >= last_share + 0.05:
                stage, last_share = without_numbers, share
                waiting.append(f"[{100 * share:3.0f} %] {text}{_time_left(time.monotonic() - begun, share)}")
                while len(waiting) > (1 if share == 0 else 0):
                    say(waiting.pop(0), to=console)

        yield write
        for line in waiting:
            say(line, to=console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)
