"""The choice of a law and its weight: by masks that are known, and by voxels left out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

import curvafit.segmentation.trials as room
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.evidence import Classes, estimate_classes, grey_levels
from curvafit.segmentation.refine import FIRST, NATS
from curvafit.segmentation.segment import segment
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.trials import (
    EDGE,
    TIMES,
    WEIGHTS,
    Judge,
    Task,
    Trial,
    block_edge,
    choose_by_masks,
    choose_by_voxels,
    hold_out_masks,
    measure_classes,
    predict_sides,
    search,
)
from curvafit.volumes.field import Field, ScanError

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
#: Of this law a tube as thick as those below is at rest: nearly none pays for bending along it.
TUBE = Coefficients(1.0, 0.0, 1.0, -1.0, 0.0, 0.25)


# ---- by masks that are known -----------------------------------------------------------------------------------------


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


# ---- by voxels left out ----------------------------------------------------------------------------------------------


def tubes(n: int = 32) -> np.ndarray:
    """Two tubes of radius 4 that do not meet."""
    z, y, x = np.mgrid[:n, :n, :n] - (n - 1) / 2
    return (np.hypot(z + 9, y + 3) < 4) | (np.hypot(z - 8, x - 2) < 4)


def noisy(mask: np.ndarray, noise: float, width: float = 0.0) -> Field:
    values = np.random.default_rng(1).standard_normal(mask.shape)
    if width:
        values = ndimage.gaussian_filter(values, width)
        values /= values.std()
    return Field((30 + 100 * mask + noise * values).astype(np.float32), (1.0, 1.0, 1.0))


def weighed(scan: Field, laws, **options) -> tuple[Trial, Classes]:
    values = grey_levels(scan)
    return choose_by_voxels(values, scan, estimate_classes(values, scan), laws, **{"steps": 100, **options})


def test_what_is_left_out_comes_in_blocks_and_once() -> None:
    outs = hold_out_masks((20, 23, 26), 4)
    assert len(outs) == TIMES and not (outs[0] & outs[1]).any()
    for out in outs:
        assert out.shape == (20, 23, 26) and 0.15 < out.mean() < 0.35
        corners = out[::4, ::4, ::4]
        whole = corners.repeat(4, 0).repeat(4, 1).repeat(4, 2)[:20, :23, :26]
        assert np.array_equal(out, whole)


@pytest.mark.parametrize(("width", "edge"), [(0.0, 2), (0.7, 4), (3.0, 6)])
def test_blocks_outlast_the_noise(width: float, edge: int) -> None:
    truth = tubes(40)
    assert block_edge(noisy(truth, 40, width).values, truth) == edge


def test_the_part_that_is_tried_is_where_the_surface_is() -> None:
    inside = np.zeros((30, 150, 90), dtype=bool)
    inside[:, 100:140, 5:25] = np.random.default_rng(0).random((30, 40, 20)) < 0.5
    z, y, x = box_with_most_surface(inside, (EDGE,) * 3)
    assert (z.start, z.stop) == (0, 30) and y.stop - y.start == x.stop - x.start == EDGE
    assert y.start <= 100 and y.stop >= 140 and x.start <= 5 and x.stop <= 90


@pytest.mark.slow
def test_the_law_that_tells_more_is_chosen_and_classes_that_overlap_are_measured_apart() -> None:
    """Of a law whose tubes are of another calibre nothing is left, or all. Otsu's halves hold some of both phases:
    their means are nearer to each other."""
    wrong = Coefficients(1.0, 0.0, 1.0, 3.0, 3.0, 9.0)
    scan, said = noisy(tubes(28), 150), list[float]()
    first = estimate_classes(grey_levels(scan), scan)
    best, classes = weighed(scan, [wrong, WILLMORE], progress=lambda _, share: said.append(share))
    assert best.law == WILLMORE and best.score > best.noise > 0 and best.strength in WEIGHTS
    assert abs(first.middle - 80) > 1.3 * abs(classes.middle - 80)
    assert 80 > first.contrast < classes.contrast < 110 and classes.noise == pytest.approx(150, rel=0.03)
    assert said == sorted(said) and said[0] > 0 and said[-1] <= 1


def test_classes_that_are_known_stay() -> None:
    scan = noisy(tubes(28), 150)
    assert weighed(scan, [WILLMORE], remeasure=False, steps=5)[1] == estimate_classes(grey_levels(scan), scan)


@pytest.mark.parametrize("measured", [False, True])
def test_the_gain_is_that_of_the_truth(measured: bool) -> None:
    """Of masks that are known, the gain stated is, within its error, the one counted."""
    truth, noise = tubes(40), 150.0
    scan, classes = noisy(truth, noise), Classes(30.0, 130.0, noise, 80.0)
    outs = hold_out_masks(scan.shape, 2)
    judge = Judge(scan.values, outs, classes, measured)
    start = predict_sides(scan, outs, classes, lambda known: known.level > 0)
    right = predict_sides(scan, outs, classes, lambda known: truth)
    gain, error = judge.gain(right, start)
    left = np.logical_or.reduce(outs)
    share = float((start[1] != (truth & left)).sum() / left.sum())
    assert abs(gain - share) < 3 * error and 0 < error < share
    assert judge.gain(start, start)[0] == 0 and judge.gain(start, right)[0] < 0


def test_where_a_prior_tells_nothing_the_start_is_the_answer() -> None:
    """A law that wipes out what there is, at every weight that is tried."""
    truth = tubes(28)
    scan = noisy(truth, 5)
    wrong = Coefficients(1.0, 0.0, 1.0, 30.0, 30.0, 900.0)
    best, classes = weighed(scan, [wrong], steps=30)
    assert best.law is None and classes == estimate_classes(grey_levels(scan), scan)
    found = segment(scan, wrong, steps=30)
    assert (found.mask.values != truth).mean() < 0.01


def test_sides_are_judged_without_the_classes_that_made_them() -> None:
    """A mask that grows fat brings the classes together, which makes it fatter: it explains less than the truth, by
    whatever classes it came about."""
    truth, noise = tubes(40), 150.0
    scan = noisy(truth, noise)
    outs = hold_out_masks(scan.shape, 2)
    for classes in (Classes(30.0, 130.0, noise, 80.0), Classes(50.0, 80.0, noise, 65.0)):
        judge = Judge(scan.values, outs, classes, True)
        worth = [
            judge.worth(predict_sides(scan, outs, classes, lambda known, mask=mask: mask))
            for mask in (truth, ndimage.binary_dilation(truth, iterations=3), ndimage.binary_erosion(truth))
        ]
        assert worth[0] > max(worth[1:]) > 0
        wrong = predict_sides(scan, outs, classes, lambda known: ~truth)
        assert judge.worth(wrong) == pytest.approx(-worth[0])
    right = predict_sides(scan, outs, classes, lambda known: truth)
    assert measure_classes(scan.values, right, classes).contrast == pytest.approx(100, rel=0.1)


def test_a_flow_that_fails_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    real = room.lower_energy

    def failing(level, law, *rest):
        if law != WILLMORE:
            raise ScanError("expected an energy that stays finite")
        return real(level, law, *rest)

    monkeypatch.setattr(room, "lower_energy", failing)
    scan = noisy(tubes(28), 150)
    assert weighed(scan, [TUBE, WILLMORE], steps=60, remeasure=False)[0].law == WILLMORE
    assert weighed(scan, [TUBE], steps=60, remeasure=False)[0].law is None
