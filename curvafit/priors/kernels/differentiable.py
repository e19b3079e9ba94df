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
    and else by autograd. So two numbers for each voxel are stored for a backward pass, where autograd alone stores
    thirty; a second derivative raises a RuntimeError. Float64, and without a kernel also compiled calls and calls that
    need no gradient, take the definition. Coefficients are numbers and the boundary is `"replicate"`; a mask that
    requires a gradient raises a ValueError.
    """
    if mask.requires_grad:
        raise ValueError("expected a mask that asks for no gradient, got one that does: detach it")
    compiling, fused = torch.compiler.is_compiling(), kernels.has_kernel(u.device)
    if u.dtype != torch.float32 or not (fused or (torch.is_grad_enabled() and not compiling)):
        return energy(u, coefficients, grid, epsilon, mask=mask)
    a = [float(value) if isinstance(value, Tensor) else value for value in coefficients]
    arguments = u, mask.to(u).expand(u.shape), a, list(grid.spacing), epsilon
    # A compiler sees the operator; `torch.func` transforms the function.
    return (_energies(*arguments) if compiling else _Energies.apply(*arguments))[0]  # type: ignore[index]


def _compute(u, mask, a, spacing, epsilon) -> tuple[Tensor, Tensor]:
    """Return the energies `(B,)` and their gradients `(B, Z, Y, X)`."""
    _warn_of_slow_calls(u.device.type)
    grid = Grid(tuple(u.shape[1:]), tuple(spacing), "replicate")
    values, gradients = u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)
    for k in range(len(u)):
        values[k], gradients[k] = energy_gradient(u[k].detach(), a, grid, epsilon, mask=mask[k].detach())
    return values, gradients


@cache
def _warn_of_slow_calls(device: str) -> None:
    """Log, once, that on a processor every call is slow (no numba) or that the first one is (compilation)."""
    if device == "cpu" and not kernels.has_kernel(device):
        _LOG.warning("numba is not installed: on a processor the loss takes some 25 times as long (pip install numba)")
    elif device == "cpu":
        from curvafit.priors.kernels.loops import fill_gradient

        if not fill_gradient.is_compiled():
            _LOG.warning("compiling the loss for this processor, once: some ten seconds")


def _save(ctx, inputs, output) -> None:
    """Save the gradients and the fields for a backward pass."""
    ctx.save_for_backward(output[1], inputs[0])
    ctx.mark_non_differentiable(output[1])


def _backward(ctx, *grad_outputs):
    """Multiply the saved gradients by the loss's gradient by the energies; the second output has no derivative."""
    (grad_energies, _), (gradients, u) = grad_outputs, ctx.saved_tensors
    return _PrecomputedGradient.apply(gradients, u) * grad_energies[:, None, None, None], None, None, None, None


class _Energies(torch.autograd.Function):
    """The energies and their gradients, for reverse and forward mode and for `torch.func.vmap`."""

    @staticmethod
    def forward(u, mask, a, spacing, epsilon):
        return _compute(u, mask, a, spacing, epsilon)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        _save(ctx, inputs, output)
        ctx.save_for_forward(output[1], inputs[0])

    backward = staticmethod(_backward)

    @staticmethod
    def jvp(ctx, tangent, *_):
        gradients, u = ctx.saved_tensors
        return (_PrecomputedGradient.apply(gradients, u) * tangent).sum((-3, -2, -1)), None

    @staticmethod
    def vmap(info, in_dims, u, mask, *numbers):
        fields = [
            field.expand(info.batch_size, *field.shape) if dim is None else field.movedim(dim, 0)
            for field, dim in zip((u, mask), in_dims, strict=False)
        ]
        energies, gradients = _Energies.apply(*(field.flatten(0, 1) for field in fields), *numbers)  # type: ignore[misc]
        batches = fields[0].shape[:2]
        return (energies.unflatten(0, batches), gradients.unflatten(0, batches)), (0, 0)


class _PrecomputedGradient(torch.autograd.Function):
    """The stored gradients as a function of u, whose derivative is an error: autograd alone would take it for zero."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradients, u):
        return gradients.view_as(gradients)

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
