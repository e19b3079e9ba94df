"""A null of a texture: a level cut of a Gaussian random field with a mask's volume fraction and two-point function.

A fit that is no nearer to a query than its null says nothing.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, stats

from curvafit.priors.grid import WORKING_EPSILON, Grid

#: Angles at which the integral of `cut_covariance` is tabulated.
ANGLES = 4001


def level_cut(mask: np.ndarray, grid: Grid, seed: int) -> np.ndarray:
    """Return a phase field (float32), which repeats, whose {u > 0} is a null of a mask `(Z, Y, X)` that repeats.

    The two-point function is the mask's, averaged over directions, as nearly as a cut of a Gaussian field comes. The
    profile is tanh(d / √2 ε), d being the Gaussian field over its mean slope at the cut, and has its level sets.
    """
    spectrum = gaussian_spectrum(mask)
    noise = np.fft.fftn(np.random.default_rng(seed).standard_normal(mask.shape))
    values = np.fft.ifftn(noise * np.sqrt(spectrum)).real
    height = values - np.quantile(values, 1 - mask.mean())
    slope = np.sqrt(sum(np.square((np.roll(height, -1, k) - np.roll(height, 1, k)) / 2) for k in range(3)))
    near = np.abs(height) < slope.mean()
    voxel = grid.spacing[0]
    return np.tanh(height * voxel / (math.sqrt(2) * WORKING_EPSILON * slope[near].mean())).astype(np.float32)


def gaussian_spectrum(mask: np.ndarray) -> np.ndarray:
    """Return the power spectrum, alike in all directions, of a Gaussian field of variance 1 whose cut has a mask's
    fraction and two-point function up to half of the box: by non-negative least squares over shells of frequencies."""
    shells = _shells(mask.shape)
    covariance = _means(np.fft.ifftn(np.abs(np.fft.fftn(mask - mask.mean())) ** 2).real / mask.size, shells)
    told, correlation = cut_covariance(float(stats.norm.isf(mask.mean())))
    read = min(mask.shape) // 2
    target = np.interp(covariance[:read], told, correlation)
    waves = np.array([_means(np.fft.ifftn(shells == k).real * mask.size, shells)[:read] for k in range(1, read)])
    power, _ = optimize.nnls(waves.T, target)
    spectrum = np.concatenate([[0], power, np.zeros(shells.max() + 1 - read)])[shells]
    return spectrum / spectrum.mean()


def cut_covariance(level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of {g > level} at two points, increasing, and the correlations of a normal g there:
    ∫ exp(-level² / (1 + sin θ)) dθ / 2π from 0 to arcsin of the correlation (Sheppard)."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, ANGLES)[1:]
    density = np.exp(-(level**2) / (1 + np.sin(angles))) / (2 * math.pi)
    steps = np.diff(angles) * (density[1:] + density[:-1]) / 2
    total = np.concatenate([[0], np.cumsum(steps)])
    return total - np.interp(0, angles, total), np.sin(angles)


def _shells(shape: tuple[int, ...]) -> np.ndarray:
    """Return the lengths, rounded, of the offsets or frequencies of a box that repeats."""
    axes = [np.minimum(np.arange(n), n - np.arange(n)) for n in shape]
    return np.rint(np.sqrt(axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2.0)).astype(int)


def _means(values: np.ndarray, shells: np.ndarray) -> np.ndarray:
    """Return the means of values over shells."""
    return np.bincount(shells.ravel(), values.ravel()) / np.bincount(shells.ravel())
