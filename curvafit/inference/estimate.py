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
from curvafit.priors.kernels.threads import map_threads
from curvafit.scan.measures import Reading, read_texture, windows_along
from curvafit.scan.preparation import HALF, Prepared

#: Draws from the posterior, and draws among which the search chooses parameters to grow.
DRAWS, POOL = 400, 2000
#: Edge, in voxels, of the boxes in which draws are grown.
EDGE = 64
#: Draws from which the search for the best parameters starts.
STARTS = 8
#: Least number of simulations to refine from, and of windows of shapes to test a law with.
FEWEST = 6
#: Windows of shapes that a law is tested with, and the least deviation of a column, as a fraction of its block's mean.
TESTED, FAINTEST = 24, 0.05
#: Most relabellings of windows that are tried; all are, where there are no more.
RELABELLED = 1999


class Described(NamedTuple):
    """A scan whose rarer phase is taken as the structure, the reading of that, and whether it is the background."""

    prepared: Prepared
    reading: Reading
    background: bool

    def mirror_if_background(self, parameters: np.ndarray) -> np.ndarray:
        """Return the parameters of the scan's structure from those of the described phase, or the reverse."""
        return mirror_parameters(parameters) if self.background else parameters


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is read of a scan's law: draws, view, combinations, candidates, misfit and matches, as a `Fit` has them.

    `simulated` has, by block, the descriptors of the scan `(k,)` and of shapes grown from draws `(n, k)`; None where
    none grew.
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
    # The training's shapes fill less than half of their box, so of a structure that fills more the background is taken.
    background = prepared.volume_fraction > HALF
    described = prepared.inverted if background else prepared
    reading = read_texture(described)
    return None if reading is None else Described(described, reading, background)


def estimate_law(
    described: Described, posterior: Posterior, *, growth: Growth | None, seed: int, progress: Progress
) -> Estimate:
    """Read the law of a scan from its descriptors: draw from the posterior, grow some of the draws, and refine by them.

    `growth` and `seed` are as in `infer`; where too little grows, the best fit is compared with those of training.
    """
    reading, mirror = described.reading, described.mirror_if_background
    progress("reading the posterior", 0.0)
    draws = posterior.draw(reading, DRAWS, seed)
    parameters, log_thickness = draws[:, :-1], draws[:, -1]
    combinations = posterior.combinations.read(parameters, background=described.background)
    estimate = Estimate(np.column_stack([mirror(parameters), log_thickness]), reading.view, combinations)
    thickness = float(np.exp(np.median(log_thickness)))
    middle = Candidate("posterior", *law_of(mirror(middle_of(parameters))), _deviations(mirror(parameters)), thickness)
    grown = None
    if growth is not None and growth.simulations:
        simulate = _simulator(described.prepared, reading.view, growth.schedule)
        stage = sub_progress(progress, 0.15, 0.45)
        grown = simulate_draws(parameters, simulate, growth.simulations, seed=seed, progress=stage)
    if growth is None or grown is None or len(grown.parameters) < FEWEST:
        unexplained = misfits(posterior.emulator, *reading.columns, parameters[None, :STARTS])[0]
        p = tail_probability(posterior.misfits[reading.view], unexplained)
        p, level_cut = _join_level_cut(p, posterior, reading)
        grain = _grain(posterior, len(posterior.misfits[reading.view]))
        misfit = Misfit(p, {}, "by the best fit, nothing grown", level_cut=level_cut, grain=grain)
        candidates = (middle, _best_fit(posterior, described, parameters[:STARTS], thickness))
        return replace(estimate, candidates=candidates, misfit=misfit)
    pool = posterior.draw(reading, POOL, seed)[:, :-1]
    search = Search(posterior.emulator, reading)
    stage = sub_progress(progress, 0.45, 1.0)
    likeliest, simulations = search.run(pool, grown, simulate, rounds=growth.rounds, seed=seed, progress=stage)
    nearest = simulations.parameters[search.nearest(simulations)[0]]
    candidates = (Candidate("refined", *law_of(mirror(likeliest)), {}, thickness), middle)
    if not np.array_equal(nearest, likeliest):
        candidates += (Candidate("simulation", *law_of(mirror(nearest)), {}, thickness),)
    blocks, scan_row, grown_rows = np.array(column_names()), reading.descriptors, grown.columns[0]
    simulated = {block: (scan_row[blocks == block], grown_rows[:, blocks == block]) for block in BLOCKS}
    return replace(estimate, candidates=candidates, simulated=simulated)


def refine_matches(described: Described, posterior: Posterior, matches: Sequence[Match]) -> Candidate:
    """Refine the parameters of the nearest matches until the emulated descriptors fit the scan's best.

    Levenberg and Marquardt's method, by optimistix, starts from each match, with the exact derivatives of the emulator.
    """
    parameters = np.stack([parameters_of(match.coefficients, match.mass) for match in matches])
    return _best_fit(posterior, described, described.mirror_if_background(parameters), matches[0].thickness)


def middle_of(parameters: np.ndarray) -> np.ndarray:
    """Return the row of parameters `(n, 6)` nearest to the medians, in units of each column's range."""
    # As parameters are correlated, the medians of all six together may be a law that the posterior holds unlikely.
    offsets = (parameters - np.median(parameters, 0)) / np.ptp(parameters, axis=0)
    return parameters[np.square(offsets).sum(1).argmin()]


def _best_fit(posterior: Posterior, described: Described, starts: np.ndarray, thickness: float) -> Candidate:
    """Return the best fit of the descriptors, with deviations by draws from the normal distribution around it."""
    best, covariance = best_parameters(posterior.emulator, described.reading, starts)
    samples = np.random.default_rng(0).multivariate_normal(best, covariance, DRAWS, check_valid="ignore")
    deviations = _deviations(described.mirror_if_background(np.clip(samples, *posterior.emulator.box.T)))
    return Candidate("optimum", *law_of(described.mirror_if_background(best)), deviations, thickness)


