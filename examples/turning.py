"""Textures that turn: the strips of pictures of docs/gallery.md, and the README's moving picture.

python examples/turning.py [--small] [--edge 72] [--scan SCAN --twin TWIN] [-o docs/gallery]

Each strip has a shape's pictures side by side, `FRAMES` of a whole turn. One more goes from one law to another: shapes
of laws between two presets, grown from one noise. `--scan` and `--twin` are volumes of a scan's structure and of a
shape that grew from its law (`curvafit infer --test`), to be shown beside each other. Finished shapes are kept in the
folder `.turning`: a killed run goes on where it was.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import Shape, grown, parser
from PIL import Image

import curvafit
from curvafit.drawing.rendering import render_in_box, view
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset

NAMES = ("tubes", "sponge", "bilayers", "pearls", "trabec", "metatubes", "exp-0366", "weird")
#: The presets between which laws are mixed, and how many laws there are, with both.
ENDS, LAWS = ("bilinear-layers", "bilinear-tubes"), 9
#: Pictures of a turn, a picture's edge in pixels, and the quality of the strips.
FRAMES, PIXELS, QUALITY = 24, 260, 62
#: Shapes, pixels and colours of the README's picture, and milliseconds between its frames.
MOVING, SMALLER, COLOURS, PAUSE = ("tubes", "sponge", "trabec"), 220, 24, 110
KEPT = Path(".turning")


def main() -> None:
    takes = parser(__doc__, "docs/gallery")
    takes.set_defaults(edge=72)
    takes.add_argument("--scan", type=Path, help="a mask of a scan, to turn beside its twin")
    takes.add_argument("--twin", type=Path, help="the shape that grew from the scan's law")
    options = takes.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    turns = {}
    for name in NAMES:
        law = preset(name)
        turns[name] = turn(grown(KEPT / f"{name}.npz", law.coefficients, law.mass, options).field)
    for name, path in (("scan", options.scan), ("twin", options.twin)):
        if path is not None:
            turns[name] = turn(curvafit.load(path).values)
    for name, pictures in turns.items():
        write_strip(pictures, options.output / f"{name}.webp")
    write_strip([still(shape.field, 32.0) for shape in between(options)], options.output / "between.webp")
    write_moving([turns[name] for name in MOVING], options.output.parent / "turning.gif")


def between(options) -> list[Shape]:
    """Return shapes of laws from one preset to another, all from one noise."""
    first, last = (np.array([*law.coefficients, law.mass]) for law in map(preset, ENDS))
    shapes = []
    for k, share in enumerate(np.linspace(0, 1, LAWS)):
        *coefficients, mass = (1 - share) * first + share * last
        shapes.append(grown(KEPT / f"between-{k}.npz", Coefficients(*coefficients), float(mass), options))
    return shapes


def turn(values: np.ndarray) -> list[Image.Image]:
    """Return the pictures of a whole turn about the z axis."""
    return [still(values, 32.0 + 360 * k / FRAMES) for k in range(FRAMES)]


def still(values: np.ndarray, azimuth: float) -> Image.Image:
    """Return a square picture of a shape, in which it is as large from every side."""
    values = values > 0 if values.dtype != np.float32 else values
    widest = max(max(view(values.shape, azimuth=angle).half) for angle in range(0, 91, 5))
    half = view(values.shape, azimuth=azimuth).half
    picture = Image.fromarray(render_in_box(values, width=round(PIXELS * half[0] / widest), azimuth=azimuth))
    sheet = Image.new("RGBA", (PIXELS, PIXELS))
    sheet.paste(picture, ((PIXELS - picture.width) // 2, (PIXELS - picture.height) // 2))
    return sheet


def write_strip(pictures: list[Image.Image], path: Path) -> None:
    """Write pictures side by side; their transparency suits a light page and a dark one."""
    strip = Image.new("RGBA", (PIXELS * len(pictures), PIXELS))
    for k, picture in enumerate(pictures):
        strip.paste(picture, (PIXELS * k, 0))
    strip.save(path, quality=QUALITY, method=6)
    print(path, f"{path.stat().st_size / 1000:.0f} kB")


def write_moving(turns: list[list[Image.Image]], path: Path) -> None:
    """Write shapes that turn beside each other, on white, as an animation of one palette."""
    frames = []
    for pictures in zip(*turns, strict=True):
        sheet = Image.new("RGBA", (SMALLER * len(turns), SMALLER), "white")
        for k, picture in enumerate(pictures):
            sheet.alpha_composite(picture.resize((SMALLER, SMALLER), Image.Resampling.LANCZOS), (SMALLER * k, 0))
        frames.append(sheet.convert("RGB"))
    pixels = np.concatenate([np.asarray(frame).reshape(-1, 3) for frame in frames])
    palette = Image.fromarray(pixels[pixels.min(1) < 250][None]).quantize(COLOURS - 1)
    palette.putpalette([*(palette.getpalette() or [])[: 3 * (COLOURS - 1)], 255, 255, 255])
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=PAUSE, loop=0, optimize=True)
    print(path, f"{path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
