"""Tests of whether a field is a shape: the published ones and stricter ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.priors.energy import cahn_hilliard_parts
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float

#: Greatest discrepancy ratio, and least extent of either phase, of a viable shape (paper, Experiment 4).
DISCREPANCY_LIMIT = 0.75
PHASE_LIMIT = 0.1
#: `well_formed` also requires that |u| reaches a value in this interval in both phases. The published tests accept
#: plateaus near 0, whose level set is not an interface, and fragments of a few voxels with |u| up to 7.
FORMED = (0.5, 2.0)
#: Number of planes that are processed together.
PLANES = 16


@dataclass(frozen=True)
class Viability:
    """The discrepancy ratio, max u and min u of a field, whether they are those of a shape, and the reason if not."""

    discrepancy: float
    highest: float
    lowest: float
    viable: bool
    reason: str


def well_formed(end: Viability) -> bool:
    """Return whether a shape is viable and |u| reaches a value within `FORMED` in both phases."""
    return end.viable and all(FORMED[0] < extent < FORMED[1] for extent in (end.highest, -end.lowest))


def viability(u: Float[Tensor, "z y x"], grid: Grid, epsilon: float | Tensor) -> Viability:
    """Test discrepancy ratio < 0.75, max u > 0.1 and min u < -0.1 (paper, Experiment 4)."""
    highest, lowest = float(u.max()), float(u.min())
    ratio = _discrepancy(u, grid, epsilon)
    reason = _reason(ratio, highest, lowest)
    return Viability(ratio, highest, lowest, not reason, reason)


def _discrepancy(u: Tensor, grid: Grid, epsilon: float | Tensor) -> float:
    """Return `discrepancy_ratio`, a few planes at a time, which takes little memory, with sums in float64."""
    Z, Y, X = grid.shape
    widths = epsilon.expand(grid.shape) if isinstance(epsilon, Tensor) else None
    above = below = 0.0
    for planes in torch.arange(Z).tensor_split(max(1, Z // PLANES)):
        reach = torch.arange(int(planes[0]) - 1, int(planes[-1]) + 2)
        reach = reach % Z if grid.periodic else reach.clamp(0, Z - 1)
        slab = Grid((len(reach), Y, X), grid.spacing, grid.boundary)
        parts = cahn_hilliard_parts(u[reach], slab, epsilon if widths is None else widths[reach])
        slope, well = (part[1:-1].double() for part in parts)
        above, below = above + float((slope - well).abs().sum()), below + float((slope + well).sum())
    return above / below if below else math.nan


def _reason(ratio: float, highest: float, lowest: float) -> str:
    """Return the reason why a field is not a shape; empty where it is one."""
    if not (math.isfinite(highest) and math.isfinite(lowest)):
        return "the field is not finite"
    if not highest > PHASE_LIMIT:
        return f"no inside: the field's maximum is {highest:.3g}, not above {PHASE_LIMIT}"
    if not lowest < -PHASE_LIMIT:
        return f"no outside: the field's minimum is {lowest:.3g}, not below {-PHASE_LIMIT}"
    if not ratio < DISCREPANCY_LIMIT:
        return f"no interface profile: the discrepancy ratio is {ratio:.3f}, not below {DISCREPANCY_LIMIT}"
    return ""
