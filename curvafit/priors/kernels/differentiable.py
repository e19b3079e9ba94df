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
    """`energy` of every field, its density multiplied by a mask.

    Float32 takes the fused kernel where there is one: its gradient comes with its value, so that the backward pass is
    a multiplication, once; a second derivative raises a RuntimeError. Other fields take the definition.

    Parameters
    ----------
    coefficients
        Numbers.
    grid, epsilon
        A grid with mirrors; ε in its spacing's unit.
    mask
        Gets no gradient.
    """
    if u.dtype != torch.float32 or not kernels.fused(u.device):
        return energy(u, coefficients, grid, epsilon, mask=mask)
    a = [float(value) for value in coefficients]
    return _energies(u, mask.to(u).expand(u.shape), a, list(grid.spacing), epsilon)[0]


def areas(
    u: Float[Tensor, "batch z y x"], grid: Grid, epsilon: float, mask: Float[Tensor, "#batch z y x"]
) -> Float[Tensor, " batch"]:
    """∫ ε|∇u|², about σ × area, of every field, likewise: the term of F_ε that a00 multiplies."""
    if u.dtype != torch.float32 or not kernels.fused(u.device):
        slope2 = gradient(u, grid).square().sum(-4)
        return epsilon * (slope2 * mask.to(u)).sum((-3, -2, -1)) * grid.voxel_volume
    return _energies(u, mask.to(u).expand(u.shape), [0.0] * 5 + [1.0], list(grid.spacing), epsilon)[0]


_SCHEMA = "(Tensor u, Tensor mask, float[] a, float[] spacing, float epsilon) -> (Tensor, Tensor)"


@torch.library.custom_op("curvafit::energies", mutates_args=(), schema=_SCHEMA)
def _energies(u, mask, a, spacing, epsilon):
    """The energies, and their gradient."""
    grid = Grid(tuple(u.shape[1:]), tuple(spacing), "replicate")
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


@_energies.register_fake
def _(u, mask, a, spacing, epsilon):
    return u.new_empty((u.shape[0],)), torch.empty_like(u, memory_format=torch.contiguous_format)


def _keep(ctx, inputs, output) -> None:
    ctx.save_for_backward(output[1], inputs[0])
    ctx.mark_non_differentiable(output[1])


def _backward(ctx, by_energies, _):
    slopes, u = ctx.saved_tensors
    return _Once.apply(slopes, by_energies, u), None, None, None, None


class _Once(torch.autograd.Function):
    """The gradient by u, which says that it depends on u but not how."""

    @staticmethod
    def forward(slopes, by_energies, u):
        return slopes * by_energies[:, None, None, None]

    @staticmethod
    def setup_context(ctx, inputs, output) -> None: ...

    @staticmethod
    def backward(ctx, *_):
        raise RuntimeError("expected first derivatives of F_ε in float32, got a second one: take float64 for it")


_energies.register_autograd(_backward, setup_context=_keep)
