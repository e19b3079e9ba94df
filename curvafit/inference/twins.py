"""Shapes grown from a law to stand beside a scan, seen and measured as the scan is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from curvafit.generation.flow import Flow, generate
from curvafit.generation.schedule import LEARNED
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.mesh import NoSurface
from curvafit.geometry.morphometry import Morphometry, morphometry
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.scan.prepare import Prepared
from curvafit.volumes.scan import ScanError

#: Longest edge, in working voxels, of the boxes in which twins grow.
LONGEST_EDGE = 100


@dataclass(frozen=True, eq=False)
class Twin:
    """A shape grown from a law, or why none grew: its field and mass; its curvature diagram and familiar numbers as the
    scan would show them, of a window where the scan is one: what its faces hide is hidden of the twin as well."""

    phase: np.ndarray | None
    mass: float
    diagram: Diagram | None
    morphometry: Morphometry | None
    reason: str = ""


def twin(coefficients: Coefficients, mass: float, prepared: Prepared, seed: int) -> Twin:
    """Grow a shape of a law in a box of the scan's main window, at most `LONGEST_EDGE` voxels a side.

    Of a mask or an image it fills the same part of its box as the structure (`Prepared.true_share`), since a mask does
    not state a mass; where nothing grows so, it has the law's own mass.
    """
    grid, told = twin_grid(prepared), {"schedule": LEARNED, "seed": seed, "reject_early": True}
    if prepared.kind != "field":
        share = prepared.true_share
        flow = generate(coefficients, mass, grid, volume_fraction=share, **told)
        if (grown := _measured(flow, prepared, seed)).phase is not None:
            return grown
    return _measured(generate(coefficients, mass, grid, **told), prepared, seed)


def twin_grid(prepared: Prepared) -> Grid:
    """Return the periodic box in which a scan's twins grow."""
    z, y, x = (min(edge.stop - edge.start, LONGEST_EDGE) for edge in prepared.windows[0])
    return Grid((z, y, x), prepared.grid.spacing, "periodic")


def _measured(flow: Flow, prepared: Prepared, seed: int) -> Twin:
    """Return a flow's shape with its diagram and numbers, as the scan would show it."""
    if not flow.viability.viable:
        return Twin(None, flow.mass, None, None, flow.viability.reason)
    try:
        mask, field = flow.field.numpy() > 0, flow.field
        window = Grid(flow.grid.shape, flow.grid.spacing, prepared.grid.boundary)
        if prepared.kind != "field":
            mask = prepared.seen(mask, seed)
            field = phase_field(torch.from_numpy(mask), window, WORKING_EPSILON)
        curvature = diagram(field, window, WORKING_EPSILON)
    except (NoSurface, ScanError) as error:
        return Twin(None, flow.mass, None, None, str(error))
    numbers = morphometry(mask, prepared.working_voxel, prepared.unit, periodic=window.periodic)
    return Twin(flow.field.numpy(), flow.mass, curvature, numbers)
