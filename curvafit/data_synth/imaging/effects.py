"""The effects of an image, in the order of the physics: optics, artefacts of specimen and light, noise.

Pure, seeded functions of `(Z, Y, X)` tensors of a floating type, on any device; `modality.image` chains them. Lengths
are in the unit of the spacing, which is one number for cubic voxels or three (z, y, x). Values are photons where noise
is counted in photons, grey values elsewhere. Depth grows along z, from 0 at the face of the first voxel. An effect's
random numbers depend on its seed alone. `Imaging` documents the parameters and checks their ranges.

Below the effects are linear maps along one axis at a time, as small dense matrices: at the sizes of training crops
three matrix products take a sixth of the time of three convolutions, and the width may change from voxel to voxel.
Near the faces of the box a map's weights are divided by their sum: what lies beyond counts as what lies within.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Float
from curvafit.priors.profile import profile_distance

Triple = tuple[float, float, float]
#: Lengths along (z, y, x), or one for all three.
Lengths = float | Sequence[float]
Voxels = Float[Tensor, "z y x"]

#: ε of a generated shape, in its voxels.
EPSILON = WORKING_EPSILON / WORKING_SPACING
#: Positions that are tried for a speck, until one is outside the structure.
TRIES = 8
#: Below this mean a Poisson quantile is summed up; above it, Giles's expansion is within a count.
FEW = 2.0
#: Counts that the sum goes to: P(X > 12) is 2e-7 at a mean of 2.
MOST = 12


# ---- optics ----------------------------------------------------------------------------------------------------------


def occupancy(field: Voxels, epsilon: float = EPSILON) -> Voxels:
    """Return the share of each cubic voxel that is inside the shape (partial volume); ε is in voxels.

    The profile tanh(d / √2 ε) holds the sub-voxel distance d = √2 ε artanh u, and the share is d + ½ clipped to [0, 1]:
    exact for a plane along an axis. A tilted plane's ramp is longer with softer ends; its second moment is the same
    1/12, and the difference nowhere over 0.05.
    """
    return profile_distance(field, epsilon).add_(0.5).clamp_(0, 1)


def texture(like: Voxels, spacing: Lengths, deviation: float, length: float, seed: int, purpose: str) -> Voxels:
    """Return a random factor of mean 1 and standard deviation `deviation`, correlated by `length`.

    The factor is lognormal; its logarithm is a `_correlated_field`. Textures of different `purpose` are independent.
    """
    spread = math.sqrt(math.log1p(deviation**2))
    return _correlated_field(like, spacing, length, seed, purpose).mul_(spread).sub_(spread**2 / 2).exp_()


def blur(image: Voxels, spacing: Lengths, widths: Lengths, growth: float = 0.0, attenuation: float = 0.0) -> Voxels:
    """Return the image under a Gaussian point-spread function of standard deviations `widths` along (z, y, x).

    With depth scatter and aberrations widen it to σ(z) = σ(0) (1 + growth z), and weaken light by exp(-attenuation z).
    """
    edges = _as_triple(spacing)
    depth = _centres(len(image), edges[0], image)[:, None]
    wider = 1 + growth * depth  # of each row of z's matrix, and of each slice's matrices of y and x
    factors = (wider, wider[..., None], wider[..., None]) if growth else (1.0, 1.0, 1.0)
    axes = zip(image.shape, _as_triple(widths), edges, factors, strict=True)
    maps = (_gaussian_matrix(n, σ / h * factor if σ else 0.0, image) for n, σ, h, factor in axes)
    image = _apply_matrices(image, *maps)
    return image * torch.exp(-attenuation * depth)[..., None] if attenuation else image


def sample(image: Voxels, spacing: Lengths, onto: Lengths, window: Lengths = 0.0) -> Float[Tensor, "Z Y X"]:
    """Sample an image on a grid of voxels `onto`, each the mean over a `window` about the voxel's centre.

    The window is the slice's thickness and the pixel's size. The corners of both grids' first voxels coincide, and
    voxels that do not fit into the box are left out. Along an axis whose window is narrower than an old voxel, the
    value is interpolated linearly.
    """
    axes = zip(image.shape, *map(_as_triple, (spacing, onto, window)), strict=True)
    return _apply_matrices(image, *(_sampling_matrix(n, old, new, width, image) for n, old, new, width in axes))


# ---- specimen, light and detector ------------------------------------------------------------------------------------


def bias(like: Voxels, spacing: Lengths, strength: float, length: float, seed: int) -> Voxels:
    """Return the factor of uneven illumination: smooth, from 1 - strength to 1 + strength, correlated by `length`."""
    field = _correlated_field(like, spacing, length, seed, "bias")
    low, high = field.aminmax()
    middle, half = (high + low) / 2, ((high - low) / 2).clamp_min(torch.finfo(field.dtype).tiny)
    return (field - middle).mul_(strength / half).add_(1)


def stripes(like: Voxels, spacing: Lengths, strength: float, width: float, seed: int) -> Voxels:
    """Return the factor of stripes along x, as shadows in a light sheet or a milling curtain make.

    It has mean 1 and deviation `strength`, is not below 0, constant along x, and correlated by `width` across it.
    """
    field = _correlated_field(like, spacing, (width, width, math.inf), seed, "stripes")
    return field.mul_(strength).add_(1).clamp_min_(0).expand(like.shape)


def rings(like: Voxels, spacing: Lengths, strength: float, width: float, seed: int) -> Voxels:
    """Return the rings about an axis along z that defects of a CT detector add to an image, of mean 0.

    Their deviation is `strength`. Each slice has its own, since a detector's row makes a slice. Few are strong: the
    profile over the radius is g|g|/√3 of a normal g, correlated by `width`. The centre lies within twice the box.
    """
    depth, *sides = like.shape
    _, *edges = _as_triple(spacing)
    centre = uniform(2, seed, "ring centre", like).tolist()
    y, x = (_centres(n, h, like) - (2 * c - 0.5) * n * h for c, n, h in zip(centre, sides, edges, strict=True))
    step = min(width, *edges)
    radius = torch.hypot(y[:, None], x) / step
    count = int(radius.amax()) + 2
    normal = _correlated_field(like.new_empty(depth, 1, count), step, (0, 0, width), seed, "rings")[:, 0]
    profile = normal * normal.abs() / math.sqrt(3)
    below = radius.long()
    return torch.lerp(profile[:, below], profile[:, below + 1], radius - below) * strength


def dropout(occupied: Voxels, spacing: Lengths, share: float, length: float, loss: float, seed: int) -> Voxels:
    """Return the factor of lost stain: smooth, 1 where the stain holds, down to 1 - loss where it is lost.

    Stain is lost where a random field of correlation `length` is high: stretches of a tube, where `length` is over its
    radius. A fraction `share` of the structure (voxels at least half full) loses more than half of `loss`.
    """
    field = _correlated_field(occupied, spacing, length, seed, "dropout")
    inside = field[occupied >= 0.5]
    lost = round(share * len(inside))
    all_or_none = -math.inf if lost else math.inf
    threshold = inside.kthvalue(len(inside) - lost).values if 0 < lost < len(inside) else all_or_none
    return 1 - loss * torch.sigmoid((field - threshold) / 0.2)  # the stain fades at the end of a stretch


def clutter(occupied: Voxels, spacing: Lengths, density: float, radius: float, seed: int) -> Voxels:
    """Return specks outside the structure: Gaussian blobs up to 1 high, 0 wherever a voxel is full.

    Their number is Poisson's, at `density` a unit of volume; half-widths (deviations) along each axis are uniform in
    (½, 1½) radius, heights in (½, 1).
    """
    edges = _as_triple(spacing)
    box = occupied.new_tensor([n * h for n, h in zip(occupied.shape, edges, strict=True)])
    mean = occupied.new_tensor(density * math.prod(box.tolist()))
    count = int(torch.poisson(mean, generator=_stream(seed, "clutter count", occupied.device)))
    random = uniform(count * (3 * TRIES + 4), seed, "clutter", occupied).reshape(count, 3 * TRIES + 4)
    # A speck has a height, 3 widths and `TRIES` positions, and stands at the first that is empty, else has no height.
    positions = random[:, 4:].reshape(count, TRIES, 3)
    voxel = (positions * torch.tensor(occupied.shape, device=positions.device)).long().unbind(-1)
    free = occupied[voxel] == 0
    position = positions[torch.arange(count, device=positions.device), free.long().argmax(1)] * box
    height = (0.5 + 0.5 * random[:, 0]) * free.any(1)
    width = radius * (0.5 + random[:, 1:4])
    centres = (_centres(n, h, position) for n, h in zip(occupied.shape, edges, strict=True))
    z, y, x = (_bell((centre - position[:, k, None]) / width[:, k, None]) for k, centre in enumerate(centres))
    planes = (height[:, None, None] * z[:, :, None] * y[:, None, :]).flatten(1)
    return (planes.mT @ x).reshape(occupied.shape).clamp_max_(1) * (1 - occupied)


# ---- noise -----------------------------------------------------------------------------------------------------------


def poisson_gaussian(
    photons: Voxels, gain: float, read_noise: float, offset: float, seed: int, width: Lengths = 0.0
) -> Voxels:
    """Return counts: offset + gain · Poisson(photons) + N(0, read_noise²), whose variance is a line over the mean.

    Photons are means, from 0. A gain of 0 is an instrument whose noise does not depend on the signal: offset + photons
    + N. Noise has the correlation that a Gaussian of deviations `width`, in voxels (z, y, x), leaves, as reconstruction
    and denoising do; every voxel's own law stays as it is.
    """
    if gain:
        photons = gain * poisson_quantile(photons, _grainy_noise(photons, width, seed, "photons"))
    return gaussian_noise(photons + offset, read_noise, seed, width)


def poisson_quantile(mean: Tensor, z: Tensor) -> Tensor:
    """Turn standard normal numbers into Poisson numbers of the same quantile.

    So one random number a voxel makes a count, and smooth noise makes smooth counts. From a mean of `FEW` on by Giles's
    expansion Q̃_N3 ("Algorithm 955", ACM Trans. Math. Softw. 42, 2016), a count off in at most 0.5 % of draws; below by
    summing the probabilities, exact to `MOST` counts.
    """
    root = mean.clamp_min(FEW).sqrt_()
    z2 = z.square()
    quantile = (z2 / 270).add_(7 / 810).mul_(z2).sub_(8 / 405).div_(root)
    quantile.sub_((z2 + 2).mul_(z), alpha=1 / 72).div_(root)
    quantile.add_(z2, alpha=1 / 6).add_(1 / 3).addcmul_(root, root + z).floor_().clamp_min_(0)
    small = mean < FEW
    if bool(small.any()):
        return torch.where(small, _sum_quantile(mean.clamp_max(FEW), z), quantile)
    return quantile


def gaussian_noise(image: Voxels, deviation: float, seed: int, width: Lengths = 0.0) -> Voxels:
    """Return the image plus normal noise of a standard deviation, smoothed by `width` voxels at that deviation."""
    return image + deviation * _grainy_noise(image, width, seed, "read noise") if deviation else image


def rician(image: Voxels, deviation: float, seed: int, width: Lengths = 0.0) -> Voxels:
    """Return the magnitude of a signal with normal noise in both channels: √((v + σ n₁)² + (σ n₂)²).

    The mean square is v² + 2σ²; where there is no signal, the mean is σ √(π/2) (Gudbjartsson and Patz 1995).
    """
    real, imaginary = (_grainy_noise(image, width, seed, f"{name} channel") for name in ("real", "imaginary"))
    return torch.hypot(image + deviation * real, deviation * imaginary)


def _sum_quantile(mean: Tensor, z: Tensor) -> Tensor:
    """Return the Poisson quantiles of small means: how many of the sums P(X ≤ k), k = 0, 1, …, are below Φ(z)."""
    probability = torch.special.ndtr(z)
    term = torch.exp(-mean)
    cumulative = term.clone()
    count = torch.zeros_like(mean, dtype=torch.uint8)
    highest = float(probability.amax())
    for k in range(1, MOST + 1):
        if float(cumulative.amin()) > highest:  # no voxel counts further
            break
        count += (probability > cumulative).view(torch.uint8)
        cumulative += term.mul_(mean).mul_(1 / k)
    return count.to(mean.dtype)


# ---- maps and random fields ------------------------------------------------------------------------------------------


def _apply_matrices(volume: Voxels, z: Tensor | None, y: Tensor | None, x: Tensor | None) -> Float[Tensor, "Z Y X"]:
    """Apply a matrix (out, in), or None, along each axis; those of y and x may differ by slice, (Z, out, in)."""
    volume = volume if x is None else volume @ x.mT
    volume = volume if y is None else y @ volume
    return volume if z is None else torch.tensordot(z, volume, 1)


def _gaussian_matrix(count: int, width: float | Tensor, like: Tensor) -> Tensor | None:
    """Return the matrix (count, count) of a blur by a Gaussian of deviation `width` voxels, cut at four; None for 0.
    Widths (…, 1, 1) give a matrix each; widths (count, 1) are those of the rows."""
    if not isinstance(width, Tensor) and width == 0:
        return None
    position = torch.arange(count, device=like.device, dtype=like.dtype)
    weight = _bell((position[:, None] - position) / width)
    return weight / weight.sum(-1, keepdim=True)


def _bell(distance: Tensor) -> Tensor:
    """Return exp(-½ distance²), and 0 where the distance is over four."""
    # The square is clipped first, since arithmetic with denormal numbers is slow.
    square = distance.square().clamp_max_(16)
    return torch.exp(-0.5 * square).masked_fill_(square == 16, 0)


def _sampling_matrix(count: int, spacing: float, onto: float, window: float, like: Tensor) -> Tensor | None:
    """Return the matrix of `sample` along an axis, None where nothing changes."""
    # A window narrower than a voxel is as wide as one: the means are then linear interpolations.
    window, samples = max(window, spacing), max(1, math.floor(count * spacing / onto + 1e-6))
    if samples == count and math.isclose(spacing, onto) and math.isclose(window, spacing):
        return None
    centre = (torch.arange(samples, dtype=torch.float64)[:, None] + 0.5) * onto
    start = torch.arange(count, dtype=torch.float64) * spacing
    upper, lower = (centre + window / 2).minimum(start + spacing), (centre - window / 2).maximum(start)
    weight = (upper - lower).clamp_min(0)  # the length by which a window and a voxel overlap
    return (weight / weight.sum(-1, keepdim=True)).to(like)


def _as_triple(value: Lengths) -> Triple:
    z, y, x = (value,) * 3 if isinstance(value, (int, float)) else value
    return z, y, x


def _stream(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the random generator of a seed for one purpose; another device draws other numbers."""
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),))
    return torch.Generator(device).manual_seed(int(sequence.generate_state(1)[0]))


