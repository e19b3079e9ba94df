"""Fused kernels for float32 fields on processors: `cpu` is for callers, `loops` has the loops.

`energies.energy_gradient`, and `gaussian_blur` here, choose between a kernel and plain torch by type and device.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from curvafit.priors import stencils
from curvafit.priors.grid import Grid


def has_kernel(device: torch.device | str) -> bool:
    """Return whether a device has a fused kernel for float32 fields: processors have, where numba is installed."""
    return torch.device(device).type == "cpu" and importlib.util.find_spec("numba") is not None


def to_numpy_cost(
    coefficients: Iterable[float | Tensor], grid: Grid, orientation: Tensor | None
) -> tuple[list[float | np.ndarray], np.ndarray | None]:
    """Return coefficients and orientation as `cpu` takes them: numbers, or arrays `(Z, Y, X)` if they vary."""

    def to_numpy(value: float | Tensor) -> float | np.ndarray:
        if not isinstance(value, Tensor) or value.dim() == 0:
            return float(value)
        return value.detach().double().expand(grid.shape).numpy()

    Q = None if orientation is None else orientation.double().numpy()
    return [to_numpy(value) for value in coefficients], Q


def gaussian_blur(u: Tensor, grid: Grid, width: float) -> Tensor:
    """Return `stencils.gaussian_blur` of a field that needs no gradient, by the kernel where there is one."""
    stencils.check_blur(grid, width)
    if u.dtype == torch.float32 and u.dim() == 3 and has_kernel(u.device):
        from curvafit.priors.kernels import cpu

        return torch.from_numpy(cpu.gaussian_blur(u.detach().numpy(), grid, width))
    return stencils.gaussian_blur(u, grid, width)
