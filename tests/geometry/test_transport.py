"""Distances between diagrams: metric properties, known values, and what binning costs."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.distances import sinkhorn_divergence, sliced_embedding, wasserstein


def blob(seed: int = 0, centre: tuple[float, float] = (20.0, -5.0), width: float = 4.0, count: int = 300) -> Diagram:
    generator = np.random.default_rng(seed)
    return Diagram(generator.normal(centre, width, (count, 2)), generator.random(count) + 0.1)


def moved(d: Diagram, by: tuple[float, float]) -> Diagram:
    return dataclasses.replace(d, points=d.points + np.array(by))


def test_a_diagram_is_at_distance_zero_from_itself_at_any_scale() -> None:
    d = blob()
    assert wasserstein(d, d) == pytest.approx(0, abs=1e-2)
    assert wasserstein(d, dataclasses.replace(d, weights=7 * d.weights)) == pytest.approx(0, abs=1e-2)


@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, -2.0), (3.0, 4.0)])
def test_balanced_distance_of_a_shift(shift: tuple[float, float]) -> None:
    """Cost ½|x - y|²: a shift by s costs |s| / √2, in Sinkhorn's and in the sliced distance alike."""
    a = blob()
    b = moved(a, shift)
    truth = math.hypot(*shift) / math.sqrt(2)
    assert wasserstein(a, b, reach=None, bin_width=0) == pytest.approx(truth, rel=1e-3)
    assert np.linalg.norm(sliced_embedding(a) - sliced_embedding(b)) == pytest.approx(truth, rel=1e-9)


def test_distances_of_gaussians_in_closed_form() -> None:
    """W2² of N(m, s²) and N(n, t²) in the plane: |m - n|² + 2 (s - t)²; halved by the cost."""
    a, b = blob(1, (0, 0), 3.0, 1500), blob(2, (6, 0), 5.0, 1500)
    truth = math.sqrt((6**2 + 2 * 2**2) / 2)
    assert wasserstein(a, b, reach=None) == pytest.approx(truth, rel=0.05)
    assert np.linalg.norm(sliced_embedding(a) - sliced_embedding(b)) == pytest.approx(truth, rel=0.06)


def test_unbalanced_distance_is_below_and_levels_off() -> None:
    a = blob()
    near, far, farther = (wasserstein(a, moved(a, (s, 0.0))) for s in (5.0, 60.0, 200.0))
    assert near < wasserstein(a, moved(a, (5.0, 0.0)), reach=None)
    assert farther == pytest.approx(far, rel=0.12)
    assert far < 20 * math.sqrt(2)  # all of both destroyed and made anew


@settings(deadline=None, max_examples=8)
@given(seeds=st.tuples(*[st.integers(0, 1000)] * 2), by=st.floats(-10, 10))
def test_symmetry(seeds: tuple[int, int], by: float) -> None:
    a, b = blob(seeds[0], count=60), moved(blob(seeds[1], count=60), (by, 0.0))
    assert wasserstein(a, b) == pytest.approx(wasserstein(b, a), rel=1e-3, abs=0.03)


@pytest.mark.slow
def test_triangle_inequality_on_some() -> None:
    ds = [blob(k, (10.0 * k, -3.0 * k), 2.0 + k) for k in range(3)]
    for a, b, c in itertools.permutations(ds):
        assert wasserstein(a, c) <= wasserstein(a, b) + wasserstein(b, c) + 0.02


@pytest.mark.slow
def test_binning_costs_less_than_stated() -> None:
    """At most 0.05 at width 2, and √½ · spread is a bound on the distance to one's binned self."""
    a, b = blob(3, count=2500), blob(4, (24.0, -6.0), 6.0, count=2500)
    fine, coarse = (wasserstein(a, b, bin_width=width) for width in (0.5, 2.0))
    assert abs(fine - coarse) < 0.05
    binned = a.bin(4.0)
    assert wasserstein(a, binned, reach=None, bin_width=0) <= math.sqrt(0.5) * binned.spread + 0.01


def measure(d: Diagram) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(d.points), torch.from_numpy(d.normalised.weights)


def test_the_divergence_is_the_distance_squared() -> None:
    a, b = blob(1), blob(2, (24.0, -6.0), 6.0)
    squared = sinkhorn_divergence(*measure(a), *measure(b), blur=1.0, reach=20.0)
    assert float(squared) == pytest.approx(wasserstein(a, b, bin_width=0) ** 2, rel=1e-6)


