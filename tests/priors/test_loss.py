"""The training loss is the energy, of windows, classes, units, masks, types of float; what it takes and refuses."""

import contextlib
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from loss_cases import LAW, TUBES, fit_file, noise, probabilities, slope_of
from torch import Tensor
from torch.testing import assert_close

from curvafit.priors import Coefficients, CurvaturePrior, Grid, curvature_prior, energy, optimal_profile
from curvafit.priors.coefficients import NAMES
from curvafit.priors.loss import choose_refinement
from curvafit.priors.profile import refine_profile
from curvafit.priors.stencils import gaussian_blur, refine_axis

pytestmark = pytest.mark.filterwarnings("ignore:ε = .* interpolating", "ignore:a20 > 0")
types = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def radii(shape: tuple[int, int, int], spacing: tuple[float, float, float]) -> tuple[Tensor, ...]:
    """Places (z, y, x) of voxel centres, from the middle of a box."""
    axes = (h * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n, h in zip(shape, spacing, strict=True))
    return torch.meshgrid(*axes, indexing="ij")


# ---- the value ------------------------------------------------------------------------------------------------------


def interior(*shape: int) -> Tensor:
    mask = torch.zeros(shape)
    mask[1:-1, 1:-1, 1:-1] = 1
    return mask


def test_the_sum_is_the_energy_of_the_interior():
    """A preset is in working units of the finest axis; the offsets ξ in the definition are numbers, nowhere felt."""
    spacing, epsilon, grid = (1.2, 1.0, 0.9), 2.5, Grid((12, 11, 10), (1.2, 1.0, 0.9), "replicate")
    p = probabilities(2, 12, 11, 10)
    expected = energy(2 * p - 1, LAW, grid, epsilon, mask=interior(12, 11, 10))
    found = curvature_prior(p, LAW, spacing, epsilon, normalize=False)
    assert_close(found, expected, rtol=1e-4, atol=0)
    assert_close(CurvaturePrior(LAW, spacing=spacing, epsilon=epsilon, reduction="sum")(p[:, None]), found.sum())
    grid, prior = Grid((12, 11, 10), 0.01, "replicate"), CurvaturePrior("tubes", spacing=0.35, reduction="sum")  # type: ignore[arg-type]
    assert prior.epsilon == 0.7
    expected = energy(2 * p - 1, TUBES, grid, 0.02, mask=interior(12, 11, 10)).sum()
    assert_close(prior(p[:, None]), expected, rtol=1e-12, atol=0)


def test_a_change_of_unit_changes_nothing():
    p = probabilities(1, 1, 10, 10, 12)
    micro = CurvaturePrior(LAW, spacing=(2.0, 1.0, 1.0), epsilon=4.0)
    milli = CurvaturePrior(LAW.in_unit(1e3), spacing=(2e-3, 1e-3, 1e-3), epsilon=4e-3)
    assert_close(micro(p), milli(p), rtol=1e-10, atol=0)


def test_a_fit_is_in_its_own_unit_or_converted(tmp_path):
    path = fit_file(tmp_path / "fit.json", "um", "Supported (nearest match): …")  # its ε is 4 um
    for options, unit in (({"spacing": 2.0}, 1 / 200), ({"spacing": 2e-3, "unit": "mm"}, 1e3 / 200)):
        law = CurvaturePrior(str(path), **options).coefficients
        assert tuple(law) == pytest.approx(tuple(TUBES.in_unit(unit)))
    for good in (1.01, 3.9):
        CurvaturePrior(path, spacing=good * 2e-3, unit="mm")
        CurvaturePrior(path, spacing=2 / good)
    for factor in (0.2, 5.0):
        with pytest.warns(UserWarning, match=r"ε is .* mm here and was 0.004 mm in the fit"):
            CurvaturePrior(path, spacing=factor * 2e-3, unit="mm")
    with pytest.raises(ValueError, match="units"):
        CurvaturePrior(path, unit="voxel")
    with pytest.warns(UserWarning, match="is not `Supported`"):
        CurvaturePrior(fit_file(tmp_path / "doubt.json", "um", "No believable twin (nearest match): …"), spacing=2.0)


