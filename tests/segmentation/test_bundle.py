"""The MONAI bundle: trained on annotated slices and run as its users run it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest
from scipy import ndimage

BUNDLE = Path(__file__).parents[2] / "integrations" / "monai"
SPACING = np.diag([0.5, 0.5, 0.5, 1.0])


def run(folder: Path, name: str, *words: str) -> None:
    files = str([f"configs/{each}.json" for each in ("common", name)])
    command = [sys.executable, "-m", "monai.bundle", "run", "--config_file", files, *words]
    subprocess.run(command, cwd=folder, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True)


@pytest.mark.slow
def test_the_bundle_learns_from_slices_and_writes_masks(tmp_path: Path) -> None:
    for package in ("fire", "ignite"):
        pytest.importorskip(package)
    folder = tmp_path / "bundle"
    shutil.copytree(BUNDLE, folder)
    z, y, x = np.mgrid[:48, :40, :40] - 20.0
    truth = (np.hypot(y, x + z / 3) < 6) | (np.hypot(z, y - 8) < 4)
    noise = np.random.default_rng(0).standard_normal(truth.shape)
    image = ndimage.gaussian_filter(truth.astype(float), 0.8) + 0.4 * noise
    labels = np.zeros(truth.shape, np.uint8)
    labels[..., ::8] = truth[..., ::8]
    for kind, values in (("images", image.astype(np.float32)), ("labels", labels)):
        (folder / "data" / kind).mkdir(parents=True)
        nibabel.save(nibabel.Nifti1Image(values, SPACING), folder / "data" / kind / "case.nii.gz")
    run(folder, "train", "--epochs", "60", "--every", "8")
    run(folder, "inference")
    found = nibabel.load(folder / "predicted" / "case_mask.nii.gz")
    mask = np.asarray(found.dataobj) > 0  # type: ignore[attr-defined]
    assert np.allclose(found.affine, SPACING)  # type: ignore[attr-defined]
    assert 2 * (mask & truth).sum() / (mask.sum() + truth.sum()) > 0.8


def test_the_bundle_says_what_it_needs() -> None:
    meta = json.loads((BUNDLE / "configs" / "metadata.json").read_text(encoding="utf-8"))
    data = meta["network_data_format"]
    assert {"monai_version", "pytorch_version", "numpy_version", "required_packages_version"} <= meta.keys()
    assert data["inputs"]["image"]["num_channels"] == data["outputs"]["pred"]["num_channels"] == 1
