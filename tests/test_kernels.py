"""The fused kernels against the plain-torch definition, and against what must hold of them whatever the definition."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

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


def torch_gradient(u: torch.Tensor, a: Coefficients, grid: Grid, ε=EPSILON, Q=None) -> tuple[float, torch.Tensor]:
    free = u.clone().requires_grad_()
    value = energy(free, a, grid, ε, Q)
    (slope,) = torch.autograd.grad(value, free)
    return float(value.detach()), slope.double()


def assert_is_the_definition(u: torch.Tensor, a: Coefficients, grid: Grid, ε=EPSILON, Q=None) -> None:
    """No farther from float64 than a few times what the definition itself loses in float32.

    The gradient has a factor 1/S, S = √X⁺, which amplifies rounding where X crosses zero: a few voxels, other ones in
    each program, so nine in ten voxels are held to the tight bound and all to the loose one.
    """
    value, slope = torch_gradient(u, a, grid, ε, Q)
    value32, slope32 = torch_gradient(u.float(), a, grid, ε, Q)
    cost = [value.numpy() if isinstance(value, torch.Tensor) else value for value in (*a, ε, Q)]
    found, gradient_found = cpu.energy_gradient(u.numpy(), cost[:6], grid, cost[6], cost[7])
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
    found, gradient_found = cpu.energy_gradient(u.numpy(), given, grid, EPSILON, turned, mask.numpy())
    error = np.abs(gradient_found - slope.numpy()) / float(slope.abs().max())
    assert found == pytest.approx(float(value.detach()), rel=1e-5)
    assert np.quantile(error, 0.9) < 1e-5 and error.max() < 1e-2


def test_arrays_of_equal_numbers_are_numbers():
    grid = Grid((6, 7, 20))
    u = smooth_field(grid).numpy()
    value, slope = cpu.energy_gradient(u, list(TUBES), grid, EPSILON)
    found, gradient_found = cpu.energy_gradient(u, np.stack([np.full(grid.shape, a) for a in TUBES]), grid, EPSILON)
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


def small_flow(grid: Grid, frozen: np.ndarray | None = None, base: float | np.ndarray = -0.3, seed: int = 4):
    start = 0.01 * np.random.default_rng(seed).standard_normal((3, *grid.shape))
    flow = cpu.FusedFlow(start, base, list(TUBES), grid, EPSILON, BLUR, frozen, betas=BETAS, adam_eps=ADAM_EPS)
    return flow, torch.from_numpy(start)


def steps(flow, count: int) -> list[tuple[float, float, float]]:
    return [(flow.evaluate(), *flow.update(1e-2)) for _ in range(count)]


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


def test_a_restored_flow_goes_on_bit_for_bit():
    grid = Grid((8, 9, 18))
    flow, _ = small_flow(grid)
    flow.shift(0.1)
    steps(flow, 3)
    state, other = flow.state(), small_flow(grid, seed=5)[0]
    expected = steps(flow, 3)
    other.restore(state)
    assert steps(other, 3) == expected
    assert np.array_equal(other.vector, flow.vector)


def test_shift_moves_the_mass():
    grid = Grid((8, 9, 18))
    for base in (-0.3, np.full(grid.shape, -0.3)):
        flow, _ = small_flow(grid, base=base)
        flow.evaluate()
        before = flow.field.copy()
        flow.shift(0.25)
        flow.evaluate()
        assert np.abs(flow.field - before - 0.25).max() < 1e-6


def test_start_may_be_filled_in_place():
    grid = Grid((8, 9, 18))
    flow, start = small_flow(grid)
    other = cpu.FusedFlow(None, -0.3, list(TUBES), grid, EPSILON, BLUR, betas=BETAS, adam_eps=ADAM_EPS)
    assert not other.vector.any()
    other.vector[...] = start
    assert steps(other, 2) == steps(flow, 2)


def test_processors_without_wide_vectors(tmp_path):
    """The same numbers where the processor has neither 512-bit vectors nor estimates of roots."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("expected an x86 processor")
    grid, path = Grid((6, 7, 20)), tmp_path / "u.npy"
    np.save(path, smooth_field(grid).numpy())
    value, slope = cpu.energy_gradient(np.load(path), list(TUBES), grid, EPSILON)
    program = """
import sys, numpy as np
from curvafit.priors.kernels import cpu, loops
u = np.load(sys.argv[1])
value, slope = cpu.energy_gradient(u, [1, 2, 6, -40, -40, 400], cpu.Grid(u.shape), 0.02)
assert loops.WIDE == 8
np.save(sys.argv[1], np.append(slope, value))
"""
    older = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"}
    subprocess.run([sys.executable, "-c", program, path], check=True, env={**os.environ, **older})
    *slope_found, value_found = np.load(path)
    assert value_found == pytest.approx(value, rel=1e-6)
    assert np.quantile(np.abs(slope_found - slope.ravel()), 0.9) < 1e-6 * np.abs(slope).max()


def test_threads_do_not_change_the_result():
    numba = pytest.importorskip("numba")
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("expected two threads, got one")
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            flow, _ = small_flow(Grid((39, 40, 51)))
            results.append((steps(flow, 3), flow.vector.copy()))
    finally:
        numba.set_num_threads(before)
    assert results[0][0] == results[1][0]
    assert np.array_equal(results[0][1], results[1][1])


def test_dispatch_by_device_and_type():
    grid = Grid((6, 7, 16))
    u = smooth_field(grid)
    varying = Coefficients(1, 2, torch.full(grid.shape, 6.0), -40, -40, 400)
    assert kernels.fused("cpu")
    assert not kernels.fused("meta")
    value, slope = torch_gradient(u, TUBES, grid)
    for field, a, tolerance in ((u, TUBES, 1e-12), (u.float(), TUBES, 1e-3), (u.float(), varying, 1e-3)):
        found, gradient_found = kernels.energy_gradient(field, a, grid, EPSILON)
        assert gradient_found.dtype == field.dtype
        assert found == pytest.approx(value, rel=max(tolerance / 100, 1e-12))
        assert float((gradient_found.double() - slope).abs().max()) <= tolerance * float(slope.abs().max())


def test_wrong_shapes_and_orientations_are_refused():
    grid = Grid((6, 7, 16))
    with pytest.raises(ValueError, match="expected a field of shape"):
        cpu.energy_gradient(np.zeros((6, 7, 15), np.float32), list(TUBES), grid, EPSILON)
    with pytest.raises(ValueError, match="expected a number or an array of shape"):
        cpu.energy_gradient(np.zeros(grid.shape), list(TUBES), grid, np.full((6, 7, 15), EPSILON))
    with pytest.raises(ValueError, match="expected a symmetric 3×3 orientation"):
        cpu.energy_gradient(np.zeros(grid.shape), list(TUBES), grid, EPSILON, np.tri(3))
    with pytest.raises(ValueError, match="expected a field of shape"):
        cpu.gaussian_blur(np.zeros((6, 7, 15), np.float32), grid, BLUR)
