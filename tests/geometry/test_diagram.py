"""Curvature diagrams: right on exact shapes, blind to the seam; and distances between them, of known values."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from exact import Cylinder, Gyroid, Shape, Sphere, Torus, centres, profile
from geomloss import SamplesLoss
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.geometry import distances as module
from curvafit.geometry.diagrams import Diagram, diagram, family_of, family_shares, measure_levels
from curvafit.geometry.distances import one_to_many, pairwise, sliced_embedding, wasserstein
from curvafit.inference.atlas import load_atlas
from curvafit.priors.curvature import geometric_curvatures, jet
from curvafit.priors.grid import Grid
from curvafit.priors.profile import phase_field

#: On one octant (the rest is its mirror image), tube radius 8 ε; ε is 1 and the spacing 1 over voxels an ε.
OCTANTS: dict[str, tuple[Shape, tuple[float, float, float]]] = {
    "sphere": (Sphere(8.0), (12, 12, 12)),
    "cylinder": (Cylinder(8.0), (4, 12, 12)),
    "torus": (Torus(16.0, 8.0), (12, 28, 28)),
}


def octant(name: str, voxels: int) -> tuple[torch.Tensor, Grid]:
    """The exact profile and its mirrored box."""
    shape, size = OCTANTS[name]
    nz, ny, nx = (round(edge * voxels) for edge in size)
    grid = Grid((nz, ny, nx), (1 / voxels,) * 3, "replicate")
    return profile(shape, centres(grid), 1.0), grid


def errors(name: str, voxels: int, kind: str) -> np.ndarray:
    """|κ - exact κ| at every triangle's barycentre, over max(|κ1|, |κ2|) there: `(N, 2)`."""
    u, grid = octant(name, voxels)
    found = diagram(u, grid, 1.0, curvature=kind, margin=0)  # type: ignore[arg-type]
    assert found.excluded == 0
    places = torch.from_numpy(found.places) + 0.5 / voxels
    truth = torch.stack(OCTANTS[name][0].curvatures(places), -1).numpy()
    return np.abs(found.points - truth) / np.abs(truth).max(1, keepdims=True)


@pytest.mark.parametrize("name", OCTANTS)
@pytest.mark.parametrize(("voxels", "tolerance"), [(4, 0.02), (2, 0.05)])
def test_geometric_curvatures_on_exact_shapes(name: str, voxels: int, tolerance: float) -> None:
    """Every triangle, not only their mean."""
    assert errors(name, voxels, "geometric").max() < tolerance


