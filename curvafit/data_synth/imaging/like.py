"""A modality estimated from a real scan: its noise, blur, levels and textures."""

from __future__ import annotations

import itertools
import math
from operator import attrgetter
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
    variance is a line over the mean. Growth with depth, stripes, rings, lost stain and clutter stay 0. The blur makes
    the mask, times a local brightness, most like the scan. Whole numbers from 0 saturate at the highest of their type.

    The mask is the structure's voxels, (Z, Y, X); by default what is bright. The modality's `base` holds the estimates,
    its `ranges` their surroundings (`SPREAD`), and its `voxel` is the finest edge of the scan's.
    """
    values, cropped_mask = crop_middle(scan, mask)
    edges = np.array(scan.spacing)
    inside = _find_bright(values, edges) if cropped_mask is None else cropped_mask
    if not inside.any() or inside.all():
        raise ValueError("the mask must have voxels inside and outside, got an empty or a full one")
    background = _measure_background(values, inside, edges)
    structure = _measure_structure(values, inside, edges, background.level)
    noise = _measure_noise(values, inside, background, edges, background.level + structure[1])
    imaging = _to_imaging(scan, background, structure, noise)
    estimates = {name: np.asarray(attrgetter(name)(imaging)) for name in SPREAD}
    ranges = {name: tuple((end * v).tolist() for end in SPREAD[name]) for name, v in estimates.items() if v.any()}
    if imaging.illumination.bias:
        low, high = ranges["illumination.bias"]
        ranges["illumination.bias"] = low, min(high, 1.0)
    about = f"estimated from {scan.source or 'a scan'}, {'its mask' if cropped_mask is not None else 'without a mask'}"
    return Modality("like", about, float(min(scan.spacing)), imaging, ranges)


def _to_imaging(scan: Volume, background: Background, structure: Structure, noise: Triple) -> Imaging:
    """Return the estimates as parameters of an image: levels in photons where there is a gain, textures before blur."""
    (widths, contrast, texture, texture_length), (gain, read_noise, offset) = structure, noise
    scale = gain or 1.0  # counts of a photon
    dark = max(background.level - offset, 0.0) / scale
    bright = max(background.level + contrast - offset, 0.0) / scale
    # The blur has lessened the deviation of the background's texture, and lengthened its correlation.
    factor = math.prod(1 + 2 * (σ / background.length) ** 2 for σ in widths) ** 0.25
    length = math.sqrt(max(background.length**2 - 2 * min(widths) ** 2, min(scan.spacing) ** 2))
    dark_counts, bright_counts = max(dark * scale, 1e-9), max(bright * scale, 1e-9)
    dark_texture = min(background.texture * factor / dark_counts, 2.0)
    bright_texture = min(texture * abs(contrast) / bright_counts, 2.0)
    sides = (n * h for n, h in zip(scan.shape, scan.spacing, strict=True))
    counted = scan.values.dtype.kind in "ui" and scan.values.min() >= 0
    ceiling = float(np.iinfo(scan.values.dtype).max) if counted else None
    return Imaging(
        unit=scan.unit,
        spacing=scan.spacing,
        contrast=Contrast(dark, bright, dark_texture, length, bright_texture, texture_length * min(scan.spacing)),
        optics=Optics(widths),
        illumination=Illumination(min(background.bias * abs(background.level) / dark_counts, 0.9), max(sides) / 2),
        noise=Noise(gaussian=read_noise, width=background.width),
        detector=Detector(gain=gain, offset=offset, ceiling=ceiling),
    )


def crop_middle(scan: Volume, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
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


def _find_bright(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Guess the structure's voxels, bool (Z, Y, X), from grey values on voxels of `edges` (z, y, x)."""
    # A voxel is the structure's where its contrast is above half of the local one: the mean, weighted by brightness,
    # over nearby voxels above Otsu's threshold. So an edge does not depend on the structure's brightness. The threshold
    # is that of square roots, which shows dim structures.
    finest = edges.min() / edges
    smooth = ndimage.gaussian_filter(values, 0.8 * finest)
    root = np.sqrt(np.maximum(smooth - np.quantile(smooth, 0.001), 0))
    above: np.ndarray = root > threshold_otsu(root)
    contrast = smooth - np.median(smooth[~above])
    bright = np.where(above, contrast, 0)
    weight = ndimage.gaussian_filter(bright, WINDOW * finest)
    local = ndimage.gaussian_filter(bright**2, WINDOW * finest) / np.maximum(weight, 1e-6 * weight.max())
    return np.logical_and(contrast > local / 2, ndimage.maximum_filter(above, size=3))


