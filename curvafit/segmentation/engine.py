"""The engine: data and F_ε lowered together, over hundreds of steps from long to short, from a start."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from curvafit.core.runtime import Progress, silent
from curvafit.generation.data import Data, Evidence
from curvafit.generation.flow import WORKING_BLUR, Flow, descend
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.profile import phase_field
from curvafit.segmentation.evidence import VoxelEvidence
from curvafit.segmentation.working import WorkingGrid
from curvafit.volumes.field import ScanError

__all__ = ["BENDING", "HALO", "STEPS", "bending", "completed", "likelihood", "started", "stiff", "weighed"]

#: Default steps of Adam.
STEPS = 400
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
        If a20 + a02 is not positive, or the energy does not stay finite.
    """

    def watch(step: int, total: int, state: object) -> None:
        progress("lowering the energy", step / total)

    flow = descend(
        started(level, place),
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


def weighed(
    evidence: VoxelEvidence,
    law: Coefficients,
    nats: float,
    place: WorkingGrid,
    steps: int,
    progress: Progress = silent,
) -> Flow:
    """Lower -log p(scan | mask) + F_ε, of which a unit of the Willmore energy costs so many nats, as `completed`."""
    return completed(evidence.level, law, likelihood(evidence, nats, place), place, steps, progress)


def likelihood(evidence: VoxelEvidence, nats: float, place: WorkingGrid) -> Evidence:
    """Return -log p(scan | mask), in units of F_ε, of which a unit of the Willmore energy costs so many nats."""
    return Evidence(place.spread(evidence.ratio) / (nats * place.grid.voxel_volume))


def started(level: np.ndarray, place: WorkingGrid) -> Tensor:
    """Return the phase field, on the place's grid, of the set where a smooth volume (Z, Y, X) is positive.

    Where it is positive everywhere or nowhere, as in a tile far from the surface, the field is 1 or -1.
    """
    inside = place.finer(level) > 0
    if inside.all() or not inside.any():
        return 2 * inside.float() - 1
    return phase_field(inside, place.grid, WORKING_EPSILON)


def bending(law: Coefficients) -> float:
    """Return a20 + a02: bumps on a plane cost half of it times their Willmore energy.

    Raises
    ------
    ScanError
        If it is not positive.
    """
    sum_of_squares = float(law.a20 + law.a02)
    if sum_of_squares <= 0:
        raise ScanError(f"expected coefficients with a20 + a02 > 0, got {sum_of_squares:g}: surfaces would crumple")
    return sum_of_squares


def stiff(law: Coefficients) -> Coefficients:
    """Return a law scaled to a20 + a02 = `BENDING`; raise ScanError as `bending`."""
    return law.scaled(BENDING / bending(law))
