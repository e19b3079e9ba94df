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
from curvafit.inference.stationarity import energy_gradients, fix_gauge
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

    None where the box is too small to have an inside apart from its borders.
    """
    if not grid.periodic and min(grid.shape) <= 2 * HALO + STRIDE:
        return None
    return float(np.linalg.norm(ShortFlow(phase, grid, epsilon, coefficients).residual(coefficients)))


class ShortFlow:
    """Short flows of several laws from one phase field, with the displacement of the interface that each leaves.

    A weak energy moves nothing. So that laws compare, every flow gets the same budget of force, that of the law
    `reference`: the norm of (a_α × the force of term α alone) at the start. Only the direction of a counts.
    """

    def __init__(self, phase: Tensor, grid: Grid, epsilon: float, reference: Coefficients) -> None:
        values, self.grid = _cut_box(phase.detach().to("cpu", torch.float32), grid)
        self.epsilon, self._voxel = epsilon, grid.spacing[0]
        self.start = deblur(values, self.grid, epsilon)
        self._before = gaussian_blur(self.start, self.grid, epsilon)
        halo = 0 if self.grid.periodic else HALO
        inside = tuple(slice(halo, n - halo) for n in self.grid.shape)
        self.frozen = None
        if halo:
            self.frozen = torch.ones(self.grid.shape, dtype=torch.bool)
            self.frozen[inside] = False
        # The displacement is the low-passed change of u over `share`, the low-passed |∇u|; its squares are weighted by
        # share / Σ share. So the mean square is Σ (change / norm)², with norm = √(share Σ share).
        slope = gradient(self._before.double(), self.grid).square().sum(-4).sqrt()
        self._read = tuple(slice(s.start, s.stop, STRIDE) for s in inside)
        share = gaussian_blur(slope, self.grid, LOW_PASS * self._voxel)[self._read]
        self._kept = share > _FAINT * share.max()
        self._norm = (share * share[self._kept].sum()).sqrt()[self._kept]
        self._forces = self._measure_forces()
        self._budget = self._force(fix_gauge(np.array([float(value) for value in reference]))[0])

    def residual(self, law: Coefficients) -> np.ndarray:
        """Return, for each voxel that is read, its low-passed displacement in voxels times the root of its weight.

        The sum of the squares is the weighted mean square of the displacement.
        """
        scaled = law.scale(self._budget / self._force(law))
        flow = descend(
            self.start,
            scaled,
            self.grid,
            flow="h-1",
            optimiser="adam",
            steps=SHORT_FLOW.steps,
            schedule=SHORT_FLOW,
            epsilon=self.epsilon,
            blur=WORKING_BLUR,
            frozen=self.frozen,
        )
        moved = (flow.field - self._before).double()
        if not bool(torch.isfinite(moved).all()):
            return np.full(len(self._norm), _LOST / np.sqrt(len(self._norm)))
        low = gaussian_blur(moved, self.grid, LOW_PASS * self._voxel)[self._read][self._kept]
        return (low / self._norm / self._voxel).numpy()

    def _measure_forces(self) -> np.ndarray:
        """Return the root mean square of each of the six low-passed ∂F_α/∂u where the residual is read."""
        terms = energy_gradients(self._before.double(), self.grid, self.epsilon)
        low = gaussian_blur(terms, self.grid, LOW_PASS * self._voxel)[(slice(None), *self._read)][:, self._kept]
        return low.square().mean(1).sqrt().numpy()

    def _force(self, law: Coefficients) -> float:
        return float(np.linalg.norm(self._forces * law.tensor().numpy()))


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