@pytest.mark.parametrize("periodic", [True, False])
def test_curvatures_at_voxels_are_those_of_the_energy(periodic: bool) -> None:
    """The kernel has what `priors.curvature` has by torch, up to the faces of a box whose voxels are no cubes."""
    grid = Grid((7, 8, 9), (1.0, 1.1, 0.9), "periodic" if periodic else "replicate")
    u = torch.randn(grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = geometric_curvatures(jet(u, grid))[:2]
    *found, slope = measure_levels(u.numpy(), grid.spacing, periodic, np.arange(u.numel()))
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs.flatten(), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(slope**2, jet(u, grid).gradient.square().sum(-4).flatten(), rtol=1e-12)


@pytest.mark.parametrize(("name", "least"), [("sphere", 0.15), ("torus", 0.01)])
def test_diffuse_curvatures_are_far_more_biased(name: str, least: float) -> None:
    """The grid's normal-normal residue parts κ1 from κ2, most where they are equal; hence geometric ones for scans."""
    diffuse, geometric = (errors(name, 2, kind).mean() for kind in ("diffuse", "geometric"))
    assert diffuse > 10 * geometric
    assert diffuse > least
    if name == "sphere":  # the direction, as measured on the published program's fields
        mean = diagram(*octant(name, 2), 1.0, curvature="diffuse", margin=0).mean() * 8
        assert mean == pytest.approx([1.21, 0.79], abs=0.05)


def test_gauss_bonnet() -> None:
    """∫K dA = 2πχ: 4π for a sphere, 0 for a torus, -16π for a gyroid's cell."""
    ball = diagram(*octant("sphere", 2), 1.0, margin=0)
    # Half a voxel along each mirror lies beyond the octant's outermost centres: compare with the area that is left.
    assert ball.weights @ ball.points.prod(1) == pytest.approx(ball.area / 8**2, rel=0.005)
    grid = Grid((32, 32, 32), (1.0,) * 3)
    u = profile(Sphere(9.0, (16.3, 15.9, 16.1)), centres(grid), 2.0)
    whole = diagram(u, grid, 2.0)
    assert whole.weights @ whole.points.prod(1) == pytest.approx(4 * math.pi, rel=0.01)
    assert whole.area == pytest.approx(4 * math.pi * 81, rel=0.01)
    grid = Grid((24, 52, 52), (1.0,) * 3)
    ring = diagram(profile(Torus(15.0, 7.0, (12.2, 26.1, 25.8)), centres(grid), 2.0), grid, 2.0)
    curved = ring.weights @ np.abs(ring.points.prod(1))
    assert abs(ring.weights @ ring.points.prod(1)) < 0.01 * curved
    grid = Grid((40, 40, 40), (0.5,) * 3)
    cell = diagram(Gyroid(20.0).level(centres(grid)) * 0.5, grid, 2.0)
    assert cell.weights @ cell.points.prod(1) == pytest.approx(Gyroid(20.0).total_curvature, rel=0.01)
    assert abs(cell.mean().sum()) < 0.01 * np.abs(cell.points).max()


@settings(deadline=None, max_examples=6)
@given(shift=st.tuples(*[st.integers(0, 23)] * 3))
def test_periodic_diagrams_do_not_see_the_seam(shift: tuple[int, int, int]) -> None:
    grid = Grid((24, 24, 24), (1.0, 1.0, 1.0))
    u = profile(Sphere(7.0, (12.3, 11.9, 12.1)), centres(grid), 2.0)
    still, moved = diagram(u, grid, 2.0), diagram(u.roll(shift, (0, 1, 2)), grid, 2.0)
    assert moved.area == pytest.approx(still.area, rel=1e-5)
    np.testing.assert_allclose(moved.mean(), still.mean(), rtol=1e-4)


def test_margins_keep_borders_out() -> None:
    """A tilted rod leaves the box: at its ends the mirror image bends it, and a margin leaves the ends out."""
    grid = Grid((28, 28, 28), (1.0, 1.0, 1.0), "replicate")
    u = profile(Cylinder(6.0, (1.0, 0.8, 0.1), (14.0, 14.0, 14.0)), centres(grid), 2.0)
    spoilt, clean = diagram(u, grid, 2.0, margin=0), diagram(u, grid, 2.0)
    assert np.abs(clean.points * 6 - (1, 0)).max() < 0.05
    assert np.abs(spoilt.points * 6 - (1, 0)).max() > 0.2
    grid = Grid((16, 32, 24), (2.0, 1.0, 1.4), "replicate")
    u = profile(Sphere(11.0, (16.1, 16.2, 16.9)), centres(grid), 2.8)
    found = diagram(u, grid, 2.8, margin=0)
    np.testing.assert_allclose(found.points * 11, 1, atol=0.06)
    assert found.area == pytest.approx(4 * math.pi * 121, rel=0.015)


def test_only_where_asked() -> None:
    """And mirrored where inside and outside change places."""
    u, grid = octant("sphere", 2)
    lower = np.zeros(grid.shape, dtype=bool)
    lower[:8] = True
    parts = [diagram(u, grid, 1.0, margin=0, where=where).area for where in (lower, ~lower)]
    assert sum(parts) == pytest.approx(diagram(u, grid, 1.0, margin=0).area, rel=1e-12)
    assert min(parts) > 0
    u, grid = octant("torus", 2)
    there, back = diagram(u, grid, 1.0), diagram(-u, grid, 1.0)
    np.testing.assert_allclose(back.mean(), -there.mean()[::-1], rtol=1e-3, atol=1e-4)


def test_what_is_not_resolved_is_left_out_and_counted() -> None:
    """A spot so faint that its level set has no slope, beside a ball of seven voxels; and noise that is flat."""
    grid = Grid((24, 24, 32), (1.0, 1.0, 1.0))
    points = centres(grid)
    ball = torch.tanh(Sphere(7.0, (12.2, 12.1, 10.0)).distance(points) / (2 * math.sqrt(2)))
    away = points - torch.tensor([12.0, 12.0, 26.0], dtype=points.dtype)
    spot = 0.06 * torch.exp(-away.square().sum(-1) / 18) - 0.05
    found = diagram(torch.where(points[..., 2] < 20, ball, spot), grid, 2.0)
    assert 0 < found.excluded < 0.2
    assert np.isfinite(found.points).all()
    np.testing.assert_allclose(found.mean() * 7, 1, atol=0.02)
    grid = Grid((10, 10, 10), (0.01, 0.01, 0.01))
    u = 1e-7 * torch.randn(10, 10, 10, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="resolves"):
        diagram(u, grid, 0.02)


def cloud(seed: int, count: int = 500) -> Diagram:
    generator = np.random.default_rng(seed)
    return Diagram(20 * generator.standard_t(3, (count, 2)), generator.random(count))


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), width=st.floats(0.5, 30))
def test_bins_keep_area_and_mean_and_state_their_spread(seed: int, width: float) -> None:
    """The variance that binning takes away is its spread's square."""
    whole = cloud(seed)
    for binned in (whole.bin(width), whole.thin(width, 0.01)):
        assert binned.area == pytest.approx(whole.area, rel=1e-12)
        np.testing.assert_allclose(binned.mean(), whole.mean(), rtol=0, atol=1e-9)
        lost = moment(whole) - moment(binned)
        assert binned.spread**2 == pytest.approx(lost, rel=1e-9, abs=1e-9)
    assert whole.bin(width).spread <= width * math.sqrt(0.5)
    twice = whole.bin(width).bin(3 * width)
    assert twice.spread**2 == pytest.approx(moment(whole) - moment(twice), rel=1e-9, abs=1e-9)


