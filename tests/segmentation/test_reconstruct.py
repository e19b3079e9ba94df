"""A volume between known slices: interpolations, halo, and the choice between them and a prior by the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from found import made_fit

from curvafit.core.progress import silent
from curvafit.inference.candidates import Candidate
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.calibration import ODDS, Choice, Setting, Task, choice, left_out
from curvafit.segmentation.completion import MARGIN, _Between, _filled, reconstruct
from curvafit.segmentation.engine import stiff
from curvafit.segmentation.example import Example
from curvafit.segmentation.odds import Odds
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.working import TRUSTED, WorkingGrid, law_of, laws_of
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
EDGES = (1.0, 1.0, 1.0)


def straight(length: int = 24) -> np.ndarray:
    """A straight tube along z: every interpolation between its sections is exact."""
    return np.broadcast_to(np.hypot(*(np.mgrid[:24, :24] - 11.3)) < 6, (length, 24, 24)).copy()


def ball(n: int = 32) -> np.ndarray:
    return np.linalg.norm(np.mgrid[:n, :n, :n] - (n - 1) / 2, axis=0) < n / 3


def known(mask: np.ndarray, every: int, *, periodic: bool = False) -> Slices:
    places = tuple(range(0, len(mask), every))
    return Slices(mask[list(places)], places, len(mask), EDGES, periodic=periodic)


# ---- interpolations --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("periodic", [False, True])
def test_an_interpolation_keeps_the_known_slices(way: str, periodic: bool) -> None:
    mask = ball()
    slices = known(mask, 5, periodic=periodic)
    level = slices.level(way)
    assert level.shape == mask.shape and np.array_equal(level[::5] > 0, mask[::5])
    assert np.array_equal(known(straight(), 5, periodic=periodic).level(way) > 0, straight())


def test_a_volume_that_repeats_is_interpolated_across_its_end() -> None:
    one, other = (np.hypot(*(np.mgrid[:24, :24] - 11.5)) < radius for radius in (9, 4))
    slices = Slices(np.stack([one, other]), (0, 6), 12, EDGES, periodic=True)
    for way in ("linear", "spline"):
        level = slices.level(way)
        np.testing.assert_allclose(level[1:6], level[11:6:-1], atol=1e-4)  # even about slice 0
        rolled = Slices(np.stack([other, one]), (2, 8), 12, EDGES, periodic=True).level(way)
        np.testing.assert_allclose(np.roll(rolled, 4, axis=0), level, atol=1e-4)
    assert slices.gap == 6 and known(ball(), 5, periodic=True).gap == 5


def test_the_nearest_slice_is_nearest() -> None:
    inside = np.zeros((2, 4, 4), dtype=bool)
    inside[0, 1:3] = True
    level = Slices(inside, (1, 5), 8, EDGES).level("nearest")
    assert [bool((each > 0).any()) for each in level] == [True] * 4 + [False] * 4


def test_the_known_slices_around_a_slice() -> None:
    inside = np.ones((2, 4, 4), dtype=bool)
    slices = Slices(inside, (1, 5), 8, EDGES)
    away, near, far = slices.neighbours
    assert away.tolist() == [1, 0, 1, 2, 1, 0, 1, 2]
    assert near.tolist() == [0, 0, 0, 0, 1, 1, 1, 1] and far[2:5].tolist() == [1, 1, 0]
    assert slices.between.tolist() == [False, False, True, True, True, False, False, False]
    around = replace(slices, periodic=True)
    assert around.neighbours[0].tolist() == [1, 0, 1, 2, 1, 0, 1, 2]
    assert around.neighbours[1].tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert around.neighbours[2][[0, 6, 7]].tolist() == [1, 0, 0] and (~around.between).sum() == 2


# ---- an example's odds -----------------------------------------------------------------------------------------------


def pancakes(thin: int, seed: int = 0, width: int = 32) -> np.ndarray:
    """Discs at every second eighth slice that end `thin` slices above and below it: no interpolation knows that."""
    mask = np.zeros((41, 32, width), dtype=bool)
    for n, middle in zip((8, 24, 40), np.random.default_rng(seed).uniform(8, 24, (3, 2)), strict=True):
        disc = np.hypot(*(np.mgrid[:32, :width] - middle[:, None, None])) < 6
        mask[n - thin : n + thin + 1] |= disc
    return mask


def odds_of(mask: np.ndarray) -> Odds:
    between = [n for n in range(len(mask)) if n % 8]
    return Odds.of(known(mask, 8), mask[between], between)


@pytest.mark.parametrize("thin", [1, 2, 3])
def test_odds_are_learnt_from_an_example(thin: int) -> None:
    truth = pancakes(thin, seed=1)
    level = odds_of(pancakes(thin)).level(known(truth, 8))
    assert np.array_equal(level > 0, truth)
    assert not any(np.array_equal(known(truth, 8).level(way) > 0, truth) for way in WAYS)
    coarse = replace(known(truth, 8), spacing=(2.0, 2.0, 2.0), unit="um")
    np.testing.assert_allclose(odds_of(pancakes(thin)).level(coarse), 2 * level, rtol=1e-5)


def test_each_half_of_an_example_is_judged_by_the_other() -> None:
    halves = np.concatenate([pancakes(1, seed=2), pancakes(3, seed=3)], axis=2)
    level = odds_of(halves).level(known(halves, 8), crossed=True)
    assert np.array_equal(level > 0, np.concatenate([pancakes(3, seed=2), pancakes(1, seed=3)], axis=2))


def test_laws_are_lowered_on_a_box_of_an_example(monkeypatch: pytest.MonkeyPatch) -> None:
    """Odds are counted on all of it, and a box of it is judged by the half that it does not lie in."""
    monkeypatch.setattr("curvafit.segmentation.example.PART", 20)
    mask = np.concatenate([pancakes(1, seed=2), pancakes(3, seed=3)], axis=2)
    example = Example.of(Field(mask.astype(np.uint8)), range(0, 33, 8), axis=0)
    given, box = example.part.given, example.box
    assert given.shape == (33, 20, 20) and example.whole.given.shape == mask.shape and not example.notes
    monkeypatch.setattr("curvafit.segmentation.example.LARGEST", 32)
    smaller = Example.of(Field(mask.astype(np.uint8)), range(0, 33, 8), axis=0)
    assert smaller.notes == ("Of the example 33 x 32 x 32 voxels are read, where most of its surface is.",)
    assert np.array_equal(given.inside, mask[box][::8])
    assert np.array_equal(example.part.truth, mask[box][[n for n in range(32) if n % 8]])
    np.testing.assert_array_equal(example.level(given, ODDS), example.level(example.whole.given, ODDS)[box])


def test_odds_replace_an_interpolation_where_they_are_better() -> None:
    truth, other = pancakes(2, seed=1), np.concatenate([pancakes(2, seed=2), pancakes(2, seed=3)], axis=2)
    found = reconstruct(truth, WILLMORE, every=8, example=other, steps=1)
    assert f"no prior helps here: Dice 1.000 on slices of the example by {ODDS}" in found.status
    assert np.array_equal(found.mask.values, truth)


def test_odds_hold_the_surface_while_the_energy_is_lowered() -> None:
    """With springs on every voxel the odds last longer than without: thin discs cost much."""
    truth = pancakes(2, seed=1)
    slices = known(truth, 8)
    level = odds_of(pancakes(2)).level(slices)
    held, free = (
        _filled(_Between(slices, Setting(ODDS, WILLMORE, 1e7, 60, pull), level), None, None, silent)[0]
        for pull in (1e7, 0.0)
    )
    assert (held != truth).sum() < (free != truth).sum()


# ---- grids -----------------------------------------------------------------------------------------------------------


def test_a_halo_is_cut_off_again() -> None:
    values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    for spacing in (EDGES, (2.0, 1.0, 1.0)):
        scan = Field(values, spacing)
        bare, place = (WorkingGrid.of(scan, None, halo=halo) for halo in (0, 5))
        assert place.grid.shape == tuple(n + 10 for n in bare.grid.shape) and place.grid.spacing == bare.grid.spacing
        np.testing.assert_array_equal(place.back(place.finer(values)), bare.back(bare.finer(values)))
        assert torch.equal(place.finer(values)[0], place.finer(values)[5])  # the last values go on
        shared = place.spread(values, centre=0)
        np.testing.assert_array_equal(place.back(shared), bare.back(bare.spread(values, centre=0)))
        assert float(shared.sum()) == pytest.approx(float(bare.spread(values, centre=0).sum()), rel=1e-5)
    whole = WorkingGrid.of(Field(values), None, halo=5, periodic=True)
    assert whole.grid.periodic and whole.grid.shape == values.shape


def test_a_law_s_scale_does_not_matter_to_the_engine() -> None:
    one, other = stiff(WILLMORE), stiff(WILLMORE.scaled(7.5))
    assert other.as_dict() == pytest.approx(one.as_dict()) and one.a20 + one.a02 == pytest.approx(2)


# ---- the choice ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "periodic", "out"),
    [(3, False, [1]), (4, False, [1]), (5, False, [1, 3]), (4, True, [1, 3]), (5, True, [1, 3])],
)
def test_every_second_slice_is_left_out(count: int, periodic: bool, out: list[int]) -> None:
    mask = ball()
    places = tuple(range(8, 8 + 4 * count, 4))
    task = left_out(Slices(mask[list(places)], places, len(mask), EDGES, periodic=periodic))
    assert task is not None and list(task.places) == [places[k] for k in out]
    assert task.given.places == tuple(place for k, place in enumerate(places) if k not in out)
    assert np.array_equal(task.truth, mask[task.places])


def test_there_may_be_too_few_slices_to_leave_any_out() -> None:
    assert left_out(known(ball(), 20)) is None
    middle = np.zeros((3, 4, 4), dtype=bool)
    middle[1, 1:3, 1:3] = True  # the others are empty
    assert left_out(Slices(middle, (0, 4, 8), 9, EDGES)) is None


def decided(better: np.ndarray) -> Choice:
    """The choice between interpolations of a ball and a prior that fills with `better`."""
    mask, slices = ball(48), known(ball(48), 12)
    between = [n for n in range(36) if n % 12]

    def filled(given: Slices, setting: Setting) -> np.ndarray:
        return given.level(setting.way) > 0 if setting.law is None else better

    return choice(Task(slices, mask[between], between), lambda way: [Setting(way, WILLMORE, 1.0, 1)], filled)


def test_a_prior_is_taken_where_it_is_better_only() -> None:
    best = decided(ball(48))
    assert best.setting.law is WILLMORE and best.dice == 1 > best.plain
    plain = decided(np.zeros((48, 48, 48), dtype=bool))
    assert plain.setting.law is None and plain.dice == 0 and plain.plain == best.plain
    same = decided(known(ball(48), 12).level(plain.setting.way) > 0)
    assert same.setting == plain.setting and same.noise == 0


def test_a_gain_within_the_noise_is_none() -> None:
    """A single voxel is one tile's gain: as large as its standard error, (T - 1) / T of it being the jackknife's."""
    way = decided(ball(48)).setting.way
    start = known(ball(48), 12).level(way) > 0
    wrong = np.argwhere(start != ball(48))
    wrong = wrong[(wrong[:, 0] < 36) & (wrong[:, 0] % 12 > 0)]
    better = start.copy()
    better[tuple(wrong[0])] ^= True
    best = decided(better)
    assert best.setting.law is None and best.dice > best.plain


def test_no_prior_helps_where_the_interpolation_is_exact() -> None:
    truth = straight()
    found = reconstruct(truth, WILLMORE, every=6, steps=3)
    assert np.array_equal(found.mask.values, truth)
    assert found.status.startswith("no prior helps here: Dice 1.000 on slices left out by spline")
    assert found.coefficients is None and np.array_equal(found.phase.values > 0, truth)


def test_the_same_slices_make_the_same_choice() -> None:
    one, other = (reconstruct(ball(), WILLMORE, every=6, steps=10) for _ in range(2))
    assert one.status == other.status and np.array_equal(one.mask.values, other.mask.values)
    assert np.array_equal(one.mask.values[::6], ball()[::6])


def test_an_example_is_degraded_as_the_volume_is() -> None:
    """Every sixth slice of a ball is known, and so of the example, a straight tube, where there is nothing to gain."""
    found = reconstruct(ball(), WILLMORE, every=6, example=straight(), steps=3)
    assert "no prior helps here: Dice 1.000 on slices of the example by spline" in found.status
    turned = reconstruct(ball(), WILLMORE, every=6, axis=2, example=straight().transpose(1, 2, 0), steps=3)
    assert np.array_equal(turned.mask.values.transpose(2, 0, 1), found.mask.values)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"example": ball(), "known": [15, 16]}, "slices with others between them, .* got slices 1 apart"),
        (
            {"example": ball()[:8], "every": 8},
            "an example longer than their distance, got slices 8 apart and an example of 8",
        ),
        ({"example": Field(ball(), (1.0,) * 3, "mm"), "every": 8}, "an example with the spacing of the slices"),
        ({"example": np.zeros((32, 32, 32), dtype=np.uint8), "every": 8}, "got empty ones"),
        ({"example": ball() * np.float32(0.5), "every": 8}, "values that are not whole numbers"),
    ],
)
def test_bad_examples_are_refused(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        reconstruct(ball(), WILLMORE, **options)


def test_a_prior_that_is_no_fit_has_one_law() -> None:
    scan = Field(ball())
    for prior in (WILLMORE, "tubes"):
        laws, _ = laws_of(prior, scan)
        assert len(laws) == 1


def test_a_fit_has_the_laws_that_it_trusts(tmp_path: Path) -> None:
    fit = made_fit()
    known = [Candidate(name, Coefficients(1, k, 2, 3, 4, 5), -0.5, {}) for k, name in enumerate(("match", *TRUSTED))]
    fit = replace(fit, candidates=(*fit.candidates, *known))
    path = tmp_path / "fit.json"
    path.write_text(fit.to_json())
    scan = Field(ball(), (0.0195,) * 3, "mm")
    laws, _ = laws_of(fit, scan)
    assert laws[0] == law_of(fit, scan)[0]
    for each in known[1:]:
        wanted = each.coefficients.in_unit(1 / fit.length)
        assert sum(law.as_dict() == pytest.approx(wanted.as_dict()) for law in laws) == 1
    unwanted = known[0].coefficients.in_unit(1 / fit.length)
    assert not any(law.as_dict() == pytest.approx(unwanted.as_dict()) for law in laws)
    for law, read in zip(laws, laws_of(path, scan)[0], strict=True):
        assert read.as_dict() == pytest.approx(law.as_dict())


def test_known_voxels_leave_the_profile_free() -> None:
    """Half a voxel from a plane, the optimal profile of ε = 2 voxels is as far from 0 as the springs ask."""
    assert pytest.approx(np.tanh(0.5 / (2 * np.sqrt(2)))) == MARGIN
