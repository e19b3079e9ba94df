"""Parameters that vary in space, from files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from curvafit.volumes.read import map_shape, read_maps

RAMP = np.linspace(1, 2, 4 * 5 * 6).reshape(4, 5, 6)


def test_an_npz_holds_maps_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "maps.npz", a20=RAMP, mass=-RAMP / 4, theta_z=RAMP, mu=3)
    maps = read_maps(tmp_path / "maps.npz")
    assert sorted(maps) == ["a20", "mass", "mu", "theta_z"] and map_shape(maps) == (4, 5, 6)
    assert torch.equal(maps["a20"], torch.from_numpy(RAMP.astype(np.float32)))
    assert torch.equal(maps["mass"], torch.from_numpy((-RAMP / 4).astype(np.float32)))


def test_one_number_holds_everywhere(tmp_path: Path) -> None:
    np.savez(tmp_path / "maps.npz", a11=-3, mass=np.array([0.02]))
    maps = read_maps(tmp_path / "maps.npz", (9, 9, 9))
    assert maps == {"a11": -3.0, "mass": 0.02} and map_shape(maps) is None


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({}, "none"), ({"a21": RAMP, "a20": RAMP}, "a21"), ({"a20": RAMP, "a02": RAMP[:3]}, "shape"),
        ({"a20": RAMP[0]}, "shape"), ({"a20": np.where(RAMP > 1.5, np.nan, RAMP)}, "finite"),
        ({"a20": RAMP * 1e39}, "finite"), ({"a20": RAMP * 1j}, "finite"),
    ],
)  # fmt: skip
def test_maps_that_do_not_fit_are_refused(tmp_path: Path, arrays: dict[str, np.ndarray], said: str) -> None:
    np.savez(tmp_path / "maps.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        read_maps(tmp_path / "maps.npz")


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("a20 = 1")
    np.save(tmp_path / "one.npy", RAMP)
    for name in ("text.npz", "one.npy", ""):
        with pytest.raises(ValueError, match="NPZ"):
            read_maps(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="maps"):
        read_maps(tmp_path / "maps.npz")
