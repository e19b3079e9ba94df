"""The mathematics of images: linear maps along one axis at a time, and random fields by seed.

A map is a small dense matrix: at the sizes of training crops three matrix products take a sixth of the time of three
passes of a convolution, and the width may change from one voxel to the next. Near the faces of the box a map's weights
are divided by their sum: what lies beyond counts as what lies within. Random numbers depend on a sample's seed and on
their purpose alone, whatever batch the sample is in. A volume is `(B, 1, Z, Y, X)`.
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

#: Squared deviations at which a Gaussian ends.
CUT = 16.0


def apply_matrices(
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


def gaussian_matrix(count: int, width: float | Tensor, like: Tensor) -> Tensor | None:
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
    """Return exp(-½ far²), and 0 where far is over four.

    The square is clipped first: arithmetic with denormal numbers is slow.
    """
    square = far.square().clamp_max_(CUT)
    return torch.exp(-0.5 * square).masked_fill_(square == CUT, 0)


def sampling_matrix(count: int, spacing: float, onto: float, window: float, like: Tensor) -> Tensor | None:
    """Return the matrix that samples voxels of edge `spacing` at voxels of edge `onto`, each the mean over a `window`.

    The corners of both grids' first voxels coincide. A window narrower than a voxel is as wide as one: the means are
    then linear interpolations. `None` where nothing changes.
    """
    window = max(window, spacing)
    fits = count_samples(count, spacing, onto)
    if fits == count and math.isclose(spacing, onto) and math.isclose(window, spacing):
        return None
    centre = (torch.arange(fits, dtype=torch.float64)[:, None] + 0.5) * onto
    edge = torch.arange(count, dtype=torch.float64) * spacing
    upper, lower = (centre + window / 2).minimum(edge + spacing), (centre - window / 2).maximum(edge)
    weight = (upper - lower).clamp_min(0)
    return (weight / weight.sum(-1, keepdim=True)).to(like)


def count_samples(count: int, spacing: float, onto: float) -> int:
    """Return how many voxels of edge `onto` fit into `count` of edge `spacing`; at least one."""
    return max(1, math.floor(count * spacing / onto + 1e-6))


def check_volume(volume: Tensor, name: str = "a volume") -> Tensor:
    """Return the volume, if it is `(B, 1, Z, Y, X)`, of a floating type and finite."""
    if volume.ndim != 5 or volume.shape[1] != 1 or not volume.numel():
        raise ValueError(f"{name} must be of shape (B, 1, Z, Y, X), got {tuple(volume.shape)}")
    if not volume.dtype.is_floating_point:
        raise ValueError(f"{name} must be of a floating type, got {volume.dtype}")
    if not torch.isfinite(volume.sum()) and not torch.isfinite(volume).all():
        raise ValueError(f"{name} must be finite, got NaN or infinity")
    return volume


def as_triple(value: float | Sequence[float], name: str) -> Triple:
    """Return three numbers (z, y, x) from 0; one number counts for all."""
    numbers = (value,) * 3 if isinstance(value, (int, float)) else tuple(value)
    if len(numbers) != 3 or not all(math.isfinite(h) and h >= 0 for h in numbers):
        raise ValueError(f"{name} must be 3 numbers (z, y, x) from 0, got {value!r}")
    return float(numbers[0]), float(numbers[1]), float(numbers[2])


def as_spacing(spacing: float | Sequence[float]) -> Triple:
    """Return a spacing as three lengths (z, y, x) above 0; one number counts for all."""
    steps = as_triple(spacing, "a spacing")
    if not all(steps):
        raise ValueError(f"the spacing must be 3 positive numbers (z, y, x), got {spacing!r}")
    return steps


# ---- random fields ---------------------------------------------------------------------------------------------------


def stream(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the generator of a sample for one purpose; another device draws other numbers."""
    words = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),))
    return torch.Generator(device).manual_seed(int(words.generate_state(1)[0]))


def white_noise(shape: tuple[int, ...], like: Tensor, seeds: Sequence[int], purpose: str) -> Tensor:
    """Return independent standard normal numbers (batch, 1, *shape), of the type and on the device of `like`."""
    drawn = [
        torch.randn((1, *shape), generator=stream(seed, purpose, like.device), device=like.device, dtype=like.dtype)
        for seed in seeds_of(seeds, len(like))
    ]
    return torch.stack(drawn)


def correlated_field(
    like: Float[Tensor, "b 1 z y x"], lengths: Sequence[float], seeds: Sequence[int], purpose: str
) -> Float[Tensor, "b 1 z y x"]:
    """Return a Gaussian random field of mean 0 and variance 1 whose correlation over a distance d is exp(-½ Σ
    (d/length)²).

    White noise on nodes, interpolated by Gaussians; each row's weights have a sum of squares of one, so that the
    variance is one everywhere, near the faces too.

    Parameters
    ----------
    lengths
        Along (z, y, x), in voxels. Under half a voxel there is no correlation left; infinity means constant.
    """
    shape = like.shape[2:]
    maps = [_interpolate_nodes(n, length, like) for n, length in zip(shape, lengths, strict=True)]
    nodes = tuple(n if weights is None else weights.shape[-1] for n, weights in zip(shape, maps, strict=True))
    return apply_matrices(white_noise(nodes, like, seeds, purpose), *maps)


def grainy_noise(
    like: Float[Tensor, "b 1 z y x"], widths: Sequence[float], seeds: Sequence[int], purpose: str
) -> Float[Tensor, "b 1 z y x"]:
    """Return standard normal noise, smoothed by a Gaussian of deviations `widths` voxels: correlated by √2 widths."""
    noise = white_noise(tuple(like.shape[2:]), like, seeds, purpose)
    if not any(widths):
        return noise
    maps = [gaussian_matrix(n, width, like) for n, width in zip(like.shape[2:], widths, strict=True)]
    units = [None if weights is None else weights / weights.square().sum(-1, keepdim=True).sqrt() for weights in maps]
    return apply_matrices(noise, *units)


def uniform(count: int, seed: int, purpose: str, like: Tensor) -> Tensor:
    """Return `count` numbers in [0, 1) of a sample."""
    generator = stream(seed, purpose, like.device)
    return torch.rand(count, generator=generator, device=like.device, dtype=like.dtype)


def seeds_of(seeds: Sequence[int], count: int) -> list[int]:
    """Return the seeds, if there is one a sample and all are whole numbers from 0."""
    sound = [isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and seed >= 0 for seed in seeds]
    if len(sound) != count or not all(sound):
        raise ValueError(f"seeds must be {count} whole numbers from 0, one a sample, got {list(seeds)!r:.80}")
    return [int(seed) for seed in seeds]


def _interpolate_nodes(count: int, length: float, like: Tensor) -> Tensor | None:
    """Return the weights (count, nodes) that interpolate random nodes.

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
    weight = bell((place[:, None] - nodes) / width)
    return weight / weight.square().sum(-1, keepdim=True).sqrt()
