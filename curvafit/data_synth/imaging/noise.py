"""Noise: photons, electronics, magnitude images, and what a file can hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.data_synth.imaging.maths import checked, triple
from curvafit.data_synth.imaging.randomness import grainy
from curvafit.priors.shapes import Float

#: Below this mean a Poisson quantile is summed up; above it, Giles's expansion is within a count.
FEW = 2.0
#: Counts that the sum goes to: P(X > 12) is 2e-7 at a mean of 2.
MOST = 12


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

    Raises
    ------
    ValueError
        If the photons are negative or not finite, a parameter is negative, or there is not one seed a sample.
    """
    if not (0 <= gain < math.inf and 0 <= read_noise < math.inf and math.isfinite(offset)):
        raise ValueError(f"expected a gain and a read noise from 0, got {gain} and {read_noise}")
    counts = photons if gain == 0 else gain * poisson(photons, seeds, width)
    return gaussian_noise(counts + offset, read_noise, seeds, width)


def poisson(
    photons: Float[Tensor, "b 1 z y x"], seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Return numbers of photons: the Poisson quantiles of normal numbers (`poisson_quantile`), smoothed by `width`
    voxels.

    Raises
    ------
    ValueError
        If the photons are negative or not finite, or there is not one seed a sample.
    """
    if checked(photons, "photons").amin() < 0:
        raise ValueError(f"expected photons from 0, got {float(photons.amin()):g}")
    return poisson_quantile(photons, grainy(photons, triple(width, "a width of noise"), seeds, "photons"))


def poisson_quantile(mean: Tensor, z: Tensor) -> Tensor:
    """Return the quantile of Poisson's law that a standard normal number is of its own, so that one random number a
    voxel makes a count.

    From a mean of `FEW` on by Giles's expansion Q̃_N3 ("Algorithm 955", ACM Trans. Math. Softw. 42, 2016), a count off
    in at most 0.5 % of draws; below by summing the probabilities, exact to `MOST` counts.
    """
    root = mean.clamp_min(FEW).sqrt_()
    w2 = z.square()
    many = (w2 / 270).add_(7 / 810).mul_(w2).sub_(8 / 405).div_(root)
    many.sub_((w2 + 2).mul_(z), alpha=1 / 72).div_(root)
    many.add_(w2, alpha=1 / 6).add_(1 / 3).addcmul_(root, root + z).floor_().clamp_min_(0)
    few = mean < FEW
    if bool(few.any()):
        return torch.where(few, _few(mean.clamp_max(FEW), z), many)
    return many


def gaussian_noise(
    image: Float[Tensor, "b 1 z y x"], deviation: float, seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Return the image plus normal noise of a standard deviation, smoothed by `width` voxels at that deviation."""
    if not 0 <= deviation < math.inf:
        raise ValueError(f"expected a noise deviation from 0, got {deviation}")
    checked(image, "an image")
    widths = triple(width, "a width of noise")
    return image + deviation * grainy(image, widths, seeds, "read noise") if deviation else image


def rician(
    image: Float[Tensor, "b 1 z y x"], deviation: float, seeds: Sequence[int], width: float | Sequence[float] = 0.0
) -> Float[Tensor, "b 1 z y x"]:
    """Return the magnitude of a signal with normal noise in both channels: √((v + σ n₁)² + (σ n₂)²) (Gudbjartsson and
    Patz 1995).

    The mean square is v² + 2σ²; where there is no signal, the mean is σ √(π/2).
    """
    if not 0 <= deviation < math.inf:
        raise ValueError(f"expected a noise deviation from 0, got {deviation}")
    checked(image, "an image")
    widths = triple(width, "a width of noise")
    if not deviation:
        return image.abs()
    real, imaginary = (grainy(image, widths, seeds, f"{each} channel") for each in ("real", "imaginary"))
    return torch.hypot(image + deviation * real, deviation * imaginary)


def digitised(image: Float[Tensor, "b 1 z y x"], ceiling: float) -> Float[Tensor, "b 1 z y x"]:
    """Return whole counts from 0 to `ceiling`, where the instrument saturates."""
    if not ceiling > 0:
        raise ValueError(f"expected a ceiling above 0, got {ceiling}")
    return checked(image, "an image").round().clamp_(0, ceiling)


def _few(mean: Tensor, z: Tensor) -> Tensor:
    """Return how many of the sums P(X ≤ k) lie under the normal number's share."""
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
