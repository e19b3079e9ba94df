"""F_ε of predicted probabilities in a window of a larger volume: the function behind the training loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from curvafit.priors.coefficients import NAMES, POWERS, Coefficients, check_strength
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.differentiable import areas, energies
from curvafit.priors.law import Law, texture_of
from curvafit.priors.refined import refined
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import gaussian_blur

#: Voxels that ε spans: an axis with fewer, by more than a tenth, is interpolated.
RESOLVED = 2
#: How many times an axis is refined at most.
MOST = 16
#: Voxels that ε spans at most, of the smallest edge: no window has more.
COARSEST = 10_000


def curvature_prior(
    probability: Float[Tensor, "batch z y x"],
    law: Law,
    spacing: tuple[float, float, float],
    epsilon: float,
    *,
    mask: Float[Tensor, "#batch z y x"] | None = None,
    normalize: Literal["voxel", "area"] | None = "voxel",
    border: int = 1,
    blur: float = 0.0,
) -> Float[Tensor, " batch"]:
    """F_ε(2p - 1) of probabilities in a window of a larger volume (eq. `Feps`), by fused kernels in float32.

    Parameters
    ----------
    probability
        In [0, 1], float32 or float64 (the definition, for tests).
    law
        Coefficients in spacing's unit, or another law, as `CurvaturePrior` takes it.
    epsilon, blur
        ε, and the standard deviation of a Gaussian that is applied first, in spacing's unit.
    spacing
        Voxel edges (z, y, x). An axis with fewer than two voxels to ε is interpolated (cubic) until it has two;
        up to a tenth less is left as it is.
    mask
        Weights of the energy's density.
    normalize
        `"voxel"`: the mean density over the mask, in units of ε (F_ε ε³ / volume). `"area"`: per interface
        area in units of ε (F_ε ε² / (∫ ε|∇u|² + ε²)), that is the mean of p(κ1, κ2) ε². None: F_ε itself.
    border
        Voxels at each side of the window, whose density is left out.

    Raises
    ------
    ValueError
        If the window is too small for its border, ε or the blur is longer than the window's longest side, a coefficient
        is over `STRONGEST` with lengths in units of ε, or as `upsampling`.
    """
    shape = tuple(probability.shape[1:])
    if min(shape) < max(4, 2 * border + 1):
        least = max(4, 2 * border + 1)
        raise ValueError(f"expected a volume of at least {least} voxels along each axis, got {shape}: it has no inside")
    times = upsampling(spacing, epsilon)
    coefficients = texture_of(law).in_unit(None, min(spacing))
    check_numbers(coefficients, epsilon)
    check_lengths(epsilon, blur, max(n * h for n, h in zip(shape, spacing, strict=True)))
    unit = epsilon / WORKING_EPSILON
    u, weights = 2 * probability - 1, _window(probability, mask, border)
    for axis, n in enumerate(times):
        u, weights = refined(u, axis, n), weights.repeat_interleave(n, axis - 3) if n > 1 else weights
    grid = Grid(tuple(u.shape[1:]), tuple(h / n / unit for h, n in zip(spacing, times, strict=True)), "replicate")  # type: ignore[arg-type]
    if blur:
        u = gaussian_blur(u, grid, blur / unit)
    total = energies(u, coefficients.in_unit(unit), grid, WORKING_EPSILON, weights)
    if normalize == "voxel":
        volume = weights.sum((-3, -2, -1)) * (grid.voxel_volume / WORKING_EPSILON**3)
        return total / volume.clamp_min(torch.finfo(volume.dtype).tiny)
    if normalize == "area":
        return total / (areas(u, grid, WORKING_EPSILON, weights) / WORKING_EPSILON**2 + 1)
    return total


def upsampling(spacing: Sequence[float], epsilon: float) -> tuple[int, int, int]:
    """How many times each axis is refined for ε to span two voxels; not at all where it lacks a tenth of that.

    Raises
    ------
    ValueError
        If an axis would be refined more than 16-fold, or ε spans more than `COARSEST` voxels.
    """
    if not 0 < epsilon <= COARSEST * min(spacing):
        most = COARSEST * min(spacing)
        raise ValueError(
            f"expected an ε above 0 and of at most {most:g} for voxels of {tuple(spacing)}, got {epsilon:g}"
        )
    ratios = [RESOLVED * h / epsilon for h in spacing]
    times = tuple(1 if ratio <= 1.1 else math.ceil(ratio - 1e-3) for ratio in ratios)
    if max(times) > MOST:
        least = RESOLVED * max(spacing) / MOST
        raise ValueError(
            f"expected an ε of at least {least:g} for voxels of {tuple(spacing)}, got {epsilon:g}, for which an axis "
            f"is refined {max(times)}-fold: give ε in spacing's unit, or coarser"
        )
    return times  # type: ignore[return-value]


def check_numbers(coefficients: Coefficients, epsilon: float) -> None:
    """Refuse coefficients whose products with ε and with differences float32 does not hold.

    Raises
    ------
    ValueError
        If one is over `STRONGEST` with lengths in units of ε.
    """
    for name, value in zip(NAMES, coefficients, strict=True):
        check_strength(name, value, POWERS[name], epsilon)


def check_lengths(epsilon: float, blur: float, longest: float) -> None:
    """Refuse lengths beyond a window: a surface as thick as it, or a field blurred to its mean, costs nothing.

    Raises
    ------
    ValueError
        If ε or the blur is over the window's longest side.
    """
    for name, length in (("an ε", epsilon), ("a blur", blur)):
        if not 0 <= length <= longest:
            raise ValueError(f"expected {name} of at most the window's longest side, {longest:g}, got {length:g}")


def _window(probability: Tensor, mask: Tensor | None, border: int) -> Tensor:
    """The mask, zero at the border; `(1 or batch, z, y, x)`."""
    inside = probability.new_zeros(probability.shape[1:])
    z, y, x = (slice(border, n - border) for n in inside.shape)
    inside[z, y, x] = 1
    return inside[None] if mask is None else inside * mask.to(inside)
