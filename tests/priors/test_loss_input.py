"""What the training loss takes, warns of and refuses: arguments, targets, masks, numbers at the edge of float32."""

from __future__ import annotations

import contextlib
import copy
import math
import warnings

import numpy as np
import pytest
import torch
from loss_cases import LAW, fit_file, noise, probabilities, slope_of

from curvafit.priors import Coefficients, CombinedLoss, CurvaturePrior, curvature_prior
from curvafit.priors.loss import choose_refinement

# ---- what counts ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ignored_labels_count_nothing(dtype):
    prior, masked = CurvaturePrior("tubes", ignore_index=255), CurvaturePrior("tubes")
    p = probabilities(2, 1, 10, 10, 16).to(dtype)
    labels = torch.zeros(2, 1, 10, 10, 16, dtype=torch.uint8)
    labels[..., 9:] = 255
    labels[1] = 255
    expected = masked(p[:1, ..., :9]) / 2  # what is ignored has a border, as a face has
    torch.testing.assert_close(prior(p, labels), expected, rtol=1e-5, atol=0)
    slope = slope_of(lambda x: prior(x, labels), p)
    assert not bool(slope[..., 9:].any()) and not bool(slope[1].any()) and bool(slope[0, ..., 8].any())


def test_masks_weigh_the_density_and_not_the_field():
    prior, p = CurvaturePrior("tubes", reduction="sum"), probabilities(1, 1, 10, 10, 16)
    left = (torch.arange(16) < 7).double().expand(1, 1, 10, 10, 16)
    torch.testing.assert_close(prior(p, mask=left) + prior(p, mask=1 - left), prior(p), rtol=1e-12, atol=0)
    torch.testing.assert_close(prior(p, mask=0.25 * left), 0.25 * prior(p, mask=left), rtol=1e-12, atol=0)
    flat = torch.ones_like(p)  # no surface, and a masked field would have one
    assert float(prior(flat, mask=left)) == 0


def test_an_empty_mask_is_zero():
    prior, p = CurvaturePrior("tubes"), probabilities(1, 1, 8, 8, 8).float()
    nothing = torch.zeros(1, 1, 8, 8, 8)
    assert float(prior(p, mask=nothing)) == 0 and not bool(slope_of(lambda x: prior(x, mask=nothing), p).any())


def test_each_class_has_its_law_and_weight():
    p = torch.cat([probabilities(2, 1, 8, 9, 10, seed=k) for k in range(3)], 1)
    laws, weights = ("tubes", LAW, "sponge"), (1.0, 0.0, 3.0)
    prior = CurvaturePrior(laws, weight=weights, reduction="none")
    found = prior(p)
    assert found.shape == (2, 3, 1, 1, 1)
    for k, (law, weight) in enumerate(zip(laws, weights, strict=True)):
        alone = CurvaturePrior(law, reduction="none")(p[:, k : k + 1])
        torch.testing.assert_close(found[:, k : k + 1], weight * alone)
    torch.testing.assert_close(CurvaturePrior(laws, weight=weights)(p), found.mean())
    without = CurvaturePrior(laws[1:], include_background=False, reduction="none")
    torch.testing.assert_close(without(p)[:, 1], found[:, 2] / 3)


def test_two_class_softmax_is_the_sigmoid_of_the_difference():
    logits = noise(2, 2, 8, 8, 8)
    two = CurvaturePrior("tubes", softmax=True, include_background=False)
    one = CurvaturePrior("tubes", sigmoid=True)
    torch.testing.assert_close(two(logits), one(logits[:, 1:] - logits[:, :1]))


def trained(law: str, share: float, epsilon: float | None = None) -> list[float]:
    """Dice of a tube of 2 × 2 voxels and of a sheet of 2 after a training with labels on every fourth slice across.

    The logits begin near the truth, so that between the labels there is nothing but the prior to lose it.
    """
    target = torch.zeros(2, 1, 16, 16, 16)
    target[0, 0, 7:9, 7:9] = target[1, 0, 7:9] = 1
    logits = 4 * target - 2 + noise(*target.shape, dtype=torch.float32) / 2
    prior = CurvaturePrior(law, sigmoid=True, epsilon=epsilon)

    def base(values, truth):
        return torch.nn.functional.binary_cross_entropy_with_logits(values[..., ::4], truth[..., ::4])

    weight = prior.suggest_weight(base, (logits, target), share)
    adam = torch.optim.Adam([logits.requires_grad_()], lr=0.2)
    for _ in range(400):
        adam.zero_grad()
        (base(logits, target) + weight * prior(logits)).backward()
        adam.step()
    found, truth = (logits > 0).flatten(1), (target > 0).flatten(1)
    return (2 * (found & truth).sum(1) / (found.sum(1) + truth.sum(1))).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("law", ["trabec", "tubes"])
