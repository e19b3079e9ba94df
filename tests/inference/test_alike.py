"""The test of a scan among its twins: how often it rejects what is alike, and what is not."""

from __future__ import annotations

import numpy as np
import pytest

from curvafit.inference.estimate import probability_alike


@pytest.mark.parametrize("windows", [1, 4])
def test_what_is_alike_is_rejected_as_often_as_said(windows: int) -> None:
    """Ranks among 19 twins: 400 values of p at most .05 twenty times, give or take four."""
    random = np.random.default_rng(0)
    p = np.array([probability_alike(*np.split(random.standard_normal((windows + 19, 5)), [windows]), seed=k)
                  for k in range(400)])  # fmt: skip
    assert 0.02 < np.mean(p <= 0.05) < 0.085
    assert np.mean(p <= 0.5) == pytest.approx(0.5, abs=0.08)
    assert p.min() >= 1 / 20 if windows == 1 else p.min() > 0


def test_more_windows_tell_smaller_differences() -> None:
    random, found = np.random.default_rng(1), []
    for windows in (1, 8):
        pairs = ((random.standard_normal((windows, 5)) + 0.9, random.standard_normal((24, 5))) for _ in range(60))
        found.append(np.mean([probability_alike(*pair) <= 0.05 for pair in pairs]))
    assert found[0] < 0.5 < 0.9 < found[1]


def test_the_furthest_of_twenty_has_a_twentieth() -> None:
    twins = np.random.default_rng(2).standard_normal((19, 3))
    assert probability_alike(np.full((1, 3), 9.0), twins) == pytest.approx(1 / 20)
    assert probability_alike(twins.mean(0)[None], twins) == 1
