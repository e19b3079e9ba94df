"""The notebooks of the docs, each run as the script that it is."""

import runpy
from pathlib import Path
from typing import Any

import matplotlib
import pytest

pytestmark = pytest.mark.slow


def run(name: str) -> dict[str, Any]:
    """The names that a notebook ends with."""
    with matplotlib.rc_context():
        matplotlib.use("agg")
        return runpy.run_path(str(Path(__file__).resolve().parents[2] / "docs" / "notebooks" / f"{name}.py"))


def test_infer() -> None:
    """A phase field gives its coefficients back: from another processor's shape as well."""
    ended = run("infer")
    truth, fit = ended["truth"].coefficients, ended["fit"]
    assert fit.chosen == "stationarity"
    assert fit.coefficients.a11 == pytest.approx(truth.a11, abs=0.3)
    assert fit.coefficients.a02 == pytest.approx(truth.a02, abs=0.3)


def test_generate() -> None:
    """Two seeds of one texture lie nearer to each other than two textures do, in the mean; the prior's runs."""
    distances = run("generate")["distances"]
    same = [value for ((a, _), (b, _)), value in distances.items() if a == b]
    other = [value for ((a, _), (b, _)), value in distances.items() if a != b]
    assert len(same) == 3 and len(other) == 12
    assert sum(same) / 3 < sum(other) / 12
    ended = run("prior")
    assert ended["weight"] > 0
    assert all(0 < dice <= 1 for dice, _ in ended["results"].values())
