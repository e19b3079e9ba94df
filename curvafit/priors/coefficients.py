"""The six coefficients of the curvature polynomial, and the ways to state them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.core.checks import check_float, check_positive, quoted

#: Names in the paper's order: κ1², κ1κ2, κ2², κ1, κ2, 1.
NAMES = ("a20", "a11", "a02", "a10", "a01", "a00")
#: Powers of length in their units.
POWERS = dict(zip(NAMES, (0, 0, 0, 1, 1, 2), strict=True))
#: The greatest coefficient, with lengths in units of ε, at which float32 holds the energy of noise and its gradient;
#: published ones are below 15.
STRONGEST = 1e6


@dataclass(frozen=True)
class Coefficients:
    """p(κ1, κ2) = a20 κ1² + a11 κ1κ2 + a02 κ2² + a10 κ1 + a01 κ2 + a00 with κ1 ≥ κ2 (paper, eq. 6).

    The values are numbers, or tensors that broadcast with the voxels (coefficients that vary in space or over a batch).
    Lengths are in the unit of the grid's spacing; the published values are in working units (spacing 0.01).

    Warns where a20 ≤ 0 or a02 ≤ 0, for which F_ε is not bounded below; raises ValueError where a coefficient is not
    finite.
    """

    a20: float | Tensor
    a11: float | Tensor
    a02: float | Tensor
    a10: float | Tensor = 0.0
    a01: float | Tensor = 0.0
    a00: float | Tensor = 0.0

    def __post_init__(self) -> None:
        for name in NAMES:
            value = getattr(self, name)
            if not isinstance(value, Tensor):
                object.__setattr__(self, name, check_float(value, f"a finite coefficient {name}"))
            elif value.is_complex() or not bool(torch.isfinite(value).all()):
                got = "values that are not finite" if value.dim() > 0 else quoted(value.item())
                raise ValueError(f"expected a finite coefficient {name}, got {got}")
        a20, a02 = (float(torch.as_tensor(a, dtype=torch.float64).detach().min()) for a in (self.a20, self.a02))
        if min(a20, a02) <= 0:
            warnings.warn(
                f"a20 > 0 and a02 > 0 keep the energy bounded below, got least a20 = {a20:g}, a02 = {a02:g}",
                stacklevel=3,
            )

    def __iter__(self):
        return (getattr(self, name) for name in NAMES)

    def polynomial(self, kappa1, kappa2):
        """Return p(κ1, κ2), elementwise."""
        quadratic = self.a20 * kappa1**2 + self.a11 * kappa1 * kappa2 + self.a02 * kappa2**2
        return quadratic + self.a10 * kappa1 + self.a01 * kappa2 + self.a00

    def scale(self, factor: float) -> Coefficients:
        """Return all six coefficients times a positive factor; the energy keeps its minimisers."""
        return Coefficients(*(factor * value for value in self))

    def in_unit(self, unit: float) -> Coefficients:
        """Return the coefficients of the same energy with lengths in multiples of `unit`, a length in the old unit.

        The linear part is multiplied by `unit`, the constant one by its square. Working units become physical ones by
        `in_unit(0.01 / working voxel)`.
        """
        unit = check_positive(unit, "a positive length unit")
        a20, a11, a02, a10, a01, a00 = self
        return Coefficients(a20, a11, a02, a10 * unit, a01 * unit, a00 * unit**2)

    def mirror(self) -> Coefficients:
        """Exchange inside and outside: return a' with F_ε[-u; a] = F_ε[u; a'], where (κ1, κ2) becomes (-κ2, -κ1)."""
        a20, a11, a02, a10, a01, a00 = self
        return Coefficients(a02, a11, a20, -a01, -a10, a00)

    @classmethod
    def from_b(cls, h2, H0, k1, alpha, kappa1, beta, kappa2) -> Coefficients:
        """Expand h2 (H - H0)² + k1 K + α (κ1 - κ1⁰)² + β (κ2 - κ2⁰)² (paper, eq. 26)."""
        return cls(
            h2 + alpha,
            2 * h2 + k1,
            h2 + beta,
            -2 * h2 * H0 - 2 * alpha * kappa1,
            -2 * h2 * H0 - 2 * beta * kappa2,
            h2 * H0**2 + alpha * kappa1**2 + beta * kappa2**2,
        )

    @classmethod
    def helfrich(cls, bending: float, gaussian: float = 0.0, spontaneous: float = 0.0) -> Coefficients:
        """Return Helfrich's χ_b/2 (H - H0)² + χ_G K with H = κ1 + κ2 (paper, eq. 3)."""
        return cls.from_b(bending / 2, spontaneous, gaussian, 0, 0, 0, 0)

    @classmethod
    def willmore(cls) -> Coefficients:
        """Return Willmore's H² (paper, eq. 5)."""
        return cls(1, 2, 1)

    def as_dict(self) -> dict[str, float]:
        """Return numbers by name, of coefficients that do not vary in space."""
        return {name: float(value) for name, value in zip(NAMES, self, strict=True)}


def check_strengths(coefficients: Iterable[float | Tensor], epsilon: float, orientation: Tensor | None = None) -> None:
    """Raise ValueError where a coefficient, or the orientation, exceeds `STRONGEST` with lengths in units of ε."""
    terms = [(name, value, POWERS[name]) for name, value in zip(NAMES, coefficients, strict=True)]
    if orientation is not None:
        terms.append(("the orientation", orientation, POWERS["a00"]))
    for name, value, power in terms:
        most = float(value.detach().abs().max()) if isinstance(value, Tensor) else abs(value)
        strength = most * epsilon**power
        if not strength <= STRONGEST:
            unit = {0: "", 1: " epsilon", 2: " epsilon²"}[power]
            raise ValueError(f"expected |{name}|{unit} of at most {STRONGEST:g}, got {strength:.3g}")
