"""F_ε, its gradient, and related energies. `energy` is the definition in plain torch, against which the fused kernels
are tested; `energy_gradient` takes a kernel where there is one.

Every energy is a sum over voxels times the voxel's volume. Fields are `(..., Z, Y, X)`; results drop the space axes.
"""

from __future__ import annotations

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
    orientation: Float[Tensor, "3 3 *zyx"] | None = None,
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
        Q of a further term ε ∫ ∇uᵀQ∇u, symmetric, axes z, y, x, or one for each voxel; see `orientation`.
    mask
        Weights of the density, which broadcast with `u`.
    """
    field = jet(u, grid)
    terms = energy_terms(field, epsilon).unbind(-4)
    maps = (a.to(u) if isinstance(a, Tensor) else a for a in coefficients)
    weighted = (a * term for a, term in zip(maps, terms, strict=True))
    per_voxel = sum(weighted, start=torch.zeros_like(u))
    if orientation is not None:
        check_orientation(orientation)
        force = turn_slope(field.gradient, orientation)
        per_voxel = per_voxel + epsilon * (force * field.gradient).sum(-4)
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
    check_orientation(orientation)
    slope, weight = gradient(u.detach(), grid), epsilon * grid.voxel_volume * (1 if mask is None else mask.to(u))
    force = weight * turn_slope(slope, orientation)
    return (force * slope).sum(dtype=torch.float64), gradient_adjoint(2 * force, grid)


def energy_gradient_by_autograd(u: Tensor, *cost: Any) -> tuple[Tensor, Tensor]:
    """Return F_ε of fields `(..., Z, Y, X)` and its gradients in plain torch, on any device.

    `cost` are the other arguments of `energy`.
    """
    leaf = u.detach().requires_grad_()
    with torch.enable_grad():
        values = energy(leaf, *cost)
        (gradients,) = torch.autograd.grad(values.sum(), leaf)
    return values.detach(), gradients


def orientation(
    direction: Sequence[int | float | Tensor] | Tensor, strength: int | float | Tensor
) -> Float[Tensor, "3 3 *zyx"]:
    """Return Q = μ θθᵀ, which turns normals away from θ: tubes run along θ and layers contain it (paper, "Extensions").

    The direction θ (z, y, x) has any length above 0; where the strength μ is negative, normals turn towards θ. Q is
    symmetric `(3, 3)`, float64; a sum of orientations is an orientation too. Components of θ, or μ, that are tensors
    `(Z, Y, X)` vary in space, and Q is then `(3, 3, Z, Y, X)`, a matrix for each voxel.

    Raises ValueError where a number is not finite, or θ is 0 somewhere: there μ is to be 0, with any θ.
    """
    expected = "a direction of 3 finite numbers (z, y, x), not all 0"
    components = [_as_finite(component, expected, of=direction) for component in as_tuple(direction, expected, 3)]
    components.append(_as_finite(strength, "a finite strength"))
    shapes = {tuple(component.shape) for component in components if component.dim()}
    if len(shapes) > 1:
        raise ValueError(f"expected maps of direction and strength of one shape, got {quoted(sorted(shapes))}")
    *components, μ = torch.broadcast_tensors(*components)
    θ = torch.stack(components)
    if not bool(θ.any(0).all()):
        raise ValueError(f"expected {expected}, got {quoted(direction)}")
    _, exponent = torch.frexp(θ.abs().amax(0))
    θ = torch.ldexp(θ, -exponent)  # by powers of two: exact, and the squares in the norm are finite
    θ = θ / θ.square().sum(0).sqrt()
    return μ * (θ[:, None] * θ[None])


def check_orientation(orientation: object) -> None:
    """Raise ValueError where an orientation is no symmetric tensor `(3, 3)` or `(3, 3, Z, Y, X)`."""
    Q = orientation if isinstance(orientation, Tensor) else torch.empty(0)
    if Q.shape[:2] != (3, 3) or Q.dim() not in (2, 5) or not torch.equal(Q, Q.transpose(0, 1)):
        expected = "the orientation as a symmetric tensor of shape (3, 3) or (3, 3, Z, Y, X), axes z, y, x"
        raise ValueError(f"expected {expected}, got {quoted(Q.tolist() if Q.dim() == 2 else orientation)}")


def turn_slope(slope: Float[Tensor, "*batch 3 z y x"], orientation: Float[Tensor, "3 3 *zyx"]) -> Tensor:
    """Return Q∇u in every voxel: its product with ∇u is μ (θ·∇u)² for Q = μ θθᵀ (paper, "Extensions")."""
    Q = orientation.to(slope)
    columns = (Q if Q.dim() > 2 else Q[..., None, None, None]).unbind(1)
    return sum(column * part.unsqueeze(-4) for column, part in zip(columns, slope.unbind(-4), strict=True))  # type: ignore[return-value]


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


def _as_finite(value: Any, expected: str, of: Any = None) -> Tensor:
    """Return a number, or a tensor of finite numbers, in float64; `of` is quoted where it is not."""
    if not isinstance(value, Tensor) or value.dim() != 3:
        return torch.tensor(check_float(value, expected, of=of), dtype=torch.float64)
    if value.is_complex() or not bool(torch.isfinite(value).all()):
        raise ValueError(f"expected {expected}, got values that are not finite")
    return value.double()
