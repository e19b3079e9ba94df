"""Simulations: shapes grown from parameters and measured as a scan is, and a search for the likeliest parameters.

The emulator errs where few shapes have trained it. A Gaussian process, fitted to its errors on simulations near the
query, corrects it and says which parameters to simulate next (Gutmann & Corander 2016).
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
from curvafit.priors.kernels.threads import map_threads
from curvafit.scan.measures import Reading

#: Rounds, simulations in a round, and most rounds at the end that simulate the likeliest parameters alone.
ROUNDS, BATCH, LAST = 7, 3, 4
#: New parameters are tried around the `NEAREST` simulations: `AROUND` at each width, in deviations of the prior.
NEAREST, AROUND, WIDTHS = 4, 300, (0.15, 0.4)
#: Tried for the Gaussian process: lengths in deviations of the prior; variances of the process and of its noise, in
#: those that the emulator states.
LENGTHS, VARIANCES, NOISES = (0.5, 1.0, 2.0, 4.0), (0.1, 0.3, 1.0, 3.0), (0.05, 0.1, 0.2, 0.4, 0.8)
#: Penalty on the deviance at parameters that grew nothing, and its length scale in deviations of the prior.
BARREN, REACH = 50.0, 0.3


@dataclass(frozen=True)
class Growth:
    """Which shapes are grown to refine, compare and test the laws that are read of a scan; more test the best law.

    Attributes
    ----------
    simulations, rounds
        How many draws of the posterior are grown; and then how many rounds of three shapes, whose parameters are chosen
        by the shapes before.
    twins
        How many shapes of the best law are grown.
    schedule
        Steps of each shape.
    """

    simulations: int = 16
    rounds: int = ROUNDS
    twins: int = 3
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
        columns = zip(*(reading.columns for reading in self.readings), strict=True)
        return tuple(map(np.concatenate, columns))  # type: ignore[return-value]

    def add(self, parameters: np.ndarray, seeds: np.ndarray, readings: Sequence[Reading | None]) -> Simulations:
        """Return these simulations and further ones; a reading of None says that nothing grew."""
        grown = np.array([reading is not None for reading in readings])
        parameters = np.concatenate([self.parameters, parameters[grown]])
        seeds = np.concatenate([self.seeds, seeds[grown]])
        return Simulations(parameters, seeds, (*self.readings, *filter(None, readings)), self.count + len(grown))


#: Grows a shape from parameters `(6,)` and a seed, and reads it as the query was read; None where nothing grows.
Simulate = Callable[[np.ndarray, int], Reading | None]


def simulate_draws(
    draws: np.ndarray, simulate: Simulate, count: int, *, seed: int = 0, progress: Progress = silent
) -> Simulations:
    """Grow shapes from `count` of a posterior's draws `(n, 6)`, chosen at random; the k-th has the seed `seed` + k."""
    count = check_int(count, "a number of simulations", 1, len(draws))
    chosen = draws[np.random.default_rng(seed).choice(len(draws), count, replace=False)]
    seeds, readings = seed + np.arange(count), []
    for reading in map_threads(lambda k: simulate(chosen[k], int(seeds[k])), range(count)):
        readings.append(reading)
        progress(f"simulated {len(readings)} of {count}", len(readings) / count)
    return Simulations(chosen[:0], np.arange(0), (), 0).add(chosen, seeds, readings)


