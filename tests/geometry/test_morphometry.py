"""The familiar numbers on shapes that have them exactly, and on bone."""

import numpy as np
import pytest
from scipy import ndimage

from curvafit.geometry.morphometry import local_thickness, morphometry
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


def test_euler_numbers_of_known_shapes() -> None:
    ring = np.zeros((5, 9, 9), bool)
    ring[2, 2:7, 2:7] = True
    ring[2, 3:6, 3:6] = False
    shell = np.zeros((9, 9, 9), bool)
    shell[2:7, 2:7, 2:7] = True
    shell[3:6, 3:6, 3:6] = False
    assert [morphometry(mask, periodic=p).euler for mask in (ring, shell) for p in (False, True)] == [0, 0, 2, 2]
    assert morphometry(ring, 2.0).connectivity_density == pytest.approx(1 / (4 * 8 * 8 * 2**3))


@pytest.mark.slow
def test_trabecular_bone(data) -> None:
    scan = load(data / "scans" / "lhdl_trabecular_200_otsu_mask.tif")
    found = morphometry(scan.values[:96, :96, :96] > 0, scan.spacing, scan.unit)
    whole = (scan.values > 0).mean()
    assert whole == pytest.approx(0.187, abs=0.001)
    assert 150 < found.thickness_mean < 300 < found.spacing_mean < 1200  # µm, as human trabecular bone has them
    assert 0.008 < found.surface_to_volume < 0.03
