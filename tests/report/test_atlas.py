"""The page of an atlas: what it holds, where scans lie on it, what is refused, and that a browser shows it all."""

import base64
import dataclasses
import json
import os
import re
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from calling import call, refused
from exact_store import FAMILIES, exact_field, exact_store
from found import made_fit

from curvafit.data_synth.atlas import extract
from curvafit.inference.atlas import Atlas
from curvafit.report.atlas import families_of, farthest_points, make_solid, place_on_plane, scale_fit
from curvafit.report.atlas import write_map as write

#: WebGL without a graphics card.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Made(NamedTuple):
    """A page of 14 shapes, two scans that are like shape 5 among them, the atlas, and what the page holds."""

    page: Path
    atlas: Atlas
    data: dict[str, Any]

    def unpack(self, text: str, dtype: str) -> np.ndarray:
        return np.frombuffer(zlib.decompress(base64.b64decode(text, validate=True)), dtype)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("map")
    atlas = extract([exact_store(folder / "s", 16)])
    like = dataclasses.replace(made_fit(), kind="mask", diagram=atlas.mask_diagrams[5])
    full = dataclasses.replace(like.morphometry, volume_fraction=0.8)
    paths = [like.save(folder / "fit.json")]
    paths += [dataclasses.replace(like, morphometry=full, diagram=like.diagram.mirrored).save(folder / "full.json")]
    page = write([folder / "s"], folder / "map.html", fits=paths, command="curvafit atlas map <s>")
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    return Made(page, atlas, json.loads(found[1]))


def test_the_page_holds_what_was_measured(made: Made) -> None:
    """Places and nearest others by sliced distance, in thicknesses; words; a solid in its box, closed."""
    rows = made.atlas.embeddings("mask") * 0.08
    apart = np.linalg.norm(rows[:, None] - rows[None], axis=2) + np.diag(np.full(14, np.inf))
    centred = rows - rows.mean(0)
    best = (np.linalg.svd(centred, compute_uv=False)[:2] ** 2).sum()
    places = np.array([each["place"] for each in made.data["shapes"][:14]])
    assert (places**2).sum() == pytest.approx(best, rel=1e-3)  # no other plane holds more of the spread
    for k, shape in enumerate(made.data["shapes"][:14]):
        assert shape["name"] == made.atlas.ids[k] and shape["distances"] == pytest.approx(
            np.sort(apart[k])[:5], abs=1e-3
        )
        words = dict(map(tuple, shape["rows"]))
        assert words["family"] == FAMILIES[int(shape["name"][-5:]) % 4] == families_of(made.atlas)[k]
        assert words["seed"] == str(made.atlas.seeds[k])
        faces, points = (made.unpack(shape["solid"][name], "<u2").reshape(3, -1) for name in ("faces", "points"))
        edges = np.sort(np.concatenate([faces[[0, 1]], faces[[1, 2]], faces[[2, 0]]], axis=1), axis=0)
        assert (np.unique(edges, axis=1, return_counts=True)[1] == 2).all()
        assert points.max() <= 24 * 1024
        shades = made.unpack(shape["diagram"], "u1")
        assert shades.max() == 255 and len(shades) == made.data["bins"] ** 2
    page = made.page.read_text(encoding="utf-8")
    assert all(said in page for said in ("curvafit atlas map &lt;s&gt;", "<dt>s: seed</dt><dd>3</dd>", "Atlas of 14"))


def test_a_scan_lies_where_a_shape_like_it_lies(made: Made) -> None:
    """Also one that fills more than half, by its background; whatever its unit and its voxel."""
    own, *others = made.data["shapes"][5]["place"], *(made.data["shapes"][k] for k in (14, 15))
    for other in others:
        assert other["name"] == "tubes <b>&.tif" and other["near"][0] == 5 and other["distances"][0] < 0.01
        assert other["place"] == pytest.approx(own, abs=0.01)
    fit = dataclasses.replace(made_fit(), kind="field", diagram=made.atlas.field_diagrams[5])
    larger = dataclasses.replace(fit, thickness=3e3 * fit.thickness, working_voxel=3e3 * fit.working_voxel)
    assert np.allclose(scale_fit(fit).points, scale_fit(larger).points)
    assert np.allclose(scale_fit(fit).points, fit.diagram.points * fit.thickness / fit.working_voxel * 0.01)


