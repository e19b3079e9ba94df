"""A fit, its file and its verdict: what is written is what is read, and each sentence is led to by numbers."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from found import BROKEN, NUMBERS, broken, lattice, made_fit, measured

import curvafit.inference.inference as room
from curvafit.core.records import quoted
from curvafit.core.runtime import silent
from curvafit.core.schema import decode, encode
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.candidates import (
    UNBELIEVABLE,
    Candidate,
    Growth,
    Misfit,
    Twin,
    best_candidate,
    find_differences,
    seed_noise_of,
    verdict,
)
from curvafit.inference.estimate import Estimate, sort_by_middle
from curvafit.inference.fit import Fit
from curvafit.inference.table import COLUMNS, to_columns
from curvafit.priors import Law
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.preparation import Prepared


@pytest.fixture(scope="module")
def fit() -> Fit:
    seen = measured(lattice(32, 16, 4.5)).thin(BIN_WIDTH, TAIL_SHARE)
    return dataclasses.replace(made_fit(), diagram=seen.normalised)


def fields(fit: Fit) -> dict:
    """All but the diagram; the draws as a file has them."""
    return {name: value for name, value in vars(fit).items() if name != "diagram"} | {"draws": fit.as_dict()["draws"]}


def test_every_field_comes_back(fit: Fit) -> None:
    back, lost = Fit.from_json(fit.to_json()), made_fit("match", lost=True)
    assert {type(value) for value in fields(back).values()} == {type(value) for value in fields(fit).values()}
    odd = dataclasses.replace(fit, status="grown [  3  ]", notes=("scan [ 1, 2 ].tif",))
    assert lost.candidates[0].distance is None
    for each in (fit, odd, lost, made_fit(chosen=None)):
        assert fields(Fit.from_json(each.to_json())) == fields(each)
    assert fit == fit and len({fit, fit}) == 1
    full = dataclasses.replace(fit.morphometry, volume_fraction=1.0, spacing_mean=math.nan)
    back = Fit.from_json(dataclasses.replace(fit, diagram=None, morphometry=full).to_json())
    assert back.diagram is None and math.isnan(back.morphometry.spacing_mean)
    assert back.morphometry.volume_fraction == 1.0 and back.candidates == fit.candidates


def test_the_diagram_comes_back_to_its_stored_digits(fit: Fit) -> None:
    back = Fit.from_json(fit.to_json()).diagram
    assert fit.diagram is not None and back is not None
    np.testing.assert_allclose(back.points, fit.diagram.points, rtol=5.1e-6)
    np.testing.assert_allclose(back.weights, fit.diagram.weights, rtol=5.1e-6)
    assert (back.unit, back.spread, back.excluded) == (fit.diagram.unit, fit.diagram.spread, fit.diagram.excluded)


def test_numbers_and_uncertainty_are_those_of_one_candidate(fit: Fit) -> None:
    for chosen in fit.candidates:
        other = dataclasses.replace(fit, chosen=chosen.name)
        for name in ("coefficients", "mass", "uncertainty"):
            assert getattr(other, name) == getattr(chosen, name)


def test_a_fit_without_a_law_is_none(fit: Fit) -> None:
    none = made_fit(chosen=None)
    assert (none.coefficients, none.mass, none.coefficients_physical, none.uncertainty) == (None, None, None, {})
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
    assert sort_by_middle(rows)[0] == pytest.approx(rows[3])
    rows[0, 2] = -4000  # of this range 40 is little
    assert sort_by_middle(rows)[0] == pytest.approx(rows[2])


def test_a_file_is_read_as_a_fit_and_as_a_prior(tmp_path: Path, fit: Fit) -> None:
    path = fit.save(tmp_path / "fit.json")
    assert fields(Fit.load(path)) == fields(fit)
    assert Law.load(path) == fit.to_law() == Fit.load(path).to_law()
    content = json.loads(path.read_text()) | {"format": "curvafit-fit-4"}
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
    ("thickness", "NaN", "NaN, which is not a finite number"),
    ("coefficients.a00", "-Infinity", "-Infinity, which is not a finite number"),
    ("epsilon_physical", "1e999", "1e999, which is not a finite number"),
    ("working_voxel", "1" * 400, "a number of 400 digits"), ("provenance", "1" * 5000, "a number of 5000 digits"),
    ("provenance", "[" * 100_000 + "]" * 100_000, "nested too deeply"),
    ("provenance", '{"a":' * 100_000, "nested too deeply"), ("provenance", '{"a": 1, "a": 2}', "the key 'a' twice"),
    ("provenance", "{", "which is not JSON"), ("status", None, "status, got none"),
    ("chosen", "3", "chosen as a text, or null, got 3"), ("chosen", '"optimum"', "optimum"),
    ("candidates", "[{}]", "candidates[0].name, got none"),
    ("misfit", '{"probability": 2, "unexplained": 1}', "misfit.probability as a number from 0 to 1, got 2"),
    ("scale", "[1, 1]", "scale as a list of 3 numbers"), ("draws", "[[0.1]]", "draws (n, 7), got (1, 1)"),
    ("draws", "[]", "draws (n, 7)"), ("draws", "[[0.1], [0.1, 2]]", "draws as numbers in rows of one length"),
    ("diagram", '{"points": [[1, 2]], "weights": [1, 1]}', "points (N, 2) and weights (N,), got (1, 2) and (2,)"),
]  # fmt: skip


@pytest.mark.parametrize(("where", "text", "said"), [*BOMBS, *((where, text, where) for where, text in BROKEN)])
def test_one_thing_wrong_is_named(tmp_path: Path, where: str, text: str | None, said: str) -> None:
    assert said in refused(tmp_path / "fit.json", broken(where, text))


def test_content_that_is_no_fit_is_refused(tmp_path: Path, fit: Fit) -> None:
    text, path = made_fit().to_json(), tmp_path / "fit.json"
    for content in (text.replace("tubes", "tübes").encode("latin-1"), text.encode("utf-16")):
        assert "not text in UTF-8" in refused(path, content)
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())  # a byte order mark is none of it
    assert Fit.load(path).mass == made_fit().mass
    content = json.loads(fit.to_json())
    del content["matches"]
    assert "matches, got none" in refused(path, json.dumps(content))
    assert Law.load(path) == fit.to_law()  # a law alone
    for text in ("[]", "7", '"x"', "null", "{}"):
        assert "expected a fit.json written by `curvafit infer` with" in refused(tmp_path / "fit.json", text)
    said = refused(tmp_path / "fit.json", json.dumps({"format": ["x" * 10**6] * 100}))
    assert "expected a fit.json of format curvafit-fit-5, got [" in said


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


LAW = Coefficients(1, 2, 6, -40, -40, 400)
USUAL, ODD = Misfit(0.4, 0.2, 0.5), Misfit(0.001, 0.0005, 0.5)


def law(name: str, distance: float | None = None, noise: float | None = None, status: str = "") -> Candidate:
    return Candidate(name, LAW, -0.6, {"a11": 0.4}, None, distance, noise, status=status)


def twin(diagram: Diagram | None, mass: float) -> Twin:
    if diagram is None:
        return Twin(None, mass, None, None, "the field is of one phase")
    slab = np.where(np.arange(16)[:, None, None] < 6, 1.0, -1.0) * np.ones((16, 16, 16))
    return Twin(slab, mass, diagram, NUMBERS)


# ---- candidates ------------------------------------------------------------------------------------------------------


def test_the_nearest_is_the_best_or_stationarity_within_seed_noise_of_it() -> None:
    barren, first, last = law("match"), law("posterior", 2.5), law("match", 2.25)
    nearest, quiet, single = (law("optimum", 2.0, noise) for noise in (0.5, 0.25, None))
    exact = law("stationarity", 2.5)
    for order, best in (
        ((barren, first, nearest, last), nearest), ((last, nearest, first), nearest), ((barren, first, last), last),
        ((exact, first, nearest), exact), ((exact, first, quiet), quiet), ((exact, single), single),
        ((barren,), None), ((), None),
    ):  # fmt: skip
        assert best_candidate(order) == best


def test_seed_noise_is_the_best_one_s_or_another_s() -> None:
    best, other = law("optimum", 2.0, 0.5), law("match", 5.0, 1.5)
    assert seed_noise_of((other, best)) == 0.5
    assert seed_noise_of((law("posterior", 1.0), other)) == 1.5
    assert seed_noise_of((law("posterior", 1.0), law("optimum"))) is None
    assert seed_noise_of(()) is None


def test_what_grew_is_measured_against_the_scan() -> None:
    """One twin is the scan itself: the mean distance is half the twins' own."""
    scan, other = (Diagram(np.array([point]), np.ones(1)) for point in ((3.0, 1.0), (9.0, -2.0)))
    both = law("match").compare(scan, (twin(scan, -0.5), twin(None, 0.0), twin(other, -0.25)))
    assert both.seed_noise is not None and both.distance == pytest.approx(both.seed_noise / 2) and both.distance > 1
    assert (both.mass, both.twins, both.status) == (-0.375, (NUMBERS, NUMBERS), "")
    assert both.thickness == pytest.approx(6, abs=1)
    three = law("optimum").compare(scan, (twin(scan, -0.5), twin(other, -0.25), twin(other, -0.25)))
    assert three.seed_noise == pytest.approx(2 / 3 * both.seed_noise)  # of three pairs, two differ
    assert three.mass == law("optimum").mass  # as it was read
    over = law("match").compare(scan, (twin(scan, -1.002), twin(scan, -1.001)))
    assert -1 < over.mass < -0.999  # a rare structure's field lies below -1 in the mean, and a fit holds no such mass
    one = law("optimum").compare(scan, (twin(scan, -0.5),))
    assert (one.distance, one.seed_noise, one.twins) == (0.0, None, (NUMBERS,))
    none = law("optimum", status="Hm.").compare(scan, (twin(None, 0.0),))
    assert none == law("optimum", status="Hm. No shape grew: the field is of one phase.")