def _measure_structure(values: np.ndarray, inside: np.ndarray, edges: np.ndarray, level: float) -> Structure:
    """Fit the blur of the mask to the scan near it. Return the blur's deviations (z, y = x), the mean contrast inside,
    its relative deviation (texture), and the texture's correlation length in voxels of the finest edge."""
    finest = edges.min() / edges
    window = tuple(WINDOW * finest)
    signal, mask = (torch.from_numpy(volume).float() for volume in (values - level, inside))
    nearby = blur(mask, 1.0, tuple(2 * finest)) > 0.02

    def brightness(blurred: torch.Tensor) -> torch.Tensor:
        weight = blur(blurred * blurred, 1.0, window)
        return blur(signal * blurred, 1.0, window) / weight.clamp_min(1e-6)

    def misfit(logs: np.ndarray) -> float:
        blurred = blur(mask, 1.0, tuple(np.exp(logs[[0, 1, 1]])))
        return float((signal - brightness(blurred) * blurred)[nearby].square().mean())

    start = np.log([max(finest[0], 0.5), 1.0])
    simplex = start + np.array([[0, 0], [0.5, 0], [0, 0.5]])
    options = {"xatol": 0.02, "fatol": math.inf, "maxfev": 80, "initial_simplex": simplex}
    widths = np.exp(optimize.minimize(misfit, start, method="Nelder-Mead", options=options).x[[0, 1, 1]])
    contrast = brightness(blur(mask, 1.0, tuple(widths))).numpy()
    mean = float(contrast[inside].mean())
    z, y, x = (np.sqrt(np.maximum(widths**2 - 1 / 12, 0)) * edges).tolist()  # without the average over a voxel
    return (z, y, x), mean, *_measure_texture(contrast / mean, inside, edges)


