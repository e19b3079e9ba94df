"""Simulations: shapes grown from parameters and measured as a scan is, and a search for the likeliest parameters.

The emulator errs where few shapes have trained it. Simulations near a query tell how: a Gaussian process of what the
emulator misses is added to it, and tells which parameters to simulate next (Gutmann & Corander 2016).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg

from curvafit.core.checks import check_int
from curvafit.core.runtime import Progress, silent
from curvafit.generation.schedule import LEARNED, Schedule
from curvafit.geometry.descriptors import Descriptors
from curvafit.inference.emulator import Emulator
from curvafit.inference.table import to_row

#: Simulations in a round; and how often at most the likeliest is looked for that grows.
BATCH, LAST = 3, 4
#: Parameters are also chosen around so many of the nearest simulations, so many at each of these deviations, in those
#: of the prior.
NEAREST, AROUND, WIDTHS = 4, 300, (0.15, 0.4)
#: Of the process that are tried: length in deviations of the prior, and variances of it and of the noise in those that
#: the emulator states.
LENGTHS, VARIANCES, NOISES = (0.5, 1.0, 2.0, 4.0), (0.1, 0.3, 1.0, 3.0), (0.05, 0.1, 0.2, 0.4, 0.8)
#: Parameters that grew nothing are avoided by as much, as far around, in deviations of the prior.
BARREN, REACH = 50.0, 0.3


class Effort(NamedTuple):
    """How many shapes an inference grows, and by which steps.

    Attributes
    ----------
    simulations
        Draws of the posterior.
    rounds
        Rounds of three shapes whose parameters the shapes before them suggest.
    twins, regrown
        Shapes of the best law, and the most shapes that may be grown to find which law that is.
    schedule
        Steps of each shape.
    """

    simulations: int = 16
    rounds: int = 7
    twins: int = 3
    regrown: int = 6
    schedule: Schedule | str = LEARNED


class Simulations(NamedTuple):
    """Parameters `(n, 6)`, seeds `(n,)` and descriptors `(n, 351)` of those simulations, of `count`, that grew."""

    parameters: np.ndarray
    seeds: np.ndarray
    descriptors: np.ndarray
    count: int

    def joined(self, parameters: np.ndarray, seeds: np.ndarray, descriptors: np.ndarray, count: int) -> Simulations:
        """Return these simulations and others, of which there were `count`."""
        return Simulations(
            np.concatenate([self.parameters, parameters]),
            np.concatenate([self.seeds, seeds]),
            np.concatenate([self.descriptors, descriptors]),
            self.count + count,
        )


#: From parameters `(6,)` and a seed to the descriptors of what they grow, measured as the query is; None where nothing
#: grows.
Simulate = Callable[[np.ndarray, int], Descriptors | None]


def simulate_draws(
    draws: np.ndarray,
    simulate: Simulate,
    count: int,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Simulations:
    """Grow a shape from each of some of a posterior's draws `(n, 6)`, each with a seed of its own.

    Raises ValueError if the count is not from 1 to the number of draws.

    Parameters
    ----------
    count
        Number of draws that are simulated.
    seed
        The k-th simulation has the seed `seed` + k.
    """
    count = check_int(count, "a number of simulations", 1, len(draws))
    chosen = draws[np.random.default_rng(seed).choice(len(draws), count, replace=False)]
    rows = []
    for k, parameters in enumerate(chosen):
        rows.append(to_row(simulate(parameters, seed + k)))
        progress(f"simulated {k + 1} of {count}", (k + 1) / count)
    descriptors = np.array(rows)
    grown = np.isfinite(descriptors).all(1)
    return Simulations(chosen[grown], seed + np.flatnonzero(grown), descriptors[grown], count)


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
    def of(cls, places: np.ndarray, values: np.ndarray) -> Process:
        """Return the likeliest process of mean 0 of values `(n, k)` at places `(n, d)`."""
        tried = (
            cls._fitted(places, values, length, variance, noise)
            for length in LENGTHS
            for variance in VARIANCES
            for noise in NOISES
        )
        return min(tried, key=lambda process: process.deviance(values))

    @classmethod
    def _fitted(cls, places: np.ndarray, values: np.ndarray, length: float, variance: float, noise: float) -> Process:
        covariance = variance * _alike(places, places, length) + noise * np.eye(len(places))
        factor = np.linalg.cholesky(covariance)
        return cls(places, factor, linalg.cho_solve((factor, True), values), length, variance, noise)

    def deviance(self, values: np.ndarray) -> float:
        """Return twice the negative logarithm of the likelihood of the values, a column, but for a constant."""
        fit = float((values * self.coefficients).sum()) / values.shape[1]
        return fit + 2 * float(np.log(np.diag(self.factor)).sum())

    def __call__(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the means `(m, k)` and variances `(m,)`, with the noise, at places `(m, d)`."""
        near = self.variance * _alike(places, self.places, self.length)
        explained = np.square(linalg.solve_triangular(self.factor, near.T, lower=True)).sum(0)
        return near @ self.coefficients, self.variance - explained + self.noise


