"""What the descriptors of a scan say of its law: draws from a posterior, laws to grow, whether any is believable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist, pdist

from curvafit.core.permutation import measure_energy, relabel, share_beyond
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED, Schedule
from curvafit.geometry.description import BLOCKS
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit, join_tests, twin
from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.posterior import Combination, Posterior
from curvafit.inference.simulate import Growth, Search, Simulate, simulate_draws
from curvafit.inference.table import (
    COLUMNS,
    column_names,
    columns_of,
    law_of,
    mirror_parameters,
    parameters_of,
    to_columns,
)  # fmt: skip
from curvafit.priors.grid import Grid
from curvafit.scan.measures import Reading, read_texture, windows_along
from curvafit.scan.preparation import HALF, Prepared

#: Draws from the posterior, and those among which more are chosen to be grown.
DRAWS, POOL = 400, 2000
#: Edge, in voxels, of the boxes in which draws are grown.
EDGE = 64
#: Draws from which the best parameters are looked for.
STARTS = 8
#: Least simulations to go on from, and least windows of shapes to test a law with.
FEWEST = 6
#: Windows of shapes that a law is tested with, and the least deviation of a column, of the mean of its block's.
TESTED, FAINTEST = 24, 0.05
#: Most relabellings of windows that are tried; where there are fewer, all of them are.
RELABELLED = 1999


class Described(NamedTuple):
    """The phase of a scan that is described, what is read of it, and whether it is the background."""

    seen: Prepared
    reading: Reading
    background: bool

    def turn(self, parameters: np.ndarray) -> np.ndarray:
        """Return the parameters of the structure from those of the phase that is described, or the other way round."""
        return mirror_parameters(parameters) if self.background else parameters


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is read of a scan's law: draws, view, combinations, candidates, misfit and matches, as a `Fit` has them.

    `simulated` has, by block of descriptors, the scan's numbers `(k,)` and those of shapes grown from draws `(n, k)`;
    None where none grew.
    """

    draws: np.ndarray | None = None
    view: str = ""
    combinations: tuple[Combination, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    misfit: Misfit | None = None
    matches: tuple[Match, ...] = ()
    simulated: dict[str, tuple[np.ndarray, np.ndarray]] | None = None


def measure_descriptors(prepared: Prepared) -> Described | None:
    """Measure the descriptors of a scan; None where they cannot be measured."""
    # Of a structure that fills most of the volume the background is described, as the training's shapes were thin.
    turned = prepared.volume_fraction > HALF
    seen = prepared.inverted if turned else prepared
    reading = read_texture(seen)
    return None if reading is None else Described(seen, reading, turned)


def estimate_law(
    described: Described, posterior: Posterior, *, growth: Growth | None, seed: int, progress: Progress
) -> Estimate:
    """Read the law of a scan from its descriptors: draw from the posterior, grow some draws, and compare.

    The parameters are as in `infer`; where nothing grows the scan is compared with what training left unexplained.
    """
    reading, of_structure = described.reading, described.turn
    progress("reading the posterior", 0.0)
    draws = posterior.draw(reading, DRAWS, seed)
    parameters = draws[:, :-1]
    combinations = posterior.combinations.read(parameters, background=described.background)
    estimate = Estimate(np.column_stack([of_structure(parameters), draws[:, -1]]), reading.view, combinations)
    thickness = float(np.exp(np.median(draws[:, -1])))
    likely = Candidate(
        "posterior", *law_of(of_structure(middle_of(parameters))), _deviations(of_structure(parameters)), thickness
    )
    grown = None
    if growth is not None and growth.simulations:
        simulate, step = _simulator(described.seen, reading.view, growth.schedule), sub_progress(progress, 0.15, 0.45)
        grown = simulate_draws(parameters, simulate, growth.simulations, seed=seed, progress=step)
    if growth is None or grown is None or len(grown.parameters) < FEWEST:
        own_misfit = misfits(posterior.emulator, *reading.columns, parameters[None, :STARTS])[0]
        p, level_cut = _join_level_cut(
            tail_probability(posterior.misfits[reading.view], own_misfit), posterior, reading
        )
        misfit = Misfit(p, {}, "by the best fit, nothing grown", level_cut=level_cut)
        candidates = (likely, _best_fit(posterior, described, parameters[:STARTS], thickness))
        return replace(estimate, candidates=candidates, misfit=misfit)
    pool = posterior.draw(reading, POOL, seed)[:, :-1]
    search = Search(posterior.emulator, reading)
    step = sub_progress(progress, 0.45, 1.0)
    likeliest, simulations = search.run(pool, grown, simulate, rounds=growth.rounds, seed=seed, progress=step)
    nearest = simulations.parameters[search.nearest(simulations)[0]]
    laws = {"refined": likeliest} | ({} if np.array_equal(nearest, likeliest) else {"simulation": nearest})
    refined, *others = (Candidate(name, *law_of(of_structure(each)), {}, thickness) for name, each in laws.items())
    names, row, rows = np.array(column_names()), reading.descriptors, grown.columns[0]
    blocks = {name: (row[names == name], rows[:, names == name]) for name in BLOCKS}
    return replace(estimate, candidates=(refined, likely, *others), simulated=blocks)


def refine_matches(described: Described, posterior: Posterior, matches: Sequence[Match]) -> Candidate:
    """Refine the parameters of the nearest matches until the emulated descriptors fit the scan's best.

    Levenberg and Marquardt's method, by optimistix, starts from each match, with the exact derivatives of the emulator.
    """
    starts = described.turn(np.stack([parameters_of(match.coefficients, match.mass) for match in matches]))
    return _best_fit(posterior, described, starts, matches[0].thickness)


def middle_of(parameters: np.ndarray) -> np.ndarray:
    """Return the row of parameters `(n, 6)` nearest to the medians, in units of each column's range."""
    # Medians taken one by one need not be a law that the posterior holds likely: its parameters are correlated. A draw
    # is one.
    away = (parameters - np.median(parameters, 0)) / np.ptp(parameters, axis=0)
    return parameters[np.square(away).sum(1).argmin()]


def _best_fit(posterior: Posterior, described: Described, starts: np.ndarray, thickness: float) -> Candidate:
    """Return the best fit of the descriptors, with deviations by draws from the normal distribution around it."""
    best, covariance = best_parameters(posterior.emulator, described.reading, starts)
    near = np.random.default_rng(0).multivariate_normal(best, covariance, DRAWS, check_valid="ignore")
    deviations = _deviations(described.turn(np.clip(near, *posterior.emulator.box.T)))
    return Candidate("optimum", *law_of(described.turn(best)), deviations, thickness)


def _deviations(parameters: np.ndarray) -> dict[str, float]:
    """Return the standard deviations by name, 0 for a20, of parameters `(n, 6)`."""
    return {"a20": 0.0} | dict(zip(COLUMNS, to_columns(parameters).std(1).tolist(), strict=False))


def _simulator(prepared: Prepared, view: str, schedule: Schedule | str) -> Simulate:
    """Return a function that grows a shape in a box of the training, and reads its descriptors as the scan's were."""
    grid = Grid((EDGE, EDGE, EDGE))

    def simulate(parameters: np.ndarray, seed: int) -> Reading | None:
        flow = generate(*law_of(parameters), grid, schedule=schedule, seed=seed, reject_early=True)
        if not flow.viability.viable:
            return None
        try:
            return read_texture(prepared.scan_alike(flow.field.numpy(), seed), view)
        except ValueError:  # such as of one ball, which fills its box: at the scan's thickness it is a few voxels wide
            return None

    return simulate


def tail_probability(values: np.ndarray, own: float) -> float:
    """Return the probability that a number is as great as `own` where it, too, is one of such as `values` `(n,)`."""
    return float((1 + (values >= own).sum()) / (1 + len(values)))


def check_law(
    law: Candidate,
    prepared: Prepared,
    described: Described,
    posterior: Posterior,
    *,
    seed: int = 0,
    schedule: Schedule | str = LEARNED,
    progress: Progress = silent,
) -> Misfit | None:
    """Compare a scan's windows with those of shapes of a law, seen as the scan is (`compare_windows`).

    A shape shows as many windows as the scan's main window does: parts of a large shape differ more than small shapes,
    each of which has the mass of the law. As many shapes are grown as show `TESTED` windows; where some are not well
    formed, up to as many again are tried.

    Returns None where fewer than two shapes, or `FEWEST` windows, grow.
    """
    reading, background = described.reading, described.background
    across = windows_along(prepared, [edge.stop - edge.start for edge in prepared.windows[0]])
    count, rows = -(-TESTED // math.prod(across)), []
    for k in range(2 * count):
        grown = twin(law, prepared, seed + k, schedule, longest=EDGE * max(across))
        if grown.seen is not None:
            own = read_texture(grown.seen.inverted if background else grown.seen, reading.view, across)
            rows += [] if own is None else [own.windows]
        progress(f"testing the law: {len(rows)} of {count} shapes", len(rows) / count)
        if len(rows) == count:
            break
    if len(rows) < 2 or sum(map(len, rows)) < FEWEST:
        return None
    return compare_windows(posterior, reading, np.concatenate(rows))


def probability_alike(scan: np.ndarray, twins: np.ndarray, seed: int = 0) -> float:
    """Return the probability that windows of one texture differ as much as a scan's `(k, d)` and its twins' `(n, d)`.

    The statistic is the energy distance of both sets. If all windows are of one law, each choice of some of them for
    the scan's was as likely, so that values up to p come up with probability p: of a single window this is the scan's
    rank among the twins. Where not all choices are tried, some are drawn, by a seed.
    """
    rows = np.concatenate([scan, twins])
    choices, _ = relabel(np.arange(len(rows)) < len(scan), RELABELLED, seed)
    return float(share_beyond(measure_energy(cdist(rows, rows), choices)))


def rank_level_cut(posterior: Posterior, view: str, windows: np.ndarray) -> float:
    """Return the part of the model's shapes that look as much like a level cut as windows `(k, 351)` of a scan do."""
    return tail_probability(-posterior.discriminants[view], -float(posterior.discriminate(windows).mean()))


def _join_level_cut(p: float, posterior: Posterior, reading: Reading) -> tuple[float, float | None]:
    """Return the probability of a test with that of `rank_level_cut`, and the latter, if the posterior tells it."""
    if not len(posterior.discriminant):
        return p, None
    level_cut = rank_level_cut(posterior, reading.view, reading.windows)
    return join_tests(p, level_cut), level_cut


def compare_windows(posterior: Posterior, reading: Reading, twins: np.ndarray) -> Misfit:
    """Return how probable it is that windows of a scan `(k, 351)` differ so from those of twins `(n, 351)`.

    The law of the twins was found for the scan, and is not quite its own even if there is one. So the scan's departure
    from them, in the emulator's uncorrelated directions, is ranked among those of shapes of the model whose laws were
    found in the same way (`Posterior.departures`); and its discriminant among those of shapes in the same view. The
    two tests are joined (`join_tests`). Where departures are not known, and for each block, which is compared in
    deviations of the twins, the probability is that of a law named beforehand.
    """
    scan, known = reading.windows, posterior.departures
    seen, grown = map(posterior.emulator.decorrelate, (scan, twins))
    departure = float(cdist(seen, grown).mean() - pdist(grown).mean())
    p = tail_probability(known, departure) if len(known) else probability_alike(seen, grown)
    p, level_cut = _join_level_cut(p, posterior, reading)
    blocks = {}
    for name in BLOCKS:
        own, others = (columns_of(rows, [name]) for rows in (scan, twins))
        spread = others.std(0) + FAINTEST * others.std(0).mean() + 1e-12
        blocks[name] = probability_alike(own / spread, others / spread)
    ranked = f", ranked among {len(known)} shapes" if len(known) else ""
    method = f"{len(twins)} windows of shapes of the law, {len(scan)} of the scan{ranked}"
    return Misfit(p, blocks, method, departure, level_cut)
