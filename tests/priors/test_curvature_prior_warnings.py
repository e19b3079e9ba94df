"""The curvature prior: numbers that cannot be meant, in the wrong unit or range, are refused or said."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from loss_cases import LAW, fit_file, noise, probabilities, slope_of

from curvafit.priors import CurvaturePrior
from curvafit.priors.loss import upsampling

# ---- ε and units -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [(1.003, 1, 1.003), (0.8, 0.76, 0.76), (1, 1, 1.1)])
def test_an_axis_a_little_coarser_is_not_interpolated(spacing):
    assert upsampling(CurvaturePrior("tubes", spacing=spacing).spacing, 2 * min(spacing)) == (1, 1, 1)


def test_other_axes_have_two_voxels_to_epsilon():
    assert upsampling((1.11, 1.0, 1.0), 2.0) == (2, 1, 1)
    assert upsampling((5.0, 0.994, 3.0), 1.988) == (6, 1, 4)
    assert upsampling((16.0, 2.0, 1.0), 2.0) == (16, 2, 1)


@pytest.mark.parametrize(("spacing", "epsilon"), [(1.0, 0.02), ((16.1, 1.0, 1.0), 2.0)])
def test_no_axis_is_interpolated_more_than_16_fold(spacing, epsilon):
    with pytest.raises(ValueError, match=r"expected an ε of at least .* refined (100|17)-fold"):
        CurvaturePrior("tubes", spacing=spacing, epsilon=epsilon)


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_an_epsilon_far_from_the_fit_s_is_said(tmp_path, factor):
    path = fit_file(tmp_path / "fit.json", "um")  # its ε is 4 um
    for good in (1.01, 3.9):
        CurvaturePrior(path, spacing=good * 2e-3, unit="mm")
        CurvaturePrior(path, spacing=2 / good)
    with pytest.warns(UserWarning, match=r"ε is .* mm here and was 0.004 mm in the fit: state spacing and its unit"):
        CurvaturePrior(path, spacing=factor * 2e-3, unit="mm")


@pytest.mark.parametrize("law", ["tubes", LAW])
def test_an_unknown_unit_is_said(law):
    with pytest.raises(ValueError, match="expected a unit among nm, um, mm, m, got 'furlong'"):
        CurvaturePrior(law, unit="furlong")
    assert CurvaturePrior(law, unit="mm").coefficients == CurvaturePrior(law).coefficients


# ---- range -----------------------------------------------------------------------------------------------------------


def test_logits_taken_for_probabilities_are_said_once():
    logits, prior = noise(1, 1, 8, 8, 8), CurvaturePrior("tubes")
    prior(probabilities(1, 1, 8, 8, 8) * 1.001)
    with pytest.warns(UserWarning, match="expected probabilities, got -.* sigmoid or softmax missing"):
        prior(logits)
    prior(logits)  # a warning is an error here
    CurvaturePrior("tubes", sigmoid=True)(logits)
    CurvaturePrior("tubes", softmax=True)(logits.expand(1, 2, 8, 8, 8))


def test_logits_are_no_break_in_a_compiled_graph():
    prior = CurvaturePrior("tubes", shape=(16, 16, 16))
    compiled = torch.compile(prior, backend="aot_eager", fullgraph=True)
    value, mask = noise(1, 1, 8, 8, 8, dtype=torch.float32), torch.ones(1, 1, 8, 8, 8)
    with pytest.warns(UserWarning, match="expected probabilities"):
        expected = prior(value)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`", UserWarning)
        torch.testing.assert_close(compiled(value, mask=mask), expected)


@pytest.mark.parametrize("weight", [np.float32(2), torch.tensor(2.0), np.array([2.0]), [torch.tensor(2.0)], 2])
def test_weights_are_numbers_of_any_kind(weight):
    assert CurvaturePrior("tubes", weight=weight).weight == (2.0,)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_a_mask_is_finite_and_from_0(value):
    mask = torch.ones(1, 1, 8, 8, 8)
    mask[0, 0, 4, 4, 4] = value
    with pytest.raises(ValueError, match="expected a mask of finite numbers from 0"):
        CurvaturePrior("tubes")(torch.rand(1, 1, 8, 8, 8), mask=mask)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def hessian_product(dtype: torch.dtype, vector: torch.Tensor, normalize: str) -> torch.Tensor:
    prior = CurvaturePrior("tubes", sigmoid=True, normalize=normalize)  # type: ignore[arg-type]
    logits = noise(1, 1, 6, 6, 6).to(dtype).requires_grad_()
    (slope,) = torch.autograd.grad(prior(logits), logits, create_graph=True)
    assert torch.equal(slope, slope_of(prior, logits))
    return torch.autograd.grad((slope * vector).sum(), logits)[0]


@pytest.mark.parametrize("normalize", ["voxel", "area"])
def test_second_derivatives_are_right_or_refused(normalize):
    vector = noise(1, 1, 6, 6, 6, seed=1)
    with pytest.raises(RuntimeError, match="expected first derivatives of F_ε in float32, got a second one"):
        hessian_product(torch.float32, vector.float(), normalize)
    prior, logits, step = CurvaturePrior("tubes", sigmoid=True, normalize=normalize), noise(1, 1, 6, 6, 6), 1e-5
    ends = [slope_of(prior, logits + sign * step * vector) for sign in (1, -1)]
    found = hessian_product(torch.float64, vector, normalize)
    torch.testing.assert_close(found, (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-4 * float(found.abs().max()))


@pytest.mark.filterwarnings("ignore:ε = 2")
def test_a_look_without_gradients_leaves_later_ones_alone():
    """With an interpolated axis, whose weights are kept between calls; of a size no other test has."""
    prior, p = CurvaturePrior("tubes", spacing=(2.0, 1.0, 1.0)), probabilities(1, 1, 11, 9, 9)
    with torch.inference_mode():
        prior(p)
    assert bool(slope_of(prior, p).any())


# ---- deep supervision ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "options"), [((3, 8, 8), {}), ((4, 8, 8), {"border": 2}), ((8, 8, 4), {"shape": (8, 8, 80)})]
)
def test_a_level_too_coarse_is_zero(shape, options):
    whole = {"shape": (32, 32, 32)} | options
    prior, value = CurvaturePrior(("tubes", LAW), reduction="none", **whole), torch.rand(2, 2, *shape)
    with pytest.warns(UserWarning, match="a level of .* voxels is too coarse for ε = 2, so its loss is 0"):
        found = prior(value.requires_grad_())
    assert found.shape == (2, 2, 1, 1, 1) and not bool(found.any())
    found.sum().backward()
    assert value.grad is not None and not bool(value.grad.any())
    prior(value)  # said once
