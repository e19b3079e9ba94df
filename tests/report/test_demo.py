"""The page of a first look: scores on what was left out, a page that stands alone, no page of others lost."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from found import SCALE, lattice, made_inference

from curvafit.inference.atlas import load_atlas
from curvafit.inference.posterior import load_posterior
from curvafit.report.demo import demo_page, score_completion, write_demo
from curvafit.scan.measure import measure
from curvafit.segmentation.slices import WAYS
from curvafit.volumes.field import Field


def cone(n: int = 33) -> np.ndarray:
    """Discs whose radius grows along z: lines between their outlines are exact, the nearest slice is not."""
    z, y, x = np.indices((n, 48, 48))
    return np.hypot(y - 23.5, x - 23.5) < 4 + z / 2


def test_scores_are_of_the_slices_left_out_alone() -> None:
    truth = cone()
    known = np.zeros_like(truth)
    known[::8] = truth[::8]
    assert score_completion(truth, truth, 8, "").dice["curvafit"] == 1
    completion = score_completion(truth, known, 8, "")
    assert completion.dice["curvafit"] == 0 and np.array_equal(completion.known, known)
    assert set(completion.dice) == {"curvafit", *WAYS}
    assert completion.dice["linear"] > 0.98 > completion.dice["nearest"]


def test_what_lies_beyond_the_last_known_slice_does_not_count() -> None:
    truth = cone(37)
    filled = truth.copy()
    filled[33:] = False
    assert score_completion(truth, filled, 8, "").dice["curvafit"] == 1


def test_the_page_stands_alone_and_escapes_what_it_is_told() -> None:
    inference, mask = made_inference(), lattice(48, 24, 5.0) > 0
    measures = measure(Field(mask, (SCALE,) * 3, "mm"))
    completion = score_completion(mask, mask, 8, "a <status>")
    page = demo_page(inference, measures, completion, load_atlas(), load_posterior().box, "A <title>")
    assert "A &lt;title&gt;" in page and "a &lt;status&gt;" in page and "tubes &lt;b&gt;&amp;.tif" in page
    assert "<title>A <" not in page and page.count("data:image/png;base64,") == 3
    assert re.findall(r'(?:src|href)="(?!data:|report\.html)', page) == []
    assert "<b>1.000</b>" in page and "1/mm" in page
    assert len(re.findall(r"(?:not|partly)? ?read</td>", page)) == 6


def test_another_program_s_page_is_kept(tmp_path: Path) -> None:
    page = tmp_path / "demo.html"
    page.write_text("mine")
    with pytest.raises(ValueError, match="overwrite"):
        write_demo(Field(cone(), (1.0,) * 3, "voxel"), tmp_path, title="cone")
    assert page.read_text() == "mine" and [path.name for path in tmp_path.iterdir()] == ["demo.html"]