def moment(d: Diagram) -> float:
    return float(d.normalised.weights @ (d.points**2).sum(1))


def test_thinning_widens_only_the_tails() -> None:
    whole = cloud(0, 20000)
    fine, thin = whole.bin(2.0), whole.thin(2.0, 3e-3)
    assert len(thin.weights) < 0.75 * len(fine.weights)
    assert fine.spread < thin.spread < 1.5 * fine.spread


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tubes", "sponge"])
def test_masks_stay_near_their_fields(data, name: str) -> None:
    """The published shapes, known only as {u > 0}: within 2 of themselves, in 1 / working unit. Their area is kept."""
    import nibabel

    found = sorted((data / "gallery").glob(f"{name} *.nii.gz"))
    if not found:
        pytest.skip(f"needs the gallery in {data}")
    u = torch.from_numpy(nibabel.load(found[0]).get_fdata(dtype=np.float32))
    grid = Grid(tuple(u.shape), (0.01,) * 3)  # type: ignore[arg-type]
    of_field, of_mask = diagram(u, grid, 0.02), diagram(phase_field(u > 0, grid, 0.02), grid, 0.02)
    assert wasserstein(of_field, of_mask) < 1.0
    assert of_mask.area == pytest.approx(of_field.area, rel=0.01)
    assert of_field.excluded == of_mask.excluded == 0


RADIUS = 0.04


def at(*points: tuple[float, float]) -> Diagram:
    return Diagram(np.array(points) / RADIUS, np.ones(len(points)))


@pytest.mark.parametrize(
    ("points", "name"),
    [
        ([(1.0, 1.0)], "spheres"), ([(1.0, 0.1)], "tubes"), ([(1.0, -0.9)], "sponge"), ([(0.05, -0.05)], "layers"),
        ([(0.1, -1.0)], "tubular cavities"), ([(-1.0, -1.1)], "bubbles"), ([(1, 0), (0.01, 0), (0.01, 0)], "layers"),
        ([(1, 0), (1, 0), (0.01, 0)], "tubes"),
    ],
)  # fmt: skip
def test_ideal_shapes_are_named(points: list[tuple[float, float]], name: str) -> None:
    """By where the area lies, whatever the unit of length; a flat half makes layers."""
    assert family_of(at(*points), RADIUS) == name
    assert family_of(Diagram(at(*points).points / 7, np.ones(len(points))), 7 * RADIUS) == name
    assert sum(family_shares(at(*points), RADIUS).values()) == pytest.approx(1)


def blob(seed: int = 0, centre: tuple[float, float] = (20.0, -5.0), width: float = 4.0, count: int = 300) -> Diagram:
    generator = np.random.default_rng(seed)
    return Diagram(generator.normal(centre, width, (count, 2)), generator.random(count) + 0.1)


def uneven(seed: int, count: int, centre: tuple[float, float] = (0.0, 0.0), width: float = 10.0) -> Diagram:
    """Points with weights over six orders of magnitude."""
    generator = np.random.default_rng(seed)
    return Diagram(generator.normal(centre, width, (count, 2)), 10 ** generator.uniform(-6, 0, count))


