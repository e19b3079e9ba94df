"""Tiles with overlap: each voxel once, one tile is the whole, and the result does not depend on the tiles."""

from __future__ import annotations

import numpy as np
import pytest

from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation import reconstruct, segment
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.tiles import EDGE, OVERLAP, WHOLE, Tiling
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def frame(shape: tuple[int, int, int], spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Field:
    return Field(np.broadcast_to(np.float32(0), shape), spacing)


def beads(length: int = 100) -> np.ndarray:
    """A tube along z whose radius swings from 4 to 8."""
    z, y, x = np.mgrid[:length, :20, :22]
    return np.hypot(y - 9.3, x - 10.6) < 6 + 2 * np.sin(z / 7)


def grey(mask: np.ndarray, noise: float = 40) -> Field:
    return Field(100.0 * mask + noise * np.random.default_rng(0).standard_normal(mask.shape))


# ---- boxes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize(
    ("shape", "spacing", "edge"),
    [
        ((75, 40, 9), (1, 1, 1), 24),
        ((27, 5, 101), (2.5, 1, 1), 24),
        ((4, 4, 4), (1, 1, 1), 8),
        ((99, 1_000, 4), (1, 1, 3), 96),
    ],
)
def test_tiles_hold_each_voxel_once(shape, spacing, edge: int, periodic: bool) -> None:
    tiling = Tiling.of(frame(shape, spacing), None, edge, periodic=periodic)
    times, tiles, count = tiling.place.times, tiling.tiles, np.zeros(shape, dtype=np.uint8)
    assert [tile.number for tile in tiles] == list(range(tiling.count))
    for tile in tiles:
        count[tile.core] += 1
        assert all((c.stop - c.start) * n <= max(edge, n) for c, n in zip(tile.core, times, strict=True))
        box = np.empty(tile.shape)
        assert box[tile.inner].shape == count[tile.core].shape
        for axis, (before, beyond) in enumerate(tile.ends):
            core, whole = tile.core[axis], tile.box[axis]
            assert before == (whole.start == 0 and not periodic) or tiling.count == 1
            assert before or (core.start - whole.start) * times[axis] >= OVERLAP
            assert beyond or (whole.stop - core.stop) * times[axis] >= OVERLAP
    assert count.min() == count.max() == 1
    for axis in range(3):
        sizes = {tile.core[axis].stop - tile.core[axis].start for tile in tiles}
        assert max(sizes) - min(sizes) <= 1


def test_a_tile_s_grid_has_the_halo_where_the_volume_ends() -> None:
    tiling = Tiling.of(frame((75, 40, 9), (1.0, 1.0, 2.0)), None, 40)
    values = np.random.default_rng(0).random((75, 40, 9)).astype(np.float32)
    whole = tiling.place.to_grid(values)
    for tile in tiling.tiles:
        place = tiling.place_of(tile)
        part = place.to_grid(values[tile.box])
        assert tuple(part.shape) == place.grid.shape
        np.testing.assert_allclose(place.to_scan(part), tiling.place.to_scan(whole)[tile.box], atol=1e-6)
        np.testing.assert_array_equal(
            place.to_scan(place.spread(values[tile.box])), tiling.place.to_scan(tiling.place.spread(values))[tile.box]
        )


def test_large_volumes_have_tiles() -> None:
    edge = round(WHOLE ** (1 / 3)) - 12
    assert Tiling.of(frame((edge, edge, edge)), None).count == 1
    large = Tiling.of(frame((512, 500, edge + 1)), None)
    assert large.counts == (3, 3, 2)
    assert max(np.prod(large.place_of(tile).grid.shape) for tile in large.tiles) <= (EDGE + 2 * OVERLAP) ** 3


def test_a_tile_s_edge_is_checked() -> None:
    with pytest.raises(ValueError, match="tile"):
        reconstruct(beads(), WILLMORE, every=8, stiffness=1e7, tile=7)
    with pytest.raises(ValueError, match="tile"):
        reconstruct(beads(), every=8, tile=7)


# ---- starts ----------------------------------------------------------------------------------------------------------


def test_a_box_has_the_known_slices_of_the_whole() -> None:
    mask = beads(40)
    slices = Slices(mask[3::8], tuple(range(3, 40, 8)), 40, (1.0, 1.0, 1.0), periodic=True)
    rows, inside = slices.known((slice(5, 30), slice(2, 11), slice(0, 22)))
    assert rows == [6, 14, 22] and np.array_equal(inside, mask[[11, 19, 27]][:, 2:11])
    assert slices.known((slice(-9, 45), slice(-25, 3), slice(20, 30)))[0] == [4, 12, 20, 28, 36, 44, 52]


# ---- results ---------------------------------------------------------------------------------------------------------


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
    whole = reconstruct(truth, law, **options)
    same = reconstruct(truth, law, tile=200, **options)
    assert np.array_equal(whole.phase.values, same.phase.values) and same.status == whole.status
    for tile in (26, 34):
        found = reconstruct(truth, law, tile=tile, **options)
        assert np.array_equal(found.mask.values[::8], truth[::8])
        close(found, whole)
        assert found.status.split(":")[0] == whole.status.split(":")[0]


@pytest.mark.slow
def test_the_tiles_do_not_show_along_another_axis_or_around() -> None:
    truth = np.moveaxis(beads(88), 0, 2)  # two turns of the swing
    options = {"every": 8, "stiffness": 1e7, "steps": 50, "axis": 2, "periodic": True}
    whole, found = (reconstruct(truth, WILLMORE, tile=tile, **options) for tile in (None, 30))
    assert np.array_equal(found.mask.values[..., ::8], truth[..., ::8])
    close(found, whole)


def test_the_tiles_do_not_show_in_a_scan() -> None:
    scan = grey(beads())
    whole, found = (segment(scan, WILLMORE, weight=1.0, steps=50, tile=tile) for tile in (None, 34))
    close(found, whole)
    assert found.notes == whole.notes


def test_a_tile_of_background_alone_stays_empty() -> None:
    mask = np.zeros((120, 16, 16), dtype=bool)
    mask[4:20, 4:12, 4:12] = True
    likely = Field(np.where(mask, 0.9, 0.1).astype(np.float32))
    result = segment(likely, WILLMORE, probabilities=True, weight=1.0, steps=50, tile=24)
    assert result.mask.values[:20].any() and not result.mask.values[30:].any()
    for value in (0.1, 0.9):
        plain = Field(np.full_like(likely.values, value))
        assert (
            segment(plain, WILLMORE, probabilities=True, weight=1.0, steps=50, tile=24).mask.values == (value > 0.5)
        ).all()
