"""Forms, the affine maps from a flow's parameters to fields, each with its adjoint (`pullback`); seeded starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.core.checks import check_seed, check_type
from curvafit.core.runtime import FIELD, check_memory
from curvafit.priors.grid import Float, Grid
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

#: Width of the published start's interval, 40 Δx at Δx = 0.01.
AMPLITUDE = 0.4
#: A function of field, grid and standard deviation that returns k ∗ field.
Blur = Callable[[Tensor, Grid, float], Tensor]


@dataclass(frozen=True)
class DivergenceForm:
    """u = k ∗ (div A + base), whose mass is the base's for every A (paper, eq. 24 and Algorithm 1).

    The descent of A is the H⁻¹ flow ∂u/∂t = Δ ∂F_ε/∂u (eq. 2): ∂F_ε/∂A = -∇ ∂F_ε/∂u moves u by the divergence of that.
    `width` is the standard deviation of k in spacing's unit; `base` is k ∗ base: the mass m₀, or a blurred field.
    """

    grid: Grid
    width: float
    base: float | Tensor
    blur: Blur = gaussian_blur

    @classmethod
    def of(
        cls, grid: Grid, width: float, base: float | Float[Tensor, "z y x"], blur: Blur = gaussian_blur
    ) -> DivergenceForm:
        """Return the form of a base that is not blurred yet."""
        return cls(grid, width, blur(base, grid, width) if isinstance(base, Tensor) else float(base), blur)

    @classmethod
    def start_at(cls, field: Tensor, grid: Grid, width: float, blur: Blur) -> tuple[DivergenceForm, Tensor]:
        """Return the form for which u = k ∗ field at A = 0, and that A."""
        return cls.of(grid, width, field, blur), field.new_zeros((3, *grid.shape))

    def field(self, vector: Float[Tensor, "3 z y x"]) -> Float[Tensor, "z y x"]:
        """Return u for A."""
        return self.blur(divergence(vector, self.grid), self.grid, self.width) + self.base

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
        """Return -∇(k ∗ slope), as the blur is its own adjoint and div = -∇ᵀ."""
        return -gradient(self.blur(slope, self.grid, self.width), self.grid)

    def to(self, device: torch.device | str) -> DivergenceForm:
        """Return the same form on a device."""
        return dataclasses.replace(self, base=self.base.to(device)) if isinstance(self.base, Tensor) else self


@dataclass(frozen=True)
class DirectForm:
    """u = k ∗ v, whose mass may change (paper, Algorithm 2; L² flow); see `descend` on its blur."""

    grid: Grid
    width: float
    blur: Blur = gaussian_blur

    @classmethod
    def start_at(cls, field: Tensor, grid: Grid, width: float, blur: Blur) -> tuple[DirectForm, Tensor]:
        """Return the form and the start v = field."""
        return cls(grid, width, blur), field

    def field(self, values: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return u for v."""
        return self.blur(values, self.grid, self.width)

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return k ∗ slope."""
        return self.blur(slope, self.grid, self.width)

    def to(self, device: torch.device | str) -> DirectForm:
        """Return the form itself, which holds no tensor."""
        return self


Form = DivergenceForm | DirectForm
#: The flows by name, as forms that can start at a field.
FORMS: dict[str, type[DivergenceForm] | type[DirectForm]] = {"h-1": DivergenceForm, "l2": DirectForm}


def white_noise(grid: Grid, seed: int) -> Float[torch.Tensor, "3 z y x"]:
    """Return A₀, independent and uniform on [0, `AMPLITUDE`) in every voxel and component; float32, on the processor.

    The same seed and shape give the same numbers. In a box with walls the mean is subtracted: a constant A has no
    divergence in a periodic box, but has a flux through walls. Raises ValueError if the seed is not a whole number from
    0, or the box does not fit into memory.
    """
    check_type(grid, Grid, "a Grid")
    generator = torch.Generator().manual_seed(check_seed(seed))
    check_memory((*grid.shape, 3), FIELD, "a box")
    noise = torch.rand((3, *grid.shape), generator=generator, dtype=torch.float32).mul_(AMPLITUDE)
    return noise if grid.periodic else noise.sub_(AMPLITUDE / 2)
