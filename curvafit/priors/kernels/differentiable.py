"""F_ε of a batch of fields, differentiable: the fused kernels as an operator that is opaque to compilers."""

from __future__ import annotations

import torch
from torch import Tensor

from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import gradient


def energies(
    u: Float[Tensor, "batch z y x"],
    coefficients: Coefficients,
    grid: Grid,
    epsilon: float,
    mask: Float[Tensor, "#batch z y x"],
) -> Float[Tensor, " batch"]:
    """Return `energy` of every field, with its density multiplied by a mask.

    Float32 takes the fused kernel where there is one. The kernel returns the gradient with the value, so that a first
    derivative, in reverse or forward mode, is a multiplication; a second derivative raises a RuntimeError. Other fields
    take the definition.

    Parameters
    ----------
    coefficients
        Numbers.
    grid, epsilon
        A grid with the boundary `"replicate"`; ε in spacing's unit.
    mask
        Weights, which receive no gradient.

    Raises
    ------
    ValueError
        If the mask requires a gradient.
    """
    _check_mask(mask)
    if u.dtype != torch.float32 or not kernels.fused(u.device):
        return energy(u, coefficients, grid, epsilon, mask=mask)
    return _first_derivatives(u, mask, [float(value) for value in coefficients], grid, epsilon)


def areas(
    u: Float[Tensor, "batch z y x"], grid: Grid, epsilon: float, mask: Float[Tensor, "#batch z y x"]
) -> Float[Tensor, " batch"]:
    """Return ∫ ε|∇u|² of every field, the term of F_ε that a00 multiplies, about σ × area, as `energies` does."""
    _check_mask(mask)
    if u.dtype != torch.float32 or not kernels.fused(u.device):
        slope2 = gradient(u, grid).square().sum(-4)
        return epsilon * (slope2 * mask.to(u)).sum((-3, -2, -1)) * grid.voxel_volume
    return _first_derivatives(u, mask, [0.0] * 5 + [1.0], grid, epsilon)


def _check_mask(mask: Tensor) -> None:
    if mask.requires_grad:
        raise ValueError("expected a mask that asks for no gradient, got one that does: detach it")


def _first_derivatives(u: Tensor, mask: Tensor, a: list[float], grid: Grid, epsilon: float) -> Tensor:
    """The energies by the operator that a compiler sees, else by the function that `torch.func` transforms too."""
    given = u, mask.to(u).expand(u.shape), a, list(grid.spacing), epsilon
    return (_energies(*given) if torch.compiler.is_compiling() else _Energies.apply(*given))[0]  # type: ignore[index]


def _computed(u, mask, a, spacing, epsilon) -> tuple[Tensor, Tensor]:
    """The energies, and their gradient."""
    grid = Grid(tuple(u.shape[1:]), tuple(spacing), "replicate")
    u, mask = u.detach(), mask.detach()
    if u.device.type == "cuda":
        from curvafit.priors.kernels import cuda

        values, slopes = cuda.energy_gradient(u, torch.tensor(a), grid, epsilon, mask=mask)
        return values.to(u), slopes
    from curvafit.priors.kernels import cpu

    values, slopes = u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)
    for k in range(len(u)):
        value, slope = cpu.energy_gradient(u[k].numpy(), a, grid, epsilon, mask=mask[k].numpy())
        values[k], slopes[k] = value, torch.from_numpy(slope)
    return values, slopes


def _keep(ctx, inputs, output) -> None:
    ctx.save_for_backward(output[1], inputs[0])
    ctx.mark_non_differentiable(output[1])


def _backward(ctx, *by_outputs):
    (by_energies, _), (slopes, u) = by_outputs, ctx.saved_tensors
    return _Known.apply(slopes, u) * by_energies[:, None, None, None], None, None, None, None


class _Energies(torch.autograd.Function):
    """The energies and their gradient, for reverse and forward mode and for batches of batches."""

    @staticmethod
    def forward(u, mask, a, spacing, epsilon):
        return _computed(u, mask, a, spacing, epsilon)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        _keep(ctx, inputs, output)
        ctx.save_for_forward(output[1], inputs[0])

    backward = staticmethod(_backward)

    @staticmethod
    def jvp(ctx, by_u, *_):
        slopes, u = ctx.saved_tensors
        return (_Known.apply(slopes, u) * by_u).sum((-3, -2, -1)), None

    @staticmethod
    def vmap(info, in_dims, u, mask, *numbers):
        fields = [
            each.expand(info.batch_size, *each.shape) if dim is None else each.movedim(dim, 0)
            for each, dim in zip((u, mask), in_dims, strict=False)
        ]
        energies, slopes = _Energies.apply(*(each.flatten(0, 1) for each in fields), *numbers)  # type: ignore[misc]
        batches = fields[0].shape[:2]
        return (energies.unflatten(0, batches), slopes.unflatten(0, batches)), (0, 0)


class _Known(torch.autograd.Function):
    """The gradient by u, which says that it depends on u but not how."""

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


_ONLY_FIRST = "expected first derivatives of F_ε in float32, got a second one: take float64 for it"


_SCHEMA = "(Tensor u, Tensor mask, float[] a, float[] spacing, float epsilon) -> (Tensor, Tensor)"
_energies = torch.library.custom_op("curvafit::energies", _computed, mutates_args=(), schema=_SCHEMA)


@_energies.register_fake
def _(u, mask, a, spacing, epsilon):
    return u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)


_energies.register_autograd(_backward, setup_context=_keep)
