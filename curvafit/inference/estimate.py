"""What the descriptors of a scan say of its law: draws from a posterior, laws to grow, whether any is believable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.generation.flow import generate
from curvafit.generation.schedule import Schedule
from curvafit.geometry.descriptors import BLOCKS, Descriptors, descriptors
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit
from curvafit.inference.emulator import Optimum, misfits, optimum
from curvafit.inference.fit import Draws
from curvafit.inference.posterior import Posterior
from curvafit.inference.simulate import Effort, Search, Simulate, Simulations, simulate_draws
from curvafit.inference.table import (
    PARAMETERS,
    VIEWS,
    column_names,
    columns_of,
    law_of,
    mirror_parameters,
    parameters_of,
)
from curvafit.priors.grid import Grid
from curvafit.scan.measure import scan_descriptors
from curvafit.scan.prepare import HALF, Prepared
from curvafit.volumes.field import ScanError

#: Draws from the posterior, and those among which more are chosen to be grown.
DRAWS, POOL = 400, 2000
#: Edges, in working voxels, of the boxes in which draws are grown.
EDGES = (32, 64)
#: How draws come about, in words.
METHOD = "amortised: conditional flows given the descriptors"
#: Draws by which a row is summarised in `check`, and those of them from which the best parameters are looked for.
SUMMARY_DRAWS, STARTS = 64, 8
#: Least simulations to compare with.
FEWEST = 6
#: Simulations that the prior of a block's regression on the summaries counts as, and least deviation of a column, of
#: the mean of its block's.
RIDGE, FAINTEST = 3.0, 0.05
#: Squares added to what is unexplained, so that a perfect fit has a logarithm.
FLOOR = 0.1


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known of a scan's law before anything of its size is grown.

    Attributes
    ----------
    draws
        From the posterior.
    weak_directions
        Sentences on the directions in which the scan leaves the parameters open.
    misfit
        How far out the scan lies among what the model makes.
    candidates
        Laws to grow, the most trusted first.
    simulated
        By block of descriptors, the scan's numbers `(k,)` and those of the simulations `(n, k)`; None without any.
    """

    draws: Draws
    weak_directions: tuple[str, ...]
    misfit: Misfit
    candidates: tuple[Candidate, ...]
    simulated: dict[str, tuple[np.ndarray, np.ndarray]] | None = None

    @property
    def parts(self) -> dict[str, Any]:
        """Return the parts of a fit that it knows."""
        return {"draws": self.draws, "weak_directions": self.weak_directions, "misfit": self.misfit}


def estimate(
    prepared: Prepared,
    posterior: Posterior,
    *,
    seed: int = 0,
    fast: bool = False,
    effort: Effort = Effort(),  # noqa: B008
    progress: Progress = silent,
) -> Estimate | None:
    """Read the law of a scan from its descriptors: draw from the posterior, grow some, compare them with the scan.

    Parameters
    ----------
    fast
        Grow nothing: the scan is compared with what training left unexplained.
    effort
        How much is grown otherwise.
    progress
        Called with a sentence and the share done.

    Returns
    -------
    Estimate | None
        None where the descriptors cannot be measured.
    """
    progress("measuring descriptors", 0.0)
    turned = prepared.volume_fraction > HALF
    seen = prepared.inverted if turned else prepared
    if (measured := scan_descriptors(seen)) is None:
        return None
    row, view = measured[0].vector(), measured[1]
    progress("reading the posterior", 0.1)
    parameters = posterior.sample(row, view, DRAWS, seed)
    best = optimum(posterior.emulator, row, view, parameters[:STARTS])
    reading = _Reading(posterior, row, view, parameters, best, mirror_parameters if turned else np.asarray)
    if not fast:
        simulate = _simulator(seen, view, effort.schedule)
        grown = simulate_draws(
            parameters, simulate, effort.simulations, seed=seed, progress=sub_progress(progress, 0.15, 0.45)
        )
        if len(grown.parameters) >= FEWEST:
            pool = posterior.sample(row, view, POOL, seed)
            search = Search(posterior.emulator, view, row)
            likeliest, every = search.parameters(
                pool, grown, simulate, rounds=effort.rounds, seed=seed, progress=sub_progress(progress, 0.45, 1.0)
            )
            near = every.parameters[search.nearest(every)[0]]
            return _checked(reading, grown, {"refined": likeliest, "simulation": near})
    draws = reading.draws(parameters, METHOD)
    misfit = Misfit(tail_probability(posterior, view, best.misfit), {}, "by the best fit, nothing grown")
    return Estimate(draws, reading.weak, misfit, (reading.middle(draws), reading.optimum))


