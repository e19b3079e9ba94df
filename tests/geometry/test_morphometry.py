"""The familiar numbers on shapes that have them exactly, and on bone; Betti numbers in boxes and on the torus."""

import numpy as np
import pytest
from scipy import ndimage

from curvafit.geometry.balls import border_distance, paint_balls
from curvafit.geometry.morphology import local_thickness, morphometry
from curvafit.geometry.topology import betti_numbers, euler_number, euler_of_window
from curvafit.volumes.read import load


def distance_from_axes(n: int, axes: int) -> np.ndarray:
    """Distance to the middle of the box (3), or to the line through it along z (2)."""
    middle = (n - 1) / 2 + 0.2
    return np.sqrt(
        sum((np.indices((n, n, n), sparse=True)[axis] - middle) ** 2 for axis in range(3 - axes, 3))
    ) + np.zeros((n, n, n))


@pytest.mark.parametrize(("radius", "axes"), [(5, 3), (9, 3), (5, 2), (9, 2)])
def test_ball_and_tube(radius: int, axes: int) -> None:
    mask = distance_from_axes(32, axes) < radius
    found = morphometry(mask, 0.5, "um")
    assert found.volume_fraction == mask.mean()
    assert found.thickness_mean == pytest.approx(radius, abs=0.5)  # diameter of `radius` at half a µm a voxel
    assert found.thickness_mean < radius + 0.25  # tubes and balls are never overstated by more than half a voxel
    assert found.surface_to_volume == pytest.approx(axes / (radius * 0.5), rel=0.045)
    through = axes == 2  # both faces that cut the tube take half a body off
    assert found.euler == (0 if through else 1)
    assert found.connectivity_density == pytest.approx(through / (31 * 0.5) ** 3)
    assert found.unit == "um"


@pytest.mark.parametrize("width", [4, 5, 8])
def test_parallel_plates(width: int) -> None:
    mask = np.broadcast_to((np.arange(6 * width) // width % 2 == 0)[:, None, None], (6 * width, 24, 24))
    found = morphometry(mask, (2.0, 2.0, 2.0), "mm", periodic=True)
    assert found.volume_fraction == 0.5
    for mean in (found.thickness_mean, found.spacing_mean):
        assert mean == pytest.approx(2 * width, abs=2)
        assert mean >= 2 * width  # plates are overstated, by half a voxel on average
    assert found.thickness_std < 0.5
    assert found.surface_to_volume == pytest.approx(1 / width, rel=0.02)
    assert found.euler == 0  # three plates without rim on a torus


def test_a_rod_between_two_balls_has_two_thicknesses() -> None:
    z, y, x = np.indices((24, 24, 60)) - np.array([12, 12, 12])[:, None, None, None]
    balls = (z**2 + y**2 + x**2 < 9**2) | (z**2 + y**2 + (x - 36) ** 2 < 9**2)
    rod = (z**2 + y**2 < 3**2) & (x > 0) & (x < 36)
    thickness = local_thickness(balls | rod)
    assert thickness[12, 12, 12] == thickness.max() == pytest.approx(18, abs=1.5)
    assert thickness[12, 12, 30] == pytest.approx(6, abs=1)
    assert np.all(thickness[~(balls | rod)] == 0)
    fine = distance_from_axes(48, 3) < 16
    found = morphometry(fine[::3], (3.0, 1.0, 1.0))
    whole = morphometry(fine)
    assert found.thickness_mean == pytest.approx(whole.thickness_mean, abs=3)
    assert found.volume_fraction == pytest.approx(whole.volume_fraction, rel=0.02)
    coarse = local_thickness(fine, largest=8.0)[fine].mean()  # of wide gaps
    assert coarse == pytest.approx(local_thickness(fine)[fine].mean(), rel=1 / 8)


def test_thickness_never_exceeds_the_largest_ball_and_never_undercuts_the_own_one() -> None:
    noise = np.random.default_rng(0).standard_normal((40, 40, 40))
    mask = ndimage.gaussian_filter(noise, 3, mode="wrap") > 0
    own = 2 * ndimage.distance_transform_edt(mask)
    thickness = local_thickness(mask)
    assert np.all(thickness[mask] >= own[mask] - 1.0 - 0.05 * own.max())
    assert thickness.max() == pytest.approx(own.max())
    noise = np.random.default_rng(1).standard_normal((24, 24, 24))
    mask = ndimage.gaussian_filter(noise, 2, mode="wrap") > 0.3 * 0.1
    here = morphometry(mask, periodic=True)
    there = morphometry(np.roll(mask, (5, 7, 11), (0, 1, 2)), periodic=True)
    assert here.euler == there.euler
    assert here.surface_to_volume == pytest.approx(there.surface_to_volume, rel=1e-6)
    assert here.thickness_mean == pytest.approx(there.thickness_mean, rel=0.02)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.5, 0.75, 1.25)])
