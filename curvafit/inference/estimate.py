"""What the descriptors of a scan say of its law: draws from a posterior, laws to grow, whether any is believable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from curvafit.core.runtime import Progress, sub_progress
from curvafit.generation.flow import generate
from curvafit.generation.schedule import Schedule
from curvafit.geometry.descriptors import BLOCKS, descriptors
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit
from curvafit.inference.emulator import best_parameters, describe_weak_directions, misfits
from curvafit.inference.fit import COLUMNS, Fit, to_columns
from curvafit.inference.posterior import Posterior
from curvafit.inference.simulate import Search, Simulate, simulate_draws
from curvafit.inference.table import (
    PARAMETERS,
    VIEWS,
    column_names,
    columns_of,
    law_of,
    mirror_parameters,
    parameters_of,
    to_row,
)
from curvafit.priors.grid import Grid
from curvafit.scan.measure import scan_descriptors
from curvafit.scan.prepare import HALF, Prepared
from curvafit.volumes.field import ScanError

#: Draws from the posterior, and those among which more are chosen to be grown.
DRAWS, POOL = 400, 2000
#: Edges, in working voxels, of the boxes in which draws are grown.
EDGES = (32, 64)
#: Draws by which a row is summarised in `check`, and those of them from which the best parameters are looked for.
SUMMARY_DRAWS, STARTS = 64, 8
#: Least simulations to compare with.
FEWEST = 6
#: Simulations that the prior of a block's regression on the summaries counts as, and least deviation of a column, of
#: the mean of its block's.
RIDGE, FAINTEST = 3.0, 0.05
#: Squares added to what is unexplained, so that a perfect fit has a logarithm.
FLOOR = 0.1


def estimate_law(
    fit: Fit,
    prepared: Prepared,
    posterior: Posterior,
    *,
    seed: int,
    simulations: int,
    rounds: int,
    schedule: Schedule | str,
    progress: Progress,
) -> tuple[Fit, dict[str, tuple[np.ndarray, np.ndarray]] | None]:
    """Read the law of a scan from its descriptors: draw from the posterior, grow some draws, and compare.

    Parameters
    ----------
    simulations, rounds, schedule
        As in `infer`. Without simulations the scan is compared with what training left unexplained.

    Returns
    -------
    tuple
        The fit with draws, weak directions, misfit and candidates, the most trusted first; the same fit where the
        descriptors cannot be measured. And by block of descriptors the scan's numbers `(k,)` and those of the
        simulations `(n, k)`; None without simulations.
    """
    progress("measuring descriptors", 0.0)
    if (found := _measure_descriptors(prepared)) is None:
        return fit, None
    # Of a structure that fills over half, the background is described: `turn` gives the law of the structure.
    seen, row, view, turn = found
    progress("reading the posterior", 0.1)
    parameters = posterior.sample(row, view, DRAWS, seed)
    best = best_parameters(posterior.emulator, row, view, parameters[:STARTS])
    other = "Of the other phase: " if turn is mirror_parameters else ""
    weak = tuple(other + each for each in describe_weak_directions(posterior.emulator, *best))
    fit = replace(fit, draws=turn(parameters), view=view, weak_directions=weak)
    likely = Candidate("posterior", *law_of(turn(middle_of(parameters))), _deviations(turn(parameters)))
    simulate = _simulator(seen, view, schedule)
    grown = None
    if simulations:
        part = sub_progress(progress, 0.15, 0.45)
        grown = simulate_draws(parameters, simulate, simulations, seed=seed, progress=part)
    if grown is None or len(grown.parameters) < FEWEST:
        left = misfits(posterior.emulator, row[None], view, parameters[None, :STARTS])[0]
        misfit = Misfit(tail_probability(posterior, view, left), {}, "by the best fit, nothing grown")
        return replace(fit, misfit=misfit, candidates=(likely, _best_fit(posterior, *best, turn))), None
    pool = posterior.sample(row, view, POOL, seed)
    search = Search(posterior.emulator, view, row)
    part = sub_progress(progress, 0.45, 1.0)
    likeliest, every = search.run(pool, grown, simulate, rounds=rounds, seed=seed, progress=part)
    near = every.parameters[search.nearest(every)[0]]
    refined, simulation = (
        Candidate(name, *law_of(turn(each)), {}) for name, each in (("refined", likeliest), ("simulation", near))
    )
    names = np.array(column_names())
    blocks = {name: (row[names == name], grown.descriptors[:, names == name]) for name in BLOCKS}
    misfit = check(posterior, row, view, grown.descriptors)
    return replace(fit, misfit=misfit, candidates=(refined, likely, simulation)), blocks


def refine_matches(prepared: Prepared, posterior: Posterior, matches: Sequence[Match]) -> tuple[Candidate, ...]:
    """Refine the parameters of the nearest matches until the emulated descriptors fit the scan's best.

    Levenberg and Marquardt's method, by optimistix, starts from each match, with the exact derivatives of the emulator.
    Returns one law; none where the descriptors of the scan cannot be measured.
    """
    if (found := _measure_descriptors(prepared)) is None:
        return ()
    _, row, view, turn = found
    starts = turn(np.stack([parameters_of(each.coefficients, each.mass) for each in matches]))
    return (_best_fit(posterior, *best_parameters(posterior.emulator, row, view, starts), turn),)


def middle_of(parameters: np.ndarray) -> np.ndarray:
    """Return the row of parameters `(n, 6)` nearest to the medians, in units of each column's range."""
    away = (parameters - np.median(parameters, 0)) / np.ptp(parameters, axis=0)
    return parameters[np.square(away).sum(1).argmin()]


