"""What files and arrays say is what is read: spacing, unit, affine, order; one sentence where they cannot be read."""

from __future__ import annotations

import bz2
import gzip
import logging
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from curvafit import infer, refine, segment
from curvafit.core.units import parse_unit
from curvafit.volumes import Field, ScanError, field_of, load, save
from curvafit.volumes.formats.tiff import natural_key
from curvafit.volumes.read import READERS

UNITS = ("voxel", "nm", "um", "mm", "m")
VALUES = (np.random.default_rng(0).random((9, 10, 11)) * 200 + 1).astype(np.uint16)


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different."""
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def refused(path: Path | str, said: str, **options: object) -> None:
    with pytest.raises(ScanError, match=rf"^[^\n]*{said}[^\n]*$"):
        load(path, **options)  # type: ignore[arg-type]


lengths = st.floats(1e-3, 1e3, allow_nan=False).map(lambda h: float(f"{h:.6g}"))
spacings = st.tuples(lengths, lengths, lengths)


# ---- sources ---------------------------------------------------------------------------------------------------------


def test_every_kind_of_source_is_one_field(tmp_path: Path) -> None:
    field = Field(ramp(), (3.0, 2.0, 1.0), "um")
    path = save(field, tmp_path / "scan.nii.gz")
    at = {"spacing": (3.0, 2.0, 1.0), "unit": "um"}
    assert field_of(field) is field
    for source in (
        field_of(str(path)),
        field_of(path),
        field_of(ramp(), **at),
        field_of(torch.from_numpy(ramp()), **at),
    ):
        assert np.array_equal(source.values, ramp())
        assert (source.spacing, source.unit) == ((3, 2, 1), "um")
    bare = field_of(torch.from_numpy(ramp()).bfloat16().requires_grad_())
    assert (bare.spacing, bare.unit, bare.values.dtype) == ((1, 1, 1), "voxel", np.float32)


@pytest.mark.parametrize(
    ("source", "options", "word"),
    [
        (Field(ramp()), {"spacing": 2}, "spacing"),
        (Field(ramp()), {"unit": "mm"}, "unit"),
        (Field(ramp()), {"key": "raw"}, "key"),
        (ramp(), {"raw_shape": (4, 5, 6)}, "raw_shape"),
        (ramp(), {"spacing": (1, 2)}, "spacing"),
        (ramp(), {"unit": "furlong"}, "unit"),
        (ramp((5, 6)), {}, "3D"),
        (np.where(ramp() == 7, np.nan, ramp()), {}, "NaN"),
        (ramp() * 1j, {}, "complex"),
        ([[[1.0]]], {}, "volume"),
    ],
)
def test_sources_and_options_that_do_not_fit_are_refused(source, options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        field_of(source, **options)


@pytest.mark.parametrize(
    "job", [infer, lambda *a, **o: segment(*a, "tubes", **o), lambda *a, **o: refine(*a, "tubes", weight=1, **o)]
)
def test_no_job_drops_an_option_in_silence(job) -> None:
    ball = (np.linalg.norm(np.indices((10, 11, 12)).T - (4.5, 5.0, 5.5), axis=-1).T < 4).astype(np.float32)
    for options, word in (({"spacing": 2}, "spacing"), ({"unit": "mm"}, "unit"), ({"strict": True}, "strict")):
        with pytest.raises(ScanError, match=word):
            job(Field(ball), **options)
    with pytest.raises(ScanError, match="volume"):
        job(None)


def test_segment_takes_each_source(tmp_path: Path) -> None:
    ball = (np.linalg.norm(np.indices((10, 11, 12)).T - (4.5, 5.0, 5.5), axis=-1).T < 4).astype(np.float32)
    at = {"spacing": (3.0, 2.0, 2.0), "unit": "um"}
    scan = Field(100 * ball + np.random.default_rng(0).normal(0, 20, ball.shape).astype(np.float32), **at)
    wanted = segment(scan, "tubes", steps=2)
    path = save(scan, tmp_path / "scan.nii.gz")
    for source, options in ((path, {}), (scan.values, at), (torch.from_numpy(scan.values), at)):
        found = segment(source, "tubes", steps=2, **options)
        assert np.array_equal(found.mask.values, wanted.mask.values)
        assert (found.mask.spacing, found.mask.unit) == (scan.spacing, "um")


def test_a_field_is_one_line_and_equals_itself() -> None:
    field = Field(ramp(), (3.0, 2.0, 1.0), "um", source="scan\n.nii.gz")
    assert repr(field) == "Field(4 x 5 x 6 voxels of 3 x 2 x 1 um, float32 from 0 to 119, from scan\\n.nii.gz)"
    assert repr(Field(ramp(dtype="uint8"), 0.0195, "mm")) == "Field(4 x 5 x 6 voxels of 0.0195 mm, uint8 from 0 to 119)"
    assert field == field and field != Field(ramp()) and len({field, field}) == 1


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
    with pytest.raises(ScanError, match="slice12.tif"):
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
        with pytest.raises(ScanError, match="label"):
            load(tmp_path / name)
        with pytest.raises(ScanError, match="label"):
            load(f"{tmp_path / name}::no")
    field = load(tmp_path / "scan.h5::label")
    assert (field.spacing, field.unit, field.source) == ((0.5, 0.5, 0.5), "mm", f"{tmp_path / 'scan.h5'}::label")


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "<f4"])
def test_raw_files(tmp_path: Path, dtype: str) -> None:
    ramp(dtype="uint8").astype(dtype).tofile(tmp_path / "scan.raw")
    field = load(tmp_path / "scan.raw", raw_shape=(4, 5, 6), dtype=dtype)
    assert np.array_equal(field.values, ramp())
    assert field.values.dtype.isnative
    with pytest.raises(ScanError, match="bytes"):
        load(tmp_path / "scan.raw", raw_shape=(4, 5, 7), dtype=dtype)
    with pytest.raises(ScanError, match="raw-shape"):
        load(tmp_path / "scan.raw")
    if dtype != "uint8":
        with pytest.raises(ScanError, match="dtype"):
            load(tmp_path / "scan.raw", raw_shape=(4, 5, 6))


@given(spacings, spacings, st.sampled_from(UNITS), st.sampled_from((*UNITS, "cm", "µm", None)))
@settings(max_examples=40, deadline=None)
def test_arguments_override_the_file_and_the_affine_follows(stated, given_spacing, file_unit: str, unit) -> None:
    assume(unit is not None or file_unit != "voxel" or min(given_spacing) == 1)  # else a unit is asked for
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


@pytest.mark.parametrize("compression", ["lzw", "deflate", "adobe_deflate", "packbits", "zstd", "jpeg2000"])
@pytest.mark.parametrize("predictor", [False, True])
def test_compressed_tiffs_and_slices_are_read(tmp_path: Path, compression: str, predictor: bool) -> None:
    options: dict = {"photometric": "minisblack", "compression": compression}
    if predictor and compression not in ("packbits", "jpeg2000"):
        options["predictor"] = True
    tifffile.imwrite(tmp_path / "scan.tif", VALUES, imagej=True, metadata={"axes": "ZYX", "spacing": 2}, **options)
    assert np.array_equal(load(tmp_path / "scan.tif").values, VALUES)
    (tmp_path / "slices").mkdir()
    for number, plane in enumerate(VALUES):
        tifffile.imwrite(tmp_path / "slices" / f"{number}.tif", plane, rowsperstrip=3, **options)
    assert np.array_equal(load(tmp_path / "slices").values, VALUES)


def test_strips_and_pages_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, VALUES, photometric="minisblack", compression="lzw", rowsperstrip=3, metadata=None)
    with tifffile.TiffFile(path) as file:
        tag = file.pages[4].tags["StripByteCounts"]  # type: ignore[union-attr]
        place, count = tag.valueoffset, tag.count
    content = bytearray(path.read_bytes())
    content[place : place + 2 * count] = bytes(2 * count)
    path.write_bytes(content)
    refused(path, "page 4")


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


@pytest.mark.parametrize("packed", [False, True])
def test_metaimages_lie_where_itk_puts_them(tmp_path: Path, packed: bool) -> None:
    itk = pytest.importorskip("SimpleITK")
    turned, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    for suffix in (".mha", ".mhd"):
        for dtype in ("uint8", "int16", "uint32", "int64", "float32", "float64"):
            image = itk.GetImageFromArray(VALUES.astype(dtype))
            image.SetDirection(turned.ravel().tolist())
            image.SetSpacing((1, 2, 3))
            image.SetOrigin((5, 6, 7))
            itk.WriteImage(image, str(tmp_path / f"scan{suffix}"), packed)
            field = load(tmp_path / f"scan{suffix}")
            assert field.values.dtype == dtype and np.array_equal(field.values, VALUES)
            corner = image.TransformIndexToPhysicalPoint((10, 9, 8))
            flipped = np.array([-1, -1, 1]) * corner
            assert (field.affine @ [10, 9, 8, 1])[:3] == pytest.approx(flipped)


def test_mrc_is_in_nanometres(tmp_path: Path) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(tmp_path / "scan.mrc", ramp()) as file:
        file.voxel_size = (10, 20, 30)
    field = load(tmp_path / "scan.mrc")
    assert np.array_equal(field.values, ramp())
    assert field.unit == "nm"
    assert field.spacing == pytest.approx((3, 2, 1))


def test_dicom_slices_are_ordered_by_position(tmp_path: Path) -> None:
    pydicom = pytest.importorskip("pydicom")
    for number in (0, 1, 2, 3):
        write_dicom(pydicom, tmp_path / f"{9 - number}.dcm", ramp(dtype="uint16")[number], 2.5 * number)
    (tmp_path / "._9.dcm").write_bytes(bytes(300))  # the Finder's
    field = load(tmp_path)
    assert np.array_equal(field.values, ramp() * 2 - 10)
    assert (field.spacing, field.unit) == ((2.5, 0.5, 0.25), "mm")
    assert field.affine == pytest.approx(np.diag([-0.25, -0.5, 2.5, 1]))
    write_dicom(pydicom, tmp_path / "far.dcm", ramp(dtype="uint16")[0], 50)
    with pytest.raises(ScanError, match="evenly"):
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


# ---- what is not there, and odd contents -----------------------------------------------------------------------------


def test_hdf5_without_all_its_chunks_or_any_value(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        some = file.create_dataset("some", (8, 8, 8), "f4", chunks=(4, 4, 4), fillvalue=3)
        some[:4] = 1
        file.create_dataset("none", (8, 8, 8), "f4")
        layout = h5py.VirtualLayout((8, 8, 8), "f4")
        layout[:4] = h5py.VirtualSource("gone.h5", "raw", (4, 8, 8))
        file.create_virtual_dataset("virtual", layout, fillvalue=0)
        file.create_dataset("outside", (8, 8, 8), "u1", external=[(str(tmp_path / "bytes"), 0, 512)])
    note = "4 of 8 chunks are not stored: their voxels have the fill value 3.0."
    assert note in load(path, key="some").notes
    refused(path, note, key="some", strict=True)
    refused(path, "No values are stored", key="none", strict=True)
    refused(path, "gone.h5", key="virtual", strict=True)
    refused(path, "other files", key="outside")


def test_numbers_that_slices_skip_are_said(tmp_path: Path) -> None:
    for number in (0, 5, 10, 20, 25):
        tifffile.imwrite(tmp_path / f"s{number:03d}.tif", VALUES[number % 9])
    assert any("skip some, after s010 for one" in note for note in load(tmp_path).notes)
    refused(tmp_path, "skip some", strict=True)
    tifffile.imwrite(tmp_path / "s015.tif", VALUES[3])
    assert load(tmp_path, strict=True).shape == (6, 10, 11)


def test_odd_datasets_are_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["scalar"], file["text"], file["empty"] = 3.0, "abc", np.zeros((0, 3, 4))
        file["null"] = h5py.Empty("f4")
        file["texts"] = np.array([b"a", b"b"])
        file["records"] = np.zeros((2, 3, 4), np.dtype([("a", "f4"), ("b", "i2")]))
        file["complex"] = VALUES * 1j
        file.create_dataset("lists", (2,), h5py.vlen_dtype(np.int32))
        file["outer"] = h5py.ExternalLink("nowhere.h5", "raw")
        file.create_dataset("moon", (10**4, 10**4, 10**4), "f8", chunks=(100, 100, 100))
    for key in ("scalar", "text", "empty", "null", "texts", "records", "complex", "lists", "outer", "moon", "none"):
        refused(f"{path}::{key}", "")
    refused(f"{path}::moon", "memory")


@pytest.mark.parametrize(
    "attributes",
    [
        {"spacing": [1.0, 2.0]},
        {"spacing": []},
        {"spacing": "wide"},
        {"spacing": [1.0, np.nan, 1.0]},
        {"spacing": b"abc"},
        {"spacing": 1.0, "unit": 3.0},
        {"spacing": 1.0, "unit": ["um", "mm", "nm"][1:]},
        {"spacing": 1.0, "unit": b"\xff\xfe"},
        {"element_size_um": [[1.0, 2.0], [3.0, 4.0]]},
        {"voxel_size": "x" * 30_000},
    ],
)
def test_odd_attributes_are_refused_or_overridden(tmp_path: Path, attributes: dict) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["raw"] = VALUES
        file["raw"].attrs.update(attributes)
    if attributes != {"spacing": 1.0, "unit": ["mm", "nm"]}:
        with pytest.raises(ScanError, match=r"(?s)^(?=.{1,400}$)[^\n]*(spacing|unit)"):
            load(path)
    field = load(path, spacing=(3, 2, 1), unit="um")
    assert (field.spacing, field.unit) == ((3, 2, 1), "um")


def test_a_unit_in_bytes_or_in_a_list_of_one(tmp_path: Path) -> None:
    for number, unit in enumerate((b"um", ["um"], np.array([b"um"]))):
        path = tmp_path / f"{number}.h5"
        with h5py.File(path, "w") as file:
            file["raw"] = VALUES
            file["raw"].attrs.update({"spacing": np.array([2]), "unit": unit})
        assert (load(path).spacing, load(path).unit) == ((2, 2, 2), "um")


def test_odd_numpy_files_are_one_sentence(tmp_path: Path) -> None:
    records = np.zeros((2, 3, 4), np.dtype([("a", "f4"), ("ö", "i2")]))
    for values in (np.array([None]), records, np.array(["a"]), VALUES * 1j, np.float64(3)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.save(tmp_path / "a.npy", values)
            np.savez(tmp_path / "a.npz", values)
        refused(tmp_path / "a.npy", "")
        refused(tmp_path / "a.npz", "")
    np.save(tmp_path / "order.npy", np.asfortranarray(VALUES))
    assert np.array_equal(load(tmp_path / "order.npy").values, VALUES)
    refused(f"{tmp_path / 'order.npy'}::raw", "key")
    (tmp_path / "order.npy").write_bytes((tmp_path / "a.npz").read_bytes())
    refused(tmp_path / "order.npy", "cannot be read")


def test_reading_leaves_loggers_and_warnings_as_they_were(tmp_path: Path) -> None:
    names = ("tifffile", "nibabel.global", "pydicom")
    state = [(logging.getLogger(name).level, logging.getLogger(name).filters[:]) for name in names]
    filters = warnings.filters[:]
    for suffix in (".tif", ".nii.gz", ".nii"):
        path = save(Field(VALUES, 1.0, "um"), tmp_path / f"scan{suffix}")
        load(path)
        path.write_bytes(path.read_bytes()[:400])
        refused(path, "cannot be read")
    assert [(logging.getLogger(name).level, logging.getLogger(name).filters[:]) for name in names] == state
    assert warnings.filters[:] == filters


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (ramp((5, 6)), "2D"),
        (ramp((1, 5, 6)), "2D"),
        (ramp((2, 3, 4, 5)), "4D"),
        (np.zeros((0, 5, 6)), "no values"),
        (np.where(ramp() == 7, np.nan, ramp()), "NaN"),
        (np.where(ramp() < 2, np.inf, ramp()), "infinite"),
        (np.full((4, 5, 6), 3), "vary"),
        (ramp() * 1j, "complex64"),
    ],
)
def test_unusable_values_are_refused(tmp_path: Path, values: np.ndarray, word: str) -> None:
    np.save(tmp_path / "scan.npy", values)
    refused(tmp_path / "scan.npy", word)


def test_bad_spacing_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", ramp())
    for spacing in ((1, 0, 1), (1, -1, 1), (1, 1), (1, 2, 3, 4), (1, float("nan"), 1), "abc", 0.0):
        refused(tmp_path / "scan.npy", "spacing", spacing=spacing)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["raw"] = ramp()
        file["raw"].attrs["element_size_um"] = [0.0, 0.2, 0.2]
    refused(tmp_path / "scan.h5", "spacing")
    assert load(tmp_path / "scan.h5", spacing=1).spacing == (1, 1, 1)


def test_bad_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        load(tmp_path / "scan.nii")
    refused(tmp_path, "folder")
    (tmp_path / "scan.xyz").write_bytes(b"x")
    refused(tmp_path / "scan.xyz", "must end")
    for kind in (str, complex, object):
        with pytest.raises(ValueError, match="real numbers"):
            Field(ramp().astype(kind))
    for suffix in READERS:
        path = tmp_path / f"scan{suffix}"
        path.write_bytes(b"not a volume at all")
        refused(path, "", raw_shape=(4, 5, 6))


def write_npz(path: Path) -> None:
    np.savez(path, raw=ramp((20, 20, 20)))


def write_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["raw"] = ramp((20, 20, 20))


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".tif", ".npy", ".npz", ".h5"])
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.6, 0.99])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_truncated_files_are_refused(tmp_path: Path, suffix: str, kept: float, dtype: str) -> None:
    path = tmp_path / f"scan{suffix}"
    writers: dict[str, Callable[[Path], object]] = {".npz": write_npz, ".h5": write_hdf5}
    writers.get(suffix, lambda p: save(Field(ramp((20, 20, 20), dtype)), p))(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    if suffix == ".tif" and kept == 0.99:  # its values precede the directories of its last pages
        assert np.array_equal(load(path).values, ramp((20, 20, 20), dtype))
        return
    with pytest.raises(ScanError, match="cannot be read"):
        load(path)


# ---- real files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "shape", "spacing", "unit"),
    [
        ("lhdl_trabecular_200.tif", {}, (200, 200, 200), (19.5,) * 3, "um"),
        ("openpnm_berea_100_to_300.npz", {}, (200, 200, 200), (1,) * 3, "voxel"),
        ("plantseg_sample_ovule.h5::raw", {}, (32, 128, 128), (0.235, 0.15, 0.15), "um"),
        ("poreture_h61_vessel_tree.nii.gz", {}, (300, 250, 250), (0.035866,) * 3, "mm"),
        ("quanfima_polymer3d_8bit_128x128x128.raw", {"raw_shape": (128,) * 3}, (128,) * 3, (1,) * 3, "voxel"),
    ],
)
def test_real_scans(data: Path, name: str, options: dict, shape, spacing, unit: str) -> None:
    field = load(data / "scans" / name, **options)
    assert (field.shape, field.spacing, field.unit) == (shape, spacing, unit)


def test_a_spacing_needs_a_unit_unless_it_is_a_ratio(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.arange(24, dtype=np.uint8).reshape(2, 3, 4))
    with pytest.raises(ScanError, match="unit of the spacing"):
        load(tmp_path / "scan.npy", spacing=0.0195)
    assert load(tmp_path / "scan.npy", spacing=(2.5, 1, 1)).unit == "voxel"
    assert load(tmp_path / "scan.npy", spacing=0.0195, unit="mm").spacing == pytest.approx((0.0195,) * 3)
