"""Real files of DICOM, against pydicom; or refused for a reason."""

from pathlib import Path

import pydicom.data
import pytest
from disk import unreadable

from curvafit.volumes import load

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
