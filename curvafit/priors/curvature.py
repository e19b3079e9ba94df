"""Curvatures of a field's level sets: the paper's diffuse ones, from M_ε, and the geometric ones, from Hess u.

Both take a field with its gradient and Hessian (as `stencils` stores them), so that they serve any discretisation and
exact derivatives alike. Signs: κ1 ≥ κ2, positive where the phase u > 0 is convex.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from curvafit.priors.grid import Grid
from curvafit.priors.profile import double_well_derivative
from curvafit.priors.stencils import gradient, hessian

#: Offset ξ of the gradient's norm (paper, "Implementation details").
XI = 1e-6
#: Least value under the square root.
ROOT_FLOOR = 1e-6
#: Share of the squares in the root's difference that sixteen roundings of float32 leave undecided.
ROOT_ROUNDING = 2.0**-19


class Jet(NamedTuple):
    """A field `(..., Z, Y, X)` with its gradient `(..., 3, Z, Y, X)` and Hessian `(..., 6, Z, Y, X)`."""

    value: Tensor
    gradient: Tensor
    hessian: Tensor


class SecondForm(NamedTuple):
    """Invariants of M_ε that F_ε needs: Tr M, |M|², √(2|M|² - (Tr M)²)⁺, and |∇u|."""

    trace: Tensor
    norm2: Tensor
    root: Tensor
    slope: Tensor


class Curvatures(NamedTuple):
    """Principal curvatures κ1 ≥ κ2, their sum H, and K (κ1κ2 for geometric curvatures; κ1κ2 ≤ K for diffuse ones)."""

    kappa1: Tensor
    kappa2: Tensor
    mean: Tensor
    gauss: Tensor


def jet(u: Tensor, grid: Grid) -> Jet:
    """Return a field with its central differences."""
    return Jet(u, gradient(u, grid), hessian(u, grid))


def second_form(field: Jet, epsilon: float) -> SecondForm:
    """Return the invariants of M_ε = -ε Hess u + W'(u)/ε n⊗n (paper, eq. 7), where n⊗n = ∇u⊗∇u / (|∇u|² + ξ²).

    For the derivative of the root see `positive_root`.
    """
    ε = epsilon
    slope2, laplacian, hess2, normal = _invariants(field)
    W_ = double_well_derivative(field.value)
    length2 = slope2 + XI**2
    n2 = slope2 / length2  # |n|², below 1 where ∇u is small
    trace = -ε * laplacian + W_ / ε * n2
    bend2, well2 = ε**2 * hess2, (W_ / ε * n2) ** 2
    norm2 = bend2 - 2 * W_ * normal / length2 + well2
    root = positive_root(2 * norm2 - trace**2, bend2 + well2)
    return SecondForm(trace, norm2, root, length2.sqrt())


def positive_root(square: Tensor, squares: Tensor) -> Tensor:
    """Return √(x⁺) of a difference x of squares, with the derivative 0 where that of the root is unbounded.

    x = 0 at umbilics, κ1 = κ2, where √(x⁺) = ε|∇u| |κ1 - κ2| has the tip of a cone in the directions in which the two
    curvatures separate. Its subdifferential there holds slopes of either sign, and the element of least norm is 0: a
    step along it prefers no direction. The derivative is 0 wherever x cannot be distinguished from 0: up to
    `ROOT_FLOOR`, below which the root is constant, and up to the fraction `ROOT_ROUNDING` of the squares, which float32
    rounds away. That fraction holds for float64 too, so that both types have one gradient; the root itself is exact
    there. (The paper's smooth positive part, 1e-6 wide, ends about the floor; its slope was that of neither side.)

    `square` is x = 2|M|² - (Tr M)²; `squares` is the sum of the terms of |M|² before any of them cancels.
    """
    resolved = square > (ROOT_ROUNDING * squares).clamp_min(ROOT_FLOOR)
    return torch.where(resolved, square, square.detach().clamp_min(ROOT_FLOOR)).sqrt()


def diffuse_curvatures(field: Jet, epsilon: float) -> Curvatures:
    """Return κ1, κ2 = (Tr M ± √(2|M|² - (Tr M)²)⁺) / 2ε|∇u|, H and K (paper, eqs. 15 to 18)."""
    trace, norm2, root, slope = second_form(field, epsilon)
    denominator = 2 * epsilon * slope
    gauss = (trace**2 - norm2) / (2 * (epsilon * slope) ** 2)
    return Curvatures((trace + root) / denominator, (trace - root) / denominator, 2 * trace / denominator, gauss)


def geometric_curvatures(field: Jet) -> Curvatures:
    """Return the eigenvalues of the level sets' shape operator -P (Hess u) P / |∇u|, P = I - n⊗n, for any profile.

    H = -(Δu - nᵀHess u n) / |∇u| and K = ∇uᵀ adj(Hess u) ∇u / |∇u|⁴ (Goldman 2005).
    """
    slope2, laplacian, _, normal = _invariants(field)
    length2 = slope2 + XI**2
    mean = -(laplacian - normal / length2) / length2.sqrt()
    gauss = _adjugate_form(field) / length2**2
    root = (mean**2 - 4 * gauss).clamp_min(0).sqrt()
    return Curvatures((mean + root) / 2, (mean - root) / 2, mean, gauss)


def _invariants(field: Jet) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return |∇u|², Δu, |Hess u|² and ∇uᵀ Hess u ∇u."""
    gz, gy, gx = field.gradient.unbind(-4)
    zz, yy, xx, zy, zx, yx = field.hessian.unbind(-4)
    slope2 = gz**2 + gy**2 + gx**2
    hess2 = zz**2 + yy**2 + xx**2 + 2 * (zy**2 + zx**2 + yx**2)
    normal = gz * (gz * zz + 2 * (gy * zy + gx * zx)) + gy * (gy * yy + 2 * gx * yx) + gx**2 * xx
    return slope2, zz + yy + xx, hess2, normal


def _adjugate_form(field: Jet) -> Tensor:
    """Return ∇uᵀ adj(Hess u) ∇u."""
    gz, gy, gx = field.gradient.unbind(-4)
    zz, yy, xx, zy, zx, yx = field.hessian.unbind(-4)
    diagonal = gz**2 * (yy * xx - yx**2) + gy**2 * (zz * xx - zx**2) + gx**2 * (zz * yy - zy**2)
    cross = gz * gy * (zx * yx - zy * xx) + gz * gx * (zy * yx - zx * yy) + gy * gx * (zy * zx - zz * yx)
    return diagonal + 2 * cross
