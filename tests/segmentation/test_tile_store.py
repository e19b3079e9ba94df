"""Tiles that are kept: a killed run goes on to the same bytes, another run is refused, files are read by box."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from filelock import FileLock

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation import Segmentation, reconstruct, segment
from curvafit.volumes import ScanError, load, save
from curvafit.volumes.boxes import boxes_of, check_finite, subsample
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def scan(shape: tuple[int, int, int] = (66, 12, 14)) -> np.ndarray:
    """A tube along z, in noise."""
    z, y, x = (np.arange(n) for n in shape)
    mask = np.hypot(y[:, None] - 5.3 + np.sin(z / 5)[:, None, None], x - 6.6) < 4
    return (100 * mask + 30 * np.random.default_rng(0).standard_normal(shape)).astype(np.float32)


def found(source: Any, store: Path | None = None, **more: Any) -> Segmentation:
    return segment(source, WILLMORE, **{"weight": 1.0, "steps": 5, "tile": 14, "store": store, **more})


def same(one: Segmentation, other: Segmentation) -> bool:
    arrays = ((one.mask, other.mask), (one.phase, other.phase))
    return one.status == other.status and all(a.values.tobytes() == b.values.tobytes() for a, b in arrays)


def killed_after(count: int, store: Path) -> Callable[[str, float], None]:
    """A progress that ends the run once so many tiles are finished."""

    def progress(text: str, share: float) -> None:
        if (store / f"{count - 1:06d}.json").exists():
            raise KeyboardInterrupt

    return progress


class Threads:
    """Two workers, as dask's: functions travel pickled in the real ones."""

    places = 3

    def __init__(self) -> None:
        self._pool, self._asked = ThreadPoolExecutor(2), list[Future]()
        self.numbers: list[int] = []

    def submit(self, make: Callable[[Path, Sequence[int]], list[Any]], path: Path, indices: Sequence[int]) -> None:
        self.numbers.extend(indices)
        self._asked.append(self._pool.submit(make, path, indices))

    def collect(self) -> list[Any]:
        return self._asked.pop(-1).result()  # the last first: the order must not matter


# ---- kept tiles ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("finished", [1, 3, 5])
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path, finished: int) -> None:
    whole, store = found(scan()), tmp_path / "new" / "tiles"
    with pytest.raises(KeyboardInterrupt):
        found(scan(), store, progress=killed_after(finished, store))
    notes = sorted(path.name for path in store.glob("0*.json"))
    assert notes == [f"{k:06d}.json" for k in range(finished)]
    before = {name: (store / name).stat().st_mtime_ns for name in notes}
    again = found(scan(), store)
    assert same(again, whole)
    assert before == {name: (store / name).stat().st_mtime_ns for name in notes}  # not made again
    assert same(found(scan(), store), whole)  # and once more, with all of them


def test_known_slices_stay_exact_after_a_kill(tmp_path: Path) -> None:
    truth = scan() > 50
    options = {"every": 6, "stiffness": 1e7, "steps": 5, "tile": 14, "store": tmp_path / "tiles"}
    with pytest.raises(KeyboardInterrupt):
        reconstruct(truth, WILLMORE, progress=killed_after(2, tmp_path / "tiles"), **options)
    made = reconstruct(truth, WILLMORE, **options)
    assert np.array_equal(made.mask.values[::6], truth[::6])
    with pytest.raises(ValueError, match="slices"):
        reconstruct(~truth, WILLMORE, **options)


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ({"weight": 2.0}, "nats"),
        ({"steps": 6}, "steps"),
        ({"tile": 20}, "tiles"),
        ({"epsilon": 2.5}, "place"),
        ({"threshold": 40.0}, "evidence"),
    ],
)
def test_tiles_of_another_run_are_refused(tmp_path: Path, more: dict, word: str) -> None:
    store = tmp_path / "tiles"
    with pytest.raises(KeyboardInterrupt):
        found(scan(), store, progress=killed_after(1, store))
    with pytest.raises(ValueError, match=word):
        found(scan(), store, **more)
    with pytest.raises(ValueError, match="evidence"):
        found(scan()[::-1].copy(), store)


