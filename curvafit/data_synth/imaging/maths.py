"""Linear maps along one axis at a time, as small dense matrices: blurs, samplings, random textures.

A volume is `(B, 1, Z, Y, X)`. At the sizes of training crops three matrix products take a sixth of the time of three
passes of a convolution, and the width may change from one voxel to the next. Near the faces of the box a map's weights
are divided by their sum: what lies beyond counts as what lies within.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.priors.shapes import Float

Triple = tuple[float, float, float]

#: Squared deviations at which a Gaussian ends.
CUT = 16.0


def along(
    volume: Float[Tensor, "b 1 z y x"], z: Tensor | None = None, y: Tensor | None = None, x: Tensor | None = None
) -> Float[Tensor, "b 1 Z Y X"]:
    """Apply a matrix (out, in) to each axis, `None` where it stays; that of y or x may be one a slice, (Z, out, in)."""
    if x is not None:
        volume = volume @ x.mT
    if y is not None:
        volume = y @ volume
    if z is not None:
        volume = (z @ volume.flatten(-2)).unflatten(-1, volume.shape[-2:])
    return volume


def gaussian(count: int, width: float | Tensor, like: Tensor) -> Tensor | None:
    """Return the matrix (count, count) of a blur by a Gaussian of deviation `width` voxels, cut at four; `None` for
    width 0.

    A tensor of widths (…, 1, 1) gives a matrix each, one of (count, 1) a width to each row.
    """
    if not isinstance(width, Tensor) and width == 0:
        return None
    place = torch.arange(count, device=like.device, dtype=like.dtype)
    weight = bell((place[:, None] - place) / width)
    return weight / weight.sum(-1, keepdim=True)


def bell(far: Tensor) -> Tensor:
    """Return exp(-½ far²), and 0 where far is over four. It is clipped first: arithmetic with denormal numbers is
    slow."""
    square = far.square().clamp_max_(CUT)
    return torch.exp(-0.5 * square).masked_fill_(square == CUT, 0)


def sampling(count: int, spacing: float, onto: float, window: float, like: Tensor) -> Tensor | None:
    """Return the matrix that samples voxels of edge `spacing` at voxels of edge `onto`, each the mean over a `window`.

    The corners of both grids' first voxels coincide. A window narrower than a voxel is as wide as one: the means are
    then linear interpolations. `None` where nothing changes.
    """
    window = max(window, spacing)
    fits = sampled(count, spacing, onto)
    if fits == count and math.isclose(spacing, onto) and math.isclose(window, spacing):
        return None
    centre = (torch.arange(fits, dtype=torch.float64)[:, None] + 0.5) * onto
    edge = torch.arange(count, dtype=torch.float64) * spacing
    upper, lower = (centre + window / 2).minimum(edge + spacing), (centre - window / 2).maximum(edge)
    weight = (upper - lower).clamp_min(0)
    return (weight / weight.sum(-1, keepdim=True)).to(like)


def sampled(count: int, spacing: float, onto: float) -> int:
    """Return how many voxels of edge `onto` fit into `count` of edge `spacing`; at least one."""
    return max(1, math.floor(count * spacing / onto + 1e-6))


def checked(volume: Tensor, name: str = "a volume") -> Tensor:
    """Return the volume, if it is `(B, 1, Z, Y, X)`, of a floating type and finite.

    Raises
    ------
    ValueError
        If it is not.
    """
    if volume.ndim != 5 or volume.shape[1] != 1 or not volume.numel():
        raise ValueError(f"expected {name} of shape (B, 1, Z, Y, X), got {tuple(volume.shape)}")
    if not volume.dtype.is_floating_point:
        raise ValueError(f"expected {name} of a floating type, got {volume.dtype}")
    if not torch.isfinite(volume.sum()) and not torch.isfinite(volume).all():
        raise ValueError(f"expected {name} of finite values, got NaN or infinity")
    return volume


def triple(value: float | Sequence[float], name: str) -> Triple:
    """Return three numbers (z, y, x) from 0, or one for all."""
    numbers = (value,) * 3 if isinstance(value, (int, float)) else tuple(value)
    if len(numbers) != 3 or not all(math.isfinite(h) and h >= 0 for h in numbers):
        raise ValueError(f"expected {name} of 3 numbers (z, y, x) from 0, got {value!r}")
    return float(numbers[0]), float(numbers[1]), float(numbers[2])


def edges(spacing: float | Sequence[float]) -> Triple:
    """Return a spacing: three lengths above 0, or one for all."""
    steps = triple(spacing, "a spacing")
    if not all(steps):
        raise ValueError(f"expected a spacing of 3 positive numbers (z, y, x), got {spacing!r}")
    return steps
