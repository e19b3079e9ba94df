"""The emulator on a table whose law is known: the best parameters, simulations, the check of a query, and sums."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from emulated import BOX, COLUMNS, HIDDEN, HIGH, LOW, NOISE, PLAIN, linear, reading, row, seen, told
from exact import Gyroid, centres

from curvafit.generation.schedule import LEARNED
from curvafit.geometry.description import BLOCKS
from curvafit.inference import estimate
from curvafit.inference.candidates import Candidate, Misfit, Twin
from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.estimate import STARTS, compare_windows, probability_alike, tail_probability
from curvafit.inference.posterior import Combinations, Posterior
from curvafit.inference.simulate import BATCH, LAST, ROUNDS, Process, Search, Simulate, Simulations, simulate_draws
from curvafit.inference.table import PARAMETERS, Table, column_names
from curvafit.inference.training import PLANS, find_combinations, train_emulator
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.scan.measures import Reading, windows_along
from curvafit.scan.preparation import Prepared, prepare
from curvafit.volumes.volume import Volume

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


# ---- a query among simulations ---------------------------------------------------------------------------------------

NAMES = np.array(column_names())


class Linear:
    """A posterior whose emulator is `linear`, and whose draws lie about the five sums that a row tells."""

    def __init__(self) -> None:
        self.emulator = linear()
        self.compression = self.emulator.compression
        self.misfits = {"mask": np.sort(np.random.default_rng(0).chisquare(1, 400))}
        self.departures = self.discriminant = np.zeros(0)
        self.discriminants = {"mask": np.arange(99.0)}

    def sample(self, rows: np.ndarray, views: np.ndarray, amount: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
        assert set(views) == {"mask"}
        noise = NOISE * np.random.default_rng(seed).standard_normal((len(rows), count, 6))
        sums = self.compression(rows)[:, None]
        half = sums[..., :1] / np.sqrt(2)
        scaled = np.concatenate([half, sums[..., 1:4], half, sums[..., 4:]], 2)
        found = BOX.mean(1) + (scaled + noise) * (HIGH - LOW) / np.sqrt(12)
        return np.concatenate([found, np.zeros((*found.shape[:2], 1))], 2)  # and a thickness

    def discriminate(self, rows: np.ndarray) -> np.ndarray:
        """Fisher's discriminant by one column alone."""
        return rows[:, -1]


POSTERIOR = cast(Posterior, Linear())