def moved(d: Diagram, by: tuple[float, float]) -> Diagram:
    return replace(d, points=d.points + np.array(by))


def sliced(a: Diagram, b: Diagram) -> float:
    return float(np.linalg.norm(sliced_embedding(a) - sliced_embedding(b)))


def test_distances_that_are_zero() -> None:
    """From itself at any scale of weights, and a point of weight 3 from three points. A distance is the pair's own."""
    d, points = blob(), np.array([[0.0, 0.0], [10.0, -10.0]])
    heavy, light = Diagram(points, np.array([3.0, 1.0])), Diagram(points[[0, 0, 0, 1]], np.ones(4))
    assert wasserstein(d, d) == pytest.approx(0, abs=1e-2)
    assert wasserstein(d, replace(d, weights=7 * d.weights)) == pytest.approx(0, abs=1e-2)
    assert wasserstein(heavy, light, bin_width=0) == pytest.approx(0, abs=1e-2)
    np.testing.assert_allclose(heavy.mean(), [2.5, -2.5])
    a = blob()
    near, far, farther = (wasserstein(a, moved(a, (s, 0.0))) for s in (5.0, 60.0, 200.0))
    assert near < wasserstein(a, moved(a, (5.0, 0.0)), reach=None)
    assert farther == pytest.approx(far, rel=0.12)
    assert far < 20 * math.sqrt(2)  # all of both destroyed and made anew
    query, others = blob(0), [blob(k, (20.0 + 3 * k, -5.0 - k)) for k in range(1, 6)]
    full = [wasserstein(query, other, reach=None) for other in others]
    assert np.argsort(full).tolist() == np.argsort([sliced(query, other) for other in others]).tolist()
    assert sliced_embedding(query).shape == (288,)
    together = pairwise(CLOUDS)
    for i, j in itertools.combinations(range(len(CLOUDS)), 2):
        assert pairwise([CLOUDS[i], CLOUDS[j]])[0, 1] == pytest.approx(together[i, j], rel=1e-5)
    others = [replace(d, weights=7 * d.weights) for d in CLOUDS]
    np.testing.assert_allclose(one_to_many(CLOUDS[1], others), together[1], rtol=1e-5, atol=0.01)
    assert one_to_many(CLOUDS[0], []).shape == (0,) and pairwise([]).shape == (0, 0)
    a = CLOUDS[0]
    more = Diagram(np.concatenate([a.points, [[500.0, 0.0]]]), np.append(a.weights, 0.0))
    assert one_to_many(a, [more], bin_width=0)[0] == 0


@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, -2.0), (3.0, 4.0)])
@pytest.mark.parametrize("count", [300, 1])
def test_balanced_distance_of_a_shift(shift: tuple[float, float], count: int) -> None:
    """Cost ½|x - y|²: a shift by s costs |s| / √2, in Sinkhorn's and in the sliced distance; of a single point too."""
    a, b = blob(count=count), moved(blob(count=count), shift)
    truth = math.hypot(*shift) / math.sqrt(2)
    assert wasserstein(a, b, reach=None, bin_width=0) == pytest.approx(truth, rel=1e-3)
    assert sliced(a, b) == pytest.approx(truth, rel=1e-9)


@pytest.mark.slow
def test_distances_of_gaussians_in_closed_form() -> None:
    """W2² of N(m, s²) and N(n, t²) in the plane: |m - n|² + 2 (s - t)²; halved by the cost.

    Then the triangle, and what binning costs: 0.05 at most at width 2, and √½ · spread to one's binned self.
    """
    a, b = blob(1, (0, 0), 3.0, 1500), blob(2, (6, 0), 5.0, 1500)
    truth = math.sqrt((6**2 + 2 * 2**2) / 2)
    assert wasserstein(a, b, reach=None) == pytest.approx(truth, rel=0.05)
    assert sliced(a, b) == pytest.approx(truth, rel=0.06)
    ds = [blob(k, (10.0 * k, -3.0 * k), 2.0 + k) for k in range(3)]
    for a, b, c in itertools.permutations(ds):
        assert wasserstein(a, c) <= wasserstein(a, b) + wasserstein(b, c) + 0.02
    a, b = blob(3, count=2500), blob(4, (24.0, -6.0), 6.0, count=2500)
    fine, coarse = (wasserstein(a, b, bin_width=width) for width in (0.5, 2.0))
    assert abs(fine - coarse) < 0.05
    binned = a.bin(4.0)
    assert wasserstein(a, binned, reach=None, bin_width=0) <= math.sqrt(0.5) * binned.spread + 0.01


