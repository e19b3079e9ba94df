"""Microscopes' own files, by the extra that reads them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from disk import unreadable

from curvafit.volumes import load


def test_a_czi_has_its_channels_and_lengths(tmp_path: Path) -> None:
    czi = pytest.importorskip("pylibCZIrw.czi", reason="needs curvafit[microscopes]")
    values = np.random.default_rng(0).integers(0, 4000, (5, 6, 7)).astype(np.uint16)
    with czi.create_czi(str(tmp_path / "a.czi")) as file:
        for channel in range(2):
            for z, plane in enumerate(values):
                file.write(data=(plane + channel)[..., None], plane={"Z": z, "C": channel, "T": 0})
        file.write_metadata("a", scale_x=0.5e-6, scale_y=0.25e-6, scale_z=2e-6)
    field = load(tmp_path / "a.czi", channel=1)
    assert np.array_equal(field.values, values + 1) and field.dtype == np.uint16
    assert field.spacing == pytest.approx((2, 0.25, 0.5)) and field.unit == "um"
    part = load(tmp_path / "a.czi", channel=0, lazy=True)
    assert part.in_file and np.array_equal(part.read((slice(1, 3),) * 3), values[1:3, 1:3, 1:3])
    unreadable(tmp_path / "a.czi", "2 channels")
    (tmp_path / "a.czi").write_bytes((tmp_path / "a.czi").read_bytes()[:300])
    unreadable(tmp_path / "a.czi", "a.czi", channel=1)


def test_without_its_library_a_file_names_the_line_to_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix, module in (("czi", "bioio_czi"), ("lif", "bioio_lif"), ("nd2", "bioio_nd2")):
        monkeypatch.setitem(sys.modules, module, None)
        (tmp_path / f"a.{suffix}").write_bytes(b"none")
        with pytest.raises(ImportError, match=r"curvafit\[microscopes\]"):
            load(tmp_path / f"a.{suffix}")
