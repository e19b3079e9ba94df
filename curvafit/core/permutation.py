"""Do groups differ, does a number matter? Tests by relabelling, corrections for many numbers, and effect sizes.

If what is measured has nothing to do with the labels, each arrangement of them was as likely as the one that was made:
a p-value is the share of arrangements whose statistic is at least as large, and p ≤ α comes up with probability α at
most, however few the subjects are. Where subjects come in blocks (before and after in one animal), labels are
exchanged within blocks only, and what differs between blocks is taken away first.

Labels are integers or booleans, which name groups, or floating-point numbers, such as times or doses.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
from scipy import special

#: Statistics that differ by less than this part of themselves are equal: sums taken in another order.
TIE = 1e-9
#: Arrangements whose statistics are taken at once, and the most numbers that they may have.
BATCH, ROOM = 500, 2**24


# ---- arrangements ----------------------------------------------------------------------------------------------------


def relabel(labels: np.ndarray, most: int, seed: int = 0, blocks: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
    """Return arrangements (m, n) of labels (n,), the given one first, and whether they are all there are.

    With `blocks` (n,), labels are exchanged within a block only. All distinct arrangements are returned where there
    are no more than `most`; else `most` random ones after the given one, from `seed`.
    """
    blocks = np.zeros(len(labels), dtype=int) if blocks is None else blocks
    members = [np.flatnonzero(blocks == block) for block in np.unique(blocks)]
    if math.prod(_count_arrangements(labels[member]) for member in members) <= most:
        orders = [_arrange(labels[member]) for member in members]
        picks = np.indices([len(order) for order in orders]).reshape(len(orders), -1)
        arranged = np.empty((picks.shape[1], len(labels)), dtype=labels.dtype)
        for member, order, rows in zip(members, orders, picks, strict=True):
            arranged[:, member] = order[rows]
        return arranged[np.argsort((arranged != labels).any(1), kind="stable")], True
    random = np.random.default_rng(seed)
    arranged = np.repeat(labels[None], most + 1, axis=0)
    for row, member in itertools.product(arranged[1:], members):
        row[random.permutation(member)] = np.sort(labels[member])[::-1]
    return arranged, False


def _count_arrangements(labels: np.ndarray) -> int:
    """Return the number of distinct orders of labels."""
    repeated = math.prod(math.factorial(count) for count in Counter(labels.tolist()).values())
    return math.factorial(len(labels)) // repeated


def _arrange(labels: np.ndarray) -> np.ndarray:
    """Return the distinct orders (m, n) of labels (n,)."""
    first, places = labels.min(), np.arange(len(labels))
    if (labels == first).all():
        return labels[None]
    others = _arrange(labels[labels != first])
    chosen = list(itertools.combinations(places, len(labels) - others.shape[1]))
    arranged = np.full((len(chosen), len(others), len(labels)), first)
    for rows, taken in zip(arranged, chosen, strict=True):
        rows[:, np.delete(places, taken)] = others
    return arranged.reshape(-1, len(labels))


def share_beyond(statistics: np.ndarray) -> np.ndarray:
    """Return the share (…) of arrangements whose statistic (m, …) is at least that of the first: the p-value."""
    return (statistics >= statistics[0] * (1 - TIE)).mean(0)


def center(values: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return values (n, …) less the mean of each block, or of all; 0 where they are the same for all of them."""
    if blocks is None:
        centred = values - values.mean(0)
    else:
        within = (blocks[:, None] == blocks).astype(np.float64)
        centred = values - np.tensordot(within / within.sum(1, keepdims=True), values, 1)
    alike = np.linalg.norm(centred, axis=0) <= TIE * np.abs(values).max(0) * math.sqrt(len(values))
    return np.where(alike, 0.0, centred)


# ---- statistics ------------------------------------------------------------------------------------------------------


