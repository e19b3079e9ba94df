"""Damage is never read as data: checksums, sizes and headers of volume files are taken at their word."""

import gzip
import os
import random
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest

pytest.importorskip("nrrd")
pytest.importorskip("SimpleITK")
pytest.importorskip("mrcfile")

from damage import CHECKED, COUNTED, OTHERS, VALUES, damaged, files_of, gzipped
from disk import unreadable

from curvafit.volumes import ScanError, Volume, load, read_maps, save

CASES = 30


def outcomes(path: Path, seed: str):
    """Damage to files of a volume: by how much one grew, and the values then, or None where they are refused."""
    chance = random.Random(seed)
    for _ in range(CASES):
        file = chance.choice(files_of(path))
        whole = file.read_bytes()
        broken = damaged(whole, chance)
        file.write_bytes(broken)
        try:
            values = load(path).values
        except ScanError as error:
            assert str(error).isprintable() and len(str(error)) < 900
            values = None
        yield len(broken) - len(whole), values
        file.write_bytes(whole)


@pytest.mark.parametrize("name", [*CHECKED, *COUNTED, *OTHERS])
def test_damage_is_never_read_as_data(tmp_path: Path, capfd, name: str) -> None:
    """Values with a checksum are the truth or refused, others as many as the header says, or end in one sentence."""
    (CHECKED | COUNTED | OTHERS)[name](tmp_path / name)
    assert np.array_equal(load(tmp_path / name).values, VALUES)
    refused = 0
    for change, values in outcomes(tmp_path / name, name):
        refused += values is None
        if name in CHECKED:
            assert values is None or np.array_equal(values, VALUES)
        elif name in COUNTED:
            assert values is None or (change == 0 and values.size == VALUES.size)
    assert refused > (CASES / 3 if name in CHECKED else 3)
    assert capfd.readouterr() == ("", "")


def test_a_gzip_stream_is_its_members_alone_to_the_last_bit(tmp_path: Path) -> None:
    path = save(Volume(VALUES, 1.0, "mm"), tmp_path / "scan.nii.gz")
    whole = path.read_bytes()
    content = gzip.decompress(whole)
    path.write_bytes(b"".join(gzipped(content[k : k + 500]) for k in range(0, len(content), 500)))
    assert np.array_equal(load(path).values, VALUES)
    header = nibabel.Nifti1Image(np.zeros((2, 2, 2), np.float32), np.eye(4)).header.copy()
    header["dim"][1:4] = 10_000
    moon = header.binaryblock + bytes(4) + bytes(32)
    broken = [whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :] for k in range(len(whole) - 8, len(whole))]
    broken += [whole[:-cut] for cut in range(1, 9)]
    broken += [gzipped(content) + b"garbage", gzipped(content + bytes(50_000_000)), gzipped(moon)]
    for case in broken:
        path.write_bytes(case)
        unreadable(path)
    (tmp_path / "scan.nii").write_bytes(moon)
    unreadable(tmp_path / "scan.nii")


def test_nibabel_keeps_its_complaints_to_itself_and_the_note_tells(tmp_path: Path, capfd) -> None:
    path = save(Volume(VALUES, (3.0, 2.0, 1.0), "mm"), tmp_path / "scan.nii")
    content = bytearray(path.read_bytes())
    content[80:84] = np.float32(-1).tobytes()  # pixdim[1]
    path.write_bytes(content)
    field = load(path)
    assert field.spacing == (3, 2, 1) and any("header is mended: pixdim" in note for note in field.notes)
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".tif", ".npy", ".npz", ".h5", ".nrrd", ".mha", ".mrc", ".raw"])
def test_pipes_and_devices_are_refused_at_once(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"endless{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "endless"):
        unreadable(tmp_path / f"{name}{suffix}", "neither", raw_shape=(2, 2, 2))


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_pipes_within_folders_and_headers_are_refused(tmp_path: Path) -> None:
    OTHERS["v3.zarr"](tmp_path / "scan.zarr")
    os.mkfifo(tmp_path / "scan.zarr" / "pipe")
    (tmp_path / "slices").mkdir()
    os.mkfifo(tmp_path / "slices" / "a.tif")
    (tmp_path / "a.mhd").write_text(
        "NDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = slices/a.tif\n"
    )
    os.mkfifo(tmp_path / "maps.npz")
    with pytest.raises(ValueError, match="NPZ"):
        read_maps(tmp_path / "maps.npz")
    for name in ("scan.zarr", "slices", "a.mhd"):
        unreadable(tmp_path / name, "file")


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
def test_links_in_circles_and_strange_names(tmp_path: Path) -> None:
    (tmp_path / "a.nii").symlink_to(tmp_path / "a.nii")
    with pytest.raises(FileNotFoundError, match="no such file"):
        load(tmp_path / "a.nii")
    OTHERS["v3.zarr"](tmp_path / "scan.zarr")
    (tmp_path / "scan.zarr" / "inner").symlink_to(tmp_path / "scan.zarr")
    unreadable(tmp_path / "scan.zarr", "link")
    np.save(tmp_path / "two\nlines.npy", np.zeros((2, 2, 2)))
    unreadable(tmp_path / "two\nlines.npy", r"two\\nlines.npy")
    np.save(tmp_path / "a::b.npy", VALUES)
    assert np.array_equal(load(tmp_path / "a::b.npy").values, VALUES)
    for name in ("::", "::a", f"{tmp_path}/none.h5::a::b", "nul\0.nii"):
        with pytest.raises((ScanError, FileNotFoundError), match=r"^[^\n]*$"):
            load(name)