def test_the_gradient_of_a_shift_is_the_shift() -> None:
    """Balanced, D = ½|s|²; each point is pulled back by its weight times s, and one step along it brings b onto a."""
    a, shift = blob(), np.array([3.0, -4.0])
    points, weights = measure(moved(a, tuple(shift)))
    points.requires_grad_()
    sinkhorn_divergence(*measure(a), points, weights, blur=1.0, reach=None).backward()
    assert points.grad is not None
    np.testing.assert_allclose(points.grad.sum(0), shift, rtol=1e-3)
    back = points.detach() - points.grad / weights[:, None]
    assert float(sinkhorn_divergence(*measure(a), back, weights, blur=1.0, reach=None)) < 0.02 * (shift @ shift) / 2


def test_the_gradient_climbs() -> None:
    """By central differences along it, in points and in weights (their total kept) alike. The steps stop short of
    convergence while the gradient is that of converged potentials, so the slopes agree within a factor of two only."""
    clouds = blob(5, count=40), blob(6, (26.0, -3.0), count=40)
    measures = [part.requires_grad_() for d in clouds for part in measure(d)]
    sinkhorn_divergence(*measures, blur=1.0, reach=20.0).backward()
    for k, part in enumerate(measures):
        assert part.grad is not None
        up = part.grad - part.grad.mean() if part.ndim == 1 else part.grad
        step = 1e-3 * float(part.detach().norm() / up.norm())
        ends = []
        for move in (step, -step):
            there = [each.detach() + (move * up if place == k else 0) for place, each in enumerate(measures)]
            ends.append(float(sinkhorn_divergence(*there, blur=1.0, reach=20.0)))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert 0.5 < slope / float(up.square().sum()) < 2, k


def test_descent_brings_one_cloud_onto_the_other() -> None:
    a, (points, weights) = measure(blob(5, count=40)), measure(blob(6, (26.0, -3.0), count=40))
    values = []
    for _ in range(12):
        points = points.detach().requires_grad_()
        value = sinkhorn_divergence(*a, points, weights, blur=1.0, reach=20.0)
        value.backward()
        assert points.grad is not None
        values.append(float(value.detach()))
        points = points - 0.5 * points.grad / weights[:, None]
    assert values[-1] < 0.05 * values[0]


def test_a_caller_who_wants_no_gradients_gets_none_and_keeps_that() -> None:
    with torch.no_grad():
        assert not sinkhorn_divergence(*measure(blob()), *measure(blob(1)), blur=1.0, reach=20.0).requires_grad
        assert not torch.is_grad_enabled()


def test_points_that_are_one_have_a_distance() -> None:
    """No diameter to begin with: ε is blur² from the start."""
    one = Diagram(np.array([[3.0, -1.0]]), np.array([2.0]))
    assert wasserstein(one, one) == pytest.approx(0, abs=1e-6)
    assert wasserstein(one, moved(one, (0.5, 0.0)), reach=None) == pytest.approx(0.5 / math.sqrt(2), rel=1e-3)


def test_sliced_distance_ranks_as_the_full_one() -> None:
    query = blob(0)
    others = [blob(k, (20.0 + 3 * k, -5.0 - k)) for k in range(1, 6)]
    full = [wasserstein(query, other, reach=None) for other in others]
    sliced = [float(np.linalg.norm(sliced_embedding(query) - sliced_embedding(d))) for d in others]
    assert np.argsort(full).tolist() == np.argsort(sliced).tolist()
    assert sliced_embedding(query).shape == (288,)


def test_weights_count() -> None:
    """A point of weight 3 is three points."""
    points = np.array([[0.0, 0.0], [10.0, -10.0]])
    heavy = Diagram(points, np.array([3.0, 1.0]))
    light = Diagram(points[[0, 0, 0, 1]], np.ones(4))
    assert wasserstein(heavy, light, bin_width=0) == pytest.approx(0, abs=1e-2)
    np.testing.assert_allclose(heavy.mean(), [2.5, -2.5])


def test_bad_input_is_one_sentence() -> None:
    a = blob()
    with pytest.raises(ValueError, match="empty"):
        wasserstein(a, Diagram(np.zeros((0, 2)), np.zeros(0)))
    with pytest.raises(ValueError, match="unit"):
        wasserstein(a, dataclasses.replace(a, unit="1/um"))
    with pytest.raises(ValueError, match="positive"):
        wasserstein(a, a, blur=0.0)
