"""What a flow lowers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from curvafit.generation.data import Data
from curvafit.priors.bounds import instance, quoted, real
from curvafit.priors.coefficients import NAMES, POWERS, Coefficients, check_strength
from curvafit.priors.grid import Grid

#: Voxels that ε spans at least: published are two; below a tenth no voxel sees the interface.
FINEST = 0.1
#: Edges of a voxel whose squared second differences float32 holds, and beside whose inverse ξ = 1e-6 (`curvature.XI`)
#: is little.
VOXELS = (1e-8, 1e5)


@dataclass(frozen=True)
class Cost:
    """What is lowered, and the blur that comes before it; see `generate` for each.

    Raises
    ------
    ValueError
        If ε is less than a tenth of a voxel or more than the box, the blur negative or more than the box, a coefficient
        or the orientation over a million with lengths in units of ε, a voxel's edge out of float32's reach, or a tensor
        does not broadcast with the voxels.
    """

    coefficients: Coefficients
    grid: Grid
    epsilon: float | Tensor
    orientation: Tensor | None
    blur: float
    data: Data | None = None

    def __post_init__(self) -> None:
        for name, kind in (("coefficients", Coefficients), ("grid", Grid)):
            instance(getattr(self, name), kind, f"{name} as {kind.__name__}")
        self._check_lengths()
        self._check_tensors()
        self._check_strengths()

    def _check_lengths(self) -> None:
        """ε and the blur, as numbers, and both and the voxels in range."""
        edges, box = self.grid.spacing, self.grid.longest
        if not VOXELS[0] <= min(edges) <= max(edges) <= VOXELS[1]:
            raise ValueError(f"expected voxel edges from {VOXELS[0]:g} to {VOXELS[1]:g} for a flow, got {edges}")
        said = "epsilon > 0 and blur >= 0 in the spacing's unit"
        if not isinstance(self.epsilon, Tensor):
            object.__setattr__(self, "epsilon", real(self.epsilon, said, math.ulp(0)))
        object.__setattr__(self, "blur", real(self.blur, said, 0))
        lengths = torch.as_tensor(self.epsilon, dtype=torch.float64)
        low, high = float(lengths.min()), float(lengths.max())
        if not (low > 0 and math.isfinite(high)):
            raise ValueError(f"expected {said}, got {low} to {high} and {self.blur}")
        if not FINEST * min(edges) <= low <= high <= box:
            got = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            least = f"{FINEST:g} of a voxel ({FINEST * min(edges):.3g})"
            raise ValueError(f"expected an epsilon from {least} to the box ({box:.3g}), got {got}")
        if self.blur > box:
            raise ValueError(f"expected a blur within the box ({box:.3g}), got {self.blur:g}")

    def _check_tensors(self) -> None:
        """Whether what varies broadcasts with the voxels, and the orientation is one."""
        for name, value in zip(("epsilon", *NAMES), (self.epsilon, *self.coefficients), strict=True):
            if isinstance(value, Tensor):
                check_shape(name, value, self.grid)
        if self.data is not None and not callable(getattr(self.data, "slope", None)):
            raise ValueError(f"expected data with a slope, as generation.data.Evidence, got {quoted(self.data)}")
        for name, value in getattr(self.data, "__dict__", {}).items():
            if isinstance(value, Tensor):
                check_shape(f"the data's {name}", value, self.grid)
        Q = self.orientation
        if Q is None:
            return
        if not isinstance(Q, Tensor) or tuple(Q.shape) != (3, 3) or not torch.equal(Q, Q.T):
            raise ValueError(f"expected a symmetric orientation of shape (3, 3) (z, y, x), got {quoted(_plain(Q))}")

    def _check_strengths(self) -> None:
        """Coefficients and orientation, which is of a00's unit, with lengths in units of ε."""
        ε = torch.as_tensor(self.epsilon, dtype=torch.float64)
        named = {name: (value, POWERS[name]) for name, value in zip(NAMES, self.coefficients, strict=True)}
        if self.orientation is not None:
            named["the orientation"] = self.orientation, 2
        for name, (value, power) in named.items():
            check_strength(name, torch.as_tensor(value, dtype=torch.float64).detach().abs().max(), power, ε.max())


def check_shape(name: str, value: Tensor, grid: Grid) -> None:
    """Raise ValueError where a tensor does not broadcast with the voxels."""
    try:
        fits = torch.broadcast_shapes(value.shape, grid.shape) == grid.shape
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(f"expected {name} to broadcast with the voxels {grid.shape}, got shape {tuple(value.shape)}")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, Tensor) else value
