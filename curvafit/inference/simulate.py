"""Simulations: shapes grown from parameters and measured as a scan is, and a search for the likeliest parameters.

The emulator errs where few shapes have trained it. A Gaussian process of what it misses of simulations near the query
is added to it, and says which parameters to simulate next (Gutmann & Corander 2016).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from scipy import linalg

from curvafit.core.checks import check_int
from curvafit.core.runtime import Progress, silent
from curvafit.generation.schedule import LEARNED, Schedule
from curvafit.inference.emulator import Emulator
from curvafit.scan.measures import Reading

#: Rounds, simulations in a round, and most rounds at the end that simulate the likeliest parameters alone.
ROUNDS, BATCH, LAST = 7, 3, 4
#: New parameters are tried around the `NEAREST` simulations: `AROUND` at each width, in deviations of the prior.
NEAREST, AROUND, WIDTHS = 4, 300, (0.15, 0.4)
#: Tried for the Gaussian process: lengths in deviations of the prior; variances of the process and of its noise, in
#: those that the emulator states.
LENGTHS, VARIANCES, NOISES = (0.5, 1.0, 2.0, 4.0), (0.1, 0.3, 1.0, 3.0), (0.05, 0.1, 0.2, 0.4, 0.8)
#: Added to the deviance at parameters that grew nothing, and how far around, in deviations of the prior.
BARREN, REACH = 50.0, 0.3


@dataclass(frozen=True)
class Growth:
    """Which shapes are grown to refine, compare and test the laws that are read of a scan.

    Attributes
    ----------
    simulations, rounds
        How many draws of the posterior are grown, and then rounds of three shapes whose parameters the shapes before
        them suggest.
    twins
        How many shapes of the best law are grown.
    test
        Whether further shapes of the best law are grown to test whether it can have made the scan.
    schedule
        Steps of each shape.
    """

    simulations: int = 16
    rounds: int = ROUNDS
    twins: int = 3
    test: bool = True
    schedule: Schedule | str = LEARNED


class Simulations(NamedTuple):
    """The `n` simulations, of `count`, that grew: parameters `(n, 6)`, seeds `(n,)` and readings."""

    parameters: np.ndarray
    seeds: np.ndarray
    readings: tuple[Reading, ...]
    count: int

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return descriptors `(n, 351)`, views and amounts `(n,)`."""
        parts = zip(*(reading.columns for reading in self.readings), strict=True)
        return tuple(map(np.concatenate, parts))  # type: ignore[return-value]

    def add(self, parameters: np.ndarray, seeds: np.ndarray, readings: Sequence[Reading | None]) -> Simulations:
        """Return these and further ones, of which those without a reading did not grow."""
        grown = np.array([reading is not None for reading in readings])
        both = (np.concatenate([self.parameters, parameters[grown]]), np.concatenate([self.seeds, seeds[grown]]))
        return Simulations(*both, (*self.readings, *filter(None, readings)), self.count + len(parameters))


#: Grows a shape from parameters `(6,)` and a seed, and returns what is read of it, seen as the query was; None where
#: nothing grows.
Simulate = Callable[[np.ndarray, int], Reading | None]


def simulate_draws(
    draws: np.ndarray, simulate: Simulate, count: int, *, seed: int = 0, progress: Progress = silent
) -> Simulations:
    """Grow a shape from each of `count` of a posterior's draws `(n, 6)`; the k-th has the seed `seed` + k."""
    count = check_int(count, "a number of simulations", 1, len(draws))
    chosen = draws[np.random.default_rng(seed).choice(len(draws), count, replace=False)]
    readings = []
    for k, parameters in enumerate(chosen):
        readings.append(simulate(parameters, seed + k))
        progress(f"simulated {k + 1} of {count}", (k + 1) / count)
    return Simulations(chosen[:0], np.arange(0), (), 0).add(chosen, seed + np.arange(count), readings)