# ---- windows --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spacing", "border"), [((1.0, 1.0, 1.0), 1), ((2.0, 1.0, 1.0), 2)])
def test_tiles_add_up_to_the_interior_of_the_whole(spacing, border):
    p = probabilities(1, 1, 12, 20, 20)
    with pytest.warns(UserWarning, match="z 2-fold") if spacing[0] > 1 else contextlib.nullcontext():
        prior = CurvaturePrior("tubes", spacing=spacing, border=border, reduction="sum")
    inner = 8 if border == 2 else 9
    cuts = [slice(k, min(20, k + inner + 2 * border)) for k in range(0, 20 - 2 * border, inner)]
    tiles = [p[..., y, x] for y in cuts for x in cuts]
    assert len(tiles) == 4 and all(tile.shape != p.shape for tile in tiles)
    assert_close(sum(prior(tile) for tile in tiles), prior(p), rtol=1e-10, atol=0)


def test_the_mean_compares_across_patch_sizes():
    """Patches of a repeating pattern: the energies go with the volume, the means do not."""
    cell = 2 * probabilities(16, 16, 16) - 1
    whole = (gaussian_blur(cell.repeat(3, 3, 3), Grid((48, 48, 48), 1.0), 1.0)[None, None] + 1) / 2  # type: ignore[arg-type]
    patches = [whole[..., 8 : 8 + n, 8 : 8 + n, 8 : 8 + n] for n in (18, 34)]
    means, sums = ([float(CurvaturePrior("tubes", reduction=how)(p)) for p in patches] for how in ("mean", "sum"))
    assert means[0] == pytest.approx(means[1], rel=1e-9)
    assert sums[1] == pytest.approx(8 * sums[0], rel=1e-9)


def test_the_level_of_a_deep_supervision_has_its_own_spacing():
    p, fine = probabilities(1, 1, 8, 8, 8), probabilities(1, 1, 8, 16, 16)
    level = CurvaturePrior("tubes", spacing=0.5, epsilon=2.0, shape=(8, 16, 16))
    coarse = CurvaturePrior(level.coefficients, spacing=(0.5, 1.0, 1.0), epsilon=2.0)
    assert_close(level(p), coarse(p))
    assert_close(level(fine), CurvaturePrior("tubes", spacing=0.5, epsilon=2.0)(fine))


# ---- anisotropy -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("times", [2, 3])
def test_the_quintic_spline_is_of_sixth_order_under_mirrors(times):
    """Of a cosine that the mirrors at both ends continue: twice the samples, 2⁶ times less error. An odd refinement
    keeps the samples themselves. Its adjoint is exact."""

    def error(n: int) -> float:
        u, exact = (torch.cos(math.pi * 3 * (torch.arange(k, dtype=torch.float64) + 0.5) / k) for k in (n, n * times))
        fine = refine_axis(u[None, :, None, None].expand(2, n, 4, 5), 0, times)[1, :, 2, 3]
        if times == 3:
            assert_close(fine[1::3], u)
        return float((fine - exact).abs().max())

    assert error(20) / error(40) == pytest.approx(64, rel=0.15)
    u, v = noise(2, 9, 5, 6), noise(2, 9 * times, 5, 6, seed=1)
    back = slope_of(lambda leaf: refine_axis(leaf, 0, times) * v, u)
    assert float((refine_axis(u, 0, times) * v).sum()) == pytest.approx(float((u * back).sum()), rel=1e-12)


