"""The curvature prior: what it computes, whatever the window, the sampling, the labels and the precision."""

from __future__ import annotations

import copy
import json
import math

import pytest
import torch
from torch import Tensor

from curvafit.priors import Coefficients, CurvaturePrior, Grid, curvature_prior, energy, optimal_profile, preset
from curvafit.priors.refined import refined
from curvafit.priors.stencils import gaussian_blur

TUBES, _, _ = preset("tubes")
LAW = Coefficients(1.3, -0.7, 4.0, -0.6, 0.35, 0.05)


def noise(*shape: int, seed: int = 0, dtype=torch.float64) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def probabilities(*shape: int, seed: int = 0) -> Tensor:
    """Smooth, with interfaces."""
    grid = Grid(shape[-3:], 1.0, "replicate")
    return torch.sigmoid(14 * gaussian_blur(noise(*shape, seed=seed), grid, 1.5))


def ball(shape: tuple[int, int, int], spacing: tuple[float, float, float], radius: float, epsilon: float) -> Tensor:
    """The phase field of a ball in the middle of a box, `(1, 1, Z, Y, X)`."""
    axes = (h * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n, h in zip(shape, spacing, strict=True))
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return optimal_profile(radius - (z**2 + y**2 + x**2).sqrt(), epsilon)[None, None]


def slope_of(loss, value: Tensor) -> Tensor:
    leaf = value.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(leaf).sum(), leaf)
    return slope


# ---- the value -------------------------------------------------------------------------------------------------------


def test_the_sum_is_the_energy_of_the_interior():
    spacing, epsilon = (1.2, 1.0, 0.9), 2.5
    p = probabilities(2, 12, 11, 10)
    inside = torch.zeros(12, 11, 10)
    inside[1:-1, 1:-1, 1:-1] = 1
    expected = energy(2 * p - 1, LAW, Grid((12, 11, 10), spacing, "replicate"), epsilon, mask=inside)
    # In other units of length: the offsets ξ in the definition are numbers, and nowhere felt.
    found = curvature_prior(p, LAW, spacing, epsilon, normalize=None)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)
    prior = CurvaturePrior(LAW, spacing=spacing, epsilon=epsilon, reduction="sum")
    torch.testing.assert_close(prior(p[:, None]), found.sum())


