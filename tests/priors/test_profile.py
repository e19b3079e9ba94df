"""Differences and blur; double well, profile, and the ways between mask, distance and phase field."""

import itertools
import math

import numpy as np
import pytest
import torch
from exact import Cylinder, Plane, Sphere, centres
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from loss_cases import noise
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from torch.testing import assert_close

from curvafit.geometry.diagrams import diagram
from curvafit.geometry.mesh import surface
from curvafit.priors import profile, stencils
from curvafit.priors.grid import Grid

EPSILON = 2.0


def box(n: int, boundary: str = "replicate", spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Grid:
    return Grid((n, n, n), spacing, boundary)  # type: ignore[arg-type]


def brute_force(mask: np.ndarray, grid: Grid) -> np.ndarray:
    """Signed distance from voxel centres to the nearest box of the other kind, over all pairs and periodic images."""
    here = np.stack(np.meshgrid(*[np.arange(n) for n in mask.shape], indexing="ij"), -1).reshape(-1, 3)
    images = itertools.product(*[(-1, 0, 1)] * 3) if grid.periodic else [(0, 0, 0)]
    found = np.full(len(here), np.inf)
    flat = mask.reshape(-1)
    for image in images:
        steps = np.abs(here[:, None] - here[None] - np.array(image) * np.array(mask.shape))
        lengths = np.maximum(steps - 0.5, 0) * np.array(grid.spacing)
        distance = np.sqrt((lengths**2).sum(-1))
        distance[flat[:, None] == flat[None]] = np.inf
        found = np.minimum(found, distance.min(1))
    return (np.where(flat, 1, -1) * found).reshape(mask.shape)


def test_sigma_is_the_wells_integral_and_its_derivative_the_slope() -> None:
    x, w = np.polynomial.legendre.leggauss(20)
    np.testing.assert_allclose(profile.SIGMA, w @ np.sqrt(2 * profile.double_well(torch.tensor(x)).numpy()), rtol=1e-12)
    u = torch.linspace(-1.3, 1.3, 11, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(profile.double_well(u).sum(), u)
    torch.testing.assert_close(profile.double_well_derivative(u), slope)


def test_profile_solves_its_equation() -> None:
    """ε² u'' = W'(u), and ε |u'| = √(2 W(u))."""
    d, ε = torch.linspace(-3, 3, 41, dtype=torch.float64, requires_grad=True), 0.7
    u = profile.optimal_profile(d, ε)
    (slope,) = torch.autograd.grad(u.sum(), d, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), d)
    torch.testing.assert_close(ε**2 * bend, profile.double_well_derivative(u))
    torch.testing.assert_close(ε * slope, (2 * profile.double_well(u)).sqrt())


@given(st.floats(-3, 3), st.floats(0.01, 10))
def test_profile_distance_undoes_the_profile(part: float, ε: float) -> None:
    d = torch.tensor(part * math.sqrt(2) * ε, dtype=torch.float64)
    assert float(profile.profile_distance(profile.optimal_profile(d, ε), ε)) == pytest.approx(float(d), abs=1e-9 * ε)
    beyond = profile.profile_distance(torch.tensor(1.2, dtype=torch.float64), ε)
    assert float(beyond) == pytest.approx(3 * math.sqrt(2) * ε)


@settings(deadline=None, max_examples=40)
@given(
    mask=arrays(bool, st.tuples(*[st.integers(4, 6)] * 3)),
    spacing=st.tuples(*[st.sampled_from([0.5, 1.0, 1.7])] * 3),
    boundary=st.sampled_from(["periodic", "replicate"]),
)
def test_signed_distance_against_brute_force(mask: np.ndarray, spacing, boundary: str) -> None:
    grid = Grid(mask.shape, spacing, boundary)  # type: ignore[arg-type]
    if mask.all() or not mask.any():
        with pytest.raises(ValueError, match="got an empty or a full one"):
            profile.signed_distance(torch.from_numpy(mask), grid)
        return
    found = profile.signed_distance(torch.from_numpy(np.stack([mask, ~mask])), grid).numpy()  # a batch
    truth = brute_force(mask, grid)
    np.testing.assert_allclose(found, [truth, -truth], rtol=1e-6)
    cut = profile.signed_distance(torch.from_numpy(mask), grid, limit=1.2).numpy()
    np.testing.assert_allclose(cut, truth.clip(-1.2, 1.2), rtol=1e-6)
    if not grid.periodic:  # SciPy measures to the other side's centres: further, by at most half a voxel's diagonal
        gap = sum(distance_transform_edt(each, sampling=spacing) for each in (mask, ~mask)) - np.abs(found[0])
        assert gap.min() >= min(spacing) / 2 - 1e-6 and gap.max() <= math.hypot(*spacing) / 2 + 1e-6


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.5, 2.0)])
def test_planes_between_voxels_are_exact(axis: int, spacing: tuple[float, float, float]) -> None:
    """Also in a periodic box, where the slab's other face is 32 voxels away."""
    n, h, shape, along = 64, spacing[axis], [4, 4, 4], [1, 1, 1]
    shape[axis] = along[axis] = n
    at = torch.arange(n, dtype=torch.float32).sub(15.5).mul(h)
    d = torch.minimum(at, 32 * h - at).view(along).expand(shape)
    found = profile.phase_field(d > 0, Grid(tuple(shape), spacing), 2 * h)  # type: ignore[arg-type]
    error = (profile.profile_distance(found, 2 * h) - d).abs()
    assert float(error[d.abs() < 4 * h].max()) < 2e-3 * h


