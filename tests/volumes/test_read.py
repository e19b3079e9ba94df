"""What files and arrays say is what is read, and what is written comes back: values, spacing, unit, affine, order."""

import bz2
import gzip
import logging
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import torch
from disk import unreadable
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from curvafit import infer, segment
from curvafit.core.units import parse_unit
from curvafit.volumes import ScanError, Volume, load, save
from curvafit.volumes.formats.arrays import read_microscope
from curvafit.volumes.formats.tiff import natural_key
from curvafit.volumes.read import READERS

TYPES = ("bool", "uint8", "int16", "uint16", "int32", "float32", "float64")
UNITS = ("voxel", "nm", "um", "mm", "m")
VALUES = (np.random.default_rng(0).random((9, 10, 11)) * 200 + 1).astype(np.uint16)
BALL = (np.linalg.norm(np.indices((10, 11, 12)).T - (4.5, 5.0, 5.5), axis=-1).T < 4).astype(np.float32)


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different, where the type allows."""
    values = np.arange(np.prod(shape)).reshape(shape)
    return values % 2 == 0 if dtype == "bool" else values.astype(dtype)


def hdf5(path: Path, **datasets: object) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file[name] = values
    return path


lengths = st.floats(1e-3, 1e3, allow_nan=False).map(lambda h: float(f"{h:.6g}"))
spacings = st.tuples(lengths, lengths, lengths)
shapes = st.tuples(st.integers(2, 7), st.integers(2, 7), st.integers(2, 7))
axes = st.permutations(range(3))
signs = st.tuples(*[st.sampled_from((-1.0, 1.0))] * 3)
origins = st.tuples(*[st.floats(-100, 100)] * 3)


def test_every_kind_of_source_is_one_field(tmp_path: Path) -> None:
    field = Volume(ramp(), (3.0, 2.0, 1.0), "um")
    path = save(field, tmp_path / "scan.nii.gz")
    at = {"spacing": (3.0, 2.0, 1.0), "unit": "um"}
    assert load(field) is field
    tensor = torch.from_numpy(ramp())
    taken = [load(str(path)), load(path), *(load(values, **at) for values in (ramp(), tensor))]
    written = [load(save(values, tmp_path / "new.zarr", **at)) for values in (ramp(), tensor)]
    for source in (*taken, *written, load(save(path, tmp_path / "again.tif"))):
        assert np.array_equal(source.values, ramp())
        assert (source.spacing, source.unit) == ((3, 2, 1), "um")
    bare = load(tensor.bfloat16().requires_grad_())
    assert (bare.spacing, bare.unit, bare.values.dtype) == ((1, 1, 1), "voxel", np.float32)


@pytest.mark.parametrize(
    ("source", "options", "word"),
    [
        *((Volume(ramp()), {name: 2}, name) for name in ("spacing", "unit", "key")),
        (ramp(), {"raw_shape": (4, 5, 6)}, "raw_shape"), (ramp(), {"spacing": (1, 2)}, "spacing"),
        (ramp(), {"unit": "furlong"}, "unit"), (ramp((5, 6)), {}, "3D"), ([[[1.0]]], {}, "volume"),
        (np.where(ramp() == 7, np.nan, ramp()), {}, "NaN"),
        *((ramp().astype(kind), {}, "real numbers") for kind in (str, complex, object)),
    ],
)  # fmt: skip
def test_sources_and_options_that_do_not_fit_are_refused(source, options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        load(source, **options)


@pytest.mark.parametrize(
    "job", [infer, partial(segment, prior="tubes"), partial(segment, probabilities=True, weight=1)]
)
def test_no_job_drops_an_option_in_silence(job) -> None:
    for options, word in (({"spacing": 2}, "spacing"), ({"unit": "mm"}, "unit"), ({"strict": True}, "strict")):
        with pytest.raises(ScanError, match=word):
            job(Volume(BALL), **options)
    with pytest.raises(ScanError, match="volume"):
        job(None)


def test_a_field_is_one_line_and_equals_itself() -> None:
    field = Volume(ramp(), (3.0, 2.0, 1.0), "um", source="scan\n.nii.gz")
    assert repr(field) == "Volume(4 x 5 x 6 voxels of 3 x 2 x 1 µm, float32 from 0 to 119, from scan\\n.nii.gz)"
    assert (
        repr(Volume(ramp(dtype="uint8"), 0.0195, "mm")) == "Volume(4 x 5 x 6 voxels of 0.0195 mm, uint8 from 0 to 119)"
    )
    assert field == field and field != Volume(ramp()) and len({field, field}) == 1


# ---- what files say --------------------------------------------------------------------------------------------------


def test_nifti_scaling_singleton_axes_and_a_unit_that_is_not_named(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(ramp((4, 5, 6, 1), "int16"), np.diag([0.1, 0.2, 0.3, 1]))
    image.header.set_slope_inter(2, 5)
    nibabel.save(image, tmp_path / "scan.nii")
    field = load(tmp_path / "scan.nii")
    assert (field.shape, field.spacing, field.unit) == ((6, 5, 4), (0.3, 0.2, 0.1), "mm")
    assert field.values.max() > 119  # scaled by what the header says on reading
    assert field.notes == ("The file names no unit of length: mm is assumed.",)
    assert load(tmp_path / "scan.nii", unit="um").notes == ()


def imagej(**metadata: object) -> dict:
    return {"imagej": True, "metadata": {"axes": "ZYX", **metadata}}


OME = {"PhysicalSizeX": 0.2, "PhysicalSizeY": 0.2, "PhysicalSizeZ": 900, "PhysicalSizeZUnit": "nm"}


@pytest.mark.parametrize(
    ("options", "spacing", "unit"),
    [
        ({**imagej(spacing=3, unit="micron"), "resolution": (4, 2)}, (3, 0.5, 0.25), "um"),
        ({**imagej(unit="cm"), "resolution": (4, 4)}, (2.5, 2.5, 2.5), "mm"),
        ({**imagej(spacing=2), "resolution": (0.5, 0.5)}, (1, 1, 1), "voxel"), (imagej(spacing=5), (5, 1, 1), "voxel"),
        ({**imagej(spacing=0.02, unit="nm", zunit="um"), "resolution": (0.1, 0.05)}, (20, 20, 10), "nm"),
        ({**imagej(spacing=200, unit="nm", yunit="\\u00B5m", zunit="\\u00C5"), "resolution": (0.1, 0.05)},
         (20, 20000, 10), "nm"),
        ({"ome": True, "metadata": {"axes": "ZYX", **OME}}, (0.9, 0.2, 0.2), "um"),
        ({"metadata": {"axes": "ZYX", "spacing": [3, 2, 1], "unit": "um"}}, (3, 2, 1), "um"),
        ({"metadata": {"axes": "ZYX", "spacing": 19.5, "unit": "um"}}, (19.5, 19.5, 19.5), "um"),
        ({"resolution": (500, 500), "resolutionunit": "CENTIMETER"}, (0.02, 0.02, 0.02), "mm"),
        *(({"resolution": (each, each), "resolutionunit": "INCH"}, (1, 1, 1), "voxel") for each in (72, 25.4)),
        ({}, (1, 1, 1), "voxel"),
    ],
)  # fmt: skip
def test_tiff_states_its_spacing_in_many_ways(tmp_path: Path, options: dict, spacing, unit: str) -> None:
    tifffile.imwrite(tmp_path / "scan.tif", ramp(), photometric="minisblack", **options)
    field = load(tmp_path / "scan.tif")
    assert field.spacing == pytest.approx(spacing, rel=1e-5) and field.unit == unit
    given = load(tmp_path / "scan.tif", spacing=(3, 2, 1), unit="nm")
    assert (given.spacing, given.unit) == ((3, 2, 1), "nm")
    assert ["the file states" in note for note in given.notes] == [True] * (unit != "voxel")


def test_a_scan_wider_than_a_metre_is_asked_for_its_unit(tmp_path: Path) -> None:
    path = save(ramp(), tmp_path / "bone.npy")
    for spacing, unit, wide in ((200.0, "mm", "1200 mm"), (0.5, "m", "3 m"), (166.0, "mm", ""), (1e5, "um", "")):
        notes = [note for note in load(path, spacing=spacing, unit=unit).notes if "wide" in note]
        assert notes == [f"The scan would be {wide} wide: is the voxel in µm?"] * bool(wide)


def test_a_folder_of_slices_is_sorted_naturally_and_says_what_is_skipped(tmp_path: Path) -> None:
    for number, plane in enumerate(ramp((12, 5, 6), "uint8")):
        tifffile.imwrite(tmp_path / f"slice{number}.tif", plane, resolution=(1000, 1000), resolutionunit="CENTIMETER")
    field = load(tmp_path, strict=True)
    assert np.array_equal(field.values, ramp((12, 5, 6), "uint8"))
    assert field.spacing == pytest.approx((0.01, 0.01, 0.01))
    assert any("distance of slices" in note for note in field.notes)
    (tmp_path / "slice5.tif").unlink()
    assert any("skip some, after slice4 for one" in note for note in load(tmp_path).notes)
    unreadable(tmp_path, "skip some", strict=True)
    tifffile.imwrite(tmp_path / "slice12.tif", np.zeros((5, 7), np.uint8))
    unreadable(tmp_path, "slice12.tif")


@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=8, unique=True))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    names = sorted((f"Rec_{n}_v2.tif" for n in numbers), key=natural_key)
    assert names == [f"Rec_{n}_v2.tif" for n in sorted(numbers)]


def test_hdf5_and_npz_keys(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "scan.h5", **{"group/raw": ramp()})
    with h5py.File(path, "a") as file:
        file["group/raw"].attrs["element_size_um"] = [3.0, 2.0, 1.0]
    assert load(path).spacing == (3, 2, 1)
    with h5py.File(path, "a") as file:
        file["label"] = ramp(dtype="uint16")
        file["label"].attrs.update({"spacing": 0.5, "unit": "mm"})
    np.savez(tmp_path / "scan.npz", raw=ramp(), label=ramp(dtype="uint16"))
    for name in ("scan.h5", "scan.npz"):
        labels = load(f"{tmp_path / name}::label")
        assert labels.values.dtype == np.uint16
        assert np.array_equal(load(tmp_path / name, key="label").values, labels.values)
        unreadable(tmp_path / name, "label")
        unreadable(f"{tmp_path / name}::no", "label")
    field = load(tmp_path / "scan.h5::label")
    assert (field.spacing, field.unit, field.source) == ((0.5, 0.5, 0.5), "mm", f"{tmp_path / 'scan.h5'}::label")
    for unit in (b"um", ["um"], np.array([b"um"])):
        stated(spacing=np.array([2]), unit=unit)(path)
        assert (load(path).spacing, load(path).unit) == ((2, 2, 2), "um")


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "<f4"])
def test_raw_files(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "scan.raw"
    ramp(dtype="uint8").astype(dtype).tofile(path)
    field = load(path, raw_shape=(4, 5, 6), dtype=dtype)
    assert np.array_equal(field.values, ramp())
    assert field.values.dtype.isnative
    unreadable(path, "bytes", raw_shape=(4, 5, 7), dtype=dtype)
    unreadable(path, "raw-shape")
    if dtype != "uint8":
        unreadable(path, "dtype", raw_shape=(4, 5, 6))


@given(spacings, spacings, st.sampled_from(UNITS), st.sampled_from((*UNITS, "cm", "µm", None)))
@settings(max_examples=40, deadline=None)
def test_arguments_override_the_file_and_the_affine_follows(stated, given_spacing, file_unit: str, unit) -> None:
    assume(unit is not None or file_unit != "voxel" or min(given_spacing) == 1)  # else a unit is asked for
    with tempfile.TemporaryDirectory() as folder:
        path = save(Volume(ramp(), stated, file_unit), Path(folder) / "scan.nii")
        field = load(path, spacing=given_spacing, unit=unit)
    name, factor = (file_unit, 1.0) if unit is None else parse_unit(unit)
    assert field.unit == name and field.spacing == pytest.approx(tuple(h * factor for h in given_spacing))
    assert np.linalg.norm(field.affine[:3, :3], axis=0)[::-1] == pytest.approx(field.spacing, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("µm", ("um", 1)), ("Micron", ("um", 1)), ("\\u00B5m", ("um", 1)), ("Å", ("nm", 0.1)), ("cm", ("mm", 10)),
        ("meter", ("m", 1)), (None, ("voxel", 1)),
    ],
)  # fmt: skip
def test_units_have_one_name(name: str | None, expected: tuple[str, float]) -> None:
    assert parse_unit(name) == expected


@pytest.mark.parametrize("compression", ["lzw", "deflate", "adobe_deflate", "packbits", "zstd", "jpeg2000"])
def test_compressed_tiffs_and_slices_are_read(tmp_path: Path, compression: str) -> None:
    for predictor in (False, True) if compression not in ("packbits", "jpeg2000") else (False,):
        options: dict = {"photometric": "minisblack", "compression": compression, "predictor": predictor}
        tifffile.imwrite(tmp_path / "scan.tif", VALUES, imagej=True, metadata={"axes": "ZYX", "spacing": 2}, **options)
        assert np.array_equal(load(tmp_path / "scan.tif").values, VALUES)
        (tmp_path / "slices").mkdir(exist_ok=True)
        for number, plane in enumerate(VALUES):
            tifffile.imwrite(tmp_path / "slices" / f"{number}.tif", plane, rowsperstrip=3, **options)
        assert np.array_equal(load(tmp_path / "slices").values, VALUES)


def test_an_nrrd_header_names_one_file_of_values(tmp_path: Path) -> None:
    header = "NRRD0004\ntype: float\ndimension: 3\nsizes: {2} {1} {0}\nendian: little\nencoding: raw\n"
    path, head = tmp_path / "scan.nhdr", header.format(*ramp().shape)
    (tmp_path / "a.raw").write_bytes(ramp().tobytes())
    path.write_text(f"{head}data file: a.raw\n")
    assert np.array_equal(load(path).values, ramp())
    for more, word in (
        ("data file: LIST\na.raw\nb.raw", "several files"), ("datafile: a%03d.raw 1 9 1", "several files"),
        ("byte skip: -1\ndata file: a.raw", "byte skip"), ("lineskip: 2\ndata file: a.raw", "line skip"),
    ):  # fmt: skip
        path.write_text(f"{head}{more}\n")
        unreadable(path, word)


def write_dicom(path: Path, plane: np.ndarray, position: float, spacing: Sequence[float] = (0.5, 0.25)) -> None:
    import pydicom

    image = pydicom.Dataset()
    image.file_meta = pydicom.dataset.FileMetaDataset()
    image.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID = pydicom.uid.CTImageStorage
    image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID = pydicom.uid.generate_uid()
    for name, value in {
        "SeriesInstanceUID": "1.2.3", "Rows": plane.shape[0], "Columns": plane.shape[1], "PixelSpacing": list(spacing),
        "ImageOrientationPatient": [1, 0, 0, 0, 1, 0], "ImagePositionPatient": [0, 0, position], "RescaleSlope": 2,
        "RescaleIntercept": -10, "SamplesPerPixel": 1, "PhotometricInterpretation": "MONOCHROME2", "BitsAllocated": 16,
        "BitsStored": 16, "HighBit": 15, "PixelRepresentation": 0, "PixelData": plane.tobytes(),
    }.items():  # fmt: skip
        setattr(image, name, value)
    image.save_as(path, enforce_file_format=True)


IMARIS = np.random.default_rng(0).integers(1, 60000, (2, 5, 6, 7)).astype(np.uint16)


def write_imaris(path: Path, channels: int, voxels: int | None = None) -> None:
    """An Imaris file: chunks that reach beyond the image, attributes of single characters."""

    def characters(text: object) -> np.ndarray:
        return np.frombuffer(str(text).encode(), "S1")

    with h5py.File(path, "w") as file:
        for c in range(channels):
            group = file.create_group(f"DataSet/ResolutionLevel 0/TimePoint 0/Channel {c}")
            stored = np.pad(IMARIS[c], [(0, 3), (0, 2), (0, 1)])
            group.create_dataset("Data", data=stored, chunks=(4, 4, 4), compression="gzip")
            group.create_dataset("Histogram", data=np.zeros(256, np.uint64))
            for axis, n in zip("ZYX", IMARIS.shape[1:], strict=True):
                group.attrs[f"ImageSize{axis}"] = characters(voxels or n)
            file.create_dataset(f"DataSet/ResolutionLevel 1/TimePoint 0/Channel {c}/Data", data=stored[::2, ::2, ::2])
        image = file.create_group("DataSetInfo/Image")
        image.attrs["Unit"] = "um"  # other programs write a plain string
        for k, (n, edge) in enumerate(zip(IMARIS.shape[:0:-1], (0.1, 0.2, 0.3), strict=True)):
            image.attrs[f"ExtMin{k}"], image.attrs[f"ExtMax{k}"] = characters(5.5), characters(5.5 + n * edge)


def test_voxels_and_edges_of_imaris_are_the_image_s(tmp_path: Path) -> None:
    write_imaris(tmp_path / "one.ims", 1)
    write_imaris(tmp_path / "two.ims", 2)
    one, two = load(tmp_path / "one.ims"), load(tmp_path / "two.ims", key="TimePoint 0/Channel 1")
    for field, values in ((one, IMARIS[0]), (two, IMARIS[1])):
        assert np.array_equal(field.values, values) and field.unit == "um"
        assert field.spacing == pytest.approx((0.3, 0.2, 0.1))
    part = load(tmp_path / "one.ims", crop="1:-1,2:,:4")
    assert np.array_equal(part.values, IMARIS[0, 1:-1, 2:, :4])
    unreadable(tmp_path / "two.ims", "Channel 1")


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
        unreadable(path, "cannot be read")


# ---- what cannot be used: format and fault ---------------------------------------------------------------------------


def npy(values: np.ndarray) -> Callable[[Path], object]:
    return lambda path: np.save(path, values)


def npz(values: np.ndarray) -> Callable[[Path], object]:
    return lambda path: np.savez(path, values)


def dataset(**options: object) -> Callable[[Path], object]:
    """An HDF5 file with a dataset of these options."""

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset("raw", **options)  # type: ignore[arg-type]

    return write


def stated(**attributes: object) -> Callable[[Path], object]:
    """An HDF5 file with a dataset of these attributes."""

    def write(path: Path) -> None:
        with h5py.File(hdf5(path, raw=VALUES), "a") as file:
            file["raw"].attrs.update(attributes)

    return write


def lose_strips(path: Path) -> None:
    """Set the sizes of a page's strips to 0."""
    tifffile.imwrite(path, VALUES, photometric="minisblack", compression="lzw", rowsperstrip=3, metadata=None)
    with tifffile.TiffFile(path, mode="r+") as file:
        tag = file.pages[4].tags["StripByteCounts"]  # type: ignore[union-attr]
        tag.overwrite((0,) * tag.count)


