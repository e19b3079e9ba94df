"""Refinement of the parameters (a, m₀) of a shape: the method that its kind allows, and the paper's literal loss."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.inference.fixed_point import fixed_point
from curvafit.inference.refinement import Refinement
from curvafit.inference.stationarity import is_rounded, stationarity
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import geometric_curvatures, jet
from curvafit.priors.energy import energy_terms
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.progress import Progress, silent

__all__ = ["Refinement", "literal_loss_descent", "mass_of_mask", "refine"]


def refine(
    phase: Float[Tensor, "z y x"],
    grid: Grid,
    epsilon: float,
    *,
    kind: str,
    starts: Sequence[Coefficients],
    seed: int = 0,
    progress: Progress = silent,
) -> Refinement:
    """Refine the nearest matches: stationarity for a phase field, the fixed point of a short flow for a mask or image.

    A field that was rounded to few values is treated like a mask: second differences of it are noise.

    Parameters
    ----------
    phase
        Phase field, or the re-profiled mask, in working units.
    kind
        `"field"`, `"mask"` or `"image"`.
    starts
        Coefficients of the nearest matches, best first.

    Raises
    ------
    ValueError
        If the kind has another name, or as the method does.
    """
    if kind not in ("field", "mask", "image"):
        raise ValueError(f"expected kind 'field', 'mask' or 'image', got {kind!r}")
    rounded = kind == "field" and is_rounded(phase)
    if kind == "field" and not rounded:
        return stationarity(phase, grid, epsilon, starts=starts, seed=seed, progress=progress)
    found = fixed_point(phase, grid, epsilon, starts=starts, progress=progress)
    if not rounded:
        return found
    why = "Stationarity is not supported by a field rounded to few values."
    return dataclasses.replace(found, status=f"{why} {found.status}")


def mass_of_mask(phase: Float[Tensor, "z y x"], grid: Grid, epsilon: float) -> float:
    """m₀ of the shape {u > 0} to leading order in ε, from its volume fraction and its total mean curvature:
    m₀ = 2·fraction - 1 + (π²/6) ε² ∫H dA / |Ω|, which is the mean of the optimal profile about its surface.

    `phase` is the mask's phase field; ∫H dA is its level sets' H = κ1 + κ2 averaged with weight |∇u| / 2.
    """
    field = jet(phase.double(), grid)
    slope = field.gradient.square().sum(-4).sqrt()
    total = float((geometric_curvatures(field).mean * slope).sum()) / 2 * grid.voxel_volume
    fraction = float((phase > 0).double().mean())
    return 2 * fraction - 1 + math.pi**2 / 6 * epsilon**2 * total / grid.volume


def literal_loss_descent(
    u: Float[Tensor, "z y x"], grid: Grid, epsilon: float, start: Coefficients, steps: int, rate: float
) -> tuple[Tensor, Tensor]:
    """The paper's proposal taken literally: gradient descent on F_ε[u₀; a] over a. A baseline that shows its fault.

    F_ε is linear in a, so its gradient is the constant vector of the six terms: a runs off along it in a straight line
    and the loss falls for ever, whatever u₀ is. A normalisation is needed, which `stationarity` gives.

    Returns
    -------
    tuple
        Loss `(steps + 1,)` and coefficients `(steps + 1, 6)`, float64.
    """
    terms = energy_terms(jet(u.double(), grid), epsilon).sum((-3, -2, -1)) * grid.voxel_volume
    a = torch.stack([start.tensor() - k * rate * terms for k in range(steps + 1)])
    return a @ terms, a
