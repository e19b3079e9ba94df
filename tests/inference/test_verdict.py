"""Which candidate is the best, and what is said of it: each sentence by the numbers that lead to it."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from found import NUMBERS, made_fit

from curvafit.core.schema import decode, encode
from curvafit.geometry.diagram import Diagram
from curvafit.inference.candidates import Candidate, Misfit, Twin, best_candidate, seed_noise_of
from curvafit.inference.verdict import UNBELIEVABLE, find_differences, verdict
from curvafit.priors.coefficients import Coefficients

LAW = Coefficients(1, 2, 6, -40, -40, 400)
USUAL = Misfit(0.4, {"gaps": 0.3, "chords": 0.2}, "24 windows", 1.1)
ODD = Misfit(0.001, {"gaps": 0.004, "chords": 0.3, "depths": 0.0005}, "24 windows", 3.0)


def law(name: str, distance: float | None = None, noise: float | None = None, status: str = "") -> Candidate:
    return Candidate(name, LAW, -0.6, {"a11": 0.4}, None, distance, noise, status=status)


def judge(candidates: tuple[Candidate, ...], misfit: Misfit | None, fast: bool = False) -> tuple[str | None, str]:
    """The verdict on a scan of the familiar `NUMBERS`."""
    return verdict(dataclasses.replace(made_fit(), candidates=candidates, misfit=misfit), fast=fast)


def twin(diagram: Diagram | None, mass: float) -> Twin:
    if diagram is None:
        return Twin(None, mass, None, None, "the field is of one phase")
    slab = np.where(np.arange(16)[:, None, None] < 6, 1.0, -1.0) * np.ones((16, 16, 16))
    return Twin(slab, mass, diagram, NUMBERS)


# ---- candidates ------------------------------------------------------------------------------------------------------


def test_the_nearest_is_the_best_or_stationarity_within_seed_noise_of_it() -> None:
    barren, first, last = law("optimum"), law("posterior", 2.5), law("match", 2.25)
    nearest, quiet, single = (law("simulation", 2.0, noise) for noise in (0.5, 0.25, None))
    exact = law("stationarity", 2.5)
    for order, best in (
        ((barren, first, nearest, last), nearest),
        ((last, nearest, first), nearest),
        ((barren, first, last), last),
        ((exact, first, nearest), exact),
        ((exact, first, quiet), quiet),
        ((exact, single), single),
        ((barren,), None),
        ((), None),
    ):
        assert best_candidate(order) == best


def test_seed_noise_is_the_best_one_s_or_another_s() -> None:
    best, other = law("simulation", 2.0, 0.5), law("match", 5.0, 1.5)
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
    three = law("simulation").compare(scan, (twin(scan, -0.5), twin(other, -0.25), twin(other, -0.25)))
    assert three.seed_noise == pytest.approx(2 / 3 * both.seed_noise)  # of three pairs, two differ
    assert three.mass == law("simulation").mass  # as it was read
    over = law("match").compare(scan, (twin(scan, -1.002), twin(scan, -1.001)))
    assert -1 < over.mass < -0.999  # a rare structure's field lies below -1 in the mean, and a fit holds no such mass
    one = law("simulation").compare(scan, (twin(scan, -0.5),))
    assert (one.distance, one.seed_noise, one.twins) == (0.0, None, (NUMBERS,))
    none = law("simulation", status="Hm.").compare(scan, (twin(None, 0.0),))
    assert none == law("simulation", status="Hm. No shape grew: the field is of one phase.")


def test_a_candidate_comes_back_from_its_json() -> None:
    whole = dataclasses.replace(law("simulation", 2.0, 0.5, "Hm."), twins=(NUMBERS, NUMBERS))
    for each in (whole, law("match")):
        assert decode(Candidate, json.loads(json.dumps(encode(each)))) == each
    full = dataclasses.replace(whole, twins=(dataclasses.replace(NUMBERS, spacing_mean=math.nan),))
    content = json.loads(json.dumps(encode(full), allow_nan=False))
    assert math.isnan(decode(Candidate, content).twins[0].spacing_mean)


# ---- verdicts --------------------------------------------------------------------------------------------------------


def test_without_growing_the_first_is_named_and_not_checked() -> None:
    said = "Nothing was grown to check the law (--fast)."
    assert judge((law("optimum"), law("match")), None, fast=True) == ("optimum", said)
    unusual = "A quick reading rules this law out (p = 0.0010)."
    odd, usual = (dataclasses.replace(each, departure=None) for each in (ODD, USUAL))
    assert judge((law("optimum"),), odd, fast=True) == ("optimum", f"{unusual} {said}")
    passed = "A quick reading does not rule this law out (p = 0.40)."
    assert judge((law("optimum"),), usual, fast=True) == ("optimum", f"{passed} {said}")


def test_where_nothing_grew_there_is_no_law() -> None:
    why = "No shape grew: the field is of one phase."
    name, status = judge((law("posterior", status=why), law("match")), USUAL)
    assert name is None and status == f"No law: nothing grew from any candidate. {why}"


def test_the_nearest_is_supported_where_its_twins_are_near() -> None:
    """As the test says, whatever the distances are."""
    usual = "Shapes of this law look like the scan (p = 0.40)."
    near = "Supported (nearest match): its twins lie 0.9 from the scan's curvature diagram"
    assert judge((law("match", 0.9, 0.5),), USUAL) == ("match", f"{near}, 0.5 from each other. {usual}")
    assert judge((law("match", 0.9, status="Hm."),), USUAL) == ("match", f"{near}. {usual} Hm.")
    far = law("match", 9.0, 0.5)
    assert judge((far,), dataclasses.replace(USUAL, probability=UNBELIEVABLE))[1].startswith("Supported")
    untested = "Undecided (nearest match): its twins lie 9.0 from the scan's curvature diagram, 0.5 from each other."
    assert judge((far,), None) == ("match", f"{untested} The law was not tested.")


def test_familiar_numbers_explain_and_do_not_decide() -> None:
    thick = dataclasses.replace(NUMBERS, thickness_mean=1.5 * NUMBERS.thickness_mean)
    other = dataclasses.replace(law("match", 0.9, 0.5), twins=(thick,))
    for misfit, word in ((USUAL, "Supported"), (ODD, "No believable twin")):
        _, status = judge((other,), misfit)
        assert status.startswith(f"{word} (nearest match): ") and status.endswith("Twins over scan: thickness 1.5.")


def test_a_far_or_strange_one_is_named_but_not_believed() -> None:
    name, status = judge((law("simulation", 0.1, 0.5), law("match", 9.0)), ODD)
    assert name == "simulation" and status.startswith("No believable twin (nearest of the simulations): ")
    assert status.endswith(
        "0.5 from each other. Shapes of this law do not look like the scan (p = 0.0010); "
        "what differs most: depths, gaps."
    )
    single = dataclasses.replace(ODD, blocks={"gaps": 0.3})
    assert judge((law("simulation", 0.1),), single)[1].endswith("(p = 0.0010); no descriptor tells it alone.")
    random = dataclasses.replace(single, level_cut=0.01)
    assert judge((law("simulation", 0.1),), random)[1].endswith(
        "It looks more like a level cut of a random field, which no law made."
    )
    aligned = dataclasses.replace(ODD, blocks={"fabric": 0.001})
    direction = "The scan has a direction (fabric), and the model has none."
    assert judge((law("simulation", 0.1),), aligned)[1].endswith(direction)


def test_few_tunnels_may_differ_by_the_root_of_their_count() -> None:
    """Two counts of n differ by some √2n: of 1000 by 45, where 15 % is more; of 100 by 14, of one by some two."""
    for tunnels, ratio, words in (
        (1000, 1.14, []),
        (1000, 1.17, ["connectivity 1.2"]),
        (100, 1.29, []),
        (100, 1.4, ["connectivity 1.4"]),
        (100, 0.74, []),
        (100, 0.7, ["connectivity 0.70"]),
        (16, 0.3, ["connectivity 0.30"]),
        (1, 7.0, ["connectivity 7.0"]),
        (1, 6.0, []),
    ):
        scan = dataclasses.replace(NUMBERS, euler=1 - tunnels)
        other = dataclasses.replace(scan, connectivity_density=ratio * scan.connectivity_density)
        assert find_differences(scan, (other,)) == words


def test_familiar_numbers_that_differ_are_named() -> None:
    """Where all twins differ by more than 15 %, the same way; none that the scan does not have."""
    near = dataclasses.replace(NUMBERS, thickness_mean=1.14 * NUMBERS.thickness_mean)
    assert (
        find_differences(NUMBERS, (NUMBERS, near))
        == find_differences(NUMBERS, (near,))
        == find_differences(NUMBERS, ())
        == []
    )
    far = dataclasses.replace(NUMBERS, thickness_mean=3 * NUMBERS.thickness_mean, connectivity_density=0.0)
    further = dataclasses.replace(far, thickness_mean=5 * NUMBERS.thickness_mean)
    assert find_differences(NUMBERS, (far, further)) == ["thickness 4.0", "connectivity 0"]
    assert find_differences(NUMBERS, (NUMBERS, far)) == []
    thin = dataclasses.replace(NUMBERS, thickness_mean=0.5 * NUMBERS.thickness_mean)
    assert (
        find_differences(NUMBERS, (thin, dataclasses.replace(far, connectivity_density=NUMBERS.connectivity_density)))
        == []
    )
    pieces = dataclasses.replace(NUMBERS, connectivity_density=-NUMBERS.connectivity_density)
    assert find_differences(NUMBERS, (pieces,)) == ["connectivity of the other sign"]
    assert find_differences(dataclasses.replace(NUMBERS, thickness_mean=math.nan), (NUMBERS,)) == []
    assert find_differences(dataclasses.replace(NUMBERS, connectivity_density=0.0), (NUMBERS,)) == []