def scale_by_furlongs(path: Path) -> None:
    """State three units, of which one is not known."""
    units = imagej(unit="nm", yunit="um", zunit="furlong", spacing=20)
    tifffile.imwrite(path, VALUES, resolution=(0.1, 0.05), **units)


RECORDS = np.zeros((2, 3, 4), np.dtype([("a", "f4"), ("ö", "i2")]))
BARE = {"spacing": "abc"}, {"spacing": (1, 0, 1)}, {"spacing": (1, -1, 1)}, {"spacing": (1, 1)}, {"spacing": 0.0}
BARE += ({"spacing": (1, 2, 3, 4)}, {"spacing": (1, float("nan"), 1)})
REFUSED: list[tuple[str, Callable[[Path], object], dict, str]] = [
    ("a.bmp", lambda path: path.write_bytes(b"BM"), {}, "must end.*a folder of their own"),
    ("a.npy", npy(ramp((5, 6))), {}, "2D.*a folder of their own"), ("a.npy", npy(ramp((1, 5, 6))), {}, "2D"),
    ("a.npy", npy(ramp((2, 3, 4, 5))), {}, "4D"), ("a.npy", npy(np.zeros((0, 5, 6))), {}, "no values"),
    ("a.npy", npy(np.where(ramp() == 7, np.nan, ramp())), {}, "NaN"),
    ("a.npy", npy(np.where(ramp() < 2, np.inf, ramp())), {}, "infinite"),
    ("a.npy", npy(np.full((4, 5, 6), 3)), {}, "vary"), ("a.npy", npy(VALUES), {"key": "raw"}, "key"),
    ("a.npy", lambda path: hdf5(path, raw=VALUES), {}, "cannot be read"),
    *(("a.npy", npy(ramp()), options, "spacing") for options in BARE),
    *((name, write(values), {}, "")
      for values in (np.array([None]), RECORDS, np.array(["a"]), VALUES * 1j, np.float64(3))
      for name, write in (("a.npy", npy), ("a.npz", npz))),
    *(("a.h5", dataset(data=values), {}, "")
      for values in (3.0, "abc", np.zeros((0, 3, 4)), h5py.Empty("f4"), np.array([b"a", b"b"]), VALUES * 1j,
                     np.zeros((2, 3, 4), np.dtype([("a", "f4"), ("b", "i2")])))),
    ("a.h5", dataset(shape=(2,), dtype=h5py.vlen_dtype(np.int32)), {}, ""),
    ("a.h5", dataset(shape=(10**4,) * 3, dtype="f8", chunks=(100,) * 3), {}, "memory"),
    ("a.h5", dataset(shape=(8, 8, 8), dtype="u1", external=[("bytes", 0, 512)]), {}, "other files"),
    ("a.h5", lambda path: hdf5(path, raw=h5py.ExternalLink("nowhere.h5", "raw")), {}, ""),
    ("a.h5", stated(element_size_um=[0.0, 0.2, 0.2]), {}, "spacing"), ("a.tif", lose_strips, {}, "page 4"),
    ("a.tif", scale_by_furlongs, {}, "um and nm"),
    ("a.ims", lambda path: hdf5(path, raw=VALUES), {}, "no arrays"),
    ("a.ims", lambda path: write_imaris(path, 1, voxels=900), {}, "900"),
    ("a.nowhere", lambda path: path.write_bytes(b"x"), {}, "must end"),
    ("folder", lambda path: path.mkdir(), {}, "folder"),
    *((f"a{suffix}", lambda path: path.write_bytes(b"not a volume at all"), {"raw_shape": (4, 5, 6)}, "")
      for suffix in READERS if READERS[suffix] is not read_microscope),
]  # fmt: skip


