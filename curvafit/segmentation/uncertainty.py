"""Probabilities of the inside: weights of evidence where the truth is known, calibration, and what to annotate next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import entr, expit, logit
from scipy.stats import t as student

from curvafit.scan.grids import centre_distance
from curvafit.segmentation.slices import filled_range, harmonic_distance

#: Distance from a surface, in voxels, within which probabilities are judged.
NEAR = 3
#: Greatest weight: where all is right it would grow without end.
STRONGEST = 20.0
#: Most voxels that the weights are fitted to.
MOST = 1_000_000
#: Least threshold, by the Dice of real structures at gaps of 8 to 16 slices.
LEAST = 0.35
#: Thresholds that are tried.
THRESHOLDS = 1000
#: Log-odds within which a voxel counts for a temperature.
UNSURE = 4.0
#: Bins of the calibration error.
BINS = 15


def near_surface(mask: np.ndarray) -> np.ndarray:
    """Return the voxels whose centres are within `NEAR` voxels of a mask's surface; none where there is no surface."""
    return np.abs(centre_distance(mask, (1, 1, 1), dtype=np.float64)) < NEAR


def fit_weights(evidence: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the weights under which evidence (N, K) makes what is inside (N,) most likely: one for each kind, from 0,
    and a constant.
    """
    stride = -(-len(inside) // MOST)
    signed = np.where(inside[::stride, None], 1.0, -1.0) * _with_constant(evidence[::stride])

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = signed @ weights
        return float(np.logaddexp(0, -margin).mean()), -(expit(-margin) @ signed) / len(signed)

    kinds = evidence.shape[1]
    bounds = [*[(0, STRONGEST)] * kinds, (-STRONGEST, STRONGEST)]
    return minimize(cost, np.append(np.ones(kinds), 0.0), jac=True, method="L-BFGS-B", bounds=bounds).x


def probability(evidence: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the probability of the inside, float64 (N,)."""
    return expit(_with_constant(evidence) @ weights)


def count_probabilities(probability: np.ndarray) -> np.ndarray:
    """Return how many probabilities lie in each of `THRESHOLDS` equal bins from 0 to 1; the counts of parts add up."""
    return np.histogram(probability, THRESHOLDS, (0.0, 1.0))[0]


def best_threshold(counts: np.ndarray) -> float:
    """Return the probability, at most one half, above which voxels are inside in the mask with the best expected Dice.
    `counts` are those of `count_probabilities`. A mask of N voxels whose probabilities add up to s has the expected
    Dice 2 s / (N + S), where S is the sum over all voxels; its maximum leaves out what is less likely than half of it.
    At one half, structures that are hard to predict would get lost."""
    edges = np.linspace(0.0, 1.0, THRESHOLDS + 1)
    sizes, sums = (np.cumsum(each[::-1]) for each in (counts, counts * (edges[1:] + edges[:-1]) / 2))
    best = int(np.argmax(sums / np.maximum(sizes + sums[-1], 1e-9)))
    return min(0.5, float(edges[::-1][best + 1]))


def expected_dice(probability: np.ndarray, mask: np.ndarray) -> float:
    """Return the Dice that a mask has, to first order on average, if voxels are inside with these probabilities."""
    inside, whole = (float(each.sum(dtype=np.float64)) for each in (probability[mask], probability))
    return 2 * inside / max(float(mask.sum()) + whole, 1e-9)


def best_log_odds(logits: np.ndarray) -> float:
    """Return the log-odds of the `best_threshold` of voxels with these log-odds, but not below that of `LEAST`: where
    structures are thinner than those that taught, probabilities are too small, and so would the threshold be."""
    return float(logit(max(best_threshold(count_probabilities(expit(logits))), LEAST)))


def fit_temperature(logits: np.ndarray, inside: np.ndarray) -> float:
    """Return by what log-odds (N,) are to be divided for the least cross entropy where they are unsure."""
    near = np.abs(logits) < UNSURE
    if not near.any():
        return 1.0
    signed = np.where(inside[near] > 0, -1.0, 1.0) * logits[near]
    found = minimize_scalar(lambda t: float(np.logaddexp(0, signed / np.exp(t)).mean()), bounds=(-1, 2))
    return float(np.exp(found.x))


def calibration_error(probability: np.ndarray, inside: np.ndarray) -> float:
    """Return the expected calibration error: the mean over voxels of the difference, in a voxel's bin of probability,
    between the share that is inside and the mean probability; 0 where there are no voxels."""
    where = np.minimum((probability * BINS).astype(int), BINS - 1)
    excess = np.bincount(where, inside - probability.astype(np.float64), minlength=BINS)
    return float(np.abs(excess).sum() / max(len(where), 1))


def entropy(probability: np.ndarray) -> np.ndarray:
    """Return the entropy of each probability of two outcomes, in nats."""
    p = probability.astype(np.float64)
    return entr(p) + entr(1 - p)


def doubt(probability: np.ndarray) -> np.ndarray:
    """Return the entropy of each probability; 0 of exactly one half, which stands where nothing was filled."""
    return entropy(np.where(probability == 0.5, 0, probability))


def share_by_slices(
    shares: np.ndarray, places: Sequence[int], length: int, *, periodic: bool = False, whole: bool = False
) -> tuple[float, ...]:
    """Return the share of a volume by Cavalieri's principle, from those of known slices, and its 95 % interval where
    three or more are known.

    Shares are linear between known slices and constant beyond them, in slices that are filled or in the `whole` volume.
    The interval takes them for a random walk with jumps of single slices, as Gundersen and Jensen do; of smooth shapes
    it is too wide. How far a share lies off the line between its neighbours, and off the next one, tells the variances
    of both. A step of the walk adds n (n² - 1) / 12 in a gap of n slices and e (e + 1) (2e + 1) / 6 in e slices beyond
    an end; a jump adds the square of how many slices a known one counts for.
    """
    reach, at = slice(0, length) if whole else filled_range(places, length), np.array(places, dtype=np.int64)
    if periodic:
        at, shares = np.append(at, at[0] + length), np.append(shares, shares[0])
        reach = slice(int(at[0]), int(at[-1]))
    rows = np.arange(reach.start, reach.stop)
    weights = np.array([np.interp(rows, at, row).sum() for row in np.eye(len(at))])
    gaps, known = np.diff(at), float(weights @ shares) / length
    if len(gaps) < 2:
        return (known,)
    left, right = gaps[:-1], gaps[1:]
    off = shares[1:-1] - (shares[:-2] * right + shares[2:] * left) / (left + right)
    walk, jump = (left * right / (left + right)).mean(), (1 + (left**2 + right**2) / (left + right) ** 2).mean()
    square, rise = np.mean(off**2), np.mean(np.diff(shares) ** 2)
    jumps = max(0.0, (square * gaps.mean() - rise * walk) / (jump * gaps.mean() - 2 * walk))
    steps = max(0.0, square - jumps * jump) / walk
    ends = np.maximum([at[0] - reach.start, reach.stop - 1 - at[-1]], 0)
    walked = (gaps * (gaps**2 - 1) / 12).sum() + (ends * (ends + 1) * (2 * ends + 1) / 6).sum()
    half = float(student.ppf(0.975, len(off)) * np.sqrt(steps * walked + jumps * weights @ weights)) / length
    return known, max(known - half, 0.0), min(known + half, 1.0)


def _with_constant(evidence: np.ndarray) -> np.ndarray:
    return np.concatenate([evidence, np.ones_like(evidence[:, :1])], axis=1)


def suggest_slices(entropies: np.ndarray, places: Sequence[int], count: int, periodic: bool = False) -> tuple[int, ...]:
    """Return the slices to annotate next, given entropies (Z,), the most telling first, each chosen as if those
    before it were known; fewer where no other would tell anything."""
    known, left = set(places), np.asarray(entropies, dtype=np.float64)
    chosen: list[int] = []
    for _ in range(count):
        unknown = [n for n in range(len(left)) if n not in known]
        after = [remaining_entropy(left, known, n, periodic) for n in unknown]
        sums = [each.sum() for each in after]
        if not sums or min(sums) >= left.sum():
            break
        best = int(np.argmin(sums))
        left = after[best]
        chosen.append(unknown[best])
        known.add(unknown[best])
    return tuple(chosen)


def remaining_entropy(
    entropies: np.ndarray, places: Sequence[int] | set[int], new: int, periodic: bool = False
) -> np.ndarray:
    """Return the entropies (Z,) of the slices once a new one is known. The uncertain layer of a slice is as thick as
    its `harmonic_distance`: in that proportion the entropy falls. A new slice tells nothing about slices beyond other
    known ones."""
    before, after = (harmonic_distance(sorted(known), len(entropies), periodic) for known in (places, {*places, new}))
    return entropies * np.divide(after, before, out=np.zeros_like(before), where=before > 0)
