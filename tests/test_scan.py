"""Reading and writing volumes: nothing moves, turns, rescales or changes its unit on the way."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.formats import normalise_unit
from curvafit.formats.tiff import natural_key
from curvafit.scan import READABLE, Field, ScanError, load, save

TYPES = ("bool", "uint8", "int16", "uint16", "int32", "float32", "float64")
UNITS = ("voxel", "nm", "um", "mm", "m")


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different, where the type allows."""
    values = np.arange(np.prod(shape)).reshape(shape)
    return values % 2 == 0 if dtype == "bool" else values.astype(dtype)


# ---- round trips -----------------------------------------------------------------------------------------------------

lengths = st.floats(1e-3, 1e3, allow_nan=False).map(lambda h: float(f"{h:.6g}"))
spacings = st.tuples(lengths, lengths, lengths)
shapes = st.tuples(st.integers(2, 7), st.integers(2, 7), st.integers(2, 7))
axes = st.permutations(range(3))
signs = st.tuples(*[st.sampled_from((-1.0, 1.0))] * 3)
origins = st.tuples(*[st.floats(-100, 100)] * 3)


@given(
    st.sampled_from((".nii", ".nii.gz", ".tif", ".zarr")),
    st.sampled_from(TYPES),
    shapes,
    spacings,
    st.sampled_from(UNITS),
)
@settings(max_examples=120, deadline=None)
def test_values_spacing_and_unit_survive(suffix: str, dtype: str, shape, spacing, unit: str) -> None:
    field = Field(ramp(shape, dtype), spacing, unit)
    with tempfile.TemporaryDirectory() as folder:
        back = load(save(field, Path(folder) / f"scan{suffix}"))
    assert np.array_equal(back.values, field.values)
    assert back.values.dtype == (np.uint8 if dtype == "bool" and suffix != ".zarr" else field.values.dtype)
    assert back.spacing == pytest.approx(spacing, rel=1e-6)
    assert back.unit == unit
    assert back.notes == ()


@given(spacings, axes, signs, origins, st.sampled_from(UNITS))
@settings(max_examples=60, deadline=None)
def test_a_turned_affine_survives_nifti(spacing, axes, signs, origin, unit: str) -> None:
    affine = np.eye(4)
    affine[:3, :3] = (np.eye(3) * signs)[list(axes)] * spacing[::-1]
    affine[:3, 3] = origin
    with tempfile.TemporaryDirectory() as folder:
        path = save(Field(ramp(), spacing, unit, affine), Path(folder) / "scan.nii")
        back, image = load(path), nibabel.load(path)
    assert back.affine == pytest.approx(affine, rel=1e-6, abs=1e-5 * max(1, *spacing))
    assert image.get_qform() == pytest.approx(image.get_sform(), rel=1e-4, abs=1e-4 * max(1, *spacing))
    assert int(image.header["qform_code"]) > 0 and int(image.header["sform_code"]) > 0


def test_npy_keeps_values_only(tmp_path: Path) -> None:
    back = load(save(Field(ramp(), 0.5, "mm"), tmp_path / "scan.npy"))
    assert np.array_equal(back.values, ramp())
    assert (back.spacing, back.unit) == ((1, 1, 1), "voxel")
    assert back.notes == ("The file states no spacing: lengths are counted in voxels.",)


def test_nifti_is_x_y_z_in_the_file(tmp_path: Path) -> None:
    path = save(Field(ramp((4, 5, 6)), (3.0, 2.0, 1.0), "um"), tmp_path / "scan.nii.gz")
    image = nibabel.load(path)
    assert image.shape == (6, 5, 4)
    assert np.asanyarray(image.dataobj)[5, 0, 3] == ramp((4, 5, 6))[3, 0, 5]
    assert image.header.get_zooms() == (1, 2, 3)
    assert image.header.get_xyzt_units()[0] == "micron"


def test_tiff_of_ints_is_what_imagej_reads(tmp_path: Path) -> None:
    with tifffile.TiffFile(save(Field(ramp(dtype="uint16"), (3.0, 0.5, 0.25), "um"), tmp_path / "scan.tif")) as file:
        metadata, tags = file.imagej_metadata, file.pages[0].tags
        assert (metadata["spacing"], metadata["unit"], metadata["slices"]) == (3.0, "micron", 4)
        top, bottom = tags["XResolution"].value
        assert top / bottom == pytest.approx(4)


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
    name, factor = (file_unit, 1.0) if unit is None else normalise_unit(unit)
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
    assert normalise_unit(name) == expected


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


