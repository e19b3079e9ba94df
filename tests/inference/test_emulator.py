"""The emulator on a table whose law is known, the parameters that fit best by it, simulations, sums of parameters."""

from __future__ import annotations

import numpy as np
import pytest
from emulated import BOX, COLUMNS, HIDDEN, HIGH, LOW, NOISE, PLAIN, linear, reading, row, seen, told

from curvafit.geometry.descriptors import BLOCKS
from curvafit.inference.combinations import Combinations, find_combinations
from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.simulate import BATCH, LAST, ROUNDS, Process, Search, Simulate, Simulations, simulate_draws
from curvafit.inference.table import Table
from curvafit.inference.training import PLANS, train_emulator
from curvafit.scan.measure import Reading

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


# ---- simulations chosen one after another ----------------------------------------------------------------------------


#: What the emulator misses of each of the five sums, in deviations of the prior.
MISSED = np.array([0.4, -0.3, 0.3, 0.2, -0.4])
TRUTH = BOX.mean(1) + 0.1 * (HIGH - LOW)
QUERY = row(TRUTH[None])[0]
QUERY[:5] += MISSED


def simulator(barren: float = -np.inf) -> Simulate:
    """Shapes whose sums are off by `MISSED`, in noise; none grows where a11 is below a bound."""

    def simulate(parameters: np.ndarray, seed: int) -> Reading | None:
        if parameters[0] < barren:
            return None
        values = row(parameters[None])[0]
        values[:5] += MISSED + 0.3 * NOISE * np.random.default_rng(seed).standard_normal(5)
        return reading(values)

    return simulate


def searched(simulate: Simulate) -> tuple[np.ndarray, Simulations, np.ndarray]:
    """The parameters, all simulations, and the draws: those of a posterior that the emulator leads astray."""
    rng = np.random.default_rng(0)
    draws = np.clip(TRUTH + (0.1 + 0.15 * rng.standard_normal((400, 6))) * (HIGH - LOW), LOW, HIGH)
    first = simulate_draws(draws, simulate, 12)
    return *Search(linear(), reading(QUERY)).run(draws, first, simulate), draws


def apart(parameters: np.ndarray) -> float:
    """How far what parameters grow lies from the query, in the noise of the emulator."""
    return float(np.sqrt(np.square((told(parameters[None])[0] - told(TRUTH[None])[0]) / NOISE).mean()))


def test_what_the_emulator_misses_is_learnt() -> None:
    parameters, every, draws = searched(simulator())
    assert apart(parameters) < 0.5 * apart(draws.mean(0))
    assert apart(parameters) < 1.5
    assert (parameters >= LOW).all() and (parameters <= HIGH).all()
    assert every.count == len(every.parameters) == 12 + ROUNDS * BATCH + 1
    assert len(set(every.seeds.tolist())) == every.count
    nearest = every.parameters[Search(linear(), reading(QUERY)).nearest(every)[0]]
    assert np.array_equal(searched(simulator())[0], parameters)  # the same seed gives the same
    assert apart(nearest) <= min(map(apart, every.parameters)) + 1.0  # noise is .3


def test_where_nothing_grows_is_avoided() -> None:
    bound = float(TRUTH[0])
    parameters, every, _ = searched(simulator(bound))
    assert len(every.parameters) < every.count
    assert parameters[0] >= bound


def test_the_answer_grows_or_is_the_nearest_that_did() -> None:
    """Nothing grows after the first simulations: the nearest of those is the answer."""
    first = simulate_draws(np.random.default_rng(0).uniform(LOW, HIGH, (400, 6)), simulator(), 12)
    search = Search(linear(), reading(QUERY))
    parameters, every = search.run(first.parameters, first, lambda *_: None)
    assert every.count == 12 + ROUNDS * BATCH + LAST and len(every.parameters) == 12
    assert np.array_equal(parameters, first.parameters[search.nearest(first)[0]])


def test_a_process_passes_through_what_it_is_told() -> None:
    places = np.random.default_rng(1).uniform(-2, 2, (60, 2))
    values = np.stack([np.sin(places[:, 0]), places.sum(1)], 1)
    process = Process.fit(places, values)
    mean, variance = process(places)
    assert np.sqrt(np.square(mean - values).mean()) < np.sqrt(0.05)  # the least noise that is tried
    assert process.length >= 1.0 and process.noise == 0.05
    far = process(np.array([[40.0, 40.0]]))
    assert far[0] == pytest.approx(np.zeros((1, 2)), abs=1e-6)
    assert far[1] == pytest.approx(process.variance + process.noise)
    assert (variance < far[1]).all()


def test_noise_is_told_from_what_varies() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(-2, 2, (60, 2))
    assert Process.fit(places, 0.9 * rng.standard_normal((60, 5))).noise >= 0.4


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
