"""A scan's blur and noise, and shapes as such a scan shows them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy import ndimage

from curvafit import Field
from curvafit.scan.grids import centre_distance
from curvafit.scan.prepare import prepare
from curvafit.scan.structure import Quality, find_structure, measure_quality, sample_mask

CUBIC = (1.0, 1.0, 1.0)


def ball(n: int, centre: float, radius: float) -> np.ndarray:
    z, y, x = np.indices((n, n, n)) + 0.5
    return (z - centre) ** 2 + (y - centre) ** 2 + (x - centre) ** 2 < radius**2


def bodies(n: int = 48) -> np.ndarray:
    """Balls and a tube in a periodic box."""
    z, y, _ = np.indices((n, n, n)) + 0.5
    tube = (z - 38) ** 2 + (y - 12) ** 2 < 25
    return ball(n, n / 3, 9) | ball(n, 2 * n / 3, 7) | tube


def image(mask: np.ndarray, blur: float, noise: float) -> np.ndarray:
    """Grey levels 100 and 150, blurred, with white noise of a part of their contrast."""
    filled = ndimage.gaussian_filter(mask.astype(np.float32), blur, mode="wrap")
    return 100 + 50 * (filled + noise * np.random.default_rng(0).standard_normal(mask.shape, dtype=np.float32))


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("blur", [0.5, 1.0, 1.5])
def test_blur_and_noise_are_read_from_grey_levels(blur: float, noise: float) -> None:
    mask = bodies()
    quality = measure_quality(image(mask, blur, noise), mask, CUBIC)
    assert quality.blur == pytest.approx(blur, abs=0.5)  # a step of those tried, and a mask's own stairs
    assert quality.noise == pytest.approx(noise, rel=0.15, abs=0.01)
    assert quality.degraded == (noise > 0.2)
    assert quality.grain <= 0.6  # white noise has none; a blur of 1.5 reaches into what lies deep
    assert abs(quality.boundary_shift) <= 0.5  # stairs


def test_what_smoothing_leaves_of_white_noise() -> None:
    assert Quality(0.5, 1.0, 0.0, 0.0, CUBIC).smoothed == pytest.approx((2 * np.sqrt(np.pi)) ** -1.5, rel=1e-3)
    levels = np.random.default_rng(0).standard_normal((48, 96, 96))
    smooth = ndimage.gaussian_filter(levels, (0.5, 1.0, 1.0))
    assert Quality(0.5, 1.0, 0.0, 0.0, (2.0, 1.0, 1.0)).smoothed == pytest.approx(smooth.std(), rel=0.05)


@pytest.mark.parametrize("spacing", [CUBIC, (2.0, 1.0, 1.0)])
def test_noise_is_read_on_slices_that_are_thicker(spacing: tuple[float, float, float]) -> None:
    mask = bodies()[:: int(spacing[0])]
    quality = measure_quality(image(mask, 0.7, 0.2), mask, spacing)
    assert quality.noise == pytest.approx(0.2, rel=0.15)
    assert quality.grain <= 0.5
    assert Quality(0.5, 0.02, 0.0, 0.0, spacing).degraded == (spacing != CUBIC)  # worse than a mask


@pytest.mark.parametrize("grain", [0.7, 1.2])
def test_noise_that_neighbours_share_is_read_with_its_grain(grain: float) -> None:
    mask = bodies()
    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal(mask.shape), grain)
    levels = image(mask, 1.0, 0.0) + 50 * 0.1 * noise / noise.std()
    quality = measure_quality(levels, mask, CUBIC)
    assert quality.noise == pytest.approx(0.1, rel=0.2)
    assert quality.grain == pytest.approx(grain, rel=0.25)


@pytest.mark.parametrize("fat", [1, 2])
def test_a_mask_that_is_too_fat_is_known_as_such(fat: int) -> None:
    """And does not lower the contrast, by which the noise would seem too great."""
    mask = bodies()
    quality = measure_quality(image(mask, 1.0, 0.2), ndimage.binary_dilation(mask, iterations=fat), CUBIC)
    # of faces' neighbours: less than a voxel in the mean
    assert quality.boundary_shift == pytest.approx(min(0.8 * fat, 1.5), abs=0.5)
    assert quality.noise == pytest.approx(0.2, rel=0.15)


def test_thin_structures_have_their_noise_read_from_differences() -> None:
    mask = np.zeros((32, 32, 32), dtype=bool)
    mask[::6] = mask[1::6] = True
    assert measure_quality(image(mask, 0.5, 0.1), mask, CUBIC).noise == pytest.approx(0.1, rel=0.2)


def shown(quality: Quality, mask: np.ndarray, seed: int = 0, slices: int = 1) -> np.ndarray:
    """The structure in an image of a mask, whose slices are so many voxels thick."""
    grey = quality.image(mask, (slices, 1.0, 1.0), seed)
    return find_structure(Field(grey, (float(slices), 1.0, 1.0), "voxel"), kind="image", periodic=True)[1].values > 0


def test_a_sharp_clean_scan_shows_the_shape() -> None:
    mask = bodies()
    seen = shown(Quality(0.5, 0.01, 0.0, 0.0, CUBIC), mask)
    beside = np.abs(centre_distance(mask, CUBIC, 3.0, periodic=True)) <= 1.5
    assert np.array_equal(seen[~beside], mask[~beside])
    assert seen.mean() == pytest.approx(mask.mean(), rel=0.05)


def test_noise_moves_the_surface_and_seeds_move_it_differently() -> None:
    mask, noisy = bodies(), Quality(1.0, 0.4, 0.0, 0.0, CUBIC)
    first, second = (shown(noisy, mask, seed) for seed in (0, 1))
    clean = shown(Quality(1.0, 0.0, 0.0, 0.0, CUBIC), mask)
    assert np.count_nonzero(first != clean) > 100
    assert np.count_nonzero(first != second) > 100


@pytest.mark.parametrize("slices", [1, 2])
def test_what_a_scan_without_noise_shows_moves_with_the_shape(slices: int) -> None:
    mask, sharp = bodies(), Quality(1.0, 0.0, 0.0, 0.0, (float(slices), 1.0, 1.0))
    moved = np.roll(mask, (6, 5, 11), (0, 1, 2))
    for show in (lambda shape: shown(sharp, shape, 0, slices), lambda shape: sample_mask(shape, (slices, 1.0, 1.0))):
        difference = show(moved) != np.roll(show(mask), (6 // slices, 5, 11), (0, 1, 2))
        assert difference.mean() < 1e-4  # ties at the threshold


def test_voxelised_on_the_same_voxels_is_the_mask_and_thick_slices_lose_a_thin_plate() -> None:
    mask = bodies()
    assert np.array_equal(sample_mask(mask, CUBIC), mask)
    mask[3] = True
    assert not sample_mask(mask, (4.0, 1.0, 1.0))[0].all()


def test_two_sharp_levels_are_split_in_their_middle() -> None:
    """Otsu's threshold lies anywhere between two sharp levels; at the lower one the structure would be a voxel fat."""
    mask = bodies()
    found = find_structure(Field(image(mask, 0.0, 0.005), CUBIC, "voxel"), kind="image", periodic=True)[1]
    split = re.search(r"threshold of (\d+)", " ".join(found.notes))
    assert split is not None and float(split[1]) == pytest.approx(125, abs=2)
    assert np.mean(found.values > 0) == pytest.approx(mask.mean(), rel=0.03)


