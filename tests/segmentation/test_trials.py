"""Laws and weights chosen by voxels left out: what is left out, what it tells of classes, and what is chosen."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

import curvafit.segmentation.weighing as room
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.evidence import Classes, classes_of, grey_levels
from curvafit.segmentation.segment import segment
from curvafit.segmentation.weighing import Weighing, trial_steps, weighing
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
#: Of this law a tube as thick as those below is at rest: nearly none pays for bending along it.
TUBE = Coefficients(1.0, 0.0, 1.0, -1.0, 0.0, 0.25)


def tubes(n: int = 40) -> np.ndarray:
    """Two tubes of radius 4 that do not meet."""
    z, y, x = np.mgrid[:n, :n, :n] - (n - 1) / 2
    return (np.hypot(z + 9, y + 3) < 4) | (np.hypot(z - 8, x - 2) < 4)


def noisy(mask: np.ndarray, noise: float, width: float = 0.0) -> Field:
    values = np.random.default_rng(1).standard_normal(mask.shape)
    if width:
        values = ndimage.gaussian_filter(values, width)
        values /= values.std()
    return Field((30 + 100 * mask + noise * values).astype(np.float32), (1.0, 1.0, 1.0))


def weighed(scan: Field, laws, **options) -> Weighing:
    values = grey_levels(scan)
    return weighing(values, scan, classes_of(values, scan), laws, **{"steps": 100, **options})


def test_what_is_left_out_comes_in_blocks_and_once() -> None:
    outs = room._blocks((20, 23, 26), 4)
    assert len(outs) == room.TIMES and not (outs[0] & outs[1]).any()
    for out in outs:
        assert out.shape == (20, 23, 26) and 0.15 < out.mean() < 0.35
        corners = out[::4, ::4, ::4]
        whole = corners.repeat(4, 0).repeat(4, 1).repeat(4, 2)[:20, :23, :26]
        assert np.array_equal(out, whole)


@pytest.mark.parametrize(("width", "edge"), [(0.0, 2), (0.7, 4), (3.0, 6)])
def test_blocks_outlast_the_noise(width: float, edge: int) -> None:
    truth = tubes()
    assert room._outlasting(noisy(truth, 40, width).values, truth) == edge


def test_the_part_that_is_tried_is_where_the_surface_is() -> None:
    inside = np.zeros((30, 150, 90), dtype=bool)
    inside[:, 100:140, 5:25] = np.random.default_rng(0).random((30, 40, 20)) < 0.5
    z, y, x = room.densest(inside, (room.EDGE,) * 3)
    assert (z.start, z.stop) == (0, 30) and y.stop - y.start == x.stop - x.start == room.EDGE
    assert y.start <= 100 and y.stop >= 140 and x.start <= 5 and x.stop <= 90


def test_classes_that_overlap_are_measured_apart() -> None:
    """Otsu's halves hold some of both phases: their means are nearer to each other."""
    scan = noisy(tubes(), 180)
    first = classes_of(grey_levels(scan), scan)
    best = weighed(scan, [WILLMORE])
    assert abs(first.middle - 80) > 1.3 * abs(best.classes.middle - 80)
    assert 80 > first.contrast < best.classes.contrast < 110 and best.classes.noise == pytest.approx(180, rel=0.03)
    kept = weighed(scan, [WILLMORE], measured=False)
    assert kept.classes == first


def test_the_law_that_tells_more_of_what_is_left_out_is_chosen() -> None:
    """Of a law whose tubes are of another calibre nothing is left, or all."""
    wrong = Coefficients(1.0, 0.0, 1.0, 3.0, 3.0, 9.0)
    best = weighed(noisy(tubes(), 200), [wrong, WILLMORE])
    assert best.law == WILLMORE and best.gain > best.noise > 0 and best.nats in room.WEIGHTS


@pytest.mark.parametrize("measured", [False, True])
def test_the_gain_is_that_of_the_truth(measured: bool) -> None:
    """Of masks that are known, the gain stated is, within its error, the one counted."""
    truth, noise = tubes(), 150.0
    scan, classes = noisy(truth, noise), Classes(30.0, 130.0, noise, 80.0)
    outs = room._blocks(scan.shape, 2)
    judge = room._Judge(scan.values, outs, classes, measured)
    start = room._sides(scan, outs, classes, lambda known: known.level > 0)
    right = room._sides(scan, outs, classes, lambda known: truth)
    gain, error = judge.gain(right, start)
    left = np.logical_or.reduce(outs)
    share = float((start[1] != (truth & left)).sum() / left.sum())
    assert abs(gain - share) < 3 * error and 0 < error < share
    assert judge.gain(start, start)[0] == 0 and judge.gain(start, right)[0] < 0


def test_where_a_prior_tells_nothing_the_start_is_the_answer() -> None:
    """A law that wipes out what there is, at every weight that is tried."""
    scan = noisy(tubes(), 5)
    wrong = Coefficients(1.0, 0.0, 1.0, 30.0, 30.0, 900.0)
    best = weighed(scan, [wrong])
    assert best.law is None and best.classes == classes_of(grey_levels(scan), scan)
    found = segment(scan, wrong, steps=100)
    assert (found.mask.values != tubes()).mean() < 0.01


def test_sides_are_judged_without_the_classes_that_made_them() -> None:
    """A mask that grows fat brings the classes together, which makes it fatter: it explains less than the truth, by
    whatever classes it came about."""
    truth, noise = tubes(), 150.0
    scan = noisy(truth, noise)
    outs = room._blocks(scan.shape, 2)
    for classes in (Classes(30.0, 130.0, noise, 80.0), Classes(50.0, 80.0, noise, 65.0)):
        judge = room._Judge(scan.values, outs, classes, True)
        worth = [
            judge.worth(room._sides(scan, outs, classes, lambda known, mask=mask: mask))
            for mask in (truth, ndimage.binary_dilation(truth, iterations=3), ndimage.binary_erosion(truth))
        ]
        assert worth[0] > max(worth[1:]) > 0
        assert judge.worth(room._sides(scan, outs, classes, lambda known: ~truth)) == pytest.approx(-worth[0])
    apart = room._measured(scan.values, room._sides(scan, outs, classes, lambda known: truth), classes)
    assert apart.contrast == pytest.approx(100, rel=0.1)


def test_a_flow_that_fails_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    real = room.weighed

    def failing(known, law, *rest):
        if law != WILLMORE:
            raise room.ScanError("expected an energy that stays finite")
        return real(known, law, *rest)

    monkeypatch.setattr(room, "weighed", failing)
    scan = noisy(tubes(), 200)
    assert weighed(scan, [TUBE, WILLMORE]).law == WILLMORE
    assert weighed(scan, [TUBE]).law is None


def test_trying_says_how_far_it_is_and_takes_about_what_is_forecast() -> None:
    said: list[float] = []
    weighed(noisy(tubes(), 200), [TUBE, WILLMORE], steps=20, progress=lambda _, share: said.append(share))
    assert said == sorted(said) and said[0] > 0 and said[-1] <= 1
    assert trial_steps(2, 20, 10**6) < trial_steps(2, 20, 10**5) == pytest.approx(room.TIMES * 8 * 20)
