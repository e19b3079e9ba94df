"""A small software renderer: the level set of a volume, seen along parallel rays, with its cut faces capped.

Rays march through the trilinear field, so that no mesh is needed and the cost does not grow with the surface. Light is
a key light with its soft shadow, and the sky as far as a blurred occupancy leaves it open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

from curvafit.priors.kernels import threads

#: Colour of the level set and of the cut faces, linear in [0, 1].
SURFACE = (0.945, 0.865, 0.715)
CAP = (0.86, 0.64, 0.47)
#: Direction towards the key light in the picture's frame: right, up, towards the eye.
KEY_LIGHT = (-0.42, 0.68, 0.60)
#: Edge of the blocks that a ray may jump over when nothing is in them, in voxels.
BLOCK = 8
#: What a ray that meets nothing reports.
MISS = 1e9


class View(NamedTuple):
    """A parallel projection: rows `right`, `up`, `towards` (the eye) in (z, y, x), the box (lengths of its edges in
    the shortest voxel edge), and half the picture's width and height in that unit."""

    frame: np.ndarray
    box: np.ndarray
    half: tuple[float, float]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return where points `(N, 3)` of the box, (z, y, x) in [0, 1], lie on the picture: `(N, 2)`, x and y down."""
        centred = (np.asarray(points) - 0.5) * self.box
        right, up = centred @ self.frame[0], centred @ self.frame[1]
        return np.stack([0.5 + right / (2 * self.half[0]), 0.5 - up / (2 * self.half[1])], axis=-1)


class _Scene(NamedTuple):
    """What the loops draw: the field `(Z, Y, X)` less its level; the same smoothed, for normals; how much lies near and
    farther off; which blocks are not empty; voxel edges over the shortest; the last voxel's index."""

    field: np.ndarray
    smooth: np.ndarray
    near: np.ndarray
    far: np.ndarray
    occupied: np.ndarray
    edges: np.ndarray
    top: np.ndarray


def view(
    shape: tuple[int, int, int],
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    azimuth: float = 32.0,
    elevation: float = 24.0,
) -> View:
    """Return the projection that shows a whole box, z up: turned by `azimuth`, seen from `elevation` degrees above."""
    α, β = math.radians(azimuth), math.radians(elevation)
    right = np.array([0.0, math.sin(α), math.cos(α)])
    towards = np.array([math.sin(β), -math.cos(α) * math.cos(β), math.sin(α) * math.cos(β)])
    up = np.array([math.cos(β), math.cos(α) * math.sin(β), -math.sin(α) * math.sin(β)])
    box = (np.array(shape) - 1) * np.array(spacing) / min(spacing)
    frame = np.stack([right, up, towards])
    half = (np.abs(frame[:2]) * box).sum(axis=1) / 2 * 1.02
    return View(frame, box, (float(half[0]), float(half[1])))


def render(
    u: np.ndarray,
    *,
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    level: float = 0.0,
    width: int = 720,
    supersample: int = 2,
    azimuth: float = 32.0,
    elevation: float = 24.0,
) -> tuple[np.ndarray, View]:
    """Return the level set of `u` `(Z, Y, X)` as a picture, and the projection that it was drawn by.

    The picture is RGBA, `(height, width, 4)` bytes, transparent where there is nothing.

    Raises
    ------
    ValueError
        If the volume is not three-dimensional, has an axis under 4 voxels, or is not finite.
    """
    field = np.ascontiguousarray(u, dtype=np.float32)
    if field.ndim != 3 or min(field.shape) < 4:
        raise ValueError(f"expected a volume of 3 axes of at least 4 voxels to draw, got shape {field.shape}")
    if not np.isfinite(field).all():
        raise ValueError("expected a finite volume to draw, got NaN or infinite values")
    camera = view(field.shape, spacing, azimuth=azimuth, elevation=elevation)
    height = max(2, round(width * camera.half[1] / camera.half[0]))
    size = (height * supersample, width * supersample)
    field = field - np.float32(level)
    edges = np.array(spacing) / min(spacing)
    smooth = gaussian_filter(field, 0.9 / edges)
    inside = (field > 0).astype(np.float32)
    near, far = (gaussian_filter(inside, distance / edges, mode="constant") for distance in (2.5, 7.0))
    scene = _Scene(field, smooth, near, far, _blocks(field), edges, np.array(field.shape) - 1.0)
    light = np.array(KEY_LIGHT) / np.linalg.norm(KEY_LIGHT) @ camera.frame
    colours = np.array(SURFACE), np.array(CAP)
    pixels = np.zeros((*size, 4), dtype=np.float32)
    threads.start()
    _draw(pixels, scene, camera.frame, np.array(camera.half), light, *colours)
    return _reduced(pixels, supersample), camera