@dataclass(frozen=True, eq=False)
class Search:
    """A search for the parameters whose shapes have the descriptors of a query.

    Attributes
    ----------
    emulator, view
        What tells a view's descriptors of parameters.
    query
        `(351,)`: the query's descriptors.
    """

    emulator: Emulator
    view: str
    query: np.ndarray

    def nearest(self, simulated: Simulations) -> np.ndarray:
        """Return the numbers of simulations in the order of how near their descriptors are to the query's."""
        deviation = self.emulator(simulated.parameters, self.view).deviation.mean(0)
        away = self._components(simulated.descriptors) - self._components(self.query[None])
        return np.square(away / deviation).sum(1).argsort(kind="stable")

    def parameters(
        self,
        draws: np.ndarray,
        simulated: Simulations,
        simulate: Simulate,
        *,
        rounds: int = Effort().rounds,
        seed: int = 0,
        progress: Progress = silent,
    ) -> tuple[np.ndarray, Simulations]:
        """Find the parameters `(6,)` that are likeliest to grow the query's descriptors.

        Each round simulates the likeliest parameters so far, and others by their likelihood; at the end the likeliest
        alone, until they grow a shape. Where they do not, those of the nearest simulation are the answer.

        Parameters
        ----------
        draws
            `(n, 6)`: of a posterior; among these, and near the best simulations, parameters are chosen.
        simulated
            What was simulated already, such as some of the draws.

        Returns
        -------
        tuple
            The parameters, and all simulations.
        """
        rng, barren = np.random.default_rng(seed), draws[:0]
        for k in range(rounds + LAST):
            candidates, deviance = self._judged(draws, simulated, barren, rng)
            likelihood = np.exp(-0.5 * (deviance - deviance.min()) / np.sqrt(len(self.emulator.basis)))
            others = rng.choice(len(candidates), BATCH - 1 if k < rounds else 0, p=likelihood / likelihood.sum())
            chosen = candidates[[int(deviance.argmin()), *others]]
            seeds = seed + simulated.count + np.arange(len(chosen))
            rows = np.array([to_row(simulate(each, int(start))) for each, start in zip(chosen, seeds, strict=True)])
            grown = np.isfinite(rows).all(1)
            barren = np.concatenate([barren, chosen[~grown]])
            simulated = simulated.joined(chosen[grown], seeds[grown], rows[grown], len(chosen))
            progress(f"refined by {simulated.count} simulations", min((k + 1) / (rounds + 1), 1.0))
            if k >= rounds and grown.all():
                return chosen[0], simulated
        return simulated.parameters[self.nearest(simulated)[0]], simulated

    def _judged(
        self, draws: np.ndarray, simulated: Simulations, barren: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return parameters among which to choose `(n, 6)`, and twice the negative log likelihood of each `(n,)`."""
        emulator = self.emulator
        centres = np.repeat(simulated.parameters[self.nearest(simulated)[:NEAREST]], AROUND * len(WIDTHS), 0)
        widths = np.resize(np.repeat(WIDTHS, AROUND), len(centres))[:, None]
        near = centres + widths * emulator.deviation * rng.standard_normal(centres.shape)
        candidates = np.concatenate([draws, np.clip(near, *emulator.box.T)])
        avoided = BARREN * _alike(self._scaled(candidates), self._scaled(barren), REACH).sum(1)
        return candidates, self.deviance(candidates, simulated) + avoided

    def deviance(self, candidates: np.ndarray, simulated: Simulations) -> np.ndarray:
        """Return twice the negative log likelihood `(m,)` of the query, but for a constant, of each of some parameters,
        by the emulator and a process of what it misses of simulations."""
        emulated = self.emulator(simulated.parameters, self.view)
        basis, deviation = self.emulator.basis, emulated.deviation.mean(0)
        missed = (self._components(simulated.descriptors) - emulated.mean @ basis.T) / deviation
        mean, variance = Process.of(self._scaled(simulated.parameters), missed)(self._scaled(candidates))
        expected = self.emulator(candidates, self.view).mean @ basis.T / deviation + mean
        left = self._components(self.query[None]) / deviation - expected
        return np.square(left).sum(1) / variance + left.shape[1] * np.log(variance)

    def _components(self, descriptors: np.ndarray) -> np.ndarray:
        """Return rows of descriptors in the emulator's uncorrelated directions `(N, k)`."""
        return self.emulator.compression(descriptors) @ self.emulator.basis.T

    def _scaled(self, parameters: np.ndarray) -> np.ndarray:
        return (parameters - self.emulator.centre) / self.emulator.deviation


def _alike(first: np.ndarray, second: np.ndarray, length: float) -> np.ndarray:
    """Return the correlations `(m, n)` of a process at two sets of places."""
    away = np.square(first).sum(1)[:, None] + np.square(second).sum(1) - 2 * first @ second.T
    return np.exp(-0.5 * np.maximum(away, 0) / length**2)
