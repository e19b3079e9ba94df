"""From scan to working grid: the right phase, size and place; a scan's blur and noise, and shapes as it shows them."""

import re

import numpy as np
import pytest
import torch
from exact import Sphere, centres
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from shapes import grown

from curvafit.geometry.diagrams import diagram
from curvafit.priors import Grid, phase_field, profile
from curvafit.priors.stencils import gaussian_blur
from curvafit.scan import preparation as preparing
from curvafit.scan.grids import (
    box_by_surface,
    candidate_boxes,
    centre_distance,
    median_thickness,
    profile_mask,
    remove_specks,
    resample,
    restore_signs,
)  # fmt: skip
from curvafit.scan.preparation import WORKING_THICKNESS, Prepared, is_ball, prepare, read_scan, thinner_thickness
from curvafit.scan.quality import Quality, measure_quality, sample_mask
from curvafit.scan.structure import find_structure, is_noise
from curvafit.volumes import ScanError, Volume, load, save


def tube_mask(shape: tuple[int, int, int], spacing: tuple[float, float, float], radius: float) -> np.ndarray:
    """A tube along x through the middle, in physical lengths."""
    z, y, _ = (((np.arange(n) + 0.5) * h - n * h / 2) for n, h in zip(shape, spacing, strict=True))
    return np.broadcast_to((z[:, None] ** 2 + y[None, :] ** 2 < radius**2)[:, :, None], shape)


def image_of(mask: np.ndarray, noise: float = 8.0, seed: int = 0) -> np.ndarray:
    grey = 50 + 100 * ndimage.gaussian_filter(mask.astype(np.float32), 0.7)
    return np.clip(grey + np.random.default_rng(seed).normal(0, noise, mask.shape), 0, 255).astype(np.uint8)


def threshold_of(scan: Prepared | Volume) -> float:
    """The grey level that separates the phases, as a note says."""
    match = re.search(r"threshold of ([\d.]+):", " ".join(scan.notes))
    assert match is not None
    return float(match[1])


@pytest.mark.parametrize("crop", [None, ":,4:20,:"])
def test_of_a_large_file_the_middle_is_read(tmp_path, monkeypatch, crop) -> None:
    monkeypatch.setattr("curvafit.scan.preparation.LARGEST_SCAN", 24)
    mask = tube_mask((20, 24, 60), (1, 1, 1), 6)
    grey = image_of(mask)
    path = save(Volume(grey, (1.0, 1.0, 1.0), "um"), tmp_path / "scan.zarr")
    field, shape = read_scan(path, crop=crop)
    rows = slice(4, 20) if crop else slice(0, 24)
    assert shape == grey[:, rows].shape and (field.values == grey[:, rows, 18:42]).all()
    assert field.affine is not None and field.affine[0, 3] == 18
    assert "the middle" in field.notes[-1] and "scan.zarr::1" in field.notes[-1]
    assert read_scan(path, whole=True)[0].shape == (20, 24, 60)
    assert read_scan(path, label=int(grey[9, 12, 30]))[0].values[9, 12, 12] == 1
    with pytest.raises(ScanError, match="in the middle of this large scan"):
        read_scan(path, label=999)
    packed = save(Volume(grey, (1.0, 1.0, 1.0), "um"), tmp_path / "scan.nii.gz")  # cannot be read in part
    assert read_scan(packed)[0].shape == (20, 24, 60)