@pytest.mark.parametrize(("suffix", "module"), [(".nrrd", "nrrd"), (".mha", "SimpleITK"), (".mrc", "mrcfile")])
def test_a_missing_library_says_how_to_get_it(tmp_path: Path, monkeypatch, suffix: str, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"scan{suffix}").write_bytes(b"x")
    with pytest.raises(ScanError, match=rf'expected {module} for .*, got none: pip install "curvafit\[io\]"'):
        load(tmp_path / f"scan{suffix}")


# ---- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        (ramp((5, 6)), r"expected a 3D volume, got 2D of shape \(5, 6\)"),
        (ramp((1, 5, 6)), r"expected a 3D volume, got 2D of shape \(1, 5, 6\)"),
        (ramp((2, 3, 4, 5)), r"expected a 3D volume, got 4D of shape \(2, 3, 4, 5\)"),
        (np.zeros((0, 5, 6)), "expected a 3D volume, got no values"),
        (np.where(ramp() == 7, np.nan, ramp()), "expected finite values, got 1 that are NaN"),
        (np.where(ramp() < 2, np.inf, ramp()), "expected finite values, got 2 that are infinite"),
        (np.full((4, 5, 6), 3), "expected a volume that varies, got 3 everywhere"),
        (ramp() * 1j, "expected numbers, got values of type complex64"),
    ],
)
def test_unusable_values_are_refused(tmp_path: Path, values: np.ndarray, complaint: str) -> None:
    np.save(tmp_path / "scan.npy", values)
    with pytest.raises(ScanError, match=complaint):
        load(tmp_path / "scan.npy")


@pytest.mark.parametrize("spacing", [(1, 0, 1), (1, -1, 1), (1, 1), (1, 2, 3, 4), (1, float("nan"), 1), "abc", 0.0])
def test_bad_spacing_is_refused(tmp_path: Path, spacing) -> None:
    np.save(tmp_path / "scan.npy", ramp())
    with pytest.raises(ScanError, match=r"expected a spacing of 3 positive numbers \(z, y, x\), got"):
        load(tmp_path / "scan.npy", spacing=spacing)


def test_zero_spacing_in_a_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["raw"] = ramp()
        file["raw"].attrs["element_size_um"] = [0.0, 0.2, 0.2]
    with pytest.raises(ScanError, match=r"expected a spacing of 3 positive numbers .*, got \(0.0, 0.2, 0.2\)"):
        load(tmp_path / "scan.h5")
    assert load(tmp_path / "scan.h5", spacing=1).spacing == (1, 1, 1)


def test_bad_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="got no such file"):
        load(tmp_path / "scan.nii")
    (tmp_path / "scan.xyz").write_bytes(b"x")
    with pytest.raises(ScanError, match="expected a file ending in one of .nii, .*, got 'scan.xyz'"):
        load(tmp_path / "scan.xyz")
    with pytest.raises(ScanError, match="expected a name ending in one of .*.zarr, got 'scan.xyz'"):
        save(Field(ramp()), tmp_path / "scan.xyz")
    with pytest.raises(ScanError, match="expected a folder of TIFF or DICOM slices or a Zarr store"):
        load(tmp_path)
    with pytest.raises(ScanError, match="expected a unit of voxel, nm, um, mm or m, got 'furlong'"):
        Field(ramp(), unit="furlong")
    with pytest.raises(ScanError, match="expected a grey volume, got a colour image"):
        tifffile.imwrite(tmp_path / "scan.tif", np.zeros((5, 6, 3), np.uint8), photometric="rgb")
        load(tmp_path / "scan.tif")


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
    with pytest.raises(ScanError, match="expected a whole, readable file, got .* that cannot be read"):
        load(path)


def test_every_suffix_has_a_reader_that_refuses_rubbish(tmp_path: Path) -> None:
    for suffix in READABLE:
        path = tmp_path / f"scan{suffix}"
        path.write_bytes(b"not a volume at all")
        with pytest.raises(ScanError, match="^expected [^\n]*$"):
            load(path, raw_shape=(4, 5, 6))


# ---- writing is all or nothing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".nii.gz", ".zarr"])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch, suffix: str) -> None:
    path = save(Field(ramp()), tmp_path / f"scan{suffix}")
    save(Field(ramp() + 1), path)
    assert np.array_equal(load(path).values, ramp() + 1)

    def fails(field: Field, target: Path) -> None:
        target.write_bytes(b"half")
        raise RuntimeError("disk full")

    monkeypatch.setitem(sys.modules["curvafit.scan"].WRITERS, suffix, fails)
    with pytest.raises(RuntimeError, match="disk full"):
        save(Field(ramp()), path)
    assert np.array_equal(load(path).values, ramp() + 1)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


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
