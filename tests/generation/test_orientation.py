"""The further term ε ∫ ∇uᵀQ∇u, and ε that varies: values, laws, derivatives, and the same in the fused entry."""

from __future__ import annotations

import math

import pytest
import torch
from exact import centres

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import (
    cahn_hilliard_area,
    discrepancy_ratio,
    energy,
    energy_gradient,
    energy_gradient_by_autograd,
    orientation,
)
from curvafit.priors.grid import Grid
from curvafit.priors.profile import SIGMA, optimal_profile
from curvafit.priors.stencils import gaussian_blur

UNEQUAL = Coefficients(1.3, -0.7, 4.0, -20.0, 35.0, 150.0)
#: An energy that is next to nothing, so that a further term stands alone.
NOTHING = Coefficients(1e-30, 0, 1e-30)
BOUNDARIES = ["periodic", "replicate"]


def rough(grid: Grid, seed: int = 0, *batch: int) -> torch.Tensor:
    noise = torch.randn(*batch, *grid.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    u = gaussian_blur(noise, grid, 1.2 * max(grid.spacing))
    return 0.7 * u / u.std()


def test_orientation_is_strength_times_the_directions_square() -> None:
    Q = orientation((0, 3, 4), 50.0)
    torch.testing.assert_close(Q, torch.tensor([[0, 0, 0], [0, 18, 24], [0, 24, 32]]).double())
    assert float(Q.trace()) == pytest.approx(50)
    for wrong in ((0, 0, 0), (1, 2), (1, math.nan, 0)):
        with pytest.raises(ValueError, match="direction"):
            orientation(wrong, 1.0)
    with pytest.raises(ValueError, match="strength"):
        orientation((1, 0, 0), math.inf)


@pytest.mark.parametrize("waves", [(1, 0, 0), (1, -2, 0), (2, 1, 3)])
def test_plane_wave(waves: tuple[int, int, int]) -> None:
    """u = sin k·x on a periodic grid: ∫ (θ·∇u)² = |Ω|/2 (Σ θ_i sin(k_i h_i) / h_i)², exact for central differences."""
    ε, μ, θ = 0.3, 7.0, torch.tensor([1.0, 2.0, -0.5]).double()
    grid = Grid((12, 16, 20), (0.2, 0.3, 0.25))
    k = torch.tensor([2 * math.pi * n / (N * h) for n, N, h in zip(waves, grid.shape, grid.spacing, strict=True)])
    h = torch.tensor(grid.spacing).double()
    u = torch.sin(centres(grid) @ k.double())
    slope = (θ / θ.norm() * torch.sin(k * h) / h).sum()
    truth = ε * μ * grid.volume / 2 * float(slope) ** 2
    found = float(energy(u, NOTHING, grid, ε, orientation(θ, μ)))
    assert found == pytest.approx(truth, rel=1e-6)


def test_layers_pay_by_their_angle() -> None:
    """ε ∫ (θ·∇u)² of a plane is μ σ cos² of the angle between θ and its normal, times the area (from below)."""
    ε, grid = 0.05, Grid((160, 4, 4), (1 / 160, 0.25, 0.25), "replicate")
    u = optimal_profile(centres(grid)[..., 0] - 0.5, ε)
    for degrees in (0, 30, 90):
        angle = math.radians(degrees)
        found = float(energy(u, NOTHING, grid, ε, orientation((math.cos(angle), math.sin(angle), 0.0), 3.0)))
        truth = 3 * SIGMA * math.cos(angle) ** 2
        assert found == pytest.approx(truth, rel=0.01, abs=1e-9)
        assert found <= truth + 1e-9


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_multiple_of_the_unit_is_a_cost_of_area(boundary: str) -> None:
    """Q = c·1 is c more of a00."""
    grid, ε = Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary), 0.5  # type: ignore[arg-type]
    u = rough(grid)
    a20, a11, a02, a10, a01, a00 = UNEQUAL
    there = energy(u, UNEQUAL, grid, ε, 33 * torch.eye(3))
    torch.testing.assert_close(there, energy(u, Coefficients(a20, a11, a02, a10, a01, a00 + 33), grid, ε))


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_turned_with_the_field(boundary: str) -> None:
    """A quarter turn in (z, y) and a swap of θ's components; -u has the same term."""
    grid, ε = Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary), 0.5  # type: ignore[arg-type]
    turned = Grid((7, 6, 8), (0.3, 0.2, 0.25), boundary)  # type: ignore[arg-type]
    u, θ = rough(grid), (1.0, -2.0, 0.5)
    here = energy(u, NOTHING, grid, ε, orientation(θ, 10.0))
    there = energy(u.rot90(1, (0, 1)), NOTHING, turned, ε, orientation((2.0, 1.0, 0.5), 10.0))
    torch.testing.assert_close(there, here, rtol=1e-12, atol=0)
    torch.testing.assert_close(energy(-u, NOTHING, grid, ε, orientation(θ, 10.0)), here, rtol=1e-12, atol=0)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradients_with_orientation_and_a_varying_width(boundary: str) -> None:
    grid = Grid((4, 5, 4), (0.2, 0.3, 0.25), boundary)  # type: ignore[arg-type]
    u = rough(grid, 3).requires_grad_()
    ε = torch.linspace(0.4, 0.6, 5, dtype=torch.float64)[:, None]
    Q = orientation((1, 2, -1), 40.0)
    smooth = Coefficients(1.3, -0.7, 1.3, -20.0, -20.0, 150.0)
    assert torch.autograd.gradcheck(lambda v: energy(v, smooth, grid, ε, Q), (u,), eps=1e-7, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_width_that_varies_is_each_width_where_it_holds(boundary: str) -> None:
    grid = Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary)  # type: ignore[arg-type]
    u = rough(grid)
    for law in (energy, lambda v, a, g, ε: cahn_hilliard_area(v, g, ε)):
        same = law(u, UNEQUAL, grid, torch.full((1, 1, 8), 0.5))
        torch.testing.assert_close(same, law(u, UNEQUAL, grid, 0.5), rtol=1e-12, atol=0)
    half = torch.where(torch.arange(8) < 4, 0.5, 0.8).double()
    a00 = Coefficients(1e-30, 0, 1e-30, a00=2.0)
    terms = [energy(u, Coefficients(1e-30, 0, 1e-30, a00=2.0 * mask), grid, ε) for mask, ε in parts(half)]
    torch.testing.assert_close(energy(u, a00, grid, half), sum(terms), rtol=1e-12, atol=0)
    assert 0 < float(discrepancy_ratio(u, grid, half)) <= 1
    two = torch.stack([u, u])
    each = torch.stack([energy(u, UNEQUAL, grid, ε) for ε in (0.5, 0.8)])
    batch = torch.tensor([0.5, 0.8], dtype=torch.float64)[:, None, None, None]
    torch.testing.assert_close(energy(two, UNEQUAL, grid, batch), each, rtol=1e-12, atol=0)


