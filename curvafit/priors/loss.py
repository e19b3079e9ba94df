"""The training loss as a function: F_ε of predicted probabilities in a window of a larger volume."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from curvafit.priors.coefficients import NAMES, POWERS, Coefficients, check_strength
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.kernels.differentiable import areas, energies
from curvafit.priors.law import Law, LawLike
from curvafit.priors.refined import refined
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import gaussian_blur

#: Voxels that ε spans: an axis with fewer, by more than a tenth, is interpolated.
RESOLVED = 2
#: The most that an axis is refined, as a factor.
MOST = 16
#: The most voxels of the smallest edge that ε spans: no window has more.
COARSEST = 10_000


def curvature_prior(
    probability: Float[Tensor, "batch z y x"],
    law: LawLike,
    spacing: tuple[float, float, float],
    epsilon: float,
    *,
    mask: Float[Tensor, "#batch z y x"] | None = None,
    normalize: Literal["voxel", "area"] | None = "voxel",
    border: int = 1,
    blur: float = 0.0,
) -> Float[Tensor, " batch"]:
    """Return F_ε(2p - 1) of probabilities in a window of a larger volume (eq. `Feps`), by fused kernels in float32.

    Parameters
    ----------
    probability
        Values in [0, 1]; float32, or float64, which takes the definition in plain torch.
    law
        Coefficients in spacing's unit, or another law, as in `CurvaturePrior`.
    epsilon, blur
        ε, and the standard deviation of a Gaussian blur of the field before the energy, in spacing's unit.
    spacing
        Voxel edges (z, y, x). An axis on which ε spans fewer than two voxels, by more than a tenth, is refined by cubic
        interpolation until it spans two.
    mask
        Weights of the energy's density.
    normalize
        `"voxel"`: the mean density over the mask, in units of ε (F_ε ε³ / volume). `"area"`: per interface
        area in units of ε (F_ε ε² / (∫ ε|∇u|² + ε²)), which is the mean of p(κ1, κ2) ε². None: F_ε itself.
    border
        Number of voxels at each side of the window whose density does not count.

    Raises
    ------
    ValueError
        If the window is too small for its border, ε or the blur is longer than the window's longest side, a coefficient
        is over `STRONGEST` with lengths in units of ε, or as `upsampling` does.
    """
    shape = tuple(probability.shape[1:])
    if min(shape) < max(4, 2 * border + 1):
        least = max(4, 2 * border + 1)
        raise ValueError(
            f"expected a volume of at least {least} voxels along each axis, got {shape}, which has no interior"
        )
    times = upsampling(spacing, epsilon)
    coefficients = Law.of(law).in_unit(None, min(spacing))
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
    """Return how many times finer each axis must be for ε to span two voxels; 1 where ε lacks at most a tenth of that.

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
            f"is refined {max(times)}-fold: state ε in spacing's unit, or a larger ε"
        )
    return times  # type: ignore[return-value]


def check_numbers(coefficients: Coefficients, epsilon: float) -> None:
    """Refuse coefficients that are too large for float32, given ε.

    Raises
    ------
    ValueError
        If a coefficient is over `STRONGEST` with lengths in units of ε.
    """
    for name, value in zip(NAMES, coefficients, strict=True):
        check_strength(name, value, POWERS[name], epsilon)


def check_lengths(epsilon: float, blur: float, longest: float) -> None:
    """Refuse an ε or a blur that is longer than the window, where the energy of any field is about 0.

    Raises
    ------
    ValueError
        If ε or the blur is longer than the window's longest side.
    """
    for name, length in (("an ε", epsilon), ("a blur", blur)):
        if not 0 <= length <= longest:
            raise ValueError(f"expected {name} of at most the window's longest side, {longest:g}, got {length:g}")


def _window(probability: Tensor, mask: Tensor | None, border: int) -> Tensor:
    """Return the mask `(1 or batch, z, y, x)` with zeros at the border."""
    inside = probability.new_zeros(probability.shape[1:])
    z, y, x = (slice(border, n - border) for n in inside.shape)
    inside[z, y, x] = 1
    return inside[None] if mask is None else inside * mask.to(inside)
