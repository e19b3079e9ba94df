"""A small software renderer: the level set of a volume, seen along parallel rays, with its cut faces capped.

The volume is a stack of planes that all rays cross one after another (Lacroute & Levoy 1994): each plane is shifted,
enlarged and compared with the level as a whole array, so that no mesh is needed and the cost does not grow with the
surface. Light is a key light with its soft shadow, and the sky as far as a blurred occupancy leaves it open.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array

from curvafit.core.files import write_content

#: Colour of the level set and of the cut faces, linear in [0, 1].
SURFACE = (0.945, 0.865, 0.715)
CAP = (0.86, 0.64, 0.47)
#: Direction towards the key light in the picture's frame: right, up, towards the eye.
KEY_LIGHT = (-0.42, 0.68, 0.60)
#: Pixels per inch of every picture, and a quiet grey for frames and notes.
DPI = 160
QUIET = "#8A8F98"
#: Width of the box's edges in pixels, pixels to one along an axis as they are drawn, and opacity behind and in front.
_LINE, _FINE, _OPACITY = 4 / 3, 3, (0.4, 0.55)
#: Rays to a pixel, along either axis.
_SUPERSAMPLE = 2
#: Distances, in the shortest voxel edge, over which occupancy is blurred for the light of the sky.
NEAR, FAR = 2.5, 7.0
#: Voxels along an edge above which the light is computed on a coarser grid.
COARSE = 128


class View(NamedTuple):
    """A parallel projection of a box.

    The rows of `frame` are the directions right, up and towards the eye, in (z, y, x). `box` has the lengths of the
    box's edges, and `half` is half the picture's width and height, both in the shortest voxel edge.
    """

    frame: np.ndarray
    box: np.ndarray
    half: tuple[float, float]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return where points `(N, 3)` of the box, (z, y, x) in [0, 1], are on the picture: `(N, 2)`, x and y down."""
        centred = (np.asarray(points) - 0.5) * self.box
        right, up = centred @ self.frame[0], centred @ self.frame[1]
        return np.stack([0.5 + right / (2 * self.half[0]), 0.5 - up / (2 * self.half[1])], axis=-1)


class _Scene(NamedTuple):
    """What is drawn: a field minus its level, as a stack of planes of which the first is nearest to the eye.

    `edges` are the voxel's, in the shortest one; the rows of `frame` are right, up and towards the eye, in these axes.
    """

    field: np.ndarray
    edges: np.ndarray
    frame: np.ndarray

    @property
    def look(self) -> np.ndarray:
        """The direction of sight, in voxels."""
        return -self.frame[2] / self.edges

    @property
    def middle(self) -> np.ndarray:
        """The middle of the box, in voxels."""
        return (np.array(self.field.shape, np.float32) - 1) / 2


class _Rays(NamedTuple):
    """Parallel rays through a stack of planes: ray (i, j) meets plane k at `places[0][i]`, `places[1][j]`, plus k times
    `slopes`, in voxels. Rays are numbered over j, then over i."""

    slopes: np.ndarray
    places: tuple[np.ndarray, np.ndarray]

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rays along i and j."""
        return len(self.places[0]), len(self.places[1])

    def at(self, planes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return the points `(3, N)`, in voxels, at which rays of these numbers meet planes (or places between two)."""
        (slope, other), (rows, columns) = self.slopes, self.places
        i, j = np.divmod(numbers, len(columns))
        return np.stack([planes, rows[i] + planes * slope, columns[j] + planes * other])


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
    height: int | None = None,
    azimuth: float = 32.0,
    elevation: float = 24.0,
) -> tuple[np.ndarray, View]:
    """Return a picture of the level set of `u` `(Z, Y, X)`, and the projection that it shows.

    The picture is RGBA bytes, transparent where there is nothing; it is `width` pixels wide, or less where it would be
    higher than `height`. A volume that has no 3 axes of at least 4 voxels, or is not finite, is a ValueError.
    """
    field = np.asarray(u, dtype=np.float32)
    if field.ndim != 3 or min(field.shape) < 4:
        raise ValueError(f"a volume to draw needs 3 axes of at least 4 voxels, got shape {field.shape}")
    if not np.isfinite(field).all():
        raise ValueError("a volume to draw needs finite values, got NaN or infinity")
    camera = view(field.shape, spacing, azimuth=azimuth, elevation=elevation)
    if height is not None:
        width = max(2, min(width, round(height * camera.half[0] / camera.half[1])))
    height = max(2, round(width * camera.half[1] / camera.half[0]))
    edges = np.array(spacing) / min(spacing)
    order, field = _stack(field - np.float32(level), -camera.frame[2] / edges)
    scene = _Scene(field, edges[order.axes], order.turn(camera.frame))
    size = (width * _SUPERSAMPLE, height * _SUPERSAMPLE)
    lengths = np.linalg.norm(scene.frame[:2, 1:], axis=0) * scene.edges[1:]  # of a voxel's edges in the picture
    rays = _rays(field.shape, scene.look, 2 * camera.half[0] / size[0] / lengths)
    sheet = Image.fromarray(_colours(scene, rays))
    placement = _placement(scene, rays, camera.half, size)
    picture = sheet.transform(size, Image.Transform.AFFINE, placement, Image.Resampling.BILINEAR)
    return np.asarray(picture.reduce(_SUPERSAMPLE)), camera