def test_a_structure_two_voxels_thick_survives_a_share_of_a_tenth(law):
    """And the tube does not survive equal gradients, least of all at an ε of 8 voxels: the labels do not hold it."""
    assert min(trained(law, 0.1)) > 0.9
    assert trained(law, 1.0)[0] < 0.7
    if law == "trabec":
        assert trained(law, 1.0, epsilon=8.0)[0] < 0.55


# ---- beside other losses --------------------------------------------------------------------------------------------


def test_the_suggested_weight_balances_gradients():
    base = torch.nn.BCEWithLogitsLoss()
    prior, logits = CurvaturePrior("tubes", sigmoid=True), noise(1, 1, 8, 8, 8, dtype=torch.float32)
    target = (noise(1, 1, 8, 8, 8, seed=1) > 0).float()
    weight = prior.suggest_weight(base, (logits, target), share=0.3)
    ours, theirs = slope_of(prior, logits).norm(), slope_of(lambda x: base(x, target), logits).norm()
    assert float(weight * ours) == pytest.approx(0.3 * float(theirs), rel=1e-5)
    with pytest.raises(ValueError, match="gradient"):
        prior.suggest_weight(base, (torch.full_like(logits, 1e4), target))


def test_it_can_be_copied():
    prior = CurvaturePrior(("tubes", "sponge"), weight=(1, 2), spacing=(1, 1, 2), epsilon=4.0)
    p = probabilities(1, 2, 8, 8, 8)
    assert torch.equal(copy.deepcopy(prior)(p), prior(p))
    assert "epsilon=4" in repr(prior)


# ---- wrong input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigmoid": True, "softmax": True}, "expected sigmoid or softmax, got both"),
        ({"reduction": "max"}, "reduction"),
        ({"spacing": (1, 0, 1)}, "expected a spacing of 3 positive numbers"),
        ({"epsilon": -1.0}, "expected epsilon > 0"),
        ({"border": 0.5}, "expected a border of whole voxels"),
        ({"weight": -1}, "expected a weight from 0"),
        ({"weight": None}, "expected a weight from 0 to 1e.09, or one for each class, got None"),
        ({"shape": (8, 8)}, "expected a shape of 3 whole numbers"),
    ],
)
def test_wrong_arguments_are_said(options, message):
    with pytest.raises(ValueError, match=message):
        CurvaturePrior("tubes", **options)


def test_wrong_laws_are_said(tmp_path):
    with pytest.raises(ValueError, match="preset"):
        CurvaturePrior("tubs")
    with pytest.raises(FileNotFoundError, match="no file"):
        CurvaturePrior(tmp_path / "fit.json")
    with pytest.raises(ValueError, match="numbers"):
        CurvaturePrior(Coefficients(torch.ones(2), 1, 1))
    with pytest.raises(ValueError, match="one law"):
        CurvaturePrior(("tubes", "sponge"))(torch.rand(1, 1, 8, 8, 8))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 1, 1, 16, 16), "at least 4 voxels"),
        ((1, 16, 16, 16), "expected an input of floats .B, N, D, H, W."),
        ((0, 1, 8, 8, 8), "expected an input of floats .B, N, D, H, W., got torch.float32 .0, 1, 8, 8, 8."),
    ],
)
def test_flat_input_is_refused(shape, message):
    with pytest.raises(ValueError, match=message):
        CurvaturePrior("tubes")(torch.rand(shape))
    with pytest.raises(ValueError, match="input"):
        CurvaturePrior("tubes")(torch.ones((1, 1, 8, 8, 8), dtype=torch.int64))


def test_wrong_targets_and_masks_are_said():
    p, prior = torch.rand(2, 2, 8, 8, 8), CurvaturePrior("tubes", ignore_index=2)
    for target in (None, torch.ones(2, 2, 8, 8, 8)):
        with pytest.raises(ValueError, match="target"):
            prior(p, target)
    with pytest.raises(ValueError, match="target"):
        prior(p, torch.ones(2, 1, 8, 8, 4))
    for shape in ((2, 3, 8, 8, 8), (3, 1, 8, 8, 8), (0, 1, 8, 8, 8), (2, 1, 8, 8, 1), (2, 8, 8, 8)):
        with pytest.raises(ValueError, match="mask"):
            prior(p, torch.ones(2, 1, 8, 8, 8), mask=torch.ones(shape))
    with pytest.raises(ValueError, match="target"):
        CurvaturePrior("tubes", to_onehot_y=True)(p, torch.ones(2, 2, 8, 8, 8))


