"""Parameters by simulations chosen one after another, with an emulator that is wrong by a known amount."""

from __future__ import annotations

import numpy as np
import pytest
from emulated import BOX, HIGH, LOW, NOISE, linear, reading, row, told

from curvafit.inference.simulate import BATCH, LAST, ROUNDS, Process, Search, Simulate, Simulations, simulate_draws
from curvafit.scan.measure import Reading

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
    assert apart(nearest) <= min(map(apart, every.parameters)) + 1.0  # noise is .3


def test_the_same_seed_gives_the_same_parameters() -> None:
    assert np.array_equal(searched(simulator())[0], searched(simulator())[0])


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
