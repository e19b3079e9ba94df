"""A volume between known slices: interpolations, the network, an example, the choice of a law by the data, labels."""

import json
import math
import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from annotated import EDGES, ball, known, leaning, organelles
from calling import done

import curvafit.segmentation.trials as room
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.flow import Working, WorkingGrid
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import MARGIN, STIFFNESS, reconstruct
from curvafit.segmentation.segmentation import FIRST, NATS, calibrate
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.trials import Task, Trial, choose_by_masks, dice
from curvafit.volumes.volume import ScanError, Volume
from tests.options import grouped

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
#: Nothing is tried out, and few steps.
QUICK = grouped(stiffness=1e7, steps=30)


def straight(length: int = 24) -> np.ndarray:
    """A straight tube along z: every interpolation between its sections is exact."""
    return np.broadcast_to(np.hypot(*(np.mgrid[:24, :24] - 11.3)) < 6, (length, 24, 24)).copy()


@pytest.mark.parametrize("way", WAYS)
def test_an_interpolation_keeps_the_known_slices(way: str) -> None:
    mask = ball()
    slices = known(mask, 5)
    level = slices.level(way)
    assert level.shape == mask.shape and np.array_equal(level[::5] > 0, mask[::5])
    assert np.array_equal(known(straight(), 5).level(way) > 0, straight())


def test_distances_are_those_of_the_slices_around() -> None:
    inside = np.zeros((2, 4, 4), dtype=bool)
    inside[0, 1:3] = True
    level = Slices(inside, (1, 5), 8, EDGES).level("nearest")
    assert [bool((each > 0).any()) for each in level] == [True] * 4 + [False] * 4
    disc = np.hypot(*(np.mgrid[:32, :32] - 15.5)) < 10
    distance = Slices(np.stack([disc, np.zeros_like(disc)]), (2, 6), 9, (2.0, 1.0, 1.0)).level("spline")
    assert np.array_equal(distance[2] > 0, disc) and np.array_equal(distance[0], distance[2])
    assert distance[6:].max() == -8  # as far outside as the slices are apart
    np.testing.assert_allclose(distance[4], (distance[2] + distance[6]) / 2, atol=1e-6)
    slices = Slices(inside, (1, 5), 8, EDGES)
    assert slices.between.tolist() == [False, False, True, True, True, False, False, False]


def pancakes(thin: int, seed: int = 0, width: int = 32) -> np.ndarray:
    """Discs at every second eighth slice that end `thin` slices above and below it: no interpolation knows that."""
    mask = np.zeros((41, 32, width), dtype=bool)
    for n, middle in zip((8, 24, 40), np.random.default_rng(seed).uniform(8, 24, (3, 2)), strict=True):
        disc = np.hypot(*(np.mgrid[:32, :width] - middle[:, None, None])) < 6
        mask[n - thin : n + thin + 1] |= disc
    return mask


def test_an_example_is_cut_in_two() -> None:
    mask = np.concatenate([pancakes(1, seed=2), pancakes(3, seed=3)], axis=2)
    example = room.Example.of(Volume(mask.astype(np.uint8)), range(0, 33, 8), axis=0)
    assert np.array_equal(example.lesson.inside, mask[:, :, :42]) and example.lesson.places == tuple(range(41))
    given = example.task.given
    assert np.array_equal(given.inside, mask[::8, :, 42:]) and given.places == (0, 8, 16, 24, 32, 40)
    assert np.array_equal(example.task.truth, mask[[n for n in range(41) if n % 8], :, 42:]) and not example.notes


