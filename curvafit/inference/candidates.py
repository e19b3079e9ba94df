"""Laws that may have made a scan, what grew from each, and which of them is supported."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.geometry.pairwise import one_to_many
from curvafit.inference.twins import Twin
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.fit_file import six_of

#: Greatest mass of either sign: a rare structure's field lies a little beyond ±1 in the mean.
RARE = 1 - 1e-6
#: Twins within this many seeds' distances of the scan support their law: true laws' twins lie one away, of a badly
#: degraded scan some 1.8.
CLOSE = 2.0
#: Where a law comes from, as people read it.
TITLES = {
    "refined": "refined by simulation",
    "posterior": "middle of the posterior",
    "optimum": "best fit of the descriptors",
    "simulation": "nearest of the simulations",
    "stationarity": "refined by stationarity",
    "match": "nearest match",
}


@dataclass(frozen=True)
class Candidate:
    """A law that may have made a scan, in working units, and what grew from it.

    Its mass is that of its twins once they are grown; where that is the one that fills the scan's volume fraction and
    not the law's own, the deviation of the law's is none of its.

    Attributes
    ----------
    name
        Where the law comes from: a key of `TITLES`.
    uncertainty
        Standard deviations by coefficient, and of the mass where it has one; empty where they are not known.
    distance
        Mean distance of its twins' curvature diagrams from the scan's, 1 / working unit; None where none grew.
    seed_noise
        Mean distance between two of its twins; None where fewer grew.
    twins
        The twins' familiar numbers.
    status
        What the method says of itself, or why nothing grew.
    """

    name: str
    coefficients: Coefficients
    mass: float
    uncertainty: dict[str, float]
    distance: float | None = None
    seed_noise: float | None = None
    twins: tuple[Morphometry, ...] = ()
    status: str = ""

    def grown(self, scan: Diagram, twins: Sequence[Twin]) -> Candidate:
        """Return the candidate with what its twins measure against the scan's curvature diagram."""
        diagrams = [each.diagram for each in twins if each.diagram is not None]
        if not diagrams:
            return replace(self, status=f"{self.status} No shape grew: {twins[0].reason}.".strip())
        distance = float(one_to_many(scan, diagrams).mean())
        pairs = [one_to_many(each, diagrams[k + 1 :]) for k, each in enumerate(diagrams[:-1])]
        noise = float(np.concatenate(pairs).mean()) if pairs else None
        numbers = tuple(each.morphometry for each in twins if each.morphometry is not None)
        mass = float(np.clip(np.mean([each.mass for each in twins if each.phase is not None]), -RARE, RARE))
        known = {name: value for name, value in self.uncertainty.items() if name != "mass" or mass == self.mass}
        return replace(self, mass=mass, uncertainty=known, distance=distance, seed_noise=noise, twins=numbers)

    def as_dict(self) -> dict[str, Any]:
        """Return the candidate in JSON's types."""
        numbers = list(map(content_of, self.twins))
        return {**vars(self), "coefficients": self.coefficients.as_dict(), "twins": numbers}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Candidate:
        """Return what `as_dict` wrote."""
        twins = tuple(map(morphometry_of, content["twins"]))
        deviations = {name: float(value) for name, value in content["uncertainty"].items()}
        same = {name: content[name] for name in ("name", "distance", "seed_noise", "status")}
        six, mass = six_of(content["coefficients"]), float(content["mass"])
        return Candidate(**same, coefficients=six, mass=mass, uncertainty=deviations, twins=twins)


def content_of(numbers: Morphometry) -> dict[str, Any]:
    """Return familiar numbers in JSON's types, null for NaN."""
    return {name: None if value != value else value for name, value in vars(numbers).items()}


def morphometry_of(content: Mapping[str, Any]) -> Morphometry:
    """Return the familiar numbers of a fit's content, NaN where it has null."""
    numbers: dict[str, Any] = {name: math.nan if value is None else value for name, value in content.items()}
    return Morphometry(**numbers)


def best_of(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the first candidate within seed noise of the one nearest to the scan; None where nothing grew.

    The noise is that of the nearest one's twins; where they are fewer than two, the nearest is the best. Of those
    within it the first is taken whose own twins lie at most `CLOSE` times as far from the scan as from each other, if
    there is one: seeds that are more alike than the scan is to any of them are another texture's.
    """
    grown = {each.name: each.distance for each in candidates if each.distance is not None}
    if not grown:
        return None
    nearest = min((each for each in candidates if each.name in grown), key=lambda each: grown[each.name])
    reach = grown[nearest.name] + (nearest.seed_noise or 0.0)
    within = [each for each in candidates if each.name in grown and grown[each.name] <= reach]
    close = (each for each in within if each.seed_noise is None or grown[each.name] <= CLOSE * each.seed_noise)
    return next(close, within[0])


def noise_of(candidates: Sequence[Candidate]) -> float | None:
    """Return the distance between two twins of the best candidate; of another one where it has fewer than two."""
    best = best_of(candidates)
    known = [each.seed_noise for each in candidates if each.seed_noise is not None]
    return best.seed_noise if best is not None and best.seed_noise is not None else next(iter(known), None)
