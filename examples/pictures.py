"""Pictures as the pages of docs/ show them: WebP, a third of a PNG where surfaces are drawn.

python examples/pictures.py PICTURE docs/NAME.webp [--width 1100] [--lossless]      # lossless for lines and letters
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from curvafit.core.files import write_atomically
from curvafit.drawing.plot import png

QUALITY = 80


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--width", type=int, help="at most so many pixels")
    parser.add_argument("--lossless", action="store_true")
    options = parser.parse_args()
    write_webp(options.picture, options.output, width=options.width, lossless=options.lossless)


def write_webp(
    picture: Figure | Path, path: Path, *, width: int | None = None, quality: int = QUALITY, lossless: bool = False
) -> Path:
    """Write a figure, or a picture of a file, on white; print how large the file is."""
    source = io.BytesIO(png(picture)) if isinstance(picture, Figure) else picture
    image = Image.open(source).convert("RGBA")
    sheet = Image.new("RGBA", image.size, "white")
    sheet.alpha_composite(image)
    if width is not None and width < sheet.width:
        sheet = sheet.resize((width, round(sheet.height * width / sheet.width)), Image.Resampling.LANCZOS)
    options = {"lossless": True, "quality": 100} if lossless else {"quality": quality}
    write_atomically(path, lambda part: sheet.convert("RGB").save(part, "webp", method=6, **options))
    print(path, f"{path.stat().st_size / 1000:.0f} kB")
    return path


if __name__ == "__main__":
    main()
