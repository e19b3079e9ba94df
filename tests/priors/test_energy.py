"""F_ε: its value on exact profiles, its relatives, its laws, its derivatives, and how a grid errs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from exact import Torus, centres, diffuse_integrals, exact_jet, grid_integrals, profile

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import Jet, diffuse_curvatures, jet, second_form
from curvafit.priors.energy import cahn_hilliard_area, discrepancy_ratio, energy, energy_terms
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import SIGMA, double_well_derivative, optimal_profile
from curvafit.priors.stencils import divergence, gaussian_blur

UNEQUAL = Coefficients(1.3, -0.7, 4.0, -20.0, 35.0, 150.0)
BOUNDARIES = ["periodic", "replicate"]
TORUS = Torus(2.0, 1.0)


def rough(grid: Grid, seed: int = 0, *batch: int) -> torch.Tensor:
    """A blurred noise with values of order one, `(*batch, Z, Y, X)` float64."""
    noise = torch.randn(*batch, *grid.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    u = gaussian_blur(noise, grid, 1.2 * max(grid.spacing))
    return 0.7 * u / u.std()


def weighted(terms: torch.Tensor, a: Coefficients) -> torch.Tensor:
    return torch.einsum("k,kzyx->zyx", a.tensor(terms.dtype), terms)


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


def curvature_integral(u: torch.Tensor, a: Coefficients, grid: Grid, ε: float) -> torch.Tensor:
    """𝓔_ε(u)."""
    return curvature_density(jet(u, grid), a, ε).sum((-3, -2, -1)) * grid.voxel_volume


def unsimplified_energy(u: torch.Tensor, a: Coefficients, grid: Grid, ε: float) -> torch.Tensor:
    """𝓔̃_ε(u)."""
    return unsimplified_density(jet(u, grid), a, ε).sum((-3, -2, -1)) * grid.voxel_volume


# ---- values ----------------------------------------------------------------------------------------------------------


def test_exact_jets_sum_to_the_coarea_integral() -> None:
    """With exact derivatives a sum over voxels has no order: F_ε of a torus's profile is ∫ √(2W(t)) ∫ p dA dt."""
    torus, ε, h = Torus(2.0, 1.0), 0.2, 0.1
    grid = Grid((21, 42, 42), (h, h, h), "replicate")
    field = exact_jet(lambda p: profile(torus, p, ε), centres(grid))
    found = 8 * h**3 / SIGMA * energy_terms(field, ε).sum((-3, -2, -1))
    truth = diffuse_integrals(torus, ε, 0.98)
    np.testing.assert_allclose(found.numpy(), truth, rtol=0.005, atol=0.05)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_three_forms_are_equal_on_exact_profiles(unit: float) -> None:
    """𝓔_ε, 𝓔̃_ε and F_ε, point by point, but for ξ and the root's floor, which have units."""
    torus, ε = Torus(1.4 * unit, 0.6 * unit), 0.1 * unit
    cloud = 4.4 * unit * (torch.rand(8000, 3, generator=torch.Generator().manual_seed(0)).double() - 0.5)
    points = cloud[torus.distance(cloud).abs() < 2 * ε][:200, None, None]
    field, a = exact_jet(lambda p: profile(torus, p, ε), points), UNEQUAL.in_unit(1 / unit)
    full = weighted(energy_terms(field, ε), a)
    for other in (unsimplified_density(field, a, ε), curvature_density(field, a, ε)):
        torch.testing.assert_close(other, full, rtol=0, atol=(1e-9 if unit < 1 else 1e-4) * float(full.abs().max()))


def measured_gap(u: torch.Tensor, grid: Grid, ε: float) -> tuple[float, float]:
    """(𝓔_ε - F_ε) / F_ε and (𝓔̃_ε - F_ε) / F_ε for |κ|² = κ1² + κ2² and a unit of area."""
    a = Coefficients(1, 0, 1, a00=1)
    whole = float(energy(u, a, grid, ε))
    gaps = (float(form(u, a, grid, ε)) - whole for form in (curvature_integral, unsimplified_energy))
    first, second = (gap / whole for gap in gaps)
    return first, second


@pytest.mark.slow
def test_forms_part_on_a_generated_field() -> None:
    """Dropping the positive part only ever lowers the |M|² term (a20 + a02 > a11), so 𝓔̃_ε ≥ F_ε."""
    grid, ε = Grid((20, 20, 20), (0.01,) * 3), 0.02
    u = short_flow(grid, ε)
    assert float(u.max()) > 0.5
    first, second = measured_gap(u, grid, ε)
    assert 0 < second < 0.02
    assert abs(first - second) < 1e-3


def test_forms_part_on_the_gallerys_fields(data) -> None:
    import nibabel

    found = sorted((data / "gallery").glob("sponge*.nii.gz"))
    if not found:
        pytest.skip(f"needs the gallery in {data}")
    u = torch.from_numpy(nibabel.load(found[0]).get_fdata(dtype=np.float32)[:, :50, :50].copy())
    first, second = measured_gap(u, Grid(tuple(u.shape), (0.01,) * 3, "replicate"), 0.02)
    assert 0 < second < 0.005
    assert abs(first - second) < 1e-3