def _correlated_field(like: Voxels, spacing: Lengths, lengths: Lengths, seed: int, purpose: str) -> Voxels:
    """Return a Gaussian random field of mean 0, variance 1 and correlation exp(-½ Σ (d/length)²) at a distance d; a
    length under half a voxel means no correlation, infinity a constant."""
    axes = zip(like.shape, _as_triple(lengths), _as_triple(spacing), strict=True)
    return _map_noise(like, [_interpolate_nodes(n, length / h, like) for n, length, h in axes], seed, purpose)


def _grainy_noise(like: Voxels, widths: Lengths, seed: int, purpose: str) -> Voxels:
    """Return noise of mean 0 and variance 1, smoothed by a Gaussian of deviations `widths` (z, y, x) in voxels."""
    axes = zip(like.shape, _as_triple(widths), strict=True)
    return _map_noise(like, [_gaussian_matrix(n, width, like) for n, width in axes], seed, purpose)


def _map_noise(like: Voxels, maps: Sequence[Tensor | None], seed: int, purpose: str) -> Voxels:
    """Return white noise under a matrix, or None, along each axis, whose rows are scaled to keep a variance of 1."""
    nodes = tuple(n if weights is None else weights.shape[-1] for n, weights in zip(like.shape, maps, strict=True))
    noise = torch.randn(nodes, generator=_stream(seed, purpose, like.device), device=like.device, dtype=like.dtype)
    return _apply_matrices(noise, *(w if w is None else w / w.square().sum(-1, keepdim=True).sqrt() for w in maps))