def test_a_preset_is_in_working_units_of_the_finest_axis():
    u = ball((14, 14, 14), (0.01, 0.01, 0.01), 0.05, 0.02)
    mask = torch.zeros(14, 14, 14)
    mask[1:-1, 1:-1, 1:-1] = 1
    expected = energy(u[0], TUBES, Grid((14, 14, 14), 0.01, "replicate"), 0.02, mask=mask)
    prior = CurvaturePrior("tubes", spacing=0.35, reduction="sum")
    assert prior.epsilon == 0.7
    torch.testing.assert_close(prior((u + 1) / 2), expected.sum(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("normalize", ["voxel", "area"])
def test_a_change_of_unit_changes_nothing(normalize):
    p = probabilities(1, 1, 10, 10, 12)
    micro = CurvaturePrior(LAW, spacing=(2.0, 1.0, 1.0), epsilon=4.0, normalize=normalize)
    milli = CurvaturePrior(LAW.in_unit(1e3), spacing=(2e-3, 1e-3, 1e-3), epsilon=4e-3, normalize=normalize)
    torch.testing.assert_close(micro(p), milli(p), rtol=1e-10, atol=0)


def fit_file(path, unit: str):
    fit = {"format": "curvafit-fit-1", "mass": -0.3, "epsilon_physical": 4.0, "working_voxel": 2.0, "length_unit": unit}
    fit["coefficients"] = TUBES.as_dict()
    fit["coefficients_physical"] = TUBES.in_unit(1 / 200).as_dict()
    path.write_text(json.dumps(fit))
    return path


def test_a_fit_is_in_its_own_unit_or_converted(tmp_path):
    path = fit_file(tmp_path / "fit.json", "um")
    (law,) = CurvaturePrior(path, spacing=2.0).coefficients
    assert tuple(law) == pytest.approx(tuple(TUBES.in_unit(1 / 200)))
    (law,) = CurvaturePrior(str(path), spacing=2e-3, unit="mm").coefficients
    assert tuple(law) == pytest.approx(tuple(TUBES.in_unit(1e3 / 200)))
    with pytest.raises(ValueError, match="expected two units among nm, um, mm, m, got voxel and the fit's um"):
        CurvaturePrior(path, unit="voxel")


def test_area_is_that_of_the_interface():
    """On a ball of radius R ≫ ε the energy per area is p(1/R, 1/R) ε², but for an error in (Δx/ε)² and (ε/R)²."""
    radius, epsilon = 16.0, 2.0
    u = ball((44, 44, 44), (1.0, 1.0, 1.0), radius, epsilon)
    willmore = CurvaturePrior(Coefficients.willmore(), epsilon=epsilon, normalize="area")
    assert float(willmore((u + 1) / 2)) == pytest.approx(4 * (epsilon / radius) ** 2, rel=0.02)


# ---- windows ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spacing", "border"), [((1.0, 1.0, 1.0), 1), ((2.0, 1.0, 1.0), 2)])
def test_tiles_add_up_to_the_interior_of_the_whole(spacing, border):
    p = probabilities(1, 1, 12, 20, 20)
    with pytest.warns(UserWarning, match="z 2-fold") if spacing[0] > 1 else no_warning():
        prior = CurvaturePrior("tubes", spacing=spacing, border=border, reduction="sum")
    inner = 8 if border == 2 else 9
    tiles = [
        p[..., y : min(20, y + inner + 2 * border), x : min(20, x + inner + 2 * border)]
        for y in range(0, 20 - 2 * border, inner)
        for x in range(0, 20 - 2 * border, inner)
    ]
    assert len(tiles) == 4 and all(tile.shape != p.shape for tile in tiles)
    torch.testing.assert_close(sum(prior(tile) for tile in tiles), prior(p), rtol=1e-10, atol=0)


class no_warning:
    def __enter__(self) -> None: ...
    def __exit__(self, *_) -> None: ...


def test_the_mean_compares_across_patch_sizes():
    """Patches of a repeating pattern: the energies go with the volume, the means do not."""
    cell = 2 * probabilities(16, 16, 16) - 1
    whole = (gaussian_blur(cell.repeat(3, 3, 3), Grid((48, 48, 48), 1.0), 1.0)[None, None] + 1) / 2
    mean, total = CurvaturePrior("tubes"), CurvaturePrior("tubes", reduction="sum")
    sizes = (18, 34)
    patches = [whole[..., 8 : 8 + n, 8 : 8 + n, 8 : 8 + n] for n in sizes]
    means, sums = ([float(prior(patch)) for patch in patches] for prior in (mean, total))
    assert means[0] == pytest.approx(means[1], rel=1e-9)
    assert sums[1] == pytest.approx(8 * sums[0], rel=1e-9)


def test_the_level_of_a_deep_supervision_has_its_own_spacing():
    p = probabilities(1, 1, 8, 8, 8)
    level = CurvaturePrior("tubes", spacing=0.5, epsilon=2.0, shape=(8, 16, 16))
    with pytest.warns(UserWarning, match="interpolating"):
        CurvaturePrior("tubes", spacing=(0.5, 1.0, 1.0), epsilon=1.0)
    coarse = CurvaturePrior(level.coefficients[0], spacing=(0.5, 1.0, 1.0), epsilon=2.0)
    torch.testing.assert_close(level(p), coarse(p))
    fine = probabilities(1, 1, 8, 16, 16)
    torch.testing.assert_close(level(fine), CurvaturePrior("tubes", spacing=0.5, epsilon=2.0)(fine))


# ---- anisotropy ------------------------------------------------------------------------------------------------------


def ball_energy(times: int, epsilon: float) -> float:
    """F_ε / σ of a ball on a grid `times` coarser along z."""
    from curvafit.priors import SIGMA

    spacing = (float(times), 1.0, 1.0)
    n = 48 // times
    u = ball((n, 48, 48), spacing, 14.0, epsilon)
    value = curvature_prior((u[0] + 1) / 2, Coefficients.willmore(), spacing, epsilon, normalize=None)
    return float(value) / SIGMA


def test_a_resampled_volume_has_the_same_energy():
    """Where the grid resolves ε the error of second differences is (Δz/ε)², so twice as coarse is four times as wrong;
    where it is interpolated (Δz = ε) the cubic's third order leaves a few per cent, of either sign."""
    epsilon = 4.0
    fine, coarse = ball_energy(1, epsilon), ball_energy(2, epsilon)
    exact = 16 * math.pi
    finest = ball_energy(1, epsilon) + (ball_energy(1, epsilon) - ball_energy(2, epsilon)) / 3
    assert abs(coarse / finest - 1) < 0.06
    assert (coarse - finest) / (fine - finest) == pytest.approx(4, rel=1e-6)
    assert finest == pytest.approx(exact, rel=0.15)
    assert ball_energy(4, epsilon) == pytest.approx(fine, rel=0.08)


def test_cubic_convolution_keeps_parabolas():
    z = torch.arange(12, dtype=torch.float64)
    fine = (torch.arange(36, dtype=torch.float64) + 0.5) / 3 - 0.5
    inside = slice(6, -6)
    for law in (lambda t: 0 * t + 2, lambda t: 3 * t - 1, lambda t: t**2 - 4 * t):
        found = refined(law(z)[None, :, None, None].expand(2, 12, 4, 5), 0, 3)
        assert found.shape == (2, 36, 4, 5)
        torch.testing.assert_close(found[1, inside, 2, 3], law(fine)[inside])


# ---- gradients and precision -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalize", ["voxel", "area"])
@pytest.mark.parametrize("options", [{}, {"spacing": (2.0, 1.0, 1.0), "epsilon": 2.0}, {"blur": 0.7}])
@pytest.mark.filterwarnings("ignore:ε = 2")
def test_gradcheck(normalize, options):
    prior = CurvaturePrior("tubes", softmax=True, normalize=normalize, **options)
    logits = noise(1, 2, 6, 5, 7).requires_grad_()
    assert torch.autograd.gradcheck(prior, (logits,))


def test_the_fused_kernels_have_the_gradient_of_the_definition():
    prior = CurvaturePrior("tubes", sigmoid=True, spacing=(1.5, 1.0, 1.0), epsilon=3.0)
    logits = 3 * gaussian_blur(noise(2, 2, 20, 18, 33), Grid((20, 18, 33), 1.0, "replicate"), 1.0)
    mask = (noise(2, 1, 20, 18, 33, seed=5) > -0.5).double()
    exact = slope_of(lambda x: prior(x, mask=mask), logits)
    found = slope_of(lambda x: prior(x, mask=mask), logits.float())
    torch.testing.assert_close(prior(logits.float(), mask=mask).double(), prior(logits, mask=mask), rtol=1e-5, atol=0)
    error = (found.double() - exact).abs() / exact.abs().max()
    assert error.quantile(0.9) < 1e-6 and error.max() < 1e-2


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_autocast_changes_nothing(kind):
    """Half-precision logits are computed with in float32, inside autocast and out of it; large ones stay finite."""
    prior = CurvaturePrior("tubes", sigmoid=True)
    logits = (40 * noise(1, 2, 8, 8, 8, dtype=torch.float32)).to(kind)
    expected = prior(logits.float())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = prior(logits)
        slope = slope_of(prior, logits)
    assert found.dtype == torch.float32 and torch.equal(found, expected)
    assert slope.dtype == kind and bool(torch.isfinite(slope).all()) and bool(slope.any())


@pytest.mark.parametrize("value", [0.0, 1e4, -1e4])
@pytest.mark.parametrize("normalize", ["voxel", "area"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_or_saturated_input_is_harmless(value, normalize, dtype):
    prior = CurvaturePrior("trabec", sigmoid=True, normalize=normalize)
    logits = torch.full((1, 1, 8, 8, 8), value, dtype=dtype)
    assert bool(torch.isfinite(prior(logits))) and bool(torch.isfinite(slope_of(prior, logits)).all())
    checkered = torch.where(noise(1, 1, 8, 8, 8) > 0, 1e4, -1e4).to(dtype)
    assert bool(torch.isfinite(prior(checkered))) and bool(torch.isfinite(slope_of(prior, checkered)).all())


def test_it_is_deterministic():
    prior, logits = CurvaturePrior("tubes", sigmoid=True), noise(2, 1, 20, 20, 20, dtype=torch.float32)
    assert torch.equal(prior(logits), prior(logits))
    assert torch.equal(slope_of(prior, logits), slope_of(prior, logits))


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


def test_a_structure_two_voxels_thick_survives():
    """A tube of 2 × 2 voxels and a sheet of 2, learnt by cross-entropy with the prior at equal gradient, default ε."""
    target = torch.zeros(2, 1, 16, 16, 16)
    target[0, 0, 7:9, 7:9] = target[1, 0, 7:9] = 1
    base, prior = torch.nn.BCEWithLogitsLoss(), CurvaturePrior("trabec", sigmoid=True)
    logits = noise(*target.shape, dtype=torch.float32)
    weight = prior.suggest_weight(base, (logits, target))
    logits.requires_grad_()
    adam = torch.optim.Adam([logits], lr=0.1)
    for _ in range(100):
        adam.zero_grad()
        (base(logits, target) + weight * prior(logits, target)).backward()
        adam.step()
    assert torch.equal(logits > 0, target > 0)


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
        ({"shape": (8, 8)}, "expected shape as 3 numbers"),
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
    with pytest.raises(ValueError, match="expected one coefficients or 1, one a class that counts, got 2"):
        CurvaturePrior(("tubes", "sponge"))(torch.rand(1, 1, 8, 8, 8))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 1, 1, 16, 16), "expected a volume of at least 4 voxels along each axis, got .1, 16, 16."),
        ((1, 16, 16, 16), "expected an input of floats .B, N, D, H, W."),
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
        with pytest.raises(ValueError, match="expected a target .* with labels 2 to ignore"):
            prior(p, target)
    with pytest.raises(ValueError, match="expected a target of shape"):
        prior(p, torch.ones(2, 1, 8, 8, 4))
    with pytest.raises(ValueError, match="expected a mask of shape"):
        prior(p, torch.ones(2, 1, 8, 8, 8), mask=torch.ones(2, 3, 8, 8, 8))
    with pytest.raises(ValueError, match="expected a target of class numbers"):
        CurvaturePrior("tubes", to_onehot_y=True)(p, torch.ones(2, 2, 8, 8, 8))


@pytest.mark.parametrize("option", [{"softmax": True}, {"include_background": False}])
def test_what_a_single_channel_ignores_is_said(option):
    p = probabilities(1, 1, 8, 8, 8)
    with pytest.warns(UserWarning, match="single channel prediction"):
        found = CurvaturePrior("tubes", **option)(p)
    assert torch.equal(found, CurvaturePrior("tubes")(p))