@pytest.mark.parametrize("option", [{"softmax": True}, {"include_background": False}])
def test_what_a_single_channel_ignores_is_said(option):
    p = probabilities(1, 1, 8, 8, 8)
    with pytest.warns(UserWarning, match="single channel"):
        found = CurvaturePrior("tubes", **option)(p)
    assert torch.equal(found, CurvaturePrior("tubes")(p))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mask_that_asks_for_a_gradient_is_refused(dtype):
    probability = torch.rand((1, 1, 8, 8, 8), generator=torch.Generator().manual_seed(0)).to(dtype)
    mask = torch.ones_like(probability, requires_grad=True)
    with pytest.raises(ValueError, match="detach"):
        CurvaturePrior("tubes")(probability, mask=mask)


# ---- any number is finite or refused ---------------------------------------------------------------------------------


HOSTILE = (
    *(sign * size for sign in (1, -1) for size in (1e-300, 1e-30, 1e-6, 0.0, 1.0, 1e6, 1e30, 1e300, math.inf)),
    math.nan, 10**400, True, None, "1", b"1", [], {}, (1.0, 1.0), 1j, object(), np.float32(2), torch.tensor(2.0),
)  # fmt: skip


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


@pytest.mark.parametrize("option", ["epsilon", "spacing", "weight", "border", "shape"])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_any_number_is_finite_or_refused(option) -> None:
    taken = [finite_or_a_sentence(lambda value=value: CurvaturePrior(LAW, **{option: value})) for value in HOSTILE]
    assert not all(taken)


@pytest.mark.parametrize("name", ["a20", "a11", "a02", "a10", "a01", "a00"])
@pytest.mark.parametrize("spacing", [1.0, 1e-9, 1e9])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_any_coefficient_is_finite_or_refused(name, spacing) -> None:
    """In any unit of length: what counts is the product with ε."""
    taken = []
    for value in HOSTILE:
        given = {"a20": 1.0, "a11": 1.0, "a02": 1.0, name: value}
        taken.append(finite_or_a_sentence(lambda given=given: CurvaturePrior(Coefficients(**given), spacing=spacing)))
    assert any(taken) and not all(taken)


@pytest.mark.parametrize("spacing", [(1e-12, 1.0, 1.0), (1.0, 1.0, 1e-12), (1e12, 1e12, 1e11), (1e-6, 1e-5, 1.0)])
@pytest.mark.parametrize("epsilon", [None, 1e-12, 1e-5, 1.0, 1e4, 1e12])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_any_voxel_is_finite_or_refused(spacing, epsilon) -> None:
    finite_or_a_sentence(lambda: CurvaturePrior("tubes", spacing=spacing, epsilon=epsilon))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"epsilon": 1e30}, "expected epsilon > 0 in spacing's unit, at most 10000, got 1e.30"),
        ({"epsilon": 11.0}, "expected an ε of at most the window's longest side, 10, got 11"),
    ],
)
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_lengths_beyond_the_window_are_refused(options, said) -> None:
    with pytest.raises(ValueError, match=said):
        CurvaturePrior("tubes", **options)(probabilities(1, 1, 8, 9, 10))


@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_products_beyond_float32_are_refused() -> None:
    """With what is too large, by name; as the function does."""
    law = Coefficients(1, 1, 1, a00=1e7)
    with pytest.raises(ValueError, match="a00"):
        CurvaturePrior(law)
    with pytest.raises(ValueError, match="a00"):
        curvature_prior(probabilities(1, 8, 9, 10), law, (1.0, 1.0, 1.0), 2.0)


@pytest.mark.parametrize("value", [1e300, math.inf, math.nan, -1.0])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_masks_beyond_float32_are_refused(value) -> None:
    p = probabilities(1, 1, 8, 9, 10)
    mask = torch.ones_like(p)
    mask[..., 3] = value
    with pytest.raises(ValueError, match="mask"):
        CurvaturePrior("tubes")(p.float(), mask=mask)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_a_lost_value_is_warned_of_and_shows_in_the_loss(value, dtype) -> None:
    """Not among the probabilities that are promised: said once, and the loss is not a number."""
    prior, p = CurvaturePrior("tubes"), probabilities(1, 1, 8, 9, 10).to(dtype)
    p[0, 0, 4, 4, 4] = value
    with pytest.warns(UserWarning, match="probabilities"):
        assert not bool(torch.isfinite(prior(p)))
    assert not bool(torch.isfinite(prior(p)))