def test_a_store_is_no_other_folder_and_no_one_else_s(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    (tmp_path / "file").write_text("keep")
    for name in ("mine", "file"):
        with pytest.raises(ValueError, match="new folder"):
            found(scan(), tmp_path / name)
    assert (tmp_path / "mine" / "notes.txt").read_text() == (tmp_path / "file").read_text() == "keep"
    (tmp_path / "tiles").mkdir()
    with (
        FileLock(tmp_path / "tiles" / "lock"),
        pytest.raises(ValueError, match="in use"),
    ):
        found(scan(), tmp_path / "tiles")


def test_a_run_killed_while_it_made_its_arrays_starts_anew(tmp_path: Path) -> None:
    (tmp_path / "tiles").mkdir()
    (tmp_path / "tiles" / "mask.npy").write_bytes(b"half")
    assert same(found(scan(), tmp_path / "tiles"), found(scan()))
    assert json.loads((tmp_path / "tiles" / "run.json").read_text())["nats"] == "1.0"


def test_workers_lower_the_same_tiles(tmp_path: Path) -> None:
    for store in (None, tmp_path / "tiles"):
        workers = Threads()
        assert same(found(scan(), store, workers=workers), found(scan()))
        assert workers.numbers == [0, 1, 2, 3, 4]


# ---- files that are read by box --------------------------------------------------------------------------------------


def stored(folder: Path) -> dict[str, tuple[Path, dict]]:
    values = scan()
    paths = {
        suffix: save(Field(values, (0.1, 0.1, 0.1), "mm"), folder / f"scan.{suffix}")
        for suffix in ("npy", "nii", "zarr", "tif")
    }
    (folder / "scan.raw").write_bytes(values.tobytes())
    with h5py.File(folder / "scan.h5", "w") as file:
        file["raw"] = values
    named = {name: (path, {}) for name, path in paths.items()}
    raw = {"raw_shape": values.shape, "dtype": "f4"}
    return {**named, "raw": (folder / "scan.raw", raw), "h5": (folder / "scan.h5", {"key": "raw"})}


def test_files_are_segmented_as_arrays_are(tmp_path: Path) -> None:
    whole = found(scan())
    for path, reading in stored(tmp_path).values():
        place = {"spacing": 1.0, "unit": "voxel", **reading}
        made, loaded = found(path, **place), load(path, **place)
        assert made.mask.values.tobytes() == whole.mask.values.tobytes(), path
        assert made.mask.spacing == loaded.spacing and made.mask.source == loaded.source
        assert set(loaded.notes) <= set(made.notes)


def test_boxes_of_a_file_are_those_of_the_loaded_volume(tmp_path: Path) -> None:
    box, crop = (slice(3, 9), slice(0, 4), slice(7, 8)), "5:60,1:,:-2"
    for path, reading in stored(tmp_path).values():
        for options in (reading, {**reading, "crop": crop}):
            loaded, boxes = load(path, **options), boxes_of(path, **options)
            np.testing.assert_array_equal(boxes.part(box), loaded.values[box])
            frame = boxes.frame
            assert (frame.shape, frame.spacing, frame.unit) == (loaded.shape, loaded.spacing, loaded.unit)
            assert frame.notes == loaded.notes and frame.values.dtype == loaded.values.dtype
            assert (frame.affine is None) == (loaded.affine is None)
            if frame.affine is not None and loaded.affine is not None:
                np.testing.assert_allclose(frame.affine, loaded.affine)
            check_finite(boxes)
            assert boxes_of(boxes) is boxes


def test_a_file_is_mapped_rather_than_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The boxes of an NPY file do not load it."""
    path = save(Field(scan()), tmp_path / "scan.npy")
    monkeypatch.setattr("curvafit.volumes.boxes.field_of", lambda *_, **__: pytest.fail("the whole was read"))
    boxes = boxes_of(path)
    assert boxes.frame.values.strides == (0, 0, 0) and boxes.part((slice(0, 2),) * 3).shape == (2, 2, 2)


def test_a_changed_file_has_another_digest(tmp_path: Path) -> None:
    for path, reading in stored(tmp_path).values():
        before = boxes_of(path, **reading).digest
        assert boxes_of(path, **reading).digest == before
        assert boxes_of(path, **reading, crop="1:,:,:").digest != before
        if path.is_file():
            os.utime(path, ns=(0, 10**18))
            assert path.suffix == ".tif" or boxes_of(path, **reading).digest != before
    one, other = (boxes_of(values).digest for values in (scan(), scan()[::-1]))
    assert one != other and one == boxes_of(scan()).digest


def test_values_that_are_not_finite_are_refused_wherever_they_are(tmp_path: Path) -> None:
    values = scan()
    values[60, 3, 4:6] = np.nan, np.inf
    np.save(tmp_path / "scan.npy", values)
    with pytest.raises(ScanError, match="finite"):
        found(tmp_path / "scan.npy")


def test_a_sample_of_a_long_volume_has_runs_of_neighbours() -> None:
    values = np.arange(1000)[:, None, None] * np.ones((1, 5, 6))
    sample, blocks = subsample(boxes_of(values))
    assert sample.shape == (256, 5, 6) and len(blocks) == 4
    for block, start in zip(blocks, (93, 343, 593, 843), strict=True):
        np.testing.assert_array_equal(sample.values[block][:, 0, 0], np.arange(start, start + 64))
    whole, (block,) = subsample(boxes_of(values[:256]))
    assert np.array_equal(whole.values, values[:256]) and whole.values[block].shape == (256, 5, 6)