@pytest.mark.parametrize(("name", "write", "options", "word"), REFUSED)
def test_what_cannot_be_used_is_refused_in_one_sentence(tmp_path: Path, name: str, write, options, word: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write(tmp_path / name)
    unreadable(tmp_path / name, word, **options)


STATED: list[dict[str, object]] = [
    *({"spacing": wrong} for wrong in ([1.0, 2.0], [], "wide", [1.0, np.nan, 1.0], b"abc")),
    *({"spacing": 1.0, "unit": wrong} for wrong in (3.0, b"\xff\xfe")),
    {"element_size_um": [[1.0, 2.0], [3.0, 4.0]]},
    {"voxel_size": "x" * 30_000},
]


@pytest.mark.parametrize("attributes", STATED)
def test_odd_attributes_are_refused_or_overridden(tmp_path: Path, attributes: dict) -> None:
    path = tmp_path / "scan.h5"
    stated(**attributes)(path)
    with pytest.raises(ScanError, match=r"(?s)^(?=.{1,400}$)[^\n]*(spacing|unit)"):
        load(path)
    field = load(path, spacing=(3, 2, 1), unit="um")
    assert (field.spacing, field.unit) == ((3, 2, 1), "um")


def test_hdf5_without_all_its_chunks_or_any_value(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        some = file.create_dataset("some", (8, 8, 8), "f4", chunks=(4, 4, 4), fillvalue=3)
        some[:4] = 1
        file.create_dataset("none", (8, 8, 8), "f4")
        layout = h5py.VirtualLayout((8, 8, 8), "f4")
        layout[:4] = h5py.VirtualSource("gone.h5", "raw", (4, 8, 8))
        file.create_virtual_dataset("virtual", layout, fillvalue=0)
    note = "4 of 8 chunks are not stored: their voxels have the fill value 3.0."
    assert note in load(path, key="some").notes
    for key, said in (("some", note), ("none", "No values are stored"), ("virtual", "gone.h5")):
        unreadable(path, said, key=key, strict=True)


def test_reading_leaves_loggers_and_warnings_as_they_were(tmp_path: Path) -> None:
    names = ("tifffile", "nibabel.global", "pydicom")
    state = [(logging.getLogger(name).level, logging.getLogger(name).filters[:]) for name in names]
    filters = warnings.filters[:]
    for suffix in (".tif", ".nii.gz", ".nii"):
        path = save(Volume(VALUES, 1.0, "um"), tmp_path / f"scan{suffix}")
        load(path)
        path.write_bytes(path.read_bytes()[:400])
        unreadable(path, "cannot be read")
    assert [(logging.getLogger(name).level, logging.getLogger(name).filters[:]) for name in names] == state
    assert warnings.filters[:] == filters


# ---- what is written comes back ------------------------------------------------------------------------------------


suffixes = st.sampled_from((".nii", ".nii.gz", ".tif", ".zarr"))


@given(suffixes, st.sampled_from(TYPES), shapes, spacings, st.sampled_from(UNITS))
@settings(max_examples=120, deadline=None)
def test_values_spacing_and_unit_survive(suffix: str, dtype: str, shape, spacing, unit: str) -> None:
    field = Volume(ramp(shape, dtype), spacing, unit)
    with tempfile.TemporaryDirectory() as folder:
        back = load(save(field, Path(folder) / f"scan{suffix}"))
    assert np.array_equal(back.values, field.values)
    assert back.values.dtype == (np.uint8 if dtype == "bool" and suffix != ".zarr" else field.values.dtype)
    assert back.spacing == pytest.approx(spacing, rel=1e-6)
    assert back.unit == unit and not [note for note in back.notes if "wide" not in note]


def test_npy_keeps_values_only(tmp_path: Path) -> None:
    back = load(save(Volume(ramp(), 0.5, "mm"), tmp_path / "scan.npy"))
    assert np.array_equal(back.values, ramp())
    assert (back.spacing, back.unit) == ((1, 1, 1), "voxel")
    assert back.notes == ("The file states no spacing: lengths are counted in voxels.",)


@pytest.mark.parametrize("member", [100, 2**28])
def test_a_compressed_nifti_holds_what_a_plain_one_does(tmp_path: Path, monkeypatch, member: int) -> None:
    monkeypatch.setattr("curvafit.volumes.formats.nifti.MEMBER", member)
    field = Volume(ramp(), (0.3, 0.2, 0.1), "um")
    plain, packed = (save(field, tmp_path / name).read_bytes() for name in ("scan.nii", "scan.nii.gz"))
    assert gzip.decompress(packed) == plain
    assert packed.count(b"\x1f\x8b\x08") == -(-len(plain) // member)


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    wide = Volume(ramp(dtype="int32"), 1.0, "nm")
    for field, name, word in ((Volume(ramp()), "a.mrc", "unit"), (wide, "a.mrc", "int32"), (wide, "a.xyz", "must end")):
        with pytest.raises(ScanError, match=word):
            save(field, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".nii.gz", ".zarr"])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch, suffix: str) -> None:
    path = save(Volume(ramp()), tmp_path / f"scan{suffix}")
    save(Volume(ramp() + 1), path)
    assert np.array_equal(load(path).values, ramp() + 1)

    def fails(field: Volume, target: Path) -> None:
        target.write_bytes(b"half")
        raise RuntimeError("disk full")

    monkeypatch.setitem(sys.modules["curvafit.volumes.write"].WRITERS, suffix, fails)
    with pytest.raises(RuntimeError, match="disk full"):
        save(Volume(ramp()), path)
    assert np.array_equal(load(path).values, ramp() + 1)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


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
    np.save(tmp_path / "scan.npy", ramp(dtype="uint8"))
    unreadable(tmp_path / "scan.npy", "unit of the spacing", spacing=0.0195)
    assert load(tmp_path / "scan.npy", spacing=(2.5, 1, 1)).unit == "voxel"
    assert load(tmp_path / "scan.npy", spacing=0.0195, unit="mm").spacing == pytest.approx((0.0195,) * 3)


@pytest.mark.parametrize(
    ("place", "spacing", "unit"),
    [
        ({"spacing": [2.0, 1.0, 0.5], "unit": "um"}, (2.0, 1.0, 0.5), "um"),
        ({"voxel_size": 0.5, "units": ["mm"]}, (0.5, 0.5, 0.5), "mm"),
        ({"pixel_size": 3.0}, (1.0, 1.0, 1.0), "voxel"),
    ],
)
def test_arrays_beside_that_of_an_npz_file_state_its_voxels(
    tmp_path: Path, place: dict, spacing: tuple[float, ...], unit: str
) -> None:
    values = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)
    np.savez(tmp_path / "scan.npz", image=values, **place)
    volume = load(tmp_path / "scan.npz")
    assert (volume.values == values).all() and (volume.spacing, volume.unit) == (spacing, unit)
    assert any("pixel_size" in note for note in volume.notes) == ("pixel_size" in place)


