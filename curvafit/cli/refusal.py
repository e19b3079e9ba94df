"""Refusals of the command line: one sentence on the error stream and exit code 2."""

from __future__ import annotations

import sys
from typing import Any, NoReturn

import typer
from rich.console import Console
from typer.core import TyperGroup

from curvafit.core.runtime import exit_code, one_line

#: Most characters of a sentence; a longer one is cut in its middle.
LONGEST = 700
#: The exception of an option that typer cannot parse; its name and module change with typer's versions.
_Refusal: type[Exception] = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")


class Commands(TyperGroup):
    """A group of commands whose usage errors are one line, as all other errors."""

    def main(self, *args: Any, standalone_mode: bool = True, **more: Any) -> Any:
        """Run a command and exit, as `click.Group.main` does."""
        if not standalone_mode:
            return super().main(*args, standalone_mode=False, **more)
        try:
            code = super().main(*args, standalone_mode=False, **more)
        except _Refusal as error:
            if type(error).__name__ == "NoArgsIsHelpError":
                error.show()  # type: ignore[attr-defined]
                sys.exit(2)
            _leave(error)
        except typer.Abort as error:  # a signal while no command was at work
            signal = error.__cause__
            sys.exit(exit_code(signal) if isinstance(signal, KeyboardInterrupt) else 1)
        sys.exit(code if isinstance(code, int) else 0)


def sentence(text: str, start: str = "error") -> str:
    """Return a message on one line of limited length, in signs that show; others are escaped."""
    line = one_line(" ".join(text.split()))
    if len(line) > LONGEST:
        line = f"{line[: LONGEST * 2 // 3]} … {line[-LONGEST // 3 :]}"
    return f"{start}: {line}"


def writable(text: str, console: Console) -> str:
    """Return a text in signs that a stream can encode; others are escaped."""
    return text.encode(console.encoding, "backslashreplace").decode(console.encoding)


def _leave(error: Any) -> NoReturn:
    """Print the usage error of typer with the command whose help tells more, and exit with code 2."""
    text = error.format_message().rstrip(".")
    context = getattr(error, "ctx", None)
    more = "" if context is None else f" (see {' '.join(['curvafit', *context.command_path.split()[1:], '--help'])})"
    console = Console(stderr=True, highlight=False)
    line = writable(sentence(f"{text[:1].lower()}{text[1:]}{more}"), console)
    console.print(line, markup=False, soft_wrap=True)
    sys.exit(2)
