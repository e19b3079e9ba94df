"""`segment` and `reconstruct` in tiles: what a kill leaves, what the same command makes of it, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, done, refused

from curvafit.segmentation.tiles import TileStore
from curvafit.volumes import load, save
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A tube along z in noise, as a Zarr store."""
    z, y, x = (np.arange(n) for n in (66, 12, 14))
    mask = np.hypot(y[:, None] - 5.3 + np.sin(z / 5)[:, None, None], x - 6.6) < 4
    values = 100 * mask + 30 * np.random.default_rng(0).standard_normal(mask.shape)
    return save(Field(values.astype(np.float32), (0.1, 0.1, 0.1), "mm"), tmp_path / "scan.zarr")


def command(scan: Path, target: Path, *more: object) -> tuple:
    return ("segment", scan, "--prior", "tubes", "--weight", 1, "--steps", 5, "--tile", 14, "-o", target, *more)


def killed(monkeypatch: pytest.MonkeyPatch, tile: int) -> None:
    """A run that is interrupted at a tile."""
    write = TileStore.write

    def stop(store: TileStore, core, piece) -> None:
        if piece.number == tile:
            raise KeyboardInterrupt
        write(store, core, piece)

    monkeypatch.setattr(TileStore, "write", stop)


@pytest.mark.parametrize(
    "name",
    [
        "mask.npy",
        pytest.param("mask.zarr", marks=pytest.mark.slow),
        pytest.param("mask.nii.gz", marks=pytest.mark.slow),
    ],
)
def test_the_same_command_goes_on_after_a_kill(scan: Path, tmp_path: Path, monkeypatch, name: str) -> None:
    whole, target = tmp_path / "whole" / name, tmp_path / "killed" / name
    done(*command(scan, whole))
    with monkeypatch.context() as patch:
        killed(patch, 2)
        result = call(*command(scan, target))
    assert result.exit_code == 130 and "same command" in result.stderr
    assert [path.name for path in target.parent.iterdir()] == [f".{name}.curvafit-tiles"]
    refused(call(*command(scan, target, "--epsilon", 0.25)), "tiles")
    result = done(*command(scan, target))
    stem = name.split(".")[0]
    assert sorted(path.name for path in target.parent.iterdir()) == sorted([name, f"{stem}.json", f"{stem}.png"])
    one, other = load(whole), load(target)
    assert one.values.tobytes() == other.values.tobytes() and one.spacing == other.spacing
    assert json.loads((target.parent / f"{stem}.json").read_text())["tile"] == 14


def test_slices_are_filled_in_tiles(scan: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels.npy"
    np.save(labels, load(scan).values > 50)
    options = ("--every", 6, "--prior", "tubes", "--stiffness", 1e7, "--steps", 5, "--tile", 14)
    done("reconstruct", labels, *options, "-o", tmp_path / "volume.npy")
    assert np.array_equal(np.load(tmp_path / "volume.npy")[::6] > 0, np.load(labels)[::6])
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_worker_processes_make_the_same_mask(scan: Path, tmp_path: Path) -> None:
    masks = []
    for name, more in (("one", ()), ("two", ("--workers", 2))):
        done(*command(scan, tmp_path / name / "mask.npy", *more))
        masks.append(np.load(tmp_path / name / "mask.npy"))
    assert (masks[0] != masks[1]).mean() < 1e-3  # other processes may add up otherwise