@pytest.mark.parametrize("value", HOSTILE)
@pytest.mark.parametrize("option", ["weight", "warmup"])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
def test_any_weight_beside_another_loss_is_finite_or_refused(option, value) -> None:
    try:
        CombinedLoss(torch.nn.MSELoss(), CurvaturePrior("tubes"), **{option: value})
    except ValueError as error:
        assert str(error).startswith("expected a ") and "\n" not in str(error)


# ---- ε and units ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [(1.003, 1, 1.003), (0.8, 0.76, 0.76), (1, 1, 1.1)])
def test_an_axis_a_little_coarser_is_not_interpolated(spacing):
    assert choose_refinement(CurvaturePrior("tubes", spacing=spacing).spacing, 2 * min(spacing)) == (1, 1, 1)


def test_other_axes_have_two_voxels_to_epsilon():
    assert choose_refinement((1.11, 1.0, 1.0), 2.0) == (2, 1, 1)
    assert choose_refinement((5.0, 0.994, 3.0), 1.988) == (6, 1, 4)
    assert choose_refinement((16.0, 2.0, 1.0), 2.0) == (16, 2, 1)


@pytest.mark.parametrize(("spacing", "epsilon"), [(1.0, 0.02), ((16.1, 1.0, 1.0), 2.0)])
def test_no_axis_is_interpolated_more_than_16_fold(spacing, epsilon):
    with pytest.raises(ValueError, match="fold"):
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
    with pytest.raises(ValueError, match="unit"):
        CurvaturePrior(law, unit="furlong")
    with pytest.warns(UserWarning, match="unit changes nothing") if law == "tubes" else contextlib.nullcontext():
        prior = CurvaturePrior(law, unit="mm")
    assert prior.coefficients == CurvaturePrior(law).coefficients


# ---- range ----------------------------------------------------------------------------------------------------------


def test_logits_taken_for_probabilities_are_said_once():
    logits, prior = noise(1, 1, 8, 8, 8), CurvaturePrior("tubes")
    prior(probabilities(1, 1, 8, 8, 8) * 1.001)
    with pytest.warns(UserWarning, match="sigmoid"):
        prior(logits)
    prior(logits)  # a warning is an error here
    CurvaturePrior("tubes", sigmoid=True)(logits)
    CurvaturePrior("tubes", softmax=True)(logits.expand(1, 2, 8, 8, 8))


def test_logits_are_no_break_in_a_compiled_graph():
    prior = CurvaturePrior("tubes", shape=(16, 16, 16))
    compiled = torch.compile(prior, backend="aot_eager", fullgraph=True)
    value, mask = noise(1, 1, 8, 8, 8, dtype=torch.float32), torch.ones(1, 1, 8, 8, 8)
    with pytest.warns(UserWarning, match="probabilities"):
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
    with pytest.raises(ValueError, match="mask"):
        CurvaturePrior("tubes")(torch.rand(1, 1, 8, 8, 8), mask=mask)


# ---- derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:ε = 2")
def test_a_look_without_gradients_leaves_later_ones_alone():
    """With an interpolated axis, whose weights are kept between calls; of a size no other test has."""
    prior, p = CurvaturePrior("tubes", spacing=(2.0, 1.0, 1.0)), probabilities(1, 1, 11, 9, 9)
    with torch.inference_mode():
        prior(p)
    assert bool(slope_of(prior, p).any())


# ---- deep supervision -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "options"), [((3, 8, 8), {}), ((4, 8, 8), {"border": 2}), ((8, 8, 4), {"shape": (8, 8, 80)})]
)
def test_a_level_too_coarse_is_zero(shape, options):
    whole = {"shape": (32, 32, 32)} | options
    prior, value = CurvaturePrior(("tubes", LAW), reduction="none", **whole), torch.rand(2, 2, *shape)
    with pytest.warns(UserWarning, match="coarse"):
        found = prior(value.requires_grad_())
    assert found.shape == (2, 2, 1, 1, 1) and not bool(found.any())
    found.sum().backward()
    assert value.grad is not None and not bool(value.grad.any())
    prior(value)  # said once
