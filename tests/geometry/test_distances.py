"""Distances between diagrams: metric properties, known values, geomloss's values, and what binning costs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from geomloss import SamplesLoss
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.geometry import distances as module
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.distances import one_to_many, pairwise, sliced_embedding, wasserstein
from curvafit.inference.atlas import load_atlas


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
    """From itself at any scale of weights, and a point of weight 3 from three points."""
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


def test_sliced_distance_ranks_as_the_full_one() -> None:
    query, others = blob(0), [blob(k, (20.0 + 3 * k, -5.0 - k)) for k in range(1, 6)]
    full = [wasserstein(query, other, reach=None) for other in others]
    assert np.argsort(full).tolist() == np.argsort([sliced(query, other) for other in others]).tolist()
    assert sliced_embedding(query).shape == (288,)


#: Near, far enough for exp(-C / blur²) to leave float32's range many times over, narrow, and a single point.
CLOUDS = [
    uneven(0, 60),
    uneven(1, 45, (15, -4), 6.0),
    uneven(2, 70, (-150, 200), 30.0),
    uneven(3, 30, (1, 1), 0.2),
    uneven(4, 1, (5, 5)),
]
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


def test_a_distance_is_the_pair_s_own_whoever_else_is_there() -> None:
    """The number of steps is the pair's. Weights are shares, and points without any do not count."""
    together = pairwise(CLOUDS)
    for i, j in itertools.combinations(range(len(CLOUDS)), 2):
        assert pairwise([CLOUDS[i], CLOUDS[j]])[0, 1] == pytest.approx(together[i, j], rel=1e-5)
    others = [replace(d, weights=7 * d.weights) for d in CLOUDS]
    np.testing.assert_allclose(one_to_many(CLOUDS[1], others), together[1], rtol=1e-5, atol=0.01)
    assert one_to_many(CLOUDS[0], []).shape == (0,) and pairwise([]).shape == (0, 0)
    a = CLOUDS[0]
    more = Diagram(np.concatenate([a.points, [[500.0, 0.0]]]), np.append(a.weights, 0.0))
    assert one_to_many(a, [more], bin_width=0)[0] == 0