def test_an_image_knows_its_imaging_and_a_mask_has_none() -> None:
    mask = bodies()
    grey = image(mask, 1.0, 0.1)
    scan = prepare(Field(grey, CUBIC, "voxel"), kind="image", periodic=True)
    dark = prepare(Field(-grey, CUBIC, "voxel"), kind="image", periodic=True, dark=True)
    assert scan.quality is not None
    assert dark.quality is not None
    assert dark.quality.blur == scan.quality.blur
    assert dark.quality.noise == pytest.approx(scan.quality.noise, rel=0.01)
    assert scan.scan_alike(mask, 0).quality == scan.quality  # which made its grey levels
    assert prepare(Field(mask, CUBIC, "voxel"), periodic=True).quality is None


@pytest.mark.parametrize("noise", [0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("blur", [1.0, 1.5])
def test_the_true_share_is_without_what_imaging_adds(blur: float, noise: float) -> None:
    """Thin tubes: their mask is up to half too full, their share less than half as much."""
    z, y, x = np.indices((60, 60, 60)) % 20 - 9.5
    truth = np.minimum(z**2 + y**2, np.minimum(y**2 + x**2, z**2 + x**2)) < 3.2**2
    scan = prepare(Field(image(truth, blur, noise), CUBIC, "voxel"), kind="image")
    full = truth.mean()
    assert abs(scan.true_volume_fraction - full) < 0.5 * abs(scan.volume_fraction - full)


def threads(n: int = 64) -> np.ndarray:
    """Thin threads and balls in a periodic box: a cut of a random field."""
    field = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((n, n, n)), 3, mode="wrap")
    return field > np.quantile(field, 0.88)


@pytest.mark.parametrize("step", [0.7, 0.9, 1.3])
def test_a_mask_keeps_its_volume_on_other_voxels(step: float) -> None:
    mask = threads()
    kept = sample_mask(mask, [step] * 3, keep_volume=True)
    assert kept.mean() == pytest.approx(mask.mean(), rel=0.005)
    assert sample_mask(mask, [step] * 3).mean() < 0.99 * mask.mean()


def test_a_grown_shape_is_read_with_the_volume_of_the_same_shape_scanned() -> None:
    """A mask loses some of its volume on the working grid; a shape that is scanned alike must not lose it twice."""
    mask = threads()
    scan = prepare(Field(mask.astype(np.uint8)), kind="mask", periodic=True, one_scale=True)
    assert scan.volume_fraction < 0.99 * mask.mean()
    assert scan.scan_alike(mask, 0).volume_fraction == pytest.approx(scan.volume_fraction, rel=0.01)
    assert scan.true_volume_fraction == pytest.approx(mask.mean(), rel=0.01)
