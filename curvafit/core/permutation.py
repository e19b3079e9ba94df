"""Do two groups differ, does a series move? Tests by relabelling, corrections for many numbers, and an effect size.

If both groups are of one law, each choice of subjects for the second was as likely as the one that was made: a p-value
is the share of choices that differ at least as much, and p ≤ α comes up with probability α at most, however few the
subjects are. So it is with the orders of a series, if each was as likely.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy import special

#: Statistics that differ by less than this part of themselves are equal: sums taken in another order.
TIE = 1e-9
#: Choices whose statistics are taken at once.
BATCH = 500


def relabel(second: np.ndarray, most: int, seed: int = 0) -> tuple[np.ndarray, bool]:
    """Return choices of the second group, bool (m, n), the given one first, and whether they are all there are.

    `second` (n,) says who is in the second group. All choices of as many are returned where there are no more than
    `most`; else `most` random ones after the given one, from `seed`.
    """
    count, own = len(second), int(second.sum())
    exact = math.comb(count, own) <= most
    if exact:
        chosen = np.array(list(itertools.combinations(range(count), own)))
    else:
        random = np.random.default_rng(seed)
        chosen = np.stack([np.flatnonzero(second), *(random.permutation(count)[:own] for _ in range(most))])
    choices = np.zeros((len(chosen), count), dtype=bool)
    np.put_along_axis(choices, chosen, True, axis=1)
    return choices[np.argsort((choices != second).any(1), kind="stable")], exact


def reorder(count: int, most: int, seed: int = 0) -> tuple[np.ndarray, bool]:
    """Return orders of 0 to `count` - 1, int (m, count), the natural one first, and whether they are all there are.

    All are returned where there are no more than `most`; else `most` random ones after the first, from `seed`.
    """
    if math.factorial(count) <= most:
        return np.array(list(itertools.permutations(range(count)))), True
    random = np.random.default_rng(seed)
    return np.stack([np.arange(count), *(random.permutation(count) for _ in range(most))]), False


def share_beyond(statistics: np.ndarray) -> np.ndarray:
    """Return the share (…) of choices whose statistic (m, …) is at least that of the first: the p-value."""
    return (statistics >= statistics[0] * (1 - TIE)).mean(0)


def measure_energy(away: np.ndarray, choices: np.ndarray) -> np.ndarray:
    """Return the energy distance (m,) of the groups of each choice (m, n), from all distances (n, n).

    It is 2 E|X - Y| - E|X - X'| - E|Y - Y'| (Székely & Rizzo 2004): for Euclidean distances at least 0, and 0 only for
    equal laws.
    """
    inside = choices.astype(np.float64)
    k = inside.sum(1)
    rest = len(away) - k
    reach = inside @ away
    own = (reach * inside).sum(1)
    between = reach.sum(1) - own
    others = away.sum() - own - 2 * between
    return np.maximum(2 * between / (k * rest) - own / k**2 - others / rest**2, 0)


def correlate(values: np.ndarray, choices: np.ndarray) -> np.ndarray:
    """Return |r| (m, d), the correlation of each number (n, d) with being in the second group, by choice (m, n).

    Choices may be numbers too, such as times in other orders.

    For one number it orders choices as the difference of means and Student's t do; over many it is free of their
    scales. It is 0 where a number is the same for all, and NaN where one is not known.
    """
    labels = choices - choices.mean(1, keepdims=True)
    centred = values - values.mean(0)
    length = np.linalg.norm(centred, axis=0)
    alike = length <= TIE * np.abs(values).max(0) * math.sqrt(len(values))
    length = np.where(alike, np.inf, length)
    return np.abs(labels @ centred) / (np.linalg.norm(labels, axis=1)[:, None] * length)


def correct_by_most(values: np.ndarray, choices: np.ndarray) -> np.ndarray:
    """Return the family-wise p (d,) of numbers (n, d): the share of choices whose most |r| is at least its |r|.

    As Holm's it holds the chance of one or more false findings (Westfall & Young 1993), and loses nothing where numbers
    go together.
    """
    parts = np.array_split(choices, math.ceil(len(choices) / BATCH))
    most = np.sort(np.concatenate([correlate(values, part).max(1, initial=0) for part in parts]))
    own = correlate(values, choices[:1])[0]
    return 1 - np.searchsorted(most, own * (1 - TIE)) / len(most)


def correct_holm(p: np.ndarray) -> np.ndarray:
    """Return Holm's p-values (K,): the chance of one or more false findings among all K is held."""
    order = np.argsort(p)
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(raised, 1)
    return corrected


def measure_effect(first: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """Return Hedges' g of second over first, (n,) and (m,), and its 95 % interval; NaN where no number varies.

    The difference of means over the pooled deviation, without the bias of few (Hedges 1981). The interval is that of
    the noncentrality of Student's t, exact for normal numbers.
    """
    freedom = len(first) + len(second) - 2
    squares = sum(float(((part - part.mean()) ** 2).sum()) for part in (first, second))
    deviation = math.sqrt(squares / freedom)
    if not deviation > TIE * max(np.abs(first).max(), np.abs(second).max()):
        return math.nan, math.nan, math.nan
    scale = math.sqrt(1 / len(first) + 1 / len(second))
    t = (second.mean() - first.mean()) / (deviation * scale)
    halves = special.gammaln(freedom / 2) - special.gammaln((freedom - 1) / 2)
    unbiased = scale * math.exp(halves) / math.sqrt(freedom / 2)
    ends = (t, special.nctdtrinc(freedom, 0.975, t), special.nctdtrinc(freedom, 0.025, t))
    g, low, high = (unbiased * float(end) for end in ends)
    return g, low, high
