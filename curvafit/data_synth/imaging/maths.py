"""The mathematics of images: linear maps along one axis at a time, and random fields by seed.

A map is a small dense matrix: at the sizes of training crops three matrix products take a sixth of the time of three
passes of a convolution, and the width may change from one voxel to the next. Near the faces of the box a map's weights
are divided by their sum: what lies beyond counts as what lies within. Random numbers depend on a seed and on their
purpose alone.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.grid import Float

Triple = tuple[float, float, float]
#: Lengths along (z, y, x), or one for all three.
Lengths = float | Sequence[float]
Volume = Float[Tensor, "z y x"]

#: Squared deviations at which a Gaussian ends.
CUT = 16.0


def apply_matrices(
    volume: Volume, z: Tensor | None = None, y: Tensor | None = None, x: Tensor | None = None
) -> Float[Tensor, "Z Y X"]:
    """Apply a matrix (out, in), or None, along each axis; those of y and x may differ by slice, (Z, out, in)."""
    if x is not None:
        volume = volume @ x.mT
    if y is not None:
        volume = y @ volume
    if z is not None:
        volume = torch.tensordot(z, volume, 1)
    return volume


def gaussian_matrix(count: int, width: float | Tensor, like: Tensor) -> Tensor | None:
    """Return the matrix (count, count) of a blur by a Gaussian of deviation `width` voxels, cut at four; None for 0.

    Widths (…, 1, 1) give a matrix each; widths (count, 1) are those of the rows.
    """
    if not isinstance(width, Tensor) and width == 0:
        return None
    place = torch.arange(count, device=like.device, dtype=like.dtype)
    weight = bell((place[:, None] - place) / width)
    return weight / weight.sum(-1, keepdim=True)


def bell(far: Tensor) -> Tensor:
    """Return exp(-½ far²), and 0 where far is over four."""
    # The square is clipped first, since arithmetic with denormal numbers is slow.
    square = far.square().clamp_max_(CUT)
    return torch.exp(-0.5 * square).masked_fill_(square == CUT, 0)


def sampling_matrix(count: int, spacing: float, onto: float, window: float, like: Tensor) -> Tensor | None:
    """Return the matrix that samples voxels of edge `spacing` at voxels of edge `onto`, each the mean over a `window`.

    The corners of both grids' first voxels coincide. A window narrower than a voxel is as wide as one: the means are
    then linear interpolations. `None` where nothing changes.
    """
    window, fits = max(window, spacing), max(1, math.floor(count * spacing / onto + 1e-6))
    if fits == count and math.isclose(spacing, onto) and math.isclose(window, spacing):
        return None
    centre = (torch.arange(fits, dtype=torch.float64)[:, None] + 0.5) * onto
    edge = torch.arange(count, dtype=torch.float64) * spacing
    upper, lower = (centre + window / 2).minimum(edge + spacing), (centre - window / 2).maximum(edge)
    weight = (upper - lower).clamp_min(0)
    return (weight / weight.sum(-1, keepdim=True)).to(like)


def as_triple(value: Lengths) -> Triple:
    """Return three numbers (z, y, x); one number counts for all."""
    z, y, x = (value,) * 3 if isinstance(value, (int, float)) else value
    return z, y, x


# ---- random fields ---------------------------------------------------------------------------------------------------


def stream(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the random generator of a seed for one purpose; another device draws other numbers."""
    words = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),))
    return torch.Generator(device).manual_seed(int(words.generate_state(1)[0]))


def white_noise(shape: tuple[int, ...], like: Tensor, seed: int, purpose: str) -> Tensor:
    """Return independent standard normal numbers of a shape, of the type and on the device of `like`."""
    return torch.randn(shape, generator=stream(seed, purpose, like.device), device=like.device, dtype=like.dtype)


def correlated_field(like: Volume, lengths: Sequence[float], seed: int, purpose: str) -> Volume:
    """Return a Gaussian random field of mean 0, variance 1 and correlation exp(-½ Σ (d/length)²) over a distance d.

    Lengths are along (z, y, x), in voxels; under half a voxel there is no correlation, and infinity means constant.
    White noise on nodes is interpolated by Gaussians; each row's weights have a sum of squares of one, so that the
    variance is one near the faces too.
    """
    maps = [_interpolate_nodes(n, length, like) for n, length in zip(like.shape, lengths, strict=True)]
    nodes = tuple(n if weights is None else weights.shape[-1] for n, weights in zip(like.shape, maps, strict=True))
    return apply_matrices(white_noise(nodes, like, seed, purpose), *maps)


def grainy_noise(like: Volume, widths: Sequence[float], seed: int, purpose: str) -> Volume:
    """Return Gaussian noise of mean 0 and variance 1, smoothed by a Gaussian of deviations `widths` (z, y, x), in
    voxels. Its correlation is a Gaussian of deviations √2 `widths`.
    """
    noise = white_noise(tuple(like.shape), like, seed, purpose)
    maps = [gaussian_matrix(n, width, like) for n, width in zip(like.shape, widths, strict=True)]
    return apply_matrices(noise, *(None if weights is None else _normalise_rows(weights) for weights in maps))


def uniform(count: int, seed: int, purpose: str, like: Tensor) -> Tensor:
    """Return `count` random numbers in [0, 1), of the type and on the device of `like`."""
    generator = stream(seed, purpose, like.device)
    return torch.rand(count, generator=generator, device=like.device, dtype=like.dtype)


def _interpolate_nodes(count: int, length: float, like: Tensor) -> Tensor | None:
    """Return the weights (count, nodes) that interpolate random nodes, or None where every voxel is a node.

    Nodes are a deviation apart, at least a voxel, and go four deviations beyond the box.
    """
    if math.isinf(length):
        return torch.ones((count, 1), device=like.device, dtype=like.dtype)
    if length < 0.5:
        return None
    width = length / math.sqrt(2)
    step, beyond = max(width, 1.0), math.ceil(4 * width)
    nodes = torch.arange(0, count + 2 * beyond, step, device=like.device, dtype=like.dtype) - beyond
    place = torch.arange(count, device=like.device, dtype=like.dtype)
    return _normalise_rows(bell((place[:, None] - nodes) / width))


def _normalise_rows(weights: Tensor) -> Tensor:
    """Return weights whose rows have a sum of squares of one, which keeps the variance of white noise."""
    return weights / weights.square().sum(-1, keepdim=True).sqrt()
