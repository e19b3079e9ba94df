"""Differences and blur: exactness on polynomials, order, adjoints."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from curvafit.priors import kernels, stencils
from curvafit.priors.grid import Grid

edges = st.floats(0.05, 5.0)
grids = st.builds(
    Grid,
    st.tuples(*[st.integers(4, 9)] * 3),
    st.tuples(edges, edges, edges),
    st.sampled_from(["periodic", "replicate"]),
)
PAIRS = {"gradient": (stencils.gradient, stencils.gradient_adjoint, 3)}


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("name", PAIRS)
@settings(deadline=None, max_examples=60)
@given(grid=grids, seed=st.integers(0, 2**31))
def test_adjoints_are_exact(name: str, grid: Grid, seed: int) -> None:
    """⟨Lu, p⟩ = ⟨u, Lᵀp⟩ to 1e-12 of the sum of magnitudes, both boundaries, three different edges."""
    forward, adjoint, parts = PAIRS[name]
    u, p = noise(seed, 2, *grid.shape), noise(seed + 1, 2, parts, *grid.shape)
    left, right = forward(u, grid) * p, u * adjoint(p, grid)
    assert abs(float(left.sum() - right.sum())) <= 1e-12 * float(left.abs().sum())


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_adjoints_are_what_autograd_finds(name: str, boundary: str) -> None:
    forward, adjoint, parts = PAIRS[name]
    grid = Grid((5, 4, 6), (0.3, 1.0, 2.0), boundary)  # type: ignore[arg-type]
    u, p = noise(0, *grid.shape).requires_grad_(), noise(1, parts, *grid.shape)
    (found,) = torch.autograd.grad((forward(u, grid) * p).sum(), u)
    torch.testing.assert_close(adjoint(p, grid), found, rtol=1e-12, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(grid=grids, seed=st.integers(0, 2**31), share=st.floats(0.05, 1.0))
def test_blur_is_its_own_adjoint_and_keeps_the_mean(grid: Grid, seed: int, share: float) -> None:
    """Also where it is as wide as the box's longest side, the widest that is taken, and where the edges differ."""
    width = share * grid.longest
    u, p = noise(seed, *grid.shape), noise(seed + 1, *grid.shape)
    left, right = stencils.gaussian_blur(u, grid, width) * p, u * stencils.gaussian_blur(p, grid, width)
    assert abs(float(left.sum() - right.sum())) <= 1e-12 * float(u.abs().sum() * p.abs().max())
    torch.testing.assert_close(stencils.gaussian_blur(u, grid, width).mean(), u.mean(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("boundary", "mode"), [("periodic", "wrap"), ("replicate", "reflect")])
def test_blur_against_scipy(boundary: str, mode: str) -> None:
    grid = Grid((24, 20, 26), (0.5, 1.0, 2.0), boundary)  # type: ignore[arg-type]
    u = noise(2, *grid.shape)
    expected = u.numpy()
    for axis, h in enumerate(grid.spacing):
        expected = gaussian_filter1d(expected, 2.0 / h, axis, mode=mode, radius=math.ceil(4 * 2.0 / h))
    np.testing.assert_allclose(stencils.gaussian_blur(u, grid, 2.0).numpy(), expected, rtol=0, atol=1e-13)


def test_blur_of_width_zero_changes_nothing_and_gradients_pass() -> None:
    grid = Grid((4, 4, 5), (1.0, 1.0, 1.0))
    u = noise(3, *grid.shape)
    assert stencils.gaussian_blur(u, grid, 0.0) is u
    assert torch.autograd.gradcheck(lambda v: stencils.gaussian_blur(v, grid, 0.8), u.requires_grad_())


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_divergence_adds_to_zero_and_is_minus_the_gradients_adjoint(boundary: str) -> None:
    grid = Grid((6, 5, 7), (0.4, 1.3, 0.9), boundary)  # type: ignore[arg-type]
    A = noise(4, 3, *grid.shape)
    found = stencils.divergence(A, grid)
    assert abs(float(found.sum())) < 1e-12 * float(found.abs().sum())
    torch.testing.assert_close(found, -stencils.gradient_adjoint(A, grid), rtol=0, atol=0)


def test_quadratics_are_differentiated_exactly_inside() -> None:
    grid = Grid((7, 8, 9), (0.5, 0.25, 2.0), "replicate")
    z, y, x = torch.meshgrid(
        *(h * torch.arange(n, dtype=torch.float64) for n, h in zip(grid.shape, grid.spacing, strict=True)),
        indexing="ij",
    )
    u = 1 + 2 * z - y + 3 * x + 0.5 * z**2 + 2 * y**2 - x**2 + 4 * z * y - 3 * z * x + y * x
    inside = (..., *(slice(1, -1),) * 3)
    gradient = torch.stack([2 + z + 4 * y - 3 * x, -1 + 4 * y + 4 * z + x, 3 - 2 * x - 3 * z + y])
    torch.testing.assert_close(stencils.gradient(u, grid)[inside], gradient[inside])
    hessian = torch.tensor([1.0, 4.0, -2.0, 4.0, -3.0, 1.0], dtype=torch.float64)[:, None, None, None]
    found = stencils.hessian(u, grid)[inside]
    torch.testing.assert_close(found, hessian.expand_as(found))


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_symbols_of_the_differences(boundary: str) -> None:
    """A wave is multiplied by sin(kh)/kh a first and by (2 sin(kh/2)/kh)² a second derivative: from below, at second
    order. The cosine is its own mirror image in the box's faces, so both boundaries continue it exactly."""
    n, k = 16, 2 * math.pi
    grid = Grid((n, n, n), (1 / n,) * 3, boundary)  # type: ignore[arg-type]
    z, y, x = (k * (torch.arange(n, dtype=torch.float64) + 0.5).div(n).view(s) for s in ((n, 1, 1), (1, n, 1), (n,)))
    once, twice = math.sin(k / n) / (k / n), (2 * math.sin(k / n / 2) / (k / n)) ** 2
    assert once < 1 and twice < 1
    u = z.cos() * y.cos() * x.cos()
    torch.testing.assert_close(stencils.gradient(u, grid)[0], -once * k * z.sin() * y.cos() * x.cos())
    torch.testing.assert_close(stencils.hessian(u, grid)[1], -twice * k**2 * u)
    torch.testing.assert_close(stencils.hessian(u, grid)[3], once**2 * k**2 * z.sin() * y.sin() * x.cos())


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_shifts_commute_or_mirror(boundary: str) -> None:
    """A reflected field has the reflected gradient with one sign changed."""
    grid = Grid((5, 6, 7), (1.0, 0.5, 0.2), boundary)  # type: ignore[arg-type]
    u = noise(5, *grid.shape)
    mirrored = stencils.gradient(u.flip(-1), grid).flip(-1) * torch.tensor([1.0, 1.0, -1.0]).view(3, 1, 1, 1)
    torch.testing.assert_close(mirrored, stencils.gradient(u, grid))


def test_bad_input_is_one_sentence() -> None:
    grid = Grid((4, 5, 6), 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="axes"):
        stencils.gradient(torch.zeros(4, 5, 5), grid)
    for width in (-1.0, 6.1, 1e6, math.inf, math.nan):
        for blur in (stencils.gaussian_blur, kernels.gaussian_blur):
            with pytest.raises(ValueError, match="blur"):
                blur(torch.zeros(4, 5, 6), grid, width)
    thin = Grid((4, 5, 6), (1e-6, 1.0, 1.0))
    with pytest.raises(ValueError, match="blur"):
        stencils.gaussian_blur(torch.zeros(4, 5, 6), thin, 1.0)


@pytest.mark.parametrize(
    ("shape", "spacing", "boundary", "said"),
    [
        ((3, 5, 5), (1, 1, 1), "periodic", "each at least 4"),
        ((4.5, 5, 5), (1, 1, 1), "periodic", "whole numbers"),
        ((5, 5), (1, 1, 1), "periodic", "expected a shape of 3 whole numbers, each at least 4, got .5, 5."),
        ((5, 5, 5), (0.2, 0, 0.2), "periodic", r"positive numbers \(z, y, x\), got \(0.2, 0, 0.2\)"),
        ((5, 5, 5), (1, 1, math.nan), "periodic", "positive numbers"),
        ((5, 5, 5), (1, 1, 1), "mirror", "expected boundary 'periodic' or 'replicate', got 'mirror'"),
    ],
)
def test_bad_grids(shape, spacing, boundary, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Grid(shape, spacing, boundary)


def test_grid_volumes() -> None:
    grid = Grid((4, 5, 6), (0.5, 1.0, 2.0))
    assert grid.voxel_volume == 1.0
    assert grid.volume == 120.0
    assert Grid((4, 4, 4), 0.5).spacing == (0.5, 0.5, 0.5)  # type: ignore[arg-type]
