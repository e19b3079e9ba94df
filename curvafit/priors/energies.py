"""F_ε, its gradient, and related energies. `energy` is the definition in plain torch, against which the fused kernels
are tested; `energy_gradient` takes a kernel where there is one.

Every energy is a sum over voxels times the voxel's volume. Fields are `(..., Z, Y, X)`; results drop the space axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from curvafit.core.checks import as_tuple, check_float, quoted
from curvafit.priors import kernels
from curvafit.priors.curvature import Jet, jet, second_form
from curvafit.priors.grid import Float, Grid
from curvafit.priors.profile import double_well
from curvafit.priors.stencils import gradient, gradient_adjoint


def energy(
    u: Float[Tensor, "*batch z y x"],
    coefficients: Iterable[float | Tensor],
    grid: Grid,
    epsilon: float,
    orientation: Float[Tensor, "3 3"] | None = None,
    mask: Tensor | None = None,
) -> Float[Tensor, "*batch"]:
    """Return F_ε(u) (paper, eq. 20), differentiable in the field and in the coefficients.

    Parameters
    ----------
    u
        Phase field, about +1 inside and -1 outside.
    coefficients
        `Coefficients`, or six numbers, or tensors that broadcast with `u` (`(batch, 1, 1, 1)` for one set per field).
    grid, epsilon
        The sampling, and the interface parameter in spacing's unit.
    orientation
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x; see `orientation`.
    mask
        Weights of the density, which broadcast with `u`.
    """
    field = jet(u, grid)
    terms = energy_terms(field, epsilon).unbind(-4)
    weighted = (_match_field(a, u) * term for a, term in zip(coefficients, terms, strict=True))
    per_voxel = sum(weighted, start=torch.zeros_like(u))
    if orientation is not None:
        per_voxel = per_voxel + epsilon * orientation_form(field.gradient, orientation)
    if mask is not None:
        per_voxel = per_voxel * mask.to(u)
    return per_voxel.sum((-3, -2, -1)) * grid.voxel_volume


def energy_gradient(
    u: Tensor,
    coefficients: Iterable[float | Tensor],
    grid: Grid,
    epsilon: float,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return F_ε(u) of a field `(Z, Y, X)` (paper, eq. 20) and its gradient ∂F_ε/∂u in every voxel, `(Z, Y, X)`.

    Float32 on a processor takes the fused kernel, where numba is installed; all else takes autograd. The parameters are
    those of `energy`. The gradient is that of the sum over voxels, so it is proportional to the voxel's volume.
    """
    if u.dtype != torch.float32 or not kernels.has_kernel(u.device):
        return energy_gradient_by_autograd(u, coefficients, grid, epsilon, orientation, mask)
    parts = [
        kernels.energy_gradient(u, numbers, grid, epsilon, weights)
        for numbers, weights in _split_cost(tuple(coefficients), mask)
    ]
    if orientation is not None:
        parts.append(_orientation_gradient(u, grid, epsilon, orientation, mask))
    values, gradients = zip(*parts, strict=True)
    return torch.stack(values).sum(), sum(gradients[1:], start=gradients[0])  # type: ignore[return-value]


def _split_cost(a: tuple[float | Tensor, ...], mask: Tensor | None) -> list[tuple[list[float], Tensor | None]]:
    """Return six numbers and a mask for each part of F_ε, which is linear in its coefficients: those that are numbers,
    and for each one that varies a 1 in its place, with the coefficient as the mask."""
    fields = {k: value for k, value in enumerate(a) if isinstance(value, Tensor) and value.dim() > 0}
    numbers = [0.0 if k in fields else float(value) for k, value in enumerate(a)]
    parts = [(numbers, mask)] if any(numbers) or not fields else []
    for k, field in fields.items():
        parts.append(([float(k == place) for place in range(6)], field if mask is None else field * mask))
    return parts


