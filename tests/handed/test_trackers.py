"""Trouble with volume files from public trackers: each is used, refused in a sentence, or said in a note."""

from collections.abc import Callable
from pathlib import Path

import mrcfile
import nibabel
import nrrd
import numpy as np
import pydicom
import pydicom.data
import pytest
from disk import unreadable

from curvafit.volumes import load
from tests.volumes.test_read import write_dicom

VALUES = np.arange(120, dtype=np.uint8).reshape(4, 5, 6)
TURN = np.diag([-2.0, 3.0, 4.0, 1.0])


def nifti(folder: Path, change: Callable[[nibabel.Nifti1Image], object], values: np.ndarray = VALUES) -> Path:
    image = nibabel.Nifti1Image(values.T, TURN)
    image.header.set_xyzt_units("mm")
    change(image)
    nibabel.save(image, folder / "a.nii")
    return folder / "a.nii"


NIFTI = (
    # SPM moves the sform alone, so the two places differ: https://github.com/TorchIO-project/torchio/issues/567
    (lambda i: (i.set_qform(np.diag([2.0, 3, 4, 1]), 1), i.set_sform(TURN, 1)), (4, 3, 2), TURN, "sform is used"),
    # one placement alone is no conflict: https://github.com/simnibs/simnibs/issues/110
    (lambda i: (i.set_qform(None, 0), i.set_sform(TURN, 1)), (4, 3, 2), TURN, None),
    # both codes 0 are no place: https://github.com/InsightSoftwareConsortium/ITK/issues/2674
    (lambda i: (i.set_qform(None, 0), i.set_sform(None, 0), i.header.set_zooms((2, 3, 4))), (4, 3, 2), None, None),
    # sform and pixdim disagree: https://github.com/NIFTI-Imaging/nifti_clib/issues/127
    (lambda i: (i.set_qform(None, 0), i.header.set_zooms((2, 3, 5))), (5, 3, 2), TURN, "voxel sizes are used"),
    # micrometres stay micrometres: https://github.com/InsightSoftwareConsortium/ITK/pull/4595
    (lambda i: i.header.set_xyzt_units("micron"), (4, 3, 2), TURN, None),
    # no unit at all: https://github.com/black0017/ct-intensity-segmentation/issues/1
    (lambda i: i.header.set_xyzt_units(0), (4, 3, 2), TURN, "mm is assumed"),
)


def test_nifti(tmp_path: Path) -> None:
    for change, spacing, affine, note in NIFTI:
        field = load(nifti(tmp_path, change))
        assert np.array_equal(field.values, VALUES) and field.spacing == spacing
        assert (field.affine is None) if affine is None else np.array_equal(field.affine, affine)  # type: ignore[arg-type]
        assert any(note in said for said in field.notes) if note else field.notes == ()
    # a slope of 0 or NaN does not scale: https://github.com/JuliaNeuroscience/NIfTI.jl/issues/14
    # and https://github.com/nipreps/fmriprep/issues/2507
    path = nifti(tmp_path, lambda image: None)
    for slope in (0.0, np.nan):
        raw = bytearray(path.read_bytes())
        raw[112:116] = np.float32(slope).tobytes()
        path.write_bytes(raw)
        assert np.array_equal(load(path).values, VALUES)
    # an affine of no numbers
    raw[280:284] = np.float32(np.nan).tobytes()
    path.write_bytes(raw)
    unreadable(path, "no numbers")


