"""Tiles with overlap hold each voxel once and do not show; a killed run goes on; files are read by box."""

import itertools
import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import h5py
import numpy as np
import pytest
from calling import call, done, refused
from filelock import FileLock

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation import Segmentation, reconstruct, segment, tiles
from curvafit.segmentation.evidence import subsample
from curvafit.segmentation.flow import HALO, Working, WorkingGrid
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.tiles import EDGE, OVERLAP, WHOLE, cut_tiles, surround
from curvafit.volumes import ScanError, load, save
from curvafit.volumes.volume import Volume
from tests.options import grouped

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def frame(shape: tuple[int, int, int], spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Volume:
    return Volume(np.broadcast_to(np.float32(0), shape), spacing)


def beads(length: int = 100) -> np.ndarray:
    """A tube along z whose radius swings from 4 to 8."""
    z, y, x = np.mgrid[:length, :20, :22]
    return np.hypot(y - 9.3, x - 10.6) < 6 + 2 * np.sin(z / 7)


def grey(mask: np.ndarray, noise: float = 40) -> Volume:
    return Volume(100.0 * mask + noise * np.random.default_rng(0).standard_normal(mask.shape))


@pytest.mark.parametrize(
    ("shape", "spacing", "edge"),
    [
        ((75, 40, 9), (1, 1, 1), 24), ((27, 5, 101), (2.5, 1, 1), 24), ((4, 4, 4), (1, 1, 1), 8),
        ((99, 1_000, 4), (1, 1, 3), 96),
    ],
)  # fmt: skip
def test_tiles_hold_each_voxel_once(shape, spacing, edge: int) -> None:
    place = WorkingGrid.of(frame(shape, spacing), None, halo=HALO)
    tiles, count = cut_tiles(place, shape, edge), np.zeros(shape, dtype=np.uint8)
    for tile in tiles:
        count[tile] += 1
        assert all((c.stop - c.start) * n <= max(edge, n) for c, n in zip(tile, place.times, strict=True))
        box, own = surround(tile, place, shape)
        assert own.grid.shape == tuple(
            (edge.stop - edge.start) * n + own.halo * sum(ends)
            for edge, n, ends in zip(box, place.times, own.ends, strict=True)
        )
        for axis, (before, beyond) in enumerate(own.ends):
            core, whole, n = tile[axis], box[axis], place.times[axis]
            assert before == (whole.start == 0)
            assert before or (core.start - whole.start) * n >= OVERLAP
            assert beyond or (whole.stop - core.stop) * n >= OVERLAP
    assert count.min() == count.max() == 1
    for axis in range(3):
        sizes = {tile[axis].stop - tile[axis].start for tile in tiles}
        assert max(sizes) - min(sizes) <= 1


def test_a_tile_s_grid_has_the_halo_where_the_volume_ends() -> None:
    shape = (75, 40, 9)
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    place = WorkingGrid.of(frame(shape, (1.0, 1.0, 2.0)), None, halo=HALO)
    whole = place.to_grid(values)
    for tile in cut_tiles(place, shape, 40):
        box, own = surround(tile, place, shape)
        part = own.to_grid(values[box])
        assert tuple(part.shape) == own.grid.shape
        np.testing.assert_allclose(own.to_scan(part), place.to_scan(whole)[box], atol=1e-6)
        np.testing.assert_array_equal(own.to_scan(own.spread(values[box])), place.to_scan(place.spread(values))[box])


def test_large_volumes_have_tiles() -> None:
    edge = round(WHOLE ** (1 / 3)) - 12

    def cut(*shape: int) -> tuple[WorkingGrid, list]:
        place = WorkingGrid.of(frame(shape), None, halo=HALO)  # type: ignore[arg-type]
        return place, cut_tiles(place, shape)

    assert len(cut(edge, edge, edge)[1]) == 1
    shape = (512, 500, edge + 1)
    place, tiles = cut(*shape)
    assert [len({tile[axis].start for tile in tiles}) for axis in range(3)] == [3, 3, 2]
    sizes = [np.prod(surround(tile, place, shape)[1].grid.shape) for tile in tiles]
    assert max(sizes) <= (EDGE + 2 * OVERLAP) ** 3
    with pytest.raises(ValueError, match="tile"):
        reconstruct(beads(), every=8, working=Working(tile=7))


def test_a_box_has_the_known_slices_of_the_whole() -> None:
    mask = beads(40)
    slices = Slices(mask[3::8], tuple(range(3, 40, 8)), 40, (1.0, 1.0, 1.0))
    rows, inside = slices.known((slice(5, 30), slice(2, 11), slice(0, 22)))
    assert rows == [6, 14, 22] and np.array_equal(inside, mask[[11, 19, 27]][:, 2:11])
    assert slices.known((slice(20, 26), slice(0, 3), slice(20, 30)))[0] == []


def close(one, other) -> None:
    """A cut `OVERLAP` voxels away moves u by less than .03 (measured: .002 to .02, on shapes of 88³ cut on all sides).

    Only voxels whose |u| is less may change sides; u falls by .35 a voxel at the surface.
    """
    moved = np.abs(one.phase.values - other.phase.values)
    assert moved.max() < 0.03
    assert np.abs(one.phase.values[one.mask.values != other.mask.values]).max(initial=0) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("law", [WILLMORE, Coefficients(1, 2, 1, -20, -20, 100)])
def test_the_tiles_do_not_show_between_slices(law: Coefficients) -> None:
    truth = beads()
    options = {"every": 8, "stiffness": 1e7, "steps": 50}
    whole = reconstruct(truth, law, **grouped(**options))
    same = reconstruct(truth, law, **grouped(tile=200, **options))
    assert np.array_equal(whole.phase.values, same.phase.values) and same.status == whole.status
    for tile in (26, 34):
        found = reconstruct(truth, law, **grouped(tile=tile, **options))
        assert np.array_equal(found.mask.values[::8], truth[::8])
        close(found, whole)
        assert found.status.split(":")[0] == whole.status.split(":")[0]


@pytest.mark.slow
def test_the_tiles_do_not_show_along_another_axis() -> None:
    truth = np.moveaxis(beads(88), 0, 2)  # two turns of the swing
    options = {"every": 8, "stiffness": 1e7, "steps": 50, "axis": 2}
    whole, found = (reconstruct(truth, WILLMORE, **grouped(tile=tile, **options)) for tile in (None, 30))
    assert np.array_equal(found.mask.values[..., ::8], truth[..., ::8])
    close(found, whole)


def test_the_tiles_do_not_show_in_a_scan() -> None:
    scan = grey(beads())
    whole, found = (segment(scan, WILLMORE, weight=1.0, working=Working(steps=50, tile=tile)) for tile in (None, 34))
    close(found, whole)
    assert found.notes == whole.notes


def test_a_tile_of_background_alone_stays_empty() -> None:
    mask = np.zeros((120, 16, 16), dtype=bool)
    mask[4:20, 4:12, 4:12] = True
    likely = Volume(np.where(mask, 0.9, 0.1).astype(np.float32))
    options = grouped(probabilities=True, weight=1.0, steps=50, tile=24)
    result = segment(likely, WILLMORE, **options)
    assert result.mask.values[:20].any() and not result.mask.values[30:].any()
    for value in (0.1, 0.9):
        plain = segment(Volume(np.full_like(likely.values, value)), WILLMORE, **options)
        assert (plain.mask.values == (value > 0.5)).all()


def scan(shape: tuple[int, int, int] = (66, 12, 14)) -> np.ndarray:
    """A tube along z, in noise."""
    z, y, x = (np.arange(n) for n in shape)
    mask = np.hypot(y[:, None] - 5.3 + np.sin(z / 5)[:, None, None], x - 6.6) < 4
    return (100 * mask + 30 * np.random.default_rng(0).standard_normal(shape)).astype(np.float32)


def found(source: Any, store: Path | None = None, **more: Any) -> Segmentation:
    return segment(source, WILLMORE, **grouped(**{"weight": 1.0, "steps": 5, "tile": 14, "store": store, **more}))


def same(one: Segmentation, other: Segmentation) -> bool:
    arrays = ((one.mask, other.mask), (one.phase, other.phase))
    return one.status == other.status and all(a.values.tobytes() == b.values.tobytes() for a, b in arrays)


def killed_after(count: int, store: Path) -> Callable[[str, float], None]:
    """A progress that ends the run once so many tiles are finished."""

    def progress(text: str, share: float) -> None:
        if (store / f"lowering-the-energy-{count - 1:06d}.npz").exists():
            raise KeyboardInterrupt

    return progress


class Threads:
    """Two workers, as dask's: functions travel pickled in the real ones."""

    places = 3

    def __init__(self) -> None:
        self._pool, self._asked = ThreadPoolExecutor(2), list[Future]()
        self.numbers: list[int] = []

    def submit(self, function: Callable[[int], Any], number: int) -> None:
        self.numbers.append(number)
        self._asked.append(self._pool.submit(function, number))

    def collect(self) -> Any:
        return self._asked.pop(-1).result()  # the last first: the order must not matter


def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    whole, store = found(scan()), tmp_path / "new" / "tiles"
    with pytest.raises(KeyboardInterrupt):
        found(scan(), store, progress=killed_after(3, store))
    notes = sorted(path.name for path in store.glob("*.npz"))
    assert notes == [f"lowering-the-energy-{k:06d}.npz" for k in range(3)]
    before = {name: (store / name).stat().st_mtime_ns for name in notes}
    again = found(scan(), store)
    assert same(again, whole)
    assert before == {name: (store / name).stat().st_mtime_ns for name in notes}  # not made again
    assert same(found(scan(), store), whole)  # and once more, with all of them


@pytest.mark.parametrize(
    "name", ["mask.tif", *(pytest.param(f"mask.{suffix}", marks=pytest.mark.slow) for suffix in ("zarr", "nii.gz"))]
)
def test_the_same_command_goes_on_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """One, two or no worker processes: other processes may add up otherwise."""
    source = save(Volume(scan(), (0.1, 0.1, 0.1), "mm"), tmp_path / "scan.zarr")
    options = ("segment", source, "--prior", "tubes", "--weight", 1, "--steps", 5, "--tile", 14)
    whole, target, lower = tmp_path / "whole" / name, tmp_path / "killed" / name, tiles.lower_energy
    done(*options, "-o", whole, "--workers", 0)

    made = itertools.count()

    def stop(*arguments: Any) -> Any:
        if next(made) == 2:
            raise KeyboardInterrupt
        return lower(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(tiles, "lower_energy", stop)
        result = call(*options, "-o", target)
    assert result.exit_code == 130 and "same command" in result.stderr
    assert [path.name for path in target.parent.iterdir()] == [f".{name}.curvafit-tiles"]
    refused(call(*options, "-o", target, "--epsilon", 0.25), "tiles")
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install" in call(*options, "-o", target, "--workers", 2).stderr
    monkeypatch.undo()
    more = ("--workers", 2) if name.endswith("gz") else ()
    done(*options, "-o", target, *more)
    assert sorted(path.suffix for path in target.parent.iterdir()) == sorted([".json", ".png", target.suffix])
    one, other = load(whole), load(target)
    assert (one.values != other.values).mean() <= (1e-3 if more else 0) and one.spacing == other.spacing
    assert json.loads((target.parent / "mask.json").read_text())["tile"] == 14


def test_known_slices_stay_exact_after_a_kill(tmp_path: Path) -> None:
    truth = scan() > 50
    options = grouped(every=6, stiffness=1e7, steps=5, tile=14, store=tmp_path / "tiles")
    with pytest.raises(KeyboardInterrupt):
        reconstruct(truth, WILLMORE, progress=killed_after(2, tmp_path / "tiles"), **options)
    made = reconstruct(truth, WILLMORE, **options)
    assert np.array_equal(made.mask.values[::6], truth[::6])
    with pytest.raises(ValueError, match="slices"):
        reconstruct(~truth, WILLMORE, **options)


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ({"weight": 2.0}, "nats"), ({"steps": 6}, "steps"), ({"tile": 20}, "tiles"), ({"epsilon": 2.5}, "place"),
        ({"threshold": 40.0}, "evidence"),
    ],
)  # fmt: skip
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
    (tmp_path / "tiles" / ".0a1b2c3d.run.json").write_text("{")  # a run was killed while it said whose it is
    assert same(found(scan(), tmp_path / "tiles"), found(scan()))
    with FileLock(tmp_path / "tiles" / "lock"), pytest.raises(ValueError, match="in use"):
        found(scan(), tmp_path / "tiles")


