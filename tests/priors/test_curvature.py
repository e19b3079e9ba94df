"""Diffuse and geometric curvatures: right on exact jets, and their laws on any field."""

from __future__ import annotations

import pytest
import torch
from exact import Cylinder, Gyroid, Plane, Sphere, Torus, exact_jet, profile, shape_operator_curvatures
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.priors.curvature import (
    Jet,
    diffuse_curvatures,
    geometric_curvatures,
    jet,
    second_form,
)
from curvafit.priors.grid import Grid

#: In millimetres or so: small numbers, so that ξ and the root's floor, which have units, are far below what is tested.
UNIT = 1e-3
SHAPES = {
    "plane": Plane((1.0, -2.0, 0.5)),
    "sphere": Sphere(0.8 * UNIT),
    "cylinder": Cylinder(0.7 * UNIT, (1.0, 2.0, -1.0)),
    "torus": Torus(1.4 * UNIT, 0.6 * UNIT),
}
KINDS = {"diffuse": lambda field: diffuse_curvatures(field, 0.1), "geometric": geometric_curvatures}


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
@pytest.mark.parametrize("kind", ["diffuse", "geometric"])
def test_exact_profiles_have_their_curvatures(name: str, kind: str) -> None:
    """The diffuse ones coincide with the geometric ones where the profile is tanh."""
    field, points = near_jet(name)
    found = diffuse_curvatures(field, 0.1 * UNIT) if kind == "diffuse" else geometric_curvatures(field)
    for mine, theirs in zip(SHAPES[name].curvatures(points), found[:2], strict=True):
        torch.testing.assert_close(theirs, mine, rtol=1e-5, atol=1e-5 / UNIT)
    torch.testing.assert_close(found.mean, found.kappa1 + found.kappa2, rtol=1e-9, atol=1e-9 / UNIT)
    torch.testing.assert_close(found.gauss, found.kappa1 * found.kappa2, rtol=1e-4, atol=1e-4 / UNIT**2)


def test_geometric_curvatures_of_a_gyroid_by_eigenvalues() -> None:
    """A level function that is no distance, so that only invariance under reparametrisation can be right."""
    points = torch.rand(400, 1, 1, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    field = exact_jet(Gyroid(1.0).level, points)
    steep = field.gradient.square().sum(0).sqrt() > 2
    mine, theirs = geometric_curvatures(field), shape_operator_curvatures(field)
    assert int(steep.sum()) > 300
    torch.testing.assert_close(mine.kappa1[steep], theirs[0][steep], rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(mine.kappa2[steep], theirs[1][steep], rtol=1e-7, atol=1e-7)


def test_geometric_curvatures_do_not_see_the_profile() -> None:
    field, _ = near_jet("torus")
    u, g, h = field
    gg = torch.stack([g[0] ** 2, g[1] ** 2, g[2] ** 2, g[0] * g[1], g[0] * g[2], g[1] * g[2]])
    cubed = Jet(u + u**3, (1 + 3 * u**2) * g, (1 + 3 * u**2) * h + 6 * u * gg)
    for a, b in zip(geometric_curvatures(cubed), geometric_curvatures(field), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**31))
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


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_negated_fields_exchange_the_curvatures(kind: str, seed: int) -> None:
    field = random_jet(seed)
    there, back = KINDS[kind](field), KINDS[kind](Jet(*(-part for part in field)))
    torch.testing.assert_close(back.kappa1, -there.kappa2, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(back.kappa2, -there.kappa1, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(back.gauss, there.gauss, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_rotations_by_90_degrees(kind: str, boundary: str, plane: tuple[int, int]) -> None:
    spacing = (0.2, 0.3, 0.5)
    u = torch.randn(7, 6, 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    grid = Grid((7, 6, 5), spacing, boundary)  # type: ignore[arg-type]
    order = list(range(3))
    order[plane[0]], order[plane[1]] = plane[1], plane[0]
    turned = Grid(tuple(grid.shape[k] for k in order), tuple(spacing[k] for k in order), boundary)  # type: ignore[arg-type]
    before = KINDS[kind](jet(u, grid))
    after = KINDS[kind](jet(torch.rot90(u, 1, plane), turned))
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(torch.rot90(a, 1, plane), b, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("kind", ["diffuse", "geometric"])
def test_change_of_length_unit(kind: str) -> None:
    """Lengths times 1000, ε with them: curvatures divided by 1000."""
    u = torch.randn(6, 6, 6, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    small, large = (Grid((6, 6, 6), (h, h, 2 * h), "periodic") for h in (1e-4, 1e-1))
    if kind == "geometric":
        a, b = geometric_curvatures(jet(u, small)), geometric_curvatures(jet(u, large))
    else:
        a, b = diffuse_curvatures(jet(u, small), 2e-4), diffuse_curvatures(jet(u, large), 2e-1)
    torch.testing.assert_close(a.kappa1 / 1000, b.kappa1, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(a.kappa2 / 1000, b.kappa2, rtol=1e-4, atol=1e-4)


def test_norm_and_trace_are_those_of_the_matrix() -> None:
    field, ε = random_jet(5), 0.1
    u, g, h = field
    n = g / g.square().sum(0).sqrt()
    M = torch.empty(*u.shape, 3, 3, dtype=torch.float64)
    for part, (i, j) in zip(h, ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), strict=True):
        M[..., i, j] = M[..., j, i] = -ε * part + (u**3 - u) / ε * n[i] * n[j]
    found = second_form(field, ε)
    torch.testing.assert_close(found.trace, M.diagonal(dim1=-2, dim2=-1).sum(-1), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(found.norm2, M.square().sum((-2, -1)), rtol=1e-7, atol=1e-7)


def test_constant_fields_have_finite_curvatures_and_gradients() -> None:
    grid = Grid((4, 4, 4), (1.0, 1.0, 1.0))
    for value in (0.0, 1.0, 0.3):
        u = torch.full((4, 4, 4), value, requires_grad=True)
        for found in (diffuse_curvatures(jet(u, grid), 2.0), geometric_curvatures(jet(u, grid))):
            assert all(bool(torch.isfinite(part).all()) for part in found)
        (slope,) = torch.autograd.grad(second_form(jet(u, grid), 2.0).root.sum(), u)
        assert bool(torch.isfinite(slope).all())
