"""F_ε: its value on exact profiles, its relatives, its laws, its derivatives, and how a grid errs."""

import math

import numpy as np
import pytest
import torch
from exact import (
    Torus,
    centres,
    diffuse_integrals,
    exact_jet,
    grid_integrals,
    profile,
    recovery_ends,
    recovery_integrals,
    recovery_profile,
)
from kernel_cases import rough
from shapes import grown
from torch.testing import assert_close

from curvafit.generation.result import viability
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import Jet, diffuse_curvatures, jet, second_form
from curvafit.priors.energies import (
    cahn_hilliard_area,
    energy,
    energy_gradient,
    energy_gradient_by_autograd,
    energy_terms,
    orientation,
)
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import SIGMA, double_well_derivative, optimal_profile

UNEQUAL = Coefficients(1.3, -0.7, 4.0, -20.0, 35.0, 150.0)
TORUS = Torus(2.0, 1.0)
GRIDS = [Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary) for boundary in ("periodic", "replicate")]  # type: ignore[arg-type]
grids = pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: grid.boundary)
boundaries = pytest.mark.parametrize("boundary", ["periodic", "replicate"])
ε = 0.5
#: An energy that is next to nothing, so that a further term stands alone.
NOTHING = Coefficients(1e-30, 0, 1e-30)
RAMP = torch.linspace(1.0, 1.5, 11)
VARYING = Coefficients(1.3, -0.7, 1.3 * RAMP, -60.0, 35.0, 500 * RAMP.flip(0))


# ---- what F_ε comes from (paper, section 3, before eq. 20) -----------------------------------------------------------


def curvature_density(field: Jet, a: Coefficients, ε: float) -> torch.Tensor:
    """The integrand of 𝓔_ε(u) = ∫ p(κ1_ε, κ2_ε) ε|∇u|² dx, which is zero where ∇u is zero."""
    κ1, κ2, _, _ = diffuse_curvatures(field, ε)
    return a.polynomial(κ1, κ2) * ε * field.gradient.square().sum(-4)


def unsimplified_density(field: Jet, a: Coefficients, ε: float) -> torch.Tensor:
    """The integrand of 𝓔̃_ε: that of F_ε with the positive part of 2|M|² - (Tr M)² in its quadratic terms too."""
    trace, norm2, root, slope = second_form(field, ε)
    positive = (2 * norm2 - trace**2).clamp_min(0)
    even, odd = a.a20 + a.a02 - a.a11, 2 * (a.a20 - a.a02)
    quadratic = even * positive + (a.a20 + a.a02 + a.a11) * trace**2 + odd * trace * root
    linear = (a.a10 + a.a01) * trace + (a.a10 - a.a01) * root
    return quadratic / (4 * ε) + slope * linear / 2 + a.a00 * ε * field.gradient.square().sum(-4)


def integral(density):
    return lambda u, a, grid, ε: density(jet(u, grid), a, ε).sum((-3, -2, -1)) * grid.voxel_volume


CURVATURE_INTEGRAL, UNSIMPLIFIED = integral(curvature_density), integral(unsimplified_density)


# ---- values ----------------------------------------------------------------------------------------------------------


def test_exact_jets_sum_to_the_coarea_integral() -> None:
    """With exact derivatives a sum over voxels has no order: F_ε of a torus's profile is ∫ √(2W(t)) ∫ p dA dt."""
    ε, h = 0.2, 0.1
    field = exact_jet(lambda p: profile(TORUS, p, ε), centres(Grid((21, 42, 42), (h, h, h), "replicate")))
    found = 8 * h**3 / SIGMA * energy_terms(field, ε).sum((-3, -2, -1))
    np.testing.assert_allclose(found.numpy(), diffuse_integrals(TORUS, ε, 0.98), rtol=0.005, atol=0.05)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_three_forms_are_equal_on_exact_profiles(unit: float) -> None:
    """𝓔_ε, 𝓔̃_ε and F_ε, point by point, but for ξ and the root's floor, which have units."""
    torus, ε = Torus(1.4 * unit, 0.6 * unit), 0.1 * unit
    cloud = 4.4 * unit * (torch.rand(8000, 3, generator=torch.Generator().manual_seed(0)).double() - 0.5)
    points = cloud[torus.distance(cloud).abs() < 2 * ε][:200, None, None]
    field, a = exact_jet(lambda p: profile(torus, p, ε), points), UNEQUAL.in_unit(1 / unit)
    full = sum(value * term for value, term in zip(a, energy_terms(field, ε), strict=True))
    for other in (unsimplified_density(field, a, ε), curvature_density(field, a, ε)):
        assert_close(other, full, rtol=0, atol=(1e-9 if unit < 1 else 1e-4) * float(full.abs().max()))