def refine_matches(prepared: Prepared, posterior: Posterior, matches: Sequence[Match]) -> Candidate | None:
    """Refine the parameters of the nearest matches until the emulated descriptors fit the scan's best.

    Levenberg and Marquardt's method, by optimistix, starts from each match, with the exact derivatives of the emulator.
    None where the descriptors of the scan cannot be measured.
    """
    turned = prepared.volume_fraction > HALF
    if (measured := scan_descriptors(prepared.inverted if turned else prepared)) is None:
        return None
    row, view = measured[0].vector(), measured[1]
    turn = mirror_parameters if turned else np.asarray
    starts = turn(np.stack([parameters_of(each.coefficients, each.mass) for each in matches]))
    best = optimum(posterior.emulator, row, view, starts)
    return _Reading(posterior, row, view, starts, best, turn).optimum


@dataclass(frozen=True, eq=False)
class _Reading:
    """What the posterior and the emulator read from a row of descriptors: draws and the best fit.

    Of a structure that fills most of the volume its background is read; `turn` gives the parameters of the structure.
    """

    posterior: Posterior
    row: np.ndarray
    view: str
    parameters: np.ndarray
    best: Optimum
    turn: Callable[[np.ndarray], np.ndarray]

    @property
    def weak(self) -> tuple[str, ...]:
        """Return the weak directions as sentences."""
        of = "" if self.turn is np.asarray else "Of the other phase: "
        return tuple(f"{of}{each}" for each in self.best.weak)

    def draws(self, parameters: np.ndarray, method: str) -> Draws:
        """Return draws of the structure's parameters."""
        return Draws.of(self.turn(parameters), self.view, method)

    def middle(self, draws: Draws) -> Candidate:
        """Return the middle of the draws with their deviations."""
        middle = Draws.of(self.parameters, self.view, "").middle(np.ptp(self.parameters, axis=0))
        return Candidate("posterior", *law_of(self.turn(middle)), draws.deviations)

    @property
    def optimum(self) -> Candidate:
        """Return the best fit of the descriptors with its own deviations."""
        rng = np.random.default_rng(0)
        near = rng.multivariate_normal(self.best.parameters, self.best.covariance, DRAWS, check_valid="ignore")
        low, high = self.posterior.box.T
        own = self.draws(np.clip(near, low, high), "").deviations
        return Candidate("optimum", *law_of(self.turn(self.best.parameters)), own)


def _checked(reading: _Reading, grown: Simulations, others: Mapping[str, np.ndarray]) -> Estimate:
    """Return what is known once draws were grown, and other parameters were chosen by what grew."""
    row = reading.row
    draws = reading.draws(reading.parameters, METHOD)
    misfit = check(reading.posterior, row, reading.view, grown.descriptors)
    refined, simulation = (Candidate(name, *law_of(reading.turn(each)), {}) for name, each in others.items())
    names = np.array(column_names())
    blocks = {name: (row[names == name], grown.descriptors[:, names == name]) for name in BLOCKS}
    return Estimate(draws, reading.weak, misfit, (refined, reading.middle(draws), simulation), blocks)


def simulation_grid(prepared: Prepared) -> Grid:
    """Return the periodic box in which draws are grown: the scan's main window, within `EDGES`."""
    z, y, x = (int(np.clip(edge.stop - edge.start, *EDGES)) for edge in prepared.windows[0])
    return Grid((z, y, x), prepared.grid.spacing, "periodic")


