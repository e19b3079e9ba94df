"""Segmentation without a network: evidence, units, grids, and shapes that come out better."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from found import made_fit
from scipy import ndimage
from skimage.filters import threshold_otsu

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset
from curvafit.segmentation.evidence import GreyEvidence, VoxelEvidence, estimate_classes, grey_evidence, grey_levels
from curvafit.segmentation.flow import WorkingGrid
from curvafit.segmentation.segment import segment
from curvafit.segmentation.trials import dice, law_of
from curvafit.volumes.boxes import boxes_of
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()


def tubes(n: int = 32) -> np.ndarray:
    """Two crossing tubes and a ball, none thinner than six voxels."""
    z, y, x = np.mgrid[:n, :n, :n] - n / 2 + 0.5
    first, second = np.hypot(z + 8, y) < 4, np.hypot(z - 0.3 * y - 3, x - 4) < 3.5
    return first | second | (z**2 + (y + 9) ** 2 + (x + 9) ** 2 < 25)


def noisy(mask: np.ndarray, noise: float, **place) -> Field:
    values = 30 + 100 * mask + noise * np.random.default_rng(1).standard_normal(mask.shape)
    return Field(values.astype(np.float32), **place)


# ---- evidence --------------------------------------------------------------------------------------------------------


def of_intensities(scan: Field, threshold: float | str = "otsu", dark: bool = False) -> VoxelEvidence:
    values = grey_levels(scan, threshold)
    return grey_evidence(values, scan, estimate_classes(values, scan, threshold, dark))


def test_intensities_find_the_classes_and_the_noise() -> None:
    truth = tubes()
    found = of_intensities(noisy(truth, 25))
    ideal = (noisy(truth, 25).values - 80) * 100 / 25**2
    inner = ndimage.binary_erosion(truth, iterations=2) | ndimage.binary_erosion(~truth, iterations=2, border_value=1)
    slope = np.polyfit(ideal[inner], found.ratio[inner], 1)
    assert slope == pytest.approx([1, 0], abs=0.15)
    dark = of_intensities(dataclasses.replace(noisy(truth, 25), values=200 - noisy(truth, 25).values), dark=True)
    np.testing.assert_allclose(dark.ratio, found.ratio, rtol=0.02, atol=0.1)


def test_classes_that_overlap_are_measured_apart() -> None:
    """Otsu's halves hold some of both phases, so that their means are nearer to each other: off the surface they are
    not."""
    scan = boxes_of(noisy(tubes(48), 250))
    found = GreyEvidence.of(scan, apart=True)
    assert found.first.faint and GreyEvidence.of(scan).classes == found.first
    assert abs(found.classes.middle - 80) < abs(found.first.middle - 80) / 1.3
    clear = GreyEvidence.of(boxes_of(noisy(tubes(), 25)), apart=True)
    assert clear.classes == clear.first


def test_a_rare_structure_needs_a_threshold_and_is_told_so() -> None:
    ball = np.linalg.norm(np.mgrid[:48, :48, :48] - 23.5, axis=0) < 2.9
    scan, said = noisy(ball, 10), "give a threshold"
    assert said in " ".join(segment(scan, weight=1.0, steps=1).notes)
    assert said not in " ".join(segment(noisy(tubes(), 60), weight=1.0, steps=1).notes)
    given = segment(scan, threshold=80.0, steps=30)
    assert said not in " ".join(given.notes) and dice(given.mask.values, ball) > 0.9
    assert given.status.startswith("no prior helps here") and given.coefficients is None and given.weight is None
    found = of_intensities(scan, 80.0)
    assert dice(found.level > 0, ball) > 0.9
    assert np.median(found.ratio[ball]) > 40 > -40 > np.median(found.ratio[~ball])


# ---- units and grids -------------------------------------------------------------------------------------------------


def test_a_prior_comes_in_the_scan_s_unit(tmp_path: Path) -> None:
    fit = made_fit()
    path = tmp_path / "fit.json"
    path.write_text(fit.to_json())
    mm, um = (Field(np.zeros((4, 4, 4)), (h,) * 3, unit) for h, unit in ((0.0195, "mm"), (19.5, "um")))
    assert law_of(path, mm)[0] == fit.coefficients_physical
    law, notes = law_of(str(path), um)
    assert law.as_dict() == pytest.approx(fit.coefficients_physical.in_unit(1e-3).as_dict())
    assert "mm" in notes[0] and "um" in notes[0]
    with pytest.raises(ValueError, match="--unit"):
        law_of(path, Field(np.zeros((4, 4, 4))))
    with pytest.raises(ValueError, match="preset"):
        law_of("tube", mm)
    with pytest.raises(FileNotFoundError):
        law_of(tmp_path / "none.json", mm)
    working = law_of("tubes", um)[0].in_unit(19.5 / 0.01)
    assert working.as_dict() == pytest.approx(preset("tubes").coefficients.as_dict())


@pytest.mark.parametrize(("status", "count"), [("Supported (refined): …", 0), ("No believable twin (refined): …", 1)])
def test_a_prior_that_is_not_supported_is_said_to_be_so(status: str, count: int) -> None:
    mm = Field(np.zeros((4, 4, 4)), (0.0195,) * 3, "mm")
    fit = dataclasses.replace(made_fit(), status=status)
    assert law_of(fit, mm)[1] == (f"{fit.to_law().doubt} Compare the mask with the scan.",) * count


def test_axes_are_refined_and_brought_back() -> None:
    place = WorkingGrid.of(Field(np.zeros((6, 7, 8)), (2.5, 1.0, 1.0)), None)
    assert place.times == (3, 1, 1) and place.grid.shape == (18, 7, 8) and place.epsilon == 2
    assert min(place.grid.spacing) * 100 == pytest.approx(2.5 / 3)
    values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    shared = place.spread(values)
    assert float(shared.sum()) == pytest.approx(float(values.sum()), rel=1e-5)
    np.testing.assert_allclose(place.to_scan(3 * shared), values, rtol=1e-6)
    held = place.spread(values, centre=0)
    np.testing.assert_array_equal(held[1::3].numpy(), values)
    assert not held[0::3].any() and not held[2::3].any()


@pytest.mark.parametrize("scale", [1e-3, 40.0])
def test_a_segmentation_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    truth = tubes(24)
    law = preset("tubes").coefficients.in_unit(0.01)
    one = segment(noisy(truth, 60), law, weight=2.0, steps=100)
    other = segment(noisy(truth, 60, spacing=(scale,) * 3), law.in_unit(1 / scale), weight=2.0, steps=100)
    assert one.weight == pytest.approx(other.weight, rel=1e-4)
    assert (one.mask.values != other.mask.values).mean() < 1e-3


# ---- what comes out --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_noisy_tubes_come_out_better_than_from_a_threshold_at_any_smoothing() -> None:
    truth = tubes()
    scan = noisy(truth, 90, spacing=(0.02,) * 3, unit="mm", affine=np.diag([-0.02, 0.02, 0.02, 1]))
    found = segment(scan, steps=100)
    others = []
    for width in (0, 0.7, 1, 1.5, 2, 3):
        smooth = ndimage.gaussian_filter(scan.values, width)
        others.append(dice(smooth > threshold_otsu(smooth), truth))
    assert dice(found.mask.values, truth) > max(others) + 0.01
    assert found.mask.spacing == scan.spacing and found.mask.unit == "mm"
    assert np.array_equal(found.mask.affine, scan.affine)  # type: ignore[arg-type]
    assert found.mask.values.dtype == bool and np.array_equal(found.mask.values, found.phase.values > 0)
    assert found.coefficients == WILLMORE and found.weight == 0.3


@pytest.mark.slow
def test_anisotropic_scans_keep_their_grid() -> None:
    truth = tubes(36)[1::3]
    scan = noisy(truth, 40, spacing=(3.0, 1.0, 1.0))
    found = segment(scan, WILLMORE, steps=100)
    assert found.mask.shape == truth.shape and found.mask.spacing == (3.0, 1.0, 1.0)
    assert any("z 3-fold" in note for note in found.notes)
    assert dice(found.mask.values, truth) > 0.93


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"weight": 0.0}, "weight"),
        ({"threshold": 500.0}, "threshold"),
        ({"threshold": "li"}, "otsu"),
        ({"epsilon": math.inf}, "epsilon"),
        ({"prior": Coefficients(torch.ones(32, 32, 32), 0, 1)}, "coefficients"),
    ],
)
def test_bad_options_are_refused(options, said) -> None:
    with pytest.raises(ValueError, match=said):
        segment(noisy(tubes(), 30), **{"prior": WILLMORE, **options})


def test_a_scan_with_holes_is_refused() -> None:
    scan = noisy(tubes(), 30)
    scan.values[3, 4, 5:7] = math.nan, math.inf
    with pytest.raises(ValueError, match="finite"):
        segment(scan, WILLMORE)


@pytest.mark.filterwarnings("ignore:a20 > 0:UserWarning")
def test_a_prior_without_stiffness_is_refused() -> None:
    with pytest.raises(ValueError, match="a20"):
        segment(noisy(tubes(), 30), Coefficients(1, 0, -2))


def test_a_prior_s_scale_does_not_matter_but_its_weight_does() -> None:
    """But for voxels at the surface: the two flows round otherwise."""
    scan = noisy(tubes(), 60)
    one, thrice = (segment(scan, WILLMORE.scale(by), weight=1 / by, steps=100) for by in (1, 3))
    assert (one.mask.values != thrice.mask.values).mean() < 1e-3
    weak, strong = (segment(scan, WILLMORE, weight=weight, steps=100).mask.values for weight in (0.01, 30))
    bright = scan.values > 80
    assert (weak == bright).mean() > (strong == bright).mean() + 0.001


def test_a_prior_that_is_too_strong_says_so() -> None:
    ball = np.linalg.norm(np.mgrid[:20, :20, :20] - 9.5, axis=0) < 4
    found = segment(noisy(ball, 30), Coefficients(1, 2, 1, 0, 0, 1.0), weight=1e4, steps=400)
    assert found.status.startswith("no surface is left") and not found.mask.values.any()