@pytest.mark.parametrize("normal", [(1.0, 0.62, -0.35), (1.0, 0.27, 0.11), (-0.4, 1.0, 0.9)])
def test_tilted_planes_are_unbiased(normal: tuple[float, float, float]) -> None:
    """Voxels cut a tilted plane into stairs; a tenth of a voxel is left of them, and none on average."""
    plane, grid = Plane(normal, (24.3, 23.8, 24.1)), box(48)
    u = profile.phase_field(plane.distance(centres(grid)) > 0, grid, EPSILON)
    inner = slice(10, -10)
    mesh = surface(u[inner, inner, inner], box(28))
    error = plane.distance(torch.from_numpy(mesh.vertices) + 10.5)
    assert abs(float(error.mean())) < 0.03
    assert float(error.square().mean().sqrt()) < 0.1


def test_distances_across_tilted_faces_are_short_not_long() -> None:
    """The direction of what smoothing cannot mend: overhanging voxels are nearer than the plane, by up to a fifth."""
    plane, grid = Plane((1.0, 0.62, -0.35), (16.3, 15.8, 16.1)), box(32)
    d = plane.distance(centres(grid))
    found = profile.profile_distance(profile.phase_field(d > 0, grid, EPSILON), EPSILON)
    inner = (slice(8, -8),) * 3
    slope = (found * d)[inner][d[inner].abs() < 3].sum() / d[inner][d[inner].abs() < 3].square().sum()
    assert 0.78 < float(slope) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("radius", [4, 6, 8])
def test_balls_and_rods_keep_their_mean_curvature(radius: int) -> None:
    """Mean κ1 + κ2 over the mesh of a re-profiled mask, four random centres: within 2 % from a thickness of 12 voxels,
    5 % at 8, where the smoothing reaches the skeleton, O(σ⁴/R⁴). Stairs still part κ1 and κ2, by under 0.25 / R."""
    n = 2 * radius + 14
    grid, generator = box(n), np.random.default_rng(radius)
    tolerance = 0.02 if radius >= 6 else 0.05
    for truth in (2.0, 1.0):
        sums, scatter = [], []
        for _ in range(4):
            centre = tuple(n / 2 + generator.uniform(-0.5, 0.5, 3))
            shape = Sphere(radius, centre) if truth == 2 else Cylinder(radius, tuple(generator.normal(size=3)), centre)
            u = profile.phase_field(shape.distance(centres(grid)) > 0, grid, EPSILON)
            found = diagram(u, grid, EPSILON, margin=5)
            sums.append(found.mean().sum() * radius)
            gap = found.points * radius - (1.0, truth - 1)
            scatter.append(math.sqrt(found.normalised.weights @ (gap**2).sum(1)))
        assert np.mean(sums) == pytest.approx(truth, rel=tolerance)
        assert np.mean(scatter) < 0.25


