"""Segmentation of grey levels and of probabilities: evidence, units, grids, place, examples, and what comes out."""

import dataclasses
import json
import math
from functools import partial
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from calling import call, done, refused
from found import made_fit
from scipy import ndimage
from skimage.filters import threshold_otsu

import curvafit.segmentation.evidence as room
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset
from curvafit.segmentation.evidence import load_probabilities
from curvafit.segmentation.flow import Working, WorkingGrid
from curvafit.segmentation.segmentation import calibrate, segment
from curvafit.segmentation.trials import dice, law_of
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save
from tests.options import grouped

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def tubes(n: int = 32) -> np.ndarray:
    """Two crossing tubes and a ball, none thinner than six voxels."""
    z, y, x = np.mgrid[:n, :n, :n] - n / 2 + 0.5
    first, second = np.hypot(z + 8, y) < 4, np.hypot(z - 0.3 * y - 3, x - 4) < 3.5
    return first | second | (z**2 + (y + 9) ** 2 + (x + 9) ** 2 < 25)


def noisy(mask: np.ndarray, noise: float, **place) -> Volume:
    values = 30 + 100 * mask + noise * np.random.default_rng(1).standard_normal(mask.shape)
    return Volume(values.astype(np.float32), **place)


def of_intensities(scan: Volume, threshold: float | str = "otsu", dark: bool = False) -> room.VoxelEvidence:
    values = scan.values.astype(np.float32)
    values = values.clip(*room.grey_bounds(values, threshold))
    return room.grey_evidence(values, scan, room.estimate_classes(values, scan, threshold, dark))


def test_intensities_find_the_classes_and_the_noise() -> None:
    truth = tubes()
    found = of_intensities(noisy(truth, 25))
    ideal = (noisy(truth, 25).values - 80) * 100 / 25**2
    inner = ndimage.binary_erosion(truth, iterations=2) | ndimage.binary_erosion(~truth, iterations=2, border_value=1)
    slope = np.polyfit(ideal[inner], found.ratio[inner], 1)
    assert slope == pytest.approx([1, 0], abs=0.15)
    dark = of_intensities(dataclasses.replace(noisy(truth, 25), array=200 - noisy(truth, 25).values), dark=True)
    np.testing.assert_allclose(dark.ratio, found.ratio, rtol=0.02, atol=0.1)


def test_classes_that_overlap_are_measured_apart() -> None:
    """Otsu's halves hold some of both phases, so that their means are nearer to each other: off the surface they are
    not."""
    scan = load(noisy(tubes(48), 250), lazy=True)
    found = room.GreyEvidence.of(scan, apart=True)
    assert found.first.faint and room.GreyEvidence.of(scan).classes == found.first
    assert abs(found.classes.middle - 80) < abs(found.first.middle - 80) / 1.3
    clear = room.GreyEvidence.of(load(noisy(tubes(), 25), lazy=True), apart=True)
    assert clear.classes == clear.first


def test_a_rare_structure_needs_a_threshold_and_is_told_so() -> None:
    ball = np.linalg.norm(np.mgrid[:48, :48, :48] - 23.5, axis=0) < 2.9
    scan, said = noisy(ball, 10), "give a threshold"
    assert said in " ".join(segment(scan, weight=1.0, working=Working(steps=1)).notes)
    assert said not in " ".join(segment(noisy(tubes(), 60), weight=1.0, working=Working(steps=1)).notes)
    given = segment(scan, threshold=80.0, working=Working(steps=30))
    assert said not in " ".join(given.notes) and dice(given.mask.values, ball) > 0.9
    assert given.status.startswith("no prior helps here") and given.coefficients is None and given.weight is None
    found = of_intensities(scan, 80.0)
    assert dice(found.level > 0, ball) > 0.9
    assert np.median(found.ratio[ball]) > 40 > -40 > np.median(found.ratio[~ball])


