"""Simulations of draws, and the check of a query among them, on descriptors whose law is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from emulated import BOX, HIGH, LOW, NOISE, linear, reading, row, seen, told
from exact import Gyroid, centres

from curvafit.generation.schedule import LEARNED
from curvafit.geometry.descriptors import BLOCKS
from curvafit.inference import estimate
from curvafit.inference.candidates import Candidate, Misfit, Twin
from curvafit.inference.emulator import misfits
from curvafit.inference.estimate import STARTS, compare_windows, probability_alike, tail_probability
from curvafit.inference.posterior import Posterior
from curvafit.inference.simulate import simulate_draws
from curvafit.inference.table import PARAMETERS, column_names
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.scan.measure import Reading, windows_along
from curvafit.scan.prepare import Prepared, prepare
from curvafit.volumes.field import Field

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
        scaled = np.concatenate(
            [sums[..., :1] / np.sqrt(2), sums[..., 1:4], sums[..., :1] / np.sqrt(2), sums[..., 4:]], 2
        )
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
    return prepare(Field(mask.astype(np.uint8)), kind="mask", one_scale=True)


def check(prepared: Prepared, monkeypatch: pytest.MonkeyPatch, grow: Callable[..., Twin]) -> Misfit | None:
    """The test of `LAW`, of which `grow` makes each shape."""
    monkeypatch.setattr(estimate, "twin", grow)
    return estimate.check_law(LAW, prepared, estimate.measure_descriptors(prepared), POSTERIOR)


def test_shapes_show_as_many_windows_as_the_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared, lengths = gyroid(0.1, (40, 40, 96)), []
    shown = windows_along(prepared, prepared.mask[prepared.windows[0]].shape)
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


def test_told_is_what_the_emulator_says() -> None:
    parameters = np.random.default_rng(6).uniform(LOW, HIGH, (3, 6))
    assert POSTERIOR.emulator(parameters, *seen(parameters)[1:]).mean == pytest.approx(told(parameters))


# ---- the test among twins --------------------------------------------------------------------------------------------


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
