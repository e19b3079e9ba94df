"""The fused flow's steps against the same in plain torch, and what must hold of them."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import numpy as np
import pytest
import torch
from kernel_cases import ADAM_EPS, BETAS, BLUR, BOUNDARIES, EPSILON, SPACINGS, TUBES, smooth_field, torch_gradient

from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy, energy_gradient
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

cpu = pytest.importorskip("curvafit.priors.kernels.cpu")


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
        _, slope = cpu.fused_energy_gradient(flow.field, list(TUBES), grid, EPSILON)
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


@pytest.mark.slow
def test_processors_without_wide_vectors(tmp_path):
    """The same numbers where the processor has neither 512-bit vectors nor estimates of roots."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("expected an x86 processor")
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
def test_the_kernel_cache_follows_the_processor(tmp_path):
    """What was compiled for one processor is found by the next process there, and not for another."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("expected an x86 processor")
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
    numba = pytest.importorskip("numba")
    from curvafit.priors.kernels.threads import count_threads

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


def test_dispatch_by_device_and_type():
    grid = Grid((6, 7, 16))
    u = smooth_field(grid)
    varying = Coefficients(1, 2, torch.full(grid.shape, 6.0), -40, -40, 400)
    assert kernels.has_kernel("cpu")
    assert not kernels.has_kernel("meta")
    value, slope = torch_gradient(u, TUBES, grid)
    for field, a, tolerance in ((u, TUBES, 1e-12), (u.float(), TUBES, 1e-3), (u.float(), varying, 1e-3)):
        found, gradient_found = energy_gradient(field, a, grid, EPSILON)
        assert gradient_found.dtype == field.dtype
        assert found == pytest.approx(value, rel=max(tolerance / 100, 1e-12))
        assert float((gradient_found.double() - slope).abs().max()) <= tolerance * float(slope.abs().max())


def test_wrong_shapes_and_orientations_are_refused():
    grid = Grid((6, 7, 16))
    with pytest.raises(ValueError, match="field"):
        cpu.fused_energy_gradient(np.zeros((6, 7, 15), np.float32), list(TUBES), grid, EPSILON)
    with pytest.raises(ValueError, match="array"):
        cpu.fused_energy_gradient(np.zeros(grid.shape), list(TUBES), grid, np.full((6, 7, 15), EPSILON))
    with pytest.raises(ValueError, match="symmetric"):
        cpu.fused_energy_gradient(np.zeros(grid.shape), list(TUBES), grid, EPSILON, np.tri(3))
    with pytest.raises(ValueError, match="field"):
        cpu.gaussian_blur(np.zeros((6, 7, 15), np.float32), grid, BLUR)