def test_a_prior_comes_in_the_scan_s_unit(tmp_path: Path) -> None:
    fit = made_fit()
    path = tmp_path / "fit.json"
    path.write_text(fit.to_json())
    mm, um = (Volume(np.zeros((4, 4, 4)), (h,) * 3, unit) for h, unit in ((0.0195, "mm"), (19.5, "um")))
    assert law_of(path, mm)[0] == fit.coefficients_physical
    law, notes = law_of(str(path), um)
    assert law.as_dict() == pytest.approx(fit.coefficients_physical.in_unit(1e-3).as_dict())
    assert "mm" in notes[0] and "µm" in notes[0]
    with pytest.raises(ValueError, match="--unit"):
        law_of(path, Volume(np.zeros((4, 4, 4))))
    with pytest.raises(ValueError, match="preset"):
        law_of("tube", mm)
    with pytest.raises(FileNotFoundError):
        law_of(tmp_path / "none.json", mm)
    working = law_of("tubes", um)[0].in_unit(19.5 / 0.01)
    assert working.as_dict() == pytest.approx(preset("tubes").coefficients.as_dict())


@pytest.mark.parametrize(
    ("status", "count"),
    [("Supported (nearest match): …", 0), ("No believable twin (nearest match): …", 1)],
)
def test_a_prior_that_is_not_supported_is_said_to_be_so(status: str, count: int) -> None:
    mm = Volume(np.zeros((4, 4, 4)), (0.0195,) * 3, "mm")
    fit = dataclasses.replace(made_fit(), status=status)
    assert law_of(fit, mm)[1] == (f"{fit.to_law().doubt} Compare the mask with the scan.",) * count


def test_axes_are_refined_and_brought_back() -> None:
    place = WorkingGrid.of(Volume(np.zeros((6, 7, 8)), (2.5, 1.0, 1.0)), None)
    assert place.times == (3, 1, 1) and place.grid.shape == (18, 7, 8) and place.epsilon == 2
    assert min(place.grid.spacing) * 100 == pytest.approx(2.5 / 3)
    values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    shared = place.spread(values)
    assert float(shared.sum()) == pytest.approx(float(values.sum()), rel=1e-5)
    np.testing.assert_allclose(place.to_scan(3 * shared), values, rtol=1e-6)
    held = place.spread(values, centre=0)
    np.testing.assert_array_equal(held[1::3].numpy(), values)
    assert not held[0::3].any() and not held[2::3].any()


@pytest.mark.parametrize("scale", [1e-3, 40.0])
def test_a_segmentation_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    truth = tubes(24)
    law = preset("tubes").coefficients.in_unit(0.01)
    one = segment(noisy(truth, 60), law, weight=2.0, working=Working(steps=100))
    other = segment(
        noisy(truth, 60, spacing=(scale,) * 3), law.in_unit(1 / scale), weight=2.0, working=Working(steps=100)
    )
    assert one.weight == pytest.approx(other.weight, rel=1e-4)
    assert (one.mask.values != other.mask.values).mean() < 1e-3


@pytest.mark.slow
def test_noisy_tubes_come_out_better_than_from_a_threshold_at_any_smoothing() -> None:
    truth = tubes()
    scan = noisy(truth, 90, spacing=(0.02,) * 3, unit="mm", affine=np.diag([-0.02, 0.02, 0.02, 1]))
    found = segment(scan, working=Working(steps=100))
    others = []
    for width in (0, 0.7, 1, 1.5, 2, 3):
        smooth = ndimage.gaussian_filter(scan.values, width)
        others.append(dice(smooth > threshold_otsu(smooth), truth))
    assert dice(found.mask.values, truth) > max(others) + 0.01
    assert found.mask.spacing == scan.spacing and found.mask.unit == "mm"
    assert np.array_equal(found.mask.affine, scan.affine)  # type: ignore[arg-type]
    assert found.mask.values.dtype == bool and np.array_equal(found.mask.values, found.phase.values > 0)
    assert found.coefficients == WILLMORE and found.weight == 0.3


