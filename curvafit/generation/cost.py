"""What a flow lowers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from curvafit.generation.data import Data
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.grid import Grid


@dataclass(frozen=True)
class Cost:
    """What is lowered, and the blur that comes before it; see `generate` for each.

    Raises
    ------
    ValueError
        If ε is not positive, the blur negative, or a tensor does not broadcast with the voxels.
    """

    coefficients: Coefficients
    grid: Grid
    epsilon: float | Tensor
    orientation: Tensor | None
    blur: float
    data: Data | None = None

    def __post_init__(self) -> None:
        lengths = torch.as_tensor(self.epsilon)
        if not (bool(((lengths > 0) & (lengths < math.inf)).all()) and 0 <= self.blur < math.inf):
            got = f"{float(lengths.min())} to {float(lengths.max())}" if lengths.dim() else f"{self.epsilon}"
            got = f"{got} and {self.blur}"
            raise ValueError(f"expected epsilon > 0 and blur >= 0 in the spacing's unit, got {got}")
        for name, value in zip(("epsilon", *NAMES), (self.epsilon, *self.coefficients), strict=True):
            if isinstance(value, Tensor):
                check_shape(name, value, self.grid)
        for name, value in vars(self.data).items() if self.data is not None else ():
            if isinstance(value, Tensor):
                check_shape(f"the data's {name}", value, self.grid)


def check_shape(name: str, value: Tensor, grid: Grid) -> None:
    """Raise ValueError where a tensor does not broadcast with the voxels."""
    try:
        fits = torch.broadcast_shapes(value.shape, grid.shape) == grid.shape
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(f"expected {name} to broadcast with the voxels {grid.shape}, got shape {tuple(value.shape)}")
