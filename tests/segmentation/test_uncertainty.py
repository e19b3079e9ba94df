"""Probabilities between known slices, how well they are calibrated, and the slices to annotate next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from found import made_fit

from curvafit.inference.fit import Draws
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.engine import draw_laws
from curvafit.segmentation.examples import grow_task
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.slices import Slices, harmonic_distance
from curvafit.segmentation.trials import Task, Trial
from curvafit.segmentation.uncertainty import (
    BINS,
    RUNS,
    calibration_error,
    entropy,
    estimate_probability,
    fit_weights,
    near_surface,
    probability,
    remaining_entropy,
    suggest_slices,
    vote_evidence,
)
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
EDGES = (1.0, 1.0, 1.0)


def ball(n: int = 32, radius: float = 10.0) -> np.ndarray:
    return np.linalg.norm(np.mgrid[:n, :n, :n] - (n - 1) / 2, axis=0) < radius


def known(mask: np.ndarray, places: list[int], *, periodic: bool = False) -> Slices:
    return Slices(mask[places], tuple(places), len(mask), EDGES, periodic=periodic)


# ---- harmonic distance -----------------------------------------------------------------------------------------------


def test_the_reach_is_that_of_both_sides() -> None:
    np.testing.assert_allclose(harmonic_distance([1, 5], 8), [1, 0, 3 / 4, 1, 3 / 4, 0, 1, 2])
    np.testing.assert_allclose(harmonic_distance([1, 5], 8, periodic=True), [3 / 4, 0, 3 / 4, 1, 3 / 4, 0, 3 / 4, 1])
    np.testing.assert_allclose(harmonic_distance([2], 4, periodic=True), [1, 3 / 4, 0, 3 / 4])


def test_a_new_slice_lowers_the_reach_of_its_gap_alone() -> None:
    before, after = harmonic_distance([0, 8, 16], 20), harmonic_distance([0, 3, 8, 16], 20)
    assert (after[1:8] < before[1:8]).all() and np.array_equal(after[8:], before[8:])


# ---- calibration -----------------------------------------------------------------------------------------------------


def test_the_calibration_error_is_exact_where_shares_are() -> None:
    p, inside = np.repeat([0.25, 0.75], 8), np.array([1, 1, 0, 0, 0, 0, 0, 0] + [1] * 6 + [0, 0], dtype=bool)
    assert calibration_error(p, inside) == 0
    assert calibration_error(p, np.zeros(16, dtype=bool)) == 0.5
    assert calibration_error(np.array([0.0, 1.0]), np.array([False, True])) == 0
    assert calibration_error(np.empty(0), np.empty(0, dtype=bool)) == 0


def test_labels_drawn_by_their_probability_are_calibrated() -> None:
    """The excess of a bin of n voxels has a deviation of at most √n / 2; their sum over bins is largest at equal n."""
    rng = np.random.default_rng(0)
    p = rng.random(100_000)
    inside, noise = rng.random(len(p)) < p, np.sqrt(BINS / len(p)) / 2
    assert calibration_error(p, inside) < 5 * noise
    overconfident = probability(vote_evidence(np.zeros(len(p)), 1, np.log(p / (1 - p))), np.array([0.0, 2.0, 0.0]))
    gap = float(np.abs(overconfident - p).mean())
    assert abs(calibration_error(overconfident, inside) - gap) < 5 * noise + 1 / BINS  # within a bin p varies by 1 / 15


def test_the_weights_are_those_by_which_labels_were_drawn() -> None:
    """The error of the likeliest weights has the inverse Fisher information for its covariance."""
    rng = np.random.default_rng(1)
    votes, depth, weights = rng.integers(0, 9, 40_000), rng.normal(size=40_000), np.array([0.5, 2.0, -0.7])
    signs = vote_evidence(votes, 8, depth)
    p = probability(signs, weights)
    inside = rng.random(len(p)) < p
    columns = np.column_stack([signs, np.ones(len(p))])
    noise = np.sqrt(np.diag(np.linalg.inv(columns.T @ (columns * (p * (1 - p))[:, None]))))
    found = fit_weights(signs, inside)
    assert (np.abs(found - weights) < 5 * noise).all()
    other = fit_weights(-signs, ~inside)  # what is inside is named outside
    assert other == pytest.approx(found * [1, 1, -1], rel=1e-4)


def test_evidence_has_no_side() -> None:
    votes, depth = np.arange(9), np.linspace(-2, 2, 9)
    np.testing.assert_allclose(vote_evidence(8 - votes, 8, -depth), -vote_evidence(votes, 8, depth), atol=1e-12)


def test_what_is_always_right_gets_weights_that_end() -> None:
    votes = np.repeat([0, 8], 50)
    weights = fit_weights(vote_evidence(votes, 8, votes - 4.0), votes > 4)
    assert np.isfinite(weights).all()
    assert calibration_error(probability(vote_evidence(votes, 8, votes - 4.0), weights), votes > 4) < 1e-3


def test_the_entropy_of_certainty_is_none() -> None:
    assert entropy(np.array([0.0, 1.0])).tolist() == [0, 0]
    assert entropy(np.array([0.5], dtype=np.float32))[0] == pytest.approx(np.log(2))


def test_near_is_within_three_voxels() -> None:
    mask = np.zeros((20, 4, 4), dtype=bool)
    mask[10:] = True
    assert near_surface(mask)[:, 0, 0].nonzero()[0].tolist() == [7, 8, 9, 10, 11, 12]
    assert (
        not near_surface(np.zeros((4, 4, 4), dtype=bool)).any()
        and not near_surface(np.ones((4, 4, 4), dtype=bool)).any()
    )


# ---- runs ------------------------------------------------------------------------------------------------------------


def still(slices: Slices, setting: Trial, start: np.ndarray, progress) -> tuple[np.ndarray, float]:
    """A flow that forgets where it starts: the interpolation itself."""
    return np.tanh(slices.level(setting.way) / np.sqrt(8)), 2.0


def moved(slices: Slices, setting: Trial, start: np.ndarray, progress) -> tuple[np.ndarray, float]:
    """A flow that stays where it starts."""
    return np.tanh(start / np.sqrt(8)), 2.0


def task(mask: np.ndarray, places: list[int], *, periodic: bool = False) -> Task:
    rest = [n for n in range(len(mask)) if n not in places]
    return Task(known(mask, places, periodic=periodic), mask[rest], rest)


def test_a_mirrored_volume_has_mirrored_probabilities() -> None:
    mask, places = ball() | np.roll(ball(radius=5), 9, 0), [0, 6, 12, 15, 24, 31]
    mirrored = sorted(31 - n for n in places)
    one = estimate_probability(
        task(mask, places), known(mask, places), Trial("spline"), [None], 2, level=Slices.level, flow=still
    )
    turned = task(mask[::-1], mirrored), known(mask[::-1], mirrored)
    other = estimate_probability(*turned, Trial("spline"), [None], 2, level=Slices.level, flow=still)
    np.testing.assert_allclose(other.values[::-1], one.values, atol=1e-3)
    assert other.error == pytest.approx(one.error, abs=1e-3)


def test_runs_disagree_between_known_slices_alone() -> None:
    mask, places = ball(), [0, 8, 16, 24, 31]
    same = task(mask, places), known(mask, places)
    odds = estimate_probability(*same, Trial("spline"), [None], RUNS, level=Slices.level, flow=moved)
    assert np.array_equal(odds.values[places], mask[places])
    assert odds.values.min() >= 0 and odds.values.max() <= 1
    unsure = entropy(odds.values).sum((1, 2))
    assert unsure[places].max() == 0 and unsure[[4, 12, 20]].min() > 0


def test_a_grown_task_has_the_volume_s_slices() -> None:
    slices = known(ball(), [0, 5, 10, 31])
    same = grow_task(slices, WILLMORE, None)
    assert same.given.places == slices.places and same.given.length == 32
    assert [*same.places] == [n for n in range(32) if n not in slices.places]
    assert same.truth.shape == (28, 32, 32) and same.given.inside.any() and not same.given.inside.all()


def test_a_law_of_which_no_shape_grows_is_refused() -> None:
    """Of two voxels in a thousand no flow makes a shape."""
    mask = np.zeros((16, 32, 32), dtype=bool)
    mask[:, :1, :2] = True
    with pytest.raises(ValueError, match="grows"):
        grow_task(known(mask, [0, 8, 15]), WILLMORE, None)


# ---- reconstruct -----------------------------------------------------------------------------------------------------


def test_a_reconstruction_with_runs() -> None:
    """Along the last axis, with an example; the mask is that without runs."""
    mask, example = ball(24, 8.0), ball(24, 7.0)
    options = {"every": 5, "axis": 2, "example": example, "steps": 3}
    found = reconstruct(mask.transpose(1, 2, 0), WILLMORE, runs=2, suggest=2, **options)
    plain = reconstruct(mask.transpose(1, 2, 0), WILLMORE, **options)
    assert np.array_equal(found.mask.values, plain.mask.values) and plain.probability is None
    assert found.probability is not None and found.uncertainty is not None
    values = found.probability.values
    assert values.dtype == np.float32 and values.min() >= 0 and values.max() <= 1
    assert np.array_equal(values[:, :, ::5], mask.transpose(1, 2, 0)[:, :, ::5])
    following = found.uncertainty.suggestions
    assert len(following) == 2 and all(n % 5 for n in following)
    assert found.uncertainty.seeds == (0, 1)
    assert found.status.endswith(f"on the example; annotate next: {following[0]}, {following[1]}")


def test_a_gap_that_is_left_is_suggested() -> None:
    mask = ball(24, 8.0)
    places = [n for n in range(24) if not 6 < n < 11]
    found = reconstruct(mask, WILLMORE, known=places, stiffness=1e7, steps=2, suggest=1)
    assert found.uncertainty is not None and 6 < found.uncertainty.suggestions[0] < 11
    assert len(found.uncertainty.seeds) == RUNS and any(f"{RUNS} are made" in note for note in found.notes)
    assert "on a shape of the law" in found.status


@pytest.mark.parametrize(("options", "word"), [({"runs": -1}, "runs"), ({"suggest": 29}, "slices")])
def test_numbers_out_of_range_are_refused(options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        reconstruct(ball(), WILLMORE, every=8, **options)


def test_draws_are_laws_in_the_scan_s_unit(tmp_path: Path) -> None:
    fit, scan = made_fit(), Field(ball(), (0.0195,) * 3, "mm")
    rows = np.column_stack([np.arange(1.0, 6), np.ones(5), *np.zeros((4, 5))])
    fit = replace(fit, draws=Draws(rows, "mask", "by hand"))
    laws = draw_laws(fit, scan, 3)
    assert [law.a11 for law in laws] == [1, 3, 5] and all(law.a20 == 1 for law in laws)
    linear = replace(fit, draws=Draws(rows + np.eye(6)[2], "mask", "by hand"))
    assert draw_laws(linear, scan, 1)[0].a10 == pytest.approx(1 / fit.length)
    path = tmp_path / "fit.json"
    path.write_text(fit.to_json())
    assert [law.as_dict() for law in draw_laws(path, scan, 3)] == [law.as_dict() for law in laws]
    none = replace(fit, draws=None)
    for prior in ("tubes", WILLMORE, none):
        assert draw_laws(prior, scan, 3) == ()


# ---- suggestions -----------------------------------------------------------------------------------------------------

ENTROPIES = np.random.default_rng(2).uniform(1, 5, 40)
PLACES = [0, 7, 20, 22, 39]


def test_suggestions_are_unknown_slices_in_any_order_of_the_known() -> None:
    found = suggest_slices(ENTROPIES, PLACES, 6)
    assert len(set(found)) == 6 and not set(found) & set(PLACES)
    assert suggest_slices(ENTROPIES, PLACES[::-1], 6) == found
    assert suggest_slices(ENTROPIES, PLACES, 3) == found[:3]


def test_a_mirrored_volume_has_mirrored_suggestions() -> None:
    mirrored = suggest_slices(ENTROPIES[::-1], [39 - n for n in PLACES], 6)
    assert tuple(39 - n for n in mirrored) == suggest_slices(ENTROPIES, PLACES, 6)


@pytest.mark.parametrize("periodic", [False, True])
def test_each_suggestion_lowers_the_entropy(periodic: bool) -> None:
    left, places = ENTROPIES.copy(), list(PLACES)
    left[places] = 0
    for new in suggest_slices(left, PLACES, 5, periodic):
        after = remaining_entropy(left, places, new, periodic)
        assert (after <= left).all() and after[new] == 0 and after.sum() < left.sum()
        others = [remaining_entropy(left, places, n, periodic).sum() for n in range(40) if n not in places]
        assert after.sum() == min(others)
        left, places = after, [*places, new]


def test_an_even_gap_is_halved_and_the_most_uncertain_comes_first() -> None:
    flat = np.ones(33)
    flat[[0, 16, 32]] = 0
    assert sorted(suggest_slices(flat, [0, 16, 32], 2)) == [8, 24]
    flat[17:32] *= 2
    assert suggest_slices(flat, [0, 16, 32], 1) == (24,)


def test_where_nothing_is_open_nothing_is_suggested() -> None:
    assert suggest_slices(np.zeros(10), [0, 9], 3) == ()
    assert suggest_slices(np.ones(4), [0, 1, 2], 3) == (3,)