def assert_forms_part_by(most: float, u: torch.Tensor, grid: Grid) -> None:
    """Dropping the positive part only ever lowers the |M|² term (a20 + a02 > a11), so 𝓔̃_ε ≥ F_ε."""
    a = Coefficients(1, 0, 1, a00=1)
    whole = float(energy(u, a, grid, 0.02))
    first, second = (float(form(u, a, grid, 0.02)) / whole - 1 for form in (CURVATURE_INTEGRAL, UNSIMPLIFIED))
    assert 0 < second < most
    assert abs(first - second) < 1e-3


def test_forms_part_on_a_generated_field() -> None:
    assert_forms_part_by(0.02, grown("tubes", 32), Grid((32, 32, 32)))


def test_forms_part_on_the_gallerys_fields(data) -> None:
    import nibabel

    found = sorted((data / "gallery").glob("sponge*.nii.gz"))
    if not found:
        pytest.skip(f"needs the gallery in {data}")
    u = torch.from_numpy(nibabel.load(found[0]).get_fdata(dtype=np.float32)[:, :50, :50].copy())
    assert_forms_part_by(0.005, u, Grid(tuple(u.shape), 0.01, "replicate"))  # type: ignore[arg-type]


@grids
def test_helfrich_and_willmore_are_their_own_formulas(grid: Grid) -> None:
    """(1/ε) ∫ (ε Δu - W'/ε)² and χ_b/2ε (Tr M - ε|∇u| H0)² + χ_G/2ε ((Tr M)² - |M|²), but for ξ."""
    u = rough(grid)
    field = jet(u, grid)
    willmore = (ε * field.hessian[:3].sum(0) - double_well_derivative(u) / ε).square().sum() / ε * grid.voxel_volume
    assert float(energy(u, Coefficients.willmore(), grid, ε)) == pytest.approx(float(willmore), rel=1e-8)
    trace, norm2, _, slope = second_form(field, ε)
    χb, χG, H0 = 3.0, -1.5, 2.0
    density = χb / (2 * ε) * (trace - ε * slope * H0) ** 2 + χG / (2 * ε) * (trace**2 - norm2)
    helfrich = energy(u, Coefficients.helfrich(χb, χG, H0), grid, ε)
    assert float(helfrich) == pytest.approx(float(density.sum()) * grid.voxel_volume, rel=1e-8)


# ---- laws, derivatives, area -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [energy, UNSIMPLIFIED, CURVATURE_INTEGRAL])
@grids
def test_mirror_law(form, grid: Grid) -> None:
    """F_ε[-u; a] = F_ε[u; a'] with a20 ↔ a02, a10 → -a01, a01 → -a10."""
    u = rough(grid)
    there, back = form(-u, UNEQUAL, grid, ε), form(u, UNEQUAL.mirror(), grid, ε)
    assert_close(there, back, rtol=1e-12, atol=0)
    assert abs(float(there - form(u, UNEQUAL, grid, ε))) > 1e-3 * abs(float(there))


@grids
def test_what_moves_a_field_leaves_its_energy(grid: Grid) -> None:
    """A rotation, a reflection, a shift of a periodic box; and twice the box has twice the energy."""
    u, turned = rough(grid), Grid((7, 6, 8), (0.3, 0.2, 0.25), grid.boundary)
    value = energy(u, UNEQUAL, grid, ε)
    assert_close(energy(u.rot90(1, (0, 1)), UNEQUAL, turned, ε), value, rtol=1e-12, atol=0)
    assert_close(energy(u.flip(2), UNEQUAL, grid, ε), value, rtol=1e-12, atol=0)
    if grid.periodic:
        assert_close(energy(u.roll((2, 3, 5), (0, 1, 2)), UNEQUAL, grid, ε), value, rtol=1e-12, atol=0)
        twice = Grid((12, 7, 8), grid.spacing)
        assert_close(energy(torch.cat([u, u]), UNEQUAL, twice, ε), 2 * value, rtol=1e-12, atol=0)


