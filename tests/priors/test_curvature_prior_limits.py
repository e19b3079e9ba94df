"""The curvature prior: numbers of any size and kind give a finite loss, or one sentence that says what was expected."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from loss_cases import LAW, probabilities, slope_of

from curvafit.priors import Coefficients, CombinedLoss, CurvaturePrior, curvature_prior

HOSTILE = (
    *(sign * size for sign in (1, -1) for size in (1e-300, 1e-30, 1e-6, 0.0, 1.0, 1e6, 1e30, 1e300, math.inf)),
    math.nan, 10**400, True, None, "1", b"1", [], {}, (1.0, 1.0), 1j, object(), np.float32(2), torch.tensor(2.0),
)  # fmt: skip
pytestmark = [
    pytest.mark.filterwarnings("ignore:ε = .* interpolating"),
    pytest.mark.filterwarnings("ignore:a20 > 0"),
]


def finite_or_a_sentence(loss) -> bool:
    """Whether a loss could be made and had a finite value and gradient; else the refusal is one sentence."""
    p = probabilities(1, 1, 8, 9, 10).float()
    try:
        made = loss()
        value, slope = made(p), slope_of(made, p)
    except ValueError as error:
        said = str(error)
        assert said.startswith("expected ") and "\n" not in said and ", got " in said, said
        return False
    assert bool(torch.isfinite(value)) and bool(torch.isfinite(slope).all())
    return True


@pytest.mark.parametrize("option", ["epsilon", "blur", "spacing", "weight", "border", "shape"])
def test_any_number_is_finite_or_refused(option) -> None:
    taken = [finite_or_a_sentence(lambda value=value: CurvaturePrior(LAW, **{option: value})) for value in HOSTILE]
    assert not all(taken)


@pytest.mark.parametrize("name", ["a20", "a11", "a02", "a10", "a01", "a00"])
@pytest.mark.parametrize("spacing", [1.0, 1e-9, 1e9])
def test_any_coefficient_is_finite_or_refused(name, spacing) -> None:
    """In any unit of length: what counts is the product with ε."""
    taken = []
    for value in HOSTILE:
        given = {"a20": 1.0, "a11": 1.0, "a02": 1.0, name: value}
        taken.append(finite_or_a_sentence(lambda given=given: CurvaturePrior(Coefficients(**given), spacing=spacing)))
    assert any(taken) and not all(taken)


@pytest.mark.parametrize("spacing", [(1e-12, 1.0, 1.0), (1.0, 1.0, 1e-12), (1e12, 1e12, 1e11), (1e-6, 1e-5, 1.0)])
@pytest.mark.parametrize("epsilon", [None, 1e-12, 1e-5, 1.0, 1e4, 1e12])
def test_any_voxel_is_finite_or_refused(spacing, epsilon) -> None:
    finite_or_a_sentence(lambda: CurvaturePrior("tubes", spacing=spacing, epsilon=epsilon))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"epsilon": 1e30}, "expected epsilon > 0 in spacing's unit, at most 10000, got 1e.30"),
        ({"blur": 1e6}, "expected blur >= 0 in spacing's unit, at most 10000, got 1000000.0"),
        ({"epsilon": 11.0}, "expected an ε of at most the window's longest side, 10, got 11"),
        ({"blur": 11.0}, "expected a blur of at most the window's longest side, 10, got 11"),
    ],
)
def test_lengths_beyond_the_window_are_refused(options, said) -> None:
    with pytest.raises(ValueError, match=said):
        CurvaturePrior("tubes", **options)(probabilities(1, 1, 8, 9, 10))


def test_products_beyond_float32_are_refused() -> None:
    """With what is too large, by name; as the function does."""
    law = Coefficients(1, 1, 1, a00=1e7)
    with pytest.raises(ValueError, match=r"expected \|a00\| epsilon² of at most 1e\+06, got 4e\+07"):
        CurvaturePrior(law)
    with pytest.raises(ValueError, match=r"expected \|a00\| epsilon² of at most 1e\+06, got 4e\+07"):
        curvature_prior(probabilities(1, 8, 9, 10), law, (1.0, 1.0, 1.0), 2.0)


@pytest.mark.parametrize("value", [1e300, math.inf, math.nan, -1.0])
def test_masks_beyond_float32_are_refused(value) -> None:
    p = probabilities(1, 1, 8, 9, 10)
    mask = torch.ones_like(p)
    mask[..., 3] = value
    with pytest.raises(ValueError, match=r"expected a mask of finite numbers from 0, at most 1e\+09, got others"):
        CurvaturePrior("tubes")(p.float(), mask=mask)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_lost_value_is_warned_of_and_shows_in_the_loss(value, dtype) -> None:
    """Not among the probabilities that are promised: said once, and the loss is not a number."""
    prior, p = CurvaturePrior("tubes"), probabilities(1, 1, 8, 9, 10).to(dtype)
    p[0, 0, 4, 4, 4] = value
    with pytest.warns(UserWarning, match="expected probabilities, got"):
        assert not bool(torch.isfinite(prior(p)))
    assert not bool(torch.isfinite(prior(p)))


@pytest.mark.parametrize("value", HOSTILE)
@pytest.mark.parametrize("option", ["weight", "warmup"])
def test_any_weight_beside_another_loss_is_finite_or_refused(option, value) -> None:
    try:
        CombinedLoss(torch.nn.MSELoss(), CurvaturePrior("tubes"), **{option: value})
    except ValueError as error:
        assert str(error).startswith("expected a ") and "\n" not in str(error)
