"""Real files of other packages and the shared scans, against nibabel and ITK; or refused for a reason."""

import os
from pathlib import Path

import nibabel
import numpy as np
import pydicom.data
import pytest
import SimpleITK
from disk import unreadable

from curvafit.volumes import load

DATA = Path(os.environ.get("CURVAFIT_DATA", "none"))
NIBABEL = Path(nibabel.__file__).parent / "tests" / "data"


def test_nibabel_files() -> None:
    names = (
        "anatomical.nii",
        "functional.nii",
        "reoriented_anat_moved.nii",
        "standard.nii.gz",
    )
    for name in (*names, "example4d.nii.gz", "example_nifti2.nii.gz"):
        if not (NIBABEL / name).exists():
            pytest.skip("nibabel without its test data")
        image = nibabel.load(NIBABEL / name)
        series = len(image.shape) == 4
        field = load(NIBABEL / name, **({"channel": 1} if series else {}))
        expected = np.asarray(image.dataobj[..., 1] if series else image.dataobj).T
        assert np.array_equal(field.values, expected) and np.allclose(field.spacing, image.header.get_zooms()[2::-1])
        assert field.affine is not None and np.allclose(field.affine, image.affine)
    unreadable(NIBABEL / "resampled_anat_moved.nii", "153 values that are NaN")


def test_shared_scans() -> None:
    if not DATA.is_dir():
        pytest.skip("$CURVAFIT_DATA is not there")
    for path in [*sorted((DATA / "gallery").glob("*.nii.gz"))[:6], *sorted((DATA / "scans").glob("*.nii.gz"))]:
        image, field = SimpleITK.ReadImage(str(path)), load(path)
        assert np.array_equal(field.values, SimpleITK.GetArrayViewFromImage(image))
        scale = {"um": 1e-3, "nm": 1e-6}.get(field.unit, 1.0)
        assert np.allclose(np.array(field.spacing) * scale, image.GetSpacing()[::-1], rtol=1e-4)


#: A slice is no volume; colours need a channel; a report has no pixels; some have no mark of DICOM.
DICOM = {
    "CT_small.dcm": "several slices", "MR_small.dcm": "several slices", "693_J2KI.dcm": "several slices",
    "SC_rgb_rle.dcm": "several slices", "rtdose_1frame.dcm": "several slices", "rtplan.dcm": "no pixels",
    "rtstruct.dcm": "not a DICOM file", "test-SR.dcm": "no pixels", "no_meta.dcm": "not a DICOM file",
    "MR_truncated.dcm": "damaged", "ExplVR_BigEndNoMeta.dcm": "not a DICOM file",
}  # fmt: skip


def test_dicom_files(tmp_path: Path) -> None:
    for name, reason in DICOM.items():
        source = Path(str(pydicom.data.get_testdata_file(name, download=False)))
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_bytes(source.read_bytes())
        unreadable(tmp_path / name / name, reason)
    for name in ("rtdose.dcm", "rtdose_expb.dcm", "rtdose_rle.dcm"):
        path = str(pydicom.data.get_testdata_file(name, download=False))
        image, field = pydicom.dcmread(path), load(path)
        assert field.shape == image.pixel_array.shape and field.unit == "mm"
        assert field.values.sum() == pytest.approx(image.pixel_array.sum() * float(image.DoseGridScaling), rel=1e-5)
