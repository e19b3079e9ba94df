"""What images show beside the structure: uneven light, stripes, rings, lost stain, clutter.

Each function returns a factor or a term, and `degrade` says where in the chain it belongs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.data_synth.imaging.maths import bell, checked, edges
from curvafit.data_synth.imaging.randomness import correlated, seeds_of, stream, uniform
from curvafit.priors.shapes import Float

#: How fast the stain fades at the end of a lost stretch: a part of the random field's deviation.
FADING = 0.2
#: Places that a speck tries before it is given up as having none outside the structure.
TRIES = 8


def bias(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, length: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the factor of uneven illumination: a smooth factor that goes from 1 - strength to 1 + strength, correlated
    by `length`.

    Raises
    ------
    ValueError
        If the strength is not in [0, 1], the length not positive, or there is not one seed a sample.
    """
    if not 0 <= strength <= 1 or not length > 0:
        raise ValueError(f"expected a bias in [0, 1] and a positive length, got {strength} and {length}")
    field = correlated(like, [length / h for h in edges(spacing)], seeds, "bias")
    low, high = field.amin((1, 2, 3, 4), keepdim=True), field.amax((1, 2, 3, 4), keepdim=True)
    middle, half = (high + low) / 2, ((high - low) / 2).clamp_min(torch.finfo(field.dtype).tiny)
    return (field - middle).mul_(strength / half).add_(1)