@pytest.mark.parametrize(
    "beside", [{}, {"unit": None}, {"resolution": "high"}, {"high_resolution": np.zeros((3, 4, 6), np.uint8)}]
)
def test_an_npz_file_s_volume_is_no_spacing_whatever_its_name(tmp_path: Path, beside: dict) -> None:
    values = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)
    np.savez(tmp_path / "scan.npz", low_resolution=values, **beside)
    assert (load(tmp_path / "scan.npz", key="low_resolution").values == values).all()


def test_a_label_of_a_label_and_of_a_file_larger_than_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    labels = np.repeat(np.arange(4.0), 2)[:, None, None] + np.zeros((8, 3, 4))
    np.save(tmp_path / "labels.npy", labels)
    lazy = load(tmp_path / "labels.npy", label=2, lazy=True)
    assert lazy.in_file and lazy.dtype == bool and (lazy.values == (labels == 2)).all()
    assert (lazy.label(1).values == (labels == 2)).all()
    with pytest.raises(ScanError, match="which has 0"):
        load(tmp_path / "labels.npy", label=9, lazy=True).load()
    monkeypatch.setattr("curvafit.volumes.formats.base.memory", lambda: 500)
    for label in (None, 2):
        with pytest.raises(ScanError, match="memory"):
            load(tmp_path / "labels.npy", label=label)


