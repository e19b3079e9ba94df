"""The fused kernels against the plain-torch definition, and against what must hold of them whatever the definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

cpu = pytest.importorskip("curvafit.priors.kernels.cpu")

BOUNDARIES = ("periodic", "replicate")
SPACINGS = ((0.01, 0.01, 0.01), (0.013, 0.01, 0.008))
TUBES = Coefficients(1, 2, 6, -40, -40, 400)
BETAS, ADAM_EPS, BLUR, EPSILON = (0.9, 0.999), 1e-2, 0.02, 0.02


def smooth_field(grid: Grid, seed: int = 0, rms: float = 0.8) -> torch.Tensor:
    """A blurred noise in float64, about as rough as a phase field."""
    noise = torch.randn(grid.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    field = gaussian_blur(noise, grid, 0.02)
    return field * rms / field.std() - 0.3


def torch_gradient(u: torch.Tensor, a: Coefficients, grid: Grid) -> tuple[float, torch.Tensor]:
    free = u.clone().requires_grad_()
    value = energy(free, a, grid, EPSILON)
    (slope,) = torch.autograd.grad(value, free)
    return float(value.detach()), slope.double()


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("shape", [(12, 9, 21), (4, 5, 16), (5, 4, 4)])
def test_energy_and_gradient_are_the_definitions(shape, spacing, boundary):
    """No farther from float64 than a few times what the definition itself loses in float32.

    The gradient has a factor 1/S, S = √X⁺, which amplifies rounding where X crosses zero: a few voxels, other ones in
    each program, so nine in ten voxels are held to the tight bound and all to the loose one.
    """
    grid = Grid(shape, spacing, boundary)
    a = Coefficients(1.3, -0.7, 4.0, -60.0, 35.0, 500.0)
    u = smooth_field(grid)
    value, slope = torch_gradient(u, a, grid)
    value32, slope32 = torch_gradient(u.float(), a, grid)
    found, gradient_found = cpu.energy_gradient(u.numpy(), list(a), grid, EPSILON)
    assert abs(found - value) <= 4 * abs(value32 - value) + 1e-6 * abs(value)
    scale = float(slope.abs().max())
    error, error32 = np.abs(gradient_found - slope.numpy()) / scale, (slope32 - slope).abs().numpy() / scale
    assert np.quantile(error, 0.9) <= 4 * np.quantile(error32, 0.9) + 1e-6
    assert error.max() < 1e-2


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradient_predicts_the_energy(boundary):
    """⟨∂F/∂u, δ⟩ against the central difference of the plain energy in float64: the adjoint's test at the walls too."""
    grid = Grid((10, 11, 18), 0.01, boundary)
    u, direction = smooth_field(grid, 1), smooth_field(grid, 2, rms=1.0)
    step = 1e-5
    ahead, behind = (energy(u + sign * step * direction, TUBES, grid, EPSILON) for sign in (1, -1))
    change = float(ahead - behind)
    _, slope = cpu.energy_gradient(u.numpy(), list(TUBES), grid, EPSILON)
    assert float((torch.from_numpy(slope).double() * direction).sum()) == pytest.approx(change / (2 * step), rel=1e-4)


def test_gradient_vanishes_on_pure_phases():
    grid = Grid((6, 7, 20))
    for phase in (1.0, -1.0):
        value, slope = cpu.energy_gradient(np.full(grid.shape, phase, np.float32), list(TUBES), grid, EPSILON)
        assert value == 0
        assert np.abs(slope).max() < 1e-9


def test_a_lost_value_shows():
    """NaN anywhere makes the energy NaN: fast arithmetic must not hide it."""
    grid = Grid((6, 6, 20))
    u = smooth_field(grid).numpy().astype(np.float32)
    u[3, 2, 19] = np.nan
    assert np.isnan(cpu.energy_gradient(u, list(TUBES), grid, EPSILON)[0])


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


def small_flow(grid: Grid, frozen: np.ndarray | None = None, base: float | np.ndarray = -0.3):
    start = 0.01 * np.random.default_rng(4).standard_normal((3, *grid.shape))
    flow = cpu.FusedFlow(start, base, list(TUBES), grid, EPSILON, BLUR, frozen, betas=BETAS, adam_eps=ADAM_EPS)
    return flow, torch.from_numpy(start)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
