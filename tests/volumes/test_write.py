"""Reading what was written: nothing moves, turns, rescales or changes its unit on the way."""

from __future__ import annotations

import gzip
import sys
import tempfile
from pathlib import Path

import nibabel
import numpy as np
import pytest
import tifffile
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.volumes import Field, ScanError, load, save

TYPES = ("bool", "uint8", "int16", "uint16", "int32", "float32", "float64")
UNITS = ("voxel", "nm", "um", "mm", "m")


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different, where the type allows."""
    values = np.arange(np.prod(shape)).reshape(shape)
    return values % 2 == 0 if dtype == "bool" else values.astype(dtype)


lengths = st.floats(1e-3, 1e3, allow_nan=False).map(lambda h: float(f"{h:.6g}"))
spacings = st.tuples(lengths, lengths, lengths)
shapes = st.tuples(st.integers(2, 7), st.integers(2, 7), st.integers(2, 7))
axes = st.permutations(range(3))
signs = st.tuples(*[st.sampled_from((-1.0, 1.0))] * 3)
origins = st.tuples(*[st.floats(-100, 100)] * 3)


@given(
    st.sampled_from((".nii", ".nii.gz", ".tif", ".zarr")), st.sampled_from(TYPES), shapes, spacings,
    st.sampled_from(UNITS),
)  # fmt: skip
@settings(max_examples=120, deadline=None)
def test_values_spacing_and_unit_survive(suffix: str, dtype: str, shape, spacing, unit: str) -> None:
    field = Field(ramp(shape, dtype), spacing, unit)
    with tempfile.TemporaryDirectory() as folder:
        back = load(save(field, Path(folder) / f"scan{suffix}"))
    assert np.array_equal(back.values, field.values)
    assert back.values.dtype == (np.uint8 if dtype == "bool" and suffix != ".zarr" else field.values.dtype)
    assert back.spacing == pytest.approx(spacing, rel=1e-6)
    assert back.unit == unit and back.notes == ()


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


def test_save_takes_any_source(tmp_path: Path) -> None:
    path = save(ramp(), tmp_path / "array.nii.gz", spacing=0.5, unit="mm")
    again = save(path, tmp_path / "again.tif")
    tensor = save(torch.from_numpy(ramp()), tmp_path / "tensor.zarr", spacing=(0.5, 0.5, 0.5), unit="mm")
    for back in map(load, (path, again, tensor)):
        assert np.array_equal(back.values, ramp())
        assert (back.spacing, back.unit) == ((0.5, 0.5, 0.5), "mm")


def test_npy_keeps_values_only(tmp_path: Path) -> None:
    back = load(save(Field(ramp(), 0.5, "mm"), tmp_path / "scan.npy"))
    assert np.array_equal(back.values, ramp())
    assert (back.spacing, back.unit) == ((1, 1, 1), "voxel")
    assert back.notes == ("The file states no spacing: lengths are counted in voxels.",)


def test_nifti_is_x_y_z_in_the_file(tmp_path: Path) -> None:
    image = nibabel.load(save(Field(ramp((4, 5, 6)), (3.0, 2.0, 1.0), "um"), tmp_path / "scan.nii.gz"))
    assert image.shape == (6, 5, 4)
    assert np.asanyarray(image.dataobj)[5, 0, 3] == ramp((4, 5, 6))[3, 0, 5]
    assert image.header.get_zooms() == (1, 2, 3) and image.header.get_xyzt_units()[0] == "micron"


@pytest.mark.parametrize("member", [100, 2**28])
def test_a_compressed_nifti_holds_what_a_plain_one_does(tmp_path: Path, monkeypatch, member: int) -> None:
    monkeypatch.setattr("curvafit.volumes.formats.nifti.MEMBER", member)
    field = Field(ramp(), (0.3, 0.2, 0.1), "um")
    plain, packed = (save(field, tmp_path / name).read_bytes() for name in ("scan.nii", "scan.nii.gz"))
    assert gzip.decompress(packed) == plain
    assert packed.count(b"\x1f\x8b\x08") == -(-len(plain) // member)


def test_tiff_of_ints_is_what_imagej_reads(tmp_path: Path) -> None:
    with tifffile.TiffFile(save(Field(ramp(dtype="uint16"), (3.0, 0.5, 0.25), "um"), tmp_path / "scan.tif")) as file:
        metadata, tags = file.imagej_metadata, file.pages[0].tags
        assert (metadata["spacing"], metadata["unit"], metadata["slices"]) == (3.0, "micron", 4)
        top, bottom = tags["XResolution"].value
        assert top / bottom == pytest.approx(4)


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


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    for field, name, word in (
        (Field(ramp()), "scan.mrc", "unit"),
        (Field(ramp(dtype="int32"), 1.0, "nm"), "scan.mrc", "int32"),
        (Field(ramp()), "scan.xyz", "must end"),
    ):
        with pytest.raises(ScanError, match=word):
            save(field, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


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
