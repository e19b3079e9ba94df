"""The engine: data and F_ε lowered together, over hundreds of steps from long to short, from a start."""

from __future__ import annotations

import numpy as np

from curvafit.generation.data import Data
from curvafit.generation.flow import WORKING_BLUR, Flow, descend
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.profile import phase_field
from curvafit.progress import Progress, silent
from curvafit.segmentation.working import WorkingGrid
from curvafit.volumes.field import ScanError

__all__ = ["HALO", "completed", "stiff"]

#: Voxels of the grid around a volume that does not repeat: far enough for the border's right angles not to reach it.
HALO = 6
#: a20 + a02 of the law in a flow, on which the steps of Adam depend; the Willmore energy has it.
BENDING = 2.0


def completed(
    level: np.ndarray, law: Coefficients, data: Data, place: WorkingGrid, steps: int, progress: Progress = silent
) -> Flow:
    """Lower D(u) + F_ε(u) from the set where a level is positive, with u = k ∗ v: Adam under a cooling schedule.

    Parameters
    ----------
    level
        A smooth volume (Z, Y, X) on the scan's grid, positive inside.
    law
        Coefficients with lengths in the scan's unit; their scale does not matter.
    data
        D on the place's grid, in units of F_ε of a law with a20 + a02 = 2.

    Raises
    ------
    ScanError
        If the start has one phase only, a20 + a02 is not positive, or the energy does not stay finite.
    """
    inside = place.finer(level) > 0
    if not inside.any() or inside.all():
        raise ScanError(
            f"expected a structure and background in the scan, got {'none' if inside.all() else 'one phase'}"
        )

    def watch(step: int, total: int, state: object) -> None:
        progress("lowering the energy", step / total)

    flow = descend(
        phase_field(inside, place.grid, WORKING_EPSILON),
        stiff(law).in_unit(place.unit),
        place.grid,
        data=data,
        optimiser="adam",
        steps=steps,
        schedule="cosine",
        blur=WORKING_BLUR,
        callbacks=[watch],
    )
    if not flow.finite:
        raise ScanError(f"expected an energy that stays finite, got a flow that {flow.status}: lower the weight")
    return flow


def stiff(law: Coefficients) -> Coefficients:
    """Return a law scaled to a20 + a02 = `BENDING`.

    Raises
    ------
    ScanError
        If a20 + a02 is not positive.
    """
    bending = float(law.a20 + law.a02)
    if bending <= 0:
        raise ScanError(f"expected coefficients with a20 + a02 > 0, got {bending:g}: surfaces would crumple")
    return law.scaled(BENDING / bending)
