"""The functional that a flow lowers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.core.checks import check_float, check_type, quoted
from curvafit.generation.data import Data
from curvafit.priors.coefficients import NAMES, Coefficients, check_strengths
from curvafit.priors.grid import Grid

#: The least that ε is, in voxels: two are published; below a tenth no voxel lies on the interface.
FINEST = 0.1
#: Bounds of a voxel's edge: float32 holds the squares of second differences, and ξ = 1e-6 (`curvature.XI`) is small
#: beside the inverse of an edge.
VOXEL_EDGES = (1e-8, 1e5)


@dataclass(frozen=True)
class Cost:
    """The functional that a flow lowers, and the blur of the field; see `generate` for the parameters.

    Raises ValueError if a length is outside the bounds in which float32 can follow the flow, a coefficient or the
    orientation is over `STRONGEST` with lengths in units of ε, or a tensor does not broadcast with the voxels.
    """

    coefficients: Coefficients
    grid: Grid
    epsilon: float | Tensor
    orientation: Tensor | None
    blur: float
    data: Data | None = None

    def __post_init__(self) -> None:
        for name, kind in (("coefficients", Coefficients), ("grid", Grid)):
            check_type(getattr(self, name), kind, f"{name} as {kind.__name__}")
        self._check_lengths()
        self._check_tensors()
        check_strengths(self.coefficients, self.epsilon, self.orientation)

    def _check_lengths(self) -> None:
        """Convert ε and the blur to numbers; raise ValueError where they or the voxels' edges are out of range."""
        edges, box = self.grid.spacing, self.grid.longest
        if not VOXEL_EDGES[0] <= min(edges) <= max(edges) <= VOXEL_EDGES[1]:
            raise ValueError(f"a flow needs voxel edges from {VOXEL_EDGES[0]:g} to {VOXEL_EDGES[1]:g}, got {edges}")
        expected = "epsilon > 0 and blur >= 0 in the spacing's unit"
        if not isinstance(self.epsilon, Tensor):
            object.__setattr__(self, "epsilon", check_float(self.epsilon, expected, math.ulp(0)))
        object.__setattr__(self, "blur", check_float(self.blur, expected, 0))
        lengths = torch.as_tensor(self.epsilon, dtype=torch.float64)
        low, high = float(lengths.min()), float(lengths.max())
        if not (low > 0 and math.isfinite(high)):
            raise ValueError(f"expected {expected}, got {low} to {high} and {self.blur}")
        if not FINEST * min(edges) <= low <= high <= box:
            got = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            least = f"{FINEST:g} of a voxel ({FINEST * min(edges):.3g})"
            raise ValueError(f"epsilon must be from {least} to the box's side ({box:.3g}), got {got}")
        if self.blur > box:
            raise ValueError(f"the blur must be at most the box's side ({box:.3g}), got {self.blur:g}")

    def _check_tensors(self) -> None:
        """Raise ValueError where a tensor does not broadcast with the voxels, or data or orientation do not fit."""
        for name, value in zip(("epsilon", *NAMES), (self.epsilon, *self.coefficients), strict=True):
            if isinstance(value, Tensor):
                check_shape(name, value, self.grid)
        if self.data is not None and not callable(getattr(self.data, "slope", None)):
            raise ValueError(f"data must have a method slope, as generation.Evidence has, got {quoted(self.data)}")
        for name, value in getattr(self.data, "__dict__", {}).items():
            if isinstance(value, Tensor):
                check_shape(f"the data's {name}", value, self.grid)
        Q = self.orientation
        if Q is not None and (not isinstance(Q, Tensor) or tuple(Q.shape) != (3, 3) or not torch.equal(Q, Q.T)):
            values = Q.tolist() if isinstance(Q, Tensor) else Q
            raise ValueError(f"the orientation must be symmetric, of shape (3, 3) (z, y, x), got {quoted(values)}")


def check_shape(name: str, value: Tensor, grid: Grid) -> None:
    """Raise ValueError where a tensor does not broadcast with the voxels."""
    try:
        fits = torch.broadcast_shapes(value.shape, grid.shape) == grid.shape
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(f"{name} must broadcast with the voxels {grid.shape}, got the shape {tuple(value.shape)}")
