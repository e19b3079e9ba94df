"""What a flow moves, in place of the field itself: linear maps from parameters to fields, each beside its adjoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

#: k ∗ field, given its grid and standard deviation.
Blur = Callable[[Tensor, Grid, float], Tensor]


class Form(Protocol):
    """A field as an affine function of parameters."""

    @property
    def grid(self) -> Grid: ...

    def field(self, parameters: Tensor, /) -> Tensor:
        """u, `(Z, Y, X)`."""
        ...

    def pullback(self, slope: Tensor, /) -> Tensor:
        """The gradient with respect to the parameters, of one with respect to u."""
        ...

    def to(self, device: torch.device | str) -> Form:
        """The same on a device."""
        ...


@dataclass(frozen=True)
class DivergenceForm:
    """u = k ∗ (div A + base): the mass is the base's, whatever A (paper, Algorithm 1; H⁻¹ flow).

    Parameters
    ----------
    grid, width
        The sampling, and the standard deviation of k in spacing's unit.
    base
        k ∗ base: the mass m₀, or a field `(Z, Y, X)` already blurred.
    blur
        How to blur; plain torch, if not said otherwise.
    """

    grid: Grid
    width: float
    base: float | Tensor
    blur: Blur = gaussian_blur

    @classmethod
    def of(
        cls, grid: Grid, width: float, base: float | Float[Tensor, "z y x"], blur: Blur = gaussian_blur
    ) -> DivergenceForm:
        """From a base that is not blurred yet."""
        return cls(grid, width, blur(base, grid, width) if isinstance(base, Tensor) else float(base), blur)

    @classmethod
    def at(cls, field: Tensor, grid: Grid, width: float, blur: Blur) -> tuple[DivergenceForm, Tensor]:
        """The form and its start A = 0 for u = k ∗ field."""
        return cls.of(grid, width, field, blur), field.new_zeros((3, *grid.shape))

    def field(self, vector: Float[Tensor, "3 z y x"]) -> Float[Tensor, "z y x"]:
        """u of A."""
        return self.blur(divergence(vector, self.grid), self.grid, self.width) + self.base

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
        """-∇(k ∗ slope): the blur is its own adjoint, and div = -∇ᵀ."""
        return -gradient(self.blur(slope, self.grid, self.width), self.grid)

    def to(self, device: torch.device | str) -> DivergenceForm:
        """The same on a device."""
        return dataclasses.replace(self, base=self.base.to(device)) if isinstance(self.base, Tensor) else self

    @property
    def mass(self) -> float:
        """The mean that u keeps."""
        return float(self.base.double().mean()) if isinstance(self.base, torch.Tensor) else self.base


@dataclass(frozen=True)
class DirectForm:
    """u = k ∗ v: nothing is kept (paper, Algorithm 2; L² flow).

    Algorithm 2 blurs u anew at each iteration, then steps along the gradient there; here the blur is part of the map,
    so that what is minimised, F_ε(k ∗ v), is one function, as a line search needs.
    """

    grid: Grid
    width: float
    blur: Blur = gaussian_blur

    @classmethod
    def at(cls, field: Tensor, grid: Grid, width: float, blur: Blur) -> tuple[DirectForm, Tensor]:
        """The form and its start v = field."""
        return cls(grid, width, blur), field

    def field(self, values: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """u of v."""
        return self.blur(values, self.grid, self.width)

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """k ∗ slope."""
        return self.blur(slope, self.grid, self.width)

    def to(self, device: torch.device | str) -> DirectForm:
        """Itself: it holds no tensor."""
        return self


@dataclass(frozen=True)
class MassProjectedForm:
    """u = k ∗ (v - mean v) + mass: the L² flow on fields of that mass."""

    grid: Grid
    width: float
    mass: float
    blur: Blur = gaussian_blur

    @classmethod
    def at(cls, field: Tensor, grid: Grid, width: float, blur: Blur) -> tuple[MassProjectedForm, Tensor]:
        """The form and its start v = field, whose mass is kept."""
        return cls(grid, width, float(field.mean(dtype=torch.float64)), blur), field

    def field(self, values: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """u of v."""
        return self.blur(_centred(values), self.grid, self.width) + self.mass

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """k ∗ slope, less its mean."""
        return _centred(self.blur(slope, self.grid, self.width))

    def to(self, device: torch.device | str) -> MassProjectedForm:
        """Itself: it holds no tensor."""
        return self


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(dtype=torch.float64).to(values.dtype)


#: The flows by name, as forms that can start at a field.
FORMS: dict[str, type[DivergenceForm] | type[DirectForm] | type[MassProjectedForm]] = {
    "h-1": DivergenceForm,
    "l2": DirectForm,
    "mass": MassProjectedForm,
}
