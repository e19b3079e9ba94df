"""What the flow moves, in place of the field itself."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import divergence, gaussian_blur


@dataclass(frozen=True)
class DivergenceForm:
    """u = k ∗ (div A + base): the mass is the base's, whatever A (paper, Algorithm 1; H⁻¹ flow).

    Parameters
    ----------
    grid, width
        The sampling, and the standard deviation of k in spacing's unit.
    base
        k ∗ base: the mass m₀, or a field `(Z, Y, X)` already blurred.
    """

    grid: Grid
    width: float
    base: float | Tensor

    @classmethod
    def of(cls, grid: Grid, width: float, base: float | Float[Tensor, "z y x"]) -> DivergenceForm:
        """From a base that is not blurred yet."""
        return cls(grid, width, gaussian_blur(base, grid, width) if isinstance(base, Tensor) else float(base))

    def field(self, vector: Float[Tensor, "3 z y x"]) -> Float[Tensor, "z y x"]:
        """u of A."""
        return gaussian_blur(divergence(vector, self.grid), self.grid, self.width) + self.base

    @property
    def mass(self) -> float:
        """The mean that u keeps."""
        return float(self.base.double().mean()) if isinstance(self.base, torch.Tensor) else self.base
