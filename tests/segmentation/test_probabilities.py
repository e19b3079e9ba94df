"""`segment` of a network's probabilities: evidence and place, what an example says, the command, and MONAI."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from calling import call, refused
from found import made_fit
from scipy import ndimage

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation import calibrate, segment
from curvafit.segmentation.evidence import load_probabilities, probability_evidence
from curvafit.segmentation.trials import dice
from curvafit.volumes.field import Field
from curvafit.volumes.read import load
from curvafit.volumes.write import save

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def tubes(shape: tuple[int, int, int] = (24, 26, 28), at: float = 0.0) -> np.ndarray:
    """Two crossing tubes, none thinner than seven voxels."""
    z, y, x = (np.arange(n).reshape([-1 if k == axis else 1 for k in range(3)]) - n / 2 for axis, n in enumerate(shape))
    return (np.hypot(z + 5 + at, y) < 4) | (np.hypot(z - 4 + 0.2 * y, x - at) < 3.5)


def network(truth: np.ndarray, seed: int) -> np.ndarray:
    """Probabilities that are far too sure, with errors that lie side by side."""
    noise = np.random.default_rng(seed).standard_normal(truth.shape)
    ratio = 5 * (2 * truth - 1) + 9 * ndimage.gaussian_filter(noise, 0.8) * 4
    return (1 / (1 + np.exp(-ratio))).astype(np.float32)


refine = partial(segment, probabilities=True)


# ---- evidence and place ----------------------------------------------------------------------------------------------


def test_a_probability_is_its_own_evidence() -> None:
    p = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    p[0, 0, :2] = 0, 1
    found = probability_evidence(Field(p))
    np.testing.assert_allclose(1 / (1 + np.exp(-found.ratio.astype(float))), p.clip(1e-4, 1 - 1e-4), atol=1e-6)
    assert np.array_equal(found.level > 0, p > 0.5)
    for bad in (2 * p, p - 1e-3):
        with pytest.raises(ValueError, match="probabilities"):
            probability_evidence(Field(bad))


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
    assert (found.spacing, found.unit) == (image.spacing, "mm") and found.spacing == pytest.approx(
        (1.2, 0.4, 0.5), 2e-3
    )
    assert np.array_equal(found.affine, image.affine)  # type: ignore[arg-type]
    np.testing.assert_allclose(load_probabilities(path, channel=0).values, 1 - p, atol=1e-3)
    part = load_probabilities(path, channel=1, crop="1:,:4,2:")
    np.testing.assert_array_equal(part.affine @ [0, 0, 0, 1], image.affine @ [2, 0, 1, 1])  # type: ignore[operator]
    told = load_probabilities(path, channel=1, spacing=2.0, unit="um")
    assert (told.spacing, told.unit, told.affine) == ((2.0, 2.0, 2.0), "um", None)
    alike = load_probabilities(p, like=tmp_path / "case.7.nii.gz")
    assert alike.spacing == image.spacing and np.array_equal(alike.affine, image.affine)  # type: ignore[arg-type]


def test_an_empty_segmentation_says_where_the_voxels_are(tmp_path: Path) -> None:
    path = predicted(tmp_path, "empty", 0.4 * np.random.default_rng(0).random((5, 6, 7)).astype(np.float32))
    found = refine(path, WILLMORE, channel=1, weight=1.0)
    assert not found.mask.values.any() and found.mask.unit == "mm" and found.status == "0.00 % of the volume is inside"


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"like": "other.npy"}, "shape"),
        ({"like": "case.nii.gz", "spacing": 2}, "spacing"),
        ({}, "channel"),
        ({"channel": 2}, "channel"),
    ],
)
def test_a_place_that_does_not_fit_is_refused(options, word, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    predicted(tmp_path, "case", np.random.default_rng(0).random((5, 6, 7)))
    np.save("other.npy", np.zeros((3, 3, 3)))
    with pytest.raises(ValueError, match=word):
        load_probabilities("case.npz", **({"channel": 1} | options if options else {}))


# ---- what comes out --------------------------------------------------------------------------------------------------


def test_perfect_probabilities_stay() -> None:
    truth = tubes()
    p = truth.astype(np.float32)
    found = refine(p, "tubes", example=(p, truth), steps=5)
    assert np.array_equal(found.mask.values, truth) and found.coefficients is None and found.weight is None
    assert found.status.startswith("no prior helps here: Dice 1.000 on the example, ")
    assert np.array_equal(found.phase.values > 0, truth)
    assert dice(refine(p, WILLMORE, weight=1e-3).mask.values, truth) > 0.98


def test_where_no_prior_helps_the_mask_is_what_is_likely() -> None:
    learned = calibrate(tubes().astype(np.float32), tubes(), WILLMORE, steps=5)
    p = np.random.default_rng(0).random((12, 13, 14)).astype(np.float32)
    p[0] = 0.5
    found = refine(p, WILLMORE, example=learned)
    assert np.array_equal(found.mask.values, p > 0.5) and found.status.startswith(f"{learned}; ")


@pytest.mark.slow
def test_an_example_chooses_a_weight_that_helps_elsewhere() -> None:
    one, other = tubes(), tubes(at=1.5)
    p = network(other, 1)
    learned = calibrate(network(one, 0), one, WILLMORE, steps=150)
    found = refine(p, WILLMORE, example=learned, steps=150)
    assert dice(found.mask.values, other) > dice(p > 0.5, other) + 0.05
    assert found.coefficients == WILLMORE and found.weight == learned.trial.strength
    assert f"the prior helps, at {found.weight:g} nats: Dice {learned.trial.score:.3f} on the example" in found.status
    again = refine(p, WILLMORE, example=(network(one, 0), one), steps=150)
    assert np.array_equal(again.mask.values, found.mask.values) and again.status == found.status


def test_law_and_weight_together_or_evidence_and_weight_together_change_nothing() -> None:
    """But for voxels at the surface: the flows round otherwise."""
    p = network(tubes(), 0).clip(0.02, 0.98)
    odds = (p / (1 - p)) ** 2
    one = refine(p, WILLMORE, weight=6.0, steps=100)
    for sure, law, weight in ((p, WILLMORE.scale(3), 2.0), (odds / (1 + odds), WILLMORE, 12.0)):
        other = refine(sure, law, weight=weight, steps=100)
        assert other.weight == pytest.approx(weight) and (one.mask.values != other.mask.values).mean() < 1e-3


@pytest.mark.parametrize("p", [np.linspace(0, 0.5, 1000, dtype=np.float32), np.linspace(0.6, 1, 1000)])
def test_a_map_without_a_surface_stays(p: np.ndarray) -> None:
    found = refine(p.reshape(10, 10, 10), WILLMORE, weight=1.0)
    assert np.array_equal(found.mask.values, p.reshape(10, 10, 10) > 0.5)


MAP = network(tubes(), 0)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({}, "neither"),
        ({"weight": 1.0, "example": (MAP, tubes())}, "both"),
        ({"weight": 0.0}, "weight"),
        ({"weight": 1.0, "probabilities": "odds"}, "logits"),
        ({"weight": 1.0, "dark": True}, "dark"),
        ({"probabilities": False, "example": (MAP, tubes())}, "example"),
        ({"weight": 1.0, "epsilon": -1.0}, "epsilon"),
        ({"weight": 1.0, "channel": 1}, "channel"),
        ({"example": (MAP, tubes()[1:])}, "shape"),
        ({"example": (MAP, np.zeros(MAP.shape))}, "empty"),
        ({"example": (MAP, np.ones(MAP.shape))}, "full"),
        ({"example": (MAP, MAP)}, "labels"),
        ({"example": (2 * MAP, tubes())}, "probabilities"),
        ({"example": (Field(MAP, 0.5), tubes())}, "spacing"),
        ({"example": (MAP, tubes()), "label": 3}, "label"),
        ({"weight": 1.0, "prior": made_fit()}, "--unit"),
        ({"example": (MAP, tubes()), "prior": "tube"}, "preset"),
    ],
)
def test_what_cannot_be_judged_is_refused(options, word) -> None:
    with pytest.raises(ValueError, match=word):
        refine(MAP, **{"prior": WILLMORE, **options})


def test_values_that_are_not_finite_are_refused() -> None:
    p = MAP.copy()
    p[3, 4, 5] = math.nan
    with pytest.raises(ValueError, match="finite"):
        refine(p, WILLMORE, weight=1.0)


@pytest.mark.filterwarnings("ignore:a20 > 0:UserWarning")
def test_a_law_without_stiffness_is_refused() -> None:
    for judge in ({"weight": 1.0}, {"example": (MAP, tubes())}):
        with pytest.raises(ValueError, match="a20"):
            refine(MAP, Coefficients(1, 0, -2), **judge)


def test_a_mask_is_at_the_probabilities_place() -> None:
    truth = tubes((14, 15, 16))
    chances = Field(network(truth, 0), (1.2, 0.4, 0.5), "mm", TURNED)
    for unit, factor in (("mm", 1), ("um", 1e3), ("voxel", 1)):
        spacing = (1.2 * factor, 0.4 * factor, 0.5 * factor)
        there = np.diag([factor] * 3 + [1]) @ TURNED
        learned = calibrate(chances, Field(truth, spacing, unit, there), WILLMORE, steps=1)
        assert learned.example is chances
        moved = there.copy()
        moved[0, 3] += 0.5 * factor
        with pytest.raises(ValueError, match="affine"):
            calibrate(chances, Field(truth, spacing, unit, moved), WILLMORE, steps=1)


def test_a_map_is_segmented_in_monai_s_chain() -> None:
    monai = pytest.importorskip("monai.transforms", reason="needs monai, of the extra [dev]")
    logits = torch.from_numpy(np.log(np.stack((1 - MAP, MAP)) + 1e-6))
    options = {"weight": 3.0, "steps": 5}
    step = monai.Lambda(lambda p: torch.from_numpy(refine(p[1], WILLMORE, **options).mask.values)[None])
    mask = monai.Compose([monai.Activations(softmax=True), step])(logits)
    odds = segment(torch.logit(torch.softmax(logits, 0)[1]), WILLMORE, probabilities="logits", **options)
    assert mask.shape == (1, *MAP.shape) and (mask[0].numpy() != odds.mask.values).mean() < 1e-3


# ---- the command -----------------------------------------------------------------------------------------------------


def test_the_command_keeps_the_header_and_says_what_was_chosen(tmp_path: Path) -> None:
    path, target = predicted(tmp_path / "in", "a", MAP), tmp_path / "new" / "mask.nii.gz"
    other = predicted(tmp_path / "in", "b", network(tubes(), 3))
    labels = Field(np.where(tubes(), 3, 1).astype(np.uint8), (1.2, 0.4, 0.5), "mm", TURNED)
    save(labels, tmp_path / "truth.nii.gz")
    told = (
        "segment",
        path,
        "--probabilities",
        "--channel",
        1,
        "--prior",
        "tubes",
        "--steps",
        10,
        "--example",
        tmp_path / "truth.nii.gz",
    )
    told = (*told, "--example-probabilities", other, "--label", 3, "-o", target)
    result = call(*told)
    assert result.exit_code == 0, (result.output, result.exception)
    one, mask = (nibabel.load(each) for each in (path.with_suffix(".nii.gz"), target))
    assert mask.affine.tobytes() == one.affine.tobytes() and mask.shape == one.shape  # type: ignore[attr-defined]
    record = json.loads((target.parent / "mask.json").read_text())
    assert (record["job"], record["steps"], record["example_probabilities"]) == ("segment", 10, str(other))
    chosen = record["calibration"]
    assert record["status"].startswith("no prior helps here" if chosen["law"] is None else "the ")
    assert (
        0 < chosen["dice_without"] <= 1 and f"Dice {max(chosen['dice'], chosen['dice_without']):.3f}" in result.stdout
    )
    assert sorted(each.name for each in target.parent.iterdir()) == ["mask.json", "mask.nii.gz", "mask.png"]


@pytest.mark.slow
def test_a_folder_of_predictions_is_segmented_by_one_example(tmp_path: Path) -> None:
    for name, at in (("a", 0.0), ("b", 1.5), ("c.d", 0.7)):
        predicted(tmp_path / "in", name, network(tubes(at=at), 5))
    example = predicted(tmp_path, "example", network(tubes(), 6))
    truth = tmp_path / "truth.npy"
    np.save(truth, tubes())
    options = ("--probabilities", "--channel", 1, "--prior", "tubes", "--steps", 2, "--example", truth)
    options = (*options, "--example-probabilities", example)
    result = call("segment", tmp_path / "in", *options, "-o", tmp_path / "out")
    assert result.exit_code == 0, (result.output, result.exception)
    tried = [json.loads(path.read_text())["calibration"] for path in sorted((tmp_path / "out").glob("*.json"))]
    assert len(tried) == 3 and tried[0] == tried[1] == tried[2]
    masks = sorted(path.name for path in (tmp_path / "out").glob("*.nii.gz"))
    assert masks == ["a.nii.gz", "b.nii.gz", "c.d.nii.gz"]
    for name in masks:
        one, other = (load(tmp_path / folder / name) for folder in ("in", "out"))
        assert np.array_equal(one.affine, other.affine)  # type: ignore[arg-type]
    single = call("segment", tmp_path / "in" / "b.npz", *options, "-o", tmp_path / "b.nii.gz")
    assert single.exit_code == 0
    assert np.array_equal(load(tmp_path / "b.nii.gz").values, load(tmp_path / "out" / "b.nii.gz").values)
    refused(call("segment", tmp_path / "in", *options, "-o", tmp_path / "in"), "input")
    refused(call("segment", tmp_path / "in", *options, "--like", truth, "-o", tmp_path / "more"), "--like")
    predicted(tmp_path / "in", "z", 1.5 * network(tubes(), 5))
    refused(call("segment", tmp_path / "in", *options, "-o", tmp_path / "more"), "probabilities")
    assert not (tmp_path / "more").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("--example truth.npy", "--example-probabilities"),
        ("--weight 1 --dark", "dark"),
        ("--prior tubes --weight 1 --like small.npy", "shape"),
        ("--prior tubes --example small.npy --example-probabilities p.npy", "shape"),
        ("--prior tubes --example truth.npy --example-probabilities grey.npy", "probabilities"),
        ("--prior tubes --example truth.npy --example-probabilities p.npy --label 4", "label"),
    ],
)
def test_wrong_input_is_a_sentence_and_writes_nothing(arguments, word, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("p.npy", MAP)
    np.save("grey.npy", 100 * MAP)
    np.save("truth.npy", tubes())
    np.save("small.npy", np.arange(125.0).reshape(5, 5, 5) > 60)
    result = call("segment", "p.npy", "--probabilities", *arguments.split(), "-o", "mask.nii.gz")
    said = result.stderr.strip().splitlines()[-1]
    assert result.exit_code == 2 and said.startswith("error: ") and word in said, (result.output, result.exception)
    assert not list(tmp_path.glob("*mask*"))
