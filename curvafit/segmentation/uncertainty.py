"""Probabilities of the inside: weights of evidence where the truth is known, calibration, and what to annotate next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import entr, expit, logit, stdtrit

from curvafit.scan.grids import centre_distance
from curvafit.segmentation.slices import filled_range, harmonic_distance

#: Distance from a surface, in voxels, within which probabilities are judged.
NEAR = 3
#: Greatest weight: evidence that is always right would have an infinite one.
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
    """Fit a logistic regression of `inside`, bool (N,), on evidence (N, K): K weights from 0 up, and a constant."""
    stride = -(-len(inside) // MOST)  # rounded up
    signed = np.where(inside[::stride, None], 1.0, -1.0) * _with_constant(evidence[::stride])

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = signed @ weights
        return float(np.logaddexp(0, -margin).mean()), -(expit(-margin) @ signed) / len(signed)

    count = evidence.shape[1]
    bounds = [*[(0, STRONGEST)] * count, (-STRONGEST, STRONGEST)]
    return minimize(cost, np.append(np.ones(count), 0.0), jac=True, method="L-BFGS-B", bounds=bounds).x


def probability(evidence: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the probability of the inside, float64 (N,), by evidence (N, K) and the weights of `fit_weights`."""
    return expit(_with_constant(evidence) @ weights)


def count_probabilities(probability: np.ndarray) -> np.ndarray:
    """Return the number of probabilities in each of `THRESHOLDS` equal bins from 0 to 1; counts of blocks add up."""
    return np.histogram(probability, THRESHOLDS, (0.0, 1.0))[0]


def best_threshold(counts: np.ndarray) -> float:
    """Return the threshold of the probability, at most 1/2, whose mask has the best expected Dice, given `counts` of
    `count_probabilities`. A mask of N voxels whose probabilities add up to s has the expected Dice 2 s / (N + S), where
    S is the sum over all voxels. The best threshold is half of it: at 1/2, what is hard to predict would get lost."""
    edges = np.linspace(0.0, 1.0, THRESHOLDS + 1)
    # N and s of the mask of the bins above each edge, from the highest down.
    sizes, sums = (np.cumsum(bins[::-1]) for bins in (counts, counts * (edges[1:] + edges[:-1]) / 2))
    best = int(np.argmax(sums / np.maximum(sizes + sums[-1], 1e-9)))
    return min(0.5, float(edges[::-1][best + 1]))


def expected_dice(probability: np.ndarray, mask: np.ndarray) -> float:
    """Return the expected Dice, to first order, of a mask whose voxels are inside with these probabilities."""
    inside, whole = (float(values.sum(dtype=np.float64)) for values in (probability[mask], probability))
    return 2 * inside / max(float(mask.sum()) + whole, 1e-9)


def best_log_odds(logits: np.ndarray) -> float:
    """Return the log-odds of the `best_threshold` of voxels with these log-odds, but at least those of `LEAST`: where
    structures are thinner than those in training, probabilities are too small, and so would the threshold be."""
    return float(logit(max(best_threshold(count_probabilities(expit(logits))), LEAST)))


def fit_temperature(logits: np.ndarray, inside: np.ndarray) -> float:
    """Return the temperature, which divides log-odds (N,), of least cross entropy over those within `UNSURE`."""
    unsure = np.abs(logits) < UNSURE
    if not unsure.any():
        return 1.0
    signed = np.where(inside[unsure] > 0, -1.0, 1.0) * logits[unsure]
    optimum = minimize_scalar(lambda t: float(np.logaddexp(0, signed / np.exp(t)).mean()), bounds=(-1, 2))
    return float(np.exp(optimum.x))


def calibration_error(probability: np.ndarray, inside: np.ndarray) -> float:
    """Return the expected calibration error of probabilities (N,): the mean over voxels of the difference, in a voxel's
    bin of probability, between the fraction inside and the mean probability; 0 where there are no voxels."""
    bins = np.minimum((probability * BINS).astype(int), BINS - 1)
    excess = np.bincount(bins, inside - probability.astype(np.float64), minlength=BINS)
    return float(np.abs(excess).sum() / max(len(bins), 1))


