"""The exact shapes' own premises: what the other tests take for truth."""

from __future__ import annotations

import math

import exact
import numpy as np
import pytest
import torch

SHAPES = {
    "plane": exact.Plane((1.0, -2.0, 0.5), (0.1, 0.0, 0.3)),
    "sphere": exact.Sphere(0.8, (0.1, -0.2, 0.05)),
    "cylinder": exact.Cylinder(0.7, (1.0, 2.0, -1.0), (0.2, 0.1, 0.0)),
    "torus": exact.Torus(1.4, 0.6, (0.0, 0.1, -0.1)),
}


def points_near(shape: exact.Shape, count: int = 400, reach: float = 0.3) -> torch.Tensor:
    """Random points within `reach` of the surface, `(N, 1, 1, 3)`."""
    generator = torch.Generator().manual_seed(0)
    cloud = 4.4 * torch.rand(40 * count, 3, generator=generator, dtype=torch.float64) - 2.2
    near = cloud[shape.distance(cloud).abs() < reach][:count]
    assert len(near) == count
    return near[:, None, None]


@pytest.mark.parametrize("name", SHAPES)
def test_distance_has_slope_one_and_the_curvatures_hessian(name: str) -> None:
    shape, points = SHAPES[name], points_near(SHAPES[name])
    jet = exact.exact_jet(shape.distance, points)
    torch.testing.assert_close(jet.gradient.square().sum(-4), torch.ones_like(jet.value), rtol=1e-12, atol=0)
    κ1, κ2 = shape.curvatures(points)
    assert bool((κ1 >= κ2).all())
    laplacian, hess2 = jet.hessian[:3].sum(0), jet.hessian[:3].square().sum(0) + 2 * jet.hessian[3:].square().sum(0)
    torch.testing.assert_close(-laplacian, κ1 + κ2, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(hess2, κ1**2 + κ2**2, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", SHAPES)
def test_an_eigenvalue_solver_finds_the_curvatures(name: str) -> None:
    shape, points = SHAPES[name], points_near(SHAPES[name])
    found = exact.shape_operator_curvatures(exact.exact_jet(shape.distance, points))
    for mine, theirs in zip(shape.curvatures(points), found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)


def test_torus_integrals_by_quadrature() -> None:
    torus, offset = exact.Torus(2.0, 1.0), 0.2
    R, r = torus.major, torus.minor - offset
    θ = 2 * math.pi * (np.arange(400) + 0.5) / 400
    κ1, κ2 = np.full_like(θ, 1 / r), np.cos(θ) / (R + r * np.cos(θ))
    dA = r * (R + r * np.cos(θ)) * (2 * math.pi) ** 2 / 400
    sums = [(f * dA).sum() for f in (κ1**2, κ1 * κ2, κ2**2, κ1, κ2, np.ones_like(θ))]
    np.testing.assert_allclose(torus.integrals(offset), sums, rtol=1e-12, atol=1e-11)
    assert torus.integrals()[2] == pytest.approx(12.21, abs=0.01)


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_integrals_of_parallel_surfaces_follow_steiner(name: str) -> None:
    """A(d) = A - d ∫H + d² ∫K, and ∫H dA changes by -2d ∫K."""
    shape, d = SHAPES[name], 0.17
    before, after = shape.integrals(), shape.integrals(d)
    H, K = before[3] + before[4], before[1]
    assert after[5] == pytest.approx(before[5] - d * H + d**2 * K, rel=1e-12)
    assert after[3] + after[4] == pytest.approx(H - 2 * d * K, rel=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_diffuse_integrals_tend_to_the_sharp_ones(name: str) -> None:
    """A(d)'s even part leaves a term of order ε²; halving ε quarters the gap."""
    shape = SHAPES[name]
    sharp = shape.integrals()
    gaps = [np.abs(exact.diffuse_integrals(shape, ε, 9 * ε) - sharp).max() for ε in (0.04, 0.02)]
    if name == "plane":
        assert max(gaps) < 1e-6
    else:
        assert 1.9 < math.log2(gaps[0] / gaps[1]) < 2.2


def test_profile_jet_is_the_chain_rule() -> None:
    shape, ε = SHAPES["torus"], 0.1
    points = points_near(shape)
    jet = exact.exact_jet(lambda p: exact.profile(shape, p, ε), points)
    slope = (1 - jet.value**2) / (math.sqrt(2) * ε)
    torch.testing.assert_close(jet.gradient.square().sum(-4).sqrt(), slope, rtol=1e-10, atol=1e-10)


def test_gyroid_repeats_and_has_its_mirror_symmetry() -> None:
    gyroid = exact.Gyroid(1.5)
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(gyroid.level(points + 1.5), gyroid.level(points))
    torch.testing.assert_close(gyroid.level(-points), -gyroid.level(points))
