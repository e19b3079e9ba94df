"""A small software renderer: the level set of a volume, seen along parallel rays, with its cut faces capped.

The surface is a mesh that is drawn into a depth buffer. Light is a key light with its soft shadow, from a depth buffer
as the light sees the mesh, and the sky as far as a blurred occupancy leaves it open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.measure import block_reduce, marching_cubes

#: Colour of the level set and of the cut faces, linear in [0, 1].
SURFACE = (0.945, 0.865, 0.715)
CAP = (0.86, 0.64, 0.47)
#: Direction towards the key light in the picture's frame: right, up, towards the eye.
KEY_LIGHT = (-0.42, 0.68, 0.60)
#: Pixels per inch of every picture, and a quiet grey for frames and notes.
DPI = 160
QUIET = "#8A8F98"
#: The box's edges: width in pixels, points to a pixel along either axis, and opacity behind and in front of the shape.
_EDGE_WIDTH, _EDGE_SUPERSAMPLE, _EDGE_OPACITY = 4 / 3, 3, (0.4, 0.55)
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
    azimuth: float = 32.0,
    elevation: float = 24.0,
) -> tuple[np.ndarray, View]:
    """Return a picture of the zero level of `u` `(Z, Y, X)`, and the projection that it shows.

    The picture is RGBA bytes, transparent where there is nothing, and `width` pixels wide. A volume that has
    no 3 axes of at least 4 voxels, or is not finite, is a ValueError.
    """
    field = np.asarray(u, dtype=np.float32)
    if field.ndim != 3 or min(field.shape) < 4:
        raise ValueError(f"a volume to draw needs 3 axes of at least 4 voxels, got shape {field.shape}")
    if not np.isfinite(field).all():
        raise ValueError("a volume to draw needs finite values, got NaN or infinity")
    camera = view(field.shape, spacing, azimuth=azimuth, elevation=elevation)
    height = max(2, round(width * camera.half[1] / camera.half[0]))
    size = (width * _SUPERSAMPLE, height * _SUPERSAMPLE)
    picture = Image.fromarray(_colours(field, camera, size))
    return np.asarray(picture.reduce(_SUPERSAMPLE)), camera


def _colours(field: np.ndarray, camera: View, size: tuple[int, int]) -> np.ndarray:
    """Return the colours of {field > 0} at a picture's points, as RGBA bytes `(rows, columns, 4)`."""
    picture = np.zeros((*size[::-1], 4), np.uint8)
    if not field.max() > 0:
        return picture
    extent = np.array(field.shape) - 1
    vertices, faces = _mesh(field)
    pixels = camera.project(vertices / extent) * size - 0.5
    nearness = (vertices / extent - 0.5) * camera.box @ camera.frame[2]
    nearest, weights = _rasterise(np.column_stack([pixels[:, ::-1], nearness]), faces, size[::-1])
    covered = nearest >= 0
    face, weights = nearest[covered], weights[covered]
    corners = faces[face]
    visible = np.zeros(len(vertices), bool)
    visible[corners] = True
    at_vertices = np.zeros(len(vertices), np.float32)
    at_vertices[visible] = _surface_brightness(field, camera, vertices, faces, vertices[visible])
    brightness = np.einsum("pk,pk->p", at_vertices[corners], weights)
    # A face whose corners all lie on one side of the box is a cap, with the normal of the side. Of the three sides that
    # face the camera, these are the normals' cosines with the eye and with the light.
    on_side = ((vertices == 0) | (vertices == extent))[faces].all(axis=1)
    capped = on_side.any(axis=1)[face]
    eye, key_light = np.abs(camera.frame[2]), np.sign(camera.frame[2]) * _light_direction(camera)
    brightness[capped] = _brightness(eye, np.maximum(key_light, 0), 1.0)[on_side.argmax(axis=1)[face[capped]]]
    depth = np.clip(0.5 - np.einsum("pk,pk->p", nearness[corners], weights) / np.linalg.norm(camera.box), 0, 1)
    # Colours fade with depth towards a light grey, since a parallel projection has no other sign of distance.
    haze, shade = 0.30 * depth**1.5, np.clip(brightness, 0, 1.1) ** 0.9
    for channel, (surface, cap) in enumerate(zip(SURFACE, CAP, strict=True)):
        colour = np.where(capped, cap, surface) ** 0.9
        picture[covered, channel] = 255 * (np.minimum(colour * shade, 1) * (1 - haze) + 0.93 * haze) + 0.5
    picture[covered, 3] = 255
    return picture


