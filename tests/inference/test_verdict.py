"""Which candidate is the best, and what is said of it: each sentence by the numbers that lead to it."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from found import NUMBERS

from curvafit.core.schema import decode, encode
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.candidates import Candidate, Misfit, Twin, best_candidate, seed_noise_of
from curvafit.inference.verdict import UNBELIEVABLE, find_differences, verdict
from curvafit.priors.coefficients import Coefficients

LAW = Coefficients(1, 2, 6, -40, -40, 400)
USUAL = Misfit(0.4, {"gaps": 0.3, "chords": 0.2}, "24 windows", 1.1)
ODD = Misfit(0.001, {"gaps": 0.004, "chords": 0.3, "depths": 0.0005}, "24 windows", 3.0)


def law(name: str, distance: float | None = None, noise: float | None = None, status: str = "") -> Candidate:
    return Candidate(name, LAW, -0.6, {"a11": 0.4}, None, distance, noise, status=status)


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


BARE = dataclasses.replace(ODD, blocks={"gaps": 0.3})
QUICK = [dataclasses.replace(each, departure=None) for each in (USUAL, ODD)]
EDGE = dataclasses.replace(USUAL, probability=UNBELIEVABLE)
BARREN = (law("posterior", status="No shape grew: one phase."), law("match"))
THICK = dataclasses.replace(NUMBERS, thickness_mean=1.5 * NUMBERS.thickness_mean)
NEAR, FAR = law("match", 0.9, 0.5), law("match", 9.0, 0.5)
FAT = dataclasses.replace(NEAR, twins=(THICK,))
#: Candidates, their test and whether nothing was grown; the law that is named, and words of the verdict in order.
VERDICTS: list[tuple[tuple[Candidate, ...], Misfit | None, bool, str | None, tuple[str, ...]]] = [
    ((law("optimum"), law("match")), None, True, "optimum", ("Nothing was grown",)),
    ((law("optimum"),), QUICK[0], True, "optimum", ("does not rule this law out (p = 0.40)", "Nothing was grown")),
    ((law("optimum"),), QUICK[1], True, "optimum", ("rules this law out (p = 0.0010)", "Nothing was grown")),
    (BARREN, USUAL, False, None, ("No law: nothing grew", "No shape grew: one phase.")),
    ((NEAR,), USUAL, False, "match", ("Supported (nearest match)", "lie 0.9", "0.5 from each other", "p = 0.40")),
    ((law("match", 0.9, status="Hm."),), USUAL, False, "match", ("Supported", "look like the scan", "Hm.")),
    ((FAR,), EDGE, False, "match", ("Supported",)),  # whatever the distances are
    ((FAR,), None, False, "match", ("Undecided (nearest match)", "lie 9.0", "was not tested")),
    ((FAT,), USUAL, False, "match", ("Supported", "Twins over scan: thickness 1.5.")),  # which do not decide
    ((FAT,), ODD, False, "match", ("No believable twin", "Twins over scan: thickness 1.5.")),
    ((law("simulation", 0.1, 0.5), FAR), ODD, False, "simulation", ("No believable twin", "depths, gaps.")),
    ((law("simulation", 0.1),), BARE, False, "simulation", ("no descriptor tells it alone",)),
    ((law("simulation", 0.1),), dataclasses.replace(BARE, level_cut=0.01), False, "simulation", ("level cut",)),
    ((law("simulation", 0.1),), dataclasses.replace(ODD, blocks={"fabric": 0.001}), False, "simulation",
     ("has a direction (fabric)",)),
]  # fmt: skip


@pytest.mark.parametrize(("candidates", "misfit", "fast", "name", "words"), VERDICTS)
def test_the_test_decides_and_the_verdict_says_what_led_to_it(candidates, misfit, fast, name, words) -> None:
    found, status = verdict(candidates, misfit, NUMBERS, fast=fast)
    assert found == name
    assert re.search(".*".join(map(re.escape, words)), status), status


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

    def other(thickness: float, connectivity: float = 1.0) -> Morphometry:
        own, joined = NUMBERS.thickness_mean, NUMBERS.connectivity_density
        return dataclasses.replace(NUMBERS, thickness_mean=thickness * own, connectivity_density=connectivity * joined)

    for scan, twins, words in (
        (NUMBERS, (), []),
        (NUMBERS, (other(1.14),), []),
        (NUMBERS, (NUMBERS, other(1.14)), []),
        (NUMBERS, (other(3, 0), other(5, 0)), ["thickness 4.0", "connectivity 0"]),
        (NUMBERS, (NUMBERS, other(3, 0)), []),
        (NUMBERS, (other(0.5), other(3)), []),
        (NUMBERS, (other(1, -1),), ["connectivity of the other sign"]),
        (other(math.nan), (NUMBERS,), []),
        (other(1, 0), (NUMBERS,), []),
    ):
        assert find_differences(scan, twins) == words