def test_a_file_larger_than_memory_is_read_in_its_middle(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("curvafit.scan.preparation.LARGEST_SCAN", 64)
    shape = (600, 40_000, 40_000)  # a terabyte, of which nothing but the middle is on the disk
    array = np.lib.format.open_memmap(tmp_path / "scan.npy", mode="w+", dtype=np.uint8, shape=shape)
    array[300, 20_000, 19_990:20_010] = 7
    array.flush()
    del array
    field, whole = read_scan(tmp_path / "scan.npy")
    assert whole == shape and field.shape == (64, 64, 64) and field.values.sum() == 7 * 20
    with pytest.raises(ScanError, match="does not fit into memory"):
        read_scan(tmp_path / "scan.npy", whole=True)


TUBE = tube_mask((32, 32, 32), (1, 1, 1), 6)
FIELD = phase_field(torch.from_numpy(TUBE.copy()), Grid(TUBE.shape), 0.02).numpy()


def test_kinds_are_told_apart() -> None:
    scaled = 2 * image_of(TUBE).astype(np.float32) / 255 - 1
    for values, options, kind in (
        (TUBE, {}, "mask"), (np.where(TUBE, np.float32(1), np.float32(-1)), {}, "mask"), (FIELD, {}, "field"),
        (image_of(TUBE), {}, "image"), (scaled, {}, "image"), (FIELD, {"threshold": 0.5}, "image"),
        *((FIELD, {"kind": kind}, kind) for kind in ("field", "mask", "image")),
    ):  # fmt: skip
        assert prepare(Volume(values), **options).kind == kind


def test_a_phase_field_stays_as_it_is() -> None:
    prepared = prepare(Volume(FIELD, 0.5, "um"), periodic=True)
    assert np.array_equal(prepared.phase, FIELD)
    assert prepared.grid == Grid(TUBE.shape, boundary="periodic")
    assert (prepared.scale, prepared.working_voxel, prepared.unit) == ((1, 1, 1), 0.5, "um")
    assert np.array_equal(prepare(Volume(FIELD), dark=True).mask, ~(FIELD >= 0))


def test_a_mask_is_profiled_as_the_atlas_profiles_its_masks() -> None:
    mask = tube_mask((24, 24, 24), (1, 1, 1), 5)
    prepared = prepare(Volume(mask), one_scale=True)
    assert prepared.grid.boundary == "replicate"
    assert np.array_equal(prepared.mask, mask)
    assert np.array_equal(prepared.phase, phase_field(torch.from_numpy(mask.copy()), prepared.grid, 0.02).numpy())
    assert prepared.phase.dtype == np.float32


@pytest.mark.parametrize(("radius", "share"), [(4, 1.1), (8, 0.6), (12, 0.6)])
def test_what_is_thick_is_smoothed_more_widely(radius: int, share: float) -> None:
    """The error of κ of a ball's mask nearly halves from a radius of 8 voxels on, and stays at 4."""
    ball, n = Sphere(radius, (radius + 12.3, radius + 11.9, radius + 12.1)), 2 * radius + 24
    grid = Grid((n, n, n), (1.0, 1.0, 1.0), "replicate")
    mask = ball.distance(centres(grid)) > 0
    errors = []
    for phase in (phase_field(mask, grid, 2.0), profile_mask(mask.numpy())):
        found = diagram(phase, grid, 2.0, margin=10).normalised
        errors.append(found.weights @ ((found.points * radius - 1) ** 2).sum(1))
    assert errors[1] < share**2 * errors[0]
    assert found.mean().mean() * radius == pytest.approx(1, abs=0.06 if radius == 4 else 0.02)


@pytest.mark.parametrize("wrong", [0.003, 0.02])
def test_signs_are_restored_one_by_one_as_by_a_blur_of_all(wrong: float) -> None:
    """Few or many, up to the faces, beyond which both continue as a mirror image."""
    noise = np.random.default_rng(0)
    distance = noise.standard_normal((18, 20, 31)).astype(np.float32)
    mask = (distance > 0) != (noise.random(distance.shape) < wrong)
    voxels = Grid(mask.shape, (1.0, 1.0, 1.0), "replicate")
    expected = torch.from_numpy(distance.copy())
    for _ in range(profile.SWEEPS):
        error = torch.where((expected > 0) != torch.from_numpy(mask), expected, 0)
        expected -= profile.PULL * gaussian_blur(error, voxels, profile.PULL_WIDTH)
    restore_signs(distance, mask, voxels)
    assert np.abs(distance - expected.numpy()).max() < 1e-4


def test_a_periodic_mask_is_profiled_without_a_seam_and_thin_plates_survive() -> None:
    mask = grown("tubes", 48, 1).numpy() > 0
    moved = np.roll(profile_mask(np.roll(mask, 20, (0, 1, 2)), periodic=True), -20, (0, 1, 2))
    assert profile_mask(mask, periodic=True) == pytest.approx(moved, abs=1e-5)
    plate = np.zeros((40, 40, 40), dtype=bool)
    plate[18:21] = True
    assert np.array_equal(profile_mask(plate) > 0, plate)


def test_the_image_of_a_mask_gives_the_mask_back() -> None:
    mask = tube_mask((40, 40, 40), (1, 1, 1), 6)
    bright, dark = prepare(Volume(image_of(mask))), prepare(Volume(255 - image_of(mask)), dark=True)
    for prepared in (bright, dark):
        overlap = (prepared.mask & mask).sum() / (prepared.mask | mask).sum()
        assert overlap > 0.9
    assert threshold_of(bright) == pytest.approx(100, abs=12)
    given = prepare(Volume(image_of(mask)), threshold=100.0)
    assert "the given threshold of 100" in " ".join(given.notes)


@pytest.mark.parametrize("radius", [4, 12])
def test_a_structure_and_its_background_get_one_working_grid(radius: float) -> None:
    """The thinner of the two sets it; and the note says how to turn them round."""
    mask = tube_mask((40, 40, 40), (1, 1, 1), radius)
    own, other = prepare(Volume(mask)), prepare(Volume(~mask))
    assert (own.scale, own.grid, own.thickness) == (other.scale, other.grid, other.thickness)
    assert np.array_equal(own.mask, ~other.mask)
    assert own.volume_fraction == pytest.approx(1 - other.volume_fraction) and own.volume_fraction < 0.5
    (note,) = (note for note in other.notes if "--dark" in note)
    assert f"fills {other.volume_fraction:.0%} of the volume" in note
    assert not any("--dark" in note for note in own.notes)
    turned = prepare(Volume(~mask), kind="mask", dark=True)
    assert np.array_equal(turned.mask, own.mask) and not any("--dark" in note for note in turned.notes)
    assert np.array_equal(own.inverted.mask, ~own.mask) and np.array_equal(own.inverted.phase, -own.phase)
    assert np.array_equal(own.inverted.inverted.mask, own.mask) and own.inverted.grid == own.grid


def test_only_the_region_of_interest_is_filled_or_turned() -> None:
    """Half a tube of radius 10 in a region as thick as it: the background there is thinner."""
    mask, region = tube_mask((40, 40, 40), (1, 1, 1), 10), np.zeros((40, 40, 40), dtype=bool)
    region[8:32, 8:32, :30] = True
    own = prepare(Volume(mask), roi=region)
    assert own.roi is not None
    assert own.volume_fraction == own.mask[own.roi].mean() > 0.5
    assert not own.inverted.mask[~own.roi].any()
    assert own.inverted.volume_fraction == pytest.approx(1 - own.volume_fraction)
    assert any("of the background" in note for note in own.notes)


def ball(n: int, centre: float, radius: float) -> np.ndarray:
    return np.square(np.indices((n, n, n)) - centre).sum(0) < radius**2


def test_a_ball_is_one_body_without_handles_or_cavities() -> None:
    z, y, x = np.indices((40, 40, 40)) - 19.5
    torus = np.square(np.hypot(y, x) - 11) + np.square(z) < 16
    own = ball(40, 19.5, 8)
    assert is_ball(own)
    hollow, two, cut = ball(40, 19.5, 15) & ~own, ball(40, 10, 6) | ball(40, 28, 6), ball(40, 5, 8)
    for other in (~own, torus, hollow, two, cut, np.zeros_like(own)):  # the first reaches the faces
        assert not is_ball(other)


def test_noise_as_an_image_is_smoothed_is_noise() -> None:
    for seed in range(3):
        grey = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((48, 48, 48)), 1)
        assert is_noise(grey > 0) and is_noise(grey > 0.1)


