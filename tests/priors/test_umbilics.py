"""F_ε's gradient where the root √(2|M|² - (Tr M)²)⁺ has none: one choice, in every precision and every program."""

import math

import pytest
import torch
from torch import Tensor

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import ROOT_FLOOR, ROOT_ROUNDING, jet, positive_root, second_form
from curvafit.priors.energies import energy, energy_gradient, energy_gradient_by_autograd
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile

#: Of which a20 ≠ a02 and a10 ≠ a01, so that the root counts by itself and times the trace.
LAW, EPSILON = Coefficients(1.3, -0.7, 4.0, -60.0, 35.0, 500.0), 0.02
CONCAVE = LAW.mirror()
boundaries = pytest.mark.parametrize("boundary", ["periodic", "replicate"])
laws = pytest.mark.parametrize("law", [LAW, CONCAVE], ids=["convex", "concave"])


def ramp(boundary, level: float) -> tuple[Tensor, Grid, Tensor]:
    """A plane's field, linear across x; and the voxels, away from faces and edges, on its plane where u = `level`."""
    grid = Grid((6, 7, 12), 0.01, boundary)
    u = (0.0625 * (torch.arange(12, dtype=torch.float64) - 5) + level).expand(grid.shape)
    place = torch.zeros(grid.shape, dtype=torch.bool)
    place[2:4, 2:5, 5] = True
    return u.float().double(), grid, place


def ball(boundary) -> tuple[Tensor, Grid, Tensor]:
    """A ball's field, and the six voxels where u = 0 on the axes: M is κ times the tangents' identity."""
    grid, n, radius = Grid((13, 13, 13), 0.01, boundary), 13, 4
    z, y, x = torch.meshgrid(*[torch.arange(n, dtype=torch.float64) - n // 2] * 3, indexing="ij")
    r2 = z**2 + y**2 + x**2
    u = optimal_profile(0.01 * (radius - r2.sqrt()), EPSILON).float().double()
    return u, grid, (r2 == radius**2) & ((z * y == 0) & (y * x == 0) & (z * x == 0))


def invariants(u: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """2|M|² - (Tr M)² and Tr M."""
    trace, norm2, _, _ = second_form(jet(u, grid), EPSILON)
    return 2 * norm2 - trace**2, trace


def slope_of(u: Tensor, grid: Grid, a: Coefficients = LAW) -> Tensor:
    return energy_gradient_by_autograd(u, a, grid, EPSILON)[1].double()


def one_sided(u: Tensor, grid: Grid, place: Tensor, step: float, a: Coefficients) -> tuple[Tensor, Tensor]:
    """Differences of F_ε in float64 ahead of and behind each of the voxels."""
    here = energy(u, a, grid, EPSILON)
    sides = []
    for sign in (1, -1):
        changed = u.repeat(int(place.sum()), 1, 1, 1)
        changed[torch.arange(len(changed)), *place.nonzero(as_tuple=True)] += sign * step
        sides.append((energy(changed, a, grid, EPSILON) - here) / (sign * step))
    return sides[0], sides[1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_roots_derivative_is_zero_or_the_roots(dtype) -> None:
    half, twice = 50 * ROOT_ROUNDING, 200 * ROOT_ROUNDING  # of the share of 100 that is undecided
    cases = [(-1.0, 1.0), (0.0, 0.0), (0.5 * ROOT_FLOOR, 0.1), (half, 100.0), (twice, 100.0), (4.0, 9.0)]
    square, squares = torch.tensor(cases, dtype=dtype).unbind(1)
    root = positive_root(square.requires_grad_(), squares)
    (slope,) = torch.autograd.grad(root.sum(), square)
    values = square.detach().clamp_min(ROOT_FLOOR).sqrt()
    torch.testing.assert_close(root.detach(), values)
    torch.testing.assert_close(slope, torch.tensor([0, 0, 0, 0, 1, 1], dtype=dtype) / (2 * values))
    assert bool(positive_root(torch.tensor(math.nan), torch.tensor(1.0)).isnan())  # a lost value shows


@boundaries
def test_the_fields_have_umbilics(boundary) -> None:
    """The premise of what follows: a plane's where Tr M = 0, a ball's where it is not."""
    for level in (0.0, 1.8e-5):
        u, grid, place = ramp(boundary, level)
        square, trace = invariants(u, grid)
        assert float(square[place].abs().max()) < 0.9 * ROOT_FLOOR and float(trace[place].abs().max()) < 1e-3
    u, grid, place = ball(boundary)
    square, trace = invariants(u, grid)
    assert int(place.sum()) == 6 and float(trace[place].abs().min()) > 1
    assert float((square / trace**2)[place].abs().max()) < 1e-12


@boundaries
@pytest.mark.parametrize("field", [lambda b: ramp(b, 0.0), lambda b: ramp(b, 1.8e-5), ball], ids=["0", "near", "ball"])
def test_float32_has_the_gradient_of_float64(field, boundary) -> None:
    """Of the definition and of every fused kernel (with a mask, with coefficients that vary), at umbilics and near."""
    u, grid, place = field(boundary)
    near = torch.nn.functional.max_pool3d(place.double()[None], 3, 1, 1)[0].bool()
    varying = Coefficients(*list(LAW)[:5], a00=torch.full(grid.shape, 500.0, dtype=torch.float64))
    for a, mask in ((LAW, None), (LAW, torch.full(grid.shape, 0.5)), (varying, None)):
        cost = a, grid, EPSILON, None, mask
        exact = energy_gradient_by_autograd(u, *cost)[1]
        for slope in (energy_gradient_by_autograd(u.float(), *cost)[1], energy_gradient(u.float(), *cost)[1]):
            assert float((slope - exact)[near].abs().max()) < 1e-3 * float(exact[near].abs().max())


@boundaries
@laws
def test_the_gradient_of_a_ramp_is_midway_between_the_one_sided_differences(law, boundary) -> None:
    """They differ by the cone's two slopes, whatever the step; the smooth rest of F_ε adds as much as the step."""
    u, grid, place = ramp(boundary, 0.0)
    found = slope_of(u, grid, law)[place]
    gaps = []
    for step in (1e-4, 5e-5):
        ahead, behind = one_sided(u, grid, place, step, law)
        gaps.append(ahead - behind)
        assert bool((torch.minimum(ahead, behind) < found).all() and (found < torch.maximum(ahead, behind)).all())
        assert bool(((ahead + behind) / 2 - found).abs().max() < 0.05 * gaps[-1].abs().min())
    assert float((gaps[0] / gaps[1] - 1).abs().max()) < 0.3


@boundaries
@laws
def test_the_gradient_at_a_balls_umbilics_is_between_the_one_sided_differences(law, boundary) -> None:
    """On one side the root is constant, on the other it grows as the step's root, as fast as one likes."""
    u, grid, place = ball(boundary)
    found = slope_of(u, grid, law)[place]
    steep = []
    for step in (4e-5, 1e-5):
        ahead, behind = one_sided(u, grid, place, step, law)
        slack = 0.05 * (ahead - behind).abs()
        low, high = torch.minimum(ahead, behind) - slack, torch.maximum(ahead, behind) + slack
        assert bool((low < found).all() and (found < high).all())
        steep.append((ahead - behind).abs())
    assert float((steep[1] / steep[0]).min()) > 1.5
