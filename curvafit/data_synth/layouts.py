"""How a training set lies on disk: where images and labels are, and the list of them that a reader expects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


class About(NamedTuple):
    """The names of a set, its channel and its label, in the list of cases."""

    name: str
    channel: str
    label: str = "structure"


class Layout(NamedTuple):
    """Where the parts of a case are, with `{case}` for its name and `{part}` for a label's; and the list of cases."""

    image: str
    label: str
    part: str
    listing: Callable[[Sequence[str], About], dict[str, Any]]


_NNUNET = "imagesTr/{case}_0000.nii.gz", "labelsTr/{case}.nii.gz"


def _nnunet(cases: Sequence[str], about: About) -> dict[str, Any]:
    """Return the list of the cases by name: what else lies in the folders, such as a killed run's temporary files, does
    not count."""
    image, label = _NNUNET
    listed = {case: {"images": [image.format(case=case)], "label": label.format(case=case)} for case in cases}
    return {
        "channel_names": {"0": about.channel},
        "labels": {"background": 0, about.label: 1},
        "numTraining": len(cases),
        "file_ending": ".nii.gz",
        "name": about.name,
        "description": "synthetic; made by curvafit",
        "dataset": listed,
    }


def _decathlon(image: str, label: str) -> Callable[[Sequence[str], About], dict[str, Any]]:
    def listing(cases: Sequence[str], about: About) -> dict[str, Any]:
        return {
            "name": about.name,
            "description": "synthetic; made by curvafit",
            "tensorImageSize": "3D",
            "modality": {"0": about.channel},
            "labels": {"0": "background", "1": about.label},
            "numTraining": len(cases),
            "numTest": 0,
            "training": [{"image": image.format(case=case), "label": label.format(case=case)} for case in cases],
            "test": [],
        }

    return listing


_DECATHLON = "imagesTr/{case}.nii.gz", "labelsTr/{case}.nii.gz"
_ZARR = "images/{case}.zarr", "labels/{case}.zarr"

#: nnU-Net v2's raw data sets; the Medical Segmentation Decathlon's, which MONAI reads; OME-Zarr with that list.
LAYOUTS: dict[str, Layout] = {
    "nnunet": Layout(*_NNUNET, "parts/{part}/{case}.nii.gz", _nnunet),
    "monai": Layout(*_DECATHLON, "parts/{part}/{case}.nii.gz", _decathlon(*_DECATHLON)),
    "zarr": Layout(*_ZARR, "parts/{part}/{case}.zarr", _decathlon(*_ZARR)),
}
