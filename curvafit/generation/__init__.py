"""The making: flows that lower the cost."""

if __name__ != "curvafit.generation":
    raise ImportError(
        "import curvafit.generation, not generation: the folder at the project's root is a link into the package"
    )

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from curvafit.generation.batch import generate_batch
    from curvafit.generation.data import Data, Evidence, Hinge
    from curvafit.generation.flow import descend, generate, relax
    from curvafit.generation.initial import white_noise
    from curvafit.generation.result import Flow, History, State
    from curvafit.generation.schedule import SCHEDULES, Schedule
    from curvafit.generation.viability import Viability

_HOMES = {
    "Data": "data",
    "Evidence": "data",
    "Flow": "result",
    "Hinge": "data",
    "History": "result",
    "State": "result",
    "descend": "flow",
    "generate": "flow",
    "generate_batch": "batch",
    "relax": "flow",
    "white_noise": "initial",
    "SCHEDULES": "schedule",
    "Schedule": "schedule",
    "Viability": "viability",
}

__all__ = [
    "SCHEDULES",
    "Data",
    "Evidence",
    "Flow",
    "Hinge",
    "History",
    "Schedule",
    "State",
    "Viability",
    "descend",
    "generate",
    "generate_batch",
    "relax",
    "white_noise",
]


def __getattr__(name: str) -> Any:
    """Public names, loaded when they are asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
