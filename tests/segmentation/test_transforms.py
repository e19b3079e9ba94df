"""Labels that are filled in MONAI's chains, by its `Lambdad`."""

from functools import partial
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
from monai.transforms import Compose, EnsureChannelFirstd, Lambdad, LoadImaged
from monai.utils import convert_to_dst_type

pytestmark = pytest.mark.filterwarnings("ignore:NvImgCodecPydicomReader")  # MONAI misses a reader of DICOM

SPACING = (0.5, 0.25, 0.25)


def some_slices() -> np.ndarray:
    """Slices other than every sixth are empty."""
    labels = organelles()[:13]
    labels[np.arange(13) % 6 != 0] = 0
    return labels


def fill(label: MetaTensor, axis: int = 0) -> MetaTensor:
    """As in docs/howto/reconstruct.md."""
    filled = reconstruct_labels(label[0], every=6, axis=axis, spacing=label.pixdim.tolist())
    return convert_to_dst_type(filled.labels.values[None], label)[0]  # type: ignore[union-attr, return-value]


def fill_with_image(data: dict[str, MetaTensor]) -> dict[str, MetaTensor]:
    """As in docs/howto/reconstruct.md."""
    label, image = data["label"], data["image"][0]
    filled = reconstruct_labels(label[0], image=image, every=6, spacing=label.pixdim.tolist())
    return data | {"label": convert_to_dst_type(filled.labels.values[None], label)[0]}  # type: ignore[union-attr, dict-item]


def soften(label: MetaTensor) -> MetaTensor:
    """As in examples/hosts/monai/configs/train.json."""
    filled = reconstruct(label[0], every=6, spacing=label.pixdim.tolist())
    return convert_to_dst_type(filled.probability.values[None], label)[0]  # type: ignore[union-attr, return-value]


def tensor(labels: np.ndarray) -> MetaTensor:
    affine = torch.diag(torch.tensor([*SPACING, 1.0], dtype=torch.float64))
    affine[:3, 3] = torch.tensor([3.0, -2.0, 7.0])
    return MetaTensor(torch.from_numpy(labels)[None].float(), affine=affine)


def test_a_nifti_file_is_filled_in_monai_s_chain_and_stays_where_it_is(tmp_path: Path) -> None:
    labels = some_slices()
    affine = np.array([[0, -0.25, 0, 5], [0.25, 0, 0, -3], [0, 0, 0.5, 2], [0, 0, 0, 1]])
    nibabel.save(nibabel.Nifti1Image(labels.T, affine), tmp_path / "labels.nii.gz")
    read = [LoadImaged("label", reader="NibabelReader"), EnsureChannelFirstd("label")]
    chain = Compose([*read, Lambdad("label", partial(fill, axis=2))])
    source = {"label": tmp_path / "labels.nii.gz"}
    given, found = (Compose(steps)(source)["label"] for steps in (read, chain.transforms))
    assert isinstance(found, MetaTensor) and found.dtype == given.dtype == torch.float32
    assert torch.equal(found.affine, given.affine) and np.allclose(found.affine, affine)
    assert found.meta["filename_or_obj"] == given.meta["filename_or_obj"]
    wanted = reconstruct_labels(Volume(labels.T, SPACING[::-1]), every=6, axis=2).labels
    assert wanted is not None and (wanted.values[..., 3] > 0).any() and not labels[3].any()
    assert np.array_equal(found[0].numpy(), wanted.values)
    assert np.array_equal(given[0].numpy().T, labels)  # what was given is not changed


def test_a_chain_fills_with_the_image() -> None:
    """Where the image shows the structure, the labels follow it more closely than without."""
    whole = (organelles()[:13] > 0).astype(np.uint8)
    noise = np.random.default_rng(0).normal(size=whole.shape)
    image = tensor((100 * whole + 10 * noise).astype(np.float32))
    label = tensor(whole * (np.arange(13) % 6 == 0)[:, None, None])
    found = Compose([fill_with_image])({"image": image, "label": label})["label"]
    assert isinstance(found, MetaTensor) and torch.equal(found.affine, label.affine)
    errors = [np.mean((each[0].numpy() > 0) != whole) for each in (found, fill(label))]
    assert errors[0] < 0.5 * errors[1], errors


def test_targets_are_soft_or_sure() -> None:
    labels = some_slices()
    soft = Lambdad("label", soften)({"label": tensor(labels)})["label"]
    assert isinstance(soft, MetaTensor) and soft.dtype == torch.float32
    wanted = reconstruct(Volume(labels, SPACING), every=6).probability
    assert wanted is not None and np.array_equal(soft[0].numpy(), wanted.values)
    several = reconstruct_labels(Volume(labels, SPACING), every=6)
    assert several.labels is not None and several.probability is not None
    sure = np.where(several.probability.values < 0.8, 11, several.labels.values)
    assert set(np.unique(sure)) == {0, 2, 7, 11} and np.array_equal(sure[::6], labels[::6])
