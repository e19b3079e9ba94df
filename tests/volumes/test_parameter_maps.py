"""Parameters that vary in space, from files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from curvafit.volumes import Volume, save
from curvafit.volumes.read import map_shape, read_maps

RAMP = np.linspace(1, 2, 4 * 5 * 6).reshape(4, 5, 6)


def test_an_npz_and_a_folder_say_the_same(tmp_path: Path) -> None:
    np.savez(tmp_path / "maps.npz", a20=RAMP, mass=-RAMP / 4)
    folder = tmp_path / "maps"
    save(Volume(RAMP, (1, 2, 3), "mm"), folder / "a20.nii.gz")
    save(Volume(-RAMP / 4), folder / "mass.zarr")
    (folder / "README.md").write_text("what these are")
    for path in (tmp_path / "maps.npz", folder):
        maps = read_maps(path)
        assert sorted(maps) == ["a20", "mass"] and map_shape(maps) == (4, 5, 6)
        assert torch.equal(maps["a20"], torch.from_numpy(RAMP.astype(np.float32)))
        assert torch.equal(maps["mass"], torch.from_numpy((-RAMP / 4).astype(np.float32)))


def test_one_number_holds_everywhere_and_a_folder_may_hold_constants(tmp_path: Path) -> None:
    np.savez(tmp_path / "maps.npz", a11=-3, epsilon=np.array([0.02]))
    maps = read_maps(tmp_path / "maps.npz", (9, 9, 9))
    assert maps == {"a11": -3.0, "epsilon": 0.02} and map_shape(maps) is None
    folder = tmp_path / "maps"
    save(np.full((4, 5, 6), 2.0), folder / "a20.npy")
    save(np.full((1, 1, 1), -0.5), folder / "mass.npy")
    maps = read_maps(folder)
    assert map_shape(maps) == (4, 5, 6) and bool((maps["a20"] == 2).all()) and maps["mass"] == -0.5


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
    for first, second in (("a20.npy", "other.npy"), ("a20.npy", "a20.NPY")):
        save(Volume(RAMP), tmp_path / second / first)
        (tmp_path / second / second).write_bytes((tmp_path / second / first).read_bytes())
    for name, word in (("text.npz", "NPZ"), ("one.npy", "NPZ"), ("other.npy", "other"), ("a20.NPY", "two")):
        with pytest.raises(ValueError, match=word):
            read_maps(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="maps"):
        read_maps(tmp_path / "maps.npz")
