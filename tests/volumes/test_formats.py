"""What volume files say of themselves, format by format."""

from __future__ import annotations

import bz2
import gzip
import sys
import tempfile
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.core.units import parse_unit
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.tiff import natural_key
from curvafit.volumes.read import load
from curvafit.volumes.write import save

UNITS = ("voxel", "nm", "um", "mm", "m")


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different, where the type allows."""
    values = np.arange(np.prod(shape)).reshape(shape)
    return values % 2 == 0 if dtype == "bool" else values.astype(dtype)


lengths = st.floats(1e-3, 1e3, allow_nan=False).map(lambda h: float(f"{h:.6g}"))
spacings = st.tuples(lengths, lengths, lengths)


# ---- what files say --------------------------------------------------------------------------------------------------


def test_nifti_without_unit_is_taken_for_millimetres_and_said(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(ramp(), np.diag([0.1, 0.2, 0.3, 1])), tmp_path / "scan.nii")
    field = load(tmp_path / "scan.nii")
    assert (field.spacing, field.unit) == ((0.3, 0.2, 0.1), "mm")
    assert field.notes == ("The file names no unit of length: mm is assumed.",)
    assert load(tmp_path / "scan.nii", unit="um").notes == ()


def test_nifti_scaling_and_singleton_axes(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(ramp((4, 5, 6, 1), "int16"), np.diag([1, 2, 3, 1]))
    image.header.set_slope_inter(2, 5)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / "scan.nii")
    field = load(tmp_path / "scan.nii")
    assert field.shape == (6, 5, 4)
    assert field.spacing == (3, 2, 1)
    assert field.values.max() > 119  # scaled by what the header says on reading


@pytest.mark.parametrize("member", [100, 2**28])
def test_a_compressed_nifti_holds_what_a_plain_one_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, member
) -> None:
    monkeypatch.setattr("curvafit.volumes.formats.nifti.MEMBER", member)
    field = Field(ramp(), (0.3, 0.2, 0.1), "um")
    plain, packed = (save(field, tmp_path / name).read_bytes() for name in ("scan.nii", "scan.nii.gz"))
    assert gzip.decompress(packed) == plain
    assert packed.count(b"\x1f\x8b\x08") == -(-len(plain) // member)
    back = load(tmp_path / "scan.nii.gz")
    assert np.array_equal(back.values, field.values)
    assert (back.spacing, back.unit) == ((0.3, 0.2, 0.1), "um")


def imagej(**metadata: object) -> dict:
    return {"imagej": True, "metadata": {"axes": "ZYX", **metadata}}


OME = {"PhysicalSizeX": 0.2, "PhysicalSizeY": 0.2, "PhysicalSizeZ": 900, "PhysicalSizeZUnit": "nm"}


@pytest.mark.parametrize(
    ("options", "spacing", "unit"),
    [
        ({**imagej(spacing=3, unit="micron"), "resolution": (4, 2)}, (3, 0.5, 0.25), "um"),
        ({**imagej(unit="cm"), "resolution": (4, 4)}, (2.5, 2.5, 2.5), "mm"),
        ({**imagej(spacing=2), "resolution": (0.5, 0.5)}, (1, 1, 1), "voxel"),
        (imagej(spacing=5), (5, 1, 1), "voxel"),
        ({"ome": True, "metadata": {"axes": "ZYX", **OME}}, (0.9, 0.2, 0.2), "um"),
        ({"metadata": {"axes": "ZYX", "spacing": [3, 2, 1], "unit": "um"}}, (3, 2, 1), "um"),
        ({"metadata": {"axes": "ZYX", "spacing": 19.5, "unit": "um"}}, (19.5, 19.5, 19.5), "um"),
        ({"resolution": (500, 500), "resolutionunit": "CENTIMETER"}, (0.02, 0.02, 0.02), "mm"),
        ({"resolution": (72, 72), "resolutionunit": "INCH"}, (1, 1, 1), "voxel"),
        ({"resolution": (25.4, 25.4), "resolutionunit": "INCH"}, (1, 1, 1), "voxel"),
        ({}, (1, 1, 1), "voxel"),
    ],
)
def test_tiff_states_its_spacing_in_many_ways(tmp_path: Path, options: dict, spacing, unit: str) -> None:
    tifffile.imwrite(tmp_path / "scan.tif", ramp(), photometric="minisblack", **options)
    field = load(tmp_path / "scan.tif")
    assert field.spacing == pytest.approx(spacing, rel=1e-5)
    assert field.unit == unit
    given = load(tmp_path / "scan.tif", spacing=(3, 2, 1), unit="nm")
    assert (given.spacing, given.unit, given.notes) == ((3, 2, 1), "nm", ())


def test_a_folder_of_slices_is_sorted_naturally(tmp_path: Path) -> None:
    for number, plane in enumerate(ramp((12, 5, 6), "uint8")):
        tifffile.imwrite(tmp_path / f"slice{number}.tif", plane, resolution=(1000, 1000), resolutionunit="CENTIMETER")
    field = load(tmp_path)
    assert np.array_equal(field.values, ramp((12, 5, 6), "uint8"))
    assert field.spacing == pytest.approx((0.01, 0.01, 0.01))
    assert any("distance of slices" in note for note in field.notes)
    tifffile.imwrite(tmp_path / "slice12.tif", np.zeros((5, 7), np.uint8))
    with pytest.raises(ScanError, match=r"expected 2D slices of one shape \(5, 6\), got \(5, 7\) in slice12.tif"):
        load(tmp_path)


@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=8, unique=True))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    names = sorted((f"Rec_{n}_v2.tif" for n in numbers), key=natural_key)
    assert names == [f"Rec_{n}_v2.tif" for n in sorted(numbers)]


def test_hdf5_and_npz_keys(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["group/raw"] = ramp()
        file["group/raw"].attrs["element_size_um"] = [3.0, 2.0, 1.0]
    assert load(tmp_path / "scan.h5").spacing == (3, 2, 1)
    with h5py.File(tmp_path / "scan.h5", "a") as file:
        file["label"] = ramp(dtype="uint16")
        file["label"].attrs.update({"spacing": 0.5, "unit": "mm"})
    np.savez(tmp_path / "scan.npz", raw=ramp(), label=ramp(dtype="uint16"))
    for name in ("scan.h5", "scan.npz"):
        labels = load(f"{tmp_path / name}::label")
        assert labels.values.dtype == np.uint16
        assert np.array_equal(load(tmp_path / name, key="label").values, labels.values)
        with pytest.raises(ScanError, match=r"expected a key as in .*::KEY, got none, and .* has .*label"):
            load(tmp_path / name)
        with pytest.raises(ScanError, match=r"expected a key of .*, got 'no', and it has .*label"):
            load(f"{tmp_path / name}::no")
    field = load(tmp_path / "scan.h5::label")
    assert (field.spacing, field.unit, field.source) == ((0.5, 0.5, 0.5), "mm", f"{tmp_path / 'scan.h5'}::label")


def test_zarr_groups_and_ome_scales(tmp_path: Path) -> None:
    group = zarr.create_group(tmp_path / "scan.zarr")
    for path, size in (("0", 8), ("1", 4)):
        group.create_array(path, data=ramp((1, size, size, size), "uint16"))
    levels = [
        {"path": path, "coordinateTransformations": [{"type": "scale", "scale": [1.0, 4 * f, 2 * f, f]}]}
        for path, f in (("0", 0.5), ("1", 1.0))
    ]
    axes = [{"name": n, "type": "space", "unit": "micrometer"} for n in "czyx"]
    group.attrs["ome"] = {"multiscales": [{"axes": axes, "datasets": levels}]}
    field = load(tmp_path / "scan.zarr")
    assert (field.shape, field.spacing, field.unit) == ((8, 8, 8), (2, 1, 0.5), "um")
    assert load(f"{tmp_path}/scan.zarr::1").spacing == (4, 2, 1)
    with pytest.raises(ScanError, match="it has 0, 1"):
        load(f"{tmp_path}/scan.zarr::2")


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "<f4"])
def test_raw_files(tmp_path: Path, dtype: str) -> None:
    ramp(dtype="uint8").astype(dtype).tofile(tmp_path / "scan.raw")
    field = load(tmp_path / "scan.raw", raw_shape=(4, 5, 6), dtype=dtype)
    assert np.array_equal(field.values, ramp())
    assert field.values.dtype.isnative
    with pytest.raises(ScanError, match="expected .* bytes for shape"):
        load(tmp_path / "scan.raw", raw_shape=(4, 5, 7), dtype=dtype)
    with pytest.raises(ScanError, match="expected --raw-shape"):
        load(tmp_path / "scan.raw")
    if dtype != "uint8":
        with pytest.raises(ScanError, match=r"expected --dtype .* bytes a voxel"):
            load(tmp_path / "scan.raw", raw_shape=(4, 5, 6))


@given(spacings, spacings, st.sampled_from(UNITS), st.sampled_from((*UNITS, "cm", "µm", None)))
@settings(max_examples=40, deadline=None)
def test_arguments_override_the_file_and_the_affine_follows(stated, given_spacing, file_unit: str, unit) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = save(Field(ramp(), stated, file_unit), Path(folder) / "scan.nii")
        field = load(path, spacing=given_spacing, unit=unit)
    name, factor = (file_unit, 1.0) if unit is None else parse_unit(unit)
    assert field.unit == name
    assert field.spacing == pytest.approx(tuple(h * factor for h in given_spacing))
    assert np.linalg.norm(field.affine[:3, :3], axis=0)[::-1] == pytest.approx(field.spacing, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("µm", ("um", 1)),
        ("Micron", ("um", 1)),
        ("\\u00B5m", ("um", 1)),
        ("Å", ("nm", 0.1)),
        ("cm", ("mm", 10)),
        ("meter", ("m", 1)),
        (None, ("voxel", 1)),
    ],
)
def test_units_have_one_name(name: str | None, expected: tuple[str, float]) -> None:
    assert parse_unit(name) == expected


# ---- the extra formats -----------------------------------------------------------------------------------------------


def test_nrrd(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd")
    header = {
        "space": "left-posterior-superior",
        "space directions": np.diag([1.0, 2.0, 3.0]),
        "space units": ["mm"] * 3,
    }
    nrrd.write(str(tmp_path / "scan.nrrd"), ramp().T, header)
    field = load(tmp_path / "scan.nrrd")
    assert np.array_equal(field.values, ramp())
    assert (field.spacing, field.unit) == ((3, 2, 1), "mm")
    assert np.array_equal(field.affine, np.diag([-1, -2, 3, 1]))


@pytest.mark.parametrize("suffix", [".mha", ".mhd"])
def test_metaimage(tmp_path: Path, suffix: str) -> None:
    itk = pytest.importorskip("SimpleITK")
    image = itk.GetImageFromArray(ramp())
    image.SetSpacing((1, 2, 3))
    image.SetOrigin((5, 6, 7))
    itk.WriteImage(image, str(tmp_path / f"scan{suffix}"))
    field = load(tmp_path / f"scan{suffix}")
    assert np.array_equal(field.values, ramp())
    assert (field.spacing, field.unit) == ((3, 2, 1), "mm")
    assert np.array_equal(field.affine[:3, 3], [-5, -6, 7])


def test_mrc_is_in_nanometres(tmp_path: Path) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(tmp_path / "scan.mrc", ramp()) as file:
        file.voxel_size = (10, 20, 30)
    field = load(tmp_path / "scan.mrc")
    assert np.array_equal(field.values, ramp())
    assert field.unit == "nm"
    assert field.spacing == pytest.approx((3, 2, 1))


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int16", "uint16", "float32", "float64"])
def test_mrc_is_written_in_angstrom(tmp_path: Path, dtype: str) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    path = save(Field(ramp(dtype=dtype), (0.03, 0.02, 0.01), "um"), tmp_path / "scan.mrc")
    assert mrcfile.validate(path)
    with mrcfile.open(path) as file:
        assert file.is_volume() or file.header.nz == 4
        assert (file.voxel_size.x, file.voxel_size.y, file.voxel_size.z) == pytest.approx((100, 200, 300))
    back = load(path)
    assert np.array_equal(back.values, ramp(dtype=dtype))
    assert back.unit == "nm" and back.spacing == pytest.approx((30, 20, 10))


def test_mrc_needs_a_unit_and_a_type_it_has(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="expected a unit of nm, um, mm or m for an MRC file"):
        save(Field(ramp()), tmp_path / "scan.mrc")
    with pytest.raises(ScanError, match="expected whole numbers of at most 16 bits or floats .*, got int32"):
        save(Field(ramp(dtype="int32"), 1.0, "nm"), tmp_path / "scan.mrc")
    assert list(tmp_path.iterdir()) == []


def test_dicom_slices_are_ordered_by_position(tmp_path: Path) -> None:
    pydicom = pytest.importorskip("pydicom")
    for number in (0, 1, 2, 3):
        write_dicom(pydicom, tmp_path / f"{9 - number}.dcm", ramp(dtype="uint16")[number], 2.5 * number)
    field = load(tmp_path)
    assert np.array_equal(field.values, ramp() * 2 - 10)
    assert (field.spacing, field.unit) == ((2.5, 0.5, 0.25), "mm")
    assert field.affine == pytest.approx(np.diag([-0.25, -0.5, 2.5, 1]))
    write_dicom(pydicom, tmp_path / "far.dcm", ramp(dtype="uint16")[0], 50)
    with pytest.raises(ScanError, match="expected evenly spaced DICOM slices, got steps of 2.5 to 42.5 mm"):
        load(tmp_path)


def write_dicom(pydicom, path: Path, plane: np.ndarray, position: float) -> None:
    image = pydicom.Dataset()
    image.file_meta = pydicom.dataset.FileMetaDataset()
    image.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID = pydicom.uid.CTImageStorage
    image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID = pydicom.uid.generate_uid()
    image.SeriesInstanceUID = "1.2.3"
    image.Rows, image.Columns = plane.shape
    image.PixelSpacing = [0.5, 0.25]
    image.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    image.ImagePositionPatient = [0, 0, position]
    image.RescaleSlope, image.RescaleIntercept = 2, -10
    image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
    image.BitsAllocated, image.BitsStored, image.HighBit, image.PixelRepresentation = 16, 16, 15, 0
    image.PixelData = plane.tobytes()
    image.save_as(path, enforce_file_format=True)


@pytest.mark.parametrize(("suffix", "module"), [(".nrrd", "nrrd"), (".mrc", "mrcfile")])
def test_a_missing_library_says_how_to_get_it(tmp_path: Path, monkeypatch, suffix: str, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"scan{suffix}").write_bytes(b"x")
    with pytest.raises(ImportError, match=rf'{module}.*pip install "curvafit\[io\]"'):
        load(tmp_path / f"scan{suffix}")


def test_streams_of_several_parts_are_read_whole(tmp_path: Path) -> None:
    """As parallel compressors write them; a bit that is flipped in the last part is seen."""
    values = ramp()
    halves = np.array_split(np.frombuffer(values.tobytes(), np.uint8), 2)
    header = f"NRRD0004\ntype: float\ndimension: 3\nsizes: {' '.join(map(str, values.shape[::-1]))}\n"
    header += "endian: little\nencoding: {}\n\n"
    for encoding, compress in (("gzip", gzip.compress), ("bzip2", bz2.compress)):
        path, parts = tmp_path / f"{encoding}.nrrd", [compress(half.tobytes()) for half in halves]
        path.write_bytes(header.format(encoding).encode() + b"".join(parts))
        assert np.array_equal(load(path).values, values)
        flipped = bytearray(path.read_bytes())
        flipped[-len(parts[1]) // 2] ^= 4
        path.write_bytes(flipped)
        with pytest.raises(ScanError, match="cannot be read"):
            load(path)