class Process(NamedTuple):
    """A Gaussian process fitted to values `(n, k)` at places `(n, d)`: all columns have the same covariance.

    `factor` is the Cholesky factor of the places' covariance K + noise, `coefficients` are (K + noise)⁻¹ values.
    """

    places: np.ndarray
    factor: np.ndarray
    coefficients: np.ndarray
    length: float
    variance: float
    noise: float

    @classmethod
    def fit(cls, places: np.ndarray, values: np.ndarray) -> Process:
        """Return the process of mean 0 that is likeliest for values `(n, k)` at places `(n, d)`."""
        fits = []
        for length, variance, noise in itertools.product(LENGTHS, VARIANCES, NOISES):
            covariance = variance * _correlate(places, places, length) + noise * np.eye(len(places))
            factor = np.linalg.cholesky(covariance)
            process = cls(places, factor, linalg.cho_solve((factor, True), values), length, variance, noise)
            # twice the negative log likelihood, the mean over columns, up to a constant
            deviance = (values * process.coefficients).sum() / values.shape[1] + 2 * np.log(np.diag(factor)).sum()
            fits.append((float(deviance), process))
        return min(fits, key=itemgetter(0))[1]

    def __call__(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the means `(m, k)` and variances `(m,)`, with the noise, at places `(m, d)`."""
        covariance = self.variance * _correlate(places, self.places, self.length)
        explained = np.square(linalg.solve_triangular(self.factor, covariance.T, lower=True)).sum(0)
        return covariance @ self.coefficients, self.variance - explained + self.noise


@dataclass(frozen=True, eq=False)
class Search:
    """A search for the parameters whose shapes have the descriptors of a query."""

    emulator: Emulator
    query: Reading

    def nearest(self, simulated: Simulations) -> np.ndarray:
        """Return the indices of the simulations, ordered by the distance of their descriptors from the query's."""
        deviation = self.emulator(simulated.parameters, *simulated.columns[1:]).deviation.mean(0)
        differences = self.emulator.decorrelate(simulated.columns[0]) - self.emulator.decorrelate(self.query.columns[0])
        return np.square(differences / deviation).sum(1).argsort(kind="stable")

    def run(
        self, draws: np.ndarray, simulated: Simulations, simulate: Simulate, *, rounds: int = ROUNDS, seed: int = 0,
        progress: Progress = silent,
    ) -> tuple[np.ndarray, Simulations]:  # fmt: skip
        """Return the parameters `(6,)` that are likeliest to grow the query's descriptors, and all simulations.

        Each round simulates the likeliest parameters so far, and others at random by their likelihood. The last rounds
        simulate the likeliest alone, until they grow a shape; if they never do, the nearest simulation is the answer.
        Parameters are chosen among a posterior's `draws` `(n, 6)` and near the best simulations so far.
        """
        rng, failed = np.random.default_rng(seed), draws[:0]
        for k in range(rounds + LAST):
            candidates, deviance = self._propose(draws, simulated, failed, rng)
            # A deviance over n directions varies by about √n: so scaled, it leaves others than the likeliest a chance.
            likelihood = np.exp(-0.5 * (deviance - deviance.min()) / np.sqrt(len(self.emulator.basis)))
            others = rng.choice(len(candidates), BATCH - 1 if k < rounds else 0, p=likelihood / likelihood.sum())
            chosen = candidates[[int(deviance.argmin()), *others]]
            seeds = seed + simulated.count + np.arange(len(chosen))
            readings = list(map_threads(lambda law: simulate(*law), zip(chosen, seeds.tolist(), strict=True)))
            grown = np.array([reading is not None for reading in readings])
            failed = np.concatenate([failed, chosen[~grown]])
            simulated = simulated.add(chosen, seeds, readings)
            progress(f"refined by {simulated.count} simulations", min((k + 1) / (rounds + 1), 1.0))
            if k >= rounds and grown.all():
                return chosen[0], simulated
        return simulated.parameters[self.nearest(simulated)[0]], simulated

    def _propose(
        self, draws: np.ndarray, simulated: Simulations, failed: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return parameters to try `(n, 6)`, draws and random ones around the best simulations, and their deviance
        `(n,)`, with a penalty near `failed` parameters, from which nothing grew."""
        emulator = self.emulator
        best = simulated.parameters[self.nearest(simulated)[:NEAREST]]
        centres = np.repeat(best, AROUND * len(WIDTHS), 0)
        widths = np.resize(np.repeat(WIDTHS, AROUND), len(centres))[:, None]
        around = centres + widths * emulator.deviation * rng.standard_normal(centres.shape)
        candidates = np.concatenate([draws, np.clip(around, *emulator.box.T)])
        closeness = _correlate(emulator.standardise(candidates), emulator.standardise(failed), REACH)
        return candidates, self.deviance(candidates, simulated) + BARREN * closeness.sum(1)

    def deviance(self, candidates: np.ndarray, simulated: Simulations) -> np.ndarray:
        """Return twice the negative log likelihood `(m,)` of candidate parameters `(m, 6)`, up to a constant."""
        # A Gaussian process, fitted to the emulator's residuals at the simulations, is added to the emulator's mean.
        # Descriptors are compared in uncorrelated directions, in units of the emulator's mean deviation along each;
        # that is the same for all candidates, so its logarithm is left out.
        descriptors, *conditions = simulated.columns
        query, *query_conditions = self.query.columns
        emulator, basis = self.emulator, self.emulator.basis
        emulated = emulator(simulated.parameters, *conditions)
        deviation = emulated.deviation.mean(0)
        residuals = (emulator.decorrelate(descriptors) - emulated.mean @ basis.T) / deviation
        process = Process.fit(emulator.standardise(simulated.parameters), residuals)
        mean, variance = process(emulator.standardise(candidates))
        expected = emulator(candidates, *query_conditions).mean @ basis.T / deviation + mean
        misfit = emulator.decorrelate(query) / deviation - expected
        return np.square(misfit).sum(1) / variance + misfit.shape[1] * np.log(variance)


def _correlate(first: np.ndarray, second: np.ndarray, length: float) -> np.ndarray:
    """Return the Gaussian correlations `(m, n)` of a process between places `(m, d)` and `(n, d)`."""
    squared_distances = np.square(first).sum(1)[:, None] + np.square(second).sum(1) - 2 * first @ second.T
    return np.exp(-0.5 * np.maximum(squared_distances, 0) / length**2)
