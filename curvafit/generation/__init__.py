"""Generation: flows that lower the energy of a phase field."""

if __name__ != "curvafit.generation":
    raise ImportError(
        "import curvafit.generation, not generation: the folder at the project's root is a link into the package"
    )

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.generation.batch import generate_batch
    from curvafit.generation.data import Data, Evidence, Hinge
    from curvafit.generation.flow import descend, generate, relax
    from curvafit.generation.initial import white_noise
    from curvafit.generation.result import Flow, History, State
    from curvafit.generation.schedule import SCHEDULES, Schedule
    from curvafit.generation.viability import Viability

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

_HOMES = {
    "Data": "curvafit.generation.data",
    "Evidence": "curvafit.generation.data",
    "Flow": "curvafit.generation.result",
    "Hinge": "curvafit.generation.data",
    "History": "curvafit.generation.result",
    "SCHEDULES": "curvafit.generation.schedule",
    "Schedule": "curvafit.generation.schedule",
    "State": "curvafit.generation.result",
    "Viability": "curvafit.generation.viability",
    "descend": "curvafit.generation.flow",
    "generate": "curvafit.generation.flow",
    "generate_batch": "curvafit.generation.batch",
    "relax": "curvafit.generation.flow",
    "white_noise": "curvafit.generation.initial",
}

offer(__name__, _HOMES)
