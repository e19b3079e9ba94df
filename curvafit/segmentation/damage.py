"""What networks do to masks: log-odds as a network would give them for a shape, with the errors that networks make.

Breaks, false bridges, holes, specks, outlines that waver, zones where it is unsure, staircases of thick slices; and the
errors of all that reads a noisy image with a window of some voxels. Lengths are in voxels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from curvafit.scan.grids import centre_distance
from curvafit.segmentation.repair import FAR, SUREST


@dataclass(frozen=True)
class Damage:
    """How log-odds are damaged; lengths in voxels, shares from 0 to 1, noise in contrasts of the image.

    Attributes
    ----------
    image
        Share of maps that come from a noisy image; the others come from the shape's outline, which wavers.
    blur, noise, grain
        Intervals of the deviation of the image's blur, window of reading included; of what noise is left; and of the
        noise's correlation.
    bias, drift
        Deviations of the threshold from the middle, everywhere and from place to place.
    waver
        Interval of the deviation of an outline.
    share, number
        Share of maps with each of breaks, bridges, holes, specks and unsure zones, and the most of them in a map.
    stairs, slices
        Share of maps of thick slices, and the voxels of a slice.
    sharpness, hard
        Interval of the factor on log-odds, and the share of maps that are masks.
    """

    image: float = 0.6
    blur: tuple[float, float] = (0.5, 2.0)
    noise: tuple[float, float] = (0.05, 0.3)
    grain: tuple[float, float] = (0.7, 3.0)
    bias: float = 0.06
    drift: float = 0.06
    waver: tuple[float, float] = (0.1, 0.8)
    share: float = 0.35
    number: int = 12
    stairs: float = 0.25
    slices: tuple[int, int] = (2, 5)
    sharpness: tuple[float, float] = (0.4, 3.0)
    hard: float = 0.15


def damage(mask: np.ndarray, rng: np.random.Generator, how: Damage) -> np.ndarray:
    """Return the log-odds of a mask (Z, Y, X) as a network may give them, float32, cut at `SUREST`."""
    level = centre_distance(mask, (1.0, 1.0, 1.0), FAR)
    odds = _read_image(mask, rng, how) if rng.random() < how.image else _waver(level, rng, how)
    odds *= 3 / max(float(odds.std()), 1e-6)
    for defect in (_break, _bridge, _pierce, _speckle, _doubt):
        if rng.random() < how.share:
            for _ in range(int(rng.integers(1, how.number + 1))):
                defect(odds, level, rng)
    if rng.random() < how.stairs:
        odds = _thicken_slices(odds, rng, how)
    odds = odds * np.float32(_between(how.sharpness, rng))
    if rng.random() < how.hard:
        odds = np.where(odds > 0, SUREST, -SUREST)
    return odds.clip(-SUREST, SUREST).astype(np.float32)


def _between(interval: tuple[float, float], rng: np.random.Generator) -> float:
    """Draw a number from an interval, uniform in the logarithm."""
    return math.exp(rng.uniform(*np.log(interval)))


def _smooth_noise(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> np.ndarray:
    """Return Gaussian noise of deviation 1 with a correlation, float32."""
    noise = ndimage.gaussian_filter(rng.standard_normal(shape, dtype=np.float32), width, mode="wrap")
    return noise / max(float(noise.std()), 1e-6)


def _read_image(mask: np.ndarray, rng: np.random.Generator, how: Damage) -> np.ndarray:
    """Return what a window of a noisy image of a mask says, as log-odds up to a factor."""
    clear = ndimage.gaussian_filter(mask.astype(np.float32), _between(how.blur, rng), mode="nearest")
    seen = clear + _between(how.noise, rng) * _smooth_noise(mask.shape, _between(how.grain, rng), rng)
    drift = how.drift * _smooth_noise(mask.shape, min(mask.shape) / 4, rng)
    return seen - np.float32(0.5 + how.bias * rng.standard_normal()) - drift.astype(np.float32)


def _waver(level: np.ndarray, rng: np.random.Generator, how: Damage) -> np.ndarray:
    """Return signed distances to an outline that has moved to and fro."""
    wave = sum(_between(how.waver, rng) * _smooth_noise(level.shape, width, rng) for width in (1.5, 3.0, 6.0))
    return level + np.asarray(wave, dtype=np.float32)


def _add_bump(odds: np.ndarray, centre: np.ndarray, radii: np.ndarray, turn: np.ndarray, change: Callable) -> None:
    """Change log-odds around a place, by a Gaussian bump with radii along three directions."""
    reach = math.ceil(2.5 * float(radii.max()))
    box = tuple(slice(max(int(c) - reach, 0), int(c) + reach + 1) for c in centre)
    part = odds[box]
    places = [np.arange(part.shape[k]) + box[k].start - centre[k] for k in range(3)]
    offset = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1) @ turn
    bump = np.exp(-0.5 * np.square(offset / radii).sum(-1)).astype(np.float32)
    odds[box] = change(part, bump)


def _pick(where: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Draw a voxel, None where there is none."""
    found = np.flatnonzero(where)
    return np.array(np.unravel_index(int(rng.choice(found)), where.shape)) if len(found) else None


