"""How far a short flow of a law moves a scan's surface: the right law leaves the surface where it is.

Stationarity reads how a profile deviates from tanh, so it says nothing of a mask, whose profile is made up. A short
flow first mends the profile, and then moves the interface: the better the law, the less.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from curvafit.generation.flow import WORKING_BLUR, descend
from curvafit.generation.schedule import Schedule
from curvafit.inference.stationarity import fix_gauge
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Float, Grid
from curvafit.priors.stencils import gaussian_blur, gradient
from curvafit.scan.grids import boxes_by_surface, surface_voxels

#: The short flow: Adam steps of 1e-3 as published.
SHORT_FLOW = Schedule("short", 150, 1e-3, 1e-3, "constant")
#: Longest edge of the box that is flowed, and the width of the halo that is held at the sides of a crop, in voxels.
LARGEST_BOX, HALO = 64, 8
#: Standard deviation in voxels of the low-pass on the displacement, and every how many voxels it is read.
LOW_PASS, STRIDE = 2.0, 2
#: Voxels whose share of interface is under this part of the largest are not read.
_FAINT = 0.02
#: Residual of a flow that diverged, in voxels.
_LOST = 10.0


def drift(phase: Float[Tensor, "z y x"], grid: Grid, epsilon: float, coefficients: Coefficients) -> float | None:
    """Return how far, in voxels, a short flow of a law moves the surface of `phase`: root mean square, low-passed.

    Only the direction of the coefficients counts: the flow takes them in their gauge. None where the box is too small
    to have an inside apart from its borders.
    """
    if not grid.periodic and min(grid.shape) <= 2 * HALO + STRIDE:
        return None
    values, grid = _cut_box(phase.detach().to("cpu", torch.float32), grid)
    start, voxel = deblur(values, grid, epsilon), grid.spacing[0]
    law, _ = fix_gauge(np.array([float(value) for value in coefficients]))
    options = {"steps": SHORT_FLOW.steps, "schedule": SHORT_FLOW, "epsilon": epsilon, "blur": WORKING_BLUR}
    flow = descend(start, law, grid, flow="h-1", optimiser="adam", frozen=halo_of(grid), **options)
    before = gaussian_blur(start, grid, epsilon)
    moved = (flow.field - before).double()
    if not bool(torch.isfinite(moved).all()):
        return _LOST
    margin = 0 if grid.periodic else HALO
    read = tuple(slice(margin, n - margin, STRIDE) for n in grid.shape)
    # The displacement is the low-passed change of u over `share`, the low-passed |∇u|, and weighs by `share`.
    slope = gradient(before.double(), grid).square().sum(-4).sqrt()
    share, change = (gaussian_blur(each, grid, LOW_PASS * voxel)[read] for each in (slope, moved))
    kept = share > _FAINT * share.max()
    return float((change[kept].square() / share[kept]).sum() / share[kept].sum()) ** 0.5 / voxel


def halo_of(grid: Grid) -> Tensor | None:
    """Return the voxels at the sides of a crop that a flow holds; None where the box repeats."""
    if grid.periodic:
        return None
    halo = torch.ones(grid.shape, dtype=torch.bool)
    halo[HALO:-HALO, HALO:-HALO, HALO:-HALO] = False
    return halo


def deblur(phase: Tensor, grid: Grid, width: float) -> Tensor:
    """Return v₀ with k ∗ v₀ close to `phase`, by two Van Cittert steps."""
    v = phase
    for _ in range(2):
        v = v + phase - gaussian_blur(v, grid, width)
    return v


def _cut_box(phase: Tensor, grid: Grid) -> tuple[Tensor, Grid]:
    """Return the whole, or the part of at most `LARGEST_BOX` voxels a side with the most surface."""
    if max(grid.shape) <= LARGEST_BOX:
        return phase, grid
    windows = boxes_by_surface(surface_voxels((phase > 0).numpy()), LARGEST_BOX)
    part = phase[windows[0]].contiguous()
    return part, Grid(tuple(part.shape), grid.spacing, "replicate")  # type: ignore[arg-type]