@pytest.mark.slow
def test_anisotropic_scans_keep_their_grid() -> None:
    truth = tubes(36)[1::3]
    scan = noisy(truth, 40, spacing=(3.0, 1.0, 1.0))
    found = segment(scan, WILLMORE, working=Working(steps=100))
    assert found.mask.shape == truth.shape and found.mask.spacing == (3.0, 1.0, 1.0)
    assert any("z 3-fold" in note for note in found.notes)
    assert dice(found.mask.values, truth) > 0.93


def test_a_prior_s_scale_does_not_matter_but_its_weight_does() -> None:
    """But for voxels at the surface: the two flows round otherwise."""
    scan = noisy(tubes(), 60)
    one, thrice = (segment(scan, WILLMORE.scale(by), weight=1 / by, working=Working(steps=100)) for by in (1, 3))
    assert (one.mask.values != thrice.mask.values).mean() < 1e-3
    weak, strong = (
        segment(scan, WILLMORE, weight=weight, working=Working(steps=100)).mask.values for weight in (0.01, 30)
    )
    bright = scan.values > 80
    assert (weak == bright).mean() > (strong == bright).mean() + 0.001


def test_a_prior_that_is_too_strong_says_so() -> None:
    ball = np.linalg.norm(np.mgrid[:20, :20, :20] - 9.5, axis=0) < 4
    found = segment(noisy(ball, 30), Coefficients(1, 2, 1, 0, 0, 1.0), weight=1e4, working=Working(steps=400))
    assert found.status.startswith("no surface is left") and not found.mask.values.any()


def crossed(shape: tuple[int, int, int] = (24, 26, 28), at: float = 0.0) -> np.ndarray:
    """Two crossing tubes, none thinner than seven voxels."""
    z, y, x = (np.arange(n).reshape([-1 if k == axis else 1 for k in range(3)]) - n / 2 for axis, n in enumerate(shape))
    return (np.hypot(z + 5 + at, y) < 4) | (np.hypot(z - 4 + 0.2 * y, x - at) < 3.5)


def network(truth: np.ndarray, seed: int) -> np.ndarray:
    """Probabilities that are far too sure, with errors that lie side by side."""
    noise = np.random.default_rng(seed).standard_normal(truth.shape)
    ratio = 5 * (2 * truth - 1) + 9 * ndimage.gaussian_filter(noise, 0.8) * 4
    return (1 / (1 + np.exp(-ratio))).astype(np.float32)


refine = partial(segment, probabilities=True)


def test_a_probability_is_its_own_evidence() -> None:
    p = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    p[0, 0, :2] = 0, 1
    found = room.probability_evidence(Volume(p))
    np.testing.assert_allclose(1 / (1 + np.exp(-found.ratio.astype(float))), p.clip(1e-4, 1 - 1e-4), atol=1e-6)
    assert np.array_equal(found.level > 0, p > 0.5)
    for bad in (2 * p, p - 1e-3):
        with pytest.raises(ValueError, match="probabilities"):
            room.probability_evidence(Volume(bad))


#: Turned about z, with the shift and the mirrored axis of a real scanner.
TURNED = np.array([[-0.5, 0.02, 0, 17.3], [0.02, 0.4, 0, -3.2], [0, 0, 1.2, 40], [0, 0, 0, 1]])


def predicted(folder: Path, name: str, p: np.ndarray) -> Path:
    """A case as nnU-Net writes it with --save_probabilities: classes z, y, x in an NPZ beside the segmentation."""
    folder.mkdir(exist_ok=True)
    image = nibabel.Nifti1Image((p > 0.5).astype(np.uint8).T, TURNED)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, folder / f"{name}.nii.gz")
    path = folder / f"{name}.npz"
    np.savez_compressed(path, probabilities=np.stack((1 - p, p)).astype(np.float16))
    return path


