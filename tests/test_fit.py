"""A fit and its file: what is written is what is read, in every field."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from found import lattice, made_fit, measured

from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE
from curvafit.inference.fit import Fit
from curvafit.priors import read_fit


@pytest.fixture(scope="module")
def fit() -> Fit:
    seen = measured(lattice(32, 16, 4.5)).thinned(BIN_WIDTH, TAIL_SHARE)
    return dataclasses.replace(made_fit(), diagram=seen)


def fields(fit: Fit) -> dict:
    """All but the diagram."""
    return {name: value for name, value in vars(fit).items() if name != "diagram"}


def test_every_field_comes_back(fit: Fit) -> None:
    back = Fit.from_json(fit.to_json())
    assert fields(back) == fields(fit)
    assert {type(value) for value in fields(back).values()} == {type(value) for value in fields(fit).values()}


def test_the_diagram_comes_back_to_its_stored_digits(fit: Fit) -> None:
    back = Fit.from_json(fit.to_json()).diagram
    assert fit.diagram is not None and back is not None
    np.testing.assert_allclose(back.points, fit.diagram.points, atol=0.0051)
    np.testing.assert_allclose(back.weights, fit.diagram.normalised.weights, atol=5.1e-8)
    assert (back.unit, back.spread, back.excluded) == (fit.diagram.unit, fit.diagram.spread, fit.diagram.excluded)


def test_a_fit_without_a_diagram_and_with_a_phase_that_is_missing(fit: Fit) -> None:
    full = dataclasses.replace(fit.morphometry, volume_fraction=1.0, spacing_mean=math.nan)
    back = Fit.from_json(dataclasses.replace(fit, diagram=None, morphometry=full).to_json())
    assert back.diagram is None and math.isnan(back.morphometry.spacing_mean)
    assert back.morphometry.volume_fraction == 1.0 and back.distances == fit.distances


def test_texts_come_back_as_they_are(fit: Fit) -> None:
    odd = dataclasses.replace(fit, status="grown [  3  ]", notes=("scan [ 1, 2 ].tif",))
    assert fields(Fit.from_json(odd.to_json())) == fields(odd)


def test_a_fit_can_be_a_key(fit: Fit) -> None:
    assert fit == fit and len({fit, fit}) == 1


def test_a_distance_that_is_unknown_comes_back() -> None:
    lost = made_fit("match", lost=True)
    assert lost.distances["fit"] is None and Fit.from_json(lost.to_json()).distances == lost.distances


def test_a_file_is_read_as_a_fit_and_as_a_prior(tmp_path: Path, fit: Fit) -> None:
    path = fit.save(tmp_path / "fit.json")
    assert fields(Fit.load(path)) == fields(fit)
    assert read_fit(path) == fit.to_prior() == Fit.load(path).to_prior()
    with pytest.raises(FileNotFoundError, match=r"expected a fit\.json, found no file"):
        Fit.load(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("matches", None, "matches, got none"),
        ("status", None, "status, got none"),
        ("chosen", "both", "chosen as match or fit, got 'both'"),
        ("scale", [1, 1], "scale as a list of 3 numbers"),
        ("morphometry", [], "morphometry as an object, got"),
    ],
)
def test_a_law_alone_is_no_whole_fit(tmp_path: Path, fit: Fit, name: str, value: object, said: str) -> None:
    content = json.loads(fit.to_json())
    content.pop(name) if value is None else content.update({name: value})
    with pytest.raises(ValueError, match=f"expected a fit.json written by `curvafit infer` with {said}"):
        Fit.from_json(json.dumps(content))
    if value is None:
        (tmp_path / "fit.json").write_text(json.dumps(content))
        assert read_fit(tmp_path / "fit.json") == fit.to_prior()


def test_columns_of_several_lengths_are_refused(fit: Fit) -> None:
    content = json.loads(fit.to_json())
    content["diagram"]["share"].append(0.1)
    with pytest.raises(ValueError, match="expected kappa1, kappa2 and share of one length in a fit's diagram, got"):
        Fit.from_json(json.dumps(content))


def test_a_fit_is_one_line_and_shows_its_scan_s_diagram(fit: Fit) -> None:
    text = repr(fit)
    assert "\n" not in text and "tubes from an image" in text and "working voxel 0.0195 mm" in text
    assert fit.status in text and "<img" in fit._repr_html_()
    bare = made_fit()
    assert "<img" not in bare._repr_html_()
    with pytest.raises(ValueError, match="expected a fit with a diagram to draw"):
        bare.plot()
