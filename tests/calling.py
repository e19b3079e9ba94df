"""The command line called from tests."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

from typer.testing import CliRunner, Result

from curvafit.cli.app import app

LAW = ["--coefficients", "1,2,6,-40,-40,400", "--mass", "-0.6"]
QUICK = [*LAW, "--shape", "24", "--steps", "30"]


def call(*arguments: object) -> Result:
    """As from a shell: `sys.argv`, which records repeat, is the command's."""
    words = [str(part) for part in arguments]
    with patch("sys.argv", ["curvafit", *words]):
        return CliRunner().invoke(app, words)


def done(*arguments: object) -> Result:
    """What a command that succeeds says."""
    result = call(*arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return result


def refused(result: Result, word: str = "", *, progress: bool = False) -> None:
    """One sentence with a key word on the error stream, nothing on the other, exit code 2.

    With `progress`, lines that name stages may stand before it.
    """
    assert result.exit_code == 2, (result.output, result.exception)
    assert result.stdout == ""
    *before, last = result.stderr.strip().splitlines()
    assert all(progress and line.startswith("[") for line in before), before
    assert last.startswith("error: ") and word.lower() in last.lower(), (word, last)


def made(*arguments: object) -> dict[str, Any]:
    """The record that a `generate` which succeeds leaves."""
    lines = done("generate", *arguments).stdout.splitlines()
    record = next(Path(line) for line in lines if line.endswith(".json"))
    return json.loads(record.read_text())