def short_flow(grid: Grid, ε: float) -> torch.Tensor:
    """Eighty Adam steps down F_ε of `tubes` from noise, mass held by a divergence."""
    a, mass = preset("tubes").coefficients, preset("tubes").mass
    A = 0.4 * torch.rand(3, *grid.shape, generator=torch.Generator().manual_seed(0))
    A.requires_grad_()
    optimiser = torch.optim.Adam([A], lr=1e-2, eps=1e-2)
    for _ in range(80):
        optimiser.zero_grad()
        energy(gaussian_blur(divergence(A, grid) + mass, grid, ε), a, grid, ε).backward()
        optimiser.step()
    return gaussian_blur(divergence(A.detach(), grid) + mass, grid, ε)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_helfrich_and_willmore_are_their_own_formulas(boundary: str) -> None:
    """(1/ε) ∫ (ε Δu - W'/ε)² and χ_b/2ε (Tr M - ε|∇u| H0)² + χ_G/2ε ((Tr M)² - |M|²), but for ξ."""
    grid, ε = Grid((8, 9, 10), (0.2, 0.3, 0.25), boundary), 0.5  # type: ignore[arg-type]
    u = rough(grid)
    field = jet(u, grid)
    laplacian = field.hessian[:3].sum(0)
    willmore = (ε * laplacian - double_well_derivative(u) / ε).square().sum() / ε * grid.voxel_volume
    assert float(energy(u, Coefficients.willmore(), grid, ε)) == pytest.approx(float(willmore), rel=1e-8)
    trace, norm2, _, slope = second_form(field, ε)
    χb, χG, H0 = 3.0, -1.5, 2.0
    density = χb / (2 * ε) * (trace - ε * slope * H0) ** 2 + χG / (2 * ε) * (trace**2 - norm2)
    helfrich = energy(u, Coefficients.helfrich(χb, χG, H0), grid, ε)
    assert float(helfrich) == pytest.approx(float(density.sum()) * grid.voxel_volume, rel=1e-8)


# ---- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [energy, unsimplified_energy, curvature_integral])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_mirror_law(form, boundary: str) -> None:
    """F_ε[-u; a] = F_ε[u; a'] with a20 ↔ a02, a10 → -a01, a01 → -a10."""
    grid = Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary)  # type: ignore[arg-type]
    u = rough(grid)
    there, back = form(-u, UNEQUAL, grid, 0.5), form(u, UNEQUAL.mirror(), grid, 0.5)
    torch.testing.assert_close(there, back, rtol=1e-12, atol=0)
    assert abs(float(there - form(u, UNEQUAL, grid, 0.5))) > 1e-3 * abs(float(there))


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_rotations_and_reflections(boundary: str) -> None:
    grid = Grid((6, 7, 8), (0.2, 0.3, 0.25), boundary)  # type: ignore[arg-type]
    u = rough(grid)
    value = energy(u, UNEQUAL, grid, 0.5)
    turned = Grid((7, 6, 8), (0.3, 0.2, 0.25), boundary)  # type: ignore[arg-type]
    torch.testing.assert_close(energy(u.rot90(1, (0, 1)), UNEQUAL, turned, 0.5), value, rtol=1e-12, atol=0)
    torch.testing.assert_close(energy(u.flip(2), UNEQUAL, grid, 0.5), value, rtol=1e-12, atol=0)


def test_periodic_shifts() -> None:
    grid = Grid((6, 7, 8), (0.2, 0.3, 0.25))
    u = rough(grid)
    shifted = energy(u.roll((2, 3, 5), (0, 1, 2)), UNEQUAL, grid, 0.5)
    torch.testing.assert_close(shifted, energy(u, UNEQUAL, grid, 0.5), rtol=1e-12, atol=0)


def test_change_of_length_unit() -> None:
    """Lengths a tenth, coefficients in the new unit: the same number, up to ξ and the root's floor."""
    grid = Grid((8, 8, 8), (0.02, 0.03, 0.025))
    tenth = Grid((8, 8, 8), (0.002, 0.003, 0.0025))
    u = rough(grid)
    mine, theirs = energy(u, UNEQUAL, grid, 0.05), energy(u, UNEQUAL.in_unit(10.0), tenth, 0.005)
    torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=0)


def test_linear_in_the_coefficients_and_terms_exposed() -> None:
    grid, ε = Grid((6, 7, 8), (0.2, 0.3, 0.25)), 0.5
    u = rough(grid)
    parts = energy_terms(jet(u, grid), ε).sum((-3, -2, -1)) * grid.voxel_volume
    assert parts.shape == (6,)
    torch.testing.assert_close(energy(u, UNEQUAL, grid, ε), parts @ UNEQUAL.tensor(), rtol=1e-12, atol=0)
    # κ1² + κ2² - 2κ1κ2 is (κ1 - κ2)²: the root's square, its positive part dropped.
    trace, norm2, _, _ = second_form(jet(u, grid), ε)
    square = ((2 * norm2 - trace**2) / ε).sum() * grid.voxel_volume
    torch.testing.assert_close(parts[0] + parts[2] - 2 * parts[1], square, rtol=1e-10, atol=0)