@pytest.mark.parametrize("law", [Coefficients.willmore(), Coefficients(1, 2, 6, -0.4, -0.4, 0.04)])
@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_thick_slices_up_to_four_edges_keep_the_energy(law, turn):
    """An exact torus, ε = 2, along z and turned: slices of 1.5 and 2, refined to .75 and 1, where the stencils' own
    error, of the order of (Δ/ε)², parts by 3 %; of 4, within a fifth; thicker ones are said."""

    def total(step: float) -> float:
        z, y, x = radii((int(48 // step), 48, 48), (step, 1.0, 1.0))
        z, x = math.cos(turn) * z + math.sin(turn) * x, math.cos(turn) * x - math.sin(turn) * z
        u = optimal_profile(5 - (((x**2 + y**2).sqrt() - 12) ** 2 + z**2).sqrt(), 2.0)
        return float(
            CurvaturePrior(law, spacing=(step, 1.0, 1.0), epsilon=2.0, reduction="sum")((u + 1)[None, None] / 2)
        )

    fine = total(1.0)
    for step, most in ((1.5, 0.05), (2.0, 0.05), (4.0, 0.2)):
        assert total(step) == pytest.approx(fine, rel=most)
    with pytest.warns(UserWarning, match="inflate"):
        total(6.0)


@types
@pytest.mark.parametrize("normalize", [True, False])
def test_an_interpolated_axis_is_a_finer_grid(dtype, normalize):
    p, mask = probabilities(2, 8, 10, 10).to(dtype), noise(2, 8, 10, 10).abs().to(dtype)
    fine, parts = (refine_profile(2 * p - 1, (3, 1, 1)) + 1) / 2, mask.repeat_interleave(3, 1)
    options = {"normalize": normalize, "border": 0}
    found = curvature_prior(p, LAW, (3.0, 1.0, 1.0), 2.0, mask=mask, **options)
    expected = curvature_prior(fine, LAW, (1.0, 1.0, 1.0), 2.0, mask=parts, **options)
    assert_close(found, expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=0)


# ---- gradients and precision ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"spacing": (2.0, 1.0, 1.0), "epsilon": 2.0}, {"reduction": "sum"}])
def test_gradcheck(options):
    prior = CurvaturePrior("tubes", softmax=True, **options)
    assert torch.autograd.gradcheck(prior, (noise(1, 2, 6, 5, 7).requires_grad_(),), fast_mode=True)


@pytest.mark.parametrize(
    "options", [{}, {"sigmoid": True}, *({"spacing": (0.75, 0.25, 0.25), "reduction": how} for how in ("mean", "sum"))]
)
def test_float32_is_float64(options):
    """Values and gradients of the fused kernels and of the definition, per class, under a mask of each class; the
    fused ones are deterministic."""
    prior = CurvaturePrior(LAW, **options)
    p, mask = torch.cat([probabilities(2, 1, 9, 12, 11, seed=k) for k in range(2)], 1), noise(2, 2, 9, 12, 11, seed=3)
    mask = mask.abs() * (mask > -0.5)
    exact, found, again = (slope_of(lambda x: prior(x, mask=mask), x) for x in (p, p.float(), p.float()))
    assert_close(prior(p.float(), mask=mask).double(), prior(p, mask=mask), rtol=2e-5, atol=0)
    assert found.dtype == torch.float32 and torch.equal(found, again)
    error = (found.double() - exact).abs() / exact.abs().max()
    assert error.quantile(0.9) < 2e-6 and error.max() < 1e-2


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_autocast_changes_nothing(kind):
    """Half-precision logits are computed with in float32, inside autocast and out of it; large ones stay finite.

    An interpolated axis is a matrix product, which autocast would do in half precision.
    """
    prior = CurvaturePrior("tubes", sigmoid=True, spacing=(2.0, 1.0, 1.0))
    logits = (40 * noise(1, 2, 8, 8, 8, dtype=torch.float32)).to(kind)
    expected = prior(logits.float())
    with torch.autocast("cpu", dtype=kind):
        found, slope = prior(logits), slope_of(prior, logits)
    assert found.dtype == torch.float32 and torch.equal(found, expected)
    assert slope.dtype == kind and bool(torch.isfinite(slope).all()) and bool(slope.any())


@pytest.mark.parametrize("logits", [0.0, 1e4, -1e4, "checkered"])
@types
def test_a_constant_or_saturated_input_is_harmless(logits, dtype):
    prior, checkered = CurvaturePrior("trabec", sigmoid=True), torch.where(noise(1, 1, 8, 8, 8) > 0, 1e4, -1e4)
    value = (checkered if logits == "checkered" else torch.full((1, 1, 8, 8, 8), logits)).to(dtype)
    assert bool(torch.isfinite(prior(value))) and bool(torch.isfinite(slope_of(prior, value)).all())


@types
@pytest.mark.parametrize("include", [True, False])
def test_each_class_has_its_mask(dtype, include):
    p = torch.cat([probabilities(2, 1, 8, 9, 10, seed=k) for k in range(3)], 1).to(dtype)
    mask, first = noise(2, 3, 8, 9, 10).abs(), 0 if include else 1
    found = CurvaturePrior(LAW, reduction="none", include_background=include)(p, mask=mask)
    assert found.shape == (2, 3 - first, 1, 1, 1)
    for k, column in zip(range(first, 3), found.unbind(1), strict=True):
        alone = CurvaturePrior(LAW, reduction="none")(p[:, k : k + 1], mask=mask[:, k : k + 1])
        assert_close(column, alone[:, 0])
    assert_close(CurvaturePrior(LAW, include_background=include)(p, mask=mask), found.mean())
    shared = CurvaturePrior(LAW, reduction="none")
    assert_close(shared(p, mask=mask[:1, :1]), shared(p, mask=mask[:1, :1].expand_as(p)))


# ---- what counts ----------------------------------------------------------------------------------------------------


@types
def test_ignored_labels_count_nothing(dtype):
    """Nor does a NaN in them: they have a border, as a face has."""
    prior, masked = CurvaturePrior("tubes", ignore_index=255), CurvaturePrior("tubes")
    p = probabilities(2, 1, 10, 10, 16).to(dtype)
    labels = torch.zeros(2, 1, 10, 10, 16, dtype=torch.uint8)
    labels[..., 9:] = 255
    labels[1] = 255
    assert_close(prior(p, labels), masked(p[:1, ..., :9]) / 2, rtol=1e-5, atol=0)
    slope = slope_of(lambda x: prior(x, labels), p)
    assert not bool(slope[..., 9:].any()) and not bool(slope[1].any()) and bool(slope[0, ..., 8].any())
    classes = CurvaturePrior("tubes", softmax=True, include_background=False, to_onehot_y=True, ignore_index=255)
    logits = noise(2, 3, 10, 10, 16).to(dtype)
    spoiled = torch.where(labels == 255, torch.nan, logits)
    assert_close(classes(spoiled, labels), classes(logits, labels))
    assert_close(*(slope_of(lambda x: classes(x, labels), x) for x in (spoiled, logits)))


def test_masks_weigh_the_density_and_not_the_field():
    prior, p = CurvaturePrior("tubes", reduction="sum"), probabilities(1, 1, 10, 10, 16)
    left = (torch.arange(16) < 7).double().expand(1, 1, 10, 10, 16)
    assert_close(prior(p, mask=left) + prior(p, mask=1 - left), prior(p), rtol=1e-12, atol=0)
    assert_close(prior(p, mask=0.25 * left), 0.25 * prior(p, mask=left), rtol=1e-12, atol=0)
    assert float(prior(torch.ones_like(p), mask=left)) == 0  # no surface, and a masked field would have one
    mean, nothing = CurvaturePrior("tubes"), torch.zeros_like(p)
    assert float(mean(p, mask=nothing)) == 0 and not bool(slope_of(lambda x: mean(x, mask=nothing), p.float()).any())


def test_two_class_softmax_is_the_sigmoid_of_the_difference():
    logits = noise(2, 2, 8, 8, 8)
    two = CurvaturePrior("tubes", softmax=True, include_background=False)
    assert_close(two(logits), CurvaturePrior("tubes", sigmoid=True)(logits[:, 1:] - logits[:, :1]))


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


def test_the_suggested_weight_balances_gradients():
    base = torch.nn.BCEWithLogitsLoss()
    prior, logits = CurvaturePrior("tubes", sigmoid=True), noise(1, 1, 8, 8, 8, dtype=torch.float32)
    target = (noise(1, 1, 8, 8, 8, seed=1) > 0).float()
    weight = prior.suggest_weight(base, (logits, target), share=0.3)
    ours, theirs = slope_of(prior, logits).norm(), slope_of(lambda x: base(x, target), logits).norm()
    assert float(weight * ours) == pytest.approx(0.3 * float(theirs), rel=1e-5)
    with pytest.raises(ValueError, match="gradient"):
        prior.suggest_weight(base, (torch.full_like(logits, 1e4), target))


# ---- wrong input: any number is finite or refused --------------------------------------------------------------------


def box(*shape: int) -> torch.Tensor:
    return torch.rand(shape or (2, 2, 8, 8, 8), generator=torch.Generator().manual_seed(0))


def spoiled(value: float) -> torch.Tensor:
    """A mask with one bad number."""
    mask = torch.ones(2, 2, 8, 8, 8).double()
    mask[0, 0, 4, 4, 4] = value
    return mask


LABELS = torch.ones(2, 1, 8, 8, 8)
#: A loss's options, its arguments, and a word of the refusal.
REFUSALS = [
    ({"sigmoid": True, "softmax": True}, (), "expected sigmoid or softmax, got both"),
    ({"reduction": "max"}, (), "reduction"), ({"spacing": (1, 0, 1)}, (), "expected a spacing of 3 positive numbers"),
    ({"epsilon": -1.0}, (), "expected epsilon > 0"),
    ({"epsilon": 1e30}, (), "expected epsilon > 0 in spacing's unit, at most 10000, got 1e.30"),
    ({"epsilon": 11.0}, (box(1, 1, 8, 9, 10),), "expected an ε of at most the window's longest side, 10, got 11"),
    ({"epsilon": 0.02}, (), "fold"), ({"epsilon": 2.0, "spacing": (16.1, 1.0, 1.0)}, (), "fold"),
    ({"border": 0.5}, (), "expected a border of whole voxels"),
    ({"shape": (8, 8)}, (), "expected a shape of 3 whole numbers"), ({"unit": "furlong"}, (), "unit"),
    ({"law": LAW, "unit": "furlong"}, (), "unit"), ({"law": "tubs"}, (), "preset"),
    ({"law": Path("nowhere/fit.json")}, (), "no file"), ({"law": Coefficients(torch.ones(2), 1, 1)}, (), "numbers"),
    ({"law": Coefficients(1, 1, 1, a00=1e7)}, (), "a00"),
    ({"law": ("tubes", "sponge")}, (), "expected a law"),
    ({}, (box(1, 1, 1, 16, 16),), "at least 4 voxels"),
    ({}, (box(1, 16, 16, 16),), "expected an input of floats .B, N, D, H, W."),
    ({}, (box(0, 1, 8, 8, 8),), "expected an input of floats .B, N, D, H, W., got torch.float32 .0, 1, 8, 8, 8."),
    ({}, (LABELS.long(),), "input"), ({}, (LABELS.numpy(),), "expected a torch tensor"),
    *(({"ignore_index": 2}, (box(), labels), "target") for labels in (None, box(), box(2, 1, 8, 8, 4))),
    ({"to_onehot_y": True}, (box(), box()), "target"),
    *(
        ({}, (box(), LABELS, box(*shape)), "mask")
        for shape in ((2, 3, 8, 8, 8), (3, 1, 8, 8, 8), (0, 1, 8, 8, 8), (2, 1, 8, 8, 1), (2, 8, 8, 8))
    ),
    *(({}, (box(), None, spoiled(value)), "mask") for value in (-1.0, 1e300, math.inf, math.nan)),
    *(({}, (box().to(kind), None, box().requires_grad_()), "detach") for kind in (torch.float32, torch.float64)),
]  # fmt: skip


@pytest.mark.parametrize(("options", "given", "said"), REFUSALS)
def test_what_it_cannot_take_is_refused(options, given, said):
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=said):
        CurvaturePrior(**{"law": "tubes"} | options)(*given)


def test_what_changes_nothing_is_said():
    p = probabilities(1, 1, 8, 8, 8)
    useless = ("softmax", True, "channel"), ("include_background", False, "channel"), ("unit", "nm", "unit")
    for name, value, word in useless:
        with pytest.warns(UserWarning, match=word):
            found = CurvaturePrior("tubes", **{name: value})(p)
        assert torch.equal(found, CurvaturePrior("tubes")(p))


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


@pytest.mark.parametrize("spacing", [1.0, 1e-9, 1e9, (1e-12, 1.0, 1.0), (1e12, 1e12, 1e11)])
@pytest.mark.parametrize("option", ["epsilon", "border", "shape", "spacing", *NAMES])
def test_any_number_is_finite_or_refused(option, spacing) -> None:
    """In any unit of length: what counts is the product with ε."""
    taken = []
    for value in HOSTILE:
        given = {"a20": 1.0, "a11": 1.0, "a02": 1.0} | ({option: value} if option in NAMES else {})
        options = {"spacing": spacing} | ({} if option in NAMES else {option: value})
        taken.append(finite_or_a_sentence(lambda g=given, o=options: CurvaturePrior(Coefficients(**g), **o)))
    assert not all(taken)


@types
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -9.0])
def test_what_is_no_probability_is_said_once_and_shows_in_the_loss(value, dtype) -> None:
    prior, p = CurvaturePrior("tubes"), probabilities(1, 1, 8, 9, 10).to(dtype)
    prior(p * 1.001)
    p[0, 0, 4, 4, 4] = value
    with pytest.warns(UserWarning, match="probabilities.*sigmoid"):
        assert bool(torch.isfinite(prior(p))) == math.isfinite(value)
    prior(p)  # a warning is an error here
    CurvaturePrior("tubes", sigmoid=True)(torch.full_like(p, 9.0))
    CurvaturePrior("tubes", softmax=True)(torch.full_like(p, 9.0).expand(1, 2, 8, 9, 10))