def test_nnu_net_s_probabilities_lie_where_its_segmentation_does(tmp_path: Path) -> None:
    p = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)
    path = predicted(tmp_path, "case.7", p)
    found, image = load_probabilities(path, channel=1), load(tmp_path / "case.7.nii.gz")
    np.testing.assert_allclose(found.values, p, atol=1e-3)
    assert found.spacing == image.spacing == pytest.approx((1.2, 0.4, 0.5), 2e-3) and found.unit == "mm"
    assert np.array_equal(found.affine, image.affine)  # type: ignore[arg-type]
    np.testing.assert_allclose(load_probabilities(path, channel=0).values, 1 - p, atol=1e-3)
    part = load_probabilities(path, channel=1, crop="1:,:4,2:")
    np.testing.assert_array_equal(part.affine @ [0, 0, 0, 1], image.affine @ [2, 0, 1, 1])  # type: ignore[operator]
    told = load_probabilities(path, channel=1, spacing=2.0, unit="um")
    assert (told.spacing, told.unit, told.affine) == ((2.0, 2.0, 2.0), "um", None)
    alike = load_probabilities(p, like=tmp_path / "case.7.nii.gz")
    assert alike.spacing == image.spacing and np.array_equal(alike.affine, image.affine)  # type: ignore[arg-type]
    np.save(tmp_path / "other.npy", np.zeros((3, 3, 3)))
    other = {"like": tmp_path / "other.npy", "channel": 1}
    twice = {"like": tmp_path / "case.7.nii.gz", "spacing": 2, "channel": 1}
    for options, word in ((other, "shape"), (twice, "spacing"), ({}, "channel"), ({"channel": 2}, "channel")):
        with pytest.raises(ValueError, match=word):
            load_probabilities(path, **options)
    path = predicted(tmp_path, "empty", 0.4 * p)
    empty = refine(path, WILLMORE, channel=1, weight=1.0)
    assert not empty.mask.values.any() and empty.mask.unit == "mm" and empty.status == "0.00 % of the volume is inside"


def test_perfect_probabilities_stay() -> None:
    truth = crossed()
    p = truth.astype(np.float32)
    found = refine(p, "tubes", example=(p, truth), working=Working(steps=5))
    assert np.array_equal(found.mask.values, truth) and found.coefficients is None and found.weight is None
    assert found.status.startswith("no prior helps here: Dice 1.000 on the example, ")
    assert np.array_equal(found.phase.values > 0, truth)
    assert dice(refine(p, WILLMORE, weight=1e-3).mask.values, truth) > 0.98
    learned = calibrate(p, truth, WILLMORE, working=Working(steps=5))
    p = np.random.default_rng(0).random((12, 13, 14)).astype(np.float32)
    p[0] = 0.5
    found = refine(p, WILLMORE, example=learned)  # where no prior helps, the mask is what is likely
    assert np.array_equal(found.mask.values, p > 0.5) and found.status.startswith(f"{learned}; ")


@pytest.mark.slow
def test_an_example_chooses_a_weight_that_helps_elsewhere() -> None:
    one, other = crossed(), crossed(at=1.5)
    p = network(other, 1)
    learned = calibrate(network(one, 0), one, WILLMORE, working=Working(steps=150))
    found = refine(p, WILLMORE, example=learned, working=Working(steps=150))
    assert dice(found.mask.values, other) > dice(p > 0.5, other) + 0.05
    assert found.coefficients == WILLMORE and found.weight == learned.trial.strength
    assert f"the prior helps, at {found.weight:g} nats: Dice {learned.trial.score:.3f} on the example" in found.status
    again = refine(p, WILLMORE, example=(network(one, 0), one), working=Working(steps=150))
    assert np.array_equal(again.mask.values, found.mask.values) and again.status == found.status


def test_law_and_weight_together_or_evidence_and_weight_together_change_nothing() -> None:
    """But for voxels at the surface: the flows round otherwise."""
    p = network(crossed(), 0).clip(0.02, 0.98)
    odds = (p / (1 - p)) ** 2
    one = refine(p, WILLMORE, weight=6.0, working=Working(steps=100))
    for sure, law, weight in ((p, WILLMORE.scale(3), 2.0), (odds / (1 + odds), WILLMORE, 12.0)):
        other = refine(sure, law, weight=weight, working=Working(steps=100))
        assert other.weight == pytest.approx(weight) and (one.mask.values != other.mask.values).mean() < 1e-3


