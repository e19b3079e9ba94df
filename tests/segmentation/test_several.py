"""Several structures between known slices: they exclude each other, keep what is known, and each has its own law."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel
import numpy as np
import pytest
from calling import call, refused

from curvafit.priors.coefficients import Coefficients, preset
from curvafit.segmentation.completion import reconstruct
from curvafit.segmentation.several import labels_of, reconstruct_labels
from curvafit.volumes.scan import Field, ScanError

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
#: Nothing is tried out, and few steps.
QUICK = {"stiffness": 1e7, "steps": 30}


def organelles(shift: int = 0) -> np.ndarray:
    """Two tubes along z that lean towards each other, labels 2 and 7, uint8 (25, 24, 32)."""
    z, y, x = np.indices((25, 24, 32))
    lean = (z + shift) / 8
    one = np.hypot(y - 12, x - 7 - lean) < 5
    other = np.hypot(y - 12, x - 25 + lean) < 5
    return np.where(one, 2, np.where(other, 7, 0)).astype(np.uint8)


def dice(one: np.ndarray, other: np.ndarray) -> float:
    return 2 * float((one & other).sum()) / float(one.sum() + other.sum())


def test_each_label_is_completed_as_alone_and_known_slices_stay() -> None:
    truth = organelles()
    found = reconstruct_labels(truth, {2: preset("tubes"), 7: WILLMORE}, every=6, **QUICK)
    assert found.labels is not None
    values = found.labels.values
    assert values.dtype == np.uint8
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


def test_a_label_that_is_refused_is_interpolated_and_said() -> None:
    truth = organelles()
    truth[0, :4, :4] = 9  # in the first slice alone: no slice can be left out that shows it
    found = reconstruct_labels(truth, WILLMORE, known=[0, 12, 24], chosen=[2, 9], steps=30)
    assert found.labels is not None
    assert np.array_equal(found.labels.values[0] == 9, truth[0] == 9)
    assert not (found.labels.values == 7).any()
    assert "label 9: interpolated by a spline" in found.status or "label 9: no prior" in found.status


@pytest.mark.parametrize(
    ("values", "chosen", "words"),
    [
        (np.zeros((9, 8, 8), np.uint8), None, "labels other than 0"),
        (organelles(), [0, 2], "labels other than 0"),
        (organelles(), [2, 5], r"labels of the known slices \(0, 2, 7\), got 5"),
        (organelles() + 0.5, None, "whole numbers"),
    ],
)
def test_bad_labels_are_refused(values: np.ndarray, chosen: list[int] | None, words: str) -> None:
    with pytest.raises(ScanError, match=words):
        labels_of(values, chosen)


def test_a_label_without_a_law_is_refused() -> None:
    with pytest.raises(ScanError, match="a law for each label, got none for 7"):
        reconstruct_labels(organelles(), {2: WILLMORE}, every=6, **QUICK)


def test_what_is_wrong_with_all_labels_is_an_error() -> None:
    with pytest.raises(ScanError, match="three or more known slices"):
        reconstruct_labels(organelles(), WILLMORE, known=[0, 24], steps=30)


def test_the_command_writes_labels(tmp_path: Path) -> None:
    scan, out = tmp_path / "labels.nii.gz", tmp_path / "volume.nii.gz"
    image = nibabel.Nifti1Image(organelles().T, np.diag([0.5, 0.5, 0.5, 1]))
    image.header.set_xyzt_units("micron")
    nibabel.save(image, scan)
    options = ("--every", 6, "--prior", "tubes", "--stiffness", 1e7, "--steps", 30)
    result = call("reconstruct", scan, *options, "--labels", "all", "-o", out)
    assert result.exit_code == 0, result.output
    written = nibabel.Nifti1Image.from_filename(out)
    assert set(np.unique(np.asarray(written.dataobj))) == {0, 2, 7}
    assert np.array_equal(written.affine, image.affine)
    assert json.loads((tmp_path / "volume.json").read_text(encoding="utf-8"))["labels"] == "all"
    for more, words in (
        (("--labels", "all", "--label", 2), "--labels without --label"),
        (("--labels", "2,5"), "labels of the known slices"),
        (("--labels", "two"), "--labels"),
        (("--labels", "all", "--suggest", 2), "--labels without"),
    ):
        refused(call("reconstruct", scan, *options, *more, "-o", tmp_path / "other.nii.gz"), words)
    assert not list(tmp_path.glob("other*"))


@pytest.mark.slow
def test_the_law_of_each_label_is_inferred_from_the_example(tmp_path: Path) -> None:
    scan, example, out = tmp_path / "labels.npy", tmp_path / "example.npy", tmp_path / "volume.npy"
    np.save(scan, organelles())
    np.save(example, organelles(3))
    result = call("reconstruct", scan, "--every", 6, "--labels", "2,7", "--example", example, "--steps", 30, "-o", out)
    assert result.exit_code == 0, result.output
    truth, values = organelles(), np.load(out)
    assert dice(values == 2, truth == 2) > 0.95
    assert dice(values == 7, truth == 7) > 0.95


def test_a_field_keeps_its_place() -> None:
    affine = np.diag([0.2, 0.2, 0.5, 1.0])
    field = Field(organelles(), (0.5, 0.2, 0.2), "um", affine)
    found = reconstruct_labels(field, WILLMORE, every=6, **QUICK)
    assert found.labels is not None
    assert (found.labels.spacing, found.labels.unit) == (field.spacing, "um")
    assert np.array_equal(found.labels.affine, affine)
