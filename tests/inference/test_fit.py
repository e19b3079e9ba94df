"""A fit and its file: what is written is what is read, in every field."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from found import BROKEN, broken, lattice, made_fit, measured

from curvafit.core.records import quoted
from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE
from curvafit.inference.estimate import middle_of
from curvafit.inference.fit import COLUMNS, Fit, to_columns
from curvafit.priors import Law


@pytest.fixture(scope="module")
def fit() -> Fit:
    seen = measured(lattice(32, 16, 4.5)).thin(BIN_WIDTH, TAIL_SHARE)
    return dataclasses.replace(made_fit(), diagram=seen)


def fields(fit: Fit) -> dict:
    """All but the diagram; the draws as a file has them."""
    return {name: value for name, value in vars(fit).items() if name != "diagram"} | {
        "draws": fit.as_dict()["posterior"]
    }


def test_every_field_comes_back(fit: Fit) -> None:
    back = Fit.from_json(fit.to_json())
    assert fields(back) == fields(fit)
    assert {type(value) for value in fields(back).values()} == {type(value) for value in fields(fit).values()}
    odd = dataclasses.replace(fit, status="grown [  3  ]", notes=("scan [ 1, 2 ].tif",))
    assert fields(Fit.from_json(odd.to_json())) == fields(odd)
    assert fit == fit and len({fit, fit}) == 1


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
    assert back.morphometry.volume_fraction == 1.0 and back.candidates == fit.candidates


def test_a_distance_that_is_unknown_comes_back() -> None:
    lost = made_fit("match", lost=True)
    assert lost.candidates[0].distance is None and Fit.from_json(lost.to_json()).candidates == lost.candidates


def test_numbers_and_uncertainty_are_those_of_one_candidate(fit: Fit) -> None:
    for chosen in fit.candidates:
        other = dataclasses.replace(fit, chosen=chosen.name)
        assert (other.coefficients, other.mass, other.uncertainty) == (
            chosen.coefficients, chosen.mass, chosen.uncertainty,
        )  # fmt: skip


def test_a_fit_without_a_law_is_none(fit: Fit) -> None:
    none = made_fit(chosen=None)
    assert (none.coefficients, none.mass, none.coefficients_physical, none.uncertainty) == (None, None, None, {})
    assert fields(Fit.from_json(none.to_json())) == fields(none)
    with pytest.raises(ValueError, match="law"):
        none.to_law()


def test_intervals_in_the_scan_s_unit_are_the_draws_in_that_unit(fit: Fit) -> None:
    assert fit.draws is not None
    content = json.loads(fit.to_json())
    for name, power in (("a11", 0), ("a02", 0), ("a10", 1), ("a01", 1), ("a00", 2), ("mass", 0)):
        working, physical = content["intervals"][name], content["intervals_physical"][name]
        column = to_columns(fit.draws)[COLUMNS.index(name)]
        assert working["median"] == pytest.approx(np.median(column))
        assert working["90"] == pytest.approx(np.percentile(column, (5, 95)).tolist())
        lengths = fit.thickness / to_columns(fit.draws)[-1] / 0.01  # a draw's shapes are as thick as the scan's
        assert physical["90"] == pytest.approx(np.percentile(column / lengths**power, (5, 95)).tolist())


def test_intervals_are_central_and_in_powers_of_a_length(fit: Fit) -> None:
    draws = np.outer(np.arange(1.0, 102.0), np.ones(7))
    draws[:, 1], draws[:, 6] = np.log(draws[:, 1]), np.log(8)
    even = dataclasses.replace(fit, draws=draws, thickness=8 * 0.02)
    working, other = even.intervals(), even.intervals(physical=True)
    assert working is not None and other is not None and list(working) == list(COLUMNS[:6])
    for name, scale in zip(COLUMNS[:6], (1, 1, 2, 2, 4, 1), strict=True):
        assert working[name]["median"] == pytest.approx(51)
        assert (working[name]["50"], working[name]["90"]) == (pytest.approx([26, 76]), pytest.approx([6, 96]))
        assert other[name]["90"] == pytest.approx([6 / scale, 96 / scale])


def test_the_middle_is_the_draw_nearest_to_the_medians() -> None:
    rows = np.repeat(np.array([-3, -1, 0.5, 1, 9])[:, None], 6, 1)  # median .5
    rows[:, 2] = (0, 0, 40, 3, 0)  # median 0
    assert middle_of(rows) == pytest.approx(rows[3])
    rows[0, 2] = -4000  # of this range 40 is little
    assert middle_of(rows) == pytest.approx(rows[2])


def test_a_file_is_read_as_a_fit_and_as_a_prior(tmp_path: Path, fit: Fit) -> None:
    path = fit.save(tmp_path / "fit.json")
    assert fields(Fit.load(path)) == fields(fit)
    assert Law.load(path) == fit.to_law() == Fit.load(path).to_law()
    content = json.loads(path.read_text()) | {"format": "curvafit-fit-1"}
    path.write_text(json.dumps(content))
    for load in (Law.load, Fit.load):
        with pytest.raises(ValueError, match="again"):
            load(path)
    with pytest.raises(FileNotFoundError, match="no file"):
        Fit.load(tmp_path / "none.json")


def test_a_fit_is_one_line_and_shows_its_scan_s_diagram(fit: Fit) -> None:
    text = repr(fit)
    assert "\n" not in text and "tubes from an image" in text and "working voxel 0.0195 mm" in text
    assert fit.status in text and "<img" in fit._repr_html_()
    bare = made_fit()
    assert "<img" not in bare._repr_html_()
    with pytest.raises(ValueError, match="diagram"):
        bare.plot()


# ---- what a file may not hold ----------------------------------------------------------------------------------------

SENTENCE = r"\Aexpected [^\n]{1,600}\Z"


def refused(path: Path, content: str | bytes) -> str:
    """What `Fit.load` says of a file."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ValueError, match=SENTENCE) as error:
        Fit.load(path)
    return str(error.value)