def measure_energy(away: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the energy distance (m,) of the groups of each arrangement (m, n), from all distances (n, n).

    Of two groups it is 2 E|X - Y| - E|X - X'| - E|Y - Y'| (Székely & Rizzo 2004); of more the mean of that over pairs
    of groups, weighted by the numbers of pairs of subjects: the dispersion between groups of Rizzo & Székely (2010).
    For Euclidean distances it is at least 0, and 0 only for equal laws.
    """
    centred = _center_both(away, blocks)
    within = np.zeros(len(arranged))
    groups, sizes = np.unique(arranged[0], return_counts=True)
    for group, size in zip(groups, sizes, strict=True):
        inside = (arranged == group).astype(np.float64)
        within += ((inside @ centred) * inside).sum(1) / size
    return np.maximum(-within * 2 * len(away) / (len(away) ** 2 - (sizes**2).sum()), 0)


def measure_dependence(away: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the distance correlation (m,) of subjects with the numbers of each arrangement (m, n).

    From the subjects' distances (n, n) and the differences of their numbers (Székely, Rizzo & Bakirov 2007): 0 where
    they are independent, at most 1.
    """
    centred = _center_both(away, blocks)
    own = _center_both(np.abs(np.subtract.outer(arranged[0], arranged[0])), blocks)
    size = np.linalg.norm(centred) * np.linalg.norm(own)
    if size == 0:
        return np.zeros(len(arranged))
    products = [
        np.abs(part[:, :, None] - part[:, None]).reshape(len(part), -1) @ centred.ravel()
        for part in np.array_split(arranged, math.ceil(len(arranged) * len(away) ** 2 / ROOM))
    ]
    return np.sqrt(np.maximum(np.concatenate(products) / size, 0))


def _center_both(away: np.ndarray, blocks: np.ndarray | None) -> np.ndarray:
    """Return distances (n, n) centred along rows and columns."""
    return center(center(away, blocks).T, blocks)


def correlate(values: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the correlation (m, d) of each number (n, d) with the labels of each arrangement (m, n), at least 0.

    |r| with the labels where they are numbers or name two groups; of more groups the root of the part of the variance
    that lies between them (the correlation ratio η). For one number they order arrangements as Student's t and Fisher's
    F do; over many they are free of their scales. 0 where a number is the same for all, NaN where one is not known.
    """
    centred = center(values, blocks)
    length = np.linalg.norm(centred, axis=0)
    length = np.where(length == 0, np.inf, length)
    groups, sizes = np.unique(arranged[0], return_counts=True)
    if np.issubdtype(arranged.dtype, np.floating) or len(groups) <= 2:
        labels = center(arranged.T.astype(np.float64), blocks).T
        return np.abs(labels @ centred) / (np.linalg.norm(labels, axis=1)[:, None] * length)
    sums = [np.square((arranged == g).astype(np.float64) @ centred) / n for g, n in zip(groups, sizes, strict=True)]
    return np.sqrt(np.sum(sums, axis=0)) / length


def correct_by_most(values: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the family-wise p (d,) of numbers (n, d): the share of arrangements whose most is at least its own.

    What is compared is their correlation with the labels. As Holm's correction it holds the chance of one or more false
    findings (Westfall & Young 1993), and loses nothing where numbers go together.
    """
    parts = np.array_split(arranged, math.ceil(len(arranged) / BATCH))
    most = np.sort(np.concatenate([correlate(values, part, blocks).max(1, initial=0) for part in parts]))
    own = correlate(values, arranged[:1], blocks)[0]
    return 1 - np.searchsorted(most, own * (1 - TIE)) / len(most)


def correct_holm(p: np.ndarray) -> np.ndarray:
    """Return Holm's p-values (K,): the chance of one or more false findings among all K is held."""
    order = np.argsort(p)
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(raised, 1)
    return corrected


# ---- effects, with 95 % intervals for normal numbers -----------------------------------------------------------------


def measure_effect(first: np.ndarray, second: np.ndarray, paired: bool = False) -> tuple[float, float, float]:
    """Return Hedges' g of second over first, (n,) and (m,), and its interval; NaN where no number varies.

    The difference of means over the pooled deviation, or of `paired` numbers over the deviation of their differences,
    without the bias of few (Hedges 1981); NaN of two pairs. The interval is that of the noncentrality of Student's t.
    """
    parts = [second - first] if paired else [first, second]
    freedom = sum(map(len, parts)) - len(parts)
    squares = sum(float(((part - part.mean()) ** 2).sum()) for part in parts)
    deviation = math.sqrt(squares / freedom)
    if freedom < 2 or not deviation > TIE * max(np.abs(first).max(), np.abs(second).max()):
        return math.nan, math.nan, math.nan
    scale = math.sqrt(sum(1 / len(part) for part in parts))
    t = (second.mean() - first.mean()) / (deviation * scale)
    halves = special.gammaln(freedom / 2) - special.gammaln((freedom - 1) / 2)
    unbiased = scale * math.exp(halves) / math.sqrt(freedom / 2)
    ends = (t, special.nctdtrinc(freedom, 0.975, t), special.nctdtrinc(freedom, 0.025, t))
    g, low, high = (unbiased * float(end) for end in ends)
    return g, low, high


def measure_slope(
    values: np.ndarray, numbers: np.ndarray, blocks: np.ndarray | None = None
) -> tuple[float, tuple[float, float, float]]:
    """Return the slope of values (n,) over numbers (n,), within blocks, and r with its interval by Fisher's z."""
    y, x = center(values, blocks), center(numbers, blocks)
    slope = float(x @ y / (x @ x))
    freedom = len(y) - (1 if blocks is None else len(np.unique(blocks))) - 2
    if not y.any() or np.isnan(y).any():
        return slope, (math.nan, math.nan, math.nan)
    r = float(np.clip(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)), -1 + 1e-15, 1 - 1e-15))
    reach = float(special.ndtri(0.975)) / math.sqrt(freedom) if freedom > 0 else math.nan
    return slope, (r, math.tanh(math.atanh(r) - reach), math.tanh(math.atanh(r) + reach))