# ---- ε, weights, levels ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spacing", "epsilon", "times"),
    [
        *((spacing, 2 * min(spacing), (1, 1, 1)) for spacing in ((1.003, 1, 1.003), (0.8, 0.76, 0.76), (1, 1, 1.1))),
        ((1.11, 1.0, 1.0), 2.0, (2, 1, 1)), ((5.0, 0.994, 3.0), 1.988, (6, 1, 4)),
        ((16.0, 2.0, 1.0), 2.0, (16, 2, 1)),
    ],
)  # fmt: skip
def test_an_axis_a_little_coarser_is_not_interpolated_and_others_have_two_voxels_to_epsilon(spacing, epsilon, times):
    assert choose_refinement(spacing, epsilon) == times


def test_a_look_without_gradients_leaves_later_ones_alone():
    """With an interpolated axis, whose weights are kept between calls; of a size no other test has."""
    prior, p = CurvaturePrior("tubes", spacing=(2.0, 1.0, 1.0)), probabilities(1, 1, 11, 9, 9)
    with torch.inference_mode():
        prior(p)
    assert bool(slope_of(prior, p).any())


@pytest.mark.parametrize(
    ("shape", "options"), [((3, 8, 8), {}), ((4, 8, 8), {"border": 2}), ((8, 8, 4), {"shape": (8, 8, 80)})]
)
def test_a_level_too_coarse_is_zero(shape, options):
    whole = {"shape": (32, 32, 32)} | options
    prior, value = CurvaturePrior("tubes", reduction="none", **whole), torch.rand(2, 2, *shape)
    with pytest.warns(UserWarning, match="coarse"):
        found = prior(value.requires_grad_())
    assert found.shape == (2, 2, 1, 1, 1) and not bool(found.any())
    found.sum().backward()
    assert value.grad is not None and not bool(value.grad.any())
    prior(value)  # said once