def test_change_of_length_unit() -> None:
    """Lengths a tenth, coefficients in the new unit: the same number, up to ξ and the root's floor."""
    grid, tenth = Grid((8, 8, 8), (0.02, 0.03, 0.025)), Grid((8, 8, 8), (0.002, 0.003, 0.0025))
    u = rough(grid)
    mine, theirs = energy(u, UNEQUAL, grid, 0.05), energy(u, UNEQUAL.in_unit(10.0), tenth, 0.005)
    assert_close(mine, theirs, rtol=1e-6, atol=0)


def test_linear_in_the_coefficients_and_terms_exposed() -> None:
    grid = GRIDS[0]
    u = rough(grid)
    field = jet(u, grid)
    assert field.gradient.shape == (3, 6, 7, 8) and field.hessian.shape == (6, 6, 7, 8)
    parts = energy_terms(field, ε).sum((-3, -2, -1)) * grid.voxel_volume
    assert_close(energy(u, UNEQUAL, grid, ε), parts @ torch.tensor([*UNEQUAL], dtype=parts.dtype), rtol=1e-12, atol=0)
    # κ1² + κ2² - 2κ1κ2 is (κ1 - κ2)²: the root's square, its positive part dropped.
    trace, norm2, _, _ = second_form(field, ε)
    square = ((2 * norm2 - trace**2) / ε).sum() * grid.voxel_volume
    assert_close(parts[0] + parts[2] - 2 * parts[1], square, rtol=1e-10, atol=0)


def test_batches_precision_and_coefficients_in_space() -> None:
    grid = GRIDS[1]
    u = rough(grid, 1, 2)
    each = torch.stack([energy(part, UNEQUAL, grid, ε) for part in u])
    assert_close(energy(u, UNEQUAL, grid, ε), each, rtol=1e-12, atol=0)
    assert_close(energy(u.float(), UNEQUAL, grid, ε).double(), each, rtol=1e-4, atol=0)
    a00, five = torch.linspace(0, 200, 8, dtype=torch.float64), list(UNEQUAL)[:5]
    extra = (a00 * energy_terms(jet(u[0], grid), ε)[5]).sum() * grid.voxel_volume
    flat = energy(u[0], Coefficients(*five), grid, ε)
    assert_close(energy(u[0], Coefficients(*five, a00=a00), grid, ε), flat + extra, rtol=1e-12, atol=0)


@boundaries
@pytest.mark.parametrize("turned", [False, True])
def test_gradients_by_finite_differences(turned: bool, boundary: str) -> None:
    """In the field and in the coefficients, with an orientation that varies too. No root's argument is within its
    smoothing of 0: it would be stiff."""
    grid = Grid((4, 5, 4), (0.2, 0.3, 0.25), boundary)  # type: ignore[arg-type]
    u = rough(grid, 3).requires_grad_()
    Q, a = None, UNEQUAL
    if turned:
        Q, a = orientation((1, rough(grid, 4), -1), 40 * rough(grid, 5)), (1.3, -0.7, 1.3, -20.0, -20.0, 150.0)
    trace, norm2, _, _ = second_form(jet(u.detach(), grid), ε)
    assert float((2 * norm2 - trace**2).abs().min()) > 1e-4
    given = u, torch.tensor([*a], dtype=torch.float64).requires_grad_()
    function = lambda v, c: energy(v, Coefficients(*c.unbind()), grid, ε, Q)  # noqa: E731
    assert torch.autograd.gradcheck(function, given, eps=1e-7, atol=1e-4, rtol=1e-5)


def test_gradients_are_finite_on_flat_and_floored_fields() -> None:
    """Where ∇u = 0 nothing divides by it."""
    grid = Grid((6, 6, 6))
    for u in (torch.full((6, 6, 6), -0.4), torch.full((6, 6, 6), 1.0), rough(grid).float().round(decimals=1)):
        free = u.clone().requires_grad_()
        (slope,) = torch.autograd.grad(energy(free, preset("tubes").coefficients, grid, 0.02), free)
        assert bool(torch.isfinite(slope).all())


def test_cahn_hilliard_area_of_a_plane_from_below() -> None:
    """σ a unit of area; central differences underestimate |∇u|², so the sum comes from below, at second order."""
    ε, errors = 0.05, []
    for n in (40, 80):
        grid = Grid((n, 4, 4), (1 / n, 0.25, 0.25), "replicate")
        u = optimal_profile(centres(grid)[..., 0] - 0.5, ε)
        errors.append(float(cahn_hilliard_area(u, grid, ε)) - SIGMA)
    assert errors[0] < errors[1] < 0
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)