@pytest.mark.parametrize("p", [np.linspace(0, 0.5, 1000, dtype=np.float32), np.linspace(0.6, 1, 1000)])
def test_a_map_without_a_surface_stays(p: np.ndarray) -> None:
    found = refine(p.reshape(10, 10, 10), WILLMORE, weight=1.0)
    assert np.array_equal(found.mask.values, p.reshape(10, 10, 10) > 0.5)


MAP = network(crossed(), 0)
TAUGHT, GREY = {"example": (MAP, crossed())}, {"probabilities": False}
#: What `segment` refuses of a map of probabilities, by a word of the sentence.
REFUSALS: dict[str, list[dict]] = {
    "neither": [{}], "both": [{"weight": 1.0, **TAUGHT}], "logits": [{"weight": 1.0, "probabilities": "odds"}],
    "weight": [{"weight": 0.0}, {**GREY, "weight": 0.0}], "dark": [{"weight": 1.0, "dark": True}],
    "example": [{**GREY, **TAUGHT}], "channel": [{"weight": 1.0, "channel": 1}], "label": [{**TAUGHT, "label": 3}],
    "epsilon": [{"weight": 1.0, "epsilon": -1.0}, {**GREY, "epsilon": math.inf}],
    "shape": [{"example": (MAP, crossed()[1:])}], "empty": [{"example": (MAP, np.zeros(MAP.shape))}],
    "full": [{"example": (MAP, np.ones(MAP.shape))}], "labels": [{"example": (MAP, MAP)}],
    "probabilities": [{"example": (2 * MAP, crossed())}], "spacing": [{"example": (Volume(MAP, 0.5), crossed())}],
    "--unit": [{"weight": 1.0, "prior": made_fit()}], "preset": [{**TAUGHT, "prior": "tube"}],
    "a20": [{**options, "prior": (1, 0, -2)} for options in ({"weight": 1.0}, TAUGHT, GREY)],
    "finite": [{**options, "scan": np.where(np.indices(MAP.shape)[0] == 3, bad, MAP)}
               for options, bad in (({"weight": 1.0}, math.nan), (GREY, math.inf))],
    "threshold": [{**GREY, "threshold": 500.0}], "otsu": [{**GREY, "threshold": "li"}],
    "coefficients": [{**GREY, "prior": (torch.ones(32, 32, 32), 0, 1)}],
}  # fmt: skip


@pytest.mark.parametrize("word", REFUSALS)
@pytest.mark.filterwarnings("ignore:a20 > 0:UserWarning")
def test_what_cannot_be_judged_is_refused(word: str) -> None:
    for options in REFUSALS[word]:
        prior = options.get("prior", WILLMORE)
        prior = Coefficients(*prior) if isinstance(prior, tuple) else prior
        with pytest.raises(ValueError, match=word):
            refine(**grouped(**{"scan": MAP, "steps": 1, **options, "prior": prior}))


def test_a_mask_is_at_the_probabilities_place() -> None:
    truth = crossed((14, 15, 16))
    chances = Volume(network(truth, 0), (1.2, 0.4, 0.5), "mm", TURNED)
    for unit, factor in (("mm", 1), ("um", 1e3), ("voxel", 1)):
        spacing = (1.2 * factor, 0.4 * factor, 0.5 * factor)
        there = np.diag([factor] * 3 + [1]) @ TURNED
        learned = calibrate(chances, Volume(truth, spacing, unit, there), WILLMORE, working=Working(steps=1))
        assert learned.example is chances
        moved = there.copy()
        moved[0, 3] += 0.5 * factor
        with pytest.raises(ValueError, match="affine"):
            calibrate(chances, Volume(truth, spacing, unit, moved), WILLMORE, working=Working(steps=1))