def test_balls_are_painted_by_the_rule(spacing: tuple[float, float, float], periodic: bool) -> None:
    """One by one, in descending size, unless one sticks out of the ball that painted its centre by less than half the
    finest edge or a twentieth: across words of 64 voxels, and beside a box that repeats."""
    mask = ndimage.gaussian_filter(np.random.default_rng(2).standard_normal((10, 11, 100)), 2.0) > -0.02
    radius = np.minimum(border_distance(mask, spacing), 3.0)
    places, finest = np.argwhere(np.ones(mask.shape)), min(spacing)
    flat = radius.ravel()
    painted, owner = np.zeros(mask.size, np.float32), np.full(mask.size, -1)

    def away(voxel: int) -> np.ndarray:
        steps = np.abs(places - places[voxel])
        steps = np.minimum(steps, np.array(mask.shape) - steps) if periodic else steps
        return np.sqrt(np.square(steps * np.float32(spacing).astype(float)).sum(1))

    for voxel in np.argsort(-flat, kind="stable"):
        if not flat[voxel]:
            break
        distances, centre = away(voxel), owner[voxel]
        if centre >= 0:
            excess = distances[centre] + flat[voxel] - flat[centre]
            if excess <= max(0.5 * finest, 0.05 * flat[centre]):
                continue
        covered = (distances <= flat[voxel] + 0.5 * finest) & (owner < 0) & mask.ravel()
        painted[covered], owner[covered] = flat[voxel], voxel
    found = paint_balls(radius, spacing, periodic=periodic)
    assert len(np.unique(owner)) > 100
    assert np.array_equal(found.ravel(), painted)
    with pytest.raises(ValueError, match="31 voxels"):
        paint_balls(np.full((3, 3, 90), 40.0 * spacing[2], np.float32), spacing)


def test_euler_numbers_of_known_shapes() -> None:
    """And windows add their share: the mean over all places of a window in a box that repeats, exactly."""
    ring = np.zeros((5, 9, 9), bool)
    ring[2, 2:7, 2:7] = True
    ring[2, 3:6, 3:6] = False
    shell = np.zeros((9, 9, 9), bool)
    shell[2:7, 2:7, 2:7] = True
    shell[3:6, 3:6, 3:6] = False
    assert [morphometry(mask, periodic=p).euler for mask in (ring, shell) for p in (False, True)] == [0, 0, 2, 2]
    assert morphometry(ring, 2.0).connectivity_density == pytest.approx(1 / (4 * 8 * 8 * 2**3))
    mask = np.random.default_rng(0).random((6, 7, 5)) < 0.4
    shares = [euler_of_window(np.roll(mask, by, (0, 1, 2))[:4, :5, :3]) for by in np.ndindex(*mask.shape)]
    assert np.mean(shares) == pytest.approx(euler_number(mask, periodic=True) * 3 * 4 * 2 / mask.size)
    alone = np.pad(mask, 1)
    assert euler_of_window(alone) == euler_number(alone)


@pytest.mark.slow
def test_trabecular_bone(data) -> None:
    scan = load(data / "scans" / "lhdl_trabecular_200_otsu_mask.tif")
    found = morphometry(scan.values[:96, :96, :96] > 0, scan.spacing, scan.unit)
    whole = (scan.values > 0).mean()
    assert whole == pytest.approx(0.187, abs=0.001)
    assert 150 < found.thickness_mean < 300 < found.spacing_mean < 1200  # µm, as human trabecular bone has them
    assert 0.008 < found.surface_to_volume < 0.03


def solid(*boxes: tuple[slice, slice, slice], less: tuple[tuple[slice, slice, slice], ...] = ()) -> np.ndarray:
    mask = np.zeros((10, 11, 12), dtype=bool)
    for box in boxes:
        mask[box] = True
    for box in less:
        mask[box] = False
    return mask


ALL, INNER, CORE = slice(None), slice(3, 8), slice(4, 7)
BALL = (INNER, INNER, INNER)
ROD = (ALL, INNER, INNER)
PLATE = (INNER, ALL, ALL)

#: Solids, their Betti numbers, and χ on the torus.
SOLIDS = {
    "ball": (solid(BALL), (1, 0, 0), 1),
    "shell": (solid(BALL, less=((CORE, CORE, CORE),)), (1, 0, 1), 2),
    "ring": (solid(BALL, less=((ALL, CORE, CORE),)), (1, 1, 0), 0),
    "rod": (solid(ROD), (1, 0, 0), 0),
    "pipe": (solid(ROD, less=((ALL, CORE, CORE),)), (1, 1, 0), 0),
    "plate": (solid(PLATE), (1, 0, 0), 0),
    "plate with a hole": (solid(PLATE, less=((ALL, CORE, CORE),)), (1, 1, 0), -1),
    "two plates": (solid(PLATE, (slice(9, 10), ALL, ALL)), (2, 0, 0), 0),
    "box without a ball": (~solid(BALL), (1, 0, 1), 1),
    "box without a rod": (~solid(ROD), (1, 1, 0), 0),
    "full": (solid((ALL, ALL, ALL)), (1, 0, 0), 0),
    "empty": (solid(), (0, 0, 0), 0),
    "across an edge": (np.roll(solid(BALL), (5, 5, 6), (0, 1, 2)), (8, 0, 0), 1),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_betti_numbers_of_known_solids(name: str) -> None:
    """And two solids that touch at a corner are one, two hollows that do are two."""
    mask, betti, torus = SOLIDS[name]
    assert betti_numbers(mask) == betti and euler_number(mask, periodic=True) == torus
    corners = solid((slice(2, 5),) * 3, (slice(5, 8),) * 3)
    assert betti_numbers(corners) == (1, 0, 0) and betti_numbers(~corners) == (1, 0, 2)


@pytest.mark.parametrize("seed", range(4))
def test_laws_of_random_masks(seed: int) -> None:
    """Of a box turned and mirrored; and χ on the torus, which a shift does not change."""
    random = np.random.default_rng(seed)
    mask = ndimage.gaussian_filter(random.standard_normal((14, 12, 16)), 1.3, mode="wrap") > random.uniform(-0.1, 0.1)
    pieces, tunnels, cavities = betti = betti_numbers(mask)
    assert betti_numbers(mask.transpose(2, 0, 1)[::-1]) == betti and min(betti) >= 0
    assert pieces - tunnels + cavities == euler_number(mask)
    assert euler_number(np.roll(mask, (5, 7, 3), (0, 1, 2)), periodic=True) == euler_number(mask, periodic=True)