class Process(NamedTuple):
    """A Gaussian process of values `(n, k)` at places `(n, d)`, the same for each column.

    `factor` is the Cholesky factor of the covariance K + noise there, `coefficients` (K + noise)⁻¹ values.
    """

    places: np.ndarray
    factor: np.ndarray
    coefficients: np.ndarray
    length: float
    variance: float
    noise: float

    @classmethod
    def fit(cls, places: np.ndarray, values: np.ndarray) -> Process:
        """Return the likeliest process of mean 0 of values `(n, k)` at places `(n, d)`."""
        tried = []
        for length, variance, noise in itertools.product(LENGTHS, VARIANCES, NOISES):
            covariance = variance * _correlate(places, places, length) + noise * np.eye(len(places))
            factor = np.linalg.cholesky(covariance)
            process = cls(places, factor, linalg.cho_solve((factor, True), values), length, variance, noise)
            # twice the negative log likelihood, the mean over columns, up to a constant
            deviance = (values * process.coefficients).sum() / values.shape[1] + 2 * np.log(np.diag(factor)).sum()
            tried.append((float(deviance), process))
        return min(tried, key=itemgetter(0))[1]

    def __call__(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the means `(m, k)` and variances `(m,)`, with the noise, at places `(m, d)`."""
        near = self.variance * _correlate(places, self.places, self.length)
        explained = np.square(linalg.solve_triangular(self.factor, near.T, lower=True)).sum(0)
        return near @ self.coefficients, self.variance - explained + self.noise


@dataclass(frozen=True, eq=False)
class Search:
    """A search for the parameters whose shapes are read as a query was."""

    emulator: Emulator
    query: Reading

    def nearest(self, simulated: Simulations) -> np.ndarray:
        """Return the numbers of the simulations, those whose descriptors are nearest to the query's first."""
        deviation = self.emulator(simulated.parameters, *simulated.columns[1:]).deviation.mean(0)
        away = self.emulator.decorrelate(simulated.columns[0]) - self.emulator.decorrelate(self.query.columns[0])
        return np.square(away / deviation).sum(1).argsort(kind="stable")

    def run(
        self,
        draws: np.ndarray,
        simulated: Simulations,
        simulate: Simulate,
        *,
        rounds: int = ROUNDS,
        seed: int = 0,
        progress: Progress = silent,
    ) -> tuple[np.ndarray, Simulations]:
        """Return the parameters `(6,)` that are likeliest to grow the query's descriptors, and all simulations.

        Each round simulates the likeliest parameters so far, and others at random by their likelihood. The last rounds
        simulate the likeliest alone, until they grow a shape; if they never do, the nearest simulation is the answer.
        Parameters are chosen among a posterior's `draws` `(n, 6)` and near the best simulations so far.
        """
        rng, barren = np.random.default_rng(seed), draws[:0]
        for k in range(rounds + LAST):
            candidates, deviance = self._propose(draws, simulated, barren, rng)
            likelihood = np.exp(-0.5 * (deviance - deviance.min()) / np.sqrt(len(self.emulator.basis)))
            others = rng.choice(len(candidates), BATCH - 1 if k < rounds else 0, p=likelihood / likelihood.sum())
            chosen = candidates[[int(deviance.argmin()), *others]]
            seeds = seed + simulated.count + np.arange(len(chosen))
            readings = [simulate(each, int(start)) for each, start in zip(chosen, seeds, strict=True)]
            grown = np.array([reading is not None for reading in readings])
            barren = np.concatenate([barren, chosen[~grown]])
            simulated = simulated.add(chosen, seeds, readings)
            progress(f"refined by {simulated.count} simulations", min((k + 1) / (rounds + 1), 1.0))
            if k >= rounds and grown.all():
                return chosen[0], simulated
        return simulated.parameters[self.nearest(simulated)[0]], simulated

    def _propose(
        self, draws: np.ndarray, simulated: Simulations, barren: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return parameters to try `(n, 6)`, draws and others around the best simulations, and -2 log likelihood of
        each `(n,)`; near `barren` parameters, from which nothing grew, they cost more."""
        emulator = self.emulator
        best = simulated.parameters[self.nearest(simulated)[:NEAREST]]
        centres = np.repeat(best, AROUND * len(WIDTHS), 0)
        widths = np.resize(np.repeat(WIDTHS, AROUND), len(centres))[:, None]
        near = centres + widths * emulator.deviation * rng.standard_normal(centres.shape)
        candidates = np.concatenate([draws, np.clip(near, *emulator.box.T)])
        close = _correlate(emulator.standardise(candidates), emulator.standardise(barren), REACH)
        return candidates, self.deviance(candidates, simulated) + BARREN * close.sum(1)

    def deviance(self, candidates: np.ndarray, simulated: Simulations) -> np.ndarray:
        """Return twice the negative log likelihood of each candidate `(m,)`, up to a constant."""
        # A Gaussian process, fitted to the emulator's residuals at the simulations, is added to the emulator's mean.
        # Descriptors are compared in uncorrelated directions, in units of the emulator's mean deviation along each;
        # that is the same for all candidates, so its logarithm is left out.
        descriptors, *seen = simulated.columns
        row, *asked = self.query.columns
        emulator, emulated = self.emulator, self.emulator(simulated.parameters, *seen)
        basis, deviation = emulator.basis, emulated.deviation.mean(0)
        residuals = (emulator.decorrelate(descriptors) - emulated.mean @ basis.T) / deviation
        process = Process.fit(emulator.standardise(simulated.parameters), residuals)
        mean, variance = process(emulator.standardise(candidates))
        expected = emulator(candidates, *asked).mean @ basis.T / deviation + mean
        scan_residual = emulator.decorrelate(row) / deviation - expected
        return np.square(scan_residual).sum(1) / variance + scan_residual.shape[1] * np.log(variance)


def _correlate(first: np.ndarray, second: np.ndarray, length: float) -> np.ndarray:
    """Return the correlations `(m, n)` of a process at two sets of places."""
    away = np.square(first).sum(1)[:, None] + np.square(second).sum(1) - 2 * first @ second.T
    return np.exp(-0.5 * np.maximum(away, 0) / length**2)
