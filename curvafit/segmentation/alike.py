"""Textures like known slices: chosen by what the slices look like, drawn anew, and taught to the filler, for a minute.

No example is needed. What the textures of `data_synth.textures` look like in slices is packaged, as numbers; only those
that are taken are drawn.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.special import expit

from curvafit.core.files import open_packaged
from curvafit.core.runtime import Progress, silent
from curvafit.data_synth.textures import KINDS
from curvafit.segmentation.filler import REACH, Raster, Taught, fill, plane_thickness
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.teach import FILLED, TEXTURES, TUNING, TUNING_RATE, Lessons, Mix, draw_texture, learn
from curvafit.segmentation.trials import PART, crop_to_surface, dice
from curvafit.segmentation.uncertainty import best_log_odds, expected_dice

#: Thicknesses in pixels at which the looks within slices are kept, and gaps over thicknesses for those between them.
THICKNESSES, GAPS = (4.0, 8.0, 16.0), (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
#: Numbers that are kept of a texture.
COLUMNS = 6 * len(THICKNESSES) + len(GAPS)
#: Textures that teach; their root mean square distance from the slices, in deviations of all, up to which they do.
NEAREST, FARTHEST = 30, 1.5
#: Expected Dice of the volume by the network as it is, from which textures do not make it better.
WELL = 0.85
#: Pixels of a side, and number, of the windows by which a texture is described.
SIDE, WINDOWS = 96, 3
#: Deviation of the blur of outlines, in pixels, before their curvature is taken, and levels next to an outline.
BLUR, NEAR = 1.5, 0.25


def describe_planes(masks: np.ndarray, thickness: float) -> np.ndarray:
    """Return how masks (n, Y, X) look in their planes `(6,)`, given a thickness in pixels: log-odds of the share
    inside; logarithms of the outline's length, of bodies, of holes and of the deviation of the outline's curvature; and
    the mean of that, all in thicknesses."""
    share = float(np.clip(masks.mean(), 1e-3, 1 - 1e-3))
    steps = sum(float(np.abs(np.diff(masks.view(np.int8), axis=axis)).mean()) for axis in (1, 2))
    bodies, outside = (
        np.array([ndimage.label(mask)[1] for mask in phase]) / masks[0].size  # type: ignore[index]
        for phase in (masks, ~masks)
    )
    holes = np.maximum(outside - 1 / masks[0].size, 0)  # the largest piece of the outside is none
    level = ndimage.gaussian_filter(masks.astype(np.float32), (0, BLUR, BLUR))
    down, right = np.gradient(level, axis=(1, 2))
    length = np.hypot(down, right) + 1e-6
    bends = thickness * (np.gradient(down / length, axis=1) + np.gradient(right / length, axis=2))
    bends = bends[np.abs(level - 0.5) < NEAR]
    mean, spread = (float(bends.mean()), float(bends.std())) if len(bends) else (0.0, 0.0)
    pieces = thickness**2 * np.array([bodies.mean(), holes.mean()]) + 0.01
    return np.array([np.log(share / (1 - share)), *np.log([thickness * steps + 1e-3, *pieces, spread + 0.1]), mean / 2])


def overlap(masks: np.ndarray) -> float:
    """Return the Dice coefficient of neighbours among masks (n, Y, X), the mean over pairs that are not empty."""
    pairs = [(a, b) for a, b in itertools.pairwise(masks) if a.any() or b.any()]
    return float(np.mean([dice(a, b) for a, b in pairs])) if pairs else 1.0


def tabulate(kind: str, number: int) -> np.ndarray:
    """Return how a texture looks `(24,)`: `describe_planes` at each of `THICKNESSES`, `overlap` at each of `GAPS`. They
    are NaN of one that fills too little or too much to teach."""
    texture, rng, mix = draw_texture(kind, number), np.random.default_rng(number), Mix()
    if not FILLED[0] < (texture.values > 0).mean() < FILLED[1]:
        return np.full(COLUMNS, np.nan)
    plane = np.arange(float(SIDE))

    def cut(thickness: float, gap: float, count: int) -> np.ndarray:
        return texture.cut(rng, (gap * np.arange(count), plane, plane), thickness, mix)

    looks = [np.mean([describe_planes(cut(t, 2 * t, 3), t) for _ in range(WINDOWS)], 0) for t in THICKNESSES]
    middle = THICKNESSES[1]
    overlaps = [np.mean([overlap(cut(middle, gap * middle, 3)) for _ in range(WINDOWS)]) for gap in GAPS]
    return np.concatenate([*looks, overlaps])


@dataclass(frozen=True, eq=False)
class Looks:
    """How known slices look, in pixels: the thickness of their structure, the gap, slices in a gap, and the numbers of
    `describe_planes` and `overlap`, `(7,)`."""

    thickness: float
    gap: float
    count: int
    numbers: np.ndarray

    @classmethod
    def of(cls, slices: Slices) -> Looks:
        """Describe slices."""
        raster, inner = Raster.of(slices), slice(REACH, -REACH)
        masks = np.stack([raster.distances(mask)[inner, inner] > 0 for mask in slices.inside])
        thickness = plane_thickness(masks, (1.0, 1.0))
        numbers = np.append(describe_planes(masks, thickness), overlap(masks))
        gap = slices.gap * slices.spacing[0] / raster.pixel
        return cls(thickness, gap, slices.gap - 1, numbers)

    def find(self) -> tuple[list[tuple[str, int]], float]:
        """Return the `NEAREST` textures, by kind and number, and their root mean square distance."""
        with np.load(open_packaged("segmentation", "alike.npz")) as file:
            rows = file["rows"].astype(float)
        names = [(kind, number) for kind in KINDS for number in range(TEXTURES)]
        planes = rows[:, : -len(GAPS)].reshape(len(rows), len(THICKNESSES), -1)
        looks = np.stack([_interpolate(self.thickness, THICKNESSES, each.T) for each in planes])
        overlaps = _interpolate(self.gap / self.thickness, GAPS, rows[:, -len(GAPS) :])
        table = np.column_stack([looks, overlaps])
        known = np.flatnonzero(np.isfinite(table).all(1))
        distances = np.square((table[known] - self.numbers) / table[known].std(0)).mean(1)
        nearest = distances.argsort(kind="stable")[:NEAREST]
        return [names[k] for k in known[nearest]], float(np.sqrt(distances[nearest].mean()))


def _interpolate(value: float, places: Sequence[float], rows: np.ndarray) -> np.ndarray:
    """Interpolate rows (n, places) linearly in the logarithm of the place."""
    at = np.interp(np.log(value), np.log(places), np.arange(len(places)))
    low = min(int(at), len(places) - 2)
    return rows[:, low] + (at - low) * (rows[:, low + 1] - rows[:, low])


def tune_alike(taught: Taught, slices: Slices, progress: Progress = silent) -> tuple[Taught, tuple[str, ...]]:
    """Train a filler further on textures that look like known slices, or like the part of large ones that has most
    surface; return it with notes. Where the filler as it was fills the volume well, or nothing looks like the slices,
    it stays so, and a note says why."""
    slices = crop_to_surface(slices, 2 * PART)[0]
    logits = fill(slices, taught)[slices.between]
    if expected_dice(expit(logits), logits > best_log_odds(logits)) > WELL:
        return taught, ("Known slices tell the volume well: the network is not tuned.",)
    looks = Looks.of(slices)
    names, distance = looks.find() if math.isfinite(looks.thickness) else ([], math.inf)
    if distance > FARTHEST:
        return taught, ("No texture looks like the known slices: the network is not tuned.",)
    textures = []
    for k, name in enumerate(names):
        progress("drawing textures like the slices", 0.3 * k / len(names))
        textures.append(draw_texture(*name))
    narrow = (looks.thickness / 1.18, looks.thickness * 1.18)
    mix = Mix(thickness=narrow, pairs=0.0, holes=0.0, trembling=0.0, partial=0.0)
    step = looks.gap / (looks.count + 1)
    lessons = Lessons([textures], mix, 0, TUNING, size=3, edge=64, count=looks.count, step=step)
    tuned = replace(taught, filler=copy.deepcopy(taught.filler))
    report: Progress = lambda _, done: progress("tuning on textures like the slices", 0.3 + 0.7 * done)  # noqa: E731
    learn(tuned.filler, lessons, TUNING_RATE, workers=0, progress=report)
    return replace(tuned, status="filled by the network, tuned on textures like the slices"), ()
