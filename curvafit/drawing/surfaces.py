"""A surface in its box as a picture. Matplotlib is not needed: its start would take longer than the drawing."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

from curvafit.core.files import write_content
from curvafit.drawing.render import View, render

#: Pixels per inch of every picture, and a quiet grey for frames and notes.
DPI = 160
QUIET = "#8A8F98"
#: Width of the box's edges in pixels, pixels to one along an axis as they are drawn, and opacity behind and in front.
_LINE, _FINE, _OPACITY = 4 / 3, 3, (0.4, 0.55)


def surface_picture(u: np.ndarray, path: str | Path, *, width: int = 900, **options) -> Path:
    """Write a square picture, `width` pixels wide, of the surface of `u` `(Z, Y, X)`; `options` are those of `boxed`.

    Raises
    ------
    ValueError
        If the volume cannot be drawn (see `render.render`).
    """
    picture = Image.fromarray(boxed(u, width=width, height=width, **options))
    sheet = Image.new("RGB", (width, width), "white")
    sheet.paste(picture, ((width - picture.width) // 2, (width - picture.height) // 2), picture)
    buffer = io.BytesIO()
    sheet.save(buffer, format="png", dpi=(DPI, DPI), compress_level=3)
    return write_content(Path(path), buffer.getvalue())


def boxed(u: np.ndarray, *, level: float = 0.0, **options) -> np.ndarray:
    """Return the level set of a field (or the outline of a bool mask) in its box, cut faces capped.

    The picture is RGBA bytes, transparent where there is nothing; `options` are those of `render.render`.
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
    """Return a picture of the box's edges: the nine in front of the shape, or the three behind it."""
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