def _deviations(parameters: np.ndarray) -> dict[str, float]:
    """Return the standard deviations of parameters `(n, 6)` by name; that of a20, which is 1, is 0."""
    return {"a20": 0.0} | dict(zip(COLUMNS, to_columns(parameters).std(1).tolist(), strict=False))


def _simulator(prepared: Prepared, view: str, schedule: Schedule | str) -> Simulate:
    """Return a function that grows a shape in a box of training's size, and reads its descriptors as the scan's."""
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
    """Return the probability that a value drawn as `values` `(n,)` were is at least `own`, which counts among them."""
    return float((1 + (values >= own).sum()) / (1 + len(values)))


def check_law(
    law: Candidate, prepared: Prepared, described: Described, posterior: Posterior, *, seed: int = 0,
    schedule: Schedule | str = LEARNED, progress: Progress = silent,
) -> Misfit | None:  # fmt: skip
    """Grow shapes of a law, and compare the scan's windows with theirs, scanned alike (`compare_windows`).

    A shape is read in as many windows as the scan's main window: windows of one large shape differ more than small
    shapes, each of which has the mass of the law. So many shapes are grown that they have `TESTED` windows; where some
    are not well formed, up to as many again are tried. Returns None where fewer than two shapes, or `FEWEST` windows,
    grow.
    """
    reading = described.reading
    across = windows_along(prepared, [edge.stop - edge.start for edge in prepared.window])
    count = math.ceil(TESTED / math.prod(across))

    def read_twin(seed: int) -> Reading | None:
        grown = twin(law, prepared, seed, schedule, longest=EDGE * max(across)).seen
        if grown is None:
            return None
        return read_texture(grown.inverted if described.background else grown, reading.view, across)

    windows, tried = [], 0
    while len(windows) < count and tried < 2 * count:
        more = min(count - len(windows), 2 * count - tried)
        for twin_reading in map_threads(read_twin, range(seed + tried, seed + tried + more)):
            windows += [] if twin_reading is None else [twin_reading.windows]
            progress(f"testing the law: {len(windows)} of {count} shapes", len(windows) / count)
        tried += more
    if len(windows) < 2 or sum(map(len, windows)) < FEWEST:
        return None
    return compare_windows(posterior, reading, np.concatenate(windows))


def probability_alike(scan: np.ndarray, twins: np.ndarray, seed: int = 0) -> float:
    """Return the probability that windows of one texture differ as much as a scan's `(k, d)` and its twins' `(n, d)`.

    It is the permutation test of the energy distance between both sets: if all windows are of one texture, any k of
    them were as likely the scan's. For a single window it ranks the scan among the twins. At most `RELABELLED` choices,
    drawn by `seed`, are tried.
    """
    windows = np.concatenate([scan, twins])
    choices, _ = relabel(np.arange(len(windows)) < len(scan), RELABELLED, seed)
    return float(share_beyond(measure_energy(cdist(windows, windows), choices)))


def rank_level_cut(posterior: Posterior, view: str, windows: np.ndarray) -> float:
    """Return the fraction of the model's shapes that look as much like a level cut as windows `(k, 351)` of a scan."""
    return tail_probability(-posterior.discriminants[view], -float(posterior.discriminate(windows).mean()))


def _join_level_cut(p: float, posterior: Posterior, reading: Reading) -> tuple[float, float | None]:
    """Join the probability of a test with that of `rank_level_cut`; return both, or `p` and None without the latter."""
    if not len(posterior.discriminant):
        return p, None
    level_cut = rank_level_cut(posterior, reading.view, reading.windows)
    return join_tests(p, level_cut), level_cut


def _grain(posterior: Posterior, ranked: int) -> float:
    """Return the step in which a probability comes that was ranked among so many values, and joined with another."""
    return (2 if len(posterior.discriminant) else 1) / (1 + ranked)


def compare_windows(posterior: Posterior, reading: Reading, twins: np.ndarray) -> Misfit:
    """Test whether windows of a scan `(k, 351)` differ from those of twins `(n, 351)` more than the model's shapes do.

    The law of the twins was fitted to the scan, and differs a little from the true one even if there is one. So the
    scan's departure from them, in the emulator's uncorrelated directions, is ranked among those of shapes whose laws
    were fitted in the same way (`Posterior.departures`), and its discriminant among those of the same view; the tests
    are joined (`join_tests`). For each block, and without departures, p is that of a law chosen before the scan.
    """
    scan, references = reading.windows, posterior.departures
    scan_scores, twin_scores = map(posterior.emulator.decorrelate, (scan, twins))
    departure = float(cdist(scan_scores, twin_scores).mean() - pdist(twin_scores).mean())
    ranked = len(references) > 0
    p = tail_probability(references, departure) if ranked else probability_alike(scan_scores, twin_scores)
    p, level_cut = _join_level_cut(p, posterior, reading)
    blocks = {}
    for name in BLOCKS:
        scan_block, twin_block = (columns_of(windows, [name]) for windows in (scan, twins))
        spread = twin_block.std(0) + FAINTEST * twin_block.std(0).mean() + 1e-12
        blocks[name] = probability_alike(scan_block / spread, twin_block / spread)
    ranking = f", ranked among {len(references)} shapes" if ranked else ""
    method = f"{len(twins)} windows of shapes of the law, {len(scan)} of the scan{ranking}"
    grain = _grain(posterior, len(references) or RELABELLED)
    return Misfit(p, blocks, method, departure, level_cut, grain)
