"""Probabilities between known slices, how well they are calibrated, and the slices to annotate next."""

from collections.abc import Callable

import numpy as np
import pytest
from annotated import ball
from scipy.ndimage import gaussian_filter

import curvafit.segmentation.uncertainty as room
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import harmonic_distance
from curvafit.segmentation.uncertainty import calibration_error, probability

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


def test_the_reach_is_that_of_both_sides_and_a_new_slice_lowers_that_of_its_gap_alone() -> None:
    np.testing.assert_allclose(harmonic_distance([1, 5], 8), [1, 0, 3 / 4, 1, 3 / 4, 0, 1, 2])
    np.testing.assert_allclose(harmonic_distance([2], 4), [2, 1, 0, 1])
    before, after = harmonic_distance([0, 8, 16], 20), harmonic_distance([0, 3, 8, 16], 20)
    assert (after[1:8] < before[1:8]).all() and np.array_equal(after[8:], before[8:])


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
    inside, noise = rng.random(len(p)) < p, np.sqrt(room.BINS / len(p)) / 2
    assert calibration_error(p, inside) < 5 * noise
    overconfident = probability(np.column_stack([np.zeros(len(p)), np.log(p / (1 - p))]), np.array([0.0, 2.0, 0.0]))
    gap = float(np.abs(overconfident - p).mean())
    assert abs(calibration_error(overconfident, inside) - gap) < 5 * noise + 1 / room.BINS  # p varies so within a bin


def test_the_weights_are_those_by_which_labels_were_drawn_and_end() -> None:
    """The error of the likeliest weights has the inverse Fisher information for its covariance; what is always right
    has weights too."""
    rng = np.random.default_rng(1)
    weights = np.array([0.5, 2.0, -0.7])
    signs = np.column_stack([2 * rng.normal(size=40_000), rng.normal(size=40_000)])
    p = probability(signs, weights)
    inside = rng.random(len(p)) < p
    columns = np.column_stack([signs, np.ones(len(p))])
    noise = np.sqrt(np.diag(np.linalg.inv(columns.T @ (columns * (p * (1 - p))[:, None]))))
    found = room.fit_weights(signs, inside)
    assert (np.abs(found - weights) < 5 * noise).all()
    other = room.fit_weights(-signs, ~inside)  # what is inside is named outside
    assert other == pytest.approx(found * [1, 1, -1], rel=1e-4)
    signs = np.repeat([[-3.0, -4.0], [3.0, 4.0]], 50, axis=0)
    weights = room.fit_weights(signs, signs[:, 0] > 0)
    assert np.isfinite(weights).all()
    assert calibration_error(probability(signs, weights), signs[:, 0] > 0) < 1e-3


def test_near_is_within_three_voxels_and_certainty_has_no_entropy() -> None:
    mask = np.zeros((20, 4, 4), dtype=bool)
    mask[10:] = True
    assert room.near_surface(mask)[:, 0, 0].nonzero()[0].tolist() == [7, 8, 9, 10, 11, 12]
    assert not any(room.near_surface(np.full((4, 4, 4), value)).any() for value in (False, True))
    assert room.entropy(np.array([0.0, 1.0, 0.5], dtype=np.float32)) == pytest.approx([0, 0, np.log(2)])


