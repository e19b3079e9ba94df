"""F_ε of a batch of fields, differentiable: the energy and its gradient as an operator opaque to compilers."""

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
    and else by autograd: two numbers for each voxel wait for a backward pass, where autograd alone stores thirty. There
    are first derivatives only, and a second one raises a RuntimeError. Float64, a compiler without a kernel, and a call
    without a gradient take the definition. Coefficients are numbers and the boundary is `"replicate"`; a mask that asks
    for a gradient is a ValueError.
    """
    if mask.requires_grad:
        raise ValueError("expected a mask that asks for no gradient, got one that does: detach it")
    compiling, fused = torch.compiler.is_compiling(), kernels.has_kernel(u.device)
    if u.dtype != torch.float32 or not (fused or (torch.is_grad_enabled() and not compiling)):
        return energy(u, coefficients, grid, epsilon, mask=mask)
    numbers = [float(value) if isinstance(value, Tensor) else value for value in coefficients]
    given = u, mask.to(u).expand(u.shape), numbers, list(grid.spacing), epsilon
    # A compiler sees the operator; `torch.func` transforms the function.
    return (_energies(*given) if compiling else _Energies.apply(*given))[0]  # type: ignore[index]


def _compute(u, mask, a, spacing, epsilon) -> tuple[Tensor, Tensor]:
    """Return the energies and their gradient."""
    _say_what_takes_long(u.device.type)
    grid = Grid(tuple(u.shape[1:]), tuple(spacing), "replicate")
    values, slopes = u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)
    for k in range(len(u)):
        values[k], slopes[k] = energy_gradient(u[k].detach(), a, grid, epsilon, mask=mask[k].detach())
    return values, slopes


@cache
def _say_what_takes_long(device: str) -> None:
    """Log, once, what makes the first call slow on a processor, or every call."""
    if device == "cpu" and not kernels.has_kernel(device):
        _LOG.warning("numba is not installed: on a processor the loss takes some 25 times as long (pip install numba)")
    elif device == "cpu":
        from curvafit.priors.kernels.loops import fill_gradient

        if not fill_gradient.is_compiled():
            _LOG.warning("compiling the loss for this processor, once: some ten seconds")


def _save(ctx, inputs, output) -> None:
    """Save the gradient and the fields for a backward pass."""
    ctx.save_for_backward(output[1], inputs[0])
    ctx.mark_non_differentiable(output[1])


def _backward(ctx, *by_outputs):
    """Multiply the gradient that came with the energies by that of the loss; the second output has none of its own."""
    (by_energies, _), (slopes, u) = by_outputs, ctx.saved_tensors
    return _PrecomputedGradient.apply(slopes, u) * by_energies[:, None, None, None], None, None, None, None


class _Energies(torch.autograd.Function):
    """The energies and their gradient, for reverse and forward mode and for batches of batches."""

    @staticmethod
    def forward(u, mask, a, spacing, epsilon):
        return _compute(u, mask, a, spacing, epsilon)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        _save(ctx, inputs, output)
        ctx.save_for_forward(output[1], inputs[0])

    backward = staticmethod(_backward)

    @staticmethod
    def jvp(ctx, by_u, *_):
        slopes, u = ctx.saved_tensors
        return (_PrecomputedGradient.apply(slopes, u) * by_u).sum((-3, -2, -1)), None

    @staticmethod
    def vmap(info, in_dims, u, mask, *numbers):
        fields = [
            each.expand(info.batch_size, *each.shape) if dim is None else each.movedim(dim, 0)
            for each, dim in zip((u, mask), in_dims, strict=False)
        ]
        energies, slopes = _Energies.apply(*(each.flatten(0, 1) for each in fields), *numbers)  # type: ignore[misc]
        batches = fields[0].shape[:2]
        return (energies.unflatten(0, batches), slopes.unflatten(0, batches)), (0, 0)


class _PrecomputedGradient(torch.autograd.Function):
    """The gradient by u as a function of u without a derivative: a second derivative is an error, not zero."""

    generate_vmap_rule = True

    @staticmethod
    def forward(slopes, u):
        return slopes.view_as(slopes)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None: ...

    @staticmethod
    def backward(ctx, *_):
        raise RuntimeError(_ONLY_FIRST)

    @staticmethod
    def jvp(ctx, *_):
        raise RuntimeError(_ONLY_FIRST)


_ONLY_FIRST = "float32 has first derivatives of F_ε only: take float64 for second ones"
_SCHEMA = "(Tensor u, Tensor mask, float[] a, float[] spacing, float epsilon) -> (Tensor, Tensor)"
_energies = torch.library.custom_op("curvafit::energies", _compute, mutates_args=(), schema=_SCHEMA)


@_energies.register_fake
def _(u, mask, a, spacing, epsilon):
    return u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)


_energies.register_autograd(_backward, setup_context=_save)
