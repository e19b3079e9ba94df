"""The atlas's page in a real browser: load, hover, click, turn, copy, drop, by keyboard alone, on a phone."""

from __future__ import annotations

import dataclasses
import io
import os
import re
import shlex
import shutil
from collections.abc import Iterator

import numpy as np
import pytest
import typer
from broken_fits import BROKEN, broken
from exact_store import exact_store, quick_map
from found import made_fit
from PIL import Image

from curvafit.atlas_map.extract import extract
from curvafit.atlas_map.files import write_map
from curvafit.cli.app import app
from curvafit.inference.atlas import Atlas, Match
from curvafit.inference.fit import Fit

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
pytestmark = pytest.mark.slow

#: WebGL 2 without a graphics card.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
COUNT = 16


class Opened:
    """A page with what it complained of and what it asked for."""

    def __init__(self, page, address: str) -> None:
        self.page, self.errors, self.asked = page, [], []
        page.on("console", lambda said: self.errors.append(said.text) if said.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
        page.goto(address)
        page.locator("html[data-ready]").wait_for(state="attached")

    def place(self, name: str) -> dict[str, float]:
        """Where a shape's point is in the canvas: the page's finder puts it into the middle."""
        self.page.fill("#find", name)
        self.page.press("#find", "Enter")
        box = self.page.locator("#points").bounding_box()
        return {"x": box["width"] / 2, "y": box["height"] / 2}

    def turned(self) -> str:
        return self.page.locator("#solid").get_attribute("data-drawn")

    def pixels(self, selector: str = "#solid") -> np.ndarray:
        shot = self.page.locator(selector).screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)


@pytest.fixture(scope="module")
def atlas_page(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Atlas]:
    folder = tmp_path_factory.mktemp("page")
    exact_store(folder / "s.zarr", COUNT)
    with pytest.MonkeyPatch.context() as patch:
        quick_map(patch)
        patch.setattr("curvafit.atlas_map.files.map_picture", lambda mapped, field, path: path)
        _, page = write_map([folder / "s.zarr"], folder / "map")
    return page.as_uri(), extract([folder / "s.zarr"])


@pytest.fixture(scope="module")
def browser() -> Iterator:
    found = os.environ.get("CURVAFIT_BROWSER") or shutil.which("chromium") or shutil.which("google-chrome")
    if not found:
        pytest.skip("needs Chromium: put chromium or google-chrome on the path, or name it in CURVAFIT_BROWSER")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=found, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def opened(browser, atlas_page) -> Iterator[Opened]:
    context = browser.new_context(viewport={"width": 1000, "height": 640})
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    one = Opened(context.new_page(), atlas_page[0])
    yield one
    assert one.errors == [] and all(re.match(r"file:|data:|blob:", url) for url in one.asked)
    context.close()


def test_it_loads_alone_and_draws_its_points(opened: Opened, atlas_page) -> None:
    assert opened.page.title() == "Atlas of 14 shapes · curvafit"
    assert len([url for url in opened.asked if url.startswith("file:")]) == 1
    groups = opened.page.locator("#legend button").all_inner_texts()
    assert sum(int(re.sub(r"\D", "", text)) for text in groups) == 14
    assert opened.pixels("#points").std() > 5
    opened.page.select_option("#colour", "a11")
    assert opened.page.locator("#legend").inner_text().split()[0] == "a₁₁,"
    assert opened.page.locator("#legend .ramp").count() == 1


def test_the_shape_turns_and_zooms(opened: Opened, atlas_page) -> None:
    page, name = opened.page, atlas_page[1].ids[3]
    opened.place(name)
    page.locator(f"#solid[data-drawn^='{name} 32 24']").wait_for()
    before = opened.pixels()
    assert before.std() > 15
    page.locator("#solid").hover()
    page.mouse.down()
    page.mouse.move(*[100.0 + value for value in page.locator("#solid").bounding_box().values()][:2])
    page.mouse.up()
    page.locator(f"#solid[data-drawn]:not([data-drawn^='{name} 32 24'])").wait_for()
    assert np.abs(opened.pixels() - before).mean() > 3
    page.mouse.wheel(0, -400)
    page.locator("#solid[data-drawn$='1.82']").wait_for()


def test_the_command_is_copied_and_the_command_line_takes_it(opened: Opened, atlas_page) -> None:
    atlas = atlas_page[1]
    opened.place(atlas.ids[9])
    opened.page.click("#copy")
    opened.page.locator("#copy:has-text('Copied')").wait_for()
    copied = shlex.split(opened.page.evaluate("() => navigator.clipboard.readText()"))
    generate = typer.main.get_command(app).commands["generate"]  # type: ignore[attr-defined]
    given = generate.make_context("generate", copied[2:]).params
    assert copied[:2] == ["curvafit", "generate"] and given["seed"] == atlas.seeds[9]
    assert [float(part) for part in given["coefficients"].split(",")] == atlas.coefficients[9].tolist()
    assert given["mass"] == atlas.masses[9] and given["shape"] == "24" and given["schedule"] == "cosine"


