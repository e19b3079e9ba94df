"""Refinement of the parameters (a, m₀) of a shape: the method that its kind allows, and the paper's literal loss."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.fixed_point import fixed_point
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import jet
from curvafit.priors.energy import energy_terms
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.refinement import Progress, Refinement
from curvafit.stationarity import stationarity

__all__ = ["Refinement", "literal_loss_descent", "refine"]


def refine(
    phase: Float[Tensor, "z y x"],
    grid: Grid,
    epsilon: float,
    *,
    kind: str,
    starts: Sequence[Coefficients],
    seed: int = 0,
    progress: Progress | None = None,
) -> Refinement:
    """Refine the nearest matches: stationarity for a phase field, the fixed point of a short flow for a mask or image.

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
    if kind == "field":
        return stationarity(phase, grid, epsilon, starts=starts, seed=seed, progress=progress)
    if kind not in ("mask", "image"):
        raise ValueError(f"expected kind 'field', 'mask' or 'image', got {kind!r}")
    return fixed_point(phase, grid, epsilon, starts=starts, progress=progress)


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