def _simulator(prepared: Prepared, view: str, schedule: Schedule | str) -> Simulate:
    """Return a function that grows a shape from parameters and measures its descriptors as the scan's were measured.

    Blur, noise and window are the scan's own.
    """
    grid = simulation_grid(prepared)
    # A window of something larger loses what its faces cut; a box that repeats loses nothing.
    apply_view = VIEWS["mask" if prepared.part(prepared.windows[0]).periodic else "crop"]

    def simulate(parameters: np.ndarray, seed: int) -> Descriptors | None:
        flow = generate(*law_of(parameters), grid, schedule=schedule, seed=seed, reject_early=True)
        if not flow.viability.viable:
            return None
        field = flow.field.numpy()
        try:
            if view == "field":
                return descriptors(field, grid)
            return descriptors(*apply_view(prepared.rescan(field > 0, seed), grid, np.random.default_rng(seed)))
        except (ScanError, NoSurface):
            return None

    return simulate


def tail_probability(posterior: Posterior, view: str, misfit: float) -> float:
    """Return the part of shapes that fit worse than a query, each by its best parameters from `STARTS` draws.

    Parameters
    ----------
    misfit
        What the query's best parameters leave unexplained (`curvafit.inference.emulator.Optimum`).
    """
    usual = posterior.misfits[view]
    return float((1 + (usual >= misfit).sum()) / (1 + len(usual)))


def check(posterior: Posterior, descriptors: np.ndarray, view: str, simulated: np.ndarray) -> Misfit:
    """Compare a row of descriptors `(351,)` with those of simulations of the posterior's draws `(n, 351)`.

    Probabilities of blocks are of what the posterior's mean given a row, by linear regression, does not tell of the
    block; they are cautious.

    Raises
    ------
    ValueError
        If there are fewer than `FEWEST` simulations.
    """
    if len(simulated) < FEWEST:
        raise ValueError(f"expected at least {FEWEST} simulations to compare with, got {len(simulated)}")
    rows = np.concatenate([np.atleast_2d(descriptors), simulated])
    draws = posterior.sample(rows, view, SUMMARY_DRAWS)
    left = np.log(misfits(posterior.emulator, rows, view, draws[:, :STARTS]) + FLOOR)
    summaries = posterior.standard(draws).mean(1)
    blocks = {name: _tail(_distances(columns_of(rows, [name]), summaries)) for name in BLOCKS}
    return Misfit(_tail(left), blocks, f"{len(simulated)} shapes grown from draws")


def _tail(values: np.ndarray) -> float:
    """Return the probability of the first value or more, if it is another of the rest, which are taken to be normal."""
    first, rest = values[0], values[1:]
    score = (first - rest.mean()) / (rest.std(ddof=1) * np.sqrt(1 + 1 / len(rest)) + 1e-9)
    return float(stats.t.sf(score, len(rest) - 1))


def _distances(rows: np.ndarray, summaries: np.ndarray) -> np.ndarray:
    """Return the leave-one-out residual of each row, regressed on its summary; the query, row 0, is never in the fit.

    It is the logarithm of the mean square over columns, in deviations of the other rows.
    """
    values = []
    for k in range(len(rows)):
        rest = np.delete(np.arange(1, len(rows)), k - 1) if k else np.arange(1, len(rows))
        mean, scale = summaries[rest].mean(0), summaries[rest].std(0) + 1e-9
        regressors = (summaries - mean) / scale
        away = rows - rows[rest].mean(0)
        X = regressors[rest]
        slope = np.linalg.solve(X.T @ X + RIDGE * np.eye(len(PARAMETERS)), X.T @ away[rest])
        left = away - regressors @ slope
        deviation = left[rest].std(0, ddof=1)
        deviation = np.maximum(deviation, FAINTEST * deviation.mean() + 1e-12)
        values.append(np.log(np.square(left[k] / deviation).mean() + 1e-12))
    return np.array(values)