def _placement(scene: _Scene, rays: _Rays, half: tuple[float, float], size: tuple[int, int]) -> list[float]:
    """Return the affine map from a picture's pixels (x and y down) to those of a sheet of rays (j and i)."""
    # Three pixels determine the map: where their sight lines cross plane 0 is the place of a ray.
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) / size
    right, up = (2 * corners[:, :1] - 1) * half[0], (1 - 2 * corners[:, 1:]) * half[1]
    points = (right * scene.frame[0] + up * scene.frame[1]) / scene.edges + scene.middle
    places = points[:, 1:] - points[:, :1] * rays.slopes
    rows, columns = (
        (place - values[0]) / (values[1] - values[0]) + 0.5 for place, values in zip(places.T, rays.places, strict=True)
    )
    return [c for x in (columns, rows) for c in (x[1] - x[0], x[2] - x[0], x[0])]


# ---- planes and rays -------------------------------------------------------------------------------------------------


class _Order(NamedTuple):
    """The axes of a volume as a stack of planes, that of the planes first, and the sign of each: planes count along the
    rays."""

    axes: list[int]
    signs: np.ndarray

    def turn(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors `(…, 3)` in these axes."""
        return (vectors[..., self.axes] * self.signs).astype(np.float32)


def _stack(values: np.ndarray, direction: np.ndarray) -> tuple[_Order, np.ndarray]:
    """Return a volume as a stack of planes along the axis that is nearest to the rays' `direction`, in voxels."""
    axis = int(np.abs(direction).argmax())
    order = _Order([axis, *(other for other in range(3) if other != axis)], np.array([np.sign(direction[axis]), 1, 1]))
    planes = values.transpose(order.axes)
    return order, planes if direction[axis] > 0 else planes[::-1]


def _rays(shape: tuple[int, ...], direction: np.ndarray, steps: np.ndarray) -> _Rays:
    """Return rays along `direction`, in voxels, that fill a stack of planes at distances of `steps`."""
    slopes = (direction[1:] / direction[0]).astype(np.float32)
    shifts = slopes * (shape[0] - 1)
    first, last = np.minimum(0, -shifts), np.array(shape[1:]) - 1 + np.maximum(0, -shifts)
    rows, columns = (
        np.arange(a, b + step, step, dtype=np.float32) for a, b, step in zip(first, last, steps, strict=True)
    )
    return _Rays(slopes, (rows, columns))


def _resample_planes(
    values: np.ndarray, rays: _Rays, times: int = 1
) -> Iterator[tuple[float, tuple[slice, slice], np.ndarray]]:
    """Yield for each plane of a stack its place, the window of rays that meet it, and its values at those rays.

    With `times` above 1, there are planes between those of the stack too, interpolated. Bilinear interpolation is
    separable: a sparse matrix for the rows, and one for the columns.
    """
    for n in range((len(values) - 1) * times + 1):
        k, part = divmod(n, times)
        plane = values[k] + np.float32(part / times) * (values[k + 1] - values[k]) if part else values[k]
        (window, rows), (other, columns) = (
            _linear_weights(places + slope * (n / times), size)
            for places, slope, size in zip(rays.places, rays.slopes, plane.shape, strict=True)
        )
        yield n / times, (window, other), rows @ (columns @ plane.T).T


def _linear_weights(positions: np.ndarray, n: int) -> tuple[slice, csr_array]:
    """Return the range of ascending positions that lie on n voxels, and the matrix that interpolates voxels there."""
    window = slice(*np.searchsorted(positions, (0, np.nextafter(np.float32(n - 1), np.float32(n)))))
    inside = positions[window]
    below = np.minimum(inside.astype(np.int32), n - 2)
    share = inside - below.astype(np.float32)
    weights, places = (np.stack(pair, axis=1).ravel() for pair in ((1 - share, share), (below, below + 1)))
    return window, csr_array((weights, places, np.arange(0, len(weights) + 1, 2)), shape=(len(inside), n))


def _crossings(rays: _Rays, shape: tuple[int, ...]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each axis of a box the planes at which rays enter and leave it; arrays that broadcast to all rays."""
    start, stop = np.zeros((1, 1), np.float32), np.full((1, 1), shape[0] - 1, np.float32)
    ends: list[tuple[np.ndarray, np.ndarray]] = [(start, stop)]
    for axis, (slope, places) in enumerate(zip(rays.slopes, rays.places, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            both = np.sort([-places / slope, (shape[1 + axis] - 1 - places) / slope], axis=0)
        both = np.where(slope == 0, np.array([[-np.inf], [np.inf]], np.float32), both)
        enter, leave = (np.expand_dims(each, 1 - axis) for each in both)
        ends.append((enter, leave))
    return ends


# ---- surface ---------------------------------------------------------------------------------------------------------


def _colours(scene: _Scene, rays: _Rays) -> np.ndarray:
    """Return the colours that rays see, as RGBA bytes `(I, J, 4)`."""
    crossings = _crossings(rays, scene.field.shape)
    enter, leave = (
        choose(choose(*pair), last).ravel()
        for choose, (*pair, last) in zip((np.maximum, np.minimum), zip(*crossings, strict=True), strict=True)
    )
    depth = _first_crossings(scene.field, rays, enter, leave, max(1, round(1 / abs(float(scene.look[0])))))
    numbers = np.flatnonzero(np.isfinite(depth))
    planes = depth[numbers]
    capped = planes == enter[numbers]
    at = rays.at(planes, numbers)
    light = (np.array(KEY_LIGHT) / np.linalg.norm(KEY_LIGHT) @ scene.frame).astype(np.float32)
    glow = np.empty(len(numbers), np.float32)
    glow[~capped] = _surface_glow(scene, light, at[:, ~capped])
    sides = np.stack([np.broadcast_to(first, rays.shape).ravel()[numbers[capped]] for first, _ in crossings])
    faces = -np.sign(scene.look) * np.eye(3)
    glow[capped] = _glow(faces @ scene.frame[2], np.maximum(faces @ light, 0), 1.0)[sides.argmax(axis=0)]
    reach = float(np.linalg.norm(scene.middle * scene.edges))
    nearness = (scene.frame[2] * scene.edges).astype(np.float32) @ (at - scene.middle[:, None])
    depth_share = np.clip(0.5 - nearness / (2 * reach), 0, 1)
    haze = 0.30 * depth_share * np.sqrt(depth_share)
    bright = np.clip(glow, 0, 1.1) ** np.float32(0.9)
    sheet = np.zeros((len(depth), 4), np.uint8)
    for channel, (surface, cap) in enumerate(zip(SURFACE, CAP, strict=True)):
        colour = np.where(capped, np.float32(cap**0.9), np.float32(surface**0.9))
        sheet[numbers, channel] = 255 * (np.minimum(colour * bright, 1) * (1 - haze) + 0.93 * haze) + 0.5
    sheet[numbers, 3] = 255
    return sheet.reshape(*rays.shape, 4)


def _glow(eye: np.ndarray, lit: np.ndarray, sky: np.ndarray | float) -> np.ndarray:
    """Return the light from a surface: the sky's, more where the surface faces the eye, and the key light's."""
    return 1.12 * ((0.50 + 0.14 * eye) * sky + 0.52 * lit * (0.55 + 0.45 * sky))


def _first_crossings(field: np.ndarray, rays: _Rays, enter: np.ndarray, leave: np.ndarray, times: int) -> np.ndarray:
    """Return the planes, in fractions of a plane, at which rays meet the phase; inf where they miss it."""
    waiting, last = enter <= leave, np.full(enter.shape, -1, np.float32)
    depth = np.full(enter.shape, np.inf, np.float32)

    def meet(numbers: np.ndarray, place: np.ndarray | float, now: np.ndarray) -> None:
        """Note where rays cross the level: linearly between the plane before, or the box's side, and this place."""
        start = np.maximum(enter[numbers], np.ceil(np.float32(place) * times - 1e-3) / times - 1 / times)
        past = last[numbers]
        depth[numbers] = start + (place - start) * past / (past - now)
        waiting[numbers] = False

    def look(numbers: np.ndarray, places: np.ndarray) -> None:
        """Note the rays that are inside at places of their own: where they enter or leave the box."""
        now = map_coordinates(field, rays.at(places, numbers), np.float32, 1, "nearest")
        inside = now > 0
        meet(numbers[inside], places[inside], now[inside])
        last[numbers] = now

    sides = np.flatnonzero(waiting & (enter > 0))
    look(sides, enter[sides])
    free, before = waiting.reshape(rays.shape), last.reshape(rays.shape)
    for place, window, values in _resample_planes(field, rays, times):
        hits = np.flatnonzero((values > 0) & free[window])
        i, j = np.divmod(hits, values.shape[1])
        meet((i + window[0].start) * rays.shape[1] + j + window[1].start, place, values.ravel()[hits])
        before[window] = values
    ends = np.flatnonzero(waiting & (leave < len(field) - 1))
    look(ends, leave[ends])
    return depth


# ---- light -----------------------------------------------------------------------------------------------------------


def _surface_glow(scene: _Scene, light: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the light from the level set at points `(3, N)`, interpolated between the voxels around them."""
    field, edges = scene.field, scene.edges[:, None]
    # Light is computed at the voxels around the points, then interpolated.
    at = np.clip(at, 0, np.array(field.shape)[:, None] - 1)
    near = np.zeros(field.shape, np.bool_)
    near[tuple(at.astype(np.int32))] = True
    for axis in range(3):
        after = np.moveaxis(near, axis, 0)
        after[1:] |= after[:-1]
    voxels = np.stack(np.nonzero(near))
    smooth = gaussian_filter(field, 0.9 / scene.edges, truncate=3)
    normal = np.stack([_differences(smooth, voxels, axis) for axis in range(3)]) / (2 * edges)
    slope = np.maximum(np.linalg.norm(normal, axis=0), 1e-12)
    normal /= slope
    # A step of Newton's method takes each voxel onto the level set.
    points = voxels + np.clip(field[tuple(voxels)] / slope, -1, 1) * normal / edges
    times = -(-max(field.shape) // COARSE)
    grey, inside = (_block_means(values, times) for values in (field, field > 0))

    def coarse(points: np.ndarray) -> np.ndarray:
        return (points - (times - 1) / 2) / times

    close, wide = (
        map_coordinates(
            gaussian_filter(inside, distance / times / scene.edges, mode="constant"),
            coarse(points + distance * normal / edges),
            order=1,
            mode="nearest",
        )
        for distance in (NEAR, FAR)
    )
    # The more of the phase there is in front of a point, near and far, the less of the sky it sees.
    sky = (1 - np.clip((close - 0.12) * 1.5, 0, 0.7)) * (1 - np.clip((wide - 0.05) * 1.3, 0, 0.6))
    before = coarse(points + (1.5 * normal + 2.0 * light[:, None]) / edges)
    lit = np.maximum(light @ normal, 0) * (1 - 0.6 * _shadow(grey, light / scene.edges, before))
    glow = np.zeros(field.shape, np.float32)
    glow[near] = _glow(scene.frame[2] @ normal, lit, sky)
    return map_coordinates(glow, at, np.float32, 1, "nearest")


def _differences(values: np.ndarray, voxels: np.ndarray, axis: int) -> np.ndarray:
    """Return the differences, along an axis, of the values before and behind voxels `(3, N)`."""
    (before, behind), end = voxels[None].repeat(2, axis=0), values.shape[axis] - 1
    before[axis], behind[axis] = np.maximum(before[axis] - 1, 0), np.minimum(behind[axis] + 1, end)
    return values[tuple(before)] - values[tuple(behind)]


def _block_means(values: np.ndarray, times: int) -> np.ndarray:
    """Return the means over blocks of `times`³ voxels; those at the end repeat the last voxel."""
    if times == 1:
        return values.astype(np.float32, copy=False)
    rest = [-n % times for n in values.shape]
    whole = np.pad(values, [(0, n) for n in rest], mode="edge") if any(rest) else values
    Z, Y, X = (n // times for n in whole.shape)
    return whole.reshape(Z, times, Y, times, X, times).mean(axis=(1, 3, 5), dtype=np.float32)


def _shadow(field: np.ndarray, light: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the share of the key light that does not reach points `(3, N)`: 1 behind the phase, less near it."""
    order, planes = _stack(field, -light)
    rays = _rays(planes.shape, order.turn(-light), np.ones(2))
    highest = np.full((len(planes) + 2, *rays.shape), -1, np.float32)
    for place, window, values in _resample_planes(planes, rays):
        highest[int(place) + 2][window] = values
    np.maximum.accumulate(highest, axis=0, out=highest)
    k, *others = points[order.axes]
    k = k if order.signs[0] > 0 else len(planes) - 1 - k
    places = [
        other - k * slope - values[0] for other, slope, values in zip(others, rays.slopes, rays.places, strict=True)
    ]
    level = map_coordinates(highest, np.stack([k + 1, *places]), np.float32, 1, "nearest")
    share = np.clip(1 + level / 0.6, 0, 1)
    return share * share * (3 - 2 * share)


# ---- a surface in its box --------------------------------------------------------------------------------------------


def surface_picture(u: np.ndarray, path: str | Path, *, width: int = 900, **options) -> Path:
    """Write a square picture, `width` pixels wide, of the surface of `u` `(Z, Y, X)`; options are `render_in_box`'s."""
    picture = Image.fromarray(render_in_box(u, width=width, height=width, **options))
    sheet = Image.new("RGB", (width, width), "white")
    sheet.paste(picture, ((width - picture.width) // 2, (width - picture.height) // 2), picture)
    buffer = io.BytesIO()
    sheet.save(buffer, format="png", dpi=(DPI, DPI), compress_level=3)
    return write_content(Path(path), buffer.getvalue())


def render_in_box(u: np.ndarray, *, level: float = 0.0, **options) -> np.ndarray:
    """Return the level set of a field (or the outline of a bool mask) in its box, cut faces capped.

    The picture is RGBA bytes, transparent where there is nothing; `options` are those of `render`.
    """
    values = np.asarray(u)
    if values.dtype == np.bool_:
        values, level = gaussian_filter(values.astype(np.float32), 0.7), level + 0.5
    surface, camera = render(values, level=level, **options)
    size = (surface.shape[1], surface.shape[0])
    layers = (_edges(camera, size, front=False), Image.fromarray(surface), _edges(camera, size, front=True))
    sheet = Image.new("RGBA", size)
    for layer in layers:
        sheet.alpha_composite(layer)
    return np.asarray(sheet)


def _edges(camera: View, size: tuple[int, int], *, front: bool) -> Image.Image:
    """Return a picture of the box's edges: of the nine in front of the shape, or of the three behind it."""
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    hidden = (corners == (camera.frame[2] < 0)).all(axis=1).argmax()
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
    places = camera.project(corners) * np.array(size) * _FINE
    fine = Image.new("L", (size[0] * _FINE, size[1] * _FINE))
    pen = ImageDraw.Draw(fine)
    for a, b in pairs:
        if (hidden in (a, b)) != front:
            pen.line([*places[a], *places[b]], fill=round(255 * _OPACITY[front]), width=round(_LINE * _FINE))
    layer = Image.new("RGBA", size, QUIET)
    layer.putalpha(fine.reduce(_FINE))
    return layer
