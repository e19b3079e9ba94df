"""The double well, its optimal profile, and the maps between mask, signed distance and phase field."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from curvafit.priors.grid import Bool, Float, Grid
from curvafit.priors.stencils import gaussian_blur, refine_axis

#: σ = ∫ √(2W) over [-1, 1] = 4 / (3√2): what a unit of area costs in the limit ε → 0.
SIGMA = 4 / (3 * math.sqrt(2))

#: By how much a phase field is scaled before its distance is taken, which is infinite at ±1.
SHRINK = 0.88
#: Deviation, in voxels, of the Gaussian that smooths a mask's stairs.
STAIRS = 2.0
#: Number, strength and width (voxels) of the corrections where the smoothing changed the sign.
SWEEPS, PULL, PULL_WIDTH = 8, 8.0, 1.5


def double_well(u: Tensor) -> Tensor:
    """Return W(u) = (1 - u²)² / 4."""
    return (1 - u**2) ** 2 / 4


def double_well_derivative(u: Tensor) -> Tensor:
    """Return W'(u) = u³ - u."""
    return u**3 - u


def optimal_profile(distance: Tensor, epsilon: float) -> Tensor:
    """Return tanh(d / √2 ε) of a signed distance d, positive inside (paper, eq. 19)."""
    return torch.tanh(distance / (math.sqrt(2) * epsilon))


def profile_distance(u: Tensor, epsilon: float, limit: float = 3.0) -> Tensor:
    """Return the signed distance √2 ε artanh(u), which `optimal_profile` maps to `u`, clipped to ±`limit`·√2 ε."""
    bound = math.tanh(limit)
    v = u.clamp(-bound, bound)
    return epsilon / math.sqrt(2) * (torch.log1p(v) - torch.log1p(-v))  # 2 artanh: logarithms are vectorised


def signed_distance(
    mask: Bool[Tensor, "*batch z y x"], grid: Grid, limit: float | None = None
) -> Float[Tensor, "*batch z y x"]:
    """Return the signed distance of every voxel's centre to the faces of `mask`, positive inside, in spacing's unit.

    The distance is exact for the set of voxels (faces, edges and corners) on anisotropic and periodic grids. It is cut
    at `limit`, with which the cost grows; where `limit` is None the whole box is searched. Raises ValueError where the
    mask is empty or full.
    """
    inside = mask.bool()
    if not inside.flatten(-3).any(-1).all() or inside.flatten(-3).all(-1).any():
        raise ValueError("expected a mask with voxels inside and outside, got an empty or a full one")
    cutoff = math.inf if limit is None else float(limit)
    return _measure_distance(~inside, grid, cutoff) - _measure_distance(inside, grid, cutoff)


def refine_profile(u: Tensor, times: tuple[Any, Any, Any]) -> Tensor:
    """Return a phase field `(..., Z, Y, X)` with every voxel along (z, y, x) split into so many; differentiable.

    A spline through the profile swings where slices are thicker than ε; one through its distance, artanh u, does not.
    """
    distance = torch.logit((1 + SHRINK * u.clamp(-1, 1)) / 2)  # 2 artanh; and 2σ - 1 is quicker than tanh
    for axis, n in enumerate(times):
        distance = refine_axis(distance, axis, n)
    return (2 * torch.sigmoid(distance) - 1) / SHRINK


def phase_field(mask: Bool[Tensor, "*batch z y x"], grid: Grid, epsilon: float) -> Float[Tensor, "*batch z y x"]:
    """Return a mask's phase field: the optimal profile of the signed distance, without the voxels' stairs.

    The stairs are smoothed by 1 - (1 - G)² = 2G - G∗G, where G is a Gaussian of `STAIRS` voxels along each axis. The
    second moments of 2G - G∗G vanish, so that planes stay exact and a sphere or cylinder of radius R moves by O(σ⁴/R³),
    not by σ²/R. Smooth corrections then restore voxels whose sign changed, at thin places. Only the zero level is
    accurate: across tilted faces, whose voxels overhang, distances are up to a fifth short, about as much as the
    profiles of generated shapes are wider than tanh. Raises ValueError where the mask is empty or full.
    """
    limit = 6 * epsilon + math.ceil(4 * STAIRS) * max(grid.spacing)  # tanh is ±1 to 4e-4, and a blur's radius
    voxel_grid = Grid(grid.shape, (1.0, 1.0, 1.0), grid.boundary)
    smoothed = gaussian_blur(signed_distance(mask, grid, limit), voxel_grid, STAIRS)
    distance = 2 * smoothed - gaussian_blur(smoothed, voxel_grid, STAIRS)
    return optimal_profile(_restore_signs(distance, mask.bool(), voxel_grid), epsilon)


def _restore_signs(distance: Tensor, mask: Tensor, voxel_grid: Grid) -> Tensor:
    """Add Gaussians where the sign differs from the mask's; a sweep lowers a single voxel's error by a seventh."""
    for _ in range(SWEEPS):
        error = torch.where(mask, distance.clamp_max(0), distance.clamp_min(0))
        if not bool(error.any()):
            break
        distance = distance - PULL * gaussian_blur(error, voxel_grid, PULL_WIDTH)
    return distance


def _measure_distance(target: Tensor, grid: Grid, cutoff: float) -> Tensor:
    """Return the distance from every voxel's centre to the faces of the voxels in `target`, cut at `cutoff`.

    The squared distance is a minimum over one axis after the other; k steps away along it, a face is (k - ½) Δx away.
    """
    dtype = torch.float64 if torch.get_default_dtype() == torch.float64 else torch.float32
    squared = torch.where(target, 0.0, math.inf).to(dtype)
    for axis, h in enumerate(grid.spacing):
        n = grid.shape[axis]
        longest = n // 2 if grid.periodic else n - 1
        steps = min(longest, math.ceil(cutoff / h + 0.5)) if math.isfinite(cutoff) else longest
        source, squared = squared, squared.clone()
        for k in range(1, steps + 1):
            cost = ((k - 0.5) * h) ** 2
            for offset in (k, -k):
                _lower(squared, source, cost, offset, axis - 3, grid.periodic)
    return squared.sqrt().clamp(max=cutoff)


def _lower(squared: Tensor, source: Tensor, cost: float, offset: int, dim: int, periodic: bool) -> None:
    """Set squared[i] = min(squared[i], source[i + offset] + cost), in place."""
    if periodic:
        torch.minimum(squared, source.roll(-offset, dim) + cost, out=squared)
        return
    n = squared.shape[dim] - abs(offset)
    target = squared.narrow(dim, max(0, -offset), n)
    torch.minimum(target, source.narrow(dim, max(0, offset), n) + cost, out=target)
