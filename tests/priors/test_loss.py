"""The training loss is the energy: of windows, classes, units, masks and both types of float."""

from __future__ import annotations

import math

import pytest
import torch
from loss_cases import LAW, TUBES, fit_file, noise, probabilities, slope_of
from torch import Tensor

from curvafit.priors import Coefficients, CurvaturePrior, Grid, curvature_prior, energy, optimal_profile
from curvafit.priors.stencils import gaussian_blur, refine_axis


def ball(shape: tuple[int, int, int], spacing: tuple[float, float, float], radius: float, epsilon: float) -> Tensor:
    """The phase field of a ball in the middle of a box, `(1, 1, Z, Y, X)`."""
    axes = (h * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n, h in zip(shape, spacing, strict=True))
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return optimal_profile(radius - (z**2 + y**2 + x**2).sqrt(), epsilon)[None, None]


# ---- the value ------------------------------------------------------------------------------------------------------


def test_the_sum_is_the_energy_of_the_interior():
    spacing, epsilon = (1.2, 1.0, 0.9), 2.5
    p = probabilities(2, 12, 11, 10)
    inside = torch.zeros(12, 11, 10)
    inside[1:-1, 1:-1, 1:-1] = 1
    expected = energy(2 * p - 1, LAW, Grid((12, 11, 10), spacing, "replicate"), epsilon, mask=inside)
    # In other units of length: the offsets ξ in the definition are numbers, and nowhere felt.
    found = curvature_prior(p, LAW, spacing, epsilon, normalize=False)
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


def test_a_change_of_unit_changes_nothing():
    p = probabilities(1, 1, 10, 10, 12)
    micro = CurvaturePrior(LAW, spacing=(2.0, 1.0, 1.0), epsilon=4.0)
    milli = CurvaturePrior(LAW.in_unit(1e3), spacing=(2e-3, 1e-3, 1e-3), epsilon=4e-3)
    torch.testing.assert_close(micro(p), milli(p), rtol=1e-10, atol=0)


def test_a_fit_is_in_its_own_unit_or_converted(tmp_path):
    path = fit_file(tmp_path / "fit.json", "um")
    (law,) = CurvaturePrior(path, spacing=2.0).coefficients
    assert tuple(law) == pytest.approx(tuple(TUBES.in_unit(1 / 200)))
    (law,) = CurvaturePrior(str(path), spacing=2e-3, unit="mm").coefficients
    assert tuple(law) == pytest.approx(tuple(TUBES.in_unit(1e3 / 200)))
    with pytest.raises(ValueError, match="units"):
        CurvaturePrior(path, unit="voxel")


def test_a_fit_in_doubt_warns(tmp_path):
    with pytest.warns(UserWarning, match="is not `Supported`"):
        CurvaturePrior(fit_file(tmp_path / "fit.json", "um", "No believable twin (refined): …"), spacing=2.0)
    CurvaturePrior(fit_file(tmp_path / "fit.json", "um", "Supported (refined): …"), spacing=2.0)


# ---- windows --------------------------------------------------------------------------------------------------------


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


# ---- anisotropy -----------------------------------------------------------------------------------------------------


def ball_energy(times: int, epsilon: float) -> float:
    """F_ε / σ of a ball on a grid `times` coarser along z."""
    from curvafit.priors import SIGMA

    spacing = (float(times), 1.0, 1.0)
    n = 48 // times
    u = ball((n, 48, 48), spacing, 14.0, epsilon)
    value = curvature_prior((u[0] + 1) / 2, Coefficients.willmore(), spacing, epsilon, normalize=False)
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


@pytest.mark.parametrize("times", [2, 3])
def test_the_quintic_spline_is_of_sixth_order_under_mirrors(times):
    """Of a cosine that the mirrors at both ends continue: twice the samples, 2⁶ times less error. An odd refinement
    keeps the samples themselves."""

    def error(n: int) -> float:
        u = torch.cos(math.pi * 3 * (torch.arange(n, dtype=torch.float64) + 0.5) / n)
        fine = refine_axis(u[None, :, None, None].expand(2, n, 4, 5), 0, times)[1, :, 2, 3]
        exact = torch.cos(math.pi * 3 * (torch.arange(n * times, dtype=torch.float64) + 0.5) / (n * times))
        if times == 3:
            torch.testing.assert_close(fine[1::3], u)
        return float((fine - exact).abs().max())

    assert error(20) / error(40) == pytest.approx(64, rel=0.15)


def test_interpolation_has_an_exact_adjoint():
    u, v = noise(2, 9, 5, 6), noise(2, 27, 5, 6, seed=1)
    leaf = u.clone().requires_grad_()
    (back,) = torch.autograd.grad(refine_axis(leaf, 0, 3), leaf, v)
    assert float((refine_axis(u, 0, 3) * v).sum()) == pytest.approx(float((u * back).sum()), rel=1e-12)