def scan_fit(atlas: Atlas, like: int) -> Fit:
    """The `fit.json` of a scan whose mask is the shape number `like` of the atlas."""
    return dataclasses.replace(made_fit(), kind="mask", diagram=atlas.mask_diagrams[like])


def drop(page, text: str, name: str = "fit.json") -> None:
    script = """([text, name]) => {
        const data = new DataTransfer();
        data.items.add(new File([text], name, { type: "application/json" }));
        return data;
    }"""
    held = page.evaluate_handle(script, [text, name])
    for event in ("dragenter", "dragover", "drop"):
        page.dispatch_event("body", event, {"dataTransfer": held})


def test_a_dropped_scan_lies_by_the_shapes_it_is_like(opened: Opened, atlas_page) -> None:
    page, atlas = opened.page, atlas_page[1]
    drop(page, scan_fit(atlas, 5).to_json())
    page.locator("#scan").wait_for()
    assert page.locator("#drop").is_hidden() and page.locator("#scan-name").inner_text() == "tubes <b>&.tif"
    rows = atlas.embeddings("mask")
    truth = np.linalg.norm(rows - rows[5], axis=1)
    near = page.locator("#scan-near button").evaluate_all("list => list.map(one => one.getAttribute('aria-label'))")
    found = dict(re.findall(r"Shape (\S+),.* distance (\S+)", "\n".join(near)))
    order = np.argsort(truth)[:5]
    assert list(found) == [atlas.ids[k] for k in order]
    assert [float(apart) for apart in found.values()] == pytest.approx(truth[order].tolist(), rel=0.01, abs=0.05)
    said = page.locator("#scan-says").inner_text()
    assert "barycentre of its 5 nearest shapes" in said and "sliced Wasserstein" in said and "masks" in said
    assert opened.pixels("#scan-diagram").std() > 5
    assert "--prior fit.json" in page.locator("#scan-command").inner_text()
    page.click("#scan-remove")
    assert page.locator("#scan").is_hidden() and page.locator("#welcome").is_visible()


def test_a_scan_without_a_diagram_is_placed_by_its_matches_or_refused(opened: Opened, atlas_page) -> None:
    page, atlas = opened.page, atlas_page[1]
    own = Match(atlas.ids[2], 1.5, atlas.shape_coefficients(2), float(atlas.masses[2]), int(atlas.seeds[2]))
    drop(page, dataclasses.replace(made_fit(), matches=(own,)).to_json())
    page.locator("#scan").wait_for()
    assert "holds no diagram" in page.locator("#scan-says").inner_text()
    assert page.locator("#scan-near button").count() == 1
    texts = [(broken(where, text), where.partition(".")[0]) for where, text, _ in BROKEN]
    for text, word in (*texts, ("{}", "format"), ("κ", "JSON")):
        drop(page, text, "odd.json")
        page.locator(f"#message:has-text('{word}')").wait_for()
    page.set_input_files("#file", {"name": "a b.json", "mimeType": "", "buffer": scan_fit(atlas, 1).to_json().encode()})
    page.locator("#scan-command:has-text(\"--prior 'a b.json'\")").wait_for()
    assert page.locator("#message").is_hidden()


def test_the_keyboard_is_enough(opened: Opened) -> None:
    page = opened.page

    def tab_to(name: str) -> None:
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("() => document.activeElement.id") == name:
                return
        raise AssertionError(f"{name} is not reached")

    tab_to("points")
    assert page.locator("#tip").is_visible()
    seen = {page.locator("#said").inner_text()}
    for key in ("ArrowRight", "ArrowUp", "ArrowLeft", "ArrowLeft", "ArrowDown"):
        page.keyboard.press(key)
        seen.add(page.locator("#said").inner_text())
    assert len(seen) >= 3
    page.keyboard.press("+")
    page.keyboard.press("Enter")
    name = page.locator("#shape-name").inner_text()
    assert name in page.url and name in page.locator("#said").inner_text()
    tab_to("solid")
    page.locator(f"#solid[data-drawn^='{name} 32 24']").wait_for()
    page.keyboard.press("ArrowLeft")
    page.locator(f"#solid[data-drawn^='{name} 44 24']").wait_for()
    outline = page.evaluate("() => getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"
    tab_to("copy")
    page.keyboard.press("Enter")
    page.locator("#copy:has-text('Copied')").wait_for()


def test_a_phone_in_the_dark_has_no_sideways_scroll(browser, atlas_page) -> None:
    address, atlas = atlas_page
    sizes = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "color_scheme": "dark"}
    one = Opened(browser.new_page(**sizes), f"{address}#{atlas.ids[4]}")
    page = one.page
    page.locator("#solid[data-drawn]").wait_for()
    drop(page, scan_fit(atlas, 5).to_json())
    for section in ("scan", "shape"):
        page.locator(f"#{section}").wait_for()
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 360
        if section == "scan":
            page.locator("#scan-near button").first.tap()
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 28)"
    assert one.errors == []
    page.close()