def test_balls_keep_their_size() -> None:
    """The zero level of a ball of 6 voxels' radius moves by less than a tenth of a voxel."""
    grid, ball = box(28), Sphere(6.0, (14.2, 13.9, 14.1))
    mesh = surface(profile.phase_field(ball.distance(centres(grid)) > 0, grid, EPSILON), grid)
    error = ball.distance(torch.from_numpy(mesh.vertices) + 0.5)
    assert abs(float(error.mean())) < 0.05
    assert float(error.abs().max()) < 0.3


def test_periodic_boxes_have_no_seam_inside_is_outside_and_thin_plates_survive() -> None:
    """Plates three voxels thick: the smoothed field keeps every voxel's side."""
    grid, mask, plate = box(16, "periodic"), *torch.zeros(2, 16, 16, 16, dtype=torch.bool)
    mask[5:12, 3:10, 4:12] = plate[6:9] = True
    field = profile.phase_field(mask, grid, EPSILON)
    shifted = profile.phase_field(mask.roll((8, 8, 8), (0, 1, 2)), grid, EPSILON).roll((-8, -8, -8), (0, 1, 2))
    torch.testing.assert_close(shifted, field, rtol=0, atol=1e-6)
    torch.testing.assert_close(profile.phase_field(~mask, grid, EPSILON), -field, rtol=0, atol=1e-5)
    assert torch.equal(profile.phase_field(plate, grid, EPSILON) > 0, plate)


# ---- differences and blur: exactness on polynomials, order, adjoints -------------------------------------------------


edges = st.floats(0.05, 5.0)
BOUNDARIES = ("periodic", "replicate")
grids = st.builds(
    Grid, st.tuples(*[st.integers(4, 9)] * 3), st.tuples(edges, edges, edges), st.sampled_from(BOUNDARIES)
)
boundaries = pytest.mark.parametrize("boundary", BOUNDARIES)


@settings(deadline=None, max_examples=60)
@given(grid=grids, seed=st.integers(0, 2**31))
def test_adjoints_are_exact(grid: Grid, seed: int) -> None:
    """⟨∇u, p⟩ = ⟨u, ∇ᵀp⟩ to 1e-12 of the sum of magnitudes, both boundaries, three different edges; div is -∇ᵀ, and
    adds to zero."""
    u, p = noise(2, *grid.shape, seed=seed), noise(2, 3, *grid.shape, seed=seed + 1)
    left, right = stencils.gradient(u, grid) * p, u * stencils.gradient_adjoint(p, grid)
    assert abs(float(left.sum() - right.sum())) <= 1e-12 * float(left.abs().sum())
    flux = stencils.divergence(p, grid)
    assert abs(float(flux.sum())) < 1e-12 * float(flux.abs().sum())
    assert_close(flux, -stencils.gradient_adjoint(p, grid), rtol=0, atol=0)


