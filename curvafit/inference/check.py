"""Whether a posterior's parameters make a query's descriptors at all: tail probabilities with known false alarms.

What is compared is what the emulator's best parameters leave unexplained of a row of descriptors. Without a simulation
it is compared with what they leave of shapes that the emulator did not learn from. With simulations from the
posterior's draws, with what they leave of these: the query is then one row more among its like, whatever its window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from curvafit.geometry.descriptors import BLOCKS
from curvafit.inference.compression import columns_of
from curvafit.inference.emulator import misfits
from curvafit.inference.posterior import Posterior
from curvafit.inference.table import PARAMETERS, column_names

#: Draws by which a row is summarised, and those of them from which the best parameters are looked for.
DRAWS, STARTS = 64, 8
#: Levels of a block's band.
LEVELS = (0.05, 0.5, 0.95)
#: Least simulations to compare with.
FEWEST = 6
#: Simulations that the prior of a block's regression on the summaries counts as, and least deviation of a column, of
#: the mean of its block's.
RIDGE, FAINTEST = 3.0, 0.05
#: Squares added to what is unexplained, so that a perfect fit has a logarithm.
FLOOR = 0.1


class BlockCheck(NamedTuple):
    """Of a block of descriptors: tail probability of the query among simulations, and their quantiles at `LEVELS`,
    `(3, c)`."""

    p: float
    band: np.ndarray


class Check(NamedTuple):
    """Tail probability of a query's descriptors among simulations, for all together and for each block, and how many
    simulations there were."""

    p: float
    blocks: dict[str, BlockCheck]
    count: int


def amortised_p(posterior: Posterior, view: str, misfit: float) -> float:
    """Return the part of shapes that fit worse than a query, each by its best parameters from `STARTS` draws.

    Of 801 masks left out in thirds, 5.4 % are below .05; of level cuts of Gaussian random fields with a shape's volume
    and two-point function 20 of 20, of cuts with a Gaussian two-point function, nearly shapes of the model, 1 of 8.

    Parameters
    ----------
    misfit
        What the query's best parameters leave unexplained (`curvafit.inference.emulator.Optimum`).
    """
    usual = posterior.misfits[view]
    return float((1 + (usual >= misfit).sum()) / (1 + len(usual)))


def check(posterior: Posterior, descriptors: np.ndarray, view: str, simulated: np.ndarray) -> Check:
    """Compare a row of descriptors `(351,)` with those of simulations of the posterior's draws `(n, 351)`.

    Probabilities of blocks are of what the posterior's mean given a row, by linear regression, does not tell of the
    block. They are cautious: of 180 blocks of 20 masks of the model's own, 1 % are below .05.

    Raises
    ------
    ValueError
        If there are fewer than `FEWEST` simulations.
    """
    if len(simulated) < FEWEST:
        raise ValueError(f"expected at least {FEWEST} simulations to compare with, got {len(simulated)}")
    rows = np.concatenate([np.atleast_2d(descriptors), simulated])
    draws = posterior.sample(rows, view, DRAWS)
    left = np.log(misfits(posterior.emulator, rows, view, draws[:, :STARTS]) + FLOOR)
    summaries, names = posterior.standard(draws).mean(1), np.array(column_names())
    blocks = {}
    for name in BLOCKS:
        band = np.quantile(simulated[:, names == name], LEVELS, axis=0)
        blocks[name] = BlockCheck(_tail(_distances(columns_of(rows, [name]), summaries)), band)
    return Check(_tail(left), blocks, len(simulated))


def _tail(values: np.ndarray) -> float:
    """Return the probability of the first value or more, if it is another of the rest, which are taken to be normal."""
    first, rest = values[0], values[1:]
    score = (first - rest.mean()) / (rest.std(ddof=1) * np.sqrt(1 + 1 / len(rest)) + 1e-9)
    return float(stats.t.sf(score, len(rest) - 1))


def _distances(rows: np.ndarray, summaries: np.ndarray) -> np.ndarray:
    """Return how far each row lies from what a regression of the others, but for the first, makes of its summary:
    logarithms of mean squares of columns, in deviations of the others."""
    values = []
    for k in range(len(rows)):
        rest = np.delete(np.arange(1, len(rows)), k - 1) if k else np.arange(1, len(rows))
        mean, scale = summaries[rest].mean(0), summaries[rest].std(0) + 1e-9
        told = (summaries - mean) / scale
        away = rows - rows[rest].mean(0)
        slope = np.linalg.solve(told[rest].T @ told[rest] + RIDGE * np.eye(len(PARAMETERS)), told[rest].T @ away[rest])
        left = away - told @ slope
        deviation = left[rest].std(0, ddof=1)
        deviation = np.maximum(deviation, FAINTEST * deviation.mean() + 1e-12)
        values.append(np.log(np.square(left[k] / deviation).mean() + 1e-12))
    return np.array(values)
