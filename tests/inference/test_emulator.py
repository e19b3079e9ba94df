"""The emulator on a table whose law is known, and the parameters that fit best by it."""

from __future__ import annotations

import numpy as np
import pytest
from emulated import BOX, HIDDEN, HIGH, LOW, NOISE, PLAIN, linear, reading, row, seen, told

from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.table import Table
from curvafit.inference.training import PLANS, train_emulator


def test_the_best_parameters_are_the_true_ones_but_for_what_is_not_told() -> None:
    truth = np.array([[1.0, 0.5, 60.0, -80.0, 500.0, -0.5]])
    starts = np.random.default_rng(0).uniform(LOW, HIGH, (8, 6))
    best, covariance = best_parameters(linear(), reading(row(truth)[0]), starts)
    assert told(best[None]) == pytest.approx(told(truth), abs=0.03)  # the prior pulls by a hundredth
    for start in starts:
        single, _ = best_parameters(linear(), reading(row(truth)[0]), start[None])
        assert told(single[None]) == pytest.approx(told(best[None]), abs=1e-2)
    scale = (HIGH - LOW) / np.sqrt(12)
    known = np.linalg.inv(covariance / np.outer(scale, scale)) - np.eye(6)
    assert np.linalg.eigvalsh(known) == pytest.approx([0, 100, 100, 100, 100, 100], abs=1e-3)
    assert known @ HIDDEN == pytest.approx(0, abs=1e-3)
    deviation = np.sqrt(np.diag(covariance)) / ((HIGH - LOW) / np.sqrt(12))
    assert deviation == pytest.approx([0.71, 0.1, 0.1, 0.1, 0.71, 0.1], abs=0.01)


def test_what_no_parameters_make_is_left_over() -> None:
    """Outside the box by three deviations of the prior, in noise of a tenth of one."""
    inside = row(np.zeros((1, 6)) + BOX.mean(1))
    outside = inside.copy()
    outside[0, 2] += 5
    starts = np.tile(BOX.mean(1), (2, 8, 1))
    left = misfits(linear(), *seen(np.concatenate([inside, outside])), starts)
    assert left[0] < 0.1
    assert left[1] > (3 / NOISE) ** 2


def test_slopes_are_exact() -> None:
    emulator, at = linear(), np.random.default_rng(1).uniform(LOW, HIGH, (3, 6))
    step = 1e-4 * emulator.deviation
    for k in range(6):
        ends = [emulator(at + sign * step * np.eye(6)[k], *seen(at)[1:]).mean for sign in (-1, 1)]
        slope = emulator.slopes(at, *seen(at)[1:])[..., k]
        assert slope == pytest.approx((ends[1] - ends[0]) / 2e-4 / NOISE, abs=1e-4)


@pytest.mark.slow
def test_training_finds_mean_deviation_and_correlation() -> None:
    """A table in which components are `told`, in noise of which the first two share half."""
    rng = np.random.default_rng(0)
    plan = PLANS[1]._replace(epochs=25)
    parameters = rng.uniform(LOW, HIGH, (600, 6))
    shared = rng.standard_normal((600, 1))
    noise = 0.3 * rng.standard_normal((600, 5))
    noise[:, :2] = 0.3 * (shared + rng.standard_normal((600, 2))) / np.sqrt(2)
    descriptors = row(parameters)
    descriptors[:, :5] += noise
    names, (_, views, amount) = np.array([f"s/{i}" for i in range(600)]), seen(descriptors)
    table = Table(names, views, parameters, np.full(600, 8.0), descriptors, amount, {})
    emulator, left = train_emulator(table, PLAIN, BOX, plan=plan)
    fresh = rng.uniform(LOW, HIGH, (200, 6))
    emulated = emulator(fresh, *seen(fresh)[1:])
    assert np.square(emulated.mean - told(fresh)).mean() < 0.2 * 0.3**2  # what 600 noisy rows leave of five lines
    mixing = np.linalg.inv(emulator.basis)
    covariance = np.einsum("ij,nj,kj->nik", mixing, emulated.deviation**2, mixing).mean(0)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(0.3, rel=0.15)
    assert covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) == pytest.approx(0.5, abs=0.12)
    assert 0.8 < emulator.inflation < 1.5
    assert left["mask"].mean() == pytest.approx(1, abs=0.3)  # five equations for six parameters, in a box


def test_views_that_it_does_not_know_are_refused() -> None:
    with pytest.raises(ValueError, match="scan"):
        linear()(BOX.mean(1), *seen(BOX.mean(1)[None], "scan")[1:])