def test_a_run_killed_while_it_made_its_arrays_starts_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "tiles"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(np.lib.format, "open_memmap", MagicMock(side_effect=KeyboardInterrupt))
        found(scan(), store)
    assert json.loads((store / "run.json").read_text())["nats"] == "1.0"
    (store / "mask.npy.new").write_bytes(b"half")
    assert same(found(scan(), store), found(scan()))


def test_workers_lower_the_same_tiles(tmp_path: Path) -> None:
    for store in (None, tmp_path / "tiles"):
        workers = Threads()
        assert same(found(scan(), store, workers=workers), found(scan()))
        assert workers.numbers == [0, 1, 2, 3, 4]


def stored(folder: Path) -> list[tuple[Path, dict]]:
    values = scan()
    files = [
        (save(Volume(values, 0.1, "mm"), folder / f"scan.{suffix}"), {}) for suffix in ("npy", "nii", "zarr", "tif")
    ]
    (folder / "scan.raw").write_bytes(values.tobytes())
    with h5py.File(folder / "scan.h5", "w") as file:
        file["raw"] = values
    raw = {"raw_shape": values.shape, "dtype": "f4"}
    return [*files, (folder / "scan.raw", raw), (folder / "scan.h5", {"key": "raw"})]


def test_boxes_of_a_file_are_those_of_the_loaded_volume(tmp_path: Path) -> None:
    box, crop, whole = (slice(3, 9), slice(0, 4), slice(7, 8)), "5:60,1:,:-2", found(scan())
    for path, reading in stored(tmp_path):
        made = found(path, **{"spacing": 1.0, "unit": "voxel", **reading})
        assert (
            made.mask.values.tobytes() == whole.mask.values.tobytes()
            and made.mask.source == load(path, **reading).source
        )
        for options in (reading, {**reading, "crop": crop}):
            loaded, boxes = load(path, **options), load(path, **options, lazy=True)
            np.testing.assert_array_equal(boxes.read(box), loaded.values[box])
            assert (boxes.shape, boxes.spacing, boxes.unit) == (loaded.shape, loaded.spacing, loaded.unit)
            assert boxes.notes == loaded.notes and boxes.dtype == loaded.dtype
            assert (boxes.affine is None) == (loaded.affine is None)
            if boxes.affine is not None and loaded.affine is not None:
                np.testing.assert_allclose(boxes.affine, loaded.affine)
            assert load(boxes, lazy=True) is boxes


