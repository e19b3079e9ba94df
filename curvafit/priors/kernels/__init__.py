"""The fused energy and blur, which the device chooses, not the caller; plain torch where there is no kernel."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from curvafit.priors import stencils
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid


def has_kernel(device: torch.device | str) -> bool:
    """Return whether there is a fused kernel for float32 fields on a device: on processors, where numba is."""
    return torch.device(device).type == "cpu" and importlib.util.find_spec("numba") is not None


def to_numpy_cost(
    coefficients: Iterable[float | Tensor], grid: Grid, epsilon: float | Tensor, orientation: Tensor | None
) -> tuple[list[float | np.ndarray], float | np.ndarray, np.ndarray | None]:
    """Return a cost as `cpu` takes it: numbers, or arrays `(Z, Y, X)` where they vary in space."""

    def number(value: float | Tensor) -> float | np.ndarray:
        if not isinstance(value, Tensor) or value.dim() == 0:
            return float(value)
        return value.detach().double().expand(grid.shape).numpy()

    Q = None if orientation is None else orientation.double().numpy()
    return [number(value) for value in coefficients], number(epsilon), Q


def energy_gradient(
    u: Tensor,
    coefficients: Iterable[float | Tensor],
    grid: Grid,
    epsilon: float | Tensor,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return `energy` of a field `(Z, Y, X)` and its gradient with respect to every voxel, in the field's type.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's.
    """
    if u.dtype != torch.float32 or not has_kernel(u.device):
        return plain_energy_gradient(u, coefficients, grid, epsilon, orientation, mask)
    from curvafit.priors.kernels import cpu

    a, ε, Q = to_numpy_cost(coefficients, grid, epsilon, orientation)
    kept = None if mask is None else mask.detach().numpy()
    value, slope = cpu.energy_gradient(u.detach().numpy(), a, grid, ε, Q, kept)
    return torch.tensor(value, dtype=torch.float64), torch.from_numpy(slope)


def plain_energy_gradient(
    u: Tensor,
    coefficients: Iterable[float | Tensor],
    grid: Grid,
    epsilon: float | Tensor,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the energies of fields `(..., Z, Y, X)` and their gradients by autograd, the definition, on any device."""
    free = u.detach().requires_grad_()
    with torch.enable_grad():
        values = energy(free, coefficients, grid, epsilon, orientation, mask)
        (gradients,) = torch.autograd.grad(values.sum(), free)
    return values.detach(), gradients


def gaussian_blur(u: Tensor, grid: Grid, width: float) -> Tensor:
    """Return `stencils.gaussian_blur` of a field `(Z, Y, X)` that needs no gradient.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's, or as `stencils.check_blur` does.
    """
    stencils.check_blur(grid, width)
    if u.dtype == torch.float32 and u.dim() == 3 and has_kernel(u.device):
        from curvafit.priors.kernels import cpu

        return torch.from_numpy(cpu.gaussian_blur(u.detach().numpy(), grid, width))
    return stencils.gaussian_blur(u, grid, width)