def _mesh(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices `(V, 3)`, in voxels, and faces of the boundary of {field > 0}, with caps on the box's sides."""
    outside = -1e3 * np.abs(field).max()  # so low that caps lie at the outermost voxels' centres
    vertices, faces, _, _ = marching_cubes(np.pad(field, 1, constant_values=outside), 0.0)
    return np.clip(vertices - 1.0, 0, np.array(field.shape) - 1), faces


def _rasterise(vertices: np.ndarray, faces: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's nearest face, -1 for none, and its corners' weights, for vertices (row, column, nearness)."""
    nearest, weights = np.full(shape, -1), np.zeros((*shape, 3), np.float32)
    _fill_depth(vertices, faces, nearest, np.full(shape, -np.inf), weights)
    return nearest, weights


@njit(cache=True)
def _fill_depth(vertices, faces, nearest, depth, weights):  # pragma: no cover
    """Fill the buffers of `_rasterise`. It makes no array: Ctrl-C while compiled code returns one ends the process."""
    for face in range(len(faces)):
        a, b, c = vertices[faces[face, 0]], vertices[faces[face, 1]], vertices[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        for i in range(max(0, math.ceil(low[0])), min(len(depth) - 1, math.floor(high[0])) + 1):
            for j in range(max(0, math.ceil(low[1])), min(depth.shape[1] - 1, math.floor(high[1])) + 1):
                weight_b = ((i - a[0]) * (c[1] - a[1]) - (j - a[1]) * (c[0] - a[0])) / area
                weight_c = ((b[0] - a[0]) * (j - a[1]) - (b[1] - a[1]) * (i - a[0])) / area
                weight_a = 1 - weight_b - weight_c
                nearness = weight_a * a[2] + weight_b * b[2] + weight_c * c[2]
                # The tolerance leaves no gap at an edge that two faces share.
                if min(weight_a, weight_b, weight_c) > -1e-6 and nearness > depth[i, j]:
                    nearest[i, j], depth[i, j] = face, nearness
                    weights[i, j, 0], weights[i, j, 1], weights[i, j, 2] = weight_a, weight_b, weight_c


# ---- light -----------------------------------------------------------------------------------------------------------


def _light_direction(camera: View) -> np.ndarray:
    """Return the direction towards the key light, (z, y, x)."""
    return np.array(KEY_LIGHT) / np.linalg.norm(KEY_LIGHT) @ camera.frame


def _brightness(cosine: np.ndarray, key_light: np.ndarray, sky: np.ndarray | float) -> np.ndarray:
    """Return the brightness of a surface, by its cosine towards the eye, its key light and its share of open sky."""
    return 1.12 * ((0.50 + 0.14 * cosine) * sky + 0.52 * key_light * (0.55 + 0.45 * sky))


def _surface_brightness(
    field: np.ndarray, camera: View, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return the brightness `(N,)` of the level set at points `(N, 3)` of its mesh, in voxels."""
    edges, light = camera.box / (np.array(field.shape) - 1), _light_direction(camera)
    smooth = gaussian_filter(field, 0.9 / edges, truncate=3)
    slopes = [map_coordinates(slope, points.T, order=1, mode="nearest") for slope in np.gradient(smooth, *edges)]
    normal = -np.stack(slopes, axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    factor = math.ceil(max(field.shape) / COARSE)
    occupancy = block_reduce((field > 0).astype(np.float32), factor, np.mean)

    def occupancy_ahead(distance: float) -> np.ndarray:
        blurred = gaussian_filter(occupancy, distance / factor / edges, mode="constant")
        positions = (points + distance * normal / edges - (factor - 1) / 2) / factor
        return map_coordinates(blurred, positions.T, order=1, mode="nearest")

    occupied_near, occupied_far = occupancy_ahead(NEAR), occupancy_ahead(FAR)
    # The more of the phase there is in front of a point, near and far, the less of the sky is open to it.
    sky = (1 - np.clip((occupied_near - 0.12) * 1.5, 0, 0.7)) * (1 - np.clip((occupied_far - 0.05) * 1.3, 0, 0.6))
    # Points are lifted off the surface, which would shadow itself where the depth buffer is coarse.
    shadow = _shadow(vertices * edges, faces, light, points * edges + 1.5 * normal + 2.0 * light)
    return _brightness(normal @ camera.frame[2], np.maximum(normal @ light, 0) * (1 - 0.6 * shadow), sky)


def _shadow(vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the share of the key light that a mesh blocks at points `(N, 3)`, averaged over 3 × 3 pixels."""
    plane_axes = np.linalg.svd(light[None])[2][1:]  # two directions perpendicular to the light
    frame = np.stack([*plane_axes, light])
    projected, positions = vertices @ frame.T, points @ frame.T
    origin = projected[:, :2].min(0) - 2
    projected[:, :2] -= origin
    shape = tuple(int(n) + 3 for n in projected[:, :2].max(0))
    nearest, weights = _rasterise(projected, faces, shape)
    height = np.where(nearest < 0, -np.inf, np.einsum("ijk,ijk->ij", projected[faces[nearest], 2], weights))
    cell, fraction = np.divmod(positions[:, :2].T - origin[:, None], 1)
    indices = cell[:, None] + np.arange(-1, 3)[:, None]
    rows, columns = (np.clip(k, 0, n - 1).astype(int) for k, n in zip(indices, shape, strict=True))
    # A window 3 pixels wide covers the first and the last of 4 pixels in part.
    window = [np.stack([1 - f, np.ones_like(f), np.ones_like(f), f]) / 3 for f in fraction]
    return np.einsum("in,jn,ijn->n", *window, height[rows[:, None], columns] > positions[:, 2])


# ---- a surface in its box --------------------------------------------------------------------------------------------


def render_in_box(u: np.ndarray, **options) -> np.ndarray:
    """Return the level set of a field (or the outline of a bool mask) in its box, cut faces capped.

    The picture is RGBA bytes, transparent where there is nothing; `options` are those of `render`.
    """
    values = np.asarray(u)
    if values.dtype == np.bool_:
        values = gaussian_filter(values.astype(np.float32), 0.7) - np.float32(0.5)
    surface, camera = render(values, **options)
    size = (surface.shape[1], surface.shape[0])
    sheet = Image.new("RGBA", size)
    for layer in (_edges(camera, size, front=False), Image.fromarray(surface), _edges(camera, size, front=True)):
        sheet.alpha_composite(layer)
    return np.asarray(sheet)


def _edges(camera: View, size: tuple[int, int], *, front: bool) -> Image.Image:
    """Return a picture of the box's edges in front of the shape, or of the three behind it, at the farthest corner."""
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    farthest = (corners == (camera.frame[2] < 0)).all(axis=1).argmax()
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
    positions = camera.project(corners) * np.array(size) * _EDGE_SUPERSAMPLE
    opacity = Image.new("L", (size[0] * _EDGE_SUPERSAMPLE, size[1] * _EDGE_SUPERSAMPLE))
    grey, width = round(255 * _EDGE_OPACITY[front]), round(_EDGE_WIDTH * _EDGE_SUPERSAMPLE)
    pen = ImageDraw.Draw(opacity)
    for a, b in pairs:
        if (farthest in (a, b)) != front:
            pen.line([*positions[a], *positions[b]], fill=grey, width=width)
    layer = Image.new("RGBA", size, QUIET)
    layer.putalpha(opacity.reduce(_EDGE_SUPERSAMPLE))
    return layer
