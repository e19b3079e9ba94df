"""Imaris files, by their published layout: chunks that reach beyond the image, attributes of single characters."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from curvafit.volumes import ScanError, load

VALUES = np.random.default_rng(0).integers(1, 60000, (2, 5, 6, 7)).astype(np.uint16)


def characters(text: object) -> np.ndarray:
    return np.frombuffer(str(text).encode(), "S1")


def write(path: Path, channels: int) -> None:
    with h5py.File(path, "w") as file:
        for c in range(channels):
            group = file.create_group(f"DataSet/ResolutionLevel 0/TimePoint 0/Channel {c}")
            stored = np.pad(VALUES[c], [(0, 3), (0, 2), (0, 1)])
            group.create_dataset("Data", data=stored, chunks=(4, 4, 4), compression="gzip")
            group.create_dataset("Histogram", data=np.zeros(256, np.uint64))
            for axis, n in zip("ZYX", VALUES.shape[1:], strict=True):
                group.attrs[f"ImageSize{axis}"] = characters(n)
            file.create_dataset(f"DataSet/ResolutionLevel 1/TimePoint 0/Channel {c}/Data", data=stored[::2, ::2, ::2])
        image = file.create_group("DataSetInfo/Image")
        image.attrs["Unit"] = "um"  # other programs write a plain string
        for k, (n, edge) in enumerate(zip(VALUES.shape[:0:-1], (0.1, 0.2, 0.3), strict=True)):
            image.attrs[f"ExtMin{k}"], image.attrs[f"ExtMax{k}"] = characters(5.5), characters(5.5 + n * edge)


def test_voxels_and_edges_are_the_image_s(tmp_path: Path) -> None:
    write(tmp_path / "one.ims", 1)
    write(tmp_path / "two.ims", 2)
    one, two = load(tmp_path / "one.ims"), load(tmp_path / "two.ims", key="TimePoint 0/Channel 1")
    for field, values in ((one, VALUES[0]), (two, VALUES[1])):
        assert np.array_equal(field.values, values) and field.unit == "um"
        assert field.spacing == pytest.approx((0.3, 0.2, 0.1))
    part = load(tmp_path / "one.ims", crop="1:-1,2:,:4")
    assert np.array_equal(part.values, VALUES[0, 1:-1, 2:, :4])
    with pytest.raises(ScanError, match="Channel 1"):
        load(tmp_path / "two.ims")


def test_a_file_that_is_not_imaris_s_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.ims"
    with h5py.File(path, "w") as file:
        file["raw"] = VALUES[0]
    with pytest.raises(ScanError, match="no arrays"):
        load(path)
    write(path, 1)
    with h5py.File(path, "r+") as file:
        file["DataSet/ResolutionLevel 0/TimePoint 0/Channel 0"].attrs["ImageSizeX"] = characters(900)
    with pytest.raises(ScanError, match="900"):
        load(path)
    write(path, 1)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ScanError, match=r"^[^\n]*$"):
        load(path)