def test_where_the_middle_grows_nothing_the_next_draw_that_grows_takes_its_place(monkeypatch) -> None:
    scan = Diagram(np.array([(3.0, 1.0)]), np.ones(1))
    others = tuple(dataclasses.replace(law("posterior"), mass=mass) for mass in (-0.5, -0.4, -0.3))
    monkeypatch.setattr(room, "twin", lambda each, *_: twin(scan if each.mass == -0.4 else None, each.mass))
    estimate = Estimate(candidates=(law("posterior"), law("match")), others=others)
    found, twins = room._grow(estimate, scan, cast(Prepared, None), Growth(twins=2), 0, silent)
    assert [each.mass for each in found.candidates] == [-0.4, -0.6] and found.candidates[0].distance == 0
    assert "draw 3" in found.candidates[0].status
    assert {name: len(grown) for name, grown in twins.items()} == {"posterior": 2, "match": 1}


def test_a_candidate_comes_back_from_its_json() -> None:
    whole = dataclasses.replace(law("optimum", 2.0, 0.5, "Hm."), twins=(NUMBERS, NUMBERS))
    for each in (whole, law("match")):
        assert decode(Candidate, json.loads(json.dumps(encode(each)))) == each
    full = dataclasses.replace(whole, twins=(dataclasses.replace(NUMBERS, spacing_mean=math.nan),))
    content = json.loads(json.dumps(encode(full), allow_nan=False))
    assert math.isnan(decode(Candidate, content).twins[0].spacing_mean)


