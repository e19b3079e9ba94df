"""F_ε of a batch of fields, differentiable: in float32 its gradient is computed together with its value."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from functools import cache

import torch
from torch import Tensor

from curvafit.priors import kernels
from curvafit.priors.energies import energy, energy_gradient
from curvafit.priors.grid import Float, Grid

_LOG = logging.getLogger("curvafit")


def energies(
    u: Float[Tensor, "batch z y x"],
    coefficients: Iterable[float | Tensor],
    grid: Grid,
    epsilon: float,
    mask: Float[Tensor, "#batch z y x"],
) -> Float[Tensor, " batch"]:
    """Return `energy` of every field, with its density multiplied by a mask.

    In float32 the gradient is computed together with the value, field by field, by the fused kernel where there is one
    and else by autograd. So two numbers for each voxel are stored for a backward pass, where autograd alone stores
    thirty; there are first derivatives in reverse mode, and any other raises a RuntimeError. Float64, compiled calls,
    and without a kernel also calls that need no gradient, take the definition, which has them all. Coefficients are
    numbers; a mask that requires a gradient raises a ValueError.
    """
    if mask.requires_grad:
        raise ValueError("expected a mask that asks for no gradient, got one that does: detach it")
    in_one_pass = kernels.has_kernel(u.device) or torch.is_grad_enabled()
    if u.dtype != torch.float32 or torch.compiler.is_compiling() or not in_one_pass:
        return energy(u, coefficients, grid, epsilon, mask=mask)
    a = [float(value) if isinstance(value, Tensor) else value for value in coefficients]
    return _Energies.apply(u, mask.to(u).expand(u.shape), a, grid, epsilon)  # type: ignore[return-value]


class _Energies(torch.autograd.Function):
    """The energies of fields `(B, Z, Y, X)`, whose gradients are kept for the backward pass."""

    @staticmethod
    def forward(ctx, u, mask, a, grid, epsilon):
        _warn_of_slow_calls(u.device.type)
        pairs = [energy_gradient(field, a, grid, epsilon, mask=weights) for field, weights in zip(u, mask, strict=True)]
        values, gradients = (torch.stack(parts) for parts in zip(*pairs, strict=True))
        ctx.save_for_backward(gradients, u)
        return values.to(u)

    @staticmethod
    def backward(ctx, *slopes):
        return _PrecomputedGradient.apply(*ctx.saved_tensors) * slopes[0][:, None, None, None], None, None, None, None


class _PrecomputedGradient(torch.autograd.Function):
    """The stored gradients as a function of u, whose derivative is an error: autograd alone would take it for zero."""

    @staticmethod
    def forward(ctx, gradients, u):
        return gradients.view_as(gradients)

    @staticmethod
    def backward(ctx, *_):
        raise RuntimeError("float32 has first derivatives of F_ε only: take float64 for second ones")


@cache
def _warn_of_slow_calls(device: str) -> None:
    """Log, once, that on a processor every call is slow (no numba) or that the first one is (compilation)."""
    if device == "cpu" and not kernels.has_kernel(device):
        _LOG.warning("numba is not installed: on a processor the loss takes some 25 times as long (pip install numba)")
    elif device == "cpu":
        from curvafit.priors.kernels.loops import fill_gradient

        if not fill_gradient.is_compiled():
            _LOG.warning("compiling the loss for this processor, once: some ten seconds")
