"""The fused kernels against the plain-torch definition, and against what must hold of them whatever the definition."""

import os
import platform
import subprocess
import sys

import numba
import numpy as np
import pytest
import torch
from kernel_cases import ADAM_EPS, BETAS, BLUR, BOUNDARIES, EPSILON, SPACINGS, TUBES, smooth_field

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import energy, energy_gradient, energy_gradient_by_autograd
from curvafit.priors.grid import Grid
from curvafit.priors.kernels import cpu
from curvafit.priors.kernels.threads import count_threads
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

#: Symmetric, with every entry at work: mirrors change its signs.
ORIENTATION = torch.tensor([[300.0, 50.0, -100.0], [50.0, 200.0, 70.0], [-100.0, 70.0, -100.0]], dtype=torch.float64)
UNEQUAL = Coefficients(1.3, -0.7, 4.0, -60.0, 35.0, 500.0)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(
    ("shape", "varies"),
    [
        ((12, 9, 21), ""), ((4, 5, 16), ""), ((5, 4, 4), ""), ((9, 8, 13), "orientation"),
        ((9, 8, 13), "coefficients"), ((9, 8, 13), "orientation, coefficients"),
        ((9, 8, 35), "mask"), ((9, 8, 35), "orientation, coefficients, mask"),
        ((9, 8, 13), "orientation, directions"), ((9, 8, 35), "orientation, directions, coefficients, mask"),
    ],
)  # fmt: skip
def test_energy_and_gradient_are_the_definitions(shape, varies, spacing, boundary):
    """No farther from float64 than a few times what the definition itself loses in float32.

    The gradient has a factor 1/S, S = √X⁺, which amplifies rounding where X crosses zero: a few voxels, other ones in
    each program, so nine in ten voxels are held to the tight bound and all to the loose one. Numbers and fields may be
    mixed; a mask has its own kernel, which what varies takes too.
    """
    grid = Grid(shape, spacing, boundary)
    u, a = smooth_field(grid), list(TUBES if varies else UNEQUAL)
    if "coefficients" in varies:
        a[1], a[3], a[5] = (a[k] * (1 + 0.3 * smooth_field(grid, k)) for k in (1, 3, 5))
    Q = ORIENTATION if "orientation" in varies else None
    if "directions" in varies:
        Q = ORIENTATION[..., None, None, None] * (1 + smooth_field(grid, 7)) + 50 * torch.eye(3)[..., None, None, None]
    mask = (smooth_field(grid, 5) > -0.3) * (1 + smooth_field(grid, 6).abs()) if "mask" in varies else None
    cost = Coefficients(*a), grid, EPSILON, Q, mask
    (value, slope), (value32, slope32) = (energy_gradient_by_autograd(each, *cost) for each in (u, u.float()))
    found, gradient_found = energy_gradient(u.float(), *cost)
    assert abs(found - value) <= 4 * abs(value32 - value) + 1e-6 * abs(value)
    scale = float(slope.abs().max())
    error, error32 = (gradient_found - slope).abs().numpy() / scale, (slope32 - slope).abs().numpy() / scale
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
    _, slope = cpu.fused_energy_gradient(u.numpy(), list(TUBES), grid, EPSILON)
    assert float((torch.from_numpy(slope).double() * direction).sum()) == pytest.approx(change / (2 * step), rel=1e-4)


def test_gradient_vanishes_on_pure_phases_and_a_lost_value_shows():
    """NaN anywhere makes the energy NaN: fast arithmetic must not hide it."""
    grid = Grid((6, 7, 20))
    for phase in (1.0, -1.0):
        value, slope = cpu.fused_energy_gradient(np.full(grid.shape, phase, np.float32), list(TUBES), grid, EPSILON)
        assert value == 0
        assert np.abs(slope).max() < 1e-9
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


def test_wrong_shapes_and_orientations_are_refused():
    grid, u, law = Grid((6, 7, 16)), np.zeros((6, 7, 16), np.float32), list(TUBES)
    odd = torch.ones(3, 3).tril()
    for word, call in (
        ("field", lambda: cpu.fused_energy_gradient(u[..., 1:], law, grid, EPSILON)),
        ("symmetric", lambda: energy_gradient(torch.from_numpy(u), law, grid, EPSILON, odd)),
        ("field", lambda: cpu.gaussian_blur(u[..., 1:], grid, BLUR)),
    ):
        with pytest.raises(ValueError, match=word):
            call()