# ---- verdicts --------------------------------------------------------------------------------------------------------


UNLIKE = Misfit(0.002, 0.3, 0.001)
EDGE = dataclasses.replace(USUAL, probability=UNBELIEVABLE)
COARSE = dataclasses.replace(EDGE, grain=0.01)
BARREN = (law("posterior", status="No shape grew: one phase."), law("match"))
THICK = dataclasses.replace(NUMBERS, thickness_mean=1.5 * NUMBERS.thickness_mean)
NEAR, FAR = law("match", 0.9, 0.5), law("match", 9.0, 0.5)
FAT = dataclasses.replace(NEAR, twins=(THICK,))
#: Candidates, their test and whether shapes were grown; the law that is named, and words of the verdict in order.
VERDICTS: list[tuple[tuple[Candidate, ...], Misfit | None, bool, str | None, tuple[str, ...]]] = [
    ((law("optimum"), law("match")), None, False, "optimum", ("Not tested (best fit of the descriptors)",)),
    ((law("optimum"),), USUAL, False, "optimum", ("Not tested", "looks as shapes of laws do (p = 0.40)")),
    ((law("optimum"),), ODD, False, "optimum", ("Not tested", "does not look", "(p = 0.0010)", "need no law")),
    (BARREN, USUAL, True, None, ("No law: nothing grew", "No shape grew: one phase.")),
    ((NEAR,), USUAL, True, "match", ("Supported (nearest match)", "lie 0.9", "0.5 from each other", "p = 0.40")),
    ((law("match", 0.9, status="Hm."),), USUAL, True, "match", ("Supported", "looks as shapes of laws", "Hm.")),
    ((FAR,), EDGE, True, "match", ("Supported",)),  # whatever the distances are
    ((FAR,), COARSE, True, "match", ("Undecided", "p = 0.050", "steps of 0.01")),
    ((law("optimum"),), COARSE, False, "optimum", ("Not tested", "p = 0.050", "steps of 0.01")),
    ((FAR,), None, True, "match", ("Undecided (nearest match)", "lie 9.0", "has no p")),
    ((FAT,), USUAL, True, "match", ("Supported", "Twins over scan: thickness 1.5.")),  # which do not decide
    ((FAT,), ODD, True, "match", ("No believable twin", "Twins over scan: thickness 1.5.")),
    ((law("posterior", 0.1, 0.5), FAR), ODD, True, "posterior", ("No believable twin", "no law explains its numbers")),
    ((law("posterior", 0.1),), UNLIKE, True, "posterior", ("more like textures that no law makes", "curvafit measure")),
]  # fmt: skip