@pytest.mark.parametrize("law", [Coefficients.willmore(), Coefficients(1, 2, 6, -0.4, -0.4, 0.04)])
@pytest.mark.parametrize("turn", [0.0, 0.9])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating")
def test_thick_slices_up_to_epsilon_keep_the_energy(law, turn):
    """An exact torus, ε = 2, along z and turned: slices of 1.5 and 2, refined to .75 and 1, where the stencils' own
    error, of the order of (Δ/ε)², parts by 3 %; twice as thick as ε they are said."""

    def total(step: float) -> float:
        n = int(48 // step)
        z, y, x = step * (torch.arange(n) - (n - 1) / 2), torch.arange(48) - 23.5, torch.arange(48) - 23.5
        z, y, x = torch.meshgrid(z.double(), y.double(), x.double(), indexing="ij")
        z, x = math.cos(turn) * z + math.sin(turn) * x, math.cos(turn) * x - math.sin(turn) * z
        u = optimal_profile(5 - (((x**2 + y**2).sqrt() - 12) ** 2 + z**2).sqrt(), 2.0)
        prior = CurvaturePrior(law, spacing=(step, 1.0, 1.0), epsilon=2.0, reduction="sum")
        return float(prior((u + 1)[None, None] / 2))

    fine = total(1.0)
    for step in (1.5, 2.0):
        assert total(step) == pytest.approx(fine, rel=0.05)
    with pytest.warns(UserWarning, match="inflate"):
        total(4.0)


# ---- gradients and precision ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"spacing": (2.0, 1.0, 1.0), "epsilon": 2.0}, {"reduction": "sum"}])
@pytest.mark.filterwarnings("ignore:ε = 2")
def test_gradcheck(options):
    prior = CurvaturePrior("tubes", softmax=True, **options)
    logits = noise(1, 2, 6, 5, 7).requires_grad_()
    assert torch.autograd.gradcheck(prior, (logits,), fast_mode=True)


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
@pytest.mark.filterwarnings("ignore:ε = 2")
def test_autocast_changes_nothing(kind):
    """Half-precision logits are computed with in float32, inside autocast and out of it; large ones stay finite.

    An interpolated axis is a matrix product, which autocast would do in half precision.
    """
    prior = CurvaturePrior("tubes", sigmoid=True, spacing=(2.0, 1.0, 1.0))
    logits = (40 * noise(1, 2, 8, 8, 8, dtype=torch.float32)).to(kind)
    expected = prior(logits.float())
    with torch.autocast("cpu", dtype=kind):
        found = prior(logits)
        slope = slope_of(prior, logits)
    assert found.dtype == torch.float32 and torch.equal(found, expected)
    assert slope.dtype == kind and bool(torch.isfinite(slope).all()) and bool(slope.any())


@pytest.mark.parametrize("value", [0.0, 1e4, -1e4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_or_saturated_input_is_harmless(value, dtype):
    prior = CurvaturePrior("trabec", sigmoid=True)
    logits = torch.full((1, 1, 8, 8, 8), value, dtype=dtype)
    assert bool(torch.isfinite(prior(logits))) and bool(torch.isfinite(slope_of(prior, logits)).all())
    checkered = torch.where(noise(1, 1, 8, 8, 8) > 0, 1e4, -1e4).to(dtype)
    assert bool(torch.isfinite(prior(checkered))) and bool(torch.isfinite(slope_of(prior, checkered)).all())


def test_it_is_deterministic():
    prior, logits = CurvaturePrior("tubes", sigmoid=True), noise(2, 1, 20, 20, 20, dtype=torch.float32)
    assert torch.equal(prior(logits), prior(logits))
    assert torch.equal(slope_of(prior, logits), slope_of(prior, logits))


# ---- float32 is float64 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"spacing": (0.75, 0.25, 0.25)},
        {"spacing": (0.75, 0.25, 0.25), "reduction": "sum"},
    ],
)
@pytest.mark.filterwarnings("ignore:ε = .* interpolating")
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
@pytest.mark.filterwarnings("ignore:ε = .* interpolating")
def test_every_class_has_its_own_mask(dtype, include):
    p = torch.cat([probabilities(2, 1, 8, 9, 10, seed=k) for k in range(3)], 1).to(dtype)
    mask = torch.rand(2, 3, 8, 9, 10, generator=torch.Generator().manual_seed(0))
    found = CurvaturePrior("tubes", include_background=include, reduction="none")(p, mask=mask)
    for k, column in zip(range(3 - found.shape[1], 3), found.unbind(1), strict=True):
        alone = CurvaturePrior("tubes", reduction="none")(p[:, k : k + 1], mask=mask[:, k : k + 1])
        torch.testing.assert_close(column, alone[:, 0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.filterwarnings("ignore:ε = .* interpolating")
def test_an_interpolated_axis_is_a_finer_grid(dtype, normalize):
    p, spacing = probabilities(2, 8, 10, 10).to(dtype), (3.0, 1.0, 1.0)
    mask = torch.rand(2, 8, 10, 10, generator=torch.Generator().manual_seed(0)).to(dtype)
    fine, parts = (refine_axis(2 * p - 1, 0, 3) + 1) / 2, mask.repeat_interleave(3, 1)
    found = curvature_prior(p, LAW, spacing, 2.0, mask=mask, normalize=normalize, border=0)
    expected = curvature_prior(fine, LAW, (1.0, 1.0, 1.0), 2.0, mask=parts, normalize=normalize, border=0)
    torch.testing.assert_close(found, expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=0)
