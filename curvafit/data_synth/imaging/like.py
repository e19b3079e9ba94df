"""A modality estimated from a real scan: its noise, blur, levels and textures."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage, optimize
from skimage.filters import threshold_otsu

from curvafit.data_synth.imaging.effects import Triple, blur
from curvafit.data_synth.imaging.modality import Contrast, Detector, Illumination, Imaging, Modality, Noise, Optics
from curvafit.volumes.volume import Volume

#: The least brightness, as a share of the mean, that counts for the structure's texture.
DIMMEST = 0.1
#: The most voxels that are measured; of a larger scan the middle.
MOST = 2_000_000
#: Deviation, in voxels of the finest edge, of the window in which the structure's brightness is averaged.
WINDOW = 4.0
#: Correlation lengths of that brightness that are tried, in voxels of the finest edge: a dozen lags show no others.
BRIGHTNESS_LENGTHS = np.geomspace(WINDOW, 6 * WINDOW, 50)
#: The ends of the range that a parameter is drawn from, as multiples of the estimate.
SPREAD: dict[str, tuple[float, float]] = {
    "contrast.background": (0.8, 1.25),
    "contrast.foreground": (0.7, 1.4),
    "contrast.background_texture": (0.7, 1.4),
    "contrast.foreground_texture": (0.7, 1.4),
    "optics.blur": (0.8, 1.25),
    "illumination.bias": (0.5, 1.5),
    "detector.gain": (0.7, 1.4),
    "noise.gaussian": (0.7, 1.4),
}
#: Deviations (voxels) of the smoothing of noise, and correlation lengths of texture, whose sum is the covariance.
GRAINS = (0.0, 0.4, 0.5, 0.6, 0.75, 0.9, 1.1)
TEXTURE_LENGTHS = (3.0, 4.0, 6.0, 8.0, 12.0, 20.0)
#: Blur, contrast, texture and its length: see `_measure_structure`.
Structure = tuple[Triple, float, float, float]
#: Noise grows with the signal where the structure's variance is so many times the background's.
GROWS = 1.3


def fit_modality(scan: Volume, mask: np.ndarray | None = None) -> Modality:
    """Return a modality whose images look like a scan: its spacing, levels, textures, blur, noise and uneven light.

    The scan is taken to have two classes, a Gaussian blur of one width in the plane and one along z, and noise whose
    variance is a line over the mean. Growth with depth, stripes, rings, lost stain and clutter stay
    0. The blur is the one that makes the mask, times a local brightness, most like the scan. Whole numbers from 0 are
    taken as counts that saturate at the highest of their type.

    The mask is the structure's voxels, (Z, Y, X); by default what is bright. The modality's `base` holds the estimates,
    its `ranges` their surroundings (`SPREAD`), and its `voxel` is the finest edge of the scan's.
    """
    values, given = _crop_middle(scan, mask)
    steps = np.array(scan.spacing)
    inside = _find_bright(values, steps) if given is None else given
    if not inside.any() or inside.all():
        raise ValueError("the mask must have voxels inside and outside, got an empty or a full one")
    ground = _measure_background(values, inside, steps)
    structure = _measure_structure(values, inside, steps, ground.level)
    noise = _measure_noise(values, inside, ground, steps, ground.level + structure[1])
    base = _to_imaging(scan, ground, structure, noise)
    known = {name: np.asarray(base[name]) for name in SPREAD if np.any(base[name])}
    ranges = {name: tuple((end * value).tolist() for end in SPREAD[name]) for name, value in known.items()}
    if base.illumination.bias:
        low, high = ranges["illumination.bias"]
        ranges["illumination.bias"] = low, min(high, 1.0)
    about = f"estimated from {scan.source or 'a scan'}, {'its mask' if given is not None else 'without a mask'}"
    return Modality("like", about, float(min(scan.spacing)), base, ranges)


def _to_imaging(scan: Volume, ground: Background, structure: Structure, noise: tuple[float, float, float]) -> Imaging:
    """Return the estimates as parameters of an image: levels in photons where there is a gain, textures before blur."""
    (widths, contrast, texture, grain), (gain, read_noise, offset) = structure, noise
    unit = gain or 1.0
    low = max(ground.level - offset, 0.0) / unit
    high = max(ground.level + contrast - offset, 0.0) / unit
    shrunk = math.prod(1 + 2 * (σ / ground.length) ** 2 for σ in widths) ** 0.25
    length = math.sqrt(max(ground.length**2 - 2 * min(widths) ** 2, min(scan.spacing) ** 2))
    dark, bright = max(low * unit, 1e-9), max(high * unit, 1e-9)
    below, above = min(ground.texture * shrunk / dark, 2.0), min(texture * abs(contrast) / bright, 2.0)
    sides = (n * h for n, h in zip(scan.shape, scan.spacing, strict=True))
    counts = scan.values.dtype.kind in "ui" and scan.values.min() >= 0
    ceiling = float(np.iinfo(scan.values.dtype).max) if counts else None
    return Imaging(
        unit=scan.unit,
        spacing=scan.spacing,
        contrast=Contrast(low, high, below, length, above, grain * min(scan.spacing)),
        optics=Optics(widths),
        illumination=Illumination(min(ground.bias * abs(ground.level) / dark, 0.9), max(sides) / 2),
        noise=Noise(gaussian=read_noise, width=ground.width),
        detector=Detector(gain=gain, offset=offset, ceiling=ceiling),
    )


def _crop_middle(scan: Volume, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Check a scan and its mask; return the middle of both, of at most `MOST` voxels."""
    if min(scan.shape) < 8:
        raise ValueError(f"the scan must have at least 8 voxels along each axis, got {scan.shape}")
    if mask is not None and np.shape(mask) != scan.shape:
        raise ValueError(f"the mask must have the scan's shape {scan.shape}, got {np.shape(mask)}")
    sides = list(scan.shape)
    while math.prod(sides) > MOST:
        sides[int(np.argmax(sides))] -= 8
    box = tuple(slice((n - side) // 2, (n - side) // 2 + side) for n, side in zip(scan.shape, sides, strict=True))
    values = scan.values[box].astype(np.float32)
    if not np.isfinite(values).all() or values.min() == values.max():
        raise ValueError("the scan must hold finite values that vary, got NaN, infinity or one value")
    return values, None if mask is None else np.asarray(mask)[box].astype(bool)


def _find_bright(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Guess the structure's voxels in grey values (Z, Y, X) on voxels of edges `steps`."""
    # A voxel is the structure's where its contrast is above half of the local one: the mean, weighted by brightness,
    # over nearby voxels above Otsu's threshold. So an edge does not depend on the structure's brightness. The threshold
    # is found among square roots, which shows dim structures.
    finest = steps.min() / steps
    smooth = ndimage.gaussian_filter(values, 0.8 * finest)
    root = np.sqrt(np.maximum(smooth - np.quantile(smooth, 0.001), 0))
    above: np.ndarray = root > threshold_otsu(root)
    contrast = smooth - np.median(smooth[~above])
    bright = np.where(above, contrast, 0)
    weight = ndimage.gaussian_filter(bright, WINDOW * finest)
    local = ndimage.gaussian_filter(bright**2, WINDOW * finest) / np.maximum(weight, 1e-6 * weight.max())
    return np.logical_and(contrast > local / 2, ndimage.maximum_filter(above, size=3))


def _measure_structure(values: np.ndarray, inside: np.ndarray, steps: np.ndarray, level: float) -> Structure:
    """Return the blur (z, y = x) by which the mask explains the scan near it best; the mean contrast inside, its
    relative deviation (texture), and the texture's correlation length in voxels of the finest edge."""
    finest = steps.min() / steps
    window = tuple(WINDOW * finest)
    signal, mask = (torch.from_numpy(volume).float() for volume in (values - level, inside))
    near = blur(mask, 1.0, tuple(2 * finest)) > 0.02

    def brightness(blurred: torch.Tensor) -> torch.Tensor:
        weight = blur(blurred * blurred, 1.0, window)
        return blur(signal * blurred, 1.0, window) / weight.clamp_min(1e-6)

    def misfit(logs: np.ndarray) -> float:
        blurred = blur(mask, 1.0, tuple(np.exp(logs[[0, 1, 1]])))
        return float((signal - brightness(blurred) * blurred)[near].square().mean())

    corner = np.log([max(finest[0], 0.5), 1.0])
    simplex = corner + np.array([[0, 0], [0.5, 0], [0, 0.5]])
    options = {"xatol": 0.02, "fatol": math.inf, "maxfev": 80, "initial_simplex": simplex}
    widths = np.exp(optimize.minimize(misfit, corner, method="Nelder-Mead", options=options).x[[0, 1, 1]])
    contrast = brightness(blur(mask, 1.0, tuple(widths))).numpy()
    mean = float(contrast[inside].mean())
    z, y, x = (np.sqrt(np.maximum(widths**2 - 1 / 12, 0)) * steps).tolist()
    return (z, y, x), mean, *_measure_texture(contrast / mean, inside, steps)


def _measure_texture(relative: np.ndarray, inside: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    """Return the deviation and the correlation length, in voxels of the finest edge, of the brightness inside."""
    # Both come from the covariance, in the plane, of the logarithm, whose variance voxels under `DIMMEST` would decide.
    # The average over `WINDOW` lengthens the correlation, and lessens the deviation along a tube.
    bright_part = inside & (relative > DIMMEST)
    logs = np.log(np.where(bright_part, relative, 1.0))
    weight = bright_part.astype(np.float32)
    rest = (logs - logs[bright_part].mean()) * weight
    first, second = (_autocovariance(rest, weight, axis) for axis in (1, 2))
    covariances = np.concatenate([first, second])
    lags = np.concatenate([np.arange(len(first)) * steps[1], np.arange(len(second)) * steps[2]]) / steps.min()
    share = covariances / max(covariances[0], 1e-12)
    misfit = [np.square(share - np.exp(-0.5 * (lags / length) ** 2)).sum() for length in BRIGHTNESS_LENGTHS]
    width = float(BRIGHTNESS_LENGTHS[int(np.argmin(misfit))])
    length = math.sqrt(max(width**2 - 2 * WINDOW**2, WINDOW**2))
    return math.sqrt(math.expm1(float(covariances[0]) * max(width / length, 1.0))), length


class Background(NamedTuple):
    """The background's voxels and level; variance and width (z, y, x; voxels) of its noise; deviation and length of its
    texture; relative range of its uneven light."""

    where: np.ndarray
    level: float
    noise: float
    width: tuple[float, float, float]
    texture: float
    length: float
    bias: float


def _measure_background(values: np.ndarray, inside: np.ndarray, steps: np.ndarray) -> Background:
    """Return the background's level, its noise and texture by their correlations, and how far its level drifts,
    measured some voxels away from the structure."""
    finest_edges = steps.min() / steps
    away = ndimage.distance_transform_edt(~inside, sampling=steps) > 4 * steps.min()
    where = away if away.mean() > 0.02 else ~inside
    smooth = ndimage.gaussian_filter(values, 2 * finest_edges)
    where = where & (smooth <= np.quantile(smooth[where], 0.98))  # without other bright things than the structure
    level = float(values[where].mean())
    weight = where.astype(np.float32)
    rest = (values - level) * weight
    covariances = [_autocovariance(rest, weight, axis) for axis in range(3)]
    lags = min(map(len, covariances[1:]))
    plane = (covariances[1][:lags] + covariances[2][:lags]) / 2
    noise, lateral, texture, length = _split_covariance(plane)
    _, axial, _, _ = _split_covariance(covariances[0])
    widths = [n / 8 for n in values.shape]
    drift = ndimage.gaussian_filter(rest, widths) / np.maximum(ndimage.gaussian_filter(weight, widths), 1e-3)
    low, high = np.quantile(drift, (0.01, 0.99))
    bias, width = float(high - low) / 2 / max(abs(level), 1e-9), (axial, lateral, lateral)
    return Background(where, level, noise, width, math.sqrt(texture), length * float(steps[2]), bias)


def _measure_noise(
    values: np.ndarray, inside: np.ndarray, ground: Background, steps: np.ndarray, high: float
) -> tuple[float, float, float]:
    """Return gain, read noise and offset: the counts' variance is gain · (mean - offset) + read_noise²."""
    # The line goes through the background and the residuals' bins over the structure; it does not tell offset from read
    # noise. A negative constant is taken as an offset, a positive one as read noise. The slope is limited so that the
    # offset is no brighter than the background's darkest voxels, since fine structure may pass for noise.
    lines = _measure_bins(values, inside, ground, steps)
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
        return 0.0, math.sqrt(ground.noise), floor
    constant = ground.noise - gain * ground.level
    return gain, math.sqrt(max(constant, 0.0)), max(-constant / gain, 0.0)


def _autocovariance(rest: np.ndarray, weight: np.ndarray, axis: int) -> np.ndarray:
    """Return the autocovariance along an axis, at lags from 0, of a residual times its `weight`, which is 1 or 0."""
    a, w = np.moveaxis(rest, axis, 0), np.moveaxis(weight, axis, 0)
    lags = min(12, len(a) // 3)
    sums = [(float((a[: len(a) - k] * a[k:]).sum()), float((w[: len(w) - k] * w[k:]).sum())) for k in range(lags + 1)]
    return np.array([product / max(pairs, 1.0) for product, pairs in sums])


def _split_covariance(covariances: np.ndarray) -> tuple[float, float, float, float]:
    """Return variance and width of the noise, whose covariance is short, and variance and length of the texture."""
    lag = np.arange(len(covariances))
    short = [np.exp(-((lag / (2 * w)) ** 2)) if w else (lag == 0).astype(float) for w in GRAINS]
    long = [np.exp(-0.5 * (lag / length) ** 2) for length in TEXTURE_LENGTHS]
    flat = np.ones(len(lag))
    parts, _ = optimize.nnls(np.stack([*short, *long, flat], 1), covariances)
    noise, texture = parts[: len(GRAINS)], parts[len(GRAINS) : -1]
    total, spread = float(noise.sum()), float(texture.sum())
    width = float(noise @ GRAINS / total) if total else 0.0
    length = float(texture @ TEXTURE_LENGTHS / spread) if spread else TEXTURE_LENGTHS[0]
    return total, width, spread, length


def _measure_bins(
    values: np.ndarray, inside: np.ndarray, ground: Background, steps: np.ndarray
) -> list[tuple[float, float, int]]:
    """Return mean level, noise variance and number of voxels of the structure, in bins of its smoothed level."""
    # Second differences along both axes of the plane: no plane passes, and nothing else that a blur lets through much.
    residual = ndimage.convolve(values, np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)[None])
    mean = ndimage.gaussian_filter(values, 1.5 * steps.min() / steps)
    top = values.max()
    # Saturated voxels and their neighbours have no noise to measure.
    used = inside & (ndimage.maximum_filter(values, 3) < top) if (values == top).mean() > 1e-5 else inside
    # The share of the noise's variance that the filter lets through.
    passed = max(_robust_square(residual[ground.where]), 1e-12) / max(ground.noise, 1e-12)
    bins = []
    edges = np.quantile(mean[used], np.linspace(0, 1, 25)) if used.any() else np.zeros(1)
    for low, high in itertools.pairwise(edges):
        bin_ = used & (mean >= low) & (mean <= high)
        if (count := int(bin_.sum())) >= 50:
            bins.append((float(values[bin_].mean()), _robust_square(residual[bin_]) / passed, count))
    return bins


def _robust_square(residual: np.ndarray) -> float:
    """Return the mean square of a residual without outliers: those beyond four deviations by the median's estimate."""
    square = np.square(residual)
    near = square < 16 * np.median(square) / 0.455
    return float(square[near].mean() if near.any() else square.mean())