@pytest.mark.parametrize("period", [12, 14])
def test_a_fine_gyroid_is_no_noise(period: int) -> None:
    z, y, x = 2 * np.pi / period * np.indices((4 * period,) * 3)
    mask = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) > 0.3
    assert 4 < median_thickness(mask, (1.0, 1.0, 1.0), True)[0] < 6
    assert not is_noise(mask)


# ---- the working grid ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "tube", [((40, 40, 24), (1, 1, 1), 2.1), ((96, 96, 40), (0.5,) * 3, 12), ((20, 60, 60), (3, 1, 1), 9)]
)
@pytest.mark.parametrize("grey", [False, True])
def test_resampled_to_a_known_thickness_at_the_right_place(tube, grey: bool) -> None:
    shape, spacing, radius = tube
    mask = tube_mask(shape, spacing, radius)
    prepared = prepare(Volume(image_of(mask, 3.0) if grey else mask, spacing, "um"))
    assert prepared.scale != (1, 1, 1)
    edge = prepared.working_voxel
    assert tuple(s * h for s, h in zip(prepared.scale, spacing, strict=True)) == pytest.approx((edge,) * 3)
    assert prepared.mask.shape == tuple(int(n / s + 1e-6) for n, s in zip(shape, prepared.scale, strict=True))
    if min(prepared.mask.shape) > 32:
        assert prepared.thickness == pytest.approx(WORKING_THICKNESS)
    centre = np.array(ndimage.center_of_mass(prepared.mask)[:2]) + 0.5
    middle = np.array(shape[:2]) * spacing[:2] / 2
    assert centre * edge == pytest.approx(middle, abs=0.3 * max(spacing))
    area = prepared.mask.mean(axis=2).sum() * edge**2
    assert area == pytest.approx(np.pi * radius**2, rel=0.25 if radius < 3 * min(spacing) else 0.12)