def test_a_file_is_mapped_rather_than_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The boxes of an NPY file do not load it."""
    path = save(Volume(scan()), tmp_path / "scan.npy")
    monkeypatch.setattr(Volume, "values", property(lambda _: pytest.fail("the whole was read")))
    boxes = load(path, lazy=True)
    assert boxes.in_file and boxes.read((slice(0, 2),) * 3).shape == (2, 2, 2)


def test_a_changed_file_has_another_digest(tmp_path: Path) -> None:
    for path, reading in stored(tmp_path):
        before = load(path, **reading, lazy=True).digest
        assert load(path, **reading, lazy=True).digest == before
        assert load(path, **reading, crop="1:,:,:", lazy=True).digest != before
        if path.is_file():
            os.utime(path, ns=(0, 10**18))
            assert path.suffix == ".tif" or load(path, **reading, lazy=True).digest != before
    one, other = (load(values, lazy=True).digest for values in (scan(), scan()[::-1]))
    assert one != other and one == load(scan(), lazy=True).digest


def test_values_that_are_not_finite_are_refused_wherever_they_are(tmp_path: Path) -> None:
    values = scan()
    values[60, 3, 4:6] = np.nan, np.inf
    np.save(tmp_path / "scan.npy", values)
    with pytest.raises(ScanError, match="finite"):
        found(tmp_path / "scan.npy")


def test_a_sample_of_a_long_volume_has_runs_of_neighbours() -> None:
    values = np.arange(1000)[:, None, None] * np.ones((1, 5, 6))
    sample, blocks = subsample(load(values, lazy=True))
    assert sample.shape == (256, 5, 6) and len(blocks) == 4
    for block, start in zip(blocks, (93, 343, 593, 843), strict=True):
        np.testing.assert_array_equal(sample.values[block][:, 0, 0], np.arange(start, start + 64))
    whole, (block,) = subsample(load(values[:256], lazy=True))
    assert np.array_equal(whole.values, values[:256]) and whole.values[block].shape == (256, 5, 6)
