"""Grids and boxes: resampling, distances and profiles of masks, thickness, specks, boxes with the most surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from threading import Lock
from typing import NamedTuple, cast

import numpy as np
from numba import njit
from scipy import ndimage

from curvafit.geometry.balls import border_distance
from curvafit.geometry.morphology import local_thickness
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.kernels.cpu import gaussian_blur
from curvafit.priors.profile import PULL, PULL_WIDTH, STAIRS, SWEEPS
from curvafit.priors.stencils import gaussian_taps
from curvafit.volumes.volume import Box

#: Median thickness is measured in a box of at most this many voxels a side.
MEASURED = 160
#: Deviations, in voxels, of the Gaussians that smooth stairs after that of `priors.profile.STAIRS`, where the border
#: moves by less than so many voxels, a root mean square over what is near: a Gaussian, in a band on either side.
WIDER, MOVED, NEARBY, BAND = (2.5, 3.0), 0.1, 2.0, 2.5
#: Part of the voxels below which Gaussians are added one by one.
FEW = 1 / 150
#: Numbers that a processor adds at once, and an index that is not negative.
_LANES, _at = 8, np.uint64
#: Voxels of a periodic mask beyond its box on which its phase field depends.
REPEATED = 36


def bounding_box(shape: tuple[int, int, int], region: np.ndarray | None, longest: int) -> tuple[Box, tuple[str, ...]]:
    """Return the box around a region (else all), cut to the middle `longest` voxels of longer sides, and notes."""
    box, notes = [slice(0, n) for n in shape], []
    if region is not None:
        box = list(ndimage.find_objects(region.astype(np.uint8))[0])
        notes.append(f"The region of interest holds {region.mean():.1%} of the scan.")
    if any(s.stop - s.start > longest for s in box):
        box = [_middle(s, longest) for s in box]
        sides = " x ".join(str(s.stop - s.start) for s in box)
        more = "of a pyramid a coarser level (scan.zarr::1) shows more"
        notes.append(f"Of this large scan the middle {sides} voxels are used; {more}.")
    return (box[0], box[1], box[2]), tuple(notes)


class Thickness:
    """Local thickness of the phases of one scan: each is measured once, by the thread that asks first."""

    def __init__(self) -> None:
        self._lock, self._known = Lock(), list[tuple[np.ndarray, Future[np.ndarray]]]()

    def __call__(self, mask: np.ndarray, spacing: tuple[float, float, float], *, periodic: bool = False) -> np.ndarray:
        """Return `local_thickness` of a mask of the scan; the result is not to be written to."""
        mine = Future[np.ndarray]()
        try:
            with self._lock:
                asked = [future for known, future in self._known if np.array_equal(known, mask)]
                self._known.append((mask, mine))
            mine.set_result(asked[0].result() if asked else local_thickness(mask, spacing, periodic=periodic))
        except BaseException as reason:  # a signal too: who waits is told
            mine.set_exception(reason)
        return mine.result()


def median_thickness(
    mask: np.ndarray,
    spacing: tuple[float, float, float],
    periodic: bool,
    measure: Callable[..., np.ndarray] = local_thickness,
) -> tuple[float, float]:
    """Return the median and 95th percentile of the local thickness over the structure's surface, measured in the box of
    at most `MEASURED` voxels a side that `box_by_surface` picks."""
    # Weighed by surface, not by volume, as a curvature diagram is: else a rind around thin struts would set the scale.
    surface = surface_voxels(mask)
    box = box_by_surface(surface, MEASURED)
    cropped, surface = (mask[box], surface[box]) if box else (mask, mask)
    return thickness_beneath(cropped, surface, spacing, periodic and cropped.shape == mask.shape, measure)


def thickness_beneath(
    mask: np.ndarray,
    surface: np.ndarray,
    spacing: tuple[float, float, float],
    periodic: bool = False,
    measure: Callable[..., np.ndarray] = local_thickness,
) -> tuple[float, float]:
    """Return the median and 95th percentile of the local thickness of a mask over its `surface`, of its shape."""
    values = measure(mask, spacing, periodic=periodic)[surface]
    return float(np.median(values)), float(np.percentile(values, 95))


def surface_voxels(mask: np.ndarray) -> np.ndarray:
    """Return the voxels of the structure with a face on the background, inside the box."""
    inner = mask.copy()
    for axis in range(3):
        values, core = np.moveaxis(mask, axis, 0), np.moveaxis(inner, axis, 0)
        core[1:] &= values[:-1]
        core[:-1] &= values[1:]
    return mask & ~inner


def box_by_surface(content: np.ndarray, size: int | Sequence[int]) -> Box | None:
    """Return the one of `candidate_boxes` that `pick_box` picks by its voxels of `content`; None where it has none."""
    candidates = candidate_boxes(content.shape, size)
    counts = [int(np.count_nonzero(content[box])) for box in candidates]
    return pick_box(candidates, counts) if any(counts) else None


def candidate_boxes(shape: Sequence[int], size: int | Sequence[int]) -> list[Box]:
    """Return the middle box of a volume, of at most `size` voxels a side, and others that cover the volume."""
    sides = [size] * 3 if isinstance(size, int) else list(size)
    middle = tuple(_middle(slice(0, n), side) for n, side in zip(shape, sides, strict=True))
    tiles = [_tiles(n, side) for n, side in zip(shape, sides, strict=True)]
    return [middle] + [(z, y, x) for z in tiles[0] for y in tiles[1] for x in tiles[2] if (z, y, x) != middle]  # type: ignore[list-item]


def pick_box(candidates: Sequence[Box], counts: Sequence[int]) -> Box:
    """Return the middle box, the first of `candidate_boxes`, unless its count of voxels is less than half of the
    average; then the box with most."""
    middle_will_do = counts[0] >= 0.5 * sum(counts) / len(counts)
    return candidates[0 if middle_will_do else int(np.argmax(counts))]


def box_with_most_surface(mask: np.ndarray, edge: int | Sequence[int]) -> Box:
    """Return the box, of at most `edge` voxels a side, that holds most of a mask's surface, of all positions."""
    edges = [edge] * 3 if isinstance(edge, int) else edge
    sides = [min(n, side) for n, side in zip(mask.shape, edges, strict=True)]
    values = mask.astype(np.int8)  # each face between structure and background counts at the voxel before it
    z, y, x = (np.abs(np.diff(values, axis=axis, append=0)) for axis in range(3))
    density = (z + y + x).astype(np.float32)
    for axis, side in enumerate(sides):
        density = ndimage.uniform_filter1d(density, side, axis, mode="constant")
    centres = tuple(slice(side // 2, n - (side - 1) // 2) for n, side in zip(mask.shape, sides, strict=True))
    start = (int(k) for k in np.unravel_index(int(density[centres].argmax()), density[centres].shape))
    z, y, x = (slice(k, k + side) for k, side in zip(start, sides, strict=True))
    return z, y, x


def centre_distance(
    mask: np.ndarray,
    spacing: Sequence[float],
    limit: float = math.inf,
    periodic: bool = False,
    dtype: type[np.floating] = np.float32,
) -> np.ndarray:
    """Return the signed distance of each voxel to the border of a mask of any dimension, positive inside.

    It is measured from centre to centre across the border, minus half the finest edge, and clipped to ±`limit`; a mask
    without a border has ±`limit` everywhere. It estimates the distance to the smooth surface behind the mask better
    than `priors.signed_distance`, the exact distance to the voxels' faces. Periodic boxes need a limit.
    """
    if not mask.any() or mask.all():
        return np.full(mask.shape, limit if mask.any() else -limit, dtype)
    if periodic:
        margin = [min(n, math.ceil(limit / h) + 1) for n, h in zip(mask.shape, spacing, strict=True)]
        padded = np.pad(mask, [(m, m) for m in margin], mode="wrap")
        inner = tuple(slice(m, m + n) for m, n in zip(margin, mask.shape, strict=True))
        return centre_distance(padded, spacing, limit, dtype=dtype)[inner]
    half = 0.5 * min(spacing)
    inner = ndimage.distance_transform_edt(mask, sampling=spacing)
    outer = ndimage.distance_transform_edt(~mask, sampling=spacing)
    return np.clip(np.where(mask, inner - half, half - outer), -limit, limit).astype(dtype)  # type: ignore[operator]


def profile_mask(mask: np.ndarray, periodic: bool = False) -> np.ndarray:
    """Return the phase field of a mask (Z, Y, X) whose curvature is measured, float32.

    It is that of `priors.phase_field`, but stairs are smoothed by wider Gaussians, too, one after the other, wherever
    that moves the border by less than `MOVED` voxels: curvature of what is thicker or flatter than the first width asks
    for has half the error, and thin parts stay (Lepski's rule for a bandwidth). The mask is neither empty nor full, and
    continues beyond its box as a mirror image, or repeats.
    """
    if periodic:
        margin = [(min(n, REPEATED),) * 2 for n in mask.shape]
        inner = tuple(slice(low, -high) for low, high in margin)
        return profile_mask(np.pad(mask, margin, mode="wrap"))[inner]
    voxels = Grid(mask.shape, (1.0, 1.0, 1.0), "replicate")  # type: ignore[arg-type]
    reach = 6 * WORKING_EPSILON / WORKING_SPACING + math.ceil(4 * WIDER[-1])
    exact = border_distance(mask, (1.0, 1.0, 1.0), reach, offset=0.5, both=True)
    distance = _smooth_stairs(exact, voxels, STAIRS)
    for width in WIDER:
        move = _smooth_stairs(exact, voxels, width)
        move -= distance
        near = (np.abs(distance) < BAND).astype(np.float32)
        ratio = gaussian_blur(near * move**2, voxels, NEARBY)
        near = gaussian_blur(near, voxels, NEARBY)
        ratio /= np.maximum(near, np.float32(1e-6), out=near)
        ratio /= np.float32(-(MOVED**2))
        distance += np.multiply(np.exp(ratio, out=ratio), move, out=move)
    restore_signs(distance, mask, voxels)
    distance *= np.float32(WORKING_SPACING / (math.sqrt(2) * WORKING_EPSILON))
    return np.tanh(distance, out=distance)


def _smooth_stairs(distance: np.ndarray, voxels: Grid, width: float) -> np.ndarray:
    """Return 2 G - G² of a distance with the blur G: it smooths a mask's stairs and shrinks curves less than G does."""
    blurred = gaussian_blur(distance, voxels, width)
    twice = gaussian_blur(blurred, voxels, width)
    blurred *= 2
    blurred -= twice
    return blurred


def restore_signs(distance: np.ndarray, mask: np.ndarray, voxels: Grid) -> None:
    """Add a Gaussian wherever the sign of a distance is not the mask's, in place, until none is: one by one where few
    voxels are, and by a blur of all where many are, as in a noisy mask."""
    taps = np.array(gaussian_taps(PULL_WIDTH), np.float32)
    kernel = np.pad(taps[:, None, None] * taps[:, None] * taps, ((0, 0), (0, 0), (0, -len(taps) % _LANES)))
    for _ in range(SWEEPS):
        wrong = (distance > 0) != mask
        places = np.flatnonzero(wrong)
        if not len(places):
            break
        if len(places) > FEW * distance.size:
            errors = np.where(wrong, distance, np.float32(0))
            distance -= np.float32(PULL) * gaussian_blur(errors, voxels, PULL_WIDTH)
            continue
        _add_gaussians(distance, places, np.float32(-PULL) * distance.ravel()[places], kernel)


@njit(cache=True, nogil=True)
def _add_gaussians(field, places, heights, kernel):  # pragma: no cover
    """Add at each place, an index of the flat field, so high a kernel, mirrored at the box's faces; the kernel's rows
    end in zeros."""
    (nz, ny, nx), (n, _, length) = field.shape, kernel.shape
    flat, weights, r, lanes = field.ravel(), kernel.ravel(), n // 2, length & -_LANES  # which compilers see
    for place, height in zip(places, heights):  # noqa: B905 - numba knows no `strict`
        z, y, x = place // nx // ny - r, place // nx % ny - r, place % nx - r
        inside = 0 <= z <= nz - n and 0 <= y <= ny - n and 0 <= x <= nx - length
        for i in range(n):
            for j in range(n):
                row = _at((i * n + j) * length)
                if inside:
                    first = _at(((z + i) * ny + y + j) * nx + x)
                    for t in range(lanes):
                        flat[first + _at(t)] += height * weights[row + _at(t)]
                else:
                    first = _at((_mirror(z + i, nz) * ny + _mirror(y + j, ny)) * nx)
                    for t in range(n):
                        flat[first + _at(_mirror(x + t, nx))] += height * weights[row + _at(t)]


@njit(cache=True, inline="always")
def _mirror(k, n):  # pragma: no cover
    """Return the voxel inside 0 … n - 1 whose mirror image is voxel k."""
    while not 0 <= k < n:
        k = -1 - k if k < 0 else 2 * n - 1 - k
    return k


def resample(
    values: np.ndarray,
    scale: Sequence[float],
    start: Sequence[int],
    shape: Sequence[int],
    *,
    periodic: bool = False,
    nearest: bool = False,
    corner: Sequence[int] = (0, 0, 0),
) -> np.ndarray:
    """Resample values (Z, Y, X) to a grid whose voxels are `scale` old voxels long; the first voxels' corners coincide.

    New voxel i covers the old voxels from i·scale to (i + 1)·scale. Interpolation is linear, after a Gaussian of
    (scale - 1)/2 old voxels along axes that become coarser; or takes the `nearest` value, for labels. `start` and
    `shape` are the new voxels that are returned; `corner` is the first old voxel of `values` cut from a volume.
    """
    width = [0.0 if nearest else max(0.0, (s - 1) / 2) for s in scale]
    smooth, first = values, [0, 0, 0]
    if not periodic:  # no more is smoothed than the new voxels depend on
        margin = [math.ceil(4 * w) + 2 for w in width]
        first = [max(c, math.floor(a * s) - m) for a, s, m, c in zip(start, scale, margin, corner, strict=True)]
        stop = [math.ceil((a + n) * s) + m for a, n, s, m in zip(start, shape, scale, margin, strict=True)]
        smooth = values[tuple(slice(a - c, b - c) for a, b, c in zip(first, stop, corner, strict=True))]
    if any(width):
        smooth = ndimage.gaussian_filter(smooth, width, mode="wrap" if periodic else "nearest")
    for axis, (a, n, s, f) in enumerate(zip(start, shape, scale, first, strict=True)):
        # Positions count from the volume's first voxel, not the cut's, so that rounding is the same in every cut.
        positions = (np.arange(a, a + n) + 0.5) * s - 0.5
        smooth = _interpolate(smooth, axis, np.floor(positions + 0.5) if nearest else positions, f, periodic)
    return smooth


def resample_mask(
    mask: np.ndarray,
    spacing: Sequence[float],
    scale: Sequence[float],
    start: Sequence[int],
    shape: Sequence[int],
    *,
    periodic: bool = False,
    corner: Sequence[int] = (0, 0, 0),
) -> np.ndarray:
    """Resample the signed distances to the border of a mask, whose voxels have edges `spacing`: see `resample`."""
    distance = centre_distance(mask, spacing, distance_reach(spacing, scale), periodic)
    return resample(distance, scale, start, shape, periodic=periodic, corner=corner)


def distance_reach(spacing: Sequence[float], scale: Sequence[float]) -> float:
    """Return the limit of the signed distances that resample a mask: four edges of the longest voxel, old or new."""
    return 4 * max(max(s * h, h) for s, h in zip(scale, spacing, strict=True))


def _interpolate(values: np.ndarray, axis: int, positions: np.ndarray, first: int, periodic: bool) -> np.ndarray:
    """Interpolate values linearly at positions along an axis; the first value is at position `first`."""
    n, below = values.shape[axis], np.floor(positions).astype(np.int64)
    weights = (positions - below).reshape([-1 if k == axis else 1 for k in range(3)])
    indices = (below - first, below + 1 - first)
    lower, upper = (values.take(index % n if periodic else np.clip(index, 0, n - 1), axis) for index in indices)
    return lower + (upper - lower) * weights.astype(values.dtype) if weights.any() else lower


def remove_specks(
    mask: np.ndarray, smallest: float, periodic: bool, part: CutOut | None = None
) -> tuple[np.ndarray, int, int]:
    """Drop specks (26-connected) and pinholes (6-connected) under `smallest` voxels; return the mask and both counts.

    Pieces that touch a face of a periodic box, or a face where `part` was cut from a volume, may continue beyond it and
    are kept. In such a part, a piece is counted if its first voxel lies in the core.
    """
    part = part or CutOut(tuple(slice(0, n) for n in mask.shape), ((periodic, periodic),) * 3)  # type: ignore[arg-type]
    specks, speck_count = _small_pieces(mask, smallest, part, np.ones((3, 3, 3), dtype=bool))
    cleaned = mask & ~specks
    pinholes, pinhole_count = _small_pieces(~cleaned, smallest, part, None)
    return cleaned | pinholes, speck_count, pinhole_count


class CutOut(NamedTuple):
    """A part of a volume: its core, and whether it was cut at the low and the high end of each axis."""

    core: Box
    cut: Sequence[tuple[bool, bool]]


def _small_pieces(
    mask: np.ndarray, smallest: float, part: CutOut, structure: np.ndarray | None
) -> tuple[np.ndarray, int]:
    """Return the voxels of pieces of fewer than `smallest` voxels, and how many such pieces belong to the core."""
    labels, count = cast(tuple[np.ndarray, int], ndimage.label(mask, structure))
    sizes = np.zeros(count + 1, dtype=np.int64)
    for plane in labels:  # numpy counts a copy in 64 bits
        sizes += np.bincount(plane.ravel(), minlength=count + 1)
    small = sizes < smallest
    small[0] = False
    for axis, cut_ends in enumerate(part.cut):  # a piece at a cut may be larger than what is visible of it
        for end, cut in zip((0, -1), cut_ends, strict=True):
            if cut:
                small[np.unique(np.take(labels, end, axis=axis))] = False
    pieces = small[labels]
    voxels = np.flatnonzero(pieces)
    first_voxels = voxels[np.unique(labels.ravel()[voxels], return_index=True)[1]]
    in_core = np.ones(len(first_voxels), dtype=bool)
    for index, edge in zip(np.unravel_index(first_voxels, mask.shape), part.core, strict=True):
        in_core &= (index >= edge.start) & (index < edge.stop)
    # Several tiles may read a piece: the one whose core has its first voxel counts it.
    return pieces, int(np.count_nonzero(in_core))


def _middle(interval: slice, longest: int) -> slice:
    """Return the middle of an interval, at most `longest` voxels of it."""
    length = min(longest, interval.stop - interval.start)
    start = interval.start + (interval.stop - interval.start - length) // 2
    return slice(start, start + length)


def _tiles(n: int, size: int) -> list[slice]:
    """Return the fewest intervals of `size` that cover 0..n, evenly spread."""
    length = min(n, size)
    count = math.ceil(n / length)
    starts = [round(i * (n - length) / max(count - 1, 1)) for i in range(count)]
    return [slice(start, start + length) for start in starts]