def test_a_map_is_segmented_in_monai_s_chain() -> None:
    monai = pytest.importorskip("monai.transforms", reason="needs monai, of the group dev")
    logits = torch.from_numpy(np.log(np.stack((1 - MAP, MAP)) + 1e-6))
    options = grouped(weight=3.0, steps=5)
    step = monai.Lambda(lambda p: torch.from_numpy(refine(p[1], WILLMORE, **options).mask.values)[None])
    mask = monai.Compose([monai.Activations(softmax=True), step])(logits)
    odds = segment(torch.logit(torch.softmax(logits, 0)[1]), WILLMORE, probabilities="logits", **options)
    assert mask.shape == (1, *MAP.shape) and (mask[0].numpy() != odds.mask.values).mean() < 1e-3


def test_the_command_keeps_the_header_and_says_what_was_chosen(tmp_path: Path) -> None:
    path, target = predicted(tmp_path / "in", "a", MAP), tmp_path / "new" / "mask.nii.gz"
    other = predicted(tmp_path / "in", "b", network(crossed(), 3))
    labels = Volume(np.where(crossed(), 3, 1).astype(np.uint8), (1.2, 0.4, 0.5), "mm", TURNED)
    save(labels, tmp_path / "truth.nii.gz")
    options = ("--probabilities", "--channel", 1, "--prior", "tubes", "--steps", 10, "--label", 3)
    example = ("--example", tmp_path / "truth.nii.gz", "--example-probabilities", other)
    result = done("segment", path, *options, *example, "-o", target)
    one, mask = (nibabel.load(each) for each in (path.with_suffix(".nii.gz"), target))
    assert mask.affine.tobytes() == one.affine.tobytes() and mask.shape == one.shape  # type: ignore[attr-defined]
    record = json.loads((target.parent / "mask.json").read_text())
    assert (record["job"], record["steps"], record["example_probabilities"]) == ("segment", 10, str(other))
    chosen = record["calibration"]
    assert record["status"].startswith("no prior helps here" if chosen["law"] is None else "the ")
    assert f"Dice {max(chosen['dice'], chosen['dice_without']):.3f}" in result.stdout
    assert sorted(each.name for each in target.parent.iterdir()) == ["mask.json", "mask.nii.gz", "mask.png"]


@pytest.mark.slow
def test_a_folder_of_predictions_is_segmented_by_one_example(tmp_path: Path) -> None:
    for name, at in (("a", 0.0), ("b", 1.5), ("c.d", 0.7)):
        predicted(tmp_path / "in", name, network(crossed(at=at), 5))
    example = predicted(tmp_path, "example", network(crossed(), 6))
    truth = tmp_path / "truth.npy"
    np.save(truth, crossed())
    options = ("--probabilities", "--channel", 1, "--prior", "tubes", "--steps", 2, "--example", truth)
    options = (*options, "--example-probabilities", example)
    done("segment", tmp_path / "in", *options, "-o", tmp_path / "out")
    tried = [json.loads(path.read_text())["calibration"] for path in sorted((tmp_path / "out").glob("*.json"))]
    assert len(tried) == 3 and tried[0] == tried[1] == tried[2]
    masks = sorted(path.name for path in (tmp_path / "out").glob("*.nii.gz"))
    assert masks == ["a.nii.gz", "b.nii.gz", "c.d.nii.gz"]
    for name in masks:
        one, other = (load(tmp_path / folder / name) for folder in ("in", "out"))
        assert np.array_equal(one.affine, other.affine)  # type: ignore[arg-type]
    done("segment", tmp_path / "in" / "b.npz", *options, "-o", tmp_path / "b.nii.gz")
    assert np.array_equal(load(tmp_path / "b.nii.gz").values, load(tmp_path / "out" / "b.nii.gz").values)
    refused(call("segment", tmp_path / "in", *options, "-o", tmp_path / "in"), "input")
    refused(call("segment", tmp_path / "in", *options, "--like", truth, "-o", tmp_path / "more"), "--like")
    predicted(tmp_path / "in", "z", 1.5 * network(crossed(), 5))
    refused(call("segment", tmp_path / "in", *options, "-o", tmp_path / "more"), "probabilities")
    assert not (tmp_path / "more").exists()