def grown(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rows of parameters near the middle, in the noise that the emulator knows; the other blocks are noise alone."""
    rows = row(BOX.mean(1) + 0.1 * rng.standard_normal((count, 6)) * (HIGH - LOW))
    rows[:, :5] += NOISE * rng.standard_normal((count, 5))
    rows[:, 288:] += 0.1 * rng.standard_normal((count, rows.shape[1] - 288))
    return rows


def checked(rows: np.ndarray) -> Misfit:
    """The comparison of the first row, the only window of a scan, with the others."""
    return compare_windows(POSTERIOR, reading(rows[0]), rows[1:])


def test_a_row_of_the_same_law_passes_and_another_does_not() -> None:
    rng = np.random.default_rng(1)
    alike = [checked(grown(rng, 25)) for _ in range(40)]
    assert 0.35 < np.mean([each.probability for each in alike]) < 0.7  # of uniform ones .52 ± .05
    assert np.mean([each.departure or 0 for each in alike]) == pytest.approx(0, abs=0.06)
    rows = grown(rng, 25)
    rows[0, 2] += 5  # beyond the box
    assert checked(rows).probability == pytest.approx(1 / 25)
    assert (checked(rows).departure or 0) > 0.2


def test_a_departure_is_ranked_among_the_models_own() -> None:
    rows, ranked = grown(np.random.default_rng(1), 25), Linear()
    away = checked(rows).departure or 0
    ranked.departures = away + np.array([-0.2, -0.1, 0.1])
    found = compare_windows(cast(Posterior, ranked), reading(rows[0]), rows[1:])
    assert found.probability == pytest.approx(2 / 4)
    assert found.blocks == checked(rows).blocks
    assert found.level_cut is None


@pytest.mark.parametrize(("value", "p"), [(-1.0, 2 / 100), (0.0, 4 / 100), (90.0, 1.0)])
def test_a_scan_that_looks_like_a_level_cut_is_not_believed(value: float, p: float) -> None:
    """As few shapes of the model do: twice the part of those that do so as much, of 99 at 0 to 98."""
    rows, taught = grown(np.random.default_rng(1), 25), Linear()
    taught.discriminant, taught.departures = np.ones(1), np.full(9, 10.0)
    rows[0, -1] = value
    found = compare_windows(cast(Posterior, taught), reading(rows[0]), rows[1:])
    assert found.probability == pytest.approx(p)
    assert found.level_cut == pytest.approx(min(value + 2, 92) / 100)


def test_a_block_that_differs_is_named() -> None:
    rows = grown(np.random.default_rng(2), 25)
    rows[0, NAMES == "gaps"] *= 2
    blocks = checked(rows).blocks
    assert list(blocks) == list(BLOCKS)
    assert blocks["gaps"] == pytest.approx(1 / 25)
    assert min(blocks[name] for name in ("chords", "depths", "clearances", "correlation")) > 1 / 25


LAW = Candidate("match", Coefficients.willmore(), -0.3, {}, 8.0)
BARREN = Twin(None, 0.0, None, None, "one phase")


def gyroid(fill: float, shape: tuple[int, int, int] = (48, 48, 48)) -> Prepared:
    mask = Gyroid(fill).distance(centres(Grid(shape))).numpy() > 0
    return prepare(Volume(mask.astype(np.uint8)), kind="mask", one_scale=True)


def check(prepared: Prepared, monkeypatch: pytest.MonkeyPatch, grow: Callable[..., Twin]) -> Misfit | None:
    """The test of `LAW`, of which `grow` makes each shape."""
    monkeypatch.setattr(estimate, "twin", grow)
    return estimate.check_law(LAW, prepared, estimate.measure_descriptors(prepared), POSTERIOR)


@pytest.mark.slow
def test_shapes_show_as_many_windows_as_the_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "TESTED", 8)
    prepared, lengths = gyroid(0.1, (40, 40, 96)), []
    shown = windows_along(prepared, prepared.mask[prepared.window].shape)
    assert shown == [1, 1, 2]

    def grow(*_: object, longest: int, **__: object) -> Twin:
        lengths.append(longest)
        return replace(BARREN, seen=prepared)

    found = check(prepared, monkeypatch, grow)
    assert lengths == [2 * estimate.EDGE] * (estimate.TESTED // 2)
    assert found is not None and found.method.startswith(f"{estimate.TESTED} windows of shapes of the law, 3 of")


def test_further_shapes_are_tried_where_some_do_not_grow_and_few_test_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = gyroid(0.24)
    tried = iter([BARREN, *[replace(BARREN, seen=prepared)] * 30])
    found = check(prepared, monkeypatch, lambda *_, **__: next(tried))
    assert found is not None and found.method.startswith(f"{estimate.TESTED} windows of shapes of the law")
    assert len(list(tried)) == 30 - estimate.TESTED
    assert check(prepared, monkeypatch, lambda *_, **__: BARREN) is None


def test_a_simulation_that_is_one_ball_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the thickness of the scan's structure the ball's whole box is a few voxels wide: too few to measure."""
    prepared = gyroid(0.1)
    ball = torch.tanh(24 - torch.linalg.vector_norm(torch.cartesian_prod(*[torch.arange(64.0) - 32] * 3), dim=1))
    flow = SimpleNamespace(viability=SimpleNamespace(viable=True), field=ball.reshape(64, 64, 64))
    monkeypatch.setattr(estimate, "generate", lambda *_, **__: flow)
    assert estimate._simulator(prepared, "mask", LEARNED)(BOX.mean(1), 63) is None


def test_without_simulations_the_reference_tells() -> None:
    rows = grown(np.random.default_rng(3), 2)
    rows[1, 2] += 5
    left = misfits(POSTERIOR.emulator, *seen(rows), POSTERIOR.sample(*seen(rows), STARTS)[..., :6])
    assert tail_probability(POSTERIOR.misfits["mask"], left[0]) > 1e-2
    assert tail_probability(POSTERIOR.misfits["mask"], left[1]) == pytest.approx(1 / 401)


def described(parameters: np.ndarray, seed: int) -> Reading | None:
    """Descriptors that hold the parameters and the seed; none of every third seed."""
    values = np.zeros(sum(BLOCKS.values()))
    values[:7] = *parameters, seed
    return None if seed % 3 == 0 else reading(values)


def test_simulations_are_of_draws_each_with_its_seed() -> None:
    draws = np.random.default_rng(5).uniform(LOW, HIGH, (40, 6))
    grown = simulate_draws(draws, described, 9, seed=3)
    assert grown.count == 9
    assert grown.seeds.tolist() == [4, 5, 7, 8, 10, 11]
    assert np.array_equal(grown.columns[0][:, :6], grown.parameters)
    assert np.array_equal(grown.columns[0][:, 6], grown.seeds)
    assert len(np.unique(grown.parameters, axis=0)) == 6
    assert set(map(tuple, grown.parameters)) <= set(map(tuple, draws))
    assert grown.parameters.shape == (6, len(PARAMETERS))


def test_a_number_of_simulations_has_bounds_and_nothing_grown_is_no_row() -> None:
    for count in (0, 41):
        with pytest.raises(ValueError, match="simulations"):
            simulate_draws(np.zeros((40, 6)), described, count)
    grown = simulate_draws(np.zeros((40, 6)), lambda parameters, seed: None, 3)
    assert grown.readings == () and grown.count == 3
    assert len(grown.parameters) == len(grown.seeds) == 0


@pytest.mark.parametrize("windows", [1, 4])
def test_what_is_alike_is_rejected_as_often_as_said(windows: int) -> None:
    """Ranks among 19 twins: 400 values of p at most .05 twenty times, give or take four."""
    random = np.random.default_rng(0)
    p = np.array([probability_alike(*np.split(random.standard_normal((windows + 19, 5)), [windows]), seed=k)
                  for k in range(400)])  # fmt: skip
    assert 0.02 < np.mean(p <= 0.05) < 0.085
    assert np.mean(p <= 0.5) == pytest.approx(0.5, abs=0.08)
    assert p.min() >= 1 / 20 if windows == 1 else p.min() > 0
    twins = random.standard_normal((19, 3))  # of which the furthest of twenty has a twentieth
    assert probability_alike(np.full((1, 3), 9.0), twins) == pytest.approx(1 / 20)
    assert probability_alike(twins.mean(0)[None], twins) == 1


def test_more_windows_tell_smaller_differences() -> None:
    random, found = np.random.default_rng(1), []
    for windows in (1, 8):
        pairs = ((random.standard_normal((windows, 5)) + 0.9, random.standard_normal((24, 5))) for _ in range(60))
        found.append(np.mean([probability_alike(*pair) <= 0.05 for pair in pairs]))
    assert found[0] < 0.5 < 0.9 < found[1]
