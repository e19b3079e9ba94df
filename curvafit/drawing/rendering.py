"""A small software renderer: the level set of a volume, seen along parallel rays, with its cut faces capped.

The surface is a mesh that is drawn into a depth buffer. Light is a key light with its soft shadow, from a depth buffer
as the light sees the mesh, and the sky as far as a blurred occupancy leaves it open.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.measure import block_reduce, marching_cubes

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
#: Points to a pixel, along either axis.
_SUPERSAMPLE = 2
#: Distances, in the shortest voxel edge, over which occupancy is blurred for the light of the sky.
NEAR, FAR = 2.5, 7.0
#: Voxels along an edge above which occupancy is blurred on a coarser grid.
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
    width: int = 720,
    height: int | None = None,
    azimuth: float = 32.0,
    elevation: float = 24.0,
) -> tuple[np.ndarray, View]:
    """Return a picture of the zero level of `u` `(Z, Y, X)`, and the projection that it shows.

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
    size = (width * _SUPERSAMPLE, height * _SUPERSAMPLE)
    picture = Image.fromarray(_colours(field, camera, size))
    return np.asarray(picture.reduce(_SUPERSAMPLE)), camera


def _colours(field: np.ndarray, camera: View, size: tuple[int, int]) -> np.ndarray:
    """Return the colours of {field > 0} at a picture's points, as RGBA bytes `(rows, columns, 4)`."""
    sheet = np.zeros((*size[::-1], 4), np.uint8)
    if not field.max() > 0:
        return sheet
    last = np.array(field.shape) - 1
    vertices, faces = _mesh(field)
    points = camera.project(vertices / last) * size - 0.5
    nearness = (vertices / last - 0.5) * camera.box @ camera.frame[2]
    front, weights = _draw(np.column_stack([points[:, ::-1], nearness]), faces, size[::-1])
    drawn = front >= 0
    number, weights = front[drawn], weights[drawn]
    corners = faces[number]
    seen = np.zeros(len(vertices), bool)
    seen[corners] = True
    glow = np.zeros(len(vertices), np.float32)
    glow[seen] = _surface_glow(field, camera, vertices, faces, vertices[seen])
    glow = np.einsum("pk,pk->p", glow[corners], weights)
    # Corners on one side of the box make a cap, whose normal is that of the side.
    sides = ((vertices == 0) | (vertices == last))[faces].all(axis=1)
    capped = sides.any(axis=1)[number]
    eye, light = np.abs(camera.frame[2]), np.sign(camera.frame[2]) * _light(camera)
    glow[capped] = _glow(eye, np.maximum(light, 0), 1.0)[sides.argmax(axis=1)[number[capped]]]
    depth = np.clip(0.5 - np.einsum("pk,pk->p", nearness[corners], weights) / np.linalg.norm(camera.box), 0, 1)
    haze, bright = 0.30 * depth**1.5, np.clip(glow, 0, 1.1) ** 0.9
    for channel, (surface, cap) in enumerate(zip(SURFACE, CAP, strict=True)):
        colour = np.where(capped, cap, surface) ** 0.9
        sheet[drawn, channel] = 255 * (np.minimum(colour * bright, 1) * (1 - haze) + 0.93 * haze) + 0.5
    sheet[drawn, 3] = 255
    return sheet


