"""The example scripts as modules."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))


def example(name: str) -> Any:
    return importlib.import_module(name)


def run(script: Any, *words: object) -> None:
    """Run a script's command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"{script.__name__}.py", *map(str, words)])
        script.main()


def refused(script: Any, said: str, errors: pytest.CaptureFixture[str], *words: object) -> None:
    """Assert that a script's command ends with code 2 and one sentence."""
    with pytest.raises(SystemExit, match="2"):
        run(script, *words)
    text = errors.readouterr().err
    assert said in text and text.count("error: ") == 1
