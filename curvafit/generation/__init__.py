"""Generation: flows that lower the energy of a phase field."""

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.generation.data import Data as Data
    from curvafit.generation.data import Evidence as Evidence
    from curvafit.generation.data import Hinge as Hinge
    from curvafit.generation.flow import descend as descend
    from curvafit.generation.flow import generate as generate
    from curvafit.generation.forms import white_noise as white_noise
    from curvafit.generation.result import Flow as Flow
    from curvafit.generation.result import History as History
    from curvafit.generation.result import State as State
    from curvafit.generation.result import Viability as Viability
    from curvafit.generation.schedule import SCHEDULES as SCHEDULES
    from curvafit.generation.schedule import Schedule as Schedule

attach_lazy_names(__name__)
