"""Random numbers by seed: every sample its own, every purpose its own, whatever batch the sample is in."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from curvafit.data_synth.imaging.maths import along, bell, gaussian
from curvafit.priors.shapes import Float


def stream(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the generator of a sample for one purpose; another device draws other numbers."""
    words = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),))
    return torch.Generator(device).manual_seed(int(words.generate_state(1)[0]))


def white(like: Float[Tensor, "b 1 z y x"], seeds: Sequence[int], purpose: str) -> Float[Tensor, "b 1 z y x"]:
    """Return independent standard normal numbers.

    Raises
    ------
    ValueError
        If there is not one seed a sample, a whole number from 0.
    """
    return _drawn(tuple(like.shape[2:]), like, seeds, purpose)


def correlated(
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
    maps = [_interpolation(n, length, like) for n, length in zip(shape, lengths, strict=True)]
    nodes = tuple(n if each is None else each.shape[-1] for n, each in zip(shape, maps, strict=True))
    return along(_drawn(nodes, like, seeds, purpose), *maps)


def grainy(
    like: Float[Tensor, "b 1 z y x"], widths: Sequence[float], seeds: Sequence[int], purpose: str
) -> Float[Tensor, "b 1 z y x"]:
    """Return standard normal numbers, smoothed by a Gaussian of deviations `widths` (voxels): `correlated` by √2
    widths."""
    if not any(widths):
        return white(like, seeds, purpose)
    maps = [gaussian(n, width, like) for n, width in zip(like.shape[2:], widths, strict=True)]
    units = [None if each is None else each / each.square().sum(-1, keepdim=True).sqrt() for each in maps]
    return along(white(like, seeds, purpose), *units)


def uniform(count: int, seed: int, purpose: str, like: Tensor) -> Tensor:
    """Return `count` numbers in [0, 1) of a sample."""
    generator = stream(seed, purpose, like.device)
    return torch.rand(count, generator=generator, device=like.device, dtype=like.dtype)


def seeds_of(seeds: Sequence[int], count: int) -> list[int]:
    """Return the seeds, if there is one a sample and all are whole numbers from 0.

    Raises
    ------
    ValueError
        If they are not.
    """
    whole = [not isinstance(each, bool) and isinstance(each, (int, np.integer)) and each >= 0 for each in seeds]
    if len(whole) != count or not all(whole):
        raise ValueError(f"expected {count} seeds, whole numbers from 0, one a sample, got {list(seeds)!r:.80}")
    return [int(each) for each in seeds]


def _drawn(shape: tuple[int, ...], like: Tensor, seeds: Sequence[int], purpose: str) -> Tensor:
    drawn = [
        torch.randn((1, *shape), generator=stream(seed, purpose, like.device), device=like.device, dtype=like.dtype)
        for seed in seeds_of(seeds, len(like))
    ]
    return torch.stack(drawn)


def _interpolation(count: int, length: float, like: Tensor) -> Tensor | None:
    """Return (count, nodes) weights; nodes are a deviation apart, at least a voxel, and go four deviations beyond the
    box."""
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
