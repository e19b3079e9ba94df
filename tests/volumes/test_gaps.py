"""What is not in a file is said, or refused with `strict`; what is in it in an odd way is read or refused."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from calling import call

from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.read import load, read_values
from curvafit.volumes.write import save

VALUES = (np.random.default_rng(0).random((9, 10, 11)) * 200 + 1).astype(np.uint16)


def refused(path: Path | str, said: str, **options: object) -> None:
    with pytest.raises(ScanError, match=rf"^expected [^\n]*{said}[^\n]*$"):
        load(path, **options)  # type: ignore[arg-type]


# ---- chunks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["v2", "v3", "slashes", "group", "sharded"])
def test_missing_chunks_are_said_or_refused(tmp_path: Path, kind: str) -> None:
    path = folder = tmp_path / "scan.zarr"
    options: dict = {
        "v2": {"zarr_format": 2},
        "slashes": {"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}},
        "sharded": {"shards": (8, 10, 12)},
    }.get(kind, {})
    if kind == "group":
        zarr.create_group(path).create_array("a/b", data=VALUES, chunks=(4, 5, 6), fill_value=7)
        folder = path / "a" / "b"
    else:
        zarr.create_array(path, data=VALUES, chunks=(4, 5, 6), fill_value=7, **options)
    assert load(path, spacing=1.0).notes == () and np.array_equal(load(path, strict=True).values, VALUES)
    names = {"v2": "1.0.1", "slashes": "1/0/1", "sharded": "c/1/0/0"}
    (folder / names.get(kind, "c/1/0/1")).unlink()
    lost = 4 if kind == "sharded" else 1
    note = f"{lost} of 12 chunks are not stored: their voxels have the fill value 7."
    field = load(path, spacing=1.0)
    assert field.notes == (note,)
    assert np.count_nonzero(field.values != VALUES) <= lost * 4 * 5 * 6
    refused(path, f"a whole volume, got .*scan.zarr: {note}", strict=True)
    with pytest.warns(UserWarning, match=f"scan.zarr: {note}"):
        read_values(path)


def test_chunks_that_a_shard_lacks_are_counted(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[:4, :5, :6] = 0  # Zarr leaves out what is its fill value
    zarr.create_array(tmp_path / "a.zarr", data=values, chunks=(4, 5, 6), shards=(8, 10, 12))
    assert load(tmp_path / "a.zarr", spacing=1.0).notes == (
        "1 of 12 chunks are not stored: their voxels have the fill value 0.",
    )


def test_what_is_saved_has_all_its_chunks(tmp_path: Path) -> None:
    mask = np.zeros((70, 70, 70), np.uint8)
    mask[:5] = 1
    assert load(save(Field(mask, 1.0, "um"), tmp_path / "mask.zarr"), strict=True).notes == ()


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
    refused(path, "1 of its 1 source files are not there, gone.h5", key="virtual", strict=True)
    refused(path, "values in the file itself", key="outside")


def test_numbers_that_slices_skip_are_said(tmp_path: Path) -> None:
    for number in (0, 5, 10, 20, 25):
        tifffile.imwrite(tmp_path / f"s{number:03d}.tif", VALUES[number % 9])
    assert any("skip some, after s010 for one" in note for note in load(tmp_path).notes)
    refused(tmp_path, "skip some", strict=True)
    tifffile.imwrite(tmp_path / "s015.tif", VALUES[3])
    assert load(tmp_path, strict=True).shape == (6, 10, 11)


def test_the_command_line_says_it_and_takes_strict(tmp_path: Path) -> None:
    z, y, x = np.indices((24, 24, 24)) - 11.5
    ball = np.where(z**2 + y**2 + x**2 < 60, 200, 20).astype(np.uint8)
    ball[3, 3, 3] = 21
    path = tmp_path / "scan.zarr"
    zarr.create_array(path, data=ball, chunks=(12, 12, 12), fill_value=20, attributes={"spacing": 1.0, "unit": "um"})
    (path / "c" / "0" / "0" / "0").unlink()
    options = ("--prior", "tubes", "--steps", "1", "-o", tmp_path / "mask.npy")
    told = call("segment", path, *options)
    assert told.exit_code == 0 and "1 of 8 chunks are not stored" in told.output
    told = call("segment", path, *options, "--strict")
    assert told.exit_code == 2 and told.stdout == ""
    assert told.stderr.splitlines()[-1].startswith("error: expected a whole volume, got ")


# ---- compressed TIFF -------------------------------------------------------------------------------------------------


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
    refused(path, "strips or tiles of page 4 are not there")


# ---- odd contents ----------------------------------------------------------------------------------------------------


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
        refused(f"{path}::{key}", "got")
    refused(f"{path}::moon", "fits into memory, got 8e\\+12 bytes")


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
        with pytest.raises(ScanError, match=r"^expected a (spacing|unit) of [^\n]{1,300}$"):
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
        refused(tmp_path / "a.npy", "got")
        refused(tmp_path / "a.npz", "got")
    np.save(tmp_path / "order.npy", np.asfortranarray(VALUES))
    assert np.array_equal(load(tmp_path / "order.npy").values, VALUES)
    refused(f"{tmp_path / 'order.npy'}::raw", "a key only for NPZ, HDF5, Zarr and DICOM, got 'raw'")
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
