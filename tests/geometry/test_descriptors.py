"""Descriptors on shapes that are known exactly, and the laws that they obey."""

import math

import numpy as np
import pytest
from exact import Cylinder, Gyroid, Shape, Sphere, centres, profile
from scipy import ndimage

from curvafit.geometry.description import BLOCKS, LEVELS, RADII, Descriptors, descriptors
from curvafit.geometry.topology import euler_number
from curvafit.priors.grid import Grid

LEVEL, RADIUS = np.array(LEVELS), np.array(RADII)
EPSILON = 0.02


def measured(shape: Shape, grid: Grid, seen_as: str) -> Descriptors:
    field = profile(shape, centres(grid), EPSILON)
    return descriptors(field > 0 if seen_as == "mask" else field, grid, EPSILON)


def random_mask(n: int = 64, seed: int = 3, width: float = 4.0, share: float = 0.3) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((n, n, n))
    smooth = ndimage.gaussian_filter(noise, width, mode="wrap")
    return smooth > np.quantile(smooth, 1 - share)


@pytest.mark.parametrize("seen_as", ["field", "mask"])
def test_a_ball(seen_as: str) -> None:
    R, n = 0.16, 48
    ball, grid = Sphere(R, (0.24, 0.24, 0.24)), Grid((n, n, n))
    seen = measured(ball, grid, seen_as)
    volume = (0.01 * n) ** 3
    assert seen.fraction[0] * volume == pytest.approx(4 / 3 * math.pi * R**3, rel=0.01)
    area, bend, euler = seen.densities * volume
    assert area == pytest.approx(4 * math.pi * R**2, rel=0.02)
    assert bend == pytest.approx(4 * math.pi * R, rel=0.05)
    assert euler == pytest.approx(1)
    assert seen.chords == pytest.approx(2 * R * np.sqrt(LEVEL), abs=0.01)  # a voxel: chords are whole numbers of them
    depth = R * (1 - np.cbrt(1 - LEVEL))
    assert seen.depths == pytest.approx(np.minimum(depth, seen.depths.max()), abs=0.01)
    f, share = seen.fraction[0], 1 - 0.75 * RADIUS * 0.01 / R + (RADIUS * 0.01 / R) ** 3 / 16
    near = RADIUS * 0.01 < 2 * (0.24 - R)  # further on, a ball sees its neighbours in the repeated box
    assert seen.correlation[near] == pytest.approx(((f * share - f**2) / (f * (1 - f)))[near], abs=0.02)
    assert seen.fabric == pytest.approx(1 / 3, abs=0.005)
    assert [len(getattr(seen, name)) for name in BLOCKS] == list(BLOCKS.values())
    assert len(seen.vector()) == sum(BLOCKS.values())
    assert seen.vector()[[288, -3, -2, -1]] == pytest.approx([*seen.fraction, *seen.fabric], abs=0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("seen_as", ["field", "mask"])
def test_a_tube_along_an_axis(seen_as: str, axis: int) -> None:
    R, side = 0.1, 0.4
    direction = tuple(np.eye(3)[axis])
    seen = measured(Cylinder(R, direction, (0.2, 0.2, 0.2)), Grid((40, 40, 40)), seen_as)  # type: ignore[arg-type]
    area, bend, euler = seen.densities * side**2
    assert area == pytest.approx(2 * math.pi * R, rel=0.02)
    assert bend == pytest.approx(math.pi, rel=0.03)
    assert euler == 0
    assert seen.fabric == pytest.approx([0.5, 0.5, 0], abs=0.01)
    assert seen.chords[-1] == pytest.approx(2 * R, abs=0.01)  # those along the axis have no end, and count nowhere


def test_a_gyroid_is_the_mirror_of_its_outside() -> None:
    grid = Grid((40, 40, 40))
    field = profile(Gyroid(0.4), centres(grid), EPSILON)  # type: ignore[arg-type]
    inside, outside = descriptors(field, grid, EPSILON), descriptors(-field, grid, EPSILON)
    assert inside.densities[2] * grid.volume == pytest.approx(-4)  # half of the surface's χ = -8
    check_mirrored(inside, outside, 0.01, 0)


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_inside_for_outside_mirrors_a_random_mask(boundary: str) -> None:
    mask, grid = random_mask(), Grid((64, 64, 64), boundary=boundary)  # type: ignore[arg-type]
    assert euler_number(~mask, periodic=True) == euler_number(mask, periodic=True)  # nothing touches by corners alone
    corners = 0 if grid.periodic else 4 / grid.volume  # cells at a window's low faces count, at its high ones do not
    check_mirrored(descriptors(mask, grid), descriptors(~mask, grid), 0.05, corners)


def check_mirrored(seen: Descriptors, other: Descriptors, share: float, corners: float) -> None:
    """κ1 becomes -κ2 and κ2 becomes -κ1: the line at an angle becomes the one at 90° less it, backwards."""
    lines = seen.curvature.reshape(12, 24)
    mirrored = [-lines[6 - k][::-1] if k <= 6 else lines[18 - k] for k in range(12)]
    assert other.curvature == pytest.approx(np.concatenate(mirrored), abs=share * np.abs(lines).max())
    assert other.fraction == pytest.approx(1 - seen.fraction)
    assert other.densities[:2] == pytest.approx(seen.densities[:2] * [1, -1], rel=share, abs=share * seen.densities[0])
    assert other.densities[2] == pytest.approx(seen.densities[2], abs=corners)
    for name, counterpart in (("chords", "gaps"), ("depths", "clearances")):
        assert getattr(other, name) == pytest.approx(getattr(seen, counterpart))
        assert getattr(other, counterpart) == pytest.approx(getattr(seen, name))
    assert other.correlation == pytest.approx(seen.correlation)
    assert other.fabric == pytest.approx(seen.fabric, abs=share)


@pytest.mark.parametrize("axes", [(1, 2, 0), (2, 1, 0)])
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_permuted_axes_leave_all_blocks_alone(axes: tuple[int, ...], boundary: str) -> None:
    mask = random_mask()[:, :56, :48]
    seen = descriptors(mask, Grid(mask.shape, boundary=boundary))  # type: ignore[arg-type]
    turned = np.ascontiguousarray(mask.transpose(axes))
    again = descriptors(turned, Grid(turned.shape, boundary=boundary))  # type: ignore[arg-type]
    for name in BLOCKS:
        block = getattr(seen, name)
        assert getattr(again, name) == pytest.approx(block, abs=0.02 * np.abs(block).max()), name


def test_lengths_are_in_the_grid_s_unit() -> None:
    mask, factor = random_mask(48), 256.0  # a power of two: no sum is rounded otherwise
    seen = descriptors(mask, Grid(mask.shape), EPSILON)
    again = descriptors(mask, Grid(mask.shape, 0.01 * factor), EPSILON * factor)
    powers = {"curvature": -1, "chords": 1, "gaps": 1, "depths": 1, "clearances": 1}
    powers |= {"densities": np.array([-1, -2, -3]), "fraction": 0, "correlation": 0, "fabric": 0}
    for name in BLOCKS:
        block = getattr(seen, name) * factor ** np.asarray(powers[name], dtype=float)
        assert getattr(again, name) == pytest.approx(block, rel=1e-4, abs=1e-4 * np.abs(block).max()), name


@pytest.mark.slow
def test_crops_estimate_the_whole() -> None:
    """Windows of 32³ voxels, half of whose chords are cut short, of a box of 96³: the mean of all 27."""
    mask = random_mask(96, width=2.5)
    whole, window = descriptors(mask, Grid(mask.shape)), Grid((32, 32, 32), boundary="replicate")
    parts = np.split(mask, 3, 0)
    parts = [c for a in parts for b in np.split(a, 3, 1) for c in np.split(b, 3, 2)]
    crops = [descriptors(part, window) for part in parts]
    for name in BLOCKS:
        mean = np.mean([getattr(crop, name) for crop in crops], axis=0)
        block = getattr(whole, name)
        if name in ("chords", "gaps"):  # the longest are longer than the windows
            mean, block = mean[:8], block[:8]
        if name == "fabric":  # random windows have random directions
            assert mean == pytest.approx(block, abs=0.05)
        else:
            assert mean == pytest.approx(block, rel=0.08, abs=0.03 * np.abs(block).max()), name
