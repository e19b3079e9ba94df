"""A task of which all is known where no example is: a shape grown from the law, with the slices of a volume."""

from __future__ import annotations

import numpy as np

from curvafit.core.runtime import Progress, silent
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.calibration import Task
from curvafit.segmentation.engine import stiff
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.working import WorkingGrid
from curvafit.volumes.field import Field, ScanError

__all__ = ["grown"]

#: Largest edge of a grown shape's slices, in working voxels.
EDGE = 64
#: Seed of a grown shape.
SEED = 0


def grown(slices: Slices, law: Coefficients, epsilon: float | None, progress: Progress = silent) -> Task[Slices]:
    """Return the task to fill a shape of a law between the same slices; its slices are cut to `EDGE`.

    The shape has the volume fraction of the known slices.

    Raises
    ------
    ScanError
        If no shape grows, or its slices are all empty or all full.
    """
    times = WorkingGrid.of(slices.frame, epsilon, periodic=True).times
    planes = [min(n, max(4, EDGE // part)) for n, part in zip(slices.inside.shape[1:], times[1:], strict=True)]
    frame = Field(np.broadcast_to(np.float32(0), (slices.length, *planes)), slices.spacing, slices.unit)
    place = WorkingGrid.of(frame, epsilon, periodic=True)
    share = float(slices.inside.mean())
    flow = generate(
        stiff(law).in_unit(place.unit),
        grid=place.grid,
        schedule=LEARNED,
        volume_fraction=share,
        seed=SEED,
        callbacks=[lambda step, total, state: progress("growing a shape of the law", step / total)],
    )
    mask = place.back(flow.field) > 0
    known, rest = list(slices.places), np.setdiff1d(np.arange(slices.length), slices.places)
    inside = mask[known]
    if not flow.finite or inside.all() or not inside.any():
        raise ScanError(
            f"expected a law of which a shape with volume fraction {share:.2g} grows, got none: give an example, or "
            "ask for no runs"
        )
    given = Slices(inside, slices.places, slices.length, slices.spacing, slices.unit, slices.periodic)
    return Task(given, mask[rest], [int(n) for n in rest])