@pytest.mark.parametrize("suffix", [".npy", ".nii", ".nii.gz"])
@pytest.mark.parametrize("target", ["copy.zarr", "copy.npy"])
@pytest.mark.parametrize("value", [1.0, np.nan])
def test_a_file_without_a_structure_is_not_copied(tmp_path: Path, suffix: str, target: str, value: float) -> None:
    values = np.ones((5, 5, 5), dtype=np.float32)
    values[2, 2, 2] = value
    source = tmp_path / f"scan{suffix}"
    if suffix == ".npy":
        np.save(source, values)
    else:
        nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), source)
    with pytest.raises(ScanError, match="vary|finite"):
        save(source, tmp_path / target)


def test_masks_and_labels_are_not_shown_black(tmp_path: Path) -> None:
    """ImageJ shows 0 to the greatest label; grey levels are shown as it chooses. Values are as they were."""
    for most, shown in ((1, (0.0, 1.0)), (7, (0.0, 7.0)), (200, (None, None))):
        values = np.zeros((3, 4, 5), np.uint8)
        values[1, 2, 3] = most
        save(Volume(values), path := tmp_path / f"{most}.tif")
        with tifffile.TiffFile(path) as file:
            stated = file.imagej_metadata or {}
        assert (stated.get("min"), stated.get("max")) == shown
        assert (load(path).values == values).all()