def test_the_plane_holds_what_lies_in_one() -> None:
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(30, 2)) @ rng.normal(size=(2, 40)) + 7
    places, shares = place_on_plane(flat, flat)
    assert shares.sum() == pytest.approx(1)
    assert np.linalg.norm(places[3] - places[8]) == pytest.approx(np.linalg.norm(flat[3] - flat[8]))


def test_the_shapes_shown_are_spread_out() -> None:
    grid = np.array([(x, y) for x in range(11) for y in range(11)], dtype=float)
    chosen = grid[farthest_points(grid, 5)]
    assert {tuple(place) for place in chosen} == {(5, 5), (0, 0), (0, 10), (10, 0), (10, 10)}
    assert len(farthest_points(grid[:3], 20)) == 3


def test_a_solid_has_the_surface_where_it_was(made: Made) -> None:
    """A ball of radius 20 in 64 voxels, on 24: its radius to a tenth of one of these; no caps, as none is cut."""
    z, y, x = np.indices((64, 64, 64)) - 31.5
    solid = make_solid(np.tanh((20 - np.sqrt(z**2 + y**2 + x**2)) / 3))
    points = made.unpack(solid["points"], "<u2").reshape(3, -1) / 1024 - (31.5 * 24 / 64 + 0.5)
    assert np.linalg.norm(points, axis=0) == pytest.approx(20 * 24 / 64, abs=0.1) and solid["caps"] == 0
    assert make_solid(exact_field(0))["caps"] > 0


def test_what_cannot_be_mapped_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exact_store(tmp_path / "s", 5)
    made_fit().save("bare.json")
    Path("mine.html").write_text("mine")
    for words, said in {
        "none -o m.html": "none", "s -o m.html": "6 shapes", "s -o m": ".html",
        "s -o mine.html": "overwrite", "s -o s/m.html": "input",
        "s -o m.html --fit bare.json": "diagram", "s -o m.html --fit mine.html": "mine.html",
    }.items():  # fmt: skip
        refused(call("atlas", "map", *words.split()), said, progress=True)
        assert not Path("m.html").exists() and Path("mine.html").read_text() == "mine"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    found = os.environ.get("CURVAFIT_BROWSER") or shutil.which("chromium") or shutil.which("google-chrome")
    if not found:
        pytest.skip("needs Chromium: put chromium or google-chrome on the path, or name it in CURVAFIT_BROWSER")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=found, args=FLAGS)
        yield opened
        opened.close()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_shows_it(made: Made, browser: Any, width: int) -> None:
    """A scan is marked; hover shows a picture and a diagram, a click a solid that turns; no request leaves the page."""
    page, wrong, asked = browser.new_page(viewport={"width": width, "height": 860}), [], []
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(made.page.as_uri())
    page.locator("html[data-ready]").wait_for(state="attached")
    assert page.title() == "Atlas of 14 shapes · curvafit" and page.locator("#name").inner_text() == "tubes <b>&.tif"
    assert "tubes <b>&.tif" in page.locator("#map").inner_text()
    where = page.evaluate(
        """k => { const map = document.getElementById("map"), box = map.getBoundingClientRect(), axes = map._fullLayout;
        const [x, y] = data.shapes[k].place, {xaxis, yaxis} = axes;
        return [box.left + xaxis._offset + xaxis.d2p(x), box.top + yaxis._offset + yaxis.d2p(y)]; }""",
        7,
    )
    page.mouse.move(where[0] - 4, where[1])
    page.mouse.move(*where)
    page.locator("#card[data-shape] #hovered svg").first.wait_for()
    name = page.locator("#card").get_attribute("data-shape")  # a shape so like it may lie on it
    seed = str(made.atlas.seeds[made.atlas.ids.index(name)])
    assert page.locator("#card img").evaluate("image => image.naturalWidth") == 144
    page.mouse.click(*where)
    page.locator(f"html[data-chosen='{name}']").wait_for(state="attached")
    assert page.locator("#name").inner_text() == name and seed in page.locator("#rows").inner_text()
    page.locator("#solid").scroll_into_view_if_needed()
    page.mouse.move(5, 5)
    before = page.locator("#solid").screenshot()
    box = page.locator("#solid").bounding_box()
    page.mouse.move(box["x"] + 150, box["y"] + 150)
    page.mouse.down()
    page.mouse.move(box["x"] + 240, box["y"] + 190, steps=4)
    page.mouse.up()
    assert page.locator("#solid").screenshot() != before
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    assert wrong == [] and [url for url in asked if not re.match("file:|data:|blob:", url)] == []
    page.close()