@settings(deadline=None, max_examples=40)
@given(grid=grids, seed=st.integers(0, 2**31), share=st.floats(0.05, 1.0))
def test_blur_is_its_own_adjoint_and_keeps_the_mean(grid: Grid, seed: int, share: float) -> None:
    """Also where it is as wide as the box's longest side, the widest that is taken, and where the edges differ."""
    width = share * grid.longest
    u, p = noise(*grid.shape, seed=seed), noise(*grid.shape, seed=seed + 1)
    left, right = stencils.gaussian_blur(u, grid, width) * p, u * stencils.gaussian_blur(p, grid, width)
    assert abs(float(left.sum() - right.sum())) <= 1e-12 * float(u.abs().sum() * p.abs().max())
    assert_close(stencils.gaussian_blur(u, grid, width).mean(), u.mean(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("boundary", "mode"), [("periodic", "wrap"), ("replicate", "reflect")])
def test_blur_against_scipy(boundary: str, mode: str) -> None:
    grid = Grid((24, 20, 26), (0.5, 1.0, 2.0), boundary)  # type: ignore[arg-type]
    u = noise(*grid.shape, seed=2)
    expected = u.numpy()
    for axis, h in enumerate(grid.spacing):
        expected = gaussian_filter1d(expected, 2.0 / h, axis, mode=mode, radius=math.ceil(4 * 2.0 / h))
    np.testing.assert_allclose(stencils.gaussian_blur(u, grid, 2.0).numpy(), expected, rtol=0, atol=1e-13)


def test_blur_of_width_zero_changes_nothing_and_gradients_pass() -> None:
    grid = Grid((4, 4, 5), (1.0, 1.0, 1.0))
    u = noise(*grid.shape, seed=3)
    assert stencils.gaussian_blur(u, grid, 0.0) is u
    assert torch.autograd.gradcheck(lambda v: stencils.gaussian_blur(v, grid, 0.8), u.requires_grad_())


def test_quadratics_are_differentiated_exactly_inside() -> None:
    grid = Grid((7, 8, 9), (0.5, 0.25, 2.0), "replicate")
    axes = (h * torch.arange(n, dtype=torch.float64) for n, h in zip(grid.shape, grid.spacing, strict=True))
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    u = 1 + 2 * z - y + 3 * x + 0.5 * z**2 + 2 * y**2 - x**2 + 4 * z * y - 3 * z * x + y * x
    inside = (..., *(slice(1, -1),) * 3)
    gradient = torch.stack([2 + z + 4 * y - 3 * x, -1 + 4 * y + 4 * z + x, 3 - 2 * x - 3 * z + y])
    assert_close(stencils.gradient(u, grid)[inside], gradient[inside])
    hessian = torch.tensor([1.0, 4.0, -2.0, 4.0, -3.0, 1.0], dtype=torch.float64)[:, None, None, None]
    found = stencils.hessian(u, grid)[inside]
    assert_close(found, hessian.expand_as(found))


@boundaries
def test_symbols_of_the_differences(boundary: str) -> None:
    """A wave is multiplied by sin(kh)/kh a first and by (2 sin(kh/2)/kh)² a second derivative: from below, at second
    order. The cosine is its own mirror image in the box's faces, so both boundaries continue it exactly."""
    n, k = 16, 2 * math.pi
    grid = Grid((n, n, n), (1 / n,) * 3, boundary)  # type: ignore[arg-type]
    z, y, x = (k * (torch.arange(n, dtype=torch.float64) + 0.5).div(n).view(s) for s in ((n, 1, 1), (1, n, 1), (n,)))
    once, twice = math.sin(k / n) / (k / n), (2 * math.sin(k / n / 2) / (k / n)) ** 2
    assert once < 1 and twice < 1
    u = z.cos() * y.cos() * x.cos()
    assert_close(stencils.gradient(u, grid)[0], -once * k * z.sin() * y.cos() * x.cos())
    assert_close(stencils.hessian(u, grid)[1], -twice * k**2 * u)
    assert_close(stencils.hessian(u, grid)[3], once**2 * k**2 * z.sin() * y.sin() * x.cos())


@boundaries
def test_shifts_commute_or_mirror(boundary: str) -> None:
    """A reflected field has the reflected gradient with one sign changed."""
    grid = Grid((5, 6, 7), (1.0, 0.5, 0.2), boundary)  # type: ignore[arg-type]
    u = noise(*grid.shape, seed=5)
    mirrored = stencils.gradient(u.flip(-1), grid).flip(-1) * torch.tensor([1.0, 1.0, -1.0]).view(3, 1, 1, 1)
    assert_close(mirrored, stencils.gradient(u, grid))


def test_grid_volumes() -> None:
    grid = Grid((4, 5, 6), (0.5, 1.0, 2.0))
    assert grid.voxel_volume == 1.0
    assert grid.volume == 120.0
    assert Grid((4, 4, 4), 0.5).spacing == (0.5, 0.5, 0.5)  # type: ignore[arg-type]