def _mesh(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices `(V, 3)`, in voxels, and faces of the boundary of {field > 0}, with caps on the box's sides."""
    outside = -1e3 * np.abs(field).max()  # so low that caps lie at the outermost voxels' centres
    vertices, faces, _, _ = marching_cubes(np.pad(field, 1, constant_values=outside), 0.0)
    return np.clip(vertices - 1.0, 0, np.array(field.shape) - 1), faces


def _draw(points: np.ndarray, faces: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest face, -1 for none, and the weights of its corners at each pixel, of points (row, column,
    nearness) `(V, 3)`."""
    front, weights = np.full(shape, -1), np.zeros((*shape, 3), np.float32)
    _fill_depth(points, faces, front, np.full(shape, -np.inf), weights)
    return front, weights


@njit(cache=True)
def _fill_depth(points, faces, front, depth, weights):  # pragma: no cover
    """Draw faces into buffers. It makes no array: Ctrl-C while compiled code returns one ends the process."""
    for face in range(len(faces)):
        a, b, c = points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        for i in range(max(0, math.ceil(low[0])), min(len(depth) - 1, math.floor(high[0])) + 1):
            for j in range(max(0, math.ceil(low[1])), min(depth.shape[1] - 1, math.floor(high[1])) + 1):
                of_b = ((i - a[0]) * (c[1] - a[1]) - (j - a[1]) * (c[0] - a[0])) / area
                of_c = ((b[0] - a[0]) * (j - a[1]) - (b[1] - a[1]) * (i - a[0])) / area
                of_a = 1 - of_b - of_c
                near = of_a * a[2] + of_b * b[2] + of_c * c[2]
                if min(of_a, of_b, of_c) > -1e-6 and near > depth[i, j]:
                    front[i, j], depth[i, j] = face, near
                    weights[i, j, 0], weights[i, j, 1], weights[i, j, 2] = of_a, of_b, of_c


# ---- light -----------------------------------------------------------------------------------------------------------


def _light(camera: View) -> np.ndarray:
    """Return the direction towards the key light, (z, y, x)."""
    return np.array(KEY_LIGHT) / np.linalg.norm(KEY_LIGHT) @ camera.frame


def _glow(eye: np.ndarray, lit: np.ndarray, sky: np.ndarray | float) -> np.ndarray:
    """Return the light from a surface: the sky's, more where the surface faces the eye, and the key light's."""
    return 1.12 * ((0.50 + 0.14 * eye) * sky + 0.52 * lit * (0.55 + 0.45 * sky))


def _surface_glow(
    field: np.ndarray, camera: View, vertices: np.ndarray, faces: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Return the light from the level set at points `(N, 3)` of a mesh, in voxels."""
    edges, light = camera.box / (np.array(field.shape) - 1), _light(camera)
    smooth = gaussian_filter(field, 0.9 / edges, truncate=3)
    slopes = [map_coordinates(part, at.T, order=1, mode="nearest") for part in np.gradient(smooth, *edges)]
    normal = -np.stack(slopes, axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    times = -(-max(field.shape) // COARSE)
    inside = block_reduce((field > 0).astype(np.float32), times, np.mean)

    def occupy(distance: float) -> np.ndarray:
        blurred = gaussian_filter(inside, distance / times / edges, mode="constant")
        places = (at + distance * normal / edges - (times - 1) / 2) / times
        return map_coordinates(blurred, places.T, order=1, mode="nearest")

    close, wide = occupy(NEAR), occupy(FAR)
    # The more of the phase there is in front of a point, near and far, the less of the sky it sees.
    sky = (1 - np.clip((close - 0.12) * 1.5, 0, 0.7)) * (1 - np.clip((wide - 0.05) * 1.3, 0, 0.6))
    shadow = _shadow(vertices * edges, faces, light, at * edges + 1.5 * normal + 2.0 * light)
    return _glow(normal @ camera.frame[2], np.maximum(normal @ light, 0) * (1 - 0.6 * shadow), sky)


def _shadow(vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the share of the key light that a mesh keeps from points `(N, 3)`: a mean over 3 × 3 edges of a voxel."""
    across = np.linalg.svd(light[None])[2][1:]
    frame = np.stack([*across, light])
    points, places = vertices @ frame.T, at @ frame.T
    corner = points[:, :2].min(0) - 2
    points[:, :2] -= corner
    shape = tuple(int(n) + 3 for n in points[:, :2].max(0))
    front, weights = _draw(points, faces, shape)
    nearest = np.where(front < 0, -np.inf, np.einsum("ijk,ijk->ij", points[faces[front], 2], weights))
    low, part = np.divmod(places[:, :2].T - corner[:, None], 1)
    rows, columns = (
        np.clip(k + np.arange(-1, 3)[:, None], 0, n - 1).astype(int) for k, n in zip(low, shape, strict=True)
    )
    shares = [np.stack([1 - f, np.ones_like(f), np.ones_like(f), f]) / 3 for f in part]
    return np.einsum("in,jn,ijn->n", *shares, nearest[rows[:, None], columns] > places[:, 2])


# ---- a surface in its box --------------------------------------------------------------------------------------------


def surface_picture(u: np.ndarray, path: str | Path, *, width: int = 900, **options) -> Path:
    """Write a square picture, `width` pixels wide, of the surface of `u` `(Z, Y, X)`; options are `render_in_box`'s."""
    picture = Image.fromarray(render_in_box(u, width=width, height=width, **options))
    sheet = Image.new("RGB", (width, width), "white")
    sheet.paste(picture, ((width - picture.width) // 2, (width - picture.height) // 2), picture)
    buffer = io.BytesIO()
    sheet.save(buffer, format="png", dpi=(DPI, DPI), compress_level=3)
    return write_content(Path(path), buffer.getvalue())


def render_in_box(u: np.ndarray, **options) -> np.ndarray:
    """Return the level set of a field (or the outline of a bool mask) in its box, cut faces capped.

    The picture is RGBA bytes, transparent where there is nothing; `options` are those of `render`.
    """
    values = np.asarray(u)
    if values.dtype == np.bool_:
        values = gaussian_filter(values.astype(np.float32), 0.7) - np.float32(0.5)
    surface, camera = render(values, **options)
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
