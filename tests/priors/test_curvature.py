"""Diffuse and geometric curvatures: right on exact jets, and their laws on any field; the exact shapes themselves."""

import math

import exact
import numpy as np
import pytest
import torch
from exact import Cylinder, Gyroid, Plane, Sphere, Torus, exact_jet, profile, shape_operator_curvatures
from hypothesis import given, settings
from hypothesis import strategies as st
from loss_cases import noise
from torch.testing import assert_close

from curvafit.priors.curvature import Jet, diffuse_curvatures, geometric_curvatures, jet, second_form
from curvafit.priors.grid import Grid

#: In millimetres or so: small numbers, so that ξ and the root's floor, which have units, are far below what is tested.
UNIT = 1e-3
SHAPES = {
    "plane": Plane((1.0, -2.0, 0.5)),
    "sphere": Sphere(0.8 * UNIT),
    "cylinder": Cylinder(0.7 * UNIT, (1.0, 2.0, -1.0)),
    "torus": Torus(1.4 * UNIT, 0.6 * UNIT),
}
KINDS = {"diffuse": diffuse_curvatures, "geometric": lambda field, ε: geometric_curvatures(field)}
kinds = pytest.mark.parametrize("kind", KINDS)
seeds = given(seed=st.integers(0, 2**31))


def near_jet(name: str, ε: float = 0.1 * UNIT, count: int = 300) -> tuple[Jet, torch.Tensor]:
    shape = SHAPES[name]
    cloud = 4.4 * UNIT * (torch.rand(40 * count, 3, generator=torch.Generator().manual_seed(0)).double() - 0.5)
    points = cloud[shape.distance(cloud).abs() < 2 * ε][:count, None, None]
    assert len(points) == count
    return exact_jet(lambda p: profile(shape, p, ε), points), points


def random_jet(seed: int, count: int = 50) -> Jet:
    generator = torch.Generator().manual_seed(seed)
    draw = [torch.randn(n, count, 1, 1, generator=generator, dtype=torch.float64) for n in (1, 3, 6)]
    return Jet(draw[0][0], 3 * draw[1], 20 * draw[2])


@pytest.mark.parametrize("name", SHAPES)
@kinds
def test_exact_profiles_have_their_curvatures(name: str, kind: str) -> None:
    """The diffuse ones coincide with the geometric ones where the profile is tanh."""
    field, points = near_jet(name)
    found = KINDS[kind](field, 0.1 * UNIT)
    for mine, theirs in zip(SHAPES[name].curvatures(points), found[:2], strict=True):
        assert_close(theirs, mine, rtol=1e-5, atol=1e-5 / UNIT)
    assert_close(found.mean, found.kappa1 + found.kappa2, rtol=1e-9, atol=1e-9 / UNIT)
    assert_close(found.gauss, found.kappa1 * found.kappa2, rtol=1e-4, atol=1e-4 / UNIT**2)