@pytest.mark.slow
def test_an_example_tunes_the_network_where_that_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Discs that end between slices: the network cannot know where, and learns it from others."""
    monkeypatch.setattr("curvafit.segmentation.teach.TUNING", 25)  # lessons enough for discs
    truth, other = pancakes(1, seed=1), np.concatenate([pancakes(1, seed=k) for k in (2, 3, 4)], axis=2)
    alone, tuned = reconstruct(truth, every=8), reconstruct(truth, every=8, example=other)
    assert "tuned on the example" in tuned.status
    assert dice(tuned.mask.values, truth) > dice(alone.mask.values, truth) + 0.1


def test_a_halo_is_cut_off_again() -> None:
    values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    for spacing in (EDGES, (2.0, 1.0, 1.0)):
        scan = Volume(values, spacing)
        bare, place = (WorkingGrid.of(scan, None, halo=halo) for halo in (0, 5))
        assert place.grid.shape == tuple(n + 10 for n in bare.grid.shape) and place.grid.spacing == bare.grid.spacing
        np.testing.assert_array_equal(place.to_scan(place.to_grid(values)), bare.to_scan(bare.to_grid(values)))
        assert torch.equal(place.to_grid(values)[0], place.to_grid(values)[5])  # the last values go on
        shared = place.spread(values, centre=0)
        np.testing.assert_array_equal(place.to_scan(shared), bare.to_scan(bare.spread(values, centre=0)))
        assert float(shared.sum()) == pytest.approx(float(bare.spread(values, centre=0).sum()), rel=1e-5)


@pytest.mark.parametrize(("count", "out"), [(3, [1]), (4, [1]), (5, [1, 3])])
def test_every_second_slice_is_left_out(count: int, out: list[int]) -> None:
    mask = ball()
    places = tuple(range(8, 8 + 4 * count, 4))
    task = room.leave_out_slices(Slices(mask[list(places)], places, len(mask), EDGES))
    assert task is not None and list(task.places) == [places[k] for k in out]
    assert task.given.places == tuple(place for k, place in enumerate(places) if k not in out)
    assert np.array_equal(task.truth, mask[task.places])


def test_there_may_be_too_few_slices_to_leave_any_out() -> None:
    assert room.leave_out_slices(known(ball(), 20)) is None
    middle = np.zeros((3, 4, 4), dtype=bool)
    middle[1, 1:3, 1:3] = True  # the others are empty
    assert room.leave_out_slices(Slices(middle, (0, 4, 8), 9, EDGES)) is None


def test_a_straight_tube_is_filled_exactly_and_no_law_helps() -> None:
    truth = straight(25)
    found = reconstruct(truth, WILLMORE, every=6, working=Working(steps=3))
    assert np.array_equal(found.mask.values, truth)
    assert found.status.startswith("no law helps here: Dice 1.000 on slices left out by the network")
    assert found.coefficients is found.phase is None


def test_what_is_annotated_along_another_axis_is_kept_and_helps() -> None:
    """Every eighth slice of a leaning tube and a ball, and one plane across them."""
    truth = leaning(33)
    labels = np.full(truth.shape, 7, dtype=np.uint8)
    labels[::8] = truth[::8]
    sparse = reconstruct(labels, ignore=7)
    labels[..., 8] = truth[..., 8]
    found = reconstruct(labels, ignore=7)
    assert np.array_equal(sparse.mask.values, reconstruct(truth, every=8).mask.values)
    assert np.array_equal(found.mask.values[..., 8], truth[..., 8])
    assert set(np.unique(found.probability.values[..., 8])) == {0, 1}  # type: ignore[union-attr]
    beside = np.s_[..., [6, 7, 9, 10]]
    assert dice(found.mask.values[beside], truth[beside]) > dice(sparse.mask.values[beside], truth[beside])


def test_the_same_slices_make_the_same_choice() -> None:
    one, other = (reconstruct(ball(), WILLMORE, every=6, working=Working(steps=10)) for _ in range(2))
    assert one.status == other.status and np.array_equal(one.mask.values, other.mask.values)
    assert np.array_equal(one.mask.values[::6], ball()[::6])


def test_known_slices_are_kept_and_the_rest_beats_interpolation() -> None:
    """A ball: lines between its sections cut it short, their spline less, its curvature least."""
    n, every = 41, 8
    truth = np.linalg.norm(np.mgrid[:n, :n, :n] - 20.0, axis=0) < 15.2
    places = np.arange(0, n, every)
    found = reconstruct(Volume(truth.astype(np.uint8)), WILLMORE, every=every, working=Working(stiffness=STIFFNESS))
    lines = Slices(truth[places], tuple(places), n, (1.0, 1.0, 1.0)).level("linear") > 0
    assert np.array_equal(found.mask.values[places], truth[places])
    assert dice(found.mask.values, truth) > dice(lines, truth) + 0.01
    assert found.weight is None


BALL, RANDOM = ball().astype(np.uint8), np.random.default_rng(0)
GREY, PHOTO = RANDOM.integers(0, 99, (32, 32, 32), np.uint8), BALL + 0.4 * RANDOM.standard_normal((32, 32, 32))
#: What `reconstruct` refuses of a ball of which every eighth slice is known, by a word of the sentence.
REFUSALS: dict[str, list[dict]] = {
    "between": [{"example": BALL, "every": None, "known": [15, 16]}], "longer": [{"example": BALL[:8]}],
    "spacing": [{"example": Volume(BALL, (1.0,) * 3, "mm")}], "two or more": [{"every": None, "known": [3]}],
    "empty": [{"example": 0 * BALL}, {"every": None, "ignore": 1}, {"slices": 0 * BALL}],
    "12.5": [{"every": None, "known": [0, 12.5]}],
    "whole numbers": [{"example": BALL * np.float32(0.5)}, {"slices": BALL * np.float32(0.5)}],
    "every": [{"every": None}, {"every": 0}], "ignore": [{"every": None, "known": [3], "ignore": 1}, {"ignore": 1}],
    "31": [{"every": None, "known": [3, 99]}], "whole number": [{"every": math.nan}, {"every": slice(0.5, None, 8)}],
    "axis": [{"axis": 3}], "epsilon": [{"epsilon": -1.0}], "three or more": [{"every": None, "known": [8, 24]}],
    "stiffness": [{"stiffness": 0.0}], "no voxel": [{"every": None, "ignore": 2}], "no.npz": [{"filler": "no.npz"}],
    "256": [{"slices": RANDOM.integers(0, 999, (32, 32, 32), np.int16)}], "grey image": [{"slices": GREY}],
    "finite": [{"slices": np.where(BALL, np.nan, 0)}], "shape": [{"image": np.zeros((32, 32, 31)), "prior": None}],
    "grey": [{"image": BALL, "prior": None}],
    "both": [{"image": PHOTO}, {"image": PHOTO, "prior": None, "example": BALL}],
}  # fmt: skip


@pytest.mark.parametrize("word", REFUSALS)
def test_bad_slices_and_examples_are_refused(word: str) -> None:
    for options in REFUSALS[word]:
        with pytest.raises((ValueError, FileNotFoundError), match=word):
            reconstruct(**grouped(**{"slices": BALL, "prior": WILLMORE, "every": 8, **options}))


def test_known_voxels_leave_the_profile_free() -> None:
    """Half a voxel from a plane, the optimal profile of ε = 2 voxels is as far from 0 as the springs ask."""
    assert pytest.approx(np.tanh(0.5 / (2 * np.sqrt(2)))) == MARGIN


def test_slices_beyond_the_known_ones_are_as_those_are_for_half_a_gap() -> None:
    truth = leaning()
    found = reconstruct(truth.astype(np.uint8), every=slice(3, None, 8)).mask.values
    assert np.array_equal(found[:3], np.stack([truth[3]] * 3)) and np.array_equal(found[-4:], np.stack([truth[27]] * 4))
    far = reconstruct(truth.astype(np.uint8), known=[10, 14, 18])
    assert np.array_equal(far.mask.values[8:11], np.stack([truth[10]] * 3)) and not far.mask.values[:8].any()
    assert np.array_equal(far.mask.values[18:21], np.stack([truth[18]] * 3)) and not far.mask.values[21:].any()
    likely = far.probability.values  # type: ignore[union-attr]
    assert likely[:8].max() == likely[21:].max() == 0.5 and "19 beyond them not filled" in far.status
    assert any(note.startswith("Before") and "2 slices" in note and "8 further" in note for note in far.notes)
    full = np.where(truth, 2, 1)
    several = reconstruct_labels(full, known=[10, 14, 18]).labels.values  # type: ignore[union-attr]
    assert not several[:8].any() and not several[21:].any() and several[8:21].all()


def test_empty_slices_in_the_rhythm_of_those_with_labels_are_known() -> None:
    """A ball in slices 12 to 28, drawn on 16, 20 and 24; and the same with slices of no rhythm."""
    truth = np.linalg.norm(np.mgrid[:41, :24, :24] - np.array([20, 12, 12])[:, None, None, None], axis=0) < 8.5
    drawn = np.zeros(truth.shape, np.uint8)
    drawn[[16, 20, 24]] = truth[[16, 20, 24]]
    unasked, named = reconstruct(drawn), reconstruct(drawn, known=[12, 16, 20, 24, 28])
    np.testing.assert_array_equal(unasked.mask.values, named.mask.values)
    assert any("12, 28" in note and "rightly empty" in note for note in unasked.notes)
    assert any("3 slices with labels are known: 16, 20, 24." in note for note in unasked.notes)
    assert not unasked.mask.values[:12].any() and not reconstruct_labels(3 * drawn).mask.values[29:].any()
    drawn[23], drawn[24] = truth[23], 0
    assert not any("Slices" in note for note in reconstruct(drawn).notes)


def test_labels_count_as_inside_and_what_is_extrapolated_is_said() -> None:
    truth = leaning()
    labels = np.where(truth, np.random.default_rng(0).integers(1, 200, truth.shape), 0).astype(np.float32)
    labels[1::2] += 0.5  # these are not read
    found = reconstruct(Volume(labels), WILLMORE, every=slice(2, None, 8), working=Working(steps=1, stiffness=1e7))
    plain = reconstruct(Volume(truth), WILLMORE, known=[2, 10, 18, 26], working=Working(steps=1, stiffness=1e7))
    assert np.array_equal(found.mask.values, plain.mask.values) and set(plain.notes) <= set(found.notes)
    assert [note for note in found.notes if "one structure" in note] and len(found.notes) == len(plain.notes) + 1
    assert any("Before" in note and "2" in note for note in found.notes)
    assert any("Beyond" in note and "4 slices" in note and "1 further" in note for note in found.notes)
    assert "after 1 step:" in found.status
    whole = reconstruct(Volume(truth), WILLMORE, known=[0, 15, 31], working=Working(steps=1, stiffness=1e7))
    assert not any("Beyond" in note for note in whole.notes)


def test_each_label_is_completed_as_alone_and_known_slices_stay() -> None:
    truth, affine = organelles(), np.diag([0.2, 0.2, 0.2, 1.0])
    field = Volume(truth, 0.2, "um", affine)
    found = reconstruct_labels(field, {2: preset("tubes"), 7: WILLMORE}, every=6, **QUICK)
    assert found.labels is not None and (found.labels.spacing, found.labels.unit) == (field.spacing, "um")
    values = found.labels.values
    assert np.array_equal(found.labels.affine, affine) and values.dtype == np.uint8  # type: ignore[arg-type]
    assert np.array_equal(values[::6], truth[::6])
    assert np.array_equal(found.mask.values, values > 0)
    for number, law in ((2, preset("tubes")), (7, WILLMORE)):
        alone = reconstruct((truth == number).astype(np.uint8), law, every=6, **QUICK).mask.values
        assert dice(values == number, alone) > 0.999
        assert dice(values == number, truth == number) > 0.95
    assert found.status.count("label ") == 2


def test_labels_that_touch_exclude_each_other_where_alone_they_overlap() -> None:
    """Two touching slabs whose border jumps between known slices: alone both claim the voxels beside it."""
    truth = np.zeros((13, 20, 24), dtype=np.uint8)
    truth[:, 4:16, 2:12], truth[:, 4:16, 12:22] = 1, 2
    truth[4, 4:16, 9:12], truth[8, 4:16, 12:15] = 2, 1
    alone = [reconstruct((truth == k).astype(np.uint8), WILLMORE, every=4, **QUICK).mask.values for k in (1, 2)]
    found = reconstruct_labels(truth, WILLMORE, every=4, **QUICK)
    assert found.labels is not None
    values = found.labels.values
    only = alone[0] ^ alone[1]
    agreed = np.where(alone[0], 1, 2)[only] == values[only]
    assert agreed.mean() > 0.99
    assert set(np.unique(values)) == {0, 1, 2}


def test_where_all_is_labelled_no_voxel_is_left_out() -> None:
    truth = np.ones((13, 16, 16), dtype=np.int16)
    z, _, x = np.indices(truth.shape)
    truth[x + z / 2 > 11] = 300
    found = reconstruct_labels(truth, WILLMORE, every=6, **QUICK)
    assert found.labels is not None
    assert found.labels.values.dtype == np.uint16
    assert set(np.unique(found.labels.values)) == {1, 300}
    assert dice(found.labels.values == 300, truth == 300) > 0.95
    labels = np.ones((17, 90, 90), np.uint8)  # also where no label's box is
    labels[:, 45:], labels[8:, :, 40:], labels[8:, :10, :10] = 2, 3, 3
    found = reconstruct_labels(labels, known=[0, 16]).labels
    assert found is not None and set(np.unique(found.values)) == {1, 2, 3}


@pytest.mark.parametrize("law", [None, WILLMORE])
def test_what_is_said_of_a_label_is_of_the_volume_and_not_of_its_box(law: Coefficients | None) -> None:
    """A label that is filled in a box of 37 slices is reported as of all 65."""
    z, y, x = np.indices((65, 96, 80))
    body = np.sqrt((z - 20) ** 2 + (y - 22) ** 2 + (x - 22) ** 2) < 12
    labels = np.where(body, 1, 2 * (np.hypot(z - 40, y - 60) < 9)).astype(np.uint8)
    found = reconstruct_labels(labels, law, every=4, **QUICK)
    said = found.status.partition("; label 2: ")[0]
    assert "17 of 65 slices known" in said
    mask, slices = (float(number) for number in re.findall(r"([\d.]+) %(?= of the| \()", said))
    assert mask == pytest.approx(100 * (found.labels.values == 1).mean(), abs=0.006)  # type: ignore[union-attr]
    areas = body.mean((1, 2))  # which are joined by straight lines
    assert slices == pytest.approx(100 * np.interp(range(65), range(0, 65, 4), areas[::4]).mean(), abs=0.006)


def test_a_label_that_is_refused_is_filled_by_the_network_and_said() -> None:
    truth = organelles()
    truth[0, :4, :4] = 9
    found = reconstruct_labels(
        truth, WILLMORE, known=[0, 24], chosen=[2, 9], working=Working(steps=30)
    )  # none can be left out
    assert found.labels is not None
    assert np.array_equal(found.labels.values[0] == 9, truth[0] == 9)
    assert not (found.labels.values == 7).any()
    assert any(note.startswith("Label 9: Filled by the network alone") for note in found.notes)


def test_a_label_is_filled_in_its_own_box_as_in_the_whole_volume() -> None:
    z, y, x = np.indices((49, 120, 120))
    labels = np.zeros(z.shape, np.uint8)
    for number, (a, b) in enumerate(((20, 20), (20, 90), (90, 25), (95, 95), (60, 60)), 1):
        labels[(np.hypot(y - a - 0.2 * (z - 24), x - b) < 6) & (abs(z - 24) < 18)] = number
    found = reconstruct_labels(labels, every=8)
    for number in range(1, 6):
        alone = reconstruct((labels == number).astype(np.uint8), every=8).mask.values
        assert dice(found.labels.values == number, alone) > 0.995  # type: ignore[union-attr]
    assert set(found.uncertainty.dice_of_labels) == set(range(1, 6))  # type: ignore[union-attr]
    assert found.status.startswith("5 labels") and len(found.status) < 250
    assert found.phase is None and not found.labels.values[:, :8, 100:].any()  # type: ignore[union-attr]


SPARSE, APART = organelles(), np.zeros((25, 24, 32), np.uint8)
SPARSE[np.arange(25) != 6] = 0
APART[::8], APART[4::8] = 2 * (organelles()[::8] > 0), 5 * (organelles()[4::8] > 0)


@pytest.mark.parametrize(
    ("values", "options", "word"),
    [
        (0 * SPARSE, {}, "other than 0"), (organelles(), {"chosen": [0, 2]}, "other than 0"),
        (organelles(), {"chosen": [2, 5]}, "5"), (organelles() + 0.5, {}, "whole numbers"),
        (organelles() + 0.5, {"chosen": [2]}, "whole numbers"), (GREY, {"chosen": [2]}, "grey image"),
        (SPARSE, {"every": None}, "got 1"), (0 * SPARSE, {"every": None}, "got 0"),
        (organelles(), {"every": None}, "no slice without"), (APART, {"every": None}, "one after the"),
    ],
)  # fmt: skip
def test_bad_labels_are_refused(values: np.ndarray, options: dict, word: str) -> None:
    with pytest.raises(ScanError, match=word):
        reconstruct_labels(values, **{"prior": WILLMORE, "every": 6, **QUICK, **options})


def test_the_command_writes_labels(tmp_path: Path) -> None:
    scan, out = tmp_path / "labels.nii.gz", tmp_path / "volume.nii.gz"
    image = nibabel.Nifti1Image(organelles().T, np.diag([0.5, 0.5, 0.5, 1]))
    image.header.set_xyzt_units("micron")
    nibabel.save(image, scan)
    options = ("--every", 6, "--prior", "tubes", "--stiffness", 1e7, "--steps", 30)
    done("reconstruct", scan, *options, "--labels", "all", "-o", out)
    written = nibabel.Nifti1Image.from_filename(out)
    assert set(np.unique(np.asarray(written.dataobj))) == {0, 2, 7}
    assert np.array_equal(written.affine, image.affine)
    assert json.loads((tmp_path / "volume.json").read_text(encoding="utf-8"))["labels"] == "all"


@pytest.mark.slow
def test_the_law_of_each_label_is_inferred_from_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curvafit.segmentation.teach.TUNING", 20)  # the network is not what this is about
    scan, example, out = tmp_path / "labels.npy", tmp_path / "example.npy", tmp_path / "volume.npy"
    np.save(scan, organelles())
    np.save(example, organelles(3))
    done("reconstruct", scan, "--every", 6, "--labels", "2,7", "--example", example, "--steps", 30, "-o", out)
    truth, values = organelles(), np.load(out)
    assert dice(values == 2, truth == 2) > 0.95
    assert dice(values == 7, truth == 7) > 0.95


def decided(better: np.ndarray) -> Trial:
    """The choice between an interpolation of a ball and a prior that fills with `better`."""
    mask, slices = ball(48), known(ball(48), 12)
    between = [n for n in range(36) if n % 12]

    def filled(given: Slices, setting: Trial) -> np.ndarray:
        return given.level("spline") > 0 if setting.law is None else better

    return choose_by_masks(Task(slices, mask[between], between), [Trial(WILLMORE, 1.0, 1)], filled)


def test_a_prior_is_taken_where_it_is_better_than_the_noise_only() -> None:
    """A single voxel is one tile's gain: as large as its standard error, (T - 1) / T of it being the jackknife's."""
    best = decided(ball(48))
    assert best.law is WILLMORE and best.score == 1 > best.plain
    plain = decided(np.zeros((48, 48, 48), dtype=bool))
    assert plain.law is None and plain.score == 0 and plain.plain == best.plain
    start = known(ball(48), 12).level("spline") > 0
    same = decided(start)
    assert same.law is None and same.noise == 0
    wrong = np.argwhere(start != ball(48))
    wrong = wrong[(wrong[:, 0] < 36) & (wrong[:, 0] % 12 > 0)]
    better = start.copy()
    better[tuple(wrong[0])] ^= True
    best = decided(better)
    assert best.law is None and best.score > best.plain


def test_a_climb_ends_at_the_best_on_either_side() -> None:
    for heights, first, best in (([5, 1, 2, 3, 4], 2, 4), ([5, 4, 3, 1, 9], 2, 0), ([1, 2, 1], 1, 1), ([7], 0, 0)):
        found = room.search([Trial(None, first)], range(len(heights)), lambda trial, h=heights: h[int(trial.strength)])
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


def test_the_part_that_is_tried_is_where_the_surface_is() -> None:
    inside = np.zeros((30, 150, 90), dtype=bool)
    inside[:, 100:140, 5:25] = np.random.default_rng(0).random((30, 40, 20)) < 0.5
    z, y, x = box_with_most_surface(inside, (64,) * 3)
    assert (z.start, z.stop) == (0, 30) and y.stop - y.start == x.stop - x.start == 64
    assert y.start <= 100 and y.stop >= 140 and x.start <= 5 and x.stop <= 90


def test_a_flow_that_fails_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise ScanError("expected an energy that stays finite")

    monkeypatch.setattr("curvafit.segmentation.tiles.lower_energy", failing)
    found = calibrate(0.2 + 0.6 * ball(20), ball(20), WILLMORE, working=Working(steps=1))
    assert found.trial.law is None and (found.trial.score, found.trial.plain) == (0, 1)