def test_batches_precision_and_coefficients_in_space() -> None:
    grid, ε = Grid((6, 7, 8), (0.2, 0.3, 0.25), "replicate"), 0.5
    u = rough(grid, 1, 2)
    each = torch.stack([energy(part, UNEQUAL, grid, ε) for part in u])
    torch.testing.assert_close(energy(u, UNEQUAL, grid, ε), each, rtol=1e-12, atol=0)
    torch.testing.assert_close(energy(u.float(), UNEQUAL, grid, ε).double(), each, rtol=1e-4, atol=0)
    a00 = torch.linspace(0, 200, 8, dtype=torch.float64)
    spatial = Coefficients(*list(UNEQUAL)[:5], a00=a00)
    terms = energy_terms(jet(u[0], grid), ε)
    flat = energy(u[0], Coefficients(*list(UNEQUAL)[:5]), grid, ε)
    extra = (a00 * terms[5]).sum() * grid.voxel_volume
    torch.testing.assert_close(energy(u[0], spatial, grid, ε), flat + extra, rtol=1e-12, atol=0)


# ---- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradients_by_finite_differences(boundary: str) -> None:
    """In the field and in the coefficients. No root's argument is within its smoothing of 0: it would be stiff."""
    grid, ε = Grid((4, 5, 4), (0.2, 0.3, 0.25), boundary), 0.5  # type: ignore[arg-type]
    u = rough(grid, 3).requires_grad_()
    trace, norm2, _, _ = second_form(jet(u.detach(), grid), ε)
    assert float((2 * norm2 - trace**2).abs().min()) > 1e-4
    a = UNEQUAL.tensor().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v, c: energy(v, Coefficients(*c.unbind()), grid, ε), (u, a), eps=1e-7, atol=1e-4, rtol=1e-5
    )


def test_gradients_are_finite_on_flat_and_floored_fields() -> None:
    """Where ∇u = 0 nothing divides by it."""
    grid = Grid((6, 6, 6), (0.01,) * 3)
    for u in (torch.full((6, 6, 6), -0.4), torch.full((6, 6, 6), 1.0), rough(grid).float().round(decimals=1)):
        free = u.clone().requires_grad_()
        (slope,) = torch.autograd.grad(energy(free, preset("tubes").coefficients, grid, 0.02), free)
        assert bool(torch.isfinite(slope).all())


# ---- area ------------------------------------------------------------------------------------------------------------


def test_cahn_hilliard_area_of_a_plane_from_below() -> None:
    """σ a unit of area; central differences underestimate |∇u|², so the sum comes from below, at second order."""
    ε, found = 0.05, []
    for n in (40, 80):
        grid = Grid((n, 4, 4), (1 / n, 0.25, 0.25), "replicate")
        d = centres(grid)[..., 0] - 0.5
        found.append(float(cahn_hilliard_area(optimal_profile(d, ε), grid, ε)))
    errors = [value - SIGMA for value in found]
    assert errors[0] < errors[1] < 0
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)


def test_discrepancy_is_zero_for_the_profile_and_one_for_a_constant() -> None:
    ε, grid = 0.1, Grid((200, 4, 4), (0.01, 0.1, 0.1), "replicate")
    u = optimal_profile(centres(grid)[..., 0] - 1.0, ε)
    assert float(discrepancy_ratio(u, grid, ε)) < 0.01
    assert float(discrepancy_ratio(torch.full_like(u, -0.6), grid, ε)) == pytest.approx(1)
    steep = optimal_profile(centres(grid)[..., 0] - 1.0, ε / 2)
    assert 0.5 < float(discrepancy_ratio(steep, grid, ε)) < 1


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


def test_energy_of_a_field_is_a_sum_not_a_mean() -> None:
    """Two periods hold twice the energy."""
    grid = Grid((6, 6, 6), (0.2, 0.2, 0.2))
    u = rough(grid)
    twice = Grid((12, 6, 6), (0.2, 0.2, 0.2))
    torch.testing.assert_close(
        energy(torch.cat([u, u]), UNEQUAL, twice, 0.5), 2 * energy(u, UNEQUAL, grid, 0.5), rtol=1e-12, atol=0
    )


def test_jets_are_what_energy_reads() -> None:
    grid = Grid((5, 5, 5), (0.2, 0.2, 0.2))
    u = rough(grid)
    field = jet(u, grid)
    assert isinstance(field, Jet)
    assert field.gradient.shape == (3, 5, 5, 5) and field.hessian.shape == (6, 5, 5, 5)