def test_first_step_is_the_definitions(spacing, boundary):
    """u of A, F_ε, the statistics of ∂F_ε/∂A, and A after one step of torch's Adam, with a base that varies."""
    grid = Grid((11, 9, 21), spacing, boundary)
    base = gaussian_blur(smooth_field(grid, 5), grid, BLUR)
    flow, start = small_flow(grid, base=base.numpy())
    vector = start.clone().requires_grad_()
    adam = torch.optim.Adam([vector], lr=1e-2, betas=BETAS, eps=ADAM_EPS)
    u = gaussian_blur(divergence(vector, grid), grid, BLUR) + base
    value = energy(u, TUBES, grid, EPSILON)
    value.backward()
    assert flow.evaluate() == pytest.approx(float(value.detach()), rel=1e-6)
    assert np.abs(flow.field - u.detach().numpy()).max() < 2e-6
    size = vector.grad.abs()
    highest, mean = flow.update(1e-2)
    assert highest == pytest.approx(float(size.max()), rel=1e-3)
    assert mean == pytest.approx(float(size.mean()), rel=1e-3)
    adam.step()
    # A step is rate·g / (|g| + eps): an error of 1e-3·eps in g costs a thousandth of the longest step.
    assert np.abs(flow.vector - vector.detach().numpy()).max() < 1e-2 * 1e-2


def test_adam_is_torchs():
    """Twenty steps of the fused Adam against torch's on the gradients that the fused flow itself sees."""
    grid = Grid((8, 9, 18))
    flow, start = small_flow(grid)
    vector = start.clone().requires_grad_()
    adam = torch.optim.Adam([vector], betas=BETAS, eps=ADAM_EPS)
    for step in range(20):
        rate = 1e-3 * (1 + step % 3)
        flow.evaluate()
        _, slope = cpu.energy_gradient(flow.field, list(TUBES), grid, EPSILON)
        vector.grad = -gradient(gaussian_blur(torch.from_numpy(slope).double(), grid, BLUR), grid)
        adam.param_groups[0]["lr"] = rate
        adam.step()
        flow.update(rate)
    assert np.abs(vector.detach().numpy() - start.numpy()).max() > 1e-2
    assert np.abs(flow.vector - vector.detach().numpy()).max() < 1e-5


def test_frozen_voxels_keep_their_vector():
    grid = Grid((8, 9, 18))
    frozen = np.random.default_rng(6).random(grid.shape) > 0.5
    flow, start = small_flow(grid, frozen)
    for _ in range(3):
        flow.evaluate()
        flow.update(1e-2)
    moved = np.abs(flow.vector - start.numpy().astype(np.float32))
    assert not moved[:, frozen].any()
    assert (moved[:, ~frozen] > 0).all()


def test_threads_do_not_change_the_result():
    numba = pytest.importorskip("numba")
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("expected two threads, got one")
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            flow, _ = small_flow(Grid((39, 40, 51)))
            for _ in range(3):
                value = flow.evaluate()
                flow.update(1e-2)
            results.append((value, flow.vector.copy()))
    finally:
        numba.set_num_threads(before)
    assert results[0][0] == results[1][0]
    assert np.array_equal(results[0][1], results[1][1])


def test_dispatch_by_device_and_coefficients():
    grid = Grid((6, 7, 16))
    u = smooth_field(grid)
    varying = Coefficients(1, 2, torch.full(grid.shape, 6.0), -40, -40, 400)
    assert kernels.fused("cpu", TUBES)
    assert not kernels.fused("cpu", varying)
    assert not kernels.fused("meta", TUBES)
    value, slope = torch_gradient(u, TUBES, grid)
    for field, a, tolerance in ((u, TUBES, 1e-12), (u.float(), TUBES, 1e-3), (u.float(), varying, 1e-3)):
        found, gradient_found = kernels.energy_gradient(field, a, grid, EPSILON)
        assert gradient_found.dtype == field.dtype
        assert found == pytest.approx(value, rel=max(tolerance / 100, 1e-12))
        assert float((gradient_found.double() - slope).abs().max()) <= tolerance * float(slope.abs().max())


def test_wrong_shapes_are_refused():
    grid = Grid((6, 7, 16))
    with pytest.raises(ValueError, match="expected a field of shape"):
        cpu.energy_gradient(np.zeros((6, 7, 15), np.float32), list(TUBES), grid, EPSILON)
    with pytest.raises(ValueError, match="expected a field of shape"):
        cpu.gaussian_blur(np.zeros((6, 7, 15), np.float32), grid, BLUR)
