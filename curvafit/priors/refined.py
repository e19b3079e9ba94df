"""A finer sampling of a field along one axis, by cubic convolution."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


def refined(u: Tensor, axis: int, times: int) -> Tensor:
    """Return `u (..., Z, Y, X)` with every voxel along `axis` (0 to 2) split into `times`; differentiable.

    The interpolation is Keys' cubic convolution (a = -1/2), third-order accurate and exact for parabolas. Beyond its
    ends the field continues with the last value.
    """
    if times == 1:
        return u
    dim = axis - 3
    weights = _weights(u.shape[dim], times).to(u)
    return torch.movedim(torch.movedim(u, dim, -1) @ weights, -1, dim).contiguous()


@lru_cache(maxsize=32)
@torch.inference_mode(False)  # cached weights must serve a later backward pass
def _weights(n: int, times: int) -> Tensor:
    """Return interpolation weights `(n, n · times)`, a column for each new sample."""
    place = (torch.arange(n * times, dtype=torch.float64) + 0.5) / times - 0.5
    first = place.floor()
    t = place - first
    four = torch.stack(
        (
            ((2 - t) * t - 1) * t / 2,
            ((3 * t - 5) * t * t + 2) / 2,
            ((4 - 3 * t) * t + 1) * t / 2,
            (t - 1) * t * t / 2,
        )
    )
    weights = torch.zeros(n, n * times, dtype=torch.float64)
    for k in range(4):
        row = (first.long() + k - 1).clamp(0, n - 1)
        weights[row, torch.arange(n * times)] += four[k]
    return weights
