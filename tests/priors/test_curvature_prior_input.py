"""The curvature prior: what of its input counts, what stands beside it, and what it refuses."""

from __future__ import annotations

import copy

import pytest
import torch
from loss_cases import LAW, noise, probabilities, slope_of

from curvafit.priors import Coefficients, CurvaturePrior

# ---- what counts -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ignored_labels_count_nothing(dtype):
    prior, masked = CurvaturePrior("tubes", ignore_index=255), CurvaturePrior("tubes")
    p = probabilities(2, 1, 10, 10, 16).to(dtype)
    labels = torch.zeros(2, 1, 10, 10, 16, dtype=torch.uint8)
    labels[..., 9:] = 255
    labels[1] = 255
    expected = masked(p[:1, ..., :10]) / 2
    torch.testing.assert_close(prior(p, labels), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(prior(p, labels), masked(p, mask=labels != 255))
    slope = slope_of(lambda x: prior(x, labels), p)
    assert not bool(slope[..., 10:].any()) and not bool(slope[1].any()) and bool(slope[0, ..., 8].any())


def test_masks_weigh_the_density_and_not_the_field():
    prior, p = CurvaturePrior("tubes", reduction="sum"), probabilities(1, 1, 10, 10, 16)
    left = (torch.arange(16) < 7).double().expand(1, 1, 10, 10, 16)
    torch.testing.assert_close(prior(p, mask=left) + prior(p, mask=1 - left), prior(p), rtol=1e-12, atol=0)
    torch.testing.assert_close(prior(p, mask=0.25 * left), 0.25 * prior(p, mask=left), rtol=1e-12, atol=0)
    flat = torch.ones_like(p)  # no surface, and a masked field would have one
    assert float(prior(flat, mask=left)) == 0


@pytest.mark.parametrize("normalize", ["voxel", "area"])
def test_an_empty_mask_is_zero(normalize):
    prior, p = CurvaturePrior("tubes", normalize=normalize), probabilities(1, 1, 8, 8, 8).float()
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


# ---- beside other losses ---------------------------------------------------------------------------------------------


def test_the_suggested_weight_balances_gradients():
    base = torch.nn.BCEWithLogitsLoss()
    prior, logits = CurvaturePrior("tubes", sigmoid=True), noise(1, 1, 8, 8, 8, dtype=torch.float32)
    target = (noise(1, 1, 8, 8, 8, seed=1) > 0).float()
    weight = prior.suggest_weight(base, (logits, target), share=0.3)
    ours, theirs = slope_of(prior, logits).norm(), slope_of(lambda x: base(x, target), logits).norm()
    assert float(weight * ours) == pytest.approx(0.3 * float(theirs), rel=1e-5)
    with pytest.raises(ValueError, match="expected a batch on which both losses have a gradient"):
        prior.suggest_weight(base, (torch.full_like(logits, 1e4), target))


def test_it_can_be_copied():
    prior = CurvaturePrior(("tubes", "sponge"), weight=(1, 2), spacing=(1, 1, 2), epsilon=4.0)
    p = probabilities(1, 2, 8, 8, 8)
    assert torch.equal(copy.deepcopy(prior)(p), prior(p))
    assert "epsilon=4" in repr(prior)


# ---- wrong input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigmoid": True, "softmax": True}, "expected sigmoid or softmax, got both"),
        ({"reduction": "max"}, "expected a reduction among"),
        ({"normalize": "volume"}, "normalize among"),
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
    with pytest.raises(ValueError, match=r"expected a preset among .* got 'tubs'"):
        CurvaturePrior("tubs")
    with pytest.raises(FileNotFoundError, match=r"expected a fit\.json, found no file"):
        CurvaturePrior(tmp_path / "fit.json")
    with pytest.raises(ValueError, match="expected coefficients that are numbers"):
        CurvaturePrior(Coefficients(torch.ones(2), 1, 1))
    with pytest.raises(ValueError, match=r"expected one law, or one for each class that counts \(1 in all\), got 2"):
        CurvaturePrior(("tubes", "sponge"))(torch.rand(1, 1, 8, 8, 8))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 1, 1, 16, 16), "expected a volume of at least 4 voxels along each axis, got .1, 16, 16."),
        ((1, 16, 16, 16), "expected an input of floats .B, N, D, H, W."),
        ((0, 1, 8, 8, 8), "expected an input of floats .B, N, D, H, W., got torch.float32 .0, 1, 8, 8, 8."),
    ],
)
def test_flat_input_is_refused(shape, message):
    with pytest.raises(ValueError, match=message):
        CurvaturePrior("tubes")(torch.rand(shape))
    with pytest.raises(ValueError, match="expected an input of floats"):
        CurvaturePrior("tubes")(torch.ones((1, 1, 8, 8, 8), dtype=torch.int64))


def test_wrong_targets_and_masks_are_said():
    p, prior = torch.rand(2, 2, 8, 8, 8), CurvaturePrior("tubes", ignore_index=2)
    for target in (None, torch.ones(2, 2, 8, 8, 8)):
        with pytest.raises(ValueError, match="expected a target .* with label 2 on ignored voxels"):
            prior(p, target)
    with pytest.raises(ValueError, match="expected a target of shape"):
        prior(p, torch.ones(2, 1, 8, 8, 4))
    for shape in ((2, 3, 8, 8, 8), (3, 1, 8, 8, 8), (0, 1, 8, 8, 8), (2, 1, 8, 8, 1), (2, 8, 8, 8)):
        with pytest.raises(ValueError, match=r"expected a mask of shape \(2 or 1, 2 or 1, 8, 8, 8\), got"):
            prior(p, torch.ones(2, 1, 8, 8, 8), mask=torch.ones(shape))
    with pytest.raises(ValueError, match="expected a target of class numbers"):
        CurvaturePrior("tubes", to_onehot_y=True)(p, torch.ones(2, 2, 8, 8, 8))


@pytest.mark.parametrize("option", [{"softmax": True}, {"include_background": False}])
def test_what_a_single_channel_ignores_is_said(option):
    p = probabilities(1, 1, 8, 8, 8)
    with pytest.warns(UserWarning, match="single channel prediction"):
        found = CurvaturePrior("tubes", **option)(p)
    assert torch.equal(found, CurvaturePrior("tubes")(p))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mask_that_asks_for_a_gradient_is_refused(dtype):
    probability = torch.rand((1, 1, 8, 8, 8), generator=torch.Generator().manual_seed(0)).to(dtype)
    mask = torch.ones_like(probability, requires_grad=True)
    with pytest.raises(ValueError, match="expected a mask that asks for no gradient, got one that does: detach it"):
        CurvaturePrior("tubes")(probability, mask=mask)