def test_discrepancy_is_zero_for_the_profile_and_one_for_a_constant() -> None:
    ε, grid = 0.1, Grid((200, 4, 4), (0.01, 0.1, 0.1), "replicate")
    u, steep = (optimal_profile(centres(grid)[..., 0] - 1.0, width) for width in (ε, ε / 2))
    assert viability(u, grid, ε).discrepancy < 0.01
    assert viability(torch.full_like(u, -0.6), grid, ε).discrepancy == pytest.approx(1)
    assert 0.5 < viability(steep, grid, ε).discrepancy < 1


# ---- convergence -----------------------------------------------------------------------------------------------------


def errors_of(pairs: list[tuple[float, float]], truth=None) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the six terms for pairs (ε, Δx), and the orders in the number that changes."""
    errors = np.stack([grid_integrals(TORUS, *pair) for pair in pairs])
    errors -= TORUS.integrals() if truth is None else truth
    steps = [h if pairs[0][0] == pairs[1][0] else ε for ε, h in pairs]
    return errors, np.polyfit(np.log(steps), np.log(np.abs(errors)), 1)[0]


def test_limit_in_epsilon_with_spacing_epsilon_squared() -> None:
    """Order 2 for the four integrals that do not vanish. Squares come from above, the area from below."""
    errors, orders = errors_of([(ε, ε**2) for ε in (1 / 4, 1 / 6)])
    assert ((orders[[0, 2, 3, 5]] > 1.8) & (orders[[0, 2, 3, 5]] < 2.8)).all()
    assert (errors[:, [0, 2]] > 0).all() and (errors[:, 5] < 0).all()
    assert np.abs(errors[-1]).max() < 0.02 * TORUS.integrals().max()


def test_the_recovery_sequence_of_the_theorem_attains_the_sharp_energy_with_order_2() -> None:
    """Theorem 1, on a torus: the arc joins tanh and ±1 with their values and slopes, and all six terms of F_ε / σ tend
    to ∫ κ^α dA."""
    for ε in (0.1, 0.01):
        for end in recovery_ends(ε):
            near = torch.tensor([end - 1e-7, end + 1e-7], dtype=torch.float64, requires_grad=True)
            value = recovery_profile(near, ε)
            (slope,) = torch.autograd.grad(value.sum(), near)
            assert_close(value[0], value[1], rtol=0, atol=1e-5)
            assert_close(slope[0], slope[1], rtol=0, atol=1e-4)
    widths = (0.04, 0.02, 0.01)
    errors = np.abs([recovery_integrals(TORUS, ε) - TORUS.integrals() for ε in widths])
    least = 1e-3 * TORUS.integrals().max()  # below, nothing is left to fall: ∫κ1κ2 = 0
    orders = np.log2(errors[:-1] / errors[1:])
    assert (errors[-1] < least).all()
    assert (orders[errors[:-1] > least] > 1.6).all() and (errors[0] > least).any()


def test_order_in_the_spacing() -> None:
    """Against the continuous profile at the same ε: 2 for the area (from below), 4 for ∫κ2² (from above), where the
    normal-normal residue of order Δx² enters squared."""
    errors, orders = errors_of([(1 / 6, 1 / 6 / n) for n in (2, 3, 4)], diffuse_integrals(TORUS, 1 / 6, 1.0))
    assert 1.7 < orders[5] < 2.3
    assert 3.0 < orders[2] < 4.6
    assert (errors[:, 5] < 0).all() and (errors[:, 2] > 0).all()


def test_no_limit_at_a_fixed_ratio() -> None:
    """ε = 2 Δx, as the published experiments have it: ∫κ2² is overestimated, and ever more as ε → 0."""
    bend = errors_of([(ε, ε / 2) for ε in (1 / 4, 1 / 8, 1 / 16)])[0][:, 2]
    assert 0 < bend[0] < bend[1] < bend[2]
    assert bend[2] > 0.3 * TORUS.integrals()[2]


# ---- the further term ε ∫ ∇uᵀQ∇u, and ε that varies ------------------------------------------------------------------


def test_orientation_is_strength_times_the_directions_square() -> None:
    Q = orientation((0, 3, 4), 50.0)
    assert_close(Q, torch.tensor([[0, 0, 0], [0, 18, 24], [0, 24, 32]]).double())
    assert float(Q.trace()) == pytest.approx(50)


def test_an_orientation_that_varies_is_its_own_in_every_voxel() -> None:
    """Numbers among maps hold everywhere, the length of θ says nothing, and equal maps cost what numbers do."""
    θz, θx, μ = (1 + rough(GRIDS[0], k).abs() for k in (1, 2, 3))
    Q, place = orientation((θz, -2, θx), μ), (1, 2, 3)
    assert Q.shape == (3, 3, *GRIDS[0].shape)
    assert_close(Q[(..., *place)], orientation((θz[place], -2, θx[place]), μ[place]), rtol=1e-12, atol=0)
    assert_close(Q, orientation(torch.stack((7 * θz, -14 * torch.ones_like(μ), 7 * θx)), μ), rtol=1e-12, atol=0)
    u, ones = rough(GRIDS[0]), torch.ones(GRIDS[0].shape)
    same = orientation((ones, -2 * ones, 0.5), 40 * ones)
    for program in (energy, lambda *cost: energy_gradient(*cost)[1]):
        here, there = (program(u, UNEQUAL, GRIDS[0], ε, each) for each in (same, orientation((1, -2, 0.5), 40)))
        assert_close(here, there, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="not all 0"):
        orientation((θz - θz, 0, 0), μ)
    with pytest.raises(ValueError, match="finite"):
        orientation((θz, 0, 0), μ / (μ - μ))


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


def test_layers_pay_where_they_are_not_along() -> None:
    """A plane across z, in whose halves θ lies along and across: 3 σ times half of the area (from below)."""
    ε, grid = 0.05, Grid((160, 4, 8), (1 / 160, 0.25, 0.125), "replicate")
    u, far = optimal_profile(centres(grid)[..., 0] - 0.5, ε), centres(grid)[..., 2] > 0.5
    found = float(energy(u, NOTHING, grid, ε, orientation((far.double(), 0.0, 1 - far.double()), 3.0)))
    assert 0.99 * 1.5 * SIGMA < found <= 1.5 * SIGMA + 1e-9


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


@grids
def test_a_multiple_of_the_unit_is_a_cost_of_area(grid: Grid) -> None:
    """Q = c·1 is c more of a00."""
    u = rough(grid)
    a20, a11, a02, a10, a01, a00 = UNEQUAL
    there = energy(u, UNEQUAL, grid, ε, 33 * torch.eye(3))
    assert_close(there, energy(u, Coefficients(a20, a11, a02, a10, a01, a00 + 33), grid, ε))


@grids
def test_turned_with_the_field(grid: Grid) -> None:
    """A quarter turn in (z, y) and a swap of θ's components; -u has the same term."""
    turned = Grid((7, 6, 8), (0.3, 0.2, 0.25), grid.boundary)
    u, θ = rough(grid), (1.0, -2.0, 0.5)
    here = energy(u, NOTHING, grid, ε, orientation(θ, 10.0))
    there = energy(u.rot90(1, (0, 1)), NOTHING, turned, ε, orientation((2.0, 1.0, 0.5), 10.0))
    assert_close(there, here, rtol=1e-12, atol=0)
    assert_close(energy(-u, NOTHING, grid, ε, orientation(θ, 10.0)), here, rtol=1e-12, atol=0)


def test_the_kernels_entry_is_the_definition() -> None:
    """Fused or not, by type and device: in float64 the definition itself, in float32 the kernel near it."""
    grid, Q = Grid((9, 10, 11), (0.013, 0.01, 0.008)), orientation((1, 2, -1), 300.0)
    u = rough(grid, 1).float()
    truth = energy_gradient_by_autograd(u.double(), VARYING, grid, 0.02, Q)
    assert_close(energy_gradient(u.double(), VARYING, grid, 0.02, Q), truth, rtol=0, atol=0)
    value, slope = energy_gradient(u, VARYING, grid, 0.02, Q)
    assert float(value) == pytest.approx(float(truth[0]), rel=1e-5) and slope.dtype == torch.float32
    assert not kernels.has_kernel("meta")


def test_a_direction_of_numbers_takes_a_map_of_strength() -> None:
    μ = torch.rand(3, 4, 5, dtype=torch.float64)
    assert torch.equal(orientation((0, 0, 2), μ)[2, 2], μ) and orientation((0, 0, 2), μ).shape == (3, 3, 3, 4, 5)
    with pytest.raises(ValueError, match="one shape"):
        orientation((0, torch.ones(3, 4, 6), 1), μ)
