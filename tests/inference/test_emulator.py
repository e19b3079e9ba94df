"""The emulator on a table whose law is known: the best parameters, the test of a scan, and sums."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from emulated import BOX, COLUMNS, HIDDEN, HIGH, LOW, NOISE, PLAIN, linear, reading, row, seen, told
from scripts import example

from curvafit.geometry.description import BLOCKS
from curvafit.inference.candidates import Misfit
from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.estimate import Described, measure_misfit, tail_probability
from curvafit.inference.posterior import Combinations, Discriminant, Posterior
from curvafit.scan.preparation import Prepared
from curvafit.scan.quality import Quality

training = example("train")
PLANS, Table, find_combinations = training.PLANS, training.Table, training.find_combinations
keep_laws, train_emulator = training.keep_laws, training.train_emulator
DEVIATION = (HIGH - LOW) / np.sqrt(12)


def test_the_best_parameters_are_the_true_ones_but_for_what_is_not_told() -> None:
    truth = np.array([[1.0, 0.5, 60.0, -80.0, 500.0, -0.5]])
    starts = np.random.default_rng(0).uniform(LOW, HIGH, (8, 6))
    best, covariance = best_parameters(linear(), reading(row(truth)[0]), starts)
    assert told(best[None]) == pytest.approx(told(truth), abs=0.03)  # the prior pulls by a hundredth
    for start in starts:
        single, _ = best_parameters(linear(), reading(row(truth)[0]), start[None])
        assert told(single[None]) == pytest.approx(told(best[None]), abs=1e-2)
    known = np.linalg.inv(covariance / np.outer(DEVIATION, DEVIATION)) - np.eye(6)
    assert np.linalg.eigvalsh(known) == pytest.approx([0, 100, 100, 100, 100, 100], abs=1e-3)
    assert known @ HIDDEN == pytest.approx(0, abs=1e-3)
    deviation = np.sqrt(np.diag(covariance)) / DEVIATION
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
    assert emulator(at, *seen(at)[1:]).mean == pytest.approx(told(at))
    for k in range(6):
        ends = [emulator(at + sign * step * np.eye(6)[k], *seen(at)[1:]).mean for sign in (-1, 1)]
        slope = training.find_slopes(emulator, at, *seen(at)[1:])[..., k]
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
    assert left["mask"].mean() == pytest.approx(1, abs=0.5)  # five equations for six parameters, in a box
    kept = keep_laws(table, 0)
    assert kept.sum() == len(left["mask"]) == 60 and not np.array_equal(kept, keep_laws(table, 1))


def test_views_that_it_does_not_know_are_refused() -> None:
    with pytest.raises(ValueError, match="scan"):
        linear()(BOX.mean(1), *seen(BOX.mean(1)[None], "scan")[1:])


# ---- combinations of parameters --------------------------------------------------------------------------------------


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


def test_sums_are_uncorrelated_and_what_is_not_told_comes_last(found: Combinations) -> None:
    last = found.weights[-1] * DEVIATION
    assert abs(last @ HIDDEN) == pytest.approx(1, abs=0.05)
    assert abs(found.weights[-2, 2] * DEVIATION[2]) == pytest.approx(1, abs=0.05)
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


# ---- a scan among shapes of the model --------------------------------------------------------------------------------


class Linear:
    """A posterior whose emulator is `linear`, its discriminant the last column alone: shapes have 0 to 98."""

    def __init__(self, *views: str) -> None:
        self.emulator = linear()
        self.misfits = {"mask": np.sort(np.random.default_rng(0).chisquare(1, 400))}
        self.discriminants = dict.fromkeys(views, Discriminant(np.ones(1), np.arange(99.0)))

    def discriminate(self, rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return rows[:, -1] * weights


def ask(rows: np.ndarray, *views: str) -> Misfit:
    """The misfit of one row of descriptors, by a posterior with a discriminant in some views."""
    return measure_misfit(shown(rows), cast(Posterior, Linear(*views)), np.tile(BOX.mean(1), (8, 1))) or Misfit(0, 0)


def shown(rows: np.ndarray, quality: Quality | None = None) -> Described:
    """One row of descriptors as those of a mask, or of an image of some quality."""
    return Described(cast(Prepared, SimpleNamespace(quality=quality)), reading(rows[0]), False)


def draw_row(seed: int) -> np.ndarray:
    """Descriptors of parameters near the middle, in the noise that the emulator knows."""
    rng = np.random.default_rng(seed)
    rows = row(BOX.mean(1) + 0.1 * rng.standard_normal((1, 6)) * (HIGH - LOW))
    rows[:, :5] += NOISE * rng.standard_normal((1, 5))
    return rows


def test_what_no_parameters_explain_is_not_believed() -> None:
    alike = [ask(draw_row(seed)) for seed in range(20)]
    assert all(found.discriminant is None and found.grain == 1 / 401 for found in alike)
    assert np.mean([found.probability for found in alike]) > 0.3
    rows = draw_row(0)
    rows[0, 2] += 5  # beyond the box
    assert ask(rows) == Misfit(1 / 401, 1 / 401, None, 1 / 401)


@pytest.mark.parametrize(("value", "p"), [(-1.0, 2 / 100), (0.0, 4 / 100), (90.0, 1.0)])
def test_a_scan_that_looks_like_other_textures_is_not_believed(value: float, p: float) -> None:
    """As few shapes of the model do: twice the part of those that do so as much, of 99 at 0 to 98."""
    rows = draw_row(3)
    rows[0, -1] = value
    found = ask(rows, "mask")
    assert found.discriminant == pytest.approx(min(value + 2, 92) / 100) and found.grain == 2 / 100
    assert found.probability == pytest.approx(min(p, 2 * found.unexplained, 1.0))
    assert ask(rows, "scan").discriminant is None


def test_an_image_noisier_than_all_that_taught_is_not_tested() -> None:
    """The noise is over the contrast of the phases."""
    for noise, tested in ((0.3, True), (0.31, False)):
        described = shown(draw_row(0), Quality(1.0, noise, 0.0, 0.0, (1.0, 1.0, 1.0)))
        found = measure_misfit(described, cast(Posterior, Linear()), np.tile(BOX.mean(1), (8, 1)))
        assert (found is not None) == tested


def test_ranks_count_the_scan_itself() -> None:
    assert tail_probability(np.arange(9.0), 9.0) == 1 / 10
    assert tail_probability(np.arange(9.0), 4.0) == 6 / 10
    assert tail_probability(np.zeros(0), 1.0) == 1
