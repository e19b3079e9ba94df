"""What the descriptors of a scan say of its law: draws from a posterior, and whether any law is believable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit, join_tests
from curvafit.inference.emulator import best_parameters, misfits
from curvafit.inference.posterior import Combination, Posterior
from curvafit.inference.table import COLUMNS, law_of, mirror_parameters, parameters_of, to_columns
from curvafit.scan.measures import Reading, read_texture
from curvafit.scan.preparation import HALF, Prepared

#: Draws from the posterior.
DRAWS = 400
#: Draws from which the search for the best parameters starts.
STARTS = 8
#: How many more of the draws nearest to the middle are tried where nothing grows from the nearest.
OTHERS = 4
#: Most noise over the contrast of an image that is tested: a fifth is that of the images in the reference.
NOISIEST = 0.3


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

    `others` are draws to take the place of the posterior's middle, in this order, where nothing grows from that.
    """

    draws: np.ndarray | None = None
    view: str = ""
    combinations: tuple[Combination, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    misfit: Misfit | None = None
    matches: tuple[Match, ...] = ()
    others: tuple[Candidate, ...] = ()


def measure_descriptors(prepared: Prepared) -> Described | None:
    """Measure the descriptors of a scan; None where they cannot be measured."""
    # The training's shapes fill less than half of their box, so of a structure that fills more the background is taken.
    background = prepared.volume_fraction > HALF
    described = prepared.inverted if background else prepared
    reading = read_texture(described)
    return None if reading is None else Described(described, reading, background)


def estimate_law(described: Described, posterior: Posterior, seed: int) -> Estimate:
    """Read the law of a scan from its descriptors: draws from the posterior, the middle of these, and the misfit."""
    reading, mirror = described.reading, described.mirror_if_background
    draws = posterior.draw(reading, DRAWS, seed)
    parameters, log_thickness = draws[:, :-1], draws[:, -1]
    thickness = float(np.exp(np.median(log_thickness)))
    deviations = _deviations(mirror(parameters))
    middle, *others = (
        Candidate("posterior", *law_of(mirror(row)), deviations, thickness)
        for row in sort_by_middle(parameters)[: 1 + OTHERS]
    )
    return Estimate(
        draws=np.column_stack([mirror(parameters), log_thickness]),
        view=reading.view,
        combinations=posterior.combinations.read(parameters, background=described.background),
        candidates=(middle,),
        others=tuple(others),
        misfit=measure_misfit(described, posterior, parameters[:STARTS]),
    )


def refine_matches(described: Described, posterior: Posterior, matches: Sequence[Match]) -> Estimate:
    """Refine the parameters of the nearest matches until the emulated descriptors fit the scan's best.

    Levenberg and Marquardt's method, by optimistix, starts from each match, with the exact derivatives of the emulator.
    Deviations are those of draws from the normal distribution around the best.
    """
    mirror, box = described.mirror_if_background, posterior.emulator.box.T
    starts = mirror(np.stack([parameters_of(match.coefficients, match.mass) for match in matches]))
    best, covariance = best_parameters(posterior.emulator, described.reading, starts)
    samples = np.random.default_rng(0).multivariate_normal(best, covariance, DRAWS, check_valid="ignore")
    law = (*law_of(mirror(best)), _deviations(mirror(np.clip(samples, *box))))
    misfit = measure_misfit(described, posterior, starts)
    return Estimate(candidates=(Candidate("optimum", *law, matches[0].thickness),), misfit=misfit)


def sort_by_middle(parameters: np.ndarray) -> np.ndarray:
    """Return the rows of parameters `(n, 6)` by their distance from the medians, in units of each column's range."""
    # As parameters are correlated, the medians of all six together may be a law that the posterior holds unlikely.
    offsets = (parameters - np.median(parameters, 0)) / np.ptp(parameters, axis=0)
    return parameters[np.square(offsets).sum(1).argsort(kind="stable")]


def _deviations(parameters: np.ndarray) -> dict[str, float]:
    """Return the standard deviations of parameters `(n, 6)` by name; that of a20, which is 1, is 0."""
    return {"a20": 0.0} | dict(zip(COLUMNS, to_columns(parameters).std(1).tolist(), strict=False))


def tail_probability(values: np.ndarray, own: float) -> float:
    """Return the probability that a value drawn as `values` `(n,)` were is at least `own`, which counts among them."""
    return float((1 + (values >= own).sum()) / (1 + len(values)))


def measure_misfit(described: Described, posterior: Posterior, starts: np.ndarray) -> Misfit | None:
    """Rank a scan among shapes of the model, by two tests: what the best parameters leave unexplained, sought from
    `starts` `(n, 6)`, and how much it looks like textures of no law. None of an image whose noise is over `NOISIEST`.
    """
    reading, quality = described.reading, described.prepared.quality
    if quality is not None and quality.noise > NOISIEST:
        return None
    others = posterior.misfits[reading.view]
    unexplained = tail_probability(others, misfits(posterior.emulator, *reading.columns, starts[None])[0])
    fisher = posterior.discriminants.get(reading.view)
    if fisher is None:
        return Misfit(unexplained, unexplained, grain=1 / (1 + len(others)))
    value = posterior.discriminate(reading.columns[0], fisher.weights)[0]
    discriminant = tail_probability(-fisher.reference, -value)
    grain = 2 / (1 + min(len(others), len(fisher.reference)))
    return Misfit(join_tests(unexplained, discriminant), unexplained, discriminant, grain)
