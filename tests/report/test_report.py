"""The report: one self-contained page, readable numbers, files written whole or not at all."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from found import EPSILON, RADIUS, SCALE, made_fit, made_inference, without_drawing

from curvafit.core.units import GLOSSARY, format_length, format_number
from curvafit.geometry.diagrams import diagram
from curvafit.inference.inference import Inference
from curvafit.priors import Grid
from curvafit.priors.law import FORMAT, Law
from curvafit.report.inference import (
    describe,
    family_radius,
    parameter_table,
    report_html,
    write_inference,
)
from curvafit.volumes.read import load

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Reads a page: complains of unbalanced tags, keeps text, attributes and tables."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data + " "


@pytest.fixture(scope="module")
def html() -> str:
    return report_html(made_inference())


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    without_drawing(monkeypatch)


def test_the_page_stands_alone_and_is_well_formed(html: str) -> None:
    page = Page(html)
    links = [value or "" for name, value in page.attributes if name in ("src", "action", "srcset")]
    assert len(links) == 8 and all(link.startswith("data:image/png;base64,") for link in links)
    hrefs = [value or "" for name, value in page.attributes if name == "href"]
    assert {href.removeprefix(GLOSSARY) for href in hrefs} == {"#law", "#working-unit"}
    assert len(re.findall(r"https?:", html)) == len(hrefs) and "url(" not in html and "<script" not in html
    assert "tubes <b>" not in html and "tubes &lt;b&gt;&amp;.tif" in html
    assert all(base64.b64decode(link.partition(",")[2])[:4] == b"\x89PNG" for link in links)
    alts = [value for name, value in page.attributes if name == "alt"]
    assert len(alts) == 8 and all(alts)
    assert len(html) < 4_000_000


def test_the_page_says_what_was_found(html: str) -> None:
    text = " ".join(Page(html).text.split())
    opening = re.search(r"Tubes, radius (\d+) µm, 19 % of the volume\.", text)
    assert opening is not None and float(opening[1]) == pytest.approx(1000 * RADIUS * SCALE, rel=0.05)
    for said in ("Nearest match 2.2", "Middle of the posterior 1.6", "lie 1.1 apart", "Conn.D 4.900 1/mm³", "p = 0.40",
                 "curvafit generate --prior fit.json"):  # fmt: skip
        assert said in text, said
    assert text.count("best supported") == 1


def test_physical_coefficients_carry_their_power_of_length(html: str) -> None:
    rows = dict(re.findall(r'<tr><th scope="row">(a.{2})</th>(.*?)</tr>', html))
    assert {"a₂₀", "a₁₁", "a₀₂", "a₁₀", "a₀₁", "a₀₀"} <= set(rows)
    λ = SCALE / 0.01
    assert format_number(-38.5 / λ) in rows["a₁₀"] and ">6.0<" in rows["a₁₀"] and "1/mm<" in rows["a₁₀"]
    assert format_number(433 / λ**2) in rows["a₀₀"] and ">51<" in rows["a₀₀"] and "1/mm²" in rows["a₀₀"]
    assert "fixed" in rows["a₂₀"] and "1/mm" not in rows["a₁₁"]


def test_a_scan_without_a_law_has_a_page_all_the_same(tmp_path: Path, undrawn: None) -> None:
    none = dataclasses.replace(made_inference(), twins={}, fit=made_fit(chosen=None))
    page = Page(report_html(none))
    assert "The law, and how well" not in page.text and "Make more of it" not in page.text
    assert "Familiar numbers" in page.text and none.fit.status in page.text
    assert parameter_table(none) == []
    report = write_inference(none, tmp_path / "out")
    assert sorted(path.name for path in report.parent.iterdir()) == ["fit.json", "report.html"]
    content = json.loads((report.parent / "fit.json").read_text())
    assert content["coefficients"] is None and content["mass"] is None and content["chosen"] is None
    with pytest.raises(ValueError, match="law"):
        Law.load(report.parent / "fit.json")


def regrown(inference: Inference, phase: np.ndarray) -> Inference:
    """The inference with another shape grown from its chosen law."""
    grown = inference.twins.items()
    twins = {name: tuple(dataclasses.replace(each, phase=phase) for each in shapes) for name, shapes in grown}
    return dataclasses.replace(inference, twins=twins)


def test_an_inference_is_written_whole(tmp_path: Path, undrawn: None) -> None:
    found = made_inference()
    report = write_inference(found, tmp_path / "deep" / "out", command="curvafit infer 'a b.tif' -o out")
    assert report == tmp_path / "deep" / "out" / "report.html"
    names = sorted(path.name for path in report.parent.iterdir())
    assert names == ["fit.json", "regenerated.nii.gz", "report.html"]
    assert sorted(path.name for path in report.parent.parent.iterdir()) == ["out"]
    assert json.loads((report.parent / "fit.json").read_text())["provenance"]["command"].endswith("-o out")
    volume = load(report.parent / "regenerated.nii.gz")
    assert volume.unit == "mm" and volume.spacing == pytest.approx((SCALE,) * 3)
    assert np.array_equal(volume.values, found.best)
    assert "curvafit infer &#39;a b.tif&#39; -o out" in report.read_text(encoding="utf-8")


def test_a_failure_leaves_what_was_there(tmp_path: Path, undrawn: None) -> None:
    target = tmp_path / "out"
    target.mkdir()
    mine = f'{{"format": "{FORMAT}"}}'
    (target / "fit.json").write_text(mine)
    (target / "report.html").write_text('<meta name="generator" content="curvafit 0">')
    broken = regrown(made_inference(), np.full((48, 48, 48), np.nan))
    with pytest.raises(ValueError, match="finite"):
        write_inference(broken, target)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["fit.json", "out", "report.html"]
    assert (target / "fit.json").read_text() == mine
    with pytest.raises(ValueError, match="folder"):
        write_inference(made_inference(), target / "fit.json")


def test_a_shape_that_cannot_be_made_leaves_no_older_volume(tmp_path: Path, undrawn: None) -> None:
    (tmp_path / "fit.json").write_text(f'{{"format": "{FORMAT}"}}')
    (tmp_path / "report.html").write_text('<meta name="generator" content="curvafit 0">')
    (tmp_path / "regenerated.nii.gz").write_text("older")
    nothing = dataclasses.replace(made_inference(lost=True), twins={})
    write_inference(nothing, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.json", "report.html"]


@pytest.mark.parametrize(("family", "curvatures"), [("spheres", (0.1, 0.1)), ("tubes", (0.1, 0.0))])
def test_radii_come_from_the_family_s_own_area(family: str, curvatures: tuple[float, float]) -> None:
    z, y, x = np.meshgrid(*(np.arange(48) - 23.5,) * 3, indexing="ij")
    radius = np.sqrt(y**2 + x**2 + (z**2 if family == "spheres" else 0))
    u = np.tanh(0.01 * (10 - radius) / (np.sqrt(2) * EPSILON))
    measured = diagram(torch.from_numpy(u), Grid(u.shape, 0.01, "replicate"), EPSILON)
    assert family_radius(measured, family) == pytest.approx(0.1, rel=0.05)
    assert family_radius(measured, "sponge") is None
    assert measured.mean() * 0.01 == pytest.approx(curvatures, abs=0.006)


def test_the_first_sentence() -> None:
    found = made_inference()
    for family, said in (
        ("tubes", "Tubes, radius 9"), ("layers", "Layers, 200 µm thick, 19 % of the volume"),
        ("bubbles", "Bubbles, radius 98 µm, in a phase that is 19 % of the volume"),
    ):  # fmt: skip
        named = dataclasses.replace(found, fit=dataclasses.replace(found.fit, family=family))
        assert describe(named).replace("\u00a0", " ").startswith(said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (format_number(0.0390, 3), "0.0390"), (format_number(-40.0, 3), "−40.0"),
        (format_number(12345.6, 3), "12\u202f300"), (format_number(0.99996, 3), "1.00"), (format_number(0.0, 3), "0"),
        (format_number(2.5e-7, 2), "2.5e−07"), (format_number(None, 2), "–"), (format_number(float("nan"), 2), "–"),
        (format_length(0.0412, "mm"), "41 µm"), (format_length(1500.0, "um"), "1.5 mm"),
        (format_length(5.13, "voxel"), "5.1 voxels"), (format_length(0.2, "nm"), "0.20 nm"),
    ],
)  # fmt: skip
def test_numbers_are_rounded_and_said_in_a_fitting_unit(text: str, said: str) -> None:
    assert text.replace("\u00a0", " ") == said