def entropy(probability: np.ndarray) -> np.ndarray:
    """Return the entropy, in nats, of two outcomes with each probability."""
    p = probability.astype(np.float64)
    return entr(p) + entr(1 - p)


def doubt(probability: np.ndarray) -> np.ndarray:
    """Return the entropy of each probability; 0 where it is exactly 1/2, which marks voxels that are not filled."""
    return entropy(np.where(probability == 0.5, 0, probability))


def share_by_slices(
    shares: np.ndarray, places: Sequence[int], length: int, *, whole: bool = False
) -> tuple[float, ...]:
    """Return the inside's fraction of a volume by Cavalieri's principle, from the fractions `shares` (N,) of the known
    slices at `places`, and its 95 % interval where three or more are known.

    Fractions are interpolated linearly between known slices, and constant beyond them: in slices that are filled, or in
    the `whole` volume. The interval takes them for a random walk plus noise of single slices, as Gundersen and Jensen
    do; of smooth shapes it is too wide. Both variances follow from the residuals of the line between a slice's
    neighbours, and from differences of successive slices. In units of the walk's variance, the volume varies by
    n (n² - 1) / 12 for a gap of n slices and e (e + 1) (2e + 1) / 6 for e slices beyond an end; in units of the
    noise's, by the sum of the squared weights of the slices.
    """
    filled, at = slice(0, length) if whole else filled_range(places, length), np.array(places, dtype=np.int64)
    rows = np.arange(filled.start, filled.stop)
    weights = np.array([np.interp(rows, at, basis).sum() for basis in np.eye(len(at))])
    gaps, share = np.diff(at), float(weights @ shares) / length
    if len(gaps) < 2:
        return (share,)
    before, after = gaps[:-1], gaps[1:]
    residuals = shares[1:-1] - (shares[:-2] * after + shares[2:] * before) / (before + after)
    # With variances W of the walk and N of the noise, E[residual²] = a W + b N and E[difference²] = (mean gap) W + 2 N.
    a = (before * after / (before + after)).mean()
    b = (1 + (before**2 + after**2) / (before + after) ** 2).mean()
    residual, difference = np.mean(residuals**2), np.mean(np.diff(shares) ** 2)
    noise = max(0.0, (residual * gaps.mean() - difference * a) / (b * gaps.mean() - 2 * a))
    walk = max(0.0, residual - noise * b) / a
    ends = np.maximum([at[0] - filled.start, filled.stop - 1 - at[-1]], 0)
    walked = (gaps * (gaps**2 - 1) / 12).sum() + (ends * (ends + 1) * (2 * ends + 1) / 6).sum()
    half = float(stdtrit(len(residuals), 0.975) * np.sqrt(walk * walked + noise * weights @ weights)) / length
    return share, max(share - half, 0.0), min(share + half, 1.0)


def _with_constant(evidence: np.ndarray) -> np.ndarray:
    return np.concatenate([evidence, np.ones_like(evidence[:, :1])], axis=1)


def suggest_slices(entropies: np.ndarray, places: Sequence[int], count: int) -> tuple[int, ...]:
    """Return up to `count` slices to annotate next, given entropies (Z,). Each is the one that lowers the sum of the
    entropies most, once those before it are known; there are fewer if none lowers it."""
    known, remaining = set(places), np.asarray(entropies, dtype=np.float64)
    chosen: list[int] = []
    for _ in range(count):
        unknown = [n for n in range(len(remaining)) if n not in known]
        options = [remaining_entropy(remaining, known, n) for n in unknown]
        sums = [option.sum() for option in options]
        if not sums or min(sums) >= remaining.sum():
            break
        best = int(np.argmin(sums))
        remaining = options[best]
        chosen.append(unknown[best])
        known.add(unknown[best])
    return tuple(chosen)


def remaining_entropy(entropies: np.ndarray, places: Sequence[int] | set[int], new: int) -> np.ndarray:
    """Return the entropies (Z,) of all slices once the slice `new` is known besides those at `places`. They fall as the
    `harmonic_distance` does, the thickness of a slice's uncertain layer; those beyond the next known slices stay."""
    before, after = (harmonic_distance(sorted(known), len(entropies)) for known in (places, {*places, new}))
    return entropies * np.divide(after, before, out=np.zeros_like(before), where=before > 0)
