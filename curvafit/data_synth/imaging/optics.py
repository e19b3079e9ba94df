"""From a phase field to what an ideal instrument collects: partial volume, classes, blur, sampling.

Volumes are `(B, 1, Z, Y, X)` tensors of a floating type on any device. Lengths are in the unit of the spacing;
intensities are photons where noise is counted in photons, grey values elsewhere. Depth grows along z, from 0 at the
face of the first voxel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.data_synth.imaging.maths import along, checked, edges, gaussian, sampling, triple
from curvafit.data_synth.imaging.randomness import correlated
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.profile import profile_distance
from curvafit.priors.shapes import Float

#: ε of a generated shape, in its voxels.
EPSILON = WORKING_EPSILON / WORKING_SPACING


def occupancy(field: Float[Tensor, "b 1 z y x"], epsilon: float = EPSILON) -> Float[Tensor, "b 1 z y x"]:
    """Return the share of each cubic voxel that is inside: partial volume, from the sub-voxel distance that the profile
    holds.

    (d + ½) clipped to [0, 1], d = √2 ε artanh u in voxels: exact for a plane along an axis. A tilted plane's ramp is
    longer with softer ends; its second moment is the same 1/12, and the difference nowhere over 0.05.

    Parameters
    ----------
    epsilon
        Of the profile tanh(d / √2 ε), in voxels.

    Raises
    ------
    ValueError
        If the field is not `(B, 1, Z, Y, X)` or not finite, or ε is not positive.
    """
    if not epsilon > 0:
        raise ValueError(f"expected a positive ε in voxels, got {epsilon}")
    return profile_distance(checked(field, "phase fields"), epsilon).add_(0.5).clamp_(0, 1)


def intensities(
    occupied: Float[Tensor, "b 1 z y x"], levels: Sequence[float], stain: Tensor | None = None
) -> Float[Tensor, "b 1 z y x"]:
    """Return the light of two classes: levels (background, structure) weighed by occupancy; `stain` (0 to 1) is the
    contrast left."""
    below, above = _levels(levels)
    checked(occupied, "an occupancy")
    share = occupied if stain is None else occupied * stain
    return share * (above - below) + below


def texture(
    like: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], deviation: float, length: float,
    seeds: Sequence[int], purpose: str = "texture",
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return a positive random factor of mean 1: lognormal, of standard deviation `deviation`, its logarithm correlated
    by `length` (`correlated`).

    Raises
    ------
    ValueError
        If the deviation is negative, the length not positive, or there is not one seed a sample.
    """
    if not 0 <= deviation < math.inf or not length > 0:
        raise ValueError(f"expected a deviation from 0 and a positive length, got {deviation} and {length}")
    spread = math.sqrt(math.log1p(deviation**2))
    lengths = [length / h for h in edges(spacing)]
    return correlated(like, lengths, seeds, purpose).mul_(spread).sub_(spread**2 / 2).exp_()


def blur(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], widths: float | Sequence[float]
) -> Float[Tensor, "b 1 z y x"]:
    """Return the image under a Gaussian point-spread function of standard deviations `widths` along (z, y, x)."""
    checked(image, "an image")
    steps, σ = edges(spacing), triple(widths, "a blur")
    return along(image, *(gaussian(n, s / h, image) for n, s, h in zip(image.shape[2:], σ, steps, strict=True)))


def blur_with_depth(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], widths: float | Sequence[float],
    growth: float, attenuation: float = 0.0,
) -> Float[Tensor, "b 1 z y x"]:  # fmt: skip
    """Return the image under a point-spread function that widens with depth, as scatter and aberrations make it: σ(z) =
    σ(0) (1 + growth z).

    Parameters
    ----------
    growth
        Relative, per unit of depth.
    attenuation
        Of the light, per unit of depth: what comes from depth z is weakened by exp(-attenuation · z).

    Raises
    ------
    ValueError
        If an argument is negative, or the image not finite.
    """
    if not (0 <= growth < math.inf and 0 <= attenuation < math.inf):
        raise ValueError(f"expected a growth and an attenuation from 0, got {growth} and {attenuation}")
    checked(image, "an image")
    steps, σ = edges(spacing), triple(widths, "a blur")
    depth = (torch.arange(image.shape[2], device=image.device, dtype=image.dtype) + 0.5) * steps[0]
    wider = 1 + growth * depth[:, None]
    z, y, x = (s / h * wider if s else None for s, h in zip(σ, steps, strict=True))
    lateral = ((n, 0.0 if w is None else w[..., None]) for n, w in zip(image.shape[3:], (y, x), strict=True))
    axial = gaussian(image.shape[2], 0.0 if z is None else z, image)
    blurred = along(image, axial, *(gaussian(n, width, image) for n, width in lateral))
    return blurred * torch.exp(-attenuation * depth)[:, None, None]


def sample(
    image: Float[Tensor, "b 1 z y x"], spacing: float | Sequence[float], onto: float | Sequence[float],
    window: float | Sequence[float] = 0.0,
) -> Float[Tensor, "b 1 Z Y X"]:  # fmt: skip
    """Return values on a grid of voxels `onto`: means over a `window` (slice thickness, pixel) about each voxel's
    centre.

    The corners of both grids' first voxels coincide, and voxels that do not fit into the box are left out. Along an
    axis whose window is narrower than an old voxel, the value is interpolated linearly.

    Raises
    ------
    ValueError
        If a spacing is not positive, or the image not finite.
    """
    checked(image, "an image")
    old, new, wide = edges(spacing), edges(onto), triple(window, "a window")
    every = zip(image.shape[2:], old, new, wide, strict=True)
    return along(image, *(sampling(n, h, to, over, image) for n, h, to, over in every))


def _levels(levels: Sequence[float]) -> tuple[float, float]:
    if len(levels) != 2 or not all(math.isfinite(level) and level >= 0 for level in levels):
        raise ValueError(f"expected levels of background and structure from 0, got {levels!r}")
    return float(levels[0]), float(levels[1])
