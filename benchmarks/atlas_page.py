"""How large the page of an atlas is, and how long a browser takes until it can be used.

    python -m benchmarks.atlas_page [--count 1000] [--repeats 3]

The shapes are stand-ins: twenty random textures at 64³ with the diagrams of as many bins as real ones have, over and
over. Needs the extra `[dev]` and Chromium (on the path, or named in CURVAFIT_BROWSER).
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from curvafit.atlas_map.layout import NOISE, AtlasMap
from curvafit.atlas_map.page import page_html
from curvafit.atlas_map.shapes import shown
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.family import FAMILIES
from curvafit.inference.atlas import Atlas

BINS, TEXTURES, EDGE = 300, 20, 64
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def stand_in(count: int) -> AtlasMap:
    """A map of made-up shapes."""
    rng = np.random.default_rng(0)
    diagrams = tuple(
        Diagram(np.sort(rng.normal(20, 25, (BINS, 2)), axis=1)[:, ::-1] * 1.0, rng.uniform(size=BINS))
        for _ in range(count)
    )
    settings = {"shape": (EDGE,) * 3, "spacing": (0.01,) * 3, "epsilon": 0.02}
    positions = rng.normal(size=(count, 2))
    atlas = Atlas(
        ids=tuple(f"0-{k:05d}" for k in range(count)),
        coefficients=rng.uniform(-200, 200, (count, 6)),
        masses=rng.uniform(-0.75, -0.15, count),
        seeds=rng.integers(0, 2**32, count),
        volume_fractions=rng.uniform(0.1, 0.5, count),
        field_diagrams=diagrams,
        mask_diagrams=diagrams,
        provenance={"settings": settings},
    )
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    clusters = rng.integers(NOISE, 3, count)
    families = tuple(FAMILIES[k] for k in rng.integers(0, 4, count))
    return AtlasMap(atlas, apart, positions, clusters, FAMILIES[:3], families, {"versions": {"curvafit": "0"}})


def page(count: int) -> str:
    """Its page."""
    rng = np.random.default_rng(1)
    fields = [gaussian_filter(rng.normal(size=(EDGE,) * 3), 3.5, mode="wrap") for _ in range(TEXTURES)]
    textures = [shown(np.tanh(1.2 * field / field.std() - 0.5)) for field in fields]
    command = "curvafit generate --coefficients " + ",".join(["-123.4567890123456"] * 6) + " --mass -0.65432109876"
    commands = [f"{command} --shape 64 --seed {10**9 + k} --schedule deep -o a.nii.gz" for k in range(count)]
    return page_html(stand_in(count), [textures[k % TEXTURES] for k in range(count)], commands, [])


def load_times(address: str, repeats: int) -> list[tuple[float, float]]:
    """Seconds from asking for the page until it can be used, and until a shape that was clicked is drawn."""
    from playwright.sync_api import sync_playwright

    found = os.environ.get("CURVAFIT_BROWSER") or shutil.which("chromium") or shutil.which("google-chrome")
    times = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=FLAGS)
        for _ in range(repeats):
            view = browser.new_page(viewport={"width": 1440, "height": 900})
            began = time.perf_counter()
            view.goto(address)
            view.locator("html[data-ready]").wait_for(state="attached")
            ready = time.perf_counter() - began
            began = time.perf_counter()
            view.click("#points", position={"x": 400, "y": 300})
            view.fill("#find", "0-00007")
            view.press("#find", "Enter")
            view.locator("#solid[data-drawn]").wait_for()
            times.append((ready, time.perf_counter() - began))
            view.close()
        browser.close()
    return times


def main() -> None:
    options = argparse.ArgumentParser(description="Size and loading time of an atlas's page.")
    options.add_argument("--count", type=int, default=1000)
    options.add_argument("--repeats", type=int, default=3)
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "atlas.html"
        file.write_text(page(chosen.count), encoding="utf-8")
        print(f"{chosen.count} shapes: {file.stat().st_size / 1e6:.1f} MB")
        for ready, drawn in load_times(file.as_uri(), chosen.repeats):
            print(f"usable after {ready:.2f} s, a selected shape drawn {drawn:.2f} s later")


if __name__ == "__main__":
    main()
