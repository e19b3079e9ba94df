"""The effects of an image, in the order of the physics: optics, artefacts of specimen and light, noise.

Pure, seeded functions of `(B, 1, Z, Y, X)` tensors of a floating type, on any device; `imaging.image` chains them.
Lengths are in the unit of the spacing; values are photons where noise is counted in photons, grey values elsewhere;
depth grows along z, from 0 at the face of the first voxel. `seeds` holds one whole number a sample, which alone decides
the sample's random numbers, whatever batch it is in and whatever else is applied. Each function raises ValueError where
a volume is not of that form or not finite, a parameter is out of range, or there is not one seed a sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.data_synth.imaging.maths import (
    apply_matrices,
    as_spacing,
    as_triple,
    bell,
    check_volume,
    correlated_field,
    gaussian_matrix,
    grainy_noise,
    sampling_matrix,
    seeds_of,
    stream,
    uniform,
)
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Float
from curvafit.priors.profile import profile_distance

#: ε of a generated shape, in its voxels.
EPSILON = WORKING_EPSILON / WORKING_SPACING
#: How fast the stain fades at the end of a lost stretch: a part of the random field's deviation.
FADING = 0.2
#: Places that a speck tries before it is given up as having none outside the structure.
TRIES = 8
#: Below this mean a Poisson quantile is summed up; above it, Giles's expansion is within a count.
FEW = 2.0
#: Counts that the sum goes to: P(X > 12) is 2e-7 at a mean of 2.
MOST = 12


# ---- optics ----------------------------------------------------------------------------------------------------------


def occupancy(field: Float[Tensor, "b 1 z y x"], epsilon: float = EPSILON) -> Float[Tensor, "b 1 z y x"]:
    """Return the share of each cubic voxel that is inside the shape (partial volume).

    The profile holds the sub-voxel distance d = √2 ε artanh u, in voxels, and the share is d + ½ clipped to [0, 1]:
    exact for a plane along an axis. A tilted plane's ramp is longer with softer ends; its second moment is the same
    1/12, and the difference nowhere over 0.05.

    Parameters
    ----------
    epsilon
        Of the profile tanh(d / √2 ε), in voxels.
    """
    if not epsilon > 0:
        raise ValueError(f"ε must be positive, in voxels, got {epsilon}")
    return profile_distance(check_volume(field, "phase fields"), epsilon).add_(0.5).clamp_(0, 1)


def texture(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], deviation: float, length: float,
    seeds: Sequence[int], purpose: str = "texture",
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return a random factor of mean 1 and standard deviation `deviation`, correlated by `length`.

    The factor is lognormal; its logarithm is a `correlated_field`.
    """
    if not 0 <= deviation < math.inf or not length > 0:
        raise ValueError(f"a texture needs a deviation from 0 and a positive length, got {deviation} and {length}")
    spread = math.sqrt(math.log1p(deviation**2))
    lengths = [length / h for h in as_spacing(spacing)]
    return correlated_field(like, lengths, seeds, purpose).mul_(spread).sub_(spread**2 / 2).exp_()


def blur(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], widths: float | Sequence[float]
) -> Float[Tensor, "b 1 z y x"]:
    """Return the image under a Gaussian point-spread function of standard deviations `widths` along (z, y, x)."""
    check_volume(image, "an image")
    steps, σ = as_spacing(spacing), as_triple(widths, "a blur")
    return apply_matrices(
        image, *(gaussian_matrix(n, s / h, image) for n, s, h in zip(image.shape[2:], σ, steps, strict=True))
    )


def blur_with_depth(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], widths: float | Sequence[float],
    growth: float, attenuation: float = 0.0,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Blur an image by a Gaussian that widens with depth, as scatter and aberrations make it.

    Its deviations are σ(z) = σ(0) (1 + growth z).

    Parameters
    ----------
    growth
        Relative, per unit of depth.
    attenuation
        Of the light, per unit of depth: what comes from depth z is weakened by exp(-attenuation · z).
    """
    if not (0 <= growth < math.inf and 0 <= attenuation < math.inf):
        raise ValueError(f"growth and attenuation must be from 0, got {growth} and {attenuation}")
    check_volume(image, "an image")
    steps, σ = as_spacing(spacing), as_triple(widths, "a blur")
    depth = (torch.arange(image.shape[2], device=image.device, dtype=image.dtype) + 0.5) * steps[0]
    wider = 1 + growth * depth[:, None]
    z, y, x = (s / h * wider if s else None for s, h in zip(σ, steps, strict=True))
    lateral = ((n, 0.0 if w is None else w[..., None]) for n, w in zip(image.shape[3:], (y, x), strict=True))
    axial = gaussian_matrix(image.shape[2], 0.0 if z is None else z, image)
    blurred = apply_matrices(image, axial, *(gaussian_matrix(n, width, image) for n, width in lateral))
    return blurred * torch.exp(-attenuation * depth)[:, None, None]


def sample(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], onto: float | Sequence[float],
    window: float | Sequence[float] = 0.0,
) -> Float[Tensor, "b 1 Z Y X"]:  # fmt: skip
    """Sample an image on a grid of voxels `onto`, each the mean over a `window` about the voxel's centre.

    The window is the slice's thickness and the pixel's size. The corners of both grids' first voxels coincide, and
    voxels that do not fit into the box are left out. Along an axis whose window is narrower than an old voxel, the
    value is interpolated linearly.
    """
    check_volume(image, "an image")
    old, new, wide = as_spacing(spacing), as_spacing(onto), as_triple(window, "a window")
    every = zip(image.shape[2:], old, new, wide, strict=True)
    return apply_matrices(image, *(sampling_matrix(n, h, to, over, image) for n, h, to, over in every))


# ---- specimen, light and detector ------------------------------------------------------------------------------------


def bias(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, length: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the factor of uneven illumination: smooth, from 1 - strength to 1 + strength, correlated by `length`."""
    if not 0 <= strength <= 1 or not length > 0:
        raise ValueError(f"the bias must be in [0, 1] and its length positive, got {strength} and {length}")
    field = correlated_field(like, [length / h for h in as_spacing(spacing)], seeds, "bias")
    low, high = field.amin((1, 2, 3, 4), keepdim=True), field.amax((1, 2, 3, 4), keepdim=True)
    middle, half = (high + low) / 2, ((high - low) / 2).clamp_min(torch.finfo(field.dtype).tiny)
    return (field - middle).mul_(strength / half).add_(1)


