"""Combinations of parameters: found where they are known, described by what is made so, read from draws."""

from __future__ import annotations

import numpy as np
import pytest
from emulated import BOX, COLUMNS, HIDDEN, HIGH, LOW, NOISE

from curvafit.geometry.descriptors import BLOCKS
from curvafit.inference.combinations import Combinations, find_combinations

DEVIATION = (HIGH - LOW) / np.sqrt(12)


@pytest.fixture(scope="module")
def found() -> Combinations:
    """Laws of which the difference of a11 and a00 is not told, and a10 only half; m0 makes shapes full."""
    random = np.random.default_rng(0)
    scaled = random.uniform(-np.sqrt(3), np.sqrt(3), (2000, 6))
    noise = NOISE * random.standard_normal((2000, 6))
    noise[:, 2] = 0.5 * random.standard_normal(2000)
    noise += (1 - NOISE) * random.standard_normal((2000, 1)) * HIDDEN
    columns = np.ones((2000, COLUMNS))
    start = dict(zip(BLOCKS, np.cumsum([0, *BLOCKS.values()]), strict=False))
    columns[:, start["fraction"]] = np.exp(0.3 * scaled[:, 5])
    columns[:, start["densities"] : start["densities"] + 3] *= random.uniform(1, 2, (2000, 3))
    columns[:, start["depths"] + 8] += random.uniform(0, 1, 2000)
    columns[:, start["clearances"] + 8] += random.uniform(0, 1, 2000)
    return find_combinations(noise * DEVIATION, BOX.mean(1) + scaled * DEVIATION, columns)


def test_what_is_not_told_comes_last(found: Combinations) -> None:
    last = found.weights[-1] * DEVIATION
    assert abs(last @ HIDDEN) == pytest.approx(1, abs=0.05)
    assert abs(found.weights[-2, 2] * DEVIATION[2]) == pytest.approx(1, abs=0.05)


def test_sums_are_uncorrelated_and_of_deviation_one(found: Combinations) -> None:
    laws = BOX.mean(1) + DEVIATION * np.random.default_rng(1).uniform(-np.sqrt(3), np.sqrt(3), (4000, 6))
    assert np.cov(found(laws).T) == pytest.approx(np.eye(6), abs=0.12)


def test_ends_are_described_by_what_is_made_so(found: Combinations) -> None:
    mass = int(np.abs(found.weights[:, 5] * DEVIATION[5]).argmax())
    low, high = found.ends[mass]
    assert ("sparse" in low, "full" in high) == (True, True)
    assert found.ends[-2:] == (("", ""), ("", ""))  # of a10, and of a difference of which no look tells


def test_draws_tell_what_they_hold(found: Combinations) -> None:
    """Draws that leave the hidden difference open, and all else at one deviation."""
    random = np.random.default_rng(2)
    wanted = np.array([1.0, 1, 1, 1, 1, 0]) + np.array([0.1] * 5 + [1.0]) * random.standard_normal((4000, 6))
    read = found.read(found.centre + wanted @ np.linalg.inv(found.weights).T)
    assert [each.known for each in read] == pytest.approx([0.99] * 5 + [0.0], abs=0.05)
    for each in read[:5]:
        assert (each.median, *each.interval) == pytest.approx((1, 0.836, 1.164), abs=0.03)
    assert "not known" in str(read[-1])
    assert "not known" not in str(read[0])