def test_the_interval_of_the_known_slices_holds_the_volume() -> None:
    """Of 60 thresholded noises, fine to coarse, every 4th to 16th slice known; and 20 balls."""
    shapes: list[np.ndarray] = []
    for seed in range(60):
        noise = gaussian_filter(np.random.default_rng(seed).standard_normal((97, 32, 32)), (2, 4, 8)[seed % 3])
        shapes.append((noise > np.quantile(noise, (0.7, 0.9)[seed % 2])).mean((1, 2)))
    z = np.arange(97)
    shapes += [np.clip(r**2 - (z - 45.3 - k % 7) ** 2, 0, None) / 4e3 for k, r in enumerate(np.linspace(9, 30, 20))]
    held, wide = [], []
    for k, areas in enumerate(shapes):
        every = (4, 8, 16)[k // 6 % 3]
        known, low, high = room.share_by_slices(areas[::every], range(0, 97, every), 97)
        held.append(low <= areas.mean() <= high)
        wide.append((high - low) / 2 / known)
    # of 80 intervals of 95 %, 71 or more hold with a probability of .98; wider ones hold more often
    assert np.mean(held) >= 71 / 80 and np.median(wide) < 0.2


def test_the_volume_by_known_slices_is_that_of_what_is_filled() -> None:
    flat = room.share_by_slices(np.full(4, 0.3), [6, 10, 14, 18], 40)
    assert flat == pytest.approx((0.3 * 17 / 40,) * 3)  # slices 4 to 20
    assert room.share_by_slices(np.full(4, 0.3), [6, 10, 14, 18], 40, whole=True) == pytest.approx((0.3,) * 3)
    assert room.share_by_slices(np.array([0.0, 1.0]), [0, 4], 5) == pytest.approx((0.5,))  # no interval of two


def test_a_mask_that_is_no_estimate_of_a_volume_is_told() -> None:
    """A pattern that lies elsewhere in each slice: the known ones all have the same share, which the mask misses."""
    random = np.random.default_rng(0)
    pattern = gaussian_filter(random.standard_normal((40, 40)), 2, mode="wrap") > 0
    truth = np.stack([np.roll(pattern, random.integers(0, 40, 2), (0, 1)) for _ in range(17)]).astype(np.uint8)
    found = reconstruct(truth, every=8)
    known, low, high = found.uncertainty.known_share  # type: ignore[union-attr]
    assert low == pytest.approx(known) == pytest.approx(high) == pytest.approx(pattern.mean())
    assert any("volume" in note for note in found.notes) and f"{100 * known:.2f} %" in found.status
    ball_found = reconstruct(ball(33).astype(np.uint8), every=4)
    assert not any("volume" in note for note in ball_found.notes)


def test_the_best_threshold_has_the_best_expected_dice() -> None:
    p = np.random.default_rng(0).beta(0.3, 1.0, 5000)

    def expected(least: float) -> float:
        return 2 * p[p > least].sum() / ((p > least).sum() + p.sum())

    found = room.best_threshold(room.count_probabilities(p))
    assert expected(found) > max(expected(least) for least in np.linspace(0, 0.5, 101)) - 1e-4
    assert found == pytest.approx(expected(found) / 2, abs=0.01)


def test_a_reconstruction_says_how_sure_it_is_and_where_to_annotate() -> None:
    mask = ball(24, 8.0).transpose(1, 2, 0)
    found = reconstruct(mask, every=5, axis=2, suggest=2)
    assert found.probability is not None and found.uncertainty is not None
    values = found.probability.values
    assert values.dtype == np.float32 and values.min() >= 0 and values.max() <= 1
    assert np.array_equal(values[:, :, ::5], mask[:, :, ::5])
    unsure = room.entropy(values).sum((0, 1))
    assert unsure[::5].max() == 0 and unsure[[7, 12, 17]].min() > 0
    following = found.uncertainty.suggestions
    assert len(following) == 2 and all(n % 5 for n in following)
    assert found.status.endswith(f"annotate next: {following[0]}, {following[1]}")
    left = reconstruct(ball(24, 8.0), known=[n for n in range(24) if not 6 < n < 11], suggest=1)
    assert left.uncertainty is not None and 6 < left.uncertainty.suggestions[0] < 11


ENTROPIES = np.random.default_rng(2).uniform(1, 5, 40)
PLACES = [0, 7, 20, 22, 39]


def test_suggestions_are_unknown_slices_in_any_order_of_the_known_and_mirrored() -> None:
    found = room.suggest_slices(ENTROPIES, PLACES, 6)
    assert len(set(found)) == 6 and not set(found) & set(PLACES)
    assert room.suggest_slices(ENTROPIES, PLACES[::-1], 6) == found
    assert room.suggest_slices(ENTROPIES, PLACES, 3) == found[:3]
    mirrored = room.suggest_slices(ENTROPIES[::-1], [39 - n for n in PLACES], 6)
    assert tuple(39 - n for n in mirrored) == found
    assert room.suggest_slices(np.zeros(10), [0, 9], 3) == () and room.suggest_slices(np.ones(4), [0, 1, 2], 3) == (3,)


def test_each_suggestion_lowers_the_entropy() -> None:
    left, places = ENTROPIES.copy(), list(PLACES)
    left[places] = 0
    for new in room.suggest_slices(left, PLACES, 5):
        after = room.remaining_entropy(left, places, new)
        assert (after <= left).all() and after[new] == 0 and after.sum() < left.sum()
        others = [room.remaining_entropy(left, places, n).sum() for n in range(40) if n not in places]
        assert after.sum() == min(others)
        left, places = after, [*places, new]


@pytest.mark.parametrize("fill", [reconstruct, reconstruct_labels])
def test_the_least_certain_slices_lie_between_known_ones(fill: Callable) -> None:
    """A ball's slices beyond the last known one are guesses, but no slice to look at."""
    found = fill(ball(33).astype(np.uint8), known=[8, 16, 24]).uncertainty
    beyond = found.probability.values[25:]
    assert ((beyond > 0.1) & (beyond < 0.9)).any()
    assert found.entropies[0].nonzero()[0].tolist() == [*range(9, 16), *range(17, 24)]


def test_an_even_gap_is_halved_and_the_most_uncertain_comes_first() -> None:
    flat = np.ones(33)
    flat[[0, 16, 32]] = 0
    assert sorted(room.suggest_slices(flat, [0, 16, 32], 2)) == [8, 24]
    flat[17:32] *= 2
    assert room.suggest_slices(flat, [0, 16, 32], 1) == (24,)


def test_the_temperature_is_that_by_which_labels_were_drawn() -> None:
    random = np.random.default_rng(0)
    logits = 3 * random.standard_normal(60_000)
    labels = random.random(60_000) < 1 / (1 + np.exp(-logits / 1.7))
    assert room.fit_temperature(logits, labels) == pytest.approx(1.7, rel=0.05)
    assert room.fit_temperature(np.array([50.0]), np.array([1.0])) == 1


def test_the_expected_dice_is_that_of_truths_that_are_drawn() -> None:
    random = np.random.default_rng(0)
    likely = random.beta(0.5, 1.5, 40_000)
    mask = likely > room.best_threshold(room.count_probabilities(likely))
    drawn = [random.random(likely.shape) < likely for _ in range(20)]
    found = [2 * (truth & mask).sum() / (truth.sum() + mask.sum()) for truth in drawn]
    assert room.expected_dice(likely, mask) == pytest.approx(np.mean(found), abs=2e-3)