def _measure_texture(relative: np.ndarray, inside: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Return the deviation and the correlation length, in voxels of the finest edge, of the brightness inside."""
    # Both come from the covariance, in the plane, of the logarithm, which voxels under `DIMMEST` would dominate. The
    # average over `WINDOW` lengthens the correlation, and lessens the deviation along a tube.
    bright = inside & (relative > DIMMEST)
    logs = np.log(np.where(bright, relative, 1.0))
    weight = bright.astype(np.float32)
    residual = (logs - logs[bright].mean()) * weight
    first, second = (_autocovariance(residual, weight, axis) for axis in (1, 2))
    covariances = np.concatenate([first, second])
    lags = np.concatenate([np.arange(len(first)) * edges[1], np.arange(len(second)) * edges[2]]) / edges.min()
    correlations = covariances / max(covariances[0], 1e-12)
    misfits = [np.square(correlations - np.exp(-0.5 * (lags / length) ** 2)).sum() for length in BRIGHTNESS_LENGTHS]
    width = float(BRIGHTNESS_LENGTHS[int(np.argmin(misfits))])
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


def _measure_background(values: np.ndarray, inside: np.ndarray, edges: np.ndarray) -> Background:
    """Measure the background some voxels away from the structure; noise and texture differ in their correlations."""
    finest = edges.min() / edges
    distant = ndimage.distance_transform_edt(~inside, sampling=edges) > 4 * edges.min()
    where = distant if distant.mean() > 0.02 else ~inside
    smooth = ndimage.gaussian_filter(values, 2 * finest)
    where = where & (smooth <= np.quantile(smooth[where], 0.98))  # without other bright things than the structure
    level = float(values[where].mean())
    weight = where.astype(np.float32)
    residual = (values - level) * weight
    covariances = [_autocovariance(residual, weight, axis) for axis in range(3)]
    lags = min(map(len, covariances[1:]))
    in_plane = (covariances[1][:lags] + covariances[2][:lags]) / 2
    noise, lateral, texture, length = _split_covariance(in_plane)
    _, axial, _, _ = _split_covariance(covariances[0])
    widths = [n / 8 for n in values.shape]
    drift = ndimage.gaussian_filter(residual, widths) / np.maximum(ndimage.gaussian_filter(weight, widths), 1e-3)
    low, high = np.quantile(drift, (0.01, 0.99))
    bias, width = float(high - low) / 2 / max(abs(level), 1e-9), (axial, lateral, lateral)
    return Background(where, level, noise, width, math.sqrt(texture), length * float(edges[2]), bias)


def _measure_noise(
    values: np.ndarray, inside: np.ndarray, background: Background, edges: np.ndarray, bright_level: float
) -> tuple[float, float, float]:
    """Return gain, read noise and offset: the counts' variance is gain · (mean - offset) + read_noise²."""
    # The line through the background is fitted to bins over the structure; it does not tell offset from read noise. A
    # negative constant is taken as an offset, a positive one as read noise. The slope is limited so that the
    # offset is no brighter than the background's darkest voxels, since fine structure may pass for noise.
    bins = _measure_bins(values, inside, background, edges)
    gain = 0.0
    if len(bins) > 2:
        mean, variance, count = np.array(bins).T
        weighted = count * (mean - background.level)  # least squares, through the background
        rise, run = (float((weighted * d).sum()) for d in (variance - background.noise, mean - background.level))
        gain = max(rise / run, 0.0) if run else 0.0
    darkest = float(np.quantile(values[background.where], 0.001))
    gain = min(gain, background.noise / max(background.level - darkest, 1e-12))
    contrast = abs(bright_level - background.level)
    if not gain or gain * contrast < (GROWS - 1) * background.noise:
        # Texture is relative to a level above the offset, which is lowered where the background would not be above it.
        offset = 0.0 if background.level > 2 * background.texture else background.level - contrast
        return 0.0, math.sqrt(background.noise), offset
    constant = background.noise - gain * background.level
    return gain, math.sqrt(max(constant, 0.0)), max(-constant / gain, 0.0)


def _autocovariance(residual: np.ndarray, weight: np.ndarray, axis: int) -> np.ndarray:
    """Return the autocovariance along an axis, at lags from 0, of a residual times its `weight`, which is 1 or 0."""
    values, weights = np.moveaxis(residual, axis, 0), np.moveaxis(weight, axis, 0)
    lags = min(12, len(values) // 3)
    products = [float((values[: len(values) - k] * values[k:]).sum()) for k in range(lags + 1)]
    pairs = [float((weights[: len(weights) - k] * weights[k:]).sum()) for k in range(lags + 1)]
    return np.array(products) / np.maximum(pairs, 1.0)


def _split_covariance(covariances: np.ndarray) -> tuple[float, float, float, float]:
    """Return variance and width of the noise, whose covariance is short, and variance and length of the texture."""
    # White noise smoothed by a Gaussian of deviation w has the covariance exp(-(lag / 2w)²); a constant is a drift's.
    lag = np.arange(len(covariances))
    noise_shapes = [np.exp(-((lag / (2 * w)) ** 2)) if w else (lag == 0).astype(float) for w in GRAINS]
    texture_shapes = [np.exp(-0.5 * (lag / length) ** 2) for length in TEXTURE_LENGTHS]
    amplitudes, _ = optimize.nnls(np.stack([*noise_shapes, *texture_shapes, np.ones(len(lag))], 1), covariances)
    noise, texture = amplitudes[: len(GRAINS)], amplitudes[len(GRAINS) : -1]
    noise_variance, texture_variance = float(noise.sum()), float(texture.sum())
    width = float(noise @ GRAINS / noise_variance) if noise_variance else 0.0
    length = float(texture @ TEXTURE_LENGTHS / texture_variance) if texture_variance else TEXTURE_LENGTHS[0]
    return noise_variance, width, texture_variance, length


def _measure_bins(
    values: np.ndarray, inside: np.ndarray, background: Background, edges: np.ndarray
) -> list[tuple[float, float, int]]:
    """Return mean level, noise variance and number of voxels of the structure, in bins of its smoothed level."""
    # Second differences along both axes of the plane: no plane passes, and nothing else that a blur lets through much.
    residual = ndimage.convolve(values, np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)[None])
    mean = ndimage.gaussian_filter(values, 1.5 * edges.min() / edges)
    highest = values.max()
    # Saturated voxels and their neighbours have no noise to measure.
    used = inside & (ndimage.maximum_filter(values, 3) < highest) if (values == highest).mean() > 1e-5 else inside
    # The factor by which the filter changes the noise's variance.
    transmission = max(_robust_square(residual[background.where]), 1e-12) / max(background.noise, 1e-12)
    bins = []
    quantiles = np.quantile(mean[used], np.linspace(0, 1, 25)) if used.any() else np.zeros(1)
    for low, high in itertools.pairwise(quantiles):
        bin_ = used & (mean >= low) & (mean <= high)
        if (count := int(bin_.sum())) >= 50:
            bins.append((float(values[bin_].mean()), _robust_square(residual[bin_]) / transmission, count))
    return bins


def _robust_square(residual: np.ndarray) -> float:
    """Return the mean square of a residual without outliers: those beyond four deviations by the median's estimate."""
    square = np.square(residual)  # whose median is 0.455 times the variance, if the residual is normal
    inlier = square < 16 * np.median(square) / 0.455
    return float(square[inlier].mean() if inlier.any() else square.mean())
