"""What a real scan tells of how it was made: noise, blur, levels, textures; as a modality to draw images from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import ndimage, optimize
from skimage.filters import threshold_otsu

from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.imaging.noise_estimate import NoiseEstimate, background_of, covariance, noise_of
from curvafit.data_synth.imaging.optics import blur
from curvafit.data_synth.imaging.parameters import Contrast, Detector, Illumination, Imaging, Noise, Optics
from curvafit.volumes.field import Field

#: Share of the mean brightness from which on the structure's brightness counts for its texture.
DIMMEST = 0.1
#: Voxels that are looked at; of a larger scan the middle.
MOST = 2_000_000
#: Deviation, in voxels of the finest edge, of the window that the structure's brightness is averaged in.
WINDOW = 4.0
#: Correlation lengths of that brightness, in the same, that are looked at: what a dozen lags can tell apart.
LENGTHS = np.geomspace(WINDOW, 6 * WINDOW, 50)
#: Deviation, in the same, of the smoothing before voxels are told apart.
SMOOTH = 0.8
#: What a drawn parameter is the estimate's, low and high.
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


class Structure(NamedTuple):
    """What the mask's surroundings tell: blur in lengths (z, y, x), mean contrast, its relative deviation and the
    length, in voxels of the finest edge, that it is correlated by."""

    blur: tuple[float, float, float]
    contrast: float
    texture: float
    length: float


def like(scan: Field, mask: np.ndarray | None = None) -> Modality:
    """Return a modality whose images look like a scan: its spacing, levels, textures, blur, noise and uneven light.

    Assumed: two classes; a Gaussian blur, one width in the plane and one along z; noise whose variance is a line over
    the mean (`noise_of`). Not seen: growth with depth, stripes, rings, lost stain and clutter, which stay 0. The blur
    is the one that makes the mask, times a brightness averaged over some voxels, most like the scan.

    Parameters
    ----------
    scan
        Values of any type; counts, whole numbers from 0, are taken to saturate at the highest that their type holds.
    mask
        The structure's voxels, (Z, Y, X). By default the bright ones: Otsu's, then those above half of the brightness
        around them.

    Returns
    -------
    Modality
        `base` holds the estimates, `ranges` their surroundings (`SPREAD`); `voxel` is the finest edge of the scan's.

    Raises
    ------
    ValueError
        If the scan is under eight voxels along an axis, not finite or constant, or the mask is of another shape, empty
        or full.
    """
    values, given = _middle(scan, mask)
    steps = np.array(scan.spacing)
    inside = bright(values, steps) if given is None else given
    if not inside.any() or inside.all():
        raise ValueError("expected a mask with voxels inside and outside, got an empty or a full one")
    ground = background_of(values, inside, steps)
    structure = _structure(values, inside, steps, ground.level)
    noise = noise_of(values, inside, ground, steps, ground.level + structure.contrast)
    base = _imaging(scan, structure, noise)
    ranges = {name: _around(base[name], *ends) for name, ends in SPREAD.items() if np.any(base[name])}
    if bias := ranges.get("illumination.bias"):
        ranges["illumination.bias"] = bias[0], min(bias[1], 1.0)
    about = f"estimated from {scan.source or 'a scan'}, {'its mask' if given is not None else 'without a mask'}"
    return Modality("like", about, float(min(scan.spacing)), base, ranges)


def _imaging(scan: Field, structure: Structure, noise: NoiseEstimate) -> Imaging:
    """Return the parameters of an image: levels in photons where the variance grows with the mean; textures as they
    were before the blur."""
    unit = noise.gain or 1.0
    low = max(noise.level - noise.offset, 0.0) / unit
    high = max(noise.level + structure.contrast - noise.offset, 0.0) / unit
    shrunk = math.prod(1 + 2 * (σ / noise.length) ** 2 for σ in structure.blur) ** 0.25
    length = math.sqrt(max(noise.length**2 - 2 * min(structure.blur) ** 2, min(scan.spacing) ** 2))
    counts = scan.values.dtype.kind in "ui" and scan.values.min() >= 0
    return Imaging(
        unit=scan.unit,
        spacing=scan.spacing,
        contrast=Contrast(
            background=low,
            foreground=high,
            background_texture=min(noise.texture * shrunk / max(low * unit, 1e-9), 2.0),
            background_length=length,
            foreground_texture=min(structure.texture * abs(structure.contrast) / max(high * unit, 1e-9), 2.0),
            foreground_length=structure.length * min(scan.spacing),
        ),
        optics=Optics(structure.blur),
        illumination=Illumination(
            bias=min(noise.bias * abs(noise.level) / max(low * unit, 1e-9), 0.9),
            bias_length=max(n * h for n, h in zip(scan.shape, scan.spacing, strict=True)) / 2,
        ),
        noise=Noise(gaussian=noise.read_noise, width=noise.width),
        detector=Detector(
            gain=noise.gain,
            offset=noise.offset,
            ceiling=float(np.iinfo(scan.values.dtype).max) if counts else None,
        ),
    )


def _middle(scan: Field, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    if min(scan.shape) < 8:
        raise ValueError(f"expected a scan of at least 8 voxels along each axis, got {scan.shape}")
    if mask is not None and np.shape(mask) != scan.shape:
        raise ValueError(f"expected a mask of the scan's shape {scan.shape}, got {np.shape(mask)}")
    sides = list(scan.shape)
    while math.prod(sides) > MOST:
        sides[int(np.argmax(sides))] -= 8
    box = tuple(slice((n - side) // 2, (n - side) // 2 + side) for n, side in zip(scan.shape, sides, strict=True))
    values = scan.values[box].astype(np.float32)
    if not np.isfinite(values).all() or values.min() == values.max():
        raise ValueError("expected a scan of finite values that vary, got NaN, infinity or one value")
    return values, None if mask is None else np.asarray(mask)[box].astype(bool)


def bright(values: np.ndarray, steps: np.ndarray | Sequence[float]) -> np.ndarray:
    """Return a guess at the structure's voxels in grey values (Z, Y, X) on voxels of edges `steps`.

    Those above half of the brightness of Otsu's voxels around them, each weighed by its own: an edge is then where it
    is whatever a structure's brightness. The threshold is sought on square roots, so that dim structures count.
    """
    steps = np.asarray(steps, dtype=float)
    finest = steps.min() / steps
    smooth = ndimage.gaussian_filter(values, SMOOTH * finest)
    root = np.sqrt(np.maximum(smooth - np.quantile(smooth, 0.001), 0))
    above: np.ndarray = root > threshold_otsu(root)
    contrast = smooth - np.median(smooth[~above])
    bright = np.where(above, contrast, 0)
    weight = ndimage.gaussian_filter(bright, WINDOW * finest)
    local = ndimage.gaussian_filter(bright**2, WINDOW * finest) / np.maximum(weight, 1e-6 * weight.max())
    return np.logical_and(contrast > local / 2, ndimage.maximum_filter(above, size=3))


def _structure(values: np.ndarray, inside: np.ndarray, steps: np.ndarray, level: float) -> Structure:
    """Return the blur (z, and y = x) whose image of the mask is nearest to the scan around it; the brightness
    inside."""
    finest = steps.min() / steps
    window = tuple(WINDOW * finest)
    signal, mask = (torch.from_numpy(each)[None, None].float() for each in (values - level, inside))
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
    contrast = brightness(blur(mask, 1.0, tuple(widths)))[0, 0].numpy()
    mean = float(contrast[inside].mean())
    z, y, x = (np.sqrt(np.maximum(widths**2 - 1 / 12, 0)) * steps).tolist()
    return Structure((z, y, x), mean, *_texture(contrast / mean, inside, steps))


def _texture(relative: np.ndarray, inside: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    """Return the deviation and the length, in voxels of the finest edge, of a brightness that was averaged over a
    window of `WINDOW`: by the covariance of its logarithm in the plane. The average lengthens the one, and along a tube
    it lessens the other. What has lost its light is not looked at: a logarithm would see little else."""
    bright_part = inside & (relative > DIMMEST)
    logs = np.log(np.where(bright_part, relative, 1.0))
    weight = bright_part.astype(np.float32)
    rest = (logs - logs[bright_part].mean()) * weight
    first, second = (covariance(rest, weight, axis) for axis in (1, 2))
    covariances = np.concatenate([first, second])
    lags = np.concatenate(
        [np.arange(len(each)) * h / steps.min() for each, h in ((first, steps[1]), (second, steps[2]))]
    )
    share = covariances / max(covariances[0], 1e-12)
    misfit = [np.square(share - np.exp(-0.5 * (lags / length) ** 2)).sum() for length in LENGTHS]
    width = float(LENGTHS[int(np.argmin(misfit))])
    length = math.sqrt(max(width**2 - 2 * WINDOW**2, WINDOW**2))
    return math.sqrt(math.expm1(float(covariances[0]) * max(width / length, 1.0))), length


def _around(value: Any, low: float, high: float) -> tuple[Any, Any]:
    if isinstance(value, tuple):
        return tuple(low * each for each in value), tuple(high * each for each in value)
    return low * value, high * value
