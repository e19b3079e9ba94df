"""Distances between curvature diagrams: Sinkhorn divergences, and a sliced embedding to search with."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from geomloss import SamplesLoss
from torch import Tensor

from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE, Diagram
from curvafit.geometry.sinkhorn import halvings


def wasserstein(
    a: Diagram, b: Diagram, *, blur: float = 1.0, reach: float | None = 20.0, bin_width: float = BIN_WIDTH
) -> float:
    """Return √ of the debiased unbalanced Sinkhorn divergence of two normalised diagrams, cost ½|x - y|².

    The paper's distance (blur 1, reach 20: all in 1 / grid's unit), by geomloss, on binned diagrams instead of random
    triangles. Two diagrams that differ by a small shift s are |s| / √2 apart; far apart, the distance levels off.

    `curvafit.geometry.pairwise` and `one_to_many` give the same numbers to 1e-4 of them or 1e-5, many at a time; the
    atlas, matches and reports take theirs, so that all distances that a person compares come from one code.
    `sinkhorn_divergence` is the square of this distance, differentiable.

    Parameters
    ----------
    a, b
        Diagrams in the same unit.
    reach
        How far area is moved before it is cheaper to destroy it; None moves all.
    bin_width
        Edge of the bins, widened in the tails (`Diagram.thinned`); 0 compares the points as they are. On published
        fields and their masks (distances of 0.4 to 7), bins of 1, 2 and 3 changed a distance by at most 0.01, 0.03 and
        0.1; at 2 a diagram has 150 to 500 bins, and a distance takes a twentieth of a second once they are binned;
        `curvafit.geometry.pairwise` takes half a millisecond for each of many.

    Raises
    ------
    ValueError
        If a diagram is empty, the units differ, or a parameter is out of range.
    """
    first, second = comparable([a, b], blur, reach, bin_width)
    tensors = (torch.from_numpy(part) for d in (first, second) for part in (d.points, d.weights))
    with torch.no_grad():
        return math.sqrt(max(0.0, float(sinkhorn_divergence(*tensors, blur=blur, reach=reach))))


def sinkhorn_divergence(
    points_a: Tensor, weights_a: Tensor, points_b: Tensor, weights_b: Tensor, *, blur: float, reach: float | None
) -> Tensor:
    """Return the debiased unbalanced Sinkhorn divergence of two measures, cost ½|x - y|²: a scalar tensor.

    Its square root is `wasserstein`; descend the divergence itself, as the root's slope is infinite at 0. It is
    differentiable once in points and weights. The gradient is geomloss's, that of the last step with the potentials
    before it held, which would be exact at convergence (unbalanced: to blur² / 2 reach² of it). The steps stop short of
    that, so that the gradient leads down but its length may differ from the value's own slope by a third.

    Parameters
    ----------
    points_a, points_b
        `(N, 2)` and `(M, 2)`, of one floating-point type. Differences of near measures want float64.
    weights_a, weights_b
        `(N,)` and `(M,)`, of at least 0, each with a total of 1.
    blur, reach
        As `wasserstein` takes them, in the points' unit.
    """
    boxes = [points[weights > 0].detach().float().double().cpu().numpy() for points, weights in
             ((points_a, weights_a), (points_b, weights_b))]  # fmt: skip
    falls = halvings(np.ptp(np.concatenate(boxes), axis=0), blur)
    diameter = blur * 2.0 ** (float(falls) - 0.5)
    loss = SamplesLoss("sinkhorn", p=2, blur=blur, reach=reach, diameter=diameter, debias=True, backend="tensorized")
    with torch.set_grad_enabled(torch.is_grad_enabled()):  # geomloss leaves it switched on
        return loss(weights_a, points_a, weights_b, points_b)


def comparable(diagrams: Sequence[Diagram], blur: float, reach: float | None, bin_width: float) -> list[Diagram]:
    """Return the diagrams as distances take them: of total weight 1, in bins.

    Raises
    ------
    ValueError
        As `wasserstein`.
    """
    if not blur > 0 or not (reach is None or reach > 0) or bin_width < 0:
        raise ValueError(f"expected positive blur and reach, got blur {blur}, reach {reach}, bin width {bin_width}")
    for other in diagrams:
        if other.unit != diagrams[0].unit:
            raise ValueError(f"expected diagrams in one unit, got {diagrams[0].unit} and {other.unit}")
    whole = (diagram.normalised for diagram in diagrams)
    return [each.thinned(bin_width, TAIL_SHARE) if bin_width else each for each in whole]


def sliced_embedding(diagram: Diagram, directions: int = 12, quantiles: int = 24) -> np.ndarray:
    """Return quantiles of a diagram's projections on lines through the origin, `(directions · quantiles,)`.

    Scaled so that the Euclidean distance of two embeddings is their sliced W₂, the mean over directions of the squared
    one-dimensional distances: |s| / √2 for a shift by s, as in `wasserstein`.
    """
    whole = diagram.normalised
    angles = np.pi * np.arange(directions) / directions
    levels = (np.arange(quantiles) + 0.5) / quantiles
    lines = whole.points @ np.stack([np.cos(angles), np.sin(angles)])
    rows = []
    for values in lines.T:
        order = np.argsort(values, kind="stable")
        reached = np.cumsum(whole.weights[order]) - whole.weights[order] / 2
        rows.append(np.interp(levels, reached, values[order]))
    return np.concatenate(rows) / math.sqrt(directions * quantiles)