def _turn(rng: np.random.Generator) -> np.ndarray:
    return np.linalg.qr(rng.standard_normal((3, 3)))[0]


def _break(odds: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> None:
    """Break a strut: lower the log-odds around a place in the middle of the structure."""
    inside = level[level > 0]
    if not inside.size:
        return
    centre = _pick(level >= np.quantile(inside, 0.6), rng)
    if centre is not None:
        thick, strength = max(float(level[tuple(centre)]), 1.0), rng.uniform(4, 14)
        radii = np.array([rng.uniform(0.8, 2.5), *(thick * rng.uniform(0.6, 1.5, 2) + 0.5)])
        _add_bump(odds, centre, radii, _turn(rng), lambda part, bump: part - np.float32(strength) * bump)


def _bridge(odds: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> None:
    """Join what is apart: raise the log-odds in a rod through the background, near a surface."""
    centre = _pick((level < -0.5) & (level > -5), rng)
    if centre is not None:
        radii, strength = np.array([rng.uniform(2, 5), *rng.uniform(0.8, 2.0, 2)]), rng.uniform(4, 14)
        _add_bump(odds, centre, radii, _turn(rng), lambda part, bump: part + np.float32(strength) * bump)


def _pierce(odds: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> None:
    """Make a hole in the structure."""
    centre = _pick(level > 1, rng)
    if centre is not None:
        radii, strength = rng.uniform(0.7, 2.5, 3), rng.uniform(4, 14)
        _add_bump(odds, centre, radii, _turn(rng), lambda part, bump: part - np.float32(strength) * bump)


def _speckle(odds: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> None:
    """Put a speck into the background."""
    centre = _pick(level < -1, rng)
    if centre is not None:
        radii, strength = rng.uniform(0.7, 3.0, 3), rng.uniform(4, 14)
        _add_bump(odds, centre, radii, _turn(rng), lambda part, bump: part + np.float32(strength) * bump)


def _doubt(odds: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> None:
    """Make a zone unsure."""
    centre, shift = rng.uniform(0, level.shape), rng.normal(0, 0.7)
    keep = lambda part, bump: part * (1 - np.float32(0.95) * bump) + np.float32(shift) * bump  # noqa: E731
    _add_bump(odds, centre, rng.uniform(3, 9, 3), _turn(rng), keep)


def _thicken_slices(odds: np.ndarray, rng: np.random.Generator, how: Damage) -> np.ndarray:
    """Return log-odds of thick slices along an axis, repeated or interpolated between."""
    axis, count = int(rng.integers(3)), int(rng.integers(how.slices[0], how.slices[1] + 1))
    first = int(rng.integers(count))
    kept = np.moveaxis(odds, axis, 0)[first::count]
    if rng.random() < 0.5:
        rows = kept[np.minimum(np.arange(odds.shape[axis]) // count, len(kept) - 1)]
    else:
        places = ((np.arange(odds.shape[axis]) - first) / count).clip(0, len(kept) - 1)
        low = np.minimum(places.astype(int), len(kept) - 1)
        high, part = np.minimum(low + 1, len(kept) - 1), (places - low).astype(np.float32)[:, None, None]
        rows = kept[low] * (1 - part) + kept[high] * part
    return np.ascontiguousarray(np.moveaxis(rows, 0, axis))
