"""Refinement of the parameters (a, m₀) of a shape, by the method that its kind allows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from torch import Tensor

from curvafit.inference.fixed_point import fixed_point
from curvafit.inference.refinement import Refinement
from curvafit.inference.stationarity import is_rounded, stationarity
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.progress import Progress, silent


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
    refinement = fixed_point(phase, grid, epsilon, starts=starts, progress=progress)
    if not rounded:
        return refinement
    why = "Stationarity is not supported by a field rounded to few values."
    return dataclasses.replace(refinement, status=f"{why} {refinement.status}")
