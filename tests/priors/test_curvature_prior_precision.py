"""The curvature prior: the fused kernels, masks, blur and interpolation against what they stand for."""

from __future__ import annotations

import pytest
import torch
from loss_cases import LAW, noise, probabilities, slope_of

from curvafit.priors import CurvaturePrior, Grid, curvature_prior
from curvafit.priors.stencils import gaussian_blur, refine_axis

pytestmark = pytest.mark.filterwarnings("ignore:ε = .* interpolating")


@pytest.mark.parametrize(
    "options",
    [
        {"normalize": "area"},
        {"normalize": "area", "spacing": (0.75, 0.25, 0.25)},
        {"spacing": (0.75, 0.25, 0.25)},
        {"spacing": 0.25, "blur": 0.3},
        {"normalize": "area", "spacing": (0.75, 0.25, 0.25), "blur": 0.3, "reduction": "sum"},
    ],
)
def test_float32_is_float64(options):
    """Values and gradients of the fused kernels and of the definition, per class, under a mask of each class."""
    prior = CurvaturePrior((LAW, "tubes"), **options)
    p = torch.cat([probabilities(2, 1, 9, 12, 11, seed=k) for k in range(2)], 1)
    mask = noise(2, 2, 9, 12, 11, seed=3).abs()
    exact, found = (slope_of(lambda x: prior(x, mask=mask), p.to(kind)) for kind in (torch.float64, torch.float32))
    torch.testing.assert_close(prior(p.float(), mask=mask).double(), prior(p, mask=mask), rtol=2e-5, atol=0)
    assert found.dtype == torch.float32
    error = (found.double() - exact).abs() / exact.abs().max()
    assert error.quantile(0.9) < 2e-6 and error.max() < 1e-2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("include", [True, False])
def test_every_class_has_its_own_mask(dtype, include):
    p = torch.cat([probabilities(2, 1, 8, 9, 10, seed=k) for k in range(3)], 1).to(dtype)
    mask = torch.rand(2, 3, 8, 9, 10, generator=torch.Generator().manual_seed(0))
    found = CurvaturePrior("tubes", include_background=include, reduction="none")(p, mask=mask)
    for k, column in zip(range(3 - found.shape[1], 3), found.unbind(1), strict=True):
        alone = CurvaturePrior("tubes", reduction="none")(p[:, k : k + 1], mask=mask[:, k : k + 1])
        torch.testing.assert_close(column, alone[:, 0])


@pytest.mark.parametrize("normalize", ["voxel", "area"])
def test_blur_is_in_the_unit_of_the_spacing(normalize):
    p, spacing = probabilities(1, 1, 10, 11, 12), (0.3, 0.25, 0.25)
    blurred = gaussian_blur(p, Grid((10, 11, 12), spacing, "replicate"), 0.4)
    found = CurvaturePrior("tubes", spacing=spacing, epsilon=0.6, blur=0.4, normalize=normalize)(p)
    expected = CurvaturePrior("tubes", spacing=spacing, epsilon=0.6, normalize=normalize)(blurred)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("normalize", ["voxel", "area", None])
def test_an_interpolated_axis_is_a_finer_grid(dtype, normalize):
    p, spacing = probabilities(2, 8, 10, 10).to(dtype), (3.0, 1.0, 1.0)
    mask = torch.rand(2, 8, 10, 10, generator=torch.Generator().manual_seed(0)).to(dtype)
    fine, parts = (refine_axis(2 * p - 1, 0, 3) + 1) / 2, mask.repeat_interleave(3, 1)
    found = curvature_prior(p, LAW, spacing, 2.0, mask=mask, normalize=normalize, border=0)
    expected = curvature_prior(fine, LAW, (1.0, 1.0, 1.0), 2.0, mask=parts, normalize=normalize, border=0)
    torch.testing.assert_close(found, expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=0)