@pytest.mark.parametrize(("radius", "measured", "law"), [(1.8, 0, 0), (4.4, 1, 1), (7, 1, 0), (11, 0, 0)])
def test_the_grid_is_kept_from_5_to_16_voxels_and_laws_are_read_at_8(radius: float, measured: int, law: int) -> None:
    side = 32 if radius < 3 else 72
    scan = Volume(tube_mask((side, side, side), (1, 1, 1), radius))
    for one_scale, kept in ((False, measured), (True, law)):
        prepared = prepare(scan, one_scale=one_scale)
        assert (prepared.scale == (1, 1, 1)) == any("grid is kept" in note for note in prepared.notes) == bool(kept)
        assert not one_scale or prepared.thickness == pytest.approx(WORKING_THICKNESS, rel=0.03)


@given(st.tuples(*[st.floats(0.4, 3)] * 3), st.tuples(*[st.integers(0, 3)] * 3), st.tuples(*[st.floats(-2, 2)] * 3))
@settings(max_examples=30, deadline=None)
def test_resampling_keeps_linear_functions_of_position(scale, start, slope) -> None:
    old = np.indices((24, 24, 24)) + 0.5  # positions of voxel centres, in old voxels
    shape = [max(1, int(24 / s) - a) for s, a in zip(scale, start, strict=True)]
    values = np.tensordot(slope, old, 1)
    found = resample(values, scale, start, shape)
    new = (np.indices(shape) + np.array(start)[:, None, None, None] + 0.5) * np.array(scale)[:, None, None, None]
    inner = np.all((new > 6) & (new < 18), axis=0)  # the Gaussian bends values near the faces
    assert found[inner] == pytest.approx(np.tensordot(slope, new, 1)[inner], abs=1e-6)