@settings(deadline=None, max_examples=8)
@given(seeds=st.tuples(*[st.integers(0, 1000)] * 2), by=st.floats(-10, 10))
def test_symmetry(seeds: tuple[int, int], by: float) -> None:
    a, b = blob(seeds[0], count=60), moved(blob(seeds[1], count=60), (by, 0.0))
    assert wasserstein(a, b) == pytest.approx(wasserstein(b, a), rel=1e-3, abs=0.03)


#: Near, far enough for exp(-C / blur²) to leave float32's range many times over, narrow, and a single point.
CLOUDS = [
    uneven(0, 60), uneven(1, 45, (15, -4), 6.0), uneven(2, 70, (-150, 200), 30.0), uneven(3, 30, (1, 1), 0.2),
    uneven(4, 1, (5, 5)),
]  # fmt: skip
REGIMES = pytest.mark.parametrize(("blur", "reach"), [(1.0, 20.0), (0.3, 5.0), (1.0, None)])


@REGIMES
def test_costs_are_geomloss_s(blur: float, reach: float | None) -> None:
    """In float64; float32 keeps 1e-6 of a potential."""
    packed = module.pack([d.points for d in CLOUDS], [d.normalised.weights for d in CLOUDS])
    first, second = np.triu_indices(len(CLOUDS), 1)
    falls = module.pair_halvings(packed, first, second, blur)
    parts = [[torch.from_numpy(part) for part in (d.normalised.weights, d.points)] for d in CLOUDS]
    truth = []
    for i, j, n in zip(first, second, falls, strict=True):
        options = {"blur": blur, "reach": reach, "diameter": blur * 2.0 ** (n - 0.5), "debias": False}
        truth.append(float(SamplesLoss("sinkhorn", p=2, backend="tensorized", **options)(*parts[i], *parts[j])))
    values = module.costs(packed, first, second, falls, blur=blur, reach=reach)
    np.testing.assert_allclose(values, truth, rtol=2e-5, atol=1e-4)


@pytest.mark.parametrize("edge", [1.0, 0.3, 3.7, 181.0, 181.1, 1e5])
def test_a_box_fits_its_diameter_and_would_not_fit_half_of_it(edge: float) -> None:
    """At 2^7.5 = 181.02 a further step is needed; points that are one start at blur · √½ above and end at blur."""
    n = int(module.halvings(np.array([edge, 0.0]), 1.0))
    assert max(edge, 1.0) <= 2.0 ** (n - 0.5) < 2 * max(edge, 1.0)
    assert module.halvings(np.zeros(2), 0.5) == 1


def close(distance: float, truth: float) -> bool:
    """To 1e-4 of itself; its square, the debiased cost, is a difference of costs that float32 holds to some 1e-6."""
    return abs(distance**2 - truth**2) <= 2e-4 * truth**2 + 1e-6


@pytest.mark.slow
def test_distances_are_wasserstein_s_on_the_packaged_atlas() -> None:
    """Of shapes of all sizes, and of each with its nearest by the sliced distance."""
    atlas = load_atlas()
    embeddings = atlas.embeddings("mask")
    for k in range(0, len(atlas), len(atlas) // 5):
        near = int(np.argsort(np.linalg.norm(embeddings - embeddings[k], axis=1))[1])
        others = [atlas.mask_diagrams[near], atlas.mask_diagrams[k // 2 + 1], atlas.field_diagrams[k]]
        for distance, other in zip(one_to_many(atlas.mask_diagrams[k], others), others, strict=True):
            assert close(distance, wasserstein(atlas.mask_diagrams[k], other))


@REGIMES
def test_distances_are_wasserstein_s_far_near_narrow_and_on_single_points(blur: float, reach: float | None) -> None:
    near = [moved(CLOUDS[0], (shift, shift)) for shift in (0.01, 0.1, 1.0)]
    diagrams, options = [*CLOUDS, *near, uneven(5, 1, (900.0, -900.0))], {"blur": blur, "reach": reach, "bin_width": 0}
    distances = pairwise(diagrams, **options)
    assert (distances == distances.T).all() and (np.diag(distances) == 0).all()
    for i, j in itertools.combinations(range(len(diagrams)), 2):
        assert close(distances[i, j], wasserstein(diagrams[i], diagrams[j], **options)), (i, j)
