"""What pins the parameters of a phase field down, and what does not: its stationarity."""

import math
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module

import nibabel
import numpy as np
import pytest
import torch
from emulated import BOX, linear, reading, row
from loss_cases import noise

from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.inference.emulator import best_parameters
from curvafit.inference.stationary import clip_to_domain, energy_gradients, integrate_columns, stationarity
from curvafit.priors import WORKING_EPSILON, Coefficients, Grid, energy_terms, jet, preset
from curvafit.scan.structure import is_rounded

EDGE = 36
GRID = Grid((EDGE,) * 3)
FAR = Coefficients(1, 0.5, 3, 30, -20, 100)
TRUTH = preset("sponge")
#: The module, which has a function of its own name.
room = import_module("curvafit.inference.stationary")


@pytest.fixture(scope="module")
def sponge() -> torch.Tensor:
    """A sponge flowed until it is nearly stationary."""
    flow = generate(TRUTH.coefficients, TRUTH.mass, GRID, schedule=schedule("cosine", steps=1000), seed=0)
    assert flow.viability.viable
    return flow.field


@pytest.fixture(scope="module")
def found(sponge: torch.Tensor):
    return stationarity(sponge, GRID, WORKING_EPSILON, starts=[FAR])


def held(law: Coefficients) -> list[float]:
    """The coefficients but a20, the gauge, and a00, which is held weakly."""
    return [float(value) for value in law][1:5]


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_gradients_of_the_six_terms_are_autograds(boundary: str) -> None:
    grid = Grid((30, 7, 9), 0.01, boundary)  # type: ignore[arg-type]
    u = (0.8 * torch.tanh(noise(*grid.shape))).requires_grad_()
    each = energy_gradients(u.detach(), grid, WORKING_EPSILON)
    inside = (slice(None) if grid.periodic else slice(1, -1),) * 3
    for k, term in enumerate(energy_terms(jet(u, grid), WORKING_EPSILON)):
        (whole,) = torch.autograd.grad(term.sum(), u, retain_graph=True)
        torch.testing.assert_close(each[k][inside], whole[inside], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_stationarity_finds_what_made_a_field(found) -> None:
    assert held(found.coefficients) == pytest.approx(held(TRUTH.coefficients), rel=0.1)
    assert found.coefficients.a20 == 1
    assert found.mass == pytest.approx(TRUTH.mass, abs=1e-5)
    assert found.name == "stationarity" and found.status.startswith("Stationarity is supported")


def test_all_starts_end_at_the_whitened_singular_vector(sponge: torch.Tensor) -> None:
    """The constrained minimum is inside the domain here, so it is the unconstrained one; its value is 1 by the
    choice of the error's size."""
    _, problem, _ = room.weak_form(sponge.double(), GRID, WORKING_EPSILON)
    best, singular = room.total_least_squares(problem)
    starts = np.stack(
        [clip_to_domain(each) for each in (best, np.array(list(FAR)) / room.unit_factors(WORKING_EPSILON))]
    )
    solutions, residuals = room.solve([problem] * 2, starts)
    np.testing.assert_allclose(residuals, singular[-1], rtol=1e-4)
    np.testing.assert_allclose(solutions / solutions[:, :1], np.stack([best / best[0]] * 2), rtol=1e-2)
    assert len(singular) == 6
    assert singular[-1] == pytest.approx(1, abs=0.2)
    assert sorted(singular, reverse=True) == list(singular)


def test_deviations_cover_the_error_within_a_few(found) -> None:
    assert found.uncertainty["a20"] == 0
    for name in ("a11", "a02", "a10", "a01", "a00"):
        miss = abs(getattr(found.coefficients, name) - getattr(TRUTH.coefficients, name))
        assert miss < 6 * found.uncertainty[name], name


@pytest.mark.slow
def test_a_field_that_is_not_stationary_is_not_said_to_be(sponge: torch.Tensor) -> None:
    bent = (sponge + 0.05 * torch.sin(torch.linspace(0, 6 * math.pi, EDGE))).clamp(-1, 1)
    own, other = (room.weak_form(u.double(), GRID, WORKING_EPSILON)[2] for u in (sponge, bent))
    assert other > 5 * own


@pytest.mark.slow
def test_a_shift_changes_nothing(sponge: torch.Tensor, found) -> None:
    """An even shift maps octants and the propagated noise elsewhere, the equations onto themselves."""
    moved = stationarity(sponge.roll((6, 10, 4), (0, 1, 2)), GRID, WORKING_EPSILON)
    assert held(moved.coefficients) == pytest.approx(held(found.coefficients), rel=0.02)


@pytest.mark.slow
def test_the_mirror_image_has_mirrored_coefficients(sponge: torch.Tensor, found) -> None:
    """F_ε[-u; a] = F_ε[u; a'], so -u gives a', in the gauge a20 = 1."""
    mirrored = found.coefficients.mirror()
    inside_out = stationarity(-sponge, GRID, WORKING_EPSILON).coefficients
    assert held(inside_out) == pytest.approx(held(mirrored.scale(1 / mirrored.a20)), rel=0.02)


@pytest.mark.slow
def test_a_crop_says_what_its_inside_says(sponge: torch.Tensor) -> None:
    """The equations of a crop are those of the whole field: its border's continuation is never read."""
    grid, width = Grid((32, 32, 32), 0.01, "replicate"), 2.5
    whole = integrate_columns(energy_gradients(sponge.double(), GRID, WORKING_EPSILON), GRID, WORKING_EPSILON, width)
    crop = sponge[:32, :32, :32].double()
    part = integrate_columns(energy_gradients(crop, grid, WORKING_EPSILON), grid, WORKING_EPSILON, width)
    assert part.shape == (6, 4, 4, 4)
    np.testing.assert_allclose(part, whole[:, 6:10, 6:10, 6:10], rtol=1e-6, atol=1e-9 * np.abs(whole).max())
    cropped = stationarity(crop, grid, WORKING_EPSILON).coefficients
    assert held(cropped) == pytest.approx(held(TRUTH.coefficients), rel=0.1)


def test_refusals_and_a_rounded_field(sponge: torch.Tensor) -> None:
    rounded = torch.floor(sponge * 100) / 100
    assert is_rounded(rounded) and not is_rounded(sponge)
    assert "not supported" in stationarity(rounded, GRID, WORKING_EPSILON).status
    small = Grid((20, 20, 20), 0.01, "replicate")  # type: ignore[arg-type]
    for field, grid, word in (
        (sponge[:20, :20, :20], small, "crop of at least 28"),
        (sponge.clone().fill_(math.nan), GRID, "finite"),
        (sponge[:-1], GRID, "shape"),
    ):
        with pytest.raises(ValueError, match=word):
            stationarity(field, grid, WORKING_EPSILON)


def test_gauge_and_domain() -> None:
    coefficients, fixed = room.fix_gauge(np.array([2.0, 4, 8, -20, 6, 100]))
    assert list(coefficients) == [1, 2, 4, -10, 3, 50] and fixed == 0
    coefficients, fixed = room.fix_gauge(np.array([1e-5, 4, 2.0, 0, 0, 0]))
    assert coefficients.a02 == 1 and fixed == 2
    inside = clip_to_domain(np.array([-0.2, 1.0, 4.2, 1, 1, 1]))
    assert inside[0] > 0 and inside[2] > 0 and inside[0] + inside[2] == pytest.approx(2)
    a = Coefficients(1, 2, 3, 4, 5, 6)
    assert np.array(list(a)) / room.unit_factors(0.5) == pytest.approx(list(a.in_unit(0.5)))


@pytest.mark.slow
def test_the_authors_sponge_gives_its_coefficients_back(data) -> None:
    (path,) = (data / "gallery").glob("sponge coeffs*.nii.gz")
    field = torch.from_numpy(np.asarray(nibabel.load(path).dataobj, dtype=np.float32))
    found = stationarity(field, Grid((100, 100, 100)), WORKING_EPSILON, starts=[Coefficients(1, 0, 1)])
    assert held(found.coefficients) == pytest.approx(held(TRUTH.coefficients), rel=0.05)
    assert found.mass == pytest.approx(TRUTH.mass, abs=1e-4)
    assert found.name == "stationarity" and found.coefficients.a20 == 1


@pytest.mark.slow
def test_a_fit_in_float64_leaves_jax_as_it_is() -> None:
    """As other threads see it while fits run, two at once, and afterwards."""
    import jax
    import jax.numpy as jnp

    before, at = jax.config.jax_enable_x64, BOX.mean(1)
    with ThreadPoolExecutor(3) as pool:
        asked = (best_parameters, linear(), reading(row(at[None])[0]), np.tile(at, (8, 1)))
        fits = [pool.submit(*asked) for _ in range(2)]
        seen = {pool.submit(lambda: jax.config.jax_enable_x64).result() for _ in range(20)}
        ends = [fit.result() for fit in fits]
    assert seen == {before} and jax.config.jax_enable_x64 == before
    assert jnp.ones(1).dtype == (jnp.float64 if before else jnp.float32)
    for end, _ in ends:
        assert end == pytest.approx(at, abs=1e-4 * np.ptp(BOX))