def _blocks(field: np.ndarray) -> np.ndarray:
    """Return whether any voxel of a block of `BLOCK`³, or of the layer around it, is inside."""
    count = [-(-n // BLOCK) for n in field.shape]
    occupied = np.zeros(count, dtype=np.bool_)
    for index in np.ndindex(*count):
        cut = tuple(slice(max(0, i * BLOCK - 1), (i + 1) * BLOCK + 1) for i in index)
        occupied[index] = field[cut].max() > 0
    return occupied


def _reduced(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Return means over factor² samples (colour weighted by cover), encoded as bytes."""
    height, width = pixels.shape[0] // factor, pixels.shape[1] // factor
    cover = pixels[..., 3:]
    weighted = np.concatenate([pixels[..., :3] * cover, cover], axis=-1)
    total = weighted.reshape(height, factor, width, factor, 4).sum(axis=(1, 3))
    colour = total[..., :3] / np.maximum(total[..., 3:], 1e-6)
    alpha = total[..., 3:] / factor**2
    return np.rint(255 * np.concatenate([np.clip(colour, 0, 1), alpha], axis=-1)).astype(np.uint8)


@numba.njit(cache=True, nogil=True, parallel=True)
def _draw(pixels, scene, frame, half, light, surface, cap):
    """Send one ray a pixel: find the surface or the cut face, then light it."""
    f, smooth, occupied, edges, top = scene.field, scene.smooth, scene.occupied, scene.edges, scene.top
    height, width = pixels.shape[:2]
    reach = math.sqrt(((top * edges) ** 2).sum()) / 2
    for row in numba.prange(height):
        o, d, n, q, s = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
        up = (1 - 2 * (row + 0.5) / height) * half[1]
        for column in range(width):
            right = (2 * (column + 0.5) / width - 1) * half[0]
            for a in range(3):
                o[a] = (right * frame[0, a] + up * frame[1, a]) / edges[a] + top[a] / 2
                d[a] = -frame[2, a] / edges[a]
            t, stop, axis = _span(o, d, top)
            if t >= stop:
                continue
            capped = _at(f, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]) > 0
            if not capped:
                t = _march(f, occupied, o, d, t, stop)
                if t == MISS:
                    continue
            for a in range(3):
                o[a] += t * d[a]
                n[a] = 0.0
            n[axis] = -1.0 if d[axis] > 0 else 1.0
            if not capped:
                _normal(smooth, edges, o, n)
            sky = 1.0 if capped else _sky(scene, o, n)
            lit = _lit(scene, o, n, light, q, s)
            eye = n[0] * frame[2, 0] + n[1] * frame[2, 1] + n[2] * frame[2, 2]
            glow = 1.12 * ((0.50 + 0.14 * eye) * sky + 0.52 * lit * (0.55 + 0.45 * sky))
            haze = 0.30 * min(max(0.5 + t / (2 * reach), 0.0), 1.0) ** 1.5
            for a in range(3):
                colour = (cap[a] if capped else surface[a]) * min(max(glow, 0.0), 1.1)
                pixels[row, column, a] = min(colour, 1.0) ** 0.9 * (1 - haze) + 0.93 * haze
            pixels[row, column, 3] = 1.0


@numba.njit(cache=True, nogil=True)
def _normal(smooth, edges, p, n):
    """Write the unit normal out of the phase at `p` into `n`."""
    n[0] = (_at(smooth, p[0] - 1, p[1], p[2]) - _at(smooth, p[0] + 1, p[1], p[2])) / edges[0]
    n[1] = (_at(smooth, p[0], p[1] - 1, p[2]) - _at(smooth, p[0], p[1] + 1, p[2])) / edges[1]
    n[2] = (_at(smooth, p[0], p[1], p[2] - 1) - _at(smooth, p[0], p[1], p[2] + 1)) / edges[2]
    length = max(math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2), 1e-12)
    for a in range(3):
        n[a] /= length


@numba.njit(cache=True, nogil=True)
def _sky(scene, p, n):
    """Return the share of the sky that is open above `p`, judged from occupancies blurred by 2.5 and by 7 edges."""
    near, far, edges = scene.near, scene.far, scene.edges
    a, b, c = n[0] / edges[0], n[1] / edges[1], n[2] / edges[2]
    close = _at(near, p[0] + 2.5 * a, p[1] + 2.5 * b, p[2] + 2.5 * c)
    wide = _at(far, p[0] + 7.0 * a, p[1] + 7.0 * b, p[2] + 7.0 * c)
    return (1 - min(max((close - 0.12) * 1.5, 0.0), 0.7)) * (1 - min(max((wide - 0.05) * 1.3, 0.0), 0.6))


@numba.njit(cache=True, nogil=True)
def _lit(scene, p, n, light, q, d):
    """Return what the key light gives at `p`: its cosine, less in shadow. `q` and `d` are scratch."""
    edges = scene.edges
    facing = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
    if facing <= 0:
        return 0.0
    for a in range(3):
        q[a] = p[a] + 1.5 * n[a] / edges[a]
        d[a] = light[a] / edges[a]
    begin, end, _ = _span(q, d, scene.top)
    if end < 2 or begin > end:
        return facing
    return facing * (1 - 0.6 * _shadow(scene.field, scene.occupied, q, d, 2.0, end))


@numba.njit(cache=True, nogil=True)
def _march(f, occupied, o, d, start, stop):
    """Return the least t in [start, stop] where the ray o + t d (in voxels) enters the phase, or `MISS`."""
    t, last = start, start
    while t <= stop:
        z, y, x = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        jump = _jump(occupied, z, y, x, d)
        value = -1.0 if jump > 0 else _at(f, z, y, x)
        if value > 0:
            for _ in range(8):
                middle = 0.5 * (last + t)
                if _at(f, o[0] + middle * d[0], o[1] + middle * d[1], o[2] + middle * d[2]) > 0:
                    t = middle
                else:
                    last = middle
            return t
        last = t
        t += jump if jump > 0 else (0.6 if value < -0.6 else 0.12)
    return MISS


@numba.njit(cache=True, nogil=True)
def _shadow(f, occupied, o, d, start, stop):
    """Return the share of the key light that does not reach o: 1 where the ray meets the phase, less near it."""
    t, highest = start, -1.0
    while t <= stop and highest < 0:
        z, y, x = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        jump = _jump(occupied, z, y, x, d)
        if jump == 0:
            highest = max(highest, _at(f, z, y, x))
        t += jump if jump > 0 else 0.7
    share = min(max(1 + highest / 0.6, 0.0), 1.0)
    return share * share * (3 - 2 * share)


@numba.njit(cache=True, nogil=True)
def _jump(occupied, z, y, x, d):
    """Return how far a ray may go before it leaves an empty block; 0 in an occupied one."""
    i = min(max(int(z) // BLOCK, 0), occupied.shape[0] - 1)
    j = min(max(int(y) // BLOCK, 0), occupied.shape[1] - 1)
    k = min(max(int(x) // BLOCK, 0), occupied.shape[2] - 1)
    if occupied[i, j, k]:
        return 0.0
    return max(min(_leave(z, d[0], i), _leave(y, d[1], j), _leave(x, d[2], k)), 0.0) + 0.05


@numba.njit(cache=True, nogil=True)
def _leave(position, direction, block):
    """Return how far a ray goes before it leaves a block along one axis."""
    if abs(direction) < 1e-9:
        return MISS
    return ((block + (direction > 0)) * BLOCK - position) / direction


@numba.njit(cache=True, nogil=True)
def _span(position, direction, top):
    """Return where a line enters and leaves the box [0, top], and the axis along which it enters."""
    start, stop, axis = -1e9, 1e9, 0
    for a in range(3):
        if abs(direction[a]) < 1e-9:
            if position[a] < 0 or position[a] > top[a]:
                return 1.0, -1.0, 0
            continue
        first, second = -position[a] / direction[a], (top[a] - position[a]) / direction[a]
        if first > second:
            first, second = second, first
        if first > start:
            start, axis = first, a
        stop = min(stop, second)
    return start, stop, axis


@numba.njit(cache=True, nogil=True)
def _at(f, z, y, x):
    """Interpolate linearly along each axis, clamped to the box."""
    nz, ny, nx = f.shape
    z, y, x = min(max(z, 0.0), nz - 1.0), min(max(y, 0.0), ny - 1.0), min(max(x, 0.0), nx - 1.0)
    i, j, k = min(int(z), nz - 2), min(int(y), ny - 2), min(int(x), nx - 2)
    c, b, a = z - i, y - j, x - k
    low = (1 - b) * ((1 - a) * f[i, j, k] + a * f[i, j, k + 1])
    low += b * ((1 - a) * f[i, j + 1, k] + a * f[i, j + 1, k + 1])
    high = (1 - b) * ((1 - a) * f[i + 1, j, k] + a * f[i + 1, j, k + 1])
    high += b * ((1 - a) * f[i + 1, j + 1, k] + a * f[i + 1, j + 1, k + 1])
    return low * (1 - c) + high * c