def stripes(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, width: float,
    seeds: Sequence[int], axis: int = 2,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the stripes along an axis (0, 1, 2 for z, y, x), as shadows in a light sheet or a milling curtain make: a
    factor of mean 1 and standard deviation `strength`, not below 0, constant along the axis, correlated by `width`
    across it.

    Raises
    ------
    ValueError
        If the strength is negative, the width not positive, the axis another, or there is not one seed a sample.
    """
    if not 0 <= strength < math.inf or not width > 0 or axis not in (0, 1, 2):
        raise ValueError(
            f"expected stripes from 0, a width above 0 and an axis 0 to 2, got {strength}, {width}, {axis}"
        )
    lengths = [width / h for h in edges(spacing)]
    lengths[axis] = math.inf
    return correlated(like, lengths, seeds, "stripes").mul_(strength).add_(1).clamp_min_(0).expand(like.shape)


def rings(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, width: float,
    seeds: Sequence[int], centre: tuple[float, float] | None = None,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the rings about an axis along z, as defects of a CT detector leave: a term of mean 0 and deviation
    `strength`.

    A slice's rings are its own, since a detector's row makes a slice. Few are strong: the profile over the radius is
    g|g|/√3 of a normal g, correlated by `width`.

    Parameters
    ----------
    centre
        Of the rings (y, x), from the box's corner; by default drawn in the box and half as far again on each side.

    Raises
    ------
    ValueError
        If the strength is negative, the width not positive, or there is not one seed a sample.
    """
    if not 0 <= strength < math.inf or not width > 0:
        raise ValueError(f"expected rings from 0 and a width above 0, got {strength} and {width}")
    steps = edges(spacing)
    terms = [_rings(like[k : k + 1], steps, width, seed, centre) for k, seed in enumerate(seeds_of(seeds, len(like)))]
    return torch.cat(terms) * strength


def dropout(
    occupied: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], share: float, length: float, loss: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the factor of lost stain: smooth, 1 where the stain holds and down to 1 - loss in stretches.

    A random field of correlation `length` decides: where that is over a tube's radius, stretches of tube fade.

    Parameters
    ----------
    share
        Of the structure (voxels at least half full), what loses more than half of `loss`.

    Raises
    ------
    ValueError
        If share or loss is not in [0, 1], the length not positive, or there is not one seed a sample.
    """
    if not (0 <= share <= 1 and 0 <= loss <= 1 and length > 0):
        raise ValueError(f"expected a share and a loss in [0, 1] and a length above 0, got {share}, {loss}, {length}")
    inside = checked(occupied, "an occupancy") >= 0.5
    field = correlated(occupied, [length / h for h in edges(spacing)], seeds, "dropout")
    level = [_upper(each[within], share) for each, within in zip(field, inside, strict=True)]
    threshold = torch.stack(level)[:, None, None, None, None]
    return 1 - loss * torch.sigmoid((field - threshold) / FADING)


def clutter(
    occupied: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], density: float, radius: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return specks outside the structure: Gaussian blobs up to 1 high, 0 wherever a voxel is full.

    Their number is Poisson's, at `density` a unit of volume; half-widths (deviations) along each axis are uniform in
    (½, 1½) radius, heights in (½, 1).

    Raises
    ------
    ValueError
        If the density is negative, the radius not positive, or there is not one seed a sample.
    """
    if not 0 <= density < math.inf or not radius > 0:
        raise ValueError(f"expected a density from 0 and a positive radius, got {density} and {radius}")
    checked(occupied, "an occupancy")
    steps = edges(spacing)
    each = [
        _specks(occupied[k : k + 1], steps, density, radius, seed)
        for k, seed in enumerate(seeds_of(seeds, len(occupied)))
    ]
    return torch.cat(each) * (1 - occupied)


def _rings(like: Tensor, steps: Sequence[float], width: float, seed: int, centre: tuple[float, float] | None) -> Tensor:
    _, _, depth, *sides = like.shape
    if centre is None:
        drawn = uniform(2, seed, "ring centre", like).tolist()
        middle = [(2 * share - 0.5) * n * h for share, n, h in zip(drawn, sides, steps[1:], strict=True)]
    else:
        middle = centre
    places = [torch.arange(n, device=like.device, dtype=like.dtype) + 0.5 for n in sides]
    y, x = (place * h - at for place, h, at in zip(places, steps[1:], middle, strict=True))
    step = min(width, *steps[1:])
    radius = torch.hypot(y[:, None], x) / step
    count = int(radius.amax()) + 2
    normal = correlated(like.new_empty(1, 1, depth, 1, count), (0, 0, width / step), [seed], "rings")[0, 0, :, 0]
    profile = normal * normal.abs() / math.sqrt(3)
    near = radius.long()
    between = torch.lerp(profile[:, near], profile[:, near + 1], radius - near)
    return between[None, None]


def _upper(values: Tensor, share: float) -> Tensor:
    """Return the value that `share` of them exceed: with a share of 0 none does, with 1 all do."""
    count = values.numel()
    passed = round(share * count)
    if passed == 0 or passed == count:
        return values.new_tensor(math.inf if passed == 0 else -math.inf)
    return values.kthvalue(count - passed).values


def _specks(occupied: Tensor, steps: Sequence[float], density: float, radius: float, seed: int) -> Tensor:
    shape = occupied.shape[2:]
    sides = occupied.new_tensor([n * h for n, h in zip(shape, steps, strict=True)])
    mean = occupied.new_tensor(density * math.prod(sides.tolist()))
    count = int(torch.poisson(mean, generator=stream(seed, "clutter count", occupied.device)))
    drawn = uniform(count * (3 * TRIES + 4), seed, "clutter", occupied).reshape(count, 3 * TRIES + 4)
    tried = drawn[:, 4:].reshape(count, TRIES, 3)
    voxel = (tried * torch.tensor(shape, device=tried.device)).long().unbind(-1)
    free = occupied[0, 0][voxel] == 0
    place = tried[torch.arange(count, device=tried.device), free.long().argmax(1)] * sides
    height = (0.5 + 0.5 * drawn[:, 0]) * free.any(1)
    width = radius * (0.5 + drawn[:, 1:4])
    z, y, x = (_bells(n, h, place[:, k], width[:, k]) for k, (n, h) in enumerate(zip(shape, steps, strict=True)))
    planes = (height[:, None, None] * z[:, :, None] * y[:, None, :]).flatten(1)
    return (planes.mT @ x).reshape(occupied.shape).clamp_max_(1)


def _bells(count: int, step: float, place: Tensor, width: Tensor) -> Tensor:
    """Return the profile of each speck along an axis, (specks, voxels)."""
    at = (torch.arange(count, device=place.device, dtype=place.dtype) + 0.5) * step
    return bell((at - place[:, None]) / width[:, None])
