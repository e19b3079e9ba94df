"""The probability of the inside from what runs of a flow agree on, and how well such probabilities are calibrated."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.special import entr, expit, logit

__all__ = ["calibration_error", "entropy", "evidence", "fitted", "probability"]

#: Greatest weight: where all is right it would grow without end.
STRONGEST = 20.0
#: Most voxels that the weights are fitted to.
MOST = 1_000_000
#: Bins of the calibration error.
BINS = 15


def evidence(votes: np.ndarray, runs: int, depth: np.ndarray) -> np.ndarray:
    """Return two kinds of evidence for the inside, float64 (N, 2): log odds, and the depth below the surface.

    Parameters
    ----------
    votes
        How many of the runs have a voxel inside, (N,). The odds are those of votes + 1/2 to the others + 1/2.
    depth
        The runs' mean signed distance to the surface over the error that a distance of this voxel has, positive inside.
    """
    odds = logit((votes.astype(np.float64) + 0.5) / (runs + 1))
    return np.stack([odds, depth.astype(np.float64)], axis=-1)


def fitted(evidence: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the weights under which evidence (N, 2) makes what is inside (N,) most likely: one for each kind, from 0,
    and a constant, by which runs are too thick or too thin.
    """
    stride = -(-len(inside) // MOST)
    signed = np.where(inside[::stride, None], 1.0, -1.0) * _with_constant(evidence[::stride])

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = signed @ weights
        return float(np.logaddexp(0, -margin).mean()), -(expit(-margin) @ signed) / len(signed)

    bounds = [(0, STRONGEST), (0, STRONGEST), (-STRONGEST, STRONGEST)]
    return minimize(cost, np.array([1.0, 1.0, 0.0]), jac=True, method="L-BFGS-B", bounds=bounds).x


def probability(evidence: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the probability of the inside, float64 (N,)."""
    return expit(_with_constant(evidence) @ weights)


def calibration_error(probability: np.ndarray, inside: np.ndarray, bins: int = BINS) -> float:
    """Return the expected calibration error: how far shares inside are from what probabilities say, on average.

    Voxels are sorted into bins of equal width by their probability; the mean over voxels is taken of the difference,
    in a voxel's bin, between the share that is inside and the mean probability. 0 where there are no voxels.
    """
    where = np.minimum((probability * bins).astype(int), bins - 1)
    excess = np.bincount(where, inside - probability.astype(np.float64), minlength=bins)
    return float(np.abs(excess).sum() / max(len(where), 1))


def entropy(probability: np.ndarray) -> np.ndarray:
    """Return the entropy of each probability of two outcomes, in nats."""
    p = probability.astype(np.float64)
    return entr(p) + entr(1 - p)


def _with_constant(evidence: np.ndarray) -> np.ndarray:
    return np.concatenate([evidence, np.ones_like(evidence[:, :1])], axis=1)
