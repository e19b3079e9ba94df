"""The fused kernels against the plain-torch definition, and against what must hold of them whatever the definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kernel_cases import BLUR, BOUNDARIES, EPSILON, SPACINGS, TUBES, smooth_field, torch_gradient

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_blur

cpu = pytest.importorskip("curvafit.priors.kernels.cpu")


def assert_is_the_definition(u: torch.Tensor, a: Coefficients, grid: Grid, ε=EPSILON, Q=None) -> None:
    """No farther from float64 than a few times what the definition itself loses in float32.

    The gradient has a factor 1/S, S = √X⁺, which amplifies rounding where X crosses zero: a few voxels, other ones in
    each program, so nine in ten voxels are held to the tight bound and all to the loose one.
    """
    value, slope = torch_gradient(u, a, grid, ε, Q)
    value32, slope32 = torch_gradient(u.float(), a, grid, ε, Q)
    cost = [value.numpy() if isinstance(value, torch.Tensor) else value for value in (*a, ε, Q)]
    found, gradient_found = cpu.fused_energy_gradient(u.numpy(), cost[:6], grid, cost[6], cost[7])
    assert abs(found - value) <= 4 * abs(value32 - value) + 1e-6 * abs(value)
    scale = float(slope.abs().max())
    error, error32 = np.abs(gradient_found - slope.numpy()) / scale, (slope32 - slope).abs().numpy() / scale
    assert np.quantile(error, 0.9) <= 4 * np.quantile(error32, 0.9) + 1e-6
    assert error.max() < 1e-2


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("shape", [(12, 9, 21), (4, 5, 16), (5, 4, 4)])
def test_energy_and_gradient_are_the_definitions(shape, spacing, boundary):
    grid = Grid(shape, spacing, boundary)
    assert_is_the_definition(smooth_field(grid), Coefficients(1.3, -0.7, 4.0, -60.0, 35.0, 500.0), grid)


#: Symmetric, with every entry at work: mirrors change its signs.
ORIENTATION = torch.tensor([[300.0, 50.0, -100.0], [50.0, 200.0, 70.0], [-100.0, 70.0, -100.0]], dtype=torch.float64)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("kinds", ["orientation", "coefficients", "epsilon", "orientation, coefficients, epsilon"])
def test_orientation_and_what_varies_in_space_are_the_definitions(kinds, spacing, boundary):
    """All of ε inside the density varies with it; numbers and arrays may be mixed."""
    grid = Grid((9, 8, 13), spacing, boundary)
    a: list = list(TUBES)
    if "coefficients" in kinds:
        a[1], a[3], a[5] = (a[k] * (1 + 0.3 * smooth_field(grid, k)) for k in (1, 3, 5))
    ε = EPSILON * (1.3 + 0.1 * smooth_field(grid, 9)) if "epsilon" in kinds else EPSILON
    Q = ORIENTATION if "orientation" in kinds else None
    assert_is_the_definition(smooth_field(grid), Coefficients(*a), grid, ε, Q)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("varies", [False, True])
def test_a_mask_weighs_the_density(varies, spacing, boundary):
    """By the kernel made for it, and where what varies takes the mask with it."""
    grid = Grid((9, 8, 35), spacing, boundary)
    u, a = smooth_field(grid), list(TUBES)
    mask = (smooth_field(grid, 5) > -0.3) * (1 + smooth_field(grid, 6).abs())
    Q = ORIENTATION if varies else None
    if varies:
        a[5] = a[5] * (1 + 0.3 * smooth_field(grid, 5))
    free = u.clone().requires_grad_()
    value = energy(free, Coefficients(*a), grid, EPSILON, Q, mask)
    (slope,) = torch.autograd.grad(value, free)
    given = [v.numpy() if isinstance(v, torch.Tensor) else v for v in a]
    turned = None if Q is None else Q.numpy()
    found, gradient_found = cpu.fused_energy_gradient(u.numpy(), given, grid, EPSILON, turned, mask.numpy())
    error = np.abs(gradient_found - slope.numpy()) / float(slope.abs().max())
    assert found == pytest.approx(float(value.detach()), rel=1e-5)
    assert np.quantile(error, 0.9) < 1e-5 and error.max() < 1e-2


def test_arrays_of_equal_numbers_are_numbers():
    grid = Grid((6, 7, 20))
    u = smooth_field(grid).numpy()
    value, slope = cpu.fused_energy_gradient(u, list(TUBES), grid, EPSILON)
    found, gradient_found = cpu.fused_energy_gradient(
        u, np.stack([np.full(grid.shape, a) for a in TUBES]), grid, EPSILON
    )
    assert found == pytest.approx(value, rel=1e-6)
    assert np.quantile(np.abs(gradient_found - slope), 0.9) < 1e-6 * np.abs(slope).max()


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradient_predicts_the_energy(boundary):
    """⟨∂F/∂u, δ⟩ against the central difference of the plain energy in float64: the adjoint's test at the walls too."""
    grid = Grid((10, 11, 18), 0.01, boundary)
    u, direction = smooth_field(grid, 1), smooth_field(grid, 2, rms=1.0)
    step = 1e-5
    ahead, behind = (energy(u + sign * step * direction, TUBES, grid, EPSILON) for sign in (1, -1))
    change = float(ahead - behind)
    _, slope = cpu.fused_energy_gradient(u.numpy(), list(TUBES), grid, EPSILON)
    assert float((torch.from_numpy(slope).double() * direction).sum()) == pytest.approx(change / (2 * step), rel=1e-4)


def test_gradient_vanishes_on_pure_phases():
    grid = Grid((6, 7, 20))
    for phase in (1.0, -1.0):
        value, slope = cpu.fused_energy_gradient(np.full(grid.shape, phase, np.float32), list(TUBES), grid, EPSILON)
        assert value == 0
        assert np.abs(slope).max() < 1e-9


def test_a_lost_value_shows():
    """NaN anywhere makes the energy NaN: fast arithmetic must not hide it."""
    grid = Grid((6, 6, 20))
    u = smooth_field(grid).numpy().astype(np.float32)
    u[3, 2, 19] = np.nan
    assert np.isnan(cpu.fused_energy_gradient(u, list(TUBES), grid, EPSILON)[0])


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(
    ("shape", "width"), [((13, 10, 37), 0.02), ((21, 8, 16), 0.033), ((4, 5, 6), 0.02), ((5, 6, 7), 0.0)]
)
def test_blur_is_the_definitions(shape, width, spacing, boundary):
    """Boxes smaller than the radius and radii that are no multiple of the unrolling included."""
    grid = Grid(shape, spacing, boundary)
    u = torch.randn(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    expected = gaussian_blur(u, grid, width).numpy()
    assert np.abs(cpu.gaussian_blur(u.numpy(), grid, width) - expected).max() < 2e-6


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_blur_is_its_own_adjoint(boundary):
    grid = Grid((14, 9, 19), (0.01, 0.02, 0.007), boundary)
    first, second = np.random.default_rng(0).standard_normal((2, *grid.shape))
    left = (cpu.gaussian_blur(first, grid, BLUR).astype(np.float64) * second).sum()
    assert left == pytest.approx((first * cpu.gaussian_blur(second, grid, BLUR).astype(np.float64)).sum(), abs=1e-4)
