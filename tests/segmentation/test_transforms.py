"""MONAI's transform that fills a label, in MONAI's own chains and caches."""

import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from annotated import organelles

from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.volumes.volume import Volume

pytest.importorskip("monai", reason="needs monai, of the group dev")

from monai.data import MetaTensor
from monai.transforms import Compose, EnsureChannelFirstd, LoadImaged

from curvafit.segmentation import FillSlicesd

pytestmark = pytest.mark.filterwarnings("ignore:NvImgCodecPydicomReader")  # MONAI misses a reader of DICOM

SPACING = (0.5, 0.25, 0.25)


def some_slices() -> np.ndarray:
    """Slices other than every sixth are empty."""
    labels = organelles()[:13]
    labels[np.arange(13) % 6 != 0] = 0
    return labels


def tensor(labels: np.ndarray) -> MetaTensor:
    affine = torch.diag(torch.tensor([*SPACING, 1.0], dtype=torch.float64))
    affine[:3, 3] = torch.tensor([3.0, -2.0, 7.0])
    return MetaTensor(torch.from_numpy(labels)[None].float(), affine=affine)


def test_a_nifti_file_is_filled_in_monai_s_chain_and_stays_where_it_is(tmp_path: Path) -> None:
    labels = some_slices()
    affine = np.array([[0, -0.25, 0, 5], [0.25, 0, 0, -3], [0, 0, 0.5, 2], [0, 0, 0, 1]])
    nibabel.save(nibabel.Nifti1Image(labels.T, affine), tmp_path / "labels.nii.gz")
    read = [LoadImaged("label", reader="NibabelReader"), EnsureChannelFirstd("label")]
    chain = Compose([*read, FillSlicesd("label", every=6, axis=2)])
    source = {"label": tmp_path / "labels.nii.gz"}
    given, found = (Compose(steps)(source)["label"] for steps in (read, chain.transforms))
    assert isinstance(found, MetaTensor) and found.dtype == given.dtype == torch.float32
    assert torch.equal(found.affine, given.affine) and np.allclose(found.affine, affine)
    assert found.meta["filename_or_obj"] == given.meta["filename_or_obj"]
    wanted = reconstruct_labels(Volume(labels.T, SPACING[::-1]), every=6, axis=2).labels
    assert wanted is not None and (wanted.values[..., 3] > 0).any() and not labels[3].any()
    assert np.array_equal(found[0].numpy(), wanted.values)
    assert np.array_equal(given[0].numpy().T, labels)  # what was given is not changed


def test_targets_are_soft_or_sure() -> None:
    labels = some_slices()
    soft = FillSlicesd("label", every=6, soft=True)({"label": tensor(labels)})["label"]
    assert isinstance(soft, MetaTensor) and soft.dtype == torch.float32
    wanted = reconstruct(Volume(labels, SPACING), every=6).probability
    assert wanted is not None and np.array_equal(soft[0].numpy(), wanted.values)
    sure = FillSlicesd("label", every=6, sure=0.8, ignored=11)({"label": tensor(labels)})["label"]
    assert isinstance(sure, MetaTensor) and set(np.unique(sure)) == {0, 2, 7, 11}
    wanted = reconstruct_labels(Volume(labels, SPACING), every=6).keep_sure(0.8, 11)
    assert np.array_equal(sure[0].numpy(), wanted.values)


def test_what_is_no_label_is_refused() -> None:
    noise = np.random.default_rng(0).random((1, 24, 24, 24))
    for label, word in ((np.concatenate([noise, noise]), "channel"), (0 * noise, "other than 0"), (noise, "whole")):
        with pytest.raises(ValueError, match=word):
            FillSlicesd("label", every=6)({"label": label})


def test_without_monai_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import curvafit.segmentation

    monkeypatch.delitem(sys.modules, "curvafit.segmentation.transforms")
    monkeypatch.delitem(curvafit.segmentation.__dict__, "FillSlicesd")
    monkeypatch.setitem(sys.modules, "monai.transforms.transform", None)  # type: ignore[arg-type]
    with pytest.raises(ImportError, match="pip install monai"):
        _ = curvafit.segmentation.FillSlicesd
