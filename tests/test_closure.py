"""What the closure benchmarks compare with: the null, the synthetic likelihood, the literal loss; and their figures."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from found import made_fit
from scipy import ndimage

from benchmarks import closure_laws as laws
from benchmarks.closure_regrown import against, apart, chosen, deviations, mean_of_grown, quartiles
from benchmarks.closure_trials import COUNT, NUMBERS, Job, Trial, proceed
from benchmarks.closure_verdicts import figures
from benchmarks.level_cut import cut_covariance, gaussian_spectrum, level_cut
from curvafit.inference.misfit import Misfit
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import law_of
from curvafit.priors.energy import energy
from curvafit.priors.grid import WORKING_EPSILON, Grid

GRID = Grid((32, 32, 32))


@pytest.fixture(scope="module")
def blobs() -> np.ndarray:
    """A mask that repeats, itself a level cut of smooth noise, a quarter of the volume."""
    noise = np.random.default_rng(0).standard_normal(GRID.shape)
    smooth = ndimage.gaussian_filter(noise, 3.0, mode="wrap")
    return smooth > np.quantile(smooth, 0.75)


# ---- the null --------------------------------------------------------------------------------------------------------


def test_the_covariance_of_cuts_is_the_arcsine_law() -> None:
    covariance, correlation = cut_covariance(0.0)
    assert covariance == pytest.approx(np.arcsin(correlation) / (2 * np.pi), abs=1e-12)


def test_the_covariance_of_a_cut_with_itself_is_its_variance() -> None:
    covariance, correlation = cut_covariance(1.0)
    part = 0.15865525393145707
    assert correlation[-1] == pytest.approx(1)
    assert covariance[-1] == pytest.approx(part * (1 - part), rel=1e-6)


def test_a_null_fills_as_much_as_its_shape_and_seeds_differ(blobs: np.ndarray) -> None:
    first, second = (level_cut(blobs, GRID, seed) for seed in (1, 2))
    for cut in (first, second):
        assert (cut > 0).mean() == pytest.approx(blobs.mean(), abs=1.5 / blobs.size)
    assert not np.array_equal(first > 0, second > 0)


def test_the_spectrum_has_the_two_point_function_of_its_shape(blobs: np.ndarray) -> None:
    """Along the axes, of a shape that is itself a cut: to 0.05 of its variance, as the means over the three axes of so
    small a box have standard errors of 0.02 to 0.08 (four seeds; 0.01 to 0.04 are missed)."""
    part = blobs.mean()
    covariance = np.fft.ifftn(np.abs(np.fft.fftn(blobs - part)) ** 2).real / blobs.size / (part * (1 - part))
    told, correlation = cut_covariance(0.6744897501960817)
    gaussian = np.fft.ifftn(gaussian_spectrum(blobs)).real
    cut = np.interp(gaussian / gaussian[0, 0, 0], correlation, told) / (part * (1 - part))
    lines = [(values[:9, 0, 0] + values[0, :9, 0] + values[0, 0, :9]) / 3 for values in (covariance, cut)]
    assert lines[1] == pytest.approx(lines[0], abs=0.05)


# ---- methods ---------------------------------------------------------------------------------------------------------


def test_the_synthetic_likelihood_prefers_the_right_law() -> None:
    rng = np.random.default_rng(0)
    near, far = rng.normal(0, 1, (8, 12)), rng.normal(0, 1, (8, 12)) + 3
    norms = [np.arange(6), np.arange(6, 12)]
    for centre, right in ((0.0, 0), (3.0, 1)):
        scores = laws.synthetic_scores(rng.normal(centre, 1, 12), [near, far], norms)
        assert int(np.argmax(scores)) == right


def test_the_synthetic_likelihood_tells_laws_by_how_far_their_shapes_lie_apart() -> None:
    """Laws of one mean: a shape far from it is of the one whose shapes scatter."""
    rng = np.random.default_rng(1)
    clouds = [rng.normal(0, width, (8, 12)) for width in (0.2, 2.0)]
    norms = [np.arange(12)]
    for width, right in ((0.2, 0), (2.0, 1)):
        scores = laws.synthetic_scores(rng.normal(0, width, 12), clouds, norms)
        assert int(np.argmax(scores)) == right


def test_a_law_that_hardly_grows_is_not_chosen() -> None:
    rng = np.random.default_rng(2)
    few, many = np.zeros((2, 4)), rng.normal(5, 1, (6, 4))
    scores = laws.synthetic_scores(np.zeros(4), [few, many], [np.arange(4)])
    assert scores[0] == -np.inf and np.isfinite(scores[1])


def test_the_literal_loss_is_least_in_a_corner() -> None:
    z, y, x = np.meshgrid(*3 * [np.arange(24) - 11.5], indexing="ij")
    ball = np.tanh((8 - np.sqrt(z**2 + y**2 + x**2)) / (2 * np.sqrt(2))).astype(np.float32)
    grid, posterior = Grid(ball.shape), load_posterior()
    seen = laws.sight(ball, grid, "field", 0)
    assert seen is not None
    corner = laws.literal(laws.Query(seen, np.zeros(6), posterior, (), seen.seen.grid))
    low, high = posterior.box.T
    assert np.isin(corner[:-1], [low[:-1], high[:-1]]).all()
    others = np.random.default_rng(0).uniform(low, high, (20, 6))
    losses = [float(energy(seen.phase.double(), law_of(each)[0], grid, WORKING_EPSILON)) for each in (corner, *others)]
    assert losses[0] == min(losses)


# ---- figures ---------------------------------------------------------------------------------------------------------


def test_ratios_count_what_did_not_grow_as_infinite() -> None:
    mine = {1: 1.0, 2: 3.0, 3: 2.0, 4: np.inf, 5: np.inf, 6: 9.0}
    floor, null = {1: 1.0, 2: 2.0, 3: 1.0, 4: 1.0, 5: 1.0}, {1: 3.0, 2: 2.5, 3: 2.5, 4: 3.0, 5: 3.0, 6: 10.0}
    assert against(mine, floor, null) == pytest.approx([2.0, 1.5, np.inf, 2 / 5])
    assert quartiles(np.array([3.0, np.inf, 1.0, 2.0])) == pytest.approx([2.5, 1.5, np.inf])
    assert mean_of_grown(np.array([1.0, np.inf, 3.0])) == 2 and mean_of_grown(np.array([np.inf])) == np.inf


def test_a_law_is_chosen_by_one_shape_and_judged_by_the_other() -> None:
    numbers = np.zeros((2, COUNT))
    near, far = (Trial(np.full(6, d), np.array([d, 10 - d]), numbers) for d in (1.0, 2.0))
    trials = chosen({"posterior": {0: far, 1: far}, "optimum": {0: near, 1: far}, "match": {0: far}})
    assert set(trials) == {0}
    assert trials[0].parameters[0] == 1 and trials[0].distances == pytest.approx([9.0])


def test_numbers_are_compared_in_deviations_between_seeds() -> None:
    rng = np.random.default_rng(0)
    families = [mean + 0.5 * rng.standard_normal((40, COUNT)) for mean in (0.0, 10.0)]
    deviation = deviations([*families, np.full((2, COUNT), np.nan)])
    assert deviation == pytest.approx(np.full(COUNT, 0.5), rel=0.3)  # 78 degrees of freedom: 8 %
    one = np.zeros(COUNT)
    distances = apart(one, np.stack([deviation, 2 * deviation, np.full(COUNT, np.nan)]), deviation)
    assert distances == pytest.approx([1, 2, np.inf])


def test_a_kind_of_numbers_counts_as_much_as_another() -> None:
    kinds = np.cumsum([0, *(count for count, _ in NUMBERS.values())])
    for first, last in itertools.pairwise(kinds):
        moved = np.zeros((1, COUNT))
        moved[0, first:last] = 1
        assert apart(np.zeros(COUNT), moved, np.ones(COUNT)) == pytest.approx([np.sqrt(1 / len(NUMBERS))])


def test_seeds_that_never_differ_have_the_least_deviation() -> None:
    least = np.concatenate([np.full(count, low) for count, low in NUMBERS.values()])
    assert deviations([np.ones((3, COUNT))]) == pytest.approx(least)


def test_a_run_goes_on_where_it_was(tmp_path: Path) -> None:
    calls: list[int] = []

    def make(k: int) -> dict[str, np.ndarray]:
        calls.append(k)
        return {"values": np.array([k])}

    jobs = [Job(tmp_path / f"{k}.npz", lambda k=k: make(k)) for k in range(3)]
    assert proceed(jobs, -1) == 3 and not calls
    assert proceed(jobs[:2], 1) == 0 and proceed(jobs, 1) == 0
    assert calls == [0, 1, 2]
    assert np.load(tmp_path / "2.npz")["values"] == 2


def test_false_alarms_are_counted_among_what_was_measured() -> None:
    """The fits by hand are judged anew: `made_fit`'s twins are near, those of its true law far or the scan's own."""
    fit, true = made_fit(), made_fit().candidates[1]
    odd = dataclasses.replace(fit, misfit=Misfit(0.001, {}, ""))
    far = dataclasses.replace(true, distance=9.0, seed_noise=1.0)
    answers = [
        {"fit": each.to_json(), "truth": law.as_dict(), "seconds": seconds}
        for each, law, seconds in ((odd, far, 10.0), (fit, dataclasses.replace(far, distance=1.0), 20.0))
    ]
    row = figures([*answers, {"refused": "too thin"}], False).split()
    assert row[:8] == ["3", "1", "0.50", "0.00", "0.00", "0.00", "0.00", "0.50"]
    assert row[8] == "1.45" and row[11:] == ["0.50", "15"]  # 1.6 / 1.1
    row = figures([{**each, "fit": fit.to_json()} for each in answers], True).split()
    assert row[:8] == ["2", "0", "0.50", "0.00", "0.00", "0.00", "0.50", "0.00"] and row[8] == "5.00"
