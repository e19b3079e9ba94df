"""The energy and the flow's step, fused; chosen by device and falling back on plain torch, never by the caller."""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid


def fused(device: torch.device | str, coefficients: Coefficients) -> bool:
    """Whether there is a fused kernel for a float32 field on this device with these coefficients (numbers only)."""
    numbers = not any(isinstance(value, Tensor) and value.dim() > 0 for value in coefficients)
    return numbers and torch.device(device).type == "cpu" and importlib.util.find_spec("numba") is not None


def energy_gradient(u: Tensor, coefficients: Coefficients, grid: Grid, epsilon: float) -> tuple[float, Tensor]:
    """F_ε of a field `(Z, Y, X)` and its gradient with respect to every voxel, on the field's device and in its type.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's.
    """
    if u.dtype == torch.float32 and fused(u.device, coefficients):
        from curvafit.priors.kernels import cpu

        value, gradient = cpu.energy_gradient(u.detach().numpy(), [float(v) for v in coefficients], grid, epsilon)
        return value, torch.from_numpy(gradient)
    free = u.detach().requires_grad_()
    with torch.enable_grad():
        value = energy(free, coefficients, grid, epsilon)
        (gradient,) = torch.autograd.grad(value, free)
    return float(value.detach()), gradient