def test_geometric_curvatures_of_a_gyroid_by_eigenvalues() -> None:
    """A level function that is no distance, so that only invariance under reparametrisation can be right."""
    points = torch.rand(400, 1, 1, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    field = exact_jet(Gyroid(1.0).level, points)
    steep = field.gradient.square().sum(0).sqrt() > 2
    assert int(steep.sum()) > 300
    for mine, theirs in zip(geometric_curvatures(field)[:2], shape_operator_curvatures(field), strict=True):
        assert_close(mine[steep], theirs[steep], rtol=1e-7, atol=1e-7)


def test_geometric_curvatures_do_not_see_the_profile() -> None:
    field, _ = near_jet("torus")
    u, g, h = field
    gg = torch.stack([g[0] ** 2, g[1] ** 2, g[2] ** 2, g[0] * g[1], g[0] * g[2], g[1] * g[2]])
    cubed = Jet(u + u**3, (1 + 3 * u**2) * g, (1 + 3 * u**2) * h + 6 * u * gg)
    for a, b in zip(geometric_curvatures(cubed), geometric_curvatures(field), strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-9)


@settings(deadline=None, max_examples=30)
@seeds
def test_diffuse_product_is_at_most_k(seed: int) -> None:
    """κ1 κ2 ≤ K: the positive part only ever widens the gap between κ1 and κ2."""
    found = diffuse_curvatures(random_jet(seed), 0.1)
    slack = 1e-10 * (found.mean.square() + found.gauss.abs())
    assert bool((found.kappa1 * found.kappa2 <= found.gauss + slack).all())
    assert bool((found.kappa1 >= found.kappa2).all())


def test_diffuse_product_falls_short_where_the_root_is_cut() -> None:
    field = random_jet(0, 2000)
    trace, norm2, root, _ = second_form(field, 0.1)
    cut = 2 * norm2 < trace**2
    assert 20 < int(cut.sum()) < 1980
    found = diffuse_curvatures(field, 0.1)
    gap = found.gauss - found.kappa1 * found.kappa2
    assert float(gap[cut].min()) > 0
    assert float((gap[~cut] / found.mean[~cut].square()).abs().max()) < 1e-6
    assert float(root.min()) >= 1e-3


@kinds
@settings(deadline=None, max_examples=20)
@seeds
def test_negated_fields_exchange_the_curvatures(kind: str, seed: int) -> None:
    field = random_jet(seed)
    there, back = (KINDS[kind](Jet(*(sign * part for part in field)), 0.1) for sign in (1, -1))
    for mine, theirs in ((back.kappa1, -there.kappa2), (back.kappa2, -there.kappa1), (back.gauss, there.gauss)):
        assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


@kinds
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_rotations_by_90_degrees(kind: str, boundary: str, plane: tuple[int, int]) -> None:
    shape, spacing, order = (7, 6, 5), (0.2, 0.3, 0.5), list(range(3))
    order[plane[0]], order[plane[1]] = plane[1], plane[0]
    u, grid = noise(*shape, seed=3), Grid(shape, spacing, boundary)  # type: ignore[arg-type]
    turned = Grid(tuple(shape[k] for k in order), tuple(spacing[k] for k in order), boundary)  # type: ignore[arg-type]
    before, after = KINDS[kind](jet(u, grid), 0.1), KINDS[kind](jet(torch.rot90(u, 1, plane), turned), 0.1)
    for a, b in zip(before, after, strict=True):
        assert_close(torch.rot90(a, 1, plane), b, rtol=1e-7, atol=1e-7)


@kinds
def test_change_of_length_unit(kind: str) -> None:
    """Lengths times 1000, ε with them: curvatures divided by 1000."""
    u = noise(6, 6, 6, seed=4)
    a, b = (KINDS[kind](jet(u, Grid((6, 6, 6), (h, h, 2 * h))), 2 * h) for h in (1e-4, 1e-1))
    assert_close(a.kappa1 / 1000, b.kappa1, rtol=1e-4, atol=1e-4)
    assert_close(a.kappa2 / 1000, b.kappa2, rtol=1e-4, atol=1e-4)


def test_norm_and_trace_are_those_of_the_matrix() -> None:
    field, ε = random_jet(5), 0.1
    u, g, h = field
    n = g / g.square().sum(0).sqrt()
    M = torch.empty(*u.shape, 3, 3, dtype=torch.float64)
    for part, (i, j) in zip(h, ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), strict=True):
        M[..., i, j] = M[..., j, i] = -ε * part + (u**3 - u) / ε * n[i] * n[j]
    found = second_form(field, ε)
    assert_close(found.trace, M.diagonal(dim1=-2, dim2=-1).sum(-1), rtol=1e-7, atol=1e-7)
    assert_close(found.norm2, M.square().sum((-2, -1)), rtol=1e-7, atol=1e-7)