#: Where, what stands there as JSON, and what is said.
BOMBS = [
    ("mass", "NaN", "NaN, which is not a finite number"),
    ("coefficients.a00", "-Infinity", "-Infinity, which is not a finite number"),
    ("epsilon_physical", "1e999", "1e999, which is not a finite number"),
    ("working_voxel", "1" * 400, "a number of 400 digits"),
    ("provenance", "1" * 5000, "a number of 5000 digits"),
    ("provenance", "[" * 100_000 + "]" * 100_000, "nested too deeply"),
    ("provenance", '{"a":' * 100_000, "nested too deeply"),
    ("provenance", '{"a": 1, "a": 2}', "the key 'a' twice"),
    ("provenance", "{", "which is not JSON"),
    ("status", None, "status, got none"),
    ("chosen", "3", "chosen as a text, or null, got 3"),
    ("chosen", '"optimum"', "optimum"),
    ("candidates", "[{}]", "candidates[0].name, got none"),
    ("misfit", '{"probability": 2, "blocks": {}, "method": ""}', "misfit.probability as a number from 0 to 1, got 2"),
    ("scale", "[1, 1]", "scale as a list of 3 numbers"),
    ("posterior.draws.a10", "[0.1]", "length"),
    ("diagram", '{"kappa1": [1], "kappa2": [2], "share": [1, 1]}', "length"),
]


@pytest.mark.parametrize(("where", "text", "said"), [*BOMBS, *((where, text, where) for where, text in BROKEN)])
def test_one_thing_wrong_is_named(tmp_path: Path, where: str, text: str | None, said: str) -> None:
    assert said in refused(tmp_path / "fit.json", broken(where, text))


def test_a_law_alone_is_no_whole_fit(tmp_path: Path, fit: Fit) -> None:
    content = json.loads(fit.to_json())
    del content["matches"]
    assert "matches, got none" in refused(tmp_path / "fit.json", json.dumps(content))
    assert Law.load(tmp_path / "fit.json") == fit.to_law()


def test_bytes_that_are_no_utf8_and_a_byte_order_mark(tmp_path: Path) -> None:
    text = made_fit().to_json()
    assert "not text in UTF-8" in refused(tmp_path / "fit.json", text.replace("tubes", "tübes").encode("latin-1"))
    assert "not text in UTF-8" in refused(tmp_path / "fit.json", text.encode("utf-16"))
    (tmp_path / "fit.json").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert Fit.load(tmp_path / "fit.json").mass == made_fit().mass


def test_content_that_is_no_object_and_another_format(tmp_path: Path) -> None:
    for text in ("[]", "7", '"x"', "null", "{}"):
        assert "expected a fit.json written by `curvafit infer` with" in refused(tmp_path / "fit.json", text)
    said = refused(tmp_path / "fit.json", json.dumps({"format": ["x" * 10**6] * 100}))
    assert "expected a fit.json of format curvafit-fit-3, got [" in said


def test_what_is_written_is_what_can_be_read() -> None:
    fit = Fit.from_json(made_fit().to_json())
    assert Fit.from_json(fit.to_json()).as_dict() == fit.as_dict()
    heavy = dataclasses.replace(made_fit().candidates[0], mass=1.5)
    with pytest.raises(ValueError, match="mass"):
        dataclasses.replace(made_fit(), candidates=(heavy,)).to_json()
    with pytest.raises(ValueError, match="length_unit"):
        dataclasses.replace(made_fit(), length_unit="ell").to_json()


def test_a_quotation_is_short() -> None:
    bomb: list = ["x"]
    for _ in range(40):
        bomb = [bomb] * 9
    loop: list = []
    loop.append(loop)
    for value in (bomb, loop, "y" * 10**6, {str(k): "z" * 999 for k in range(999)}, 7**400, b"\n" * 10**5):
        assert len(quoted(value)) < 200 and "\n" not in quoted(value)