# ---- the flow's steps ------------------------------------------------------------------------------------------------


GRID = Grid((8, 9, 18))
x86 = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="needs an x86 processor")


def small_flow(grid: Grid, base: float | np.ndarray = -0.3, seed: int = 4):
    start = 0.01 * np.random.default_rng(seed).standard_normal((3, *grid.shape))
    flow = cpu.FusedFlow(start, base, list(TUBES), grid, EPSILON, BLUR, betas=BETAS, adam_eps=ADAM_EPS)
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
    flow, start = small_flow(GRID)
    vector = start.clone().requires_grad_()
    adam = torch.optim.Adam([vector], betas=BETAS, eps=ADAM_EPS)
    for step in range(20):
        rate = 1e-3 * (1 + step % 3)
        flow.evaluate()
        _, slope = cpu.fused_energy_gradient(flow.field, list(TUBES), GRID, EPSILON)
        vector.grad = -gradient(gaussian_blur(torch.from_numpy(slope).double(), GRID, BLUR), GRID)
        adam.param_groups[0]["lr"] = rate
        adam.step()
        flow.update(rate)
    assert np.abs(vector.detach().numpy() - start.numpy()).max() > 1e-2
    assert np.abs(flow.vector - vector.detach().numpy()).max() < 1e-5


def test_a_restored_flow_goes_on_bit_for_bit():
    flow, _ = small_flow(GRID)
    flow.shift(0.1)
    steps(flow, 3)
    state, other = flow.state(), small_flow(GRID, seed=5)[0]
    expected = steps(flow, 3)
    other.restore(state)
    assert steps(other, 3) == expected
    assert np.array_equal(other.vector, flow.vector)


def test_shift_moves_the_mass():
    for base in (-0.3, np.full(GRID.shape, -0.3)):
        flow, _ = small_flow(GRID, base=base)
        flow.evaluate()
        before = flow.field.copy()
        flow.shift(0.25)
        flow.evaluate()
        assert np.abs(flow.field - before - 0.25).max() < 1e-6


@pytest.mark.slow
@x86
def test_processors_without_wide_vectors(tmp_path):
    """The same numbers where the processor has neither 512-bit vectors nor estimates of roots."""
    grid, path = Grid((6, 7, 20)), tmp_path / "u.npy"
    np.save(path, smooth_field(grid).numpy())
    value, slope = cpu.fused_energy_gradient(np.load(path), list(TUBES), grid, EPSILON)
    program = """
import sys, numpy as np
from curvafit.priors.kernels import cpu, loops
u = np.load(sys.argv[1])
value, slope = cpu.fused_energy_gradient(u, [1, 2, 6, -40, -40, 400], cpu.Grid(u.shape), 0.02)
assert loops.WIDE == 8
np.save(sys.argv[1], np.append(slope, value))
"""
    older = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"}
    subprocess.run([sys.executable, "-c", program, path], check=True, env={**os.environ, **older})
    *slope_found, value_found = np.load(path)
    assert value_found == pytest.approx(value, rel=1e-6)
    assert np.quantile(np.abs(slope_found - slope.ravel()), 0.9) < 1e-6 * np.abs(slope).max()


@pytest.mark.slow
@x86
def test_the_kernel_cache_follows_the_processor(tmp_path):
    """What was compiled for one processor is found by the next process there, and not for another."""
    program = """
from curvafit.priors.kernels import loops
loops.pitch(4, 4)
print(sum(loops.pitch.stats.cache_hits.values()))
"""
    hits = []
    for name in ("x86-64", "x86-64", "nocona"):
        target = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
        command = [sys.executable, "-c", program]
        run = subprocess.run(command, check=True, env={**os.environ, **target}, capture_output=True, text=True)
        hits.append(int(run.stdout))
    assert hits == [0, 1, 0]


def test_threads_do_not_change_the_result():
    if count_threads() < 2:
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
