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
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.read import READABLE, load
from curvafit.volumes.write import save

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
    with pytest.raises(ValueError, match="unit"):
        Field(ramp(), unit="furlong")
    for kind in (str, complex, object):
        with pytest.raises(ValueError, match="expected real numbers, got values of type"):
            Field(ramp().astype(kind))
    with pytest.raises(ScanError, match="expected a channel from 0 to 2 of .*, which holds 3 channels, got none"):
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

    monkeypatch.setitem(sys.modules["curvafit.volumes.write"].WRITERS, suffix, fails)
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
