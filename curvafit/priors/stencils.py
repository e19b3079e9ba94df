"""Finite differences, their exact adjoints, and the Gaussian blur.

Fields are `(..., Z, Y, X)` tensors of any floating type on any device. Vectors add an axis of 3 (z, y, x) before
the space axes, Hessians an axis of 6 (zz, yy, xx, zy, zx, yx). Beyond the box a field continues periodically or as its
mirror image. The transpose of a difference is then the same difference of another continuation: periodic, or mirrored
with a sign along the axes that are differenced once.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.grid import Float, Grid

#: The greatest standard deviation of a blur, in voxels: it has eighty thousand weights.
WIDEST = 10_000
#: Axis pairs of the six Hessian components, in storage order.
HESSIAN_AXES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def pad(u: Float[Tensor, "*batch z y x"], grid: Grid, width: int = 1, odd: tuple[int, ...] = ()) -> Tensor:
    """Continue `u` by `width` voxels on every side: periodic, or mirrored (with a sign along the axes in `odd`)."""
    for axis, n in enumerate(u.shape[-3:]):
        dim = axis - 3
        head, tail = u.narrow(dim, 0, width), u.narrow(dim, n - width, width)
        if grid.periodic:
            head, tail = tail, head
        else:
            sign = -1 if axis in odd else 1
            head, tail = sign * head.flip(dim), sign * tail.flip(dim)
        u = torch.cat((head, u, tail), dim)
    return u


def gradient(u: Float[Tensor, "*batch z y x"], grid: Grid) -> Float[Tensor, "*batch 3 z y x"]:
    """Return central differences [-1, 0, 1] / 2Δx."""
    v = pad(_check_shape(u, grid), grid)
    return torch.stack([_central(v, axis) / (2 * h) for axis, h in enumerate(grid.spacing)], -4)


def gradient_adjoint(p: Float[Tensor, "*batch 3 z y x"], grid: Grid) -> Float[Tensor, "*batch z y x"]:
    """Apply the transpose of `gradient`: ⟨∇u, p⟩ = ⟨u, ∇ᵀp⟩ as plain sums over voxels."""
    _check_shape(p, grid)
    return sum(
        -_central(pad(p.select(-4, axis), grid, odd=(axis,)), axis) / (2 * h) for axis, h in enumerate(grid.spacing)
    )  # type: ignore[return-value]


def divergence(vector: Float[Tensor, "*batch 3 z y x"], grid: Grid) -> Float[Tensor, "*batch z y x"]:
    """Return div A = -∇ᵀA under either boundary, so that ∫ div A = 0 exactly (no flux through the box)."""
    return -gradient_adjoint(vector, grid)


def hessian(u: Float[Tensor, "*batch z y x"], grid: Grid) -> Float[Tensor, "*batch 6 z y x"]:
    """Return second differences: [1, -2, 1] on the diagonal, the 4-point cross off the diagonal (19 points in all)."""
    v = pad(_check_shape(u, grid), grid)
    return torch.stack([_second(v, i, j) / (grid.spacing[i] * grid.spacing[j]) for i, j in HESSIAN_AXES], -4)


def gaussian_blur(u: Float[Tensor, "*batch z y x"], grid: Grid, width: float) -> Float[Tensor, "*batch z y x"]:
    """Return k ∗ u, k a separable Gaussian of standard deviation `width` (in spacing's unit), cut at four deviations.

    The blur is its own adjoint under both boundaries, since the continuation beyond the box is a reflection group's.
    """
    _check_shape(u, grid)
    check_blur(grid, width)
    if width == 0:
        return u
    for axis, h in enumerate(grid.spacing):
        taps = gaussian_taps(width / h)
        radius, dim, n = len(taps) // 2, axis - 3, grid.shape[axis]
        v = _pad_axis(u, grid, axis, radius)
        u = taps[radius] * v.narrow(dim, radius, n)
        for k in range(radius):
            u = u.add_(v.narrow(dim, k, n) + v.narrow(dim, 2 * radius - k, n), alpha=taps[k])
    return u


def check_blur(grid: Grid, width: float) -> None:
    """Raise ValueError where a blur is wider than the box's longest side, and so leaves only the field's mean."""
    if not 0 <= width <= grid.longest:
        raise ValueError(f"expected a blur from 0 to the box's longest side, {grid.longest:g}, got {width:g}")


def gaussian_taps(deviation: float) -> tuple[float, ...]:
    """Return the 2⌈4σ⌉ + 1 weights of the one-dimensional blur, whose sum is one; the deviation σ is in voxels."""
    if not 0 < deviation <= WIDEST:
        raise ValueError(f"expected a blur width above 0 and of at most {WIDEST} voxels, got {deviation:g}")
    radius = math.ceil(4 * deviation)
    taps = [math.exp(-0.5 * (k / deviation) * (k / deviation)) for k in range(-radius, radius + 1)]
    return tuple(w / math.fsum(taps) for w in taps)


def refine_axis(u: Tensor, axis: int, times: int) -> Tensor:
    """Return `u (..., Z, Y, X)` with every voxel along `axis` (0 to 2) split into `times`; differentiable.

    The interpolation is the quintic spline through the samples, sixth-order accurate: F_ε takes second differences of
    it. Beyond its ends the field continues as its mirror image.
    """
    if times == 1:
        return u
    dim = axis - 3
    if torch.compiler.is_compiling():
        weights = _spline_weights(u.shape[dim], times)
    else:
        weights = torch.from_numpy(_compute_spline_weights(u.shape[dim], times))
    return torch.movedim(torch.movedim(u, dim, -1) @ weights.to(u), -1, dim).contiguous()


def _pad_axis(v: Tensor, grid: Grid, axis: int, width: int) -> Tensor:
    """Continue a field by `width` voxels, any number, at both ends of an axis."""
    dim, n = axis - 3, grid.shape[axis]
    index = torch.arange(-width, n + width, device=v.device) % (n if grid.periodic else 2 * n)
    return v.index_select(dim, torch.where(index < n, index, 2 * n - 1 - index))


def _central(v: Tensor, axis: int) -> Tensor:
    """Return the difference of both neighbours along an axis."""
    return _shift(v, {axis: 1}) - _shift(v, {axis: -1})


def _second(v: Tensor, i: int, j: int) -> Tensor:
    """Return the second difference along axes i and j."""
    if i == j:
        return _shift(v, {i: 1}) - 2 * _shift(v, {}) + _shift(v, {i: -1})
    diagonal = _shift(v, {i: 1, j: 1}) + _shift(v, {i: -1, j: -1})
    return (diagonal - _shift(v, {i: 1, j: -1}) - _shift(v, {i: -1, j: 1})) / 4


def _shift(v: Tensor, offset: dict[int, int]) -> Tensor:
    """Return the box within a field padded by one voxel, shifted by the offset (-1, 0 or 1) along each axis."""
    for axis in range(3):
        v = v.narrow(axis - 3, 1 + offset.get(axis, 0), v.shape[axis - 3] - 2)
    return v


def _check_shape(u: Tensor, grid: Grid) -> Tensor:
    """Return a field; raise ValueError where its shape is not the grid's."""
    if tuple(u.shape[-3:]) != grid.shape:
        raise ValueError(f"expected a field whose last axes are {grid.shape}, got {tuple(u.shape)}")
    return u


@lru_cache(maxsize=32)
def _compute_spline_weights(n: int, times: int) -> np.ndarray:
    """Return interpolation weights `(n, n · times)`, a column for each new sample: V⁻¹ S.

    Row i of V (n columns) holds the quintic B-spline around sample i and its mirror images at the positions of all
    samples; row i of S (n · times columns), the same at the positions of the new ones.
    """
    matrices = []
    for positions in (np.arange(n, dtype=float), (np.arange(n * times) + 0.5) / times - 0.5):
        matrix, first = np.zeros((n, len(positions))), np.floor(positions).astype(int) - 2
        for centres in (first + k for k in range(6)):  # the splines that are not 0 at a position
            samples = centres % (2 * n)
            samples = np.where(samples < n, samples, 2 * n - 1 - samples)
            matrix[samples, np.arange(len(positions))] += _quintic_spline(positions - centres)
        matrices.append(matrix)
    return np.ascontiguousarray(np.linalg.solve(*matrices))  # a cached tensor would belong to `torch.func`'s transform


def _quintic_spline(x: np.ndarray) -> np.ndarray:
    """Return the quintic B-spline of unit knots around 0, as its sum of powers."""
    return sum((-1) ** k * math.comb(6, k) / 120 * np.maximum(np.abs(x) + 3 - k, 0) ** 5 for k in range(7))  # type: ignore[return-value]


# Compilers and `torch.export` see an operator: what they trace with has no numbers to solve with, or to keep.
@torch.library.custom_op("curvafit::spline_weights", mutates_args=(), schema="(SymInt n, SymInt times) -> Tensor")
def _spline_weights(n, times):
    return torch.from_numpy(_compute_spline_weights(n, times).copy())


@_spline_weights.register_fake
def _(n, times):
    return torch.empty((n, n * times), dtype=torch.float64)