def _orientation_gradient(
    u: Tensor, grid: Grid, epsilon: float, orientation: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return ε ∫ ∇uᵀQ∇u and its gradient."""
    u = u.detach()
    slope, weight = gradient(u, grid), epsilon * grid.voxel_volume * (1 if mask is None else mask.to(u))
    value = (weight * orientation_form(slope, orientation)).sum(dtype=torch.float64)
    force = torch.einsum("ij,jzyx->izyx", orientation.to(u), slope)
    return value, gradient_adjoint(2 * weight * force, grid)


def energy_gradient_by_autograd(u: Tensor, *cost: Any) -> tuple[Tensor, Tensor]:
    """Return F_ε of fields `(..., Z, Y, X)` and its gradients in plain torch, on any device.

    `cost` are the other arguments of `energy`.
    """
    leaf = u.detach().requires_grad_()
    with torch.enable_grad():
        values = energy(leaf, *cost)
        (gradients,) = torch.autograd.grad(values.sum(), leaf)
    return values.detach(), gradients


def orientation(direction: Sequence[int | float] | Tensor, strength: int | float) -> Float[Tensor, "3 3"]:
    """Return Q = μ θθᵀ, which turns normals away from θ: tubes run along θ and layers contain it (paper, "Extensions").

    The direction θ (z, y, x) has any length above 0; where the strength μ is negative, normals turn towards θ. Q is
    symmetric `(3, 3)`, float64; a sum of orientations is an orientation too.
    """
    expected = "a direction of 3 finite numbers (z, y, x), not all 0"
    components = [check_float(component, expected, of=direction) for component in as_tuple(direction, expected, 3)]
    θ = torch.tensor(components, dtype=torch.float64)
    if not bool(θ.any()):
        raise ValueError(f"expected {expected}, got {quoted(direction)}")
    strength = check_float(strength, "a finite strength")
    _, exponent = math.frexp(float(θ.abs().max()))
    θ = θ * 2.0**-exponent  # a power of two: exact, and the squares in the norm are finite
    θ = θ / θ.norm()
    return strength * torch.outer(θ, θ)


def orientation_form(slope: Float[Tensor, "*batch 3 z y x"], orientation: Float[Tensor, "3 3"]) -> Tensor:
    """Return ∇uᵀQ∇u in every voxel, which is μ (θ·∇u)² for Q = μ θθᵀ (paper, "Extensions")."""
    Q = orientation.to(slope)
    if tuple(Q.shape) != (3, 3) or not torch.equal(Q, Q.T):
        raise ValueError(f"expected a symmetric orientation of shape (3, 3) (z, y, x), got {orientation.tolist()}")
    return torch.einsum("ij,...izyx,...jzyx->...zyx", Q, slope, slope)


def energy_terms(field: Jet, epsilon: float) -> Float[Tensor, "*batch 6 z y x"]:
    """Return the six densities, stacked on axis -4, that a20, a11, a02, a10, a01 and a00 multiply in F_ε (eq. 20).

    With R = √(2|M|² - (Tr M)²)⁺, the density of κ1² is (|M|² + R Tr M)/2ε and that of κ2² (|M|² - R Tr M)/2ε, since
    κ1, κ2 = (Tr M ± R)/2ε|∇u| (eqs. 17 and 18).
    """
    ε = epsilon
    trace, norm2, root, slope = second_form(field, ε)
    slope2 = field.gradient.square().sum(-4)
    even, odd = norm2 / (2 * ε), trace * root / (2 * ε)  # symmetric and antisymmetric in κ1, κ2
    terms = (
        even + odd,
        (trace**2 - norm2) / (2 * ε),
        even - odd,
        slope * (trace + root) / 2,
        slope * (trace - root) / 2,
        ε * slope2,
    )
    return torch.stack(terms, -4)


def cahn_hilliard_area(u: Tensor, grid: Grid, epsilon: float) -> Tensor:
    """Return 𝓐_ε(u) = ∫ ε/2 |∇u|² + W(u)/ε, about σ × area (paper, eq. 8)."""
    gradient_part, well_part = cahn_hilliard_parts(u, grid, epsilon)
    return (gradient_part + well_part).sum((-3, -2, -1)) * grid.voxel_volume


def cahn_hilliard_parts(u: Tensor, grid: Grid, epsilon: float) -> tuple[Tensor, Tensor]:
    """Return ε/2 |∇u|² and W(u)/ε in every voxel."""
    slope2 = gradient(u, grid).square().sum(-4)
    return epsilon / 2 * slope2, double_well(u) / epsilon


def _match_field(value: float | Tensor, u: Tensor) -> float | Tensor:
    """Return a number unchanged, or a tensor in the field's type and on the field's device."""
    return value.to(u) if isinstance(value, Tensor) else value
