"""A volume filled in blocks from a file is the volume filled whole, whatever the blocks; a killed run goes on."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from calling import call, done, refused
from shapes import grown

from curvafit.core.workers import cluster
from curvafit.segmentation.flow import Working
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.result import write_mask
from curvafit.volumes import Volume, load, save

#: Blocks of 64 leave a last one of 3 voxels along z, and of 5 along x.
SHAPE = (67, 40, 69)


def texture(shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    """A grown texture, repeated as far as a shape goes."""
    phase = grown("tubes", 48, 1).numpy()
    return (phase[np.ix_(*(np.arange(n) % 48 for n in shape))] > 0).astype(np.uint8)


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(Volume(texture(), (0.5, 0.5, 0.5), "um"), tmp_path_factory.mktemp("labels") / "labels.zarr")


@pytest.fixture(scope="module")
def whole(labels: Path) -> Path:
    """The volume filled whole, as files."""
    volume, target = load(labels), labels.with_name("whole.zarr")
    write_mask(reconstruct(volume, every=8), volume, target)
    return target


def files(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def levels(store: Path) -> dict[str, np.ndarray]:
    group: Any = zarr.open_group(store, mode="r")
    return {name: group[name][...] for name in group}


def check_alike(found: Path, whole: Path) -> None:
    """Float32 sums of convolutions in another order move a probability by some millionths, and a voxel that lies just
    there to the other side."""
    for name in ("", "_probability"):
        one, other = (each.with_name(f"{each.stem}{name}.zarr") for each in (found, whole))
        assert (one / "zarr.json").read_bytes() == (other / "zarr.json").read_bytes()
        for level, expected in levels(other).items():
            values = levels(one)[level]
            assert values.shape == expected.shape and values.dtype == expected.dtype
            assert np.abs(values.astype(np.float32) - expected).mean() < 1e-4
    notes = [json.loads(each.with_suffix(".json").read_text()) for each in (found, whole)]
    assert notes[0]["status"] == notes[1]["status"] and notes[0]["notes"] == notes[1]["notes"]
    for name in ("calibration_error", "suggestions", "epsilon", "shape", "spacing", "unit", "coefficients", "weight"):
        assert notes[0][name] == notes[1][name], name
    for name in ("expected_dice", "volume_fraction"):
        assert notes[0][name] == pytest.approx(notes[1][name], rel=1e-3), name


@pytest.mark.parametrize("edge", [64, *(pytest.param(edge, marks=pytest.mark.slow) for edge in (33, 96))])
def test_blocks_equal_the_whole(labels: Path, whole: Path, tmp_path: Path, edge: int) -> None:
    target = tmp_path / whole.name
    done("reconstruct", labels, "--every", 8, "--tile", edge, "-o", target)
    check_alike(target, whole)
    names = ["whole.json", "whole.png", "whole.zarr", "whole_probability.zarr"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert json.loads((tmp_path / "whole.json").read_text())["tile"] == edge


@pytest.mark.parametrize("axis", [1, 2])
def test_slices_across_any_axis(tmp_path: Path, axis: int) -> None:
    """Labelled slices are known where none are named; suggestions are those of the whole."""
    mask, shape = texture(), np.array(SHAPE)
    places = [0, 5, 14, 20, shape[axis] - 3]
    kept = np.zeros_like(mask)
    index = tuple(places if k == axis else slice(None) for k in range(3))
    kept[index] = mask[index]
    source, options = tmp_path / "labels.npy", {"axis": axis, "suggest": 2, "spacing": (1.5, 1.0, 0.8), "unit": "mm"}
    np.save(source, kept)
    volume = load(source, spacing=(1.5, 1.0, 0.8), unit="mm")
    write_mask(reconstruct(volume, axis=axis, suggest=2), volume, tmp_path / "whole.zarr")
    (tmp_path / "blocks").mkdir()
    found = reconstruct(source, working=Working(tile=40, store=tmp_path / "store"), **options)
    assert "annotate next" in found.status and found.mask.in_file
    write_mask(found, volume, tmp_path / "blocks" / "whole.zarr")
    check_alike(tmp_path / "blocks" / "whole.zarr", tmp_path / "whole.zarr")


def test_the_same_command_goes_on_after_a_kill(labels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def command(name: str) -> tuple:
        return ("reconstruct", labels, "--every", 8, "--tile", 64, "-o", tmp_path / name / "mask.zarr")

    done(*command("whole"))
    filled: list[int] = []

    room = sys.modules["curvafit.segmentation.reconstruction"]  # the package's name of the module is the function

    def stop(*job: Any, fill=room.fill_block) -> object:
        filled.append(job[-1])
        if len(filled) == 3:
            raise KeyboardInterrupt
        return fill(*job)

    monkeypatch.setattr(room, "fill_block", stop)
    result = call(*command("killed"))
    assert result.exit_code == 130 and "same command" in result.stderr
    assert [path.name for path in (tmp_path / "killed").iterdir()] == [".mask.zarr.curvafit-tiles"]
    refused(call(*command("killed"), "--axis", "y"), "tiles", progress=True)
    done(*command("killed"))
    assert filled[3:] == [2, 3]
    for name in ("mask.zarr", "mask_probability.zarr"):
        assert files(tmp_path / "killed" / name) == files(tmp_path / "whole" / name)
    assert len(list((tmp_path / "killed").iterdir())) == 4


@pytest.mark.slow
def test_workers_that_are_killed_lose_no_voxel(labels: Path, tmp_path: Path) -> None:
    """Each of two workers is killed once, while blocks are filled."""
    options: dict[str, Any] = {"every": 8}
    one = reconstruct(labels, **options, working=Working(tile=32, store=tmp_path / "one"))
    killed: list[int] = []
    with cluster(2) as crew:
        found: Any = crew._client.run(os.getpid)  # type: ignore[union-attr]
        pids = list(found.values())

        def kill(text: str, share: float) -> None:
            if "blocks" in text and len(killed) < 2 and share > 0.2 + 0.3 * len(killed):
                killed.append(pids[len(killed)])
                os.kill(killed[-1], signal.SIGKILL)

        two = reconstruct(
            labels, **options, working=Working(tile=32, store=tmp_path / "two", workers=crew), progress=kill
        )
    assert len(killed) == 2 and two.status == one.status
    assert one.probability is not None and two.probability is not None
    assert np.abs(two.probability.values - one.probability.values).max() < 1e-6
    assert (two.mask.values != one.mask.values).mean() < 1e-4


def test_what_is_mistyped_leaves_no_folder_that_refuses_what_is_right(labels: Path, tmp_path: Path) -> None:
    command = ("reconstruct", labels, "--tile", 64, "-o", tmp_path / "mask.zarr")
    for wrong, word in ((("--known", "0,8,99"), "99"), (("--every", 8, "--suggest", 400), "slices")):
        refused(call(*command, *wrong), word, progress=True)
        assert not list(tmp_path.iterdir())
    refused(call(*command, "--every", 8, "--label", 7), "label 7", progress=True)
    assert not list(tmp_path.iterdir())


def test_bad_input_ends_in_one_sentence_and_leaves_nothing(labels: Path, tmp_path: Path) -> None:
    values = texture()
    grey = np.random.default_rng(0).integers(0, 999, SHAPE).astype(np.int16)
    broken = values.astype(np.float32)
    broken[50, 3, 3] = np.nan
    for name, array in {"empty": 0 * values, "grey": grey, "nan": broken}.items():
        np.save(tmp_path / f"{name}.npy", array)
    save(Volume(values), tmp_path / "torn.zarr")
    chunk = tmp_path / "torn.zarr/0/c/1/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-9])
    there = sorted(path.name for path in tmp_path.iterdir())
    said = {"empty.npy": "inside and outside", "grey.npy": "labels", "nan.npy": "finite", "torn.zarr": "torn.zarr"}
    for source, target in (*((name, "mask.zarr") for name in said), ("torn.zarr", "torn.zarr")):
        words = ("reconstruct", tmp_path / source, "--every", 8, "--tile", 64, "-o", tmp_path / target)
        refused(call(*words), said[source], progress=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == there
