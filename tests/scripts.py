"""The example scripts as modules."""

import importlib
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))


def example(name: str) -> Any:
    return importlib.import_module(name)