def stripes(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, width: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the stripes along x, as shadows in a light sheet or a milling curtain make.

    A factor of mean 1 and deviation `strength`, not below 0, constant along x, correlated by `width` across it.
    """
    if not 0 <= strength < math.inf or not width > 0:
        raise ValueError(f"stripes need a strength from 0 and a width above 0, got {strength} and {width}")
    z, y, _ = (width / h for h in as_spacing(spacing))
    field = correlated_field(like, (z, y, math.inf), seeds, "stripes")
    return field.mul_(strength).add_(1).clamp_min_(0).expand(like.shape)


def rings(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], strength: float, width: float,
    seeds: Sequence[int], centre: tuple[float, float] | None = None,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the rings about an axis along z that defects of a CT detector leave: a term of mean 0.

    Its deviation is `strength`. A slice's rings are its own, since a detector's row makes a slice. Few are strong: the
    profile over the radius is g|g|/√3 of a normal g, correlated by `width`.

    Parameters
    ----------
    centre
        Of the rings (y, x), from the box's corner; by default drawn in the box and half as far again on each side.
    """
    if not 0 <= strength < math.inf or not width > 0:
        raise ValueError(f"rings need a strength from 0 and a width above 0, got {strength} and {width}")
    steps = as_spacing(spacing)
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
    """
    if not (0 <= share <= 1 and 0 <= loss <= 1 and length > 0):
        given = f"{share}, {loss} and {length}"
        raise ValueError(f"dropout needs a share and a loss in [0, 1] and a length above 0, got {given}")
    inside = check_volume(occupied, "an occupancy") >= 0.5
    field = correlated_field(occupied, [length / h for h in as_spacing(spacing)], seeds, "dropout")
    level = [_level_above(values[within], share) for values, within in zip(field, inside, strict=True)]
    threshold = torch.stack(level)[:, None, None, None, None]
    return 1 - loss * torch.sigmoid((field - threshold) / FADING)


def clutter(
    occupied: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], density: float, radius: float,
    seeds: Sequence[int],
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return specks outside the structure: Gaussian blobs up to 1 high, 0 wherever a voxel is full.

    Their number is Poisson's, at `density` a unit of volume; half-widths (deviations) along each axis are uniform in
    (½, 1½) radius, heights in (½, 1).
    """
    if not 0 <= density < math.inf or not radius > 0:
        raise ValueError(f"clutter needs a density from 0 and a positive radius, got {density} and {radius}")
    check_volume(occupied, "an occupancy")
    steps = as_spacing(spacing)
    samples = zip(occupied.split(1), seeds_of(seeds, len(occupied)), strict=True)
    return torch.cat([_specks(one, steps, density, radius, seed) for one, seed in samples]) * (1 - occupied)


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
    normal = correlated_field(like.new_empty(1, 1, depth, 1, count), (0, 0, width / step), [seed], "rings")[0, 0, :, 0]
    profile = normal * normal.abs() / math.sqrt(3)
    near = radius.long()
    between = torch.lerp(profile[:, near], profile[:, near + 1], radius - near)
    return between[None, None]


def _level_above(values: Tensor, share: float) -> Tensor:
    """Return the level that a share of the values exceeds: none for a share of 0, all for 1."""
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
    z, y, x = (
        _speck_profiles(n, h, place[:, k], width[:, k]) for k, (n, h) in enumerate(zip(shape, steps, strict=True))
    )
    planes = (height[:, None, None] * z[:, :, None] * y[:, None, :]).flatten(1)
    return (planes.mT @ x).reshape(occupied.shape).clamp_max_(1)


def _speck_profiles(count: int, step: float, place: Tensor, width: Tensor) -> Tensor:
    """Return the profile of each speck along an axis, (specks, voxels)."""
    at = (torch.arange(count, device=place.device, dtype=place.dtype) + 0.5) * step
    return bell((at - place[:, None]) / width[:, None])


# ---- noise -----------------------------------------------------------------------------------------------------------


def poisson_gaussian(
    photons: Float[Tensor, "b 1 z y x"], gain: float, read_noise: float, offset: float, seeds: Sequence[int],
    width: float | Sequence[float] = 0.0,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return counts: offset + gain · Poisson(photons) + N(0, read_noise²). Its variance is a line over the mean.

    Parameters
    ----------
    photons
        Means, from 0.
    gain
        Counts a photon; 0 for an instrument whose noise does not depend on the signal: offset + photons + N.
    width
        Deviation, in voxels (z, y, x), of the Gaussian that smoothed the noise, as reconstruction and denoising do. Its
        correlation is that of smoothed noise; every voxel's own law stays as it is.
    """
    if not (0 <= gain < math.inf and 0 <= read_noise < math.inf and math.isfinite(offset)):
        raise ValueError(f"gain and read noise must be from 0, got {gain} and {read_noise}")
    counts = photons if gain == 0 else gain * poisson(photons, seeds, width)
    return gaussian_noise(counts + offset, read_noise, seeds, width)


def poisson(
    photons: Float[Tensor, "b 1 z y x"], seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Draw numbers of photons with these means, by quantiles (`poisson_quantile`) of noise of a grain `width`."""
    if check_volume(photons, "photons").amin() < 0:
        raise ValueError(f"photons must be from 0, got {float(photons.amin()):g}")
    return poisson_quantile(photons, grainy_noise(photons, as_triple(width, "a width of noise"), seeds, "photons"))


def poisson_quantile(mean: Tensor, z: Tensor) -> Tensor:
    """Turn standard normal numbers into Poisson numbers of the same quantile.

    So one random number a voxel makes a count, and smooth noise makes smooth counts. From a mean of `FEW` on by Giles's
    expansion Q̃_N3 ("Algorithm 955", ACM Trans. Math. Softw. 42, 2016), a count off in at most 0.5 % of draws; below by
    summing the probabilities, exact to `MOST` counts.
    """
    root = mean.clamp_min(FEW).sqrt_()
    w2 = z.square()
    many = (w2 / 270).add_(7 / 810).mul_(w2).sub_(8 / 405).div_(root)
    many.sub_((w2 + 2).mul_(z), alpha=1 / 72).div_(root)
    many.add_(w2, alpha=1 / 6).add_(1 / 3).addcmul_(root, root + z).floor_().clamp_min_(0)
    few = mean < FEW
    if bool(few.any()):
        return torch.where(few, _sum_quantile(mean.clamp_max(FEW), z), many)
    return many


def gaussian_noise(
    image: Float[Tensor, "b 1 z y x"], deviation: float, seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Return the image plus normal noise of a standard deviation, smoothed by `width` voxels at that deviation."""
    if not 0 <= deviation < math.inf:
        raise ValueError(f"the noise's deviation must be from 0, got {deviation}")
    check_volume(image, "an image")
    widths = as_triple(width, "a width of noise")
    return image + deviation * grainy_noise(image, widths, seeds, "read noise") if deviation else image


def rician(
    image: Float[Tensor, "b 1 z y x"], deviation: float, seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Return the magnitude of a signal with normal noise in both channels: √((v + σ n₁)² + (σ n₂)²).

    The mean square is v² + 2σ²; where there is no signal, the mean is σ √(π/2) (Gudbjartsson and Patz 1995).
    """
    if not 0 <= deviation < math.inf:
        raise ValueError(f"the noise's deviation must be from 0, got {deviation}")
    check_volume(image, "an image")
    widths = as_triple(width, "a width of noise")
    if not deviation:
        return image.abs()
    real, imaginary = (grainy_noise(image, widths, seeds, f"{part} channel") for part in ("real", "imaginary"))
    return torch.hypot(image + deviation * real, deviation * imaginary)


def digitise(image: Float[Tensor, "b 1 z y x"], ceiling: float) -> Float[Tensor, "b 1 z y x"]:
    """Return whole counts from 0 to `ceiling`, where the instrument saturates."""
    if not ceiling > 0:
        raise ValueError(f"the ceiling must be above 0, got {ceiling}")
    return check_volume(image, "an image").round().clamp_(0, ceiling)


def _sum_quantile(mean: Tensor, z: Tensor) -> Tensor:
    """Return the Poisson quantiles of small means: how many of the sums P(X ≤ k), k = 0, 1, …, are below Φ(z)."""
    share = torch.special.ndtr(z)
    term = torch.exp(-mean)
    total = term.clone()
    count = torch.zeros_like(mean, dtype=torch.uint8)
    highest = float(share.amax())
    for k in range(1, MOST + 1):
        if float(total.amin()) > highest:
            break
        count += (share > total).view(torch.uint8)
        total += term.mul_(mean).mul_(1 / k)
    return count.to(mean.dtype)
