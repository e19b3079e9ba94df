"""Distances between curvature diagrams: Sinkhorn's divergence of two, of one and many, of every pair.

Many distances at once are numba's loops over geomloss's steps in float32; `wasserstein` is geomloss's in float64, and
takes these loops where geomloss is not installed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange

from curvafit.core.checks import check_type
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram
from curvafit.priors.kernels.threads import Kernel, count_threads

#: Pairs that are computed at once: a few seconds on a processor.
BLOCK = 8192
#: Lines on which a sliced embedding projects a diagram, and quantiles of each.
DIRECTIONS, QUANTILES = 12, 24
#: All fast-math flags but those that assume that no value is NaN or infinite.
_FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
_SERIAL = {"cache": True, "fastmath": _FAST, "error_model": "numpy", "nogil": True}
#: A sum over the plan is trusted between these; outside, what it adds may have left float32's range.
_LEAST, _MOST = np.float32(1e-25), np.float32(1e30)
_LN2 = math.log(2.0)
_LOW, _HIGH = np.float32(-126), np.float32(127)
_ZERO, _ONE = np.float32(0), np.float32(1)
#: Taylor's coefficients of 2^r, from the fifth to the first: on [-½, ½] the relative error is below 3e-7.
_C5, _C4, _C3, _C2, _C1 = (np.float32(_LN2**k / math.factorial(k)) for k in (5, 4, 3, 2, 1))


def pairwise(
    diagrams: Sequence[Diagram], *, blur: float = 1.0, reach: float | None = 20.0, bin_width: float = BIN_WIDTH
) -> np.ndarray:
    """Return `wasserstein` of every pair of N diagrams: `(N, N)` float64, symmetric, with a zero diagonal.

    Values agree with `wasserstein` to a relative 1e-4, or to 1e-5 below 0.1: the steps are the same, in float32. A pair
    takes half a millisecond, on numba's threads. Options and errors are those of `wasserstein`.
    """
    distances = np.zeros((len(diagrams),) * 2)
    first, second = np.triu_indices(len(diagrams), 1)
    order = np.random.default_rng(0).permutation(len(first))  # so that no thread gets most of the large diagrams
    i, j = first[order], second[order]
    distances[i, j] = distances[j, i] = _measure_pairs(diagrams, i, j, blur, reach, bin_width)
    return distances


def one_to_many(
    query: Diagram,
    diagrams: Sequence[Diagram],
    *,
    blur: float = 1.0,
    reach: float | None = 20.0,
    bin_width: float = BIN_WIDTH,
) -> np.ndarray:
    """Return the distances `(N,)` of one diagram to each of N; options and errors are those of `pairwise`."""
    others = np.arange(1, len(diagrams) + 1)
    return _measure_pairs([query, *diagrams], np.zeros_like(others), others, blur, reach, bin_width)


def _measure_pairs(
    diagrams: Sequence[Diagram], first: np.ndarray, second: np.ndarray, blur: float, reach: float | None, width: float
) -> np.ndarray:
    """Return the debiased Sinkhorn distances √(cost(a, b) - cost(a, a) / 2 - cost(b, b) / 2) of K pairs, `(K,)`."""
    binned = _normalise(diagrams, blur, reach, width)
    clouds = pack([d.points for d in binned], [d.weights for d in binned])
    # A cloud's cost with itself depends on the pair's number of halvings: it is computed once for each cloud and number
    # that occur, two or three numbers for a cloud.
    counts = pair_halvings(clouds, first, second, blur)
    keys = np.concatenate([np.stack([indices, counts], axis=1) for indices in (first, second)])
    distinct, inverse = np.unique(keys, axis=0, return_inverse=True)
    self_costs = costs(clouds, distinct[:, 0], distinct[:, 0], distinct[:, 1], blur=blur, reach=reach)
    bias = self_costs[inverse.reshape(2, -1)].sum(0) / 2
    blocks = (slice(start, start + BLOCK) for start in range(0, len(first), BLOCK))  # Ctrl-C ends work between two
    pair_costs = [costs(clouds, first[b], second[b], counts[b], blur=blur, reach=reach) for b in blocks]
    return np.sqrt(np.maximum(np.concatenate([np.empty(0), *pair_costs]) - bias, 0))


def wasserstein(
    a: Diagram, b: Diagram, *, blur: float = 1.0, reach: float | None = 20.0, bin_width: float = BIN_WIDTH
) -> float:
    """Return the Wasserstein distance of two curvature diagrams, as the paper takes it.

    It is the root of the debiased unbalanced Sinkhorn divergence of the diagrams with total weight 1, cost ½|x - y|²,
    blur 1 and reach 20 (in 1 / grid's unit), on binned diagrams instead of random triangles. Two diagrams that differ
    by a small shift s are |s| / √2 apart; far apart, the distance levels off.

    geomloss computes it in float64; where geomloss is not installed, `one_to_many` does in float32, with the accuracy
    of `pairwise`. Raises ValueError if a diagram is none or empty, the units differ, or a parameter is out of range.

    Parameters
    ----------
    reach
        How far area is moved before it is cheaper to destroy it; None moves all.
    bin_width
        Edge of the bins, widened in the tails (`Diagram.thin`); 0 compares the points as they are. On published
        fields and their masks (distances of 0.4 to 7), bins of 1, 2 and 3 changed a distance by at most 0.01, 0.03 and
        0.1.
    """
    first, second = _normalise([a, b], blur, reach, bin_width)
    if find_spec("geomloss") is None:
        return float(one_to_many(first, [second], blur=blur, reach=reach, bin_width=0)[0])
    from geomloss import SamplesLoss

    clouds = pack([first.points, second.points], [first.weights, second.weights])
    count = pair_halvings(clouds, np.array([0]), np.array([1]), blur)[0]
    options = {"blur": blur, "reach": reach, "diameter": blur * 2.0 ** (float(count) - 0.5)}
    loss = SamplesLoss("sinkhorn", p=2, debias=True, backend="tensorized", **options)
    with torch.no_grad():
        tensors = (torch.from_numpy(values) for d in (first, second) for values in (d.weights, d.points))
        return math.sqrt(max(0.0, float(loss(*tensors))))


def _normalise(diagrams: Sequence[Diagram], blur: float, reach: float | None, bin_width: float) -> list[Diagram]:
    """Return the diagrams binned and with total weight 1; raise ValueError where they or an option are not valid."""
    if not blur > 0 or not (reach is None or reach > 0) or bin_width < 0:
        raise ValueError(f"expected positive blur and reach, got blur {blur}, reach {reach}, bin width {bin_width}")
    for other in diagrams:
        check_type(other, Diagram, "curvature diagrams, which `curvafit.diagram` and `Measures.diagram` give")
        if other.unit != diagrams[0].unit:
            raise ValueError(f"expected diagrams in one unit, got {diagrams[0].unit} and {other.unit}")
    normalised = (diagram.normalised for diagram in diagrams)
    return [diagram.thin(bin_width, TAIL_SHARE) if bin_width else diagram for diagram in normalised]


def sliced_embedding(diagram: Diagram) -> np.ndarray:
    """Return 24 quantiles of a diagram's projections on each of 12 lines through the origin, `(288,)`.

    They are scaled so that the Euclidean distance of two embeddings is their sliced W₂, the mean over directions of the
    squared one-dimensional distances: |s| / √2 for a shift by s, as in `wasserstein`.
    """
    normalised = diagram.normalised
    angles = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    levels = (np.arange(QUANTILES) + 0.5) / QUANTILES
    projections = normalised.points @ np.stack([np.cos(angles), np.sin(angles)])
    quantiles = []
    for values in projections.T:
        order = np.argsort(values, kind="stable")
        weights = normalised.weights[order]
        quantiles.append(np.interp(levels, np.cumsum(weights) - weights / 2, values[order]))
    return np.concatenate(quantiles) / math.sqrt(DIRECTIONS * QUANTILES)


class Clouds(NamedTuple):
    """N weighted point sets, one after another, in float32.

    Cloud i is rows bounds[i] to bounds[i + 1] of `x`, `y` and `log2` (of the weights); `low` and `high` `(N, 2)` are
    the corners of its box.
    """

    x: np.ndarray
    y: np.ndarray
    log2: np.ndarray
    bounds: np.ndarray
    low: np.ndarray
    high: np.ndarray


def pack(points: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> Clouds:
    """Pack point sets `(n, 2)` with weights `(n,)`, some of each above 0; points without weight are left out."""
    points = [p[w > 0].astype(np.float32) for p, w in zip(points, weights, strict=True)]
    flat = np.concatenate([np.empty((0, 2), np.float32), *points])  # there may be no sets
    log2 = np.concatenate([np.empty(0), *(np.log2(w[w > 0]) for w in weights)])
    low, high = (np.array([end(p, axis=0) for p in points], np.float64).reshape(-1, 2) for end in (np.min, np.max))
    bounds = np.cumsum([0, *map(len, points)])
    x, y = np.ascontiguousarray(flat.T)
    return Clouds(x, y, log2.astype(np.float32), bounds, low, high)


def halvings(size: np.ndarray, blur: float) -> np.ndarray:
    """Return n, how often √ε halves: blur · 2^(n - ½) is the least such diameter that holds a box of edges `(…, 2)`."""
    diameter = np.maximum(np.hypot(size[..., 0], size[..., 1]), blur)
    return np.ceil(np.log2(diameter / blur) + 0.5).astype(np.int64)


def pair_halvings(clouds: Clouds, first: np.ndarray, second: np.ndarray, blur: float) -> np.ndarray:
    """Return `halvings` of the box that holds both clouds of each pair, `(K,)`."""
    high = np.maximum(clouds.high[first], clouds.high[second])
    return halvings(high - np.minimum(clouds.low[first], clouds.low[second]), blur)


def costs(
    clouds: Clouds, first: np.ndarray, second: np.ndarray, falls: np.ndarray, *, blur: float, reach: float | None
) -> np.ndarray:
    """Return the entropic, unbalanced cost OT_ε of each pair of clouds, ½|x - y|² a unit moved, `(K,)` float64.

    `first` and `second` number the clouds of each pair `(K,)`, and √ε halves `falls` times `(K,)` (`halvings`) down to
    `blur`; `reach` is √ρ of the penalty on what is not moved, and None moves everything. The debiased divergence is a
    pair's cost less half of each cloud's with itself (Séjourné et al. 2019).
    """
    first, second = (np.asarray(numbers, dtype=np.int64) for numbers in (first, second))
    ε, shares = _schedule(falls, blur)
    ρ = math.inf if reach is None else reach**2
    values = np.empty(len(first))
    _fill_costs(count_threads(), clouds, first, second, ε, shares, ρ, values)
    return values


def _schedule(falls: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ε of every step of every pair, and the share of its potentials that a step keeps, both `(K, T)`."""
    # All pairs end together: one with fewer steps begins later, at its step 0. The share is 1 before a pair begins, 0
    # at its first step and its last, ½ between.
    falls = np.asarray(falls, dtype=np.int64)[:, None]
    counts = falls + 4
    longest = int(counts.max(initial=0))
    step = np.arange(longest) - (longest - counts)
    ε = np.where(step >= falls + 2, blur**2, (blur * 2.0 ** (falls - 0.5 - np.maximum(step - 2, 0))) ** 2)
    first_or_last = (step == 0) | (step == counts - 1)
    return ε, np.where(first_or_last, 0.0, np.where(step < 0, 1.0, 0.5))


@partial(Kernel, **_SERIAL)
def _fill_costs(clouds, first, second, ε, shares, ρ, values):
    """Write the cost of every pair into `values`."""
    for k in prange(len(first)):
        a, b = _slice_cloud(clouds, first[k]), _slice_cloud(clouds, second[k])
        values[k] = _cost(a, b, ε[k], shares[k], ρ)


@njit(**_SERIAL)
def _slice_cloud(clouds, number):
    """Return x, y and the weights' log2 of one cloud."""
    rows = slice(clouds.bounds[number], clouds.bounds[number + 1])
    return clouds.x[rows], clouds.y[rows], clouds.log2[rows]


@njit(**_SERIAL)
def _cost(a, b, ε, shares, ρ):
    """Return the cost of one pair: Sinkhorn's steps on the potentials f and g, of both at once."""
    (x, y, log_a), (X, Y, log_b) = a, b
    n, m = len(x), len(X)
    f, g = np.zeros(n), np.zeros(m)
    # F, G: potentials over ε and weights, in powers of 2; to_f, to_g: log2 of the sums that give new potentials.
    F, G = np.empty(n, np.float32), np.empty(m, np.float32)
    to_f, to_g = np.empty(n, np.float32), np.empty(m, np.float32)
    for t in range(len(ε)):
        if shares[t] == 1:
            continue
        unit = ε[t] * _LN2
        h = np.float32(0.5 / unit)
        for i in range(n):
            F[i] = f[i] / unit + log_a[i]
        for j in range(m):
            G[j] = g[j] / unit + log_b[j]
        source, target = (x, y, F), (X, Y, G)
        _plan_sums(source, target, h, to_f, to_g)
        _take_logarithms(source, target, h, to_f)
        _take_logarithms(target, source, h, to_g)
        factor = (1 - shares[t]) * unit / (1 + ε[t] / ρ)
        for i in range(n):
            f[i] = shares[t] * f[i] - factor * to_f[i]
        for j in range(m):
            g[j] = shares[t] * g[j] - factor * to_g[j]
    return _dual_cost(log_a, f, ε[-1], ρ) + _dual_cost(log_b, g, ε[-1], ρ)


@njit(**_SERIAL)
def _plan_sums(source, target, h, rows, columns):
    """Write the sums of the plan 2^(F + G - h d²) over its second index into `rows`, over its first into `columns`."""
    (x, y, F), (X, Y, G) = source, target
    columns[:] = _ZERO
    for i in range(len(x)):
        xi, yi, Fi = x[i], y[i], F[i]
        total = _ZERO
        for j in range(len(X)):
            dx, dy = xi - X[j], yi - Y[j]
            mass = _exp2(Fi + G[j] - h * (dx * dx + dy * dy))
            total += mass
            columns[j] += mass
        rows[i] = total


@njit(**_SERIAL)
def _take_logarithms(source, target, h, sums):
    """Replace the sums over the plan's rows by log2 ∑ 2^(G - h d²) of every row; G and d are those of the target."""
    x, y, F = source
    for i in range(len(x)):
        if _LEAST < sums[i] < _MOST:
            sums[i] = np.log2(sums[i]) - F[i]
        else:
            sums[i] = _log_sum(x[i], y[i], target, h)


@njit(**_SERIAL)
def _log_sum(x, y, target, h):
    """Return log2 ∑ 2^(G - h d²) of one row; its largest term is factored out, so that nothing overflows."""
    X, Y, G = target
    top = np.float32(-np.inf)
    for j in range(len(X)):
        dx, dy = x - X[j], y - Y[j]
        top = max(top, G[j] - h * (dx * dx + dy * dy))
    total = _ZERO
    for j in range(len(X)):
        dx, dy = x - X[j], y - Y[j]
        total += _exp2(G[j] - h * (dx * dx + dy * dy) - top)
    return top + np.log2(total)


@njit(inline="always")
def _exp2(t):
    """Return 2^t in float32, to a relative 3e-7: a polynomial of the fraction, times a float made of exponent bits."""
    t = min(max(t, _LOW), _HIGH)
    whole = np.rint(t)
    r = t - whole
    value = _ONE + r * (_C1 + r * (_C2 + r * (_C3 + r * (_C4 + r * _C5))))
    return value * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(**_SERIAL)
def _dual_cost(log_weights, f, ε, ρ):
    """Return what a potential adds to the cost: ∑ a (ρ + ε/2) (1 - exp(-f/ρ)), or ∑ a f where all is moved."""
    total = 0.0
    for i in range(len(f)):
        value = f[i] if np.isinf(ρ) else -(ρ + ε / 2) * math.expm1(-f[i] / ρ)
        total += 2.0 ** np.float64(log_weights[i]) * value
    return total
