"""Fused kernels for float32 fields on processors: `cpu` is for callers, `loops` has the loops.

`energies.energy_gradient`, and `gaussian_blur` here, choose between a kernel and plain torch by type and device.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.priors import stencils
from curvafit.priors.grid import Grid


def has_kernel(device: torch.device | str) -> bool:
    """Return whether a device has a fused kernel for float32 fields: processors have, where numba is installed."""
    return torch.device(device).type == "cpu" and importlib.util.find_spec("numba") is not None


def energy_gradient(
    u: Tensor, coefficients: Sequence[float], grid: Grid, epsilon: float, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return `energies.energy_gradient` of a field where there is a kernel; coefficients are six numbers."""
    from curvafit.priors.kernels import cpu

    weights = None if mask is None else mask.detach().expand(grid.shape).numpy()
    value, slope = cpu.fused_energy_gradient(u.detach().numpy(), coefficients, grid, epsilon, weights)
    return torch.tensor(value, dtype=torch.float64), torch.from_numpy(slope)


def gaussian_blur(u: Tensor, grid: Grid, width: float) -> Tensor:
    """Return `stencils.gaussian_blur` of a field that needs no gradient, by the kernel where there is one."""
    stencils.check_blur(grid, width)
    if u.dtype == torch.float32 and u.dim() == 3 and has_kernel(u.device):
        from curvafit.priors.kernels import cpu

        return torch.from_numpy(cpu.gaussian_blur(u.detach().numpy(), grid, width))
    return stencils.gaussian_blur(u, grid, width)