def parts(widths: torch.Tensor):
    """Where each width holds, and it."""
    return [((widths == ε).double(), float(ε)) for ε in widths.unique()]


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_the_kernels_entry_is_the_definition(boundary: str) -> None:
    """Whatever it takes to compute: fused or not, numbers or fields, with an orientation or without."""
    grid = Grid((9, 10, 11), (0.013, 0.01, 0.008), boundary)  # type: ignore[arg-type]
    u, Q = rough(grid, 1).float(), orientation((1, 2, -1), 300.0)
    ramp = torch.linspace(1.0, 1.5, 11)
    varying = Coefficients(1.3, -0.7, 1.3 * ramp, -60.0, 35.0, 500 * ramp.flip(0))
    for a in (UNEQUAL, varying):
        for ε in (0.02, 0.02 * ramp):
            for Q_ in (None, Q):
                value, slope = energy_gradient(u, a, grid, ε, Q_)
                truth, exact = energy_gradient_by_autograd(u.double(), a, grid, ε, Q_)
                assert slope.dtype == torch.float32
                assert float(value) == pytest.approx(float(truth), rel=1e-5)
                error = (slope.double() - exact).abs() / exact.abs().max()
                assert float(error.quantile(0.9)) < 1e-4


def test_an_orientation_is_symmetric() -> None:
    grid = Grid((4, 4, 4))
    with pytest.raises(ValueError, match="symmetric"):
        energy(rough(grid), UNEQUAL, grid, 0.02, torch.arange(9.0).reshape(3, 3))