def test_constant_fields_have_finite_curvatures_and_gradients() -> None:
    grid = Grid((4, 4, 4), (1.0, 1.0, 1.0))
    for value in (0.0, 1.0, 0.3):
        u = torch.full((4, 4, 4), value, requires_grad=True)
        (slope,) = torch.autograd.grad(second_form(jet(u, grid), 2.0).root.sum(), u)
        found = [part for kind in KINDS.values() for part in kind(jet(u, grid), 2.0)]
        assert all(bool(torch.isfinite(part).all()) for part in (*found, slope))


# ---- the exact shapes' own premises: what other tests take for truth -------------------------------------------------


SOLIDS = {
    "plane": exact.Plane((1.0, -2.0, 0.5), (0.1, 0.0, 0.3)),
    "sphere": exact.Sphere(0.8, (0.1, -0.2, 0.05)),
    "cylinder": exact.Cylinder(0.7, (1.0, 2.0, -1.0), (0.2, 0.1, 0.0)),
    "torus": exact.Torus(1.4, 0.6, (0.0, 0.1, -0.1)),
}
shapes = pytest.mark.parametrize("shape", SOLIDS.values(), ids=SOLIDS)


def points_near(shape: exact.Shape, count: int = 400, reach: float = 0.3) -> torch.Tensor:
    """Random points within `reach` of the surface, `(N, 1, 1, 3)`."""
    generator = torch.Generator().manual_seed(0)
    cloud = 4.4 * torch.rand(40 * count, 3, generator=generator, dtype=torch.float64) - 2.2
    near = cloud[shape.distance(cloud).abs() < reach][:count]
    assert len(near) == count
    return near[:, None, None]


@shapes
def test_distance_has_slope_one_and_the_curvatures_hessian(shape: exact.Shape) -> None:
    """By their sum, by their squares, and by an eigenvalue solver."""
    points = points_near(shape)
    jet = exact.exact_jet(shape.distance, points)
    assert_close(jet.gradient.square().sum(-4), torch.ones_like(jet.value), rtol=1e-12, atol=0)
    κ1, κ2 = shape.curvatures(points)
    assert bool((κ1 >= κ2).all())
    laplacian, hess2 = jet.hessian[:3].sum(0), jet.hessian[:3].square().sum(0) + 2 * jet.hessian[3:].square().sum(0)
    assert_close(-laplacian, κ1 + κ2, rtol=1e-10, atol=1e-10)
    assert_close(hess2, κ1**2 + κ2**2, rtol=1e-10, atol=1e-10)
    for mine, theirs in zip((κ1, κ2), exact.shape_operator_curvatures(jet), strict=True):
        assert_close(mine, theirs, rtol=1e-9, atol=1e-9)


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
    shape, d = SOLIDS[name], 0.17
    before, after = shape.integrals(), shape.integrals(d)
    H, K = before[3] + before[4], before[1]
    assert after[5] == pytest.approx(before[5] - d * H + d**2 * K, rel=1e-12)
    assert after[3] + after[4] == pytest.approx(H - 2 * d * K, rel=1e-12)


@shapes
def test_diffuse_integrals_tend_to_the_sharp_ones(shape: exact.Shape) -> None:
    """A(d)'s even part leaves a term of order ε²; halving ε quarters the gap."""
    gaps = [np.abs(exact.diffuse_integrals(shape, ε, 9 * ε) - shape.integrals()).max() for ε in (0.04, 0.02)]
    assert max(gaps) < 1e-6 if shape is SOLIDS["plane"] else 1.9 < math.log2(gaps[0] / gaps[1]) < 2.2


def test_profile_jet_is_the_chain_rule() -> None:
    shape, ε = SOLIDS["torus"], 0.1
    jet = exact.exact_jet(lambda p: exact.profile(shape, p, ε), points_near(shape))
    slope = (1 - jet.value**2) / (math.sqrt(2) * ε)
    assert_close(jet.gradient.square().sum(-4).sqrt(), slope, rtol=1e-10, atol=1e-10)


def test_gyroid_repeats_and_has_its_mirror_symmetry() -> None:
    gyroid = exact.Gyroid(1.5)
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_close(gyroid.level(points + 1.5), gyroid.level(points))
    assert_close(gyroid.level(-points), -gyroid.level(points))