SPACED = {"space directions": np.diag([2.0, 3.0, 4.0]), "space origin": [1.0, 2.0, 3.0]}
NRRD = (
    # micrometres are used: https://github.com/ANTsX/ANTsPy/issues/514
    ({**SPACED, "space": "RAS", "space units": ["microns"] * 3}, (4, 3, 2), "um", (1, 2, 3), None),
    # no unit: https://github.com/Slicer/Slicer/issues/7631
    ({**SPACED, "space": "LPS"}, (4, 3, 2), "mm", (-1, -2, 3), "mm is assumed"),
    # a space of a number of axes only: https://github.com/ANTsX/ANTsPy/issues/514
    ({**SPACED, "space dimension": 3, "space units": ["mm"] * 3}, (4, 3, 2), "mm", (1, 2, 3), "names no space"),
    ({**SPACED, "space": "scanner-xyz", "space units": ["mm"] * 3}, (4, 3, 2), "mm", (1, 2, 3), "scanner-xyz"),
    # spacings instead of directions: https://github.com/JuliaImages/Images.jl/issues/86
    ({"spacings": [2.0, 3.0, 4.0]}, (4, 3, 2), "voxel", None, "count in voxels"),
    # values that stand for others: https://github.com/mhe/pynrrd/issues/83
    ({"spacings": [2.0, 3.0, 4.0], "units": ["mm"] * 3, "old min": 0.0, "old max": 1.0}, (4, 3, 2), "mm", None,
     "stand for 0.0 to 1.0"),
    # where a cell begins: https://teem.sourceforge.net/nrrd/format.html#centers
    ({"spacings": [2.0, 3.0, 4.0], "units": ["mm"] * 3, "axis mins": [1.0, 2.0, 3.0], "centers": "cell cell cell"},
     (4, 3, 2), "mm", (2, 3.5, 5), None),
    ({"spacings": [2.0, 3.0, 4.0], "units": ["mm"] * 3, "axis mins": [1.0, 2.0, 3.0], "centerings": ["node"] * 3},
     (4, 3, 2), "mm", (1, 2, 3), None),
    ({"axis mins": [0.0, 0.0, 0.0], "axis maxs": [5.0, 5.0, 5.0]}, (1, 1, 1), "voxel", None, "begin or end"),
)  # fmt: skip


