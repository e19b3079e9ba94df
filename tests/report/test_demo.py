"""The page of a first look: scores on what was left out, a page that stands alone, no page of others lost."""

import re
from pathlib import Path

import numpy as np
import pytest
from found import SCALE, lattice, made_inference

from curvafit.report.demo import demo_page, score, shape_figure, write_demo
from curvafit.scan.tiles import measure
from curvafit.segmentation.slices import WAYS
from curvafit.volumes.volume import Volume


def cone(n: int = 33) -> np.ndarray:
    """Discs whose radius grows along z: lines between their outlines are exact, the nearest slice is not."""
    z, y, x = np.indices((n, 48, 48))
    return np.hypot(y - 23.5, x - 23.5) < 4 + z / 2


def test_scores_are_of_the_slices_left_out_alone() -> None:
    truth = cone()
    known = np.zeros_like(truth)
    known[::8] = truth[::8]
    assert score(truth, truth, 0)["curvafit"] == 1
    scores = score(truth, known, 0)
    assert scores["curvafit"] == 0 and set(scores) == {"curvafit", *WAYS}
    assert scores["linear"] > 0.98 > scores["nearest"]
    truth, filled = cone(37), cone(37)
    filled[33:] = False  # beyond the last known slice, which does not count
    assert score(truth, filled, 0)["curvafit"] == 1


@pytest.mark.slow
def test_the_page_stands_alone_and_escapes_what_it_is_told() -> None:
    inference, mask = made_inference(), lattice(48, 24, 5.0) > 0
    measures, scores = measure(Volume(mask, (SCALE,) * 3, "mm")), score(mask, mask, 1)
    page = demo_page(inference, measures, shape_figure(mask, mask, 1, (SCALE,) * 3), scores, 1)
    assert "tubes &lt;b&gt;&amp;.tif" in page and page.count("data:image/png;base64,") == 3
    assert set(re.findall(r'(?:src|href)="(?!data:)([^"]*)', page)) == {"measures.html", "report.html"}
    assert 'chosen">1.000</td>' in page and "--axis y" in page


def test_another_program_s_page_is_kept(tmp_path: Path) -> None:
    page = tmp_path / "demo.html"
    page.write_text("mine")
    with pytest.raises(ValueError, match="overwrite"):
        write_demo(Volume(cone(), (1.0,) * 3, "voxel"), tmp_path)
    assert page.read_text() == "mine" and [path.name for path in tmp_path.iterdir()] == ["demo.html"]
