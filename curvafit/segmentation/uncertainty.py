"""Runs from other starts and under other laws, and what their agreement is worth where the truth is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from scipy.special import entr, expit, logit

from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.profile import profile_distance
from curvafit.scan.grids import centre_distance
from curvafit.segmentation.slices import Slices, harmonic_distance, plane_distances
from curvafit.segmentation.trials import Task, Trial

#: Default number of runs.
RUNS = 8
#: Distance from a surface, in voxels, within which probabilities are judged.
NEAR = 3
#: Greatest weight: where all is right it would grow without end.
STRONGEST = 20.0
#: Most voxels that the weights are fitted to.
MOST = 1_000_000
#: Bins of the calibration error.
BINS = 15

#: Interpolates between slices in a way: a level (Z, Y, X), positive inside.
Level = Callable[[Slices, str], np.ndarray]
#: Fills a volume between slices by a setting, from a level of its own: a phase field (Z, Y, X), and ε.
Flow = Callable[[Slices, Trial, np.ndarray, Progress], tuple[np.ndarray, float]]


@dataclass(frozen=True, eq=False)
class ProbabilityMap:
    """Probabilities of the inside.

    Attributes
    ----------
    values
        (Z, Y, X), float32: 0 or 1 on known slices.
    error
        The calibration error on the slices that the probabilities were fitted to, near the surface.
    weights
        Those of `fit_weights`.
    """

    values: np.ndarray
    error: float
    weights: tuple[float, ...]


def estimate_probability(
    task: Task[Slices],
    slices: Slices,
    setting: Trial,
    laws: Sequence[Coefficients | None],
    runs: int,
    *,
    level: Level,
    flow: Flow,
    progress: Progress = silent,
) -> ProbabilityMap:
    """Return the probability of the inside in each voxel between slices.

    A few runs are too sure of what they agree on. So the same runs are made on a task, where it is known what is inside
    how often, and three weights are fitted: of their votes, of the depth below their mean surface in units of a slice's
    `harmonic_distance`, and a constant.

    Parameters
    ----------
    setting
        The chosen one. Run number k starts from its interpolation with a smooth random displacement, of seed k, as
        large as the interpolation errs on the task.
    laws
        Of which the runs take one after another; None lowers no energy.
    """
    spread = _spread(task, level(task.given, setting.way))
    tried, target = (
        _Ensemble.of(each, level(each, setting.way), setting, laws, spread, count=runs, flow=flow, progress=half)
        for each, half in ((task.given, sub_progress(progress, 0, 0.5)), (slices, sub_progress(progress, 0.5, 1)))
    )
    rows = list(task.places)
    weights = fit_weights(tried.evidence(rows), task.truth.ravel())
    told = tried.probabilities(weights)
    close = near_surface(told > 0.5)[rows]
    error = calibration_error(told[rows][close], task.truth[close])
    return ProbabilityMap(target.probabilities(weights), error, tuple(map(float, weights)))


def near_surface(mask: np.ndarray) -> np.ndarray:
    """Return the voxels whose centres are within `NEAR` voxels of a mask's surface; none where there is no surface."""
    return np.abs(centre_distance(mask, (1, 1, 1), dtype=np.float64)) < NEAR


@dataclass(frozen=True, eq=False)
class _Ensemble:
    """What runs say: how many have a voxel inside, and the mean signed distance to their surfaces."""

    slices: Slices
    votes: np.ndarray
    distance: np.ndarray
    count: int

    @classmethod
    def of(
        cls,
        slices: Slices,
        level: np.ndarray,
        setting: Trial,
        laws: Sequence[Coefficients | None],
        spread: float,
        *,
        count: int,
        flow: Flow,
        progress: Progress,
    ) -> _Ensemble:
        votes, distance = np.zeros(level.shape, dtype=np.uint16), np.zeros(level.shape, dtype=np.float32)
        for seed in range(count):
            step = sub_progress(progress, seed / count, (seed + 1) / count)
            start = level + (spread * slices.harmonic_distance)[:, None, None].astype(np.float32) * _wave(slices, seed)
            u, ε = flow(slices, replace(setting, law=laws[seed % len(laws)]), start, step)
            votes += u > 0
            distance += profile_distance(torch.from_numpy(u), ε).numpy() / count
        return cls(slices, votes, distance, count)

    def evidence(self, rows: Sequence[int]) -> np.ndarray:
        """Return the evidence (N, 2) in the voxels of slices that are not known."""
        depth = self.distance[rows] / self.slices.harmonic_distance[rows, None, None]
        return vote_evidence(self.votes[rows].ravel(), self.count, depth.ravel())

    def probabilities(self, weights: np.ndarray) -> np.ndarray:
        values = np.empty(self.votes.shape, dtype=np.float32)
        for row, far in enumerate(self.slices.harmonic_distance):
            if far > 0:
                values[row] = probability(self.evidence([row]), weights).reshape(values.shape[1:])
        values[list(self.slices.places)] = self.slices.inside
        return values


def _spread(task: Task[Slices], level: np.ndarray) -> float:
    """Return how far an interpolation's distances are from a task's true ones, over the slices' reach: the median."""
    slices, rows = task.given, list(task.places)
    truth = plane_distances(task.truth, slices.spacing[1:], slices.gap * slices.spacing[0])
    ratio = np.abs(level[rows] - truth) / slices.harmonic_distance[rows, None, None]
    return float(np.median(ratio[np.abs(truth) < NEAR * min(slices.spacing[1:])]))


def _wave(slices: Slices, seed: int) -> np.ndarray:
    """Return a smooth random field (Z, Y, X) of deviation 1, as long in all directions as a quarter of the gap."""
    edges = np.array(slices.spacing)
    noise = np.random.default_rng(seed).standard_normal(slices.frame.shape, dtype=np.float32)
    mode = "wrap" if slices.periodic else "reflect"
    wave = ndimage.gaussian_filter(noise, slices.gap * edges[0] / edges / 4, mode=mode)
    return wave / wave.std()


def vote_evidence(votes: np.ndarray, runs: int, depth: np.ndarray) -> np.ndarray:
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


def fit_weights(evidence: np.ndarray, inside: np.ndarray) -> np.ndarray:
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


def suggest_slices(entropies: np.ndarray, places: Sequence[int], count: int, periodic: bool = False) -> tuple[int, ...]:
    """Return the slices to annotate next, the most telling first, each chosen as if those before it were known.

    There are fewer where no other slice would tell anything.

    Parameters
    ----------
    entropies
        The entropy of each slice, in nats, (Z,).
    places
        The numbers of the known slices.
    periodic
        Whether the last slice is followed by the first.
    """
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
    """Return the entropies (Z,) of the slices once a new one is known.

    The uncertain layer of a slice is as thick as its `harmonic_distance`: in that proportion the entropy falls. A new
    slice tells nothing about slices beyond other known ones.
    """
    before, after = (harmonic_distance(sorted(known), len(entropies), periodic) for known in (places, {*places, new}))
    return entropies * np.divide(after, before, out=np.zeros_like(before), where=before > 0)