@pytest.mark.slow
def test_periodic_boxes_stay_periodic_when_resampled() -> None:
    shape = (80, 80, 60)
    mask = np.roll(tube_mask(shape, (1, 1, 1), 9.6), 40, axis=0)  # the tube crosses the seam
    rolled, plain = prepare(Volume(mask), periodic=True), prepare(Volume(np.roll(mask, 40, axis=0)), periodic=True)
    assert rolled.grid.boundary == plain.grid.boundary == "periodic"
    assert tuple(n * s for n, s in zip(rolled.mask.shape, rolled.scale, strict=True)) == pytest.approx(shape)
    assert rolled.mask.mean() == pytest.approx(plain.mask.mean(), rel=0.05)
    assert rolled.mask[0, rolled.mask.shape[1] // 2].all() and rolled.mask[-1, rolled.mask.shape[1] // 2].all()


@pytest.mark.slow
def test_specks_and_pinholes_are_dropped() -> None:
    mask = tube_mask((40, 40, 40), (1, 1, 1), 6).copy()
    clean = mask.copy()
    mask[3, 3, 3] = mask[36, 5:7, 30] = True
    mask[20, 20, 10] = False
    prepared = prepare(Volume(mask))
    assert np.array_equal(prepared.mask, clean)
    assert any("specks: 2, pinholes: 1" in note for note in prepared.notes)
    seam = np.zeros((12, 12, 12), bool)
    seam[0, 5, 5] = seam[6, 6, 6] = True
    assert remove_specks(seam, 4, periodic=True)[0].nonzero()[0].tolist() == [0]
    assert remove_specks(seam, 4, periodic=False)[0].sum() == 0


def test_only_the_region_of_interest_counts(tmp_path) -> None:
    mask = tube_mask((40, 40, 40), (1, 1, 1), 5)
    region = np.zeros(mask.shape, np.uint8)
    region[4:36, 4:36, 10:30] = 1
    path = save(Volume(region), tmp_path / "roi.nii")
    for roi in (region, Volume(region), path):
        prepared = prepare(Volume(mask), roi=roi)
        assert prepared.mask.shape == (32, 32, 20) and prepared.origin == (4, 4, 10)
        assert np.array_equal(prepared.mask, mask[4:36, 4:36, 10:30])
    holed = region.copy()
    holed[:, :20] = 0
    holed[4, 4, 10] = 1  # keeps the bounding box
    assert not prepare(Volume(mask), roi=holed).mask[:, :16].any()
    assert any("holds 32.0% of the scan" in note for note in prepared.notes)


@given(st.tuples(*[st.integers(4, 60)] * 3), st.integers(4, 30), st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_boxes_cover_what_there_is(shape, size: int, seed: int) -> None:
    content = np.random.default_rng(seed).random(shape) < 0.01
    seen = np.zeros(shape, bool)
    for box in candidate_boxes(shape, size):
        assert all(s.stop - s.start == min(n, size) for s, n in zip(box, shape, strict=True))
        seen[box] = True
    assert seen.all()
    picked = box_by_surface(content, size)
    assert content[picked].any() if picked else not content.any()


def test_the_middle_comes_first_unless_it_is_poor() -> None:
    content = np.ones((40, 40, 40), bool)
    assert box_by_surface(content, 20) == (slice(10, 30),) * 3
    content[8:32, 8:32, 8:32] = False
    content[:20, :20, :20] = True
    assert box_by_surface(content, 20) == (slice(0, 20),) * 3
    assert box_by_surface(np.zeros((9, 9, 9), bool), 20) is None


THIN, AT = np.zeros(TUBE.shape, np.uint8), np.broadcast_to(np.arange(32) < 8, TUBE.shape).T
THIN[16, 10:12] = 1
FLAT = np.full((16, 16, 16), -0.9, np.float32)
FLAT[3, 3, 3] = -0.8


@pytest.mark.parametrize(
    ("values", "options", "word"),
    [
        (THIN, {}, "thick"), (TUBE, {"roi": AT}, "background"), (TUBE, {"roi": AT[1:]}, "shape"),
        (TUBE, {"roi": np.zeros_like(TUBE)}, "region"), (FLAT, {"kind": "field"}, "background"),
        (np.ones((32, 32, 32), np.uint8), {"kind": "mask"}, "every voxel is structure"),
        (image_of(TUBE), {"threshold": 400.0}, "400"), (image_of(TUBE), {"threshold": "li"}, "otsu"),
        (image_of(TUBE), {"kind": "tube"}, "kind"), (image_of(TUBE)[15:18], {}, "at least 4"),
    ],
)  # fmt: skip
def test_what_has_no_shape_is_refused(values: np.ndarray, options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        prepare(Volume(values), **options)


def test_a_mask_of_one_phase_has_no_thickness() -> None:
    for mask in (np.zeros((8, 8, 8), bool), np.ones((8, 8, 8), bool)):
        with pytest.raises(ValueError, match="one of them only"):
            thinner_thickness(mask)


# ---- real scans ------------------------------------------------------------------------------------------------------


def check(prepared: Prepared) -> None:
    assert prepared.phase.shape == prepared.mask.shape == prepared.grid.shape
    assert np.mean((prepared.phase > 0) == prepared.mask) > 0.99  # single voxels may yield as stairs are smoothed
    assert np.mean(prepared.phase > 0) == pytest.approx(prepared.mask.mean(), rel=0.03)
    assert len(prepared.notes) >= 2 and all(note.endswith(".") for note in prepared.notes)
    assert all(s.stop - s.start <= preparing.LARGEST_WINDOW for s in prepared.window)
    assert 0 < prepared.mask[prepared.window].mean() < 1


def test_bone_is_kept_on_its_grid(data) -> None:
    scan = load(data / "scans" / "lhdl_trabecular_200.tif")
    truth = load(data / "scans" / "lhdl_trabecular_200_otsu_mask.tif").values > 0
    inner = (slice(60, 140),) * 3
    # as the mask's README states, between whole levels
    assert threshold_of(find_structure(scan)[1]) == pytest.approx(84, abs=0.5)
    prepared = prepare(Volume(scan.values[inner], scan.spacing, scan.unit), threshold=84)
    check(prepared)
    assert (prepared.kind, prepared.scale, prepared.working_voxel, prepared.unit) == ("image", (1, 1, 1), 19.5, "um")
    dice = 2 * (prepared.mask & truth[inner]).sum() / (prepared.mask.sum() + truth[inner].sum())
    assert dice > 0.99


@pytest.mark.slow
def test_anisotropic_membranes_become_cubic(data) -> None:
    prepared = prepare(load(data / "scans" / "plantseg_sample_ovule.h5::raw"))
    check(prepared)
    assert prepared.scale[0] * 0.235 == pytest.approx(prepared.scale[1] * 0.15)
    assert prepared.scale[1] == prepared.scale[2]


def test_thin_fibres_are_magnified(data) -> None:
    scan = load(data / "scans" / "quanfima_polymer3d_8bit_128x128x128.raw", raw_shape=(128, 128, 128))
    prepared = prepare(Volume(scan.values[:48, :48, :48]))
    check(prepared)
    assert prepared.thickness == pytest.approx(WORKING_THICKNESS)
    assert max(prepared.scale) < 0.7


@pytest.mark.parametrize("name", ["sponge", "trabec", "weird", "pearls"])
def test_gallery_fields_are_known_as_such(data, name: str) -> None:
    field = load(next((data / "gallery").glob(f"{name} *")))
    assert find_structure(field)[0] == "field"
    if name == "weird":
        prepared = prepare(field, periodic=True)
        check(prepared)
        assert np.array_equal(prepared.phase, field.values)
        assert (prepared.scale, prepared.grid.boundary) == ((1, 1, 1), "periodic")


# ---- imaging ---------------------------------------------------------------------------------------------------------


CUBIC = (1.0, 1.0, 1.0)
Z, Y, _ = np.indices((48, 48, 48)) + 0.5
#: Balls and a tube in a periodic box.
BODIES = ball(48, 15.5, 9) | ball(48, 31.5, 7) | ((Z - 38) ** 2 + (Y - 12) ** 2 < 25)


def image(mask: np.ndarray, blur: float, noise: float) -> np.ndarray:
    """Grey levels 100 and 150, blurred, with white noise of a part of their contrast."""
    filled = ndimage.gaussian_filter(mask.astype(np.float32), blur, mode="wrap")
    return 100 + 50 * (filled + noise * np.random.default_rng(0).standard_normal(mask.shape, dtype=np.float32))


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("blur", [0.5, 1.0, 1.5])
def test_blur_and_noise_are_read_from_grey_levels(blur: float, noise: float) -> None:
    quality = measure_quality(image(BODIES, blur, noise), BODIES, CUBIC)
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
    mask = BODIES[:: int(spacing[0])]
    quality = measure_quality(image(mask, 0.7, 0.2), mask, spacing)
    assert quality.noise == pytest.approx(0.2, rel=0.15) and quality.grain <= 0.5
    assert Quality(0.5, 0.02, 0.0, 0.0, spacing).degraded == (spacing != CUBIC)  # worse than a mask


@pytest.mark.parametrize("grain", [0.7, 1.2])
def test_noise_that_neighbours_share_is_read_with_its_grain(grain: float) -> None:
    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal(BODIES.shape), grain)
    levels = image(BODIES, 1.0, 0.0) + 50 * 0.1 * noise / noise.std()
    quality = measure_quality(levels, BODIES, CUBIC)
    assert quality.noise == pytest.approx(0.1, rel=0.2)
    assert quality.grain == pytest.approx(grain, rel=0.25)


@pytest.mark.parametrize("fat", [1, 2])
def test_a_mask_that_is_too_fat_is_known_as_such(fat: int) -> None:
    """And does not lower the contrast, by which the noise would seem too great."""
    quality = measure_quality(image(BODIES, 1.0, 0.2), ndimage.binary_dilation(BODIES, iterations=fat), CUBIC)
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
    return find_structure(Volume(grey, (float(slices), 1.0, 1.0), "voxel"), kind="image", periodic=True)[1].values > 0


def test_a_sharp_clean_scan_shows_the_shape() -> None:
    seen = shown(Quality(0.5, 0.01, 0.0, 0.0, CUBIC), BODIES)
    beside = np.abs(centre_distance(BODIES, CUBIC, 3.0, periodic=True)) <= 1.5
    assert np.array_equal(seen[~beside], BODIES[~beside])
    assert seen.mean() == pytest.approx(BODIES.mean(), rel=0.05)


def test_noise_moves_the_surface_and_seeds_move_it_differently() -> None:
    noisy = Quality(1.0, 0.4, 0.0, 0.0, CUBIC)
    first, second = (shown(noisy, BODIES, seed) for seed in (0, 1))
    for other in (second, shown(Quality(1.0, 0.0, 0.0, 0.0, CUBIC), BODIES)):
        assert np.count_nonzero(first != other) > 100


@pytest.mark.parametrize("slices", [1, 2])
def test_what_a_scan_without_noise_shows_moves_with_the_shape(slices: int) -> None:
    sharp = Quality(1.0, 0.0, 0.0, 0.0, (float(slices), 1.0, 1.0))
    moved = np.roll(BODIES, (6, 5, 11), (0, 1, 2))
    for show in (lambda shape: shown(sharp, shape, 0, slices), lambda shape: sample_mask(shape, (slices, 1.0, 1.0))):
        difference = show(moved) != np.roll(show(BODIES), (6 // slices, 5, 11), (0, 1, 2))
        assert difference.mean() < 1e-4  # ties at the threshold


def test_voxelised_on_the_same_voxels_is_the_mask_and_thick_slices_lose_a_thin_plate() -> None:
    mask = BODIES.copy()
    assert np.array_equal(sample_mask(mask, CUBIC), mask)
    mask[3] = True
    assert not sample_mask(mask, (4.0, 1.0, 1.0))[0].all()


def test_two_sharp_levels_are_split_in_their_middle() -> None:
    """Otsu's threshold lies anywhere between two sharp levels; at the lower one the structure would be a voxel fat."""
    found = find_structure(Volume(image(BODIES, 0.0, 0.005), CUBIC, "voxel"), kind="image", periodic=True)[1]
    assert threshold_of(found) == pytest.approx(125, abs=2)
    assert np.mean(found.values > 0) == pytest.approx(BODIES.mean(), rel=0.03)


def test_a_threshold_that_decides_is_said() -> None:
    """Of sharp bodies nothing depends on it; blurred by their own width, a tenth of the contrast moves much of them."""
    sharp, soft = (ndimage.gaussian_filter(200.0 * BODIES, width, mode="wrap") for width in (0.3, 2.5))
    found = [find_structure(Volume(levels, CUBIC, "voxel"), kind="image", periodic=True)[1] for levels in (sharp, soft)]
    assert ["look at the outline" in scan.notes[-1] for scan in found] == [False, True]
    more, less = map(float, re.findall(r"(\d+)\s?% (?:more|less)", found[1].notes[-1]))
    values, level = found[1].values, threshold_of(found[1])
    contrast = soft[soft > level].mean() - soft[soft <= level].mean()
    for change, moved in ((more, -0.1), (-less, 0.1)):
        assert np.mean(values > moved * contrast) / np.mean(values > 0) - 1 == pytest.approx(change / 100, abs=0.02)


def test_an_image_knows_its_imaging_and_a_mask_has_none() -> None:
    grey = image(BODIES, 1.0, 0.1)
    scan = prepare(Volume(grey, CUBIC, "voxel"), kind="image", periodic=True)
    dark = prepare(Volume(-grey, CUBIC, "voxel"), kind="image", periodic=True, dark=True)
    assert scan.quality is not None and dark.quality is not None
    assert dark.quality.blur == scan.quality.blur
    assert dark.quality.noise == pytest.approx(scan.quality.noise, rel=0.01)
    assert scan.scan_alike(BODIES, 0).quality == scan.quality  # which made its grey levels
    assert prepare(Volume(BODIES, CUBIC, "voxel"), periodic=True).quality is None


@pytest.mark.parametrize("noise", [0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("blur", [1.0, 1.5])
def test_the_true_share_is_without_what_imaging_adds(blur: float, noise: float) -> None:
    """Thin tubes: their mask is up to half too full, their share less than half as much."""
    z, y, x = np.indices((60, 60, 60)) % 20 - 9.5
    truth = np.minimum(z**2 + y**2, np.minimum(y**2 + x**2, z**2 + x**2)) < 3.2**2
    scan = prepare(Volume(image(truth, blur, noise), CUBIC, "voxel"), kind="image")
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
    scan = prepare(Volume(mask.astype(np.uint8)), kind="mask", periodic=True, one_scale=True)
    assert scan.volume_fraction < 0.99 * mask.mean()
    assert scan.scan_alike(mask, 0).volume_fraction == pytest.approx(scan.volume_fraction, rel=0.01)
    assert scan.true_volume_fraction == pytest.approx(mask.mean(), rel=0.01)
