"""Noise and background of a scan: the correlations of its background, and residuals' variance over the mean."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage, optimize

#: Deviations (voxels) of smoothings that count as the noise's own, and correlation lengths that count as texture.
GRAINS = (0.0, 0.4, 0.5, 0.6, 0.75, 0.9, 1.1)
LENGTHS = (3.0, 4.0, 6.0, 8.0, 12.0, 20.0)
#: Lags, in voxels, that the background's correlation is looked at.
LAGS = 12
#: Bins of the mean that the variance is looked at in, and voxels that a bin needs.
BINS, LEAST = 24, 50
#: How much larger than the background's the structure's variance is, where noise is said to grow with the signal.
GROWS = 1.3
#: Second differences along both axes of the plane: no plane passes, and nothing else that a blur lets through much.
RESIDUAL = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)[None]


class Background(NamedTuple):
    """Where the background is seen, its level; variance and width (z, y, x) of its noise in voxels; deviation, length
    of its texture; range of its uneven light."""

    where: np.ndarray
    level: float
    noise: float
    width: tuple[float, float, float]
    texture: float
    length: float
    bias: float


class NoiseEstimate(NamedTuple):
    """Of counts: gain, read noise, offset; the rest as the background has it."""

    gain: float
    read_noise: float
    offset: float
    width: tuple[float, float, float]
    level: float
    texture: float
    length: float
    bias: float


def background_of(values: np.ndarray, inside: np.ndarray, steps: np.ndarray) -> Background:
    """Return the background's level and correlations, some voxels away from the structure.

    Its covariance over the lag is the sum of a short part, noise smoothed by up to a voxel, and a long one, texture.
    """
    finest = steps.min() / steps
    away = ndimage.distance_transform_edt(~inside, sampling=steps) > 4 * steps.min()
    where = away if away.mean() > 0.02 else ~inside
    smooth = ndimage.gaussian_filter(values, 2 * finest)
    where = where & (smooth <= np.quantile(smooth[where], 0.98))
    level = float(values[where].mean())
    weight = where.astype(np.float32)
    rest = (values - level) * weight
    covariances = [covariance(rest, weight, axis) for axis in range(3)]
    lags = min(map(len, covariances[1:]))
    plane = (covariances[1][:lags] + covariances[2][:lags]) / 2
    noise, lateral, texture, length = _split(plane)
    _, axial, _, _ = _split(covariances[0])
    bias = _bias(rest, weight, level, values.shape)
    return Background(
        where, level, noise, (axial, lateral, lateral), math.sqrt(texture), length * float(steps[2]), bias
    )


def noise_of(
    values: np.ndarray, inside: np.ndarray, ground: Background, steps: np.ndarray, high: float
) -> NoiseEstimate:
    """Return the line of variance over mean through the residuals' bins and the background, if it rises by the
    structure.

    The line is gain · mean + rest. A negative rest is an offset, -rest / gain, a positive one read noise: of the two
    that a line cannot tell apart, the smaller. The offset is no brighter than the background's darkest voxels: fine
    structure that passes for noise makes no steeper line. Where it does not rise, noise is the background's everywhere.
    """
    rest = ground.level, ground.texture, ground.length, ground.bias
    lines = _bins(values, inside, ground, steps)
    gain = 0.0
    if len(lines) > 2:
        mean, variance, count = np.array(lines).T
        rise = count * (mean - ground.level)
        slope = float((rise * (variance - ground.noise)).sum()), float((rise * (mean - ground.level)).sum())
        gain = max(slope[0] / slope[1], 0.0) if slope[1] else 0.0
    darkest = float(np.quantile(values[ground.where], 0.001))
    gain = min(gain, ground.noise / max(ground.level - darkest, 1e-12))
    if not gain or gain * abs(high - ground.level) < (GROWS - 1) * ground.noise:
        floor = 0.0 if ground.level > 2 * ground.texture else ground.level - abs(high - ground.level)
        return NoiseEstimate(0.0, math.sqrt(ground.noise), floor, ground.width, *rest)
    constant = ground.noise - gain * ground.level
    offset = max(-constant / gain, 0.0)
    return NoiseEstimate(gain, math.sqrt(max(constant, 0.0)), offset, ground.width, *rest)


def covariance(rest: np.ndarray, weight: np.ndarray, axis: int) -> np.ndarray:
    """Return the covariance at lags from 0, of pairs of which both are background."""
    a, w = np.moveaxis(rest, axis, 0), np.moveaxis(weight, axis, 0)
    lags = min(LAGS, len(a) // 3)
    sums = [(float((a[: len(a) - k] * a[k:]).sum()), float((w[: len(w) - k] * w[k:]).sum())) for k in range(lags + 1)]
    return np.array([product / max(pairs, 1.0) for product, pairs in sums])


def _split(covariances: np.ndarray) -> tuple[float, float, float, float]:
    """Return the variance and width of the noise, variance and length of the texture, in voxels, by non-negative least
    squares."""
    lag = np.arange(len(covariances))
    short = [np.exp(-((lag / (2 * w)) ** 2)) if w else (lag == 0).astype(float) for w in GRAINS]
    long = [np.exp(-0.5 * (lag / length) ** 2) for length in LENGTHS]
    flat = np.ones(len(lag))
    parts, _ = optimize.nnls(np.stack([*short, *long, flat], 1), covariances)
    noise, texture = parts[: len(GRAINS)], parts[len(GRAINS) : -1]
    total, spread = float(noise.sum()), float(texture.sum())
    width = float(noise @ GRAINS / total) if total else 0.0
    length = float(texture @ LENGTHS / spread) if spread else LENGTHS[0]
    return total, width, spread, length


def _bias(rest: np.ndarray, weight: np.ndarray, level: float, shape: tuple[int, ...]) -> float:
    """Return half the range of the background's slow variation, relative to its level."""
    widths = [n / 8 for n in shape]
    slow = ndimage.gaussian_filter(rest, widths) / np.maximum(ndimage.gaussian_filter(weight, widths), 1e-3)
    low, high = np.quantile(slow, (0.01, 0.99))
    return float(high - low) / 2 / max(abs(level), 1e-9)


def _bins(
    values: np.ndarray, inside: np.ndarray, ground: Background, steps: np.ndarray
) -> list[tuple[float, float, int]]:
    """Return the mean, the variance of the noise and count, by bins of the mean over the structure."""
    residual = ndimage.convolve(values, RESIDUAL)
    mean = ndimage.gaussian_filter(values, 1.5 * steps.min() / steps)
    top = values.max()
    used = inside & (ndimage.maximum_filter(values, 3) < top) if (values == top).mean() > 1e-5 else inside
    passed = max(_variance(residual[ground.where]), 1e-12) / max(ground.noise, 1e-12)
    found = []
    edges = np.quantile(mean[used], np.linspace(0, 1, BINS + 1)) if used.any() else np.zeros(1)
    for low, high in itertools.pairwise(edges):
        bin_ = used & (mean >= low) & (mean <= high)
        if (count := int(bin_.sum())) >= LEAST:
            found.append((float(values[bin_].mean()), _variance(residual[bin_]) / passed, count))
    return found


def _variance(residual: np.ndarray) -> float:
    """Return the mean and the deviation of what lies within four deviations, by the median's."""
    square = np.square(residual)
    near = square < 16 * np.median(square) / 0.455
    return float(square[near].mean() if near.any() else square.mean())