@pytest.mark.parametrize(("candidates", "misfit", "grown", "name", "words"), VERDICTS)
def test_the_test_decides_and_the_verdict_says_what_led_to_it(candidates, misfit, grown, name, words) -> None:
    found, status = verdict(candidates, misfit, NUMBERS, grown=grown)
    assert found == name
    assert re.search(".*".join(map(re.escape, words)), status), status


def test_few_tunnels_may_differ_by_the_root_of_their_count() -> None:
    """Two counts of n differ by some √2n: of 1000 by 45, where 15 % is more; of 100 by 14, of one by some two."""
    for tunnels, ratio, words in (
        (1000, 1.14, []), (1000, 1.17, ["connectivity 1.2"]), (100, 1.29, []), (100, 1.4, ["connectivity 1.4"]),
        (100, 0.74, []), (100, 0.7, ["connectivity 0.70"]), (16, 0.3, ["connectivity 0.30"]),
        (1, 7.0, ["connectivity 7.0"]), (1, 6.0, []),
    ):  # fmt: skip
        scan = dataclasses.replace(NUMBERS, euler=1 - tunnels)
        other = dataclasses.replace(scan, connectivity_density=ratio * scan.connectivity_density)
        assert find_differences(scan, (other,)) == words


def test_familiar_numbers_that_differ_are_named() -> None:
    """Where all twins differ by more than 15 %, the same way; none that the scan does not have."""

    def other(thickness: float, connectivity: float = 1.0) -> Morphometry:
        own, joined = NUMBERS.thickness_mean, NUMBERS.connectivity_density
        return dataclasses.replace(NUMBERS, thickness_mean=thickness * own, connectivity_density=connectivity * joined)

    for scan, twins, words in (
        (NUMBERS, (), []), (NUMBERS, (other(1.14),), []), (NUMBERS, (NUMBERS, other(1.14)), []),
        (NUMBERS, (other(3, 0), other(5, 0)), ["thickness 4.0", "connectivity 0"]),
        (NUMBERS, (NUMBERS, other(3, 0)), []), (NUMBERS, (other(0.5), other(3)), []),
        (NUMBERS, (other(1, -1),), ["connectivity of the other sign"]),
        (other(math.nan), (NUMBERS,), []), (other(1, 0), (NUMBERS,), []),
    ):  # fmt: skip
        assert find_differences(scan, twins) == words
