"""The fused energy and blur, which the device chooses, not the caller; plain torch where there is no kernel."""

from __future__ import annotations

import importlib.util

import numpy as np
import torch
from torch import Tensor

from curvafit.priors import stencils
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid


def fused(device: torch.device | str) -> bool:
    """Return whether there is a fused kernel for float32 fields on a device."""
    kind = torch.device(device).type
    if kind == "cuda":
        from curvafit.priors.kernels import cuda

        return cuda.available(device)
    return kind == "cpu" and importlib.util.find_spec("numba") is not None


def on_processor(
    coefficients: Coefficients, grid: Grid, epsilon: float | Tensor, orientation: Tensor | None
) -> tuple[list[float | np.ndarray], float | np.ndarray, np.ndarray | None]:
    """Return a cost as `cpu` takes it: numbers, or arrays `(Z, Y, X)` where they vary in space."""

    def number(value: float | Tensor) -> float | np.ndarray:
        if not isinstance(value, Tensor) or value.dim() == 0:
            return float(value)
        return value.detach().double().expand(grid.shape).numpy()

    Q = None if orientation is None else orientation.double().numpy()
    return [number(value) for value in coefficients], number(epsilon), Q


def stacked(coefficients: Coefficients, grid: Grid) -> Tensor:
    """Return coefficients as `cuda` takes them, in float64: `(6,)`, or `(6, Z, Y, X)` where any varies in space."""
    a = coefficients.tensor()
    return a if a.dim() == 1 else a.reshape(6, *(1,) * (4 - a.dim()), *a.shape[1:]).expand(6, *grid.shape)


def energy_gradient(
    u: Tensor,
    coefficients: Coefficients,
    grid: Grid,
    epsilon: float | Tensor,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
) -> tuple[float, Tensor]:
    """Return `energy` of a field `(Z, Y, X)` and its gradient with respect to every voxel, in the field's type.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's.
    """
    if u.dtype != torch.float32 or not fused(u.device):
        return plain_energy_gradient(u, coefficients, grid, epsilon, orientation, mask)
    if u.device.type == "cuda":
        from curvafit.priors.kernels import cuda

        energies, gradient = cuda.energy_gradient(u, stacked(coefficients, grid), grid, epsilon, orientation, mask)
        return float(energies), gradient
    from curvafit.priors.kernels import cpu

    a, ε, Q = on_processor(coefficients, grid, epsilon, orientation)
    kept = None if mask is None else mask.detach().numpy()
    value, slope = cpu.energy_gradient(u.detach().numpy(), a, grid, ε, Q, kept)
    return value, torch.from_numpy(slope)


def plain_energy_gradient(
    u: Tensor,
    coefficients: Coefficients,
    grid: Grid,
    epsilon: float | Tensor,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
) -> tuple[float, Tensor]:
    """Return the energy and its gradient by autograd, the definition."""
    free = u.detach().requires_grad_()
    with torch.enable_grad():
        value = energy(free, coefficients, grid, epsilon, orientation, mask)
        (gradient,) = torch.autograd.grad(value, free)
    return float(value.detach()), gradient


def gaussian_blur(u: Tensor, grid: Grid, width: float) -> Tensor:
    """Return `stencils.gaussian_blur` of a field `(Z, Y, X)` that needs no gradient.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's, or as `stencils.check_blur` does.
    """
    stencils.check_blur(grid, width)
    if u.dtype == torch.float32 and u.dim() == 3 and u.device.type == "cpu" and importlib.util.find_spec("numba"):
        from curvafit.priors.kernels import cpu

        return torch.from_numpy(cpu.gaussian_blur(u.detach().numpy(), grid, width))
    return stencils.gaussian_blur(u, grid, width)