def uniform(count: int, seed: int, purpose: str, like: Tensor) -> Tensor:
    """Return `count` random numbers in [0, 1), of the type and on the device of `like`."""
    generator = _stream(seed, purpose, like.device)
    return torch.rand(count, generator=generator, device=like.device, dtype=like.dtype)


def _interpolate_nodes(count: int, length: float, like: Tensor) -> Tensor | None:
    """Return the weights (count, nodes) that interpolate random nodes, or None where every voxel is a node."""
    # Nodes are a deviation apart, at least a voxel, and go four deviations beyond the box.
    if math.isinf(length):
        return torch.ones((count, 1), device=like.device, dtype=like.dtype)
    if length < 0.5:
        return None
    width = length / math.sqrt(2)  # white noise smoothed by this deviation has the correlation length
    step, beyond = max(width, 1.0), math.ceil(4 * width)
    nodes = torch.arange(0, count + 2 * beyond, step, device=like.device, dtype=like.dtype) - beyond
    position = torch.arange(count, device=like.device, dtype=like.dtype)
    return _bell((position[:, None] - nodes) / width)


def _centres(count: int, step: float, like: Tensor) -> Tensor:
    """Return the centres of voxels along an axis, of the type and on the device of `like`."""
    return (torch.arange(count, device=like.device, dtype=like.dtype) + 0.5) * step