def test_nrrd(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    for header, spacing, unit, first, note in NRRD:
        nrrd.write(str(path), VALUES.T, header)
        field = load(path)
        assert np.array_equal(field.values, VALUES) and (field.spacing, field.unit) == (spacing, unit)
        assert first is None or (field.affine is not None and tuple(field.affine[:3, 3]) == first)
        assert any(note in said for said in field.notes) if note else field.notes == ()
    # numbers of several bytes in no order: https://teem.sourceforge.net/nrrd/format.html#endian
    nrrd.write(str(path), VALUES.astype(np.uint16).T, {"encoding": "raw"})
    path.write_bytes(path.read_bytes().replace(b"endian: little\n", b""))
    unreadable(path, "endian")


META = (
    # another orientation than that of the matrix: https://github.com/InsightSoftwareConsortium/ITK/issues/1017
    ("AnatomicalOrientation = LPS\n", "mm", "AnatomicalOrientation"),
    ("AnatomicalOrientation = RAI\n", "mm", None),
    ("AnatomicalOrientation = ???\n", "mm", None),  # https://github.com/OpenGATE/Gate/issues/359
    # turned with its matrix: https://github.com/OpenGATE/Gate/issues/333
    ("AnatomicalOrientation = LPI\nTransformMatrix = -1 0 0 0 -1 0 0 0 1\n", "mm", None),
    # https://itk.org/Wiki/ITK/MetaIO/Documentation
    ("CenterOfRotation = 5 0 0\n", "mm", "CenterOfRotation"),
    ("ElementSize = 1 1 1\n", "mm", "ElementSize"),
    ("ElementToIntensityFunctionSlope = 2\n", "mm", "ElementToIntensityFunctionSlope"),
    ("DistanceUnits = um\n", "um", None),
)


def test_metaimage(tmp_path: Path) -> None:
    path = tmp_path / "a.mha"
    for lines, unit, note in META:
        sizes = "ElementSpacing = 2 3 4\nDimSize = 6 5 4\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
        path.write_bytes(f"ObjectType = Image\nNDims = 3\n{lines}{sizes}".encode() + VALUES.tobytes())
        field = load(path)
        assert np.array_equal(field.values, VALUES) and (field.spacing, field.unit) == ((4, 3, 2), unit)
        assert any(note in said for said in field.notes) if note else field.notes == ()


MRC = (
    # both ways to state a place: https://github.com/ccpem/mrcfile/issues/57
    ({"origin": (10, 20, 30), "nxstart": 7}, (1, 2, 3), "the origin is used"),
    ({"nxstart": -7, "nystart": 2}, (-1.4, 0.4, 0), None),
    # a stack of images: https://github.com/I2PC/scipion/issues/142
    ({"ispg": 0}, None, "stack of images"),
    # a stamp nobody knows: https://github.com/ccpem/mrcfile/issues/47
    ({"machst": [51, 0, 0, 0]}, None, "machine stamp"),
    # sizes of 0: https://github.com/IsoNet-cryoET/IsoNet2/issues/13
    ({"cella": (0, 0, 0)}, None, "counted in voxels"),
)


def test_mrc(tmp_path: Path) -> None:
    path = tmp_path / "a.mrc"
    for header, first, note in MRC:
        with mrcfile.new(path, VALUES.view(np.int8), overwrite=True) as file:
            file.voxel_size = 2.0
            for name, value in header.items():
                file.header[name] = value
        field = load(path)
        assert np.array_equal(field.values, VALUES) and (field.affine is None) is (first is None)
        assert first is None or field.affine[:3, 3] == pytest.approx(first)  # type: ignore
        assert any(note in said for said in field.notes) if note else field.notes == ()


DICOM = (
    # https://github.com/pydicom/pydicom/issues/205
    ({"PhotometricInterpretation": "PALETTE COLOR"}, "palette"),
    # https://github.com/Enet4/dicom-rs/issues/242
    ({"ModalityLUTSequence": [pydicom.Dataset()]}, "ModalityLUTSequence"),
    # https://github.com/OHIF/Viewers/issues/1490
    ({"ImagerPixelSpacing": [0.2, 0.2]}, "ImagerPixelSpacing"),
    # https://github.com/malaterre/GDCM/pull/170
    ({"ImagePositionPatient": None, "ImageOrientationPatient": None}, "PixelSpacing"),
    ({"LossyImageCompression": "01"}, "with loss"),
    ({"BurnedInAnnotation": "YES"}, "burnt"),
    # the thickness is no distance: https://github.com/BRAINSia/BRAINSTools/issues/334
    ({"SliceThickness": 9, "SpacingBetweenSlices": 9}, None),
    # tilt, gaps and times: https://github.com/rordenlab/dcm2niix/issues/232 and
    # https://github.com/dave3d/dicom2stl/issues/68
    ({"ImagePositionPatient": [0, 0, 1]}, "evenly spaced"),
)  # fmt: skip


def test_dicom(tmp_path: Path) -> None:
    for number, (changes, note) in enumerate(DICOM):
        folder = tmp_path / str(number)
        folder.mkdir()
        for k, plane in enumerate(VALUES.astype(np.uint16)):
            write_dicom(folder / f"{k}.dcm", plane, 2.5 * k)
            image = pydicom.dcmread(folder / f"{k}.dcm")
            image.InstanceNumber = k
            for key, value in changes.items():
                delattr(image, key) if value is None else setattr(image, key, value)
            image.save_as(folder / f"{k}.dcm")
        if note == "evenly spaced":
            unreadable(folder, note)
            continue
        field = load(folder)
        assert np.array_equal(field.values, VALUES * 2.0 - 10)
        assert any(note in said for said in field.notes) if note else field.notes == ()
        assert field.spacing == ((1, 1, 1) if note == "PixelSpacing" else (2.5, 0.5, 0.25))


def test_dose() -> None:
    """A dose is scaled, and its planes lie by their offsets: https://github.com/ferdymercury/amide/issues/1"""
    path = Path(str(pydicom.data.get_testdata_file("rtdose.dcm", download=False)))
    image, field = pydicom.dcmread(path), load(path)
    assert field.values == pytest.approx(image.pixel_array * float(image.DoseGridScaling))
    offsets, affine = image.GridFrameOffsetVector, field.affine
    assert affine is not None and field.spacing[0] == pytest.approx(offsets[1] - offsets[0])
    assert affine[:3, 3] == pytest.approx(np.array(image.ImagePositionPatient) * [-1, -1, 1])