#: From parameters of the phase that is described to those of the structure.
Turn = Callable[[np.ndarray], np.ndarray]


def _measure_descriptors(prepared: Prepared) -> tuple[Prepared, np.ndarray, str, Turn] | None:
    """Return the phase that is described, its row of descriptors and kind of view, and the way to the structure's law.

    Of a structure that fills most of the volume the background is described, as the shapes of the training were thin.
    """
    turned = prepared.volume_fraction > HALF
    seen = prepared.inverted if turned else prepared
    measured = scan_descriptors(seen)
    if measured is None:
        return None
    return seen, *measured, mirror_parameters if turned else np.asarray


def _best_fit(posterior: Posterior, best: np.ndarray, covariance: np.ndarray, turn: Turn) -> Candidate:
    """Return the best fit of the descriptors, with deviations by draws from the normal distribution around it."""
    near = np.random.default_rng(0).multivariate_normal(best, covariance, DRAWS, check_valid="ignore")
    return Candidate("optimum", *law_of(turn(best)), _deviations(turn(np.clip(near, *posterior.box.T))))


def _deviations(parameters: np.ndarray) -> dict[str, float]:
    """Return the standard deviations by name, 0 for a20, of parameters `(n, 6)`."""
    return {"a20": 0.0} | dict(zip(COLUMNS, to_columns(parameters).std(1).tolist(), strict=True))


def _simulator(prepared: Prepared, view: str, schedule: Schedule | str) -> Simulate:
    """Return a function that grows a shape from parameters and measures its descriptors as the scan's were measured.

    Blur, noise and window are the scan's own. Shapes grow in a periodic box of the main window's size, within `EDGES`.
    """
    z, y, x = (int(np.clip(edge.stop - edge.start, *EDGES)) for edge in prepared.windows[0])
    grid = Grid((z, y, x), prepared.grid.spacing, "periodic")
    # A window of something larger loses what its faces cut; a box that repeats loses nothing.
    apply_view = VIEWS["mask" if prepared.part(prepared.windows[0]).periodic else "crop"]

    def simulate(parameters: np.ndarray, seed: int) -> np.ndarray:
        flow = generate(*law_of(parameters), grid, schedule=schedule, seed=seed, reject_early=True)
        if not flow.viability.viable:
            return to_row(None)
        field = flow.field.numpy()
        try:
            if view == "field":
                return descriptors(field, grid).vector()
            seen = apply_view(prepared.rescan(field > 0, seed), grid, np.random.default_rng(seed))
            return descriptors(*seen).vector()
        except (ScanError, NoSurface):
            return to_row(None)

    return simulate


def tail_probability(posterior: Posterior, view: str, misfit: float) -> float:
    """Return the part of shapes whose best parameters leave more unexplained than a query's do (`misfit`)."""
    usual = posterior.misfits[view]
    return float((1 + (usual >= misfit).sum()) / (1 + len(usual)))


def check(posterior: Posterior, descriptors: np.ndarray, view: str, simulated: np.ndarray) -> Misfit:
    """Compare a row of descriptors `(351,)` with those of simulations of the posterior's draws `(n, 351)`.

    The probability of a block is that of its residual from a linear regression on the posterior's mean; it is cautious.
    Raises ValueError if there are fewer than `FEWEST` simulations.
    """
    if len(simulated) < FEWEST:
        raise ValueError(f"expected at least {FEWEST} simulations to compare with, got {len(simulated)}")
    rows = np.concatenate([np.atleast_2d(descriptors), simulated])
    draws = posterior.sample(rows, view, SUMMARY_DRAWS)
    left = np.log(misfits(posterior.emulator, rows, view, draws[:, :STARTS]) + FLOOR)
    summaries = posterior.standardise(draws).mean(1)
    blocks = {name: _tail(_residuals(columns_of(rows, [name]), summaries)) for name in BLOCKS}
    return Misfit(_tail(left), blocks, f"{len(simulated)} shapes grown from draws")


def _tail(values: np.ndarray) -> float:
    """Return the probability that a value of the same normal distribution as the rest exceeds the first."""
    first, rest = values[0], values[1:]
    score = (first - rest.mean()) / (rest.std(ddof=1) * np.sqrt(1 + 1 / len(rest)) + 1e-9)
    return float(stats.t.sf(score, len(rest) - 1))


def _residuals(rows: np.ndarray, summaries: np.ndarray) -> np.ndarray:
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
