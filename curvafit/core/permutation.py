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

#: Relative difference up to which statistics count as equal: the same sum in another order is rounded otherwise.
TIE = 1e-9
#: The most arrangements, and the most numbers, that are in memory at once.
BATCH, ROOM = 500, 2**24


# ---- arrangements ----------------------------------------------------------------------------------------------------


def relabel(labels: np.ndarray, most: int, seed: int = 0, blocks: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
    """Return arrangements (m, n) of labels (n,), the given one first, and whether they are all that exist.

    With `blocks` (n,), labels are exchanged within a block only. All distinct arrangements are returned where there
    are no more than `most`; else `most` random ones after the given one, from `seed`.
    """
    blocks = np.zeros(len(labels), dtype=int) if blocks is None else blocks
    members = [np.flatnonzero(blocks == block) for block in np.unique(blocks)]
    if math.prod(_count_arrangements(labels[indices]) for indices in members) <= most:
        orders = [_list_orders(labels[indices]) for indices in members]
        # All combinations of one order of each block: a column has the number of the order for every block.
        combinations = np.indices([len(order) for order in orders]).reshape(len(orders), -1)
        arranged = np.empty((combinations.shape[1], len(labels)), dtype=labels.dtype)
        for indices, order, numbers in zip(members, orders, combinations, strict=True):
            arranged[:, indices] = order[numbers]
        return arranged[np.argsort((arranged != labels).any(1), kind="stable")], True  # the given one first
    random = np.random.default_rng(seed)
    arranged = np.repeat(labels[None], most + 1, axis=0)
    for row, indices in itertools.product(arranged[1:], members):
        row[random.permutation(indices)] = np.sort(labels[indices])[::-1]  # sorted: their given order must not matter
    return arranged, False


def _count_arrangements(labels: np.ndarray) -> int:
    """Return the number of distinct orders of labels."""
    repeated = math.prod(math.factorial(count) for count in Counter(labels.tolist()).values())
    return math.factorial(len(labels)) // repeated


def _list_orders(labels: np.ndarray) -> np.ndarray:
    """Return the distinct orders (m, n) of labels (n,): the positions of the lowest, times the orders of the others."""
    lowest, positions = labels.min(), np.arange(len(labels))
    if (labels == lowest).all():
        return labels[None]
    others = _list_orders(labels[labels != lowest])
    choices = list(itertools.combinations(positions, len(labels) - others.shape[1]))
    arranged = np.full((len(choices), len(others), len(labels)), lowest)
    for rows, choice in zip(arranged, choices, strict=True):
        rows[:, np.delete(positions, choice)] = others
    return arranged.reshape(-1, len(labels))


def share_beyond(statistics: np.ndarray) -> np.ndarray:
    """Return the p-value (…) of statistics (m, …): the share of arrangements whose statistic is at least the first."""
    return (statistics >= statistics[0] * (1 - TIE)).mean(0)


def center(values: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return values (n, …) minus the mean of their block, or of all; exactly 0 where they vary by rounding only."""
    if blocks is None:
        centred = values - values.mean(0)
    else:
        is_same_block = (blocks[:, None] == blocks).astype(np.float64)
        centred = values - np.tensordot(is_same_block / is_same_block.sum(1, keepdims=True), values, 1)
    constant = np.linalg.norm(centred, axis=0) <= TIE * np.abs(values).max(0) * math.sqrt(len(values))
    return np.where(constant, 0.0, centred)


# ---- statistics ------------------------------------------------------------------------------------------------------


def measure_energy(away: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the energy distance (m,) of the groups of each arrangement (m, n), from all distances (n, n).

    Of two groups it is 2 E|X - Y| - E|X - X'| - E|Y - Y'| (Székely & Rizzo 2004); of more the mean of that over pairs
    of groups, weighted by the numbers of pairs of subjects: the dispersion between groups of Rizzo & Székely (2010).
    For Euclidean distances it is at least 0, and 0 only for equal laws.
    """
    centred = _center_both(away, blocks)
    within = np.zeros(len(arranged))  # centred distances sum to 0: what lies between groups is minus what lies within
    groups, sizes = np.unique(arranged[0], return_counts=True)
    for group, size in zip(groups, sizes, strict=True):
        is_member = (arranged == group).astype(np.float64)
        within += ((is_member @ centred) * is_member).sum(1) / size
    return np.maximum(-within * 2 * len(away) / (len(away) ** 2 - (sizes**2).sum()), 0)


def measure_dependence(away: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the distance correlation (m,), 0 to 1, of distances (n, n) with the labels of each arrangement (m, n).

    Labels are numbers, whose distances are their differences (Székely, Rizzo & Bakirov 2007). It is 0 where they are
    independent of the subjects' distances.
    """
    centred = _center_both(away, blocks)
    label_distances = _center_both(np.abs(np.subtract.outer(arranged[0], arranged[0])), blocks)
    norm = np.linalg.norm(centred) * np.linalg.norm(label_distances)  # the same for all arrangements
    if norm == 0:
        return np.zeros(len(arranged))
    products = [  # it is enough that one factor is centred
        np.abs(batch[:, :, None] - batch[:, None]).reshape(len(batch), -1) @ centred.ravel()
        for batch in np.array_split(arranged, math.ceil(len(arranged) * len(away) ** 2 / ROOM))
    ]
    return np.sqrt(np.maximum(np.concatenate(products) / norm, 0))


def _center_both(away: np.ndarray, blocks: np.ndarray | None) -> np.ndarray:
    """Return distances (n, n) centred along rows and columns."""
    return center(center(away, blocks).T, blocks)


def correlate(values: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return the correlation (m, d), 0 to 1, of each column of values (n, d) with each arrangement (m, n) of labels.

    This is |r| where labels are numbers or name two groups; with more groups it is the correlation ratio η, the root of
    the share of the variance that lies between groups. In one column both order arrangements as Student's t and
    Fisher's F do; they do not depend on a column's scale. 0 where a column is constant, NaN where it has a NaN.
    """
    centred = center(values, blocks)
    norm = np.linalg.norm(centred, axis=0)
    norm = np.where(norm == 0, np.inf, norm)
    groups, sizes = np.unique(arranged[0], return_counts=True)
    if np.issubdtype(arranged.dtype, np.floating) or len(groups) <= 2:
        labels = center(arranged.T.astype(np.float64), blocks).T
        return np.abs(labels @ centred) / (np.linalg.norm(labels, axis=1)[:, None] * norm)
    sums = [np.square((arranged == g).astype(np.float64) @ centred) / n for g, n in zip(groups, sizes, strict=True)]
    return np.sqrt(np.sum(sums, axis=0)) / norm


def correct_by_most(values: np.ndarray, arranged: np.ndarray, blocks: np.ndarray | None = None) -> np.ndarray:
    """Return family-wise p-values (d,) of columns of values (n, d), whose labels the first arrangement (m, n) has.

    A p-value is the share of arrangements in which the largest correlation of any column with the labels reaches the
    column's own. As Holm's correction this bounds the chance of any false finding (Westfall & Young 1993), but loses
    no power where columns are correlated.
    """
    batches = np.array_split(arranged, math.ceil(len(arranged) / BATCH))
    largest = np.sort(np.concatenate([correlate(values, batch, blocks).max(1, initial=0) for batch in batches]))
    observed = correlate(values, arranged[:1], blocks)[0]
    return 1 - np.searchsorted(largest, observed * (1 - TIE)) / len(largest)


# ---- effects, with 95 % intervals for normal numbers -----------------------------------------------------------------


def measure_effect(first: np.ndarray, second: np.ndarray, paired: bool = False) -> tuple[float, float, float]:
    """Return Hedges' g of samples (n,) and (m,), positive where the second is larger, and its interval's ends.

    The difference of means over the pooled deviation, or of `paired` values over the deviation of their differences,
    corrected for the bias of small samples (Hedges 1981). The interval is that of the noncentrality of Student's t. All
    are NaN where values do not vary, or of two pairs.
    """
    samples = [second - first] if paired else [first, second]
    freedom = sum(map(len, samples)) - len(samples)
    squares = sum(float(((sample - sample.mean()) ** 2).sum()) for sample in samples)
    deviation = math.sqrt(squares / freedom)
    if freedom < 2 or not deviation > TIE * max(np.abs(first).max(), np.abs(second).max()):
        return math.nan, math.nan, math.nan
    scale = math.sqrt(sum(1 / len(sample) for sample in samples))
    t = (second.mean() - first.mean()) / (deviation * scale)
    log_ratio = special.gammaln(freedom / 2) - special.gammaln((freedom - 1) / 2)
    unbiased = scale * math.exp(log_ratio) / math.sqrt(freedom / 2)  # of t to g, with Hedges' correction J
    ends = (t, special.nctdtrinc(freedom, 0.975, t), special.nctdtrinc(freedom, 0.025, t))
    g, low, high = (unbiased * float(end) for end in ends)
    return g, low, high


def measure_slope(
    values: np.ndarray, numbers: np.ndarray, blocks: np.ndarray | None = None
) -> tuple[float, tuple[float, float, float]]:
    """Return the slope of values (n,) over numbers (n,), within blocks, and (r, low, high) by Fisher's z."""
    y, x = center(values, blocks), center(numbers, blocks)
    slope = float(x @ y / (x @ x))
    freedom = len(y) - (1 if blocks is None else len(np.unique(blocks))) - 2  # n - 3 for a single block
    if not y.any() or np.isnan(y).any():
        return slope, (math.nan, math.nan, math.nan)
    r = float(np.clip(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)), -1 + 1e-15, 1 - 1e-15))
    half_width = float(special.ndtri(0.975)) / math.sqrt(freedom) if freedom > 0 else math.nan
    return slope, (r, math.tanh(math.atanh(r) - half_width), math.tanh(math.atanh(r) + half_width))
