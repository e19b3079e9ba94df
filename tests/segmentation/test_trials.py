"""The choice of a law and its weight by masks that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from curvafit.priors.coefficients import Coefficients
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.segment import FIRST, NATS, calibrate
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.trials import Task, Trial, choose_by_masks, search
from curvafit.volumes.field import ScanError

WILLMORE = Coefficients.willmore()


def ball(n: int = 48) -> np.ndarray:
    return np.linalg.norm(np.mgrid[:n, :n, :n] - (n - 1) / 2, axis=0) < n / 3


def every_twelfth(mask: np.ndarray) -> Slices:
    places = tuple(range(0, len(mask), 12))
    return Slices(mask[list(places)], places, len(mask), (1.0, 1.0, 1.0))


def decided(better: np.ndarray) -> Trial:
    """The choice between an interpolation of a ball and a prior that fills with `better`."""
    mask, slices = ball(), every_twelfth(ball())
    between = [n for n in range(36) if n % 12]

    def filled(given: Slices, setting: Trial) -> np.ndarray:
        return given.level("spline") > 0 if setting.law is None else better

    return choose_by_masks(Task(slices, mask[between], between), [Trial(WILLMORE, 1.0, 1)], filled)


def test_a_prior_is_taken_where_it_is_better_only() -> None:
    best = decided(ball())
    assert best.law is WILLMORE and best.score == 1 > best.plain
    plain = decided(np.zeros((48, 48, 48), dtype=bool))
    assert plain.law is None and plain.score == 0 and plain.plain == best.plain
    same = decided(every_twelfth(ball()).level("spline") > 0)
    assert same.law is None and same.noise == 0


def test_a_gain_within_the_noise_is_none() -> None:
    """A single voxel is one tile's gain: as large as its standard error, (T - 1) / T of it being the jackknife's."""
    start = every_twelfth(ball()).level("spline") > 0
    wrong = np.argwhere(start != ball())
    wrong = wrong[(wrong[:, 0] < 36) & (wrong[:, 0] % 12 > 0)]
    better = start.copy()
    better[tuple(wrong[0])] ^= True
    best = decided(better)
    assert best.law is None and best.score > best.plain


def test_a_climb_ends_at_the_best_on_either_side() -> None:
    for heights, first, best in (([5, 1, 2, 3, 4], 2, 4), ([5, 4, 3, 1, 9], 2, 0), ([1, 2, 1], 1, 1), ([7], 0, 0)):
        found = search([Trial(None, first)], range(len(heights)), lambda trial, h=heights: h[int(trial.strength)])
        assert found.strength == best


def test_strengths_are_tried_as_long_as_they_are_better() -> None:
    truth, tried = ball(26), []

    def fill(given: None, setting: Trial) -> np.ndarray:
        tried.append(setting)
        wrong = 1 if setting.law is None else 1 - 0.1 * [*NATS].index(setting.strength)
        return truth & (np.random.default_rng(0).random(truth.shape) > 0.3 * wrong)

    other = WILLMORE.scale(2)
    settings = [Trial(law, FIRST, 1) for law in (WILLMORE, other)]
    best = choose_by_masks(Task(None, truth, range(len(truth))), settings, fill, NATS)
    assert (best.law, best.strength) == (WILLMORE, NATS[-1]) and len(tried) == len(set(tried))
    assert {setting.strength for setting in tried if setting.law is WILLMORE} == {3.0, *NATS[NATS.index(FIRST) :]}
    assert [setting.strength for setting in tried if setting.law is other] == [FIRST, NATS[-1]]


def test_errors_side_by_side_are_one() -> None:
    """Counts of one cube have no error that is known: 16 voxels in a row are one observation, not sixteen."""
    truth = np.ones((16, 16, 32), dtype=bool)
    half = np.arange(32) < 16

    def fill(given: None, setting: Trial) -> np.ndarray:
        return truth if setting.law is None else truth & half

    best = choose_by_masks(Task(None, truth, range(16)), [Trial(WILLMORE, 1.0, 1)], fill)
    assert best.noise == pytest.approx(math.sqrt(1 / 4))  # without the one cube 0, without the other -1


def test_the_part_that_is_tried_is_where_the_surface_is() -> None:
    inside = np.zeros((30, 150, 90), dtype=bool)
    inside[:, 100:140, 5:25] = np.random.default_rng(0).random((30, 40, 20)) < 0.5
    z, y, x = box_with_most_surface(inside, (64,) * 3)
    assert (z.start, z.stop) == (0, 30) and y.stop - y.start == x.stop - x.start == 64
    assert y.start <= 100 and y.stop >= 140 and x.start <= 5 and x.stop <= 90


def test_a_flow_that_fails_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise ScanError("expected an energy that stays finite")

    monkeypatch.setattr("curvafit.segmentation.tiles.lower_energy", failing)
    found = calibrate(0.2 + 0.6 * ball(20), ball(20), WILLMORE, steps=1)
    assert found.trial.law is None and (found.trial.score, found.trial.plain) == (0, 1)
