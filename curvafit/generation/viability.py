"""Whether a flow made a shape: the published tests, and stricter ones, as pure predicates."""

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
#: What `well_formed` asks besides: |u| in both phases reaches a value in this interval. The published tests let through
#: plateaus near 0, whose level set is no interface, and fragments of a few voxels with |u| up to 7.
FORMED = (0.5, 2.0)
#: Planes that are looked at together.
PLANES = 16


@dataclass(frozen=True)
class Viability:
    """The discrepancy ratio, max u and min u of a field, whether they are a shape's, and the reason where not."""

    discrepancy: float
    highest: float
    lowest: float
    viable: bool
    reason: str


def well_formed(seen: Viability) -> bool:
    """Whether a shape is viable and |u| reaches a value within `FORMED` in both phases."""
    return seen.viable and all(FORMED[0] < extent < FORMED[1] for extent in (seen.highest, -seen.lowest))


def viability(u: Float[Tensor, "z y x"], grid: Grid, epsilon: float | Tensor) -> Viability:
    """Discrepancy ratio < 0.75, max u > 0.1 and min u < -0.1 (paper, Experiment 4)."""
    highest, lowest = float(u.max()), float(u.min())
    ratio = _discrepancy(u, grid, epsilon)
    reason = _reason(ratio, highest, lowest)
    return Viability(ratio, highest, lowest, not reason, reason)


def _discrepancy(u: Tensor, grid: Grid, epsilon: float | Tensor) -> float:
    """`discrepancy_ratio`, some planes at a time: little memory, beside a flow's own, and sums in float64."""
    Z, Y, X = grid.shape
    widths = epsilon.expand(grid.shape) if isinstance(epsilon, Tensor) else None
    above = below = 0.0
    for planes in torch.arange(Z).tensor_split(max(1, Z // PLANES)):
        reach = torch.arange(int(planes[0]) - 1, int(planes[-1]) + 2)
        reach = reach % Z if grid.periodic else reach.clamp(0, Z - 1)
        part = Grid((len(reach), Y, X), grid.spacing, grid.boundary)
        parts = cahn_hilliard_parts(u[reach], part, epsilon if widths is None else widths[reach])
        slope, well = (each[1:-1].double() for each in parts)
        above, below = above + float((slope - well).abs().sum()), below + float((slope + well).sum())
    return above / below if below else math.nan


def _reason(ratio: float, highest: float, lowest: float) -> str:
    if not (math.isfinite(highest) and math.isfinite(lowest)):
        return "the field is not finite"
    if not highest > PHASE_LIMIT:
        return f"no inside: the field's maximum is {highest:.3g}, at most {PHASE_LIMIT}"
    if not lowest < -PHASE_LIMIT:
        return f"no outside: the field's minimum is {lowest:.3g}, at least {-PHASE_LIMIT}"
    if not ratio < DISCREPANCY_LIMIT:
        return f"no interface profile: the discrepancy ratio is {ratio:.3f}, at least {DISCREPANCY_LIMIT}"
    return ""
