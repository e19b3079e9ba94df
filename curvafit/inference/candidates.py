"""Laws that may have made a scan, what grew from each, and which of them is supported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch

from curvafit.core.schema import Rule
from curvafit.generation.flow import Flow, generate
from curvafit.generation.schedule import LEARNED, Schedule
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.distances import one_to_many
from curvafit.geometry.mesh import NoSurface
from curvafit.geometry.morphometry import Morphometry, morphometry
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.scan.prepare import Prepared
from curvafit.volumes.field import ScanError

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
#: Longest edge, in working voxels, of the boxes in which twins grow.
LONGEST_EDGE = 100

NotNegative = Annotated[float, Rule(least=0)]
#: Standard deviations by coefficient, and of the mass.
Deviations = Annotated[dict[str, float], Rule(keys=tuple((name, NotNegative) for name in (*NAMES, "mass")))]


@dataclass(frozen=True)
class Candidate:
    """A law that may have made a scan, in working units, and what grew from it.

    Once twins are grown, the mass is theirs. Where it was set so that they fill the scan's volume fraction, the law's
    own deviation of the mass is dropped.

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
    mass: Annotated[float, Rule(above=-1, below=1)]
    uncertainty: Deviations
    distance: Annotated[float | None, Rule(least=0)] = None
    seed_noise: Annotated[float | None, Rule(least=0)] = None
    twins: tuple[Morphometry, ...] = ()
    status: str = ""

    def compare(self, scan: Diagram, twins: Sequence[Twin]) -> Candidate:
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


def best_candidate(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the first candidate within seed noise of the one nearest to the scan; None where nothing grew.

    The noise is the distance between the nearest candidate's twins. Of the candidates within it, the first is preferred
    whose twins lie at most `CLOSE` times as far from the scan as from each other: where the seeds of a law are more
    alike than that, the scan is another texture.
    """
    grown = [(each.distance, each) for each in candidates if each.distance is not None]
    if not grown:
        return None
    least, nearest = min(grown, key=lambda pair: pair[0])
    reach = least + (nearest.seed_noise or 0.0)
    within = [(distance, each) for distance, each in grown if distance <= reach]
    close = (each for distance, each in within if each.seed_noise is None or distance <= CLOSE * each.seed_noise)
    return next(close, within[0][1])


def seed_noise_of(candidates: Sequence[Candidate]) -> float | None:
    """Return the distance between two twins of the best candidate; of another one where it has fewer than two."""
    best = best_candidate(candidates)
    known = [each.seed_noise for each in candidates if each.seed_noise is not None]
    return best.seed_noise if best is not None and best.seed_noise is not None else next(iter(known), None)


@dataclass(frozen=True, eq=False)
class Twin:
    """A shape grown from a law, or the reason why none grew.

    `phase` and `mass` are the shape's own. `diagram` and `morphometry` are measured as the scan's were: with its blur
    and noise, and in a window where the scan is one.
    """

    phase: np.ndarray | None
    mass: float
    diagram: Diagram | None
    morphometry: Morphometry | None
    reason: str = ""


def twin(
    coefficients: Coefficients, mass: float, prepared: Prepared, seed: int, schedule: Schedule | str = LEARNED
) -> Twin:
    """Grow a shape of a law in a box of the scan's main window, at most `LONGEST_EDGE` voxels a side.

    A mask or an image does not state a mass: the shape fills as much of its box as the structure does
    (`Prepared.true_volume_fraction`), or has the law's own mass where nothing grows so.
    """
    z, y, x = (min(edge.stop - edge.start, LONGEST_EDGE) for edge in prepared.windows[0])
    grid = Grid((z, y, x), prepared.grid.spacing, "periodic")
    options = {"schedule": schedule, "seed": seed, "reject_early": True}
    if prepared.kind != "field":
        share = prepared.true_volume_fraction
        flow = generate(coefficients, mass, grid, volume_fraction=share, **options)
        if (grown := _measure_twin(flow, prepared, seed)).phase is not None:
            return grown
    return _measure_twin(generate(coefficients, mass, grid, **options), prepared, seed)


def _measure_twin(flow: Flow, prepared: Prepared, seed: int) -> Twin:
    """Return a flow's shape with its diagram and numbers, as the scan would show it."""
    if not flow.viability.viable:
        return Twin(None, flow.mass, None, None, flow.viability.reason)
    try:
        mask, field = flow.field.numpy() > 0, flow.field
        window = Grid(flow.grid.shape, flow.grid.spacing, prepared.grid.boundary)
        if prepared.kind != "field":
            mask = prepared.rescan(mask, seed)
            field = phase_field(torch.from_numpy(mask), window, WORKING_EPSILON)
        curvature = diagram(field, window, WORKING_EPSILON)
    except (NoSurface, ScanError) as error:
        return Twin(None, flow.mass, None, None, str(error))
    numbers = morphometry(mask, prepared.working_voxel, prepared.unit, periodic=window.periodic)
    return Twin(flow.field.numpy(), flow.mass, curvature, numbers)


@dataclass(frozen=True)
class Misfit:
    """The share of the model's shapes whose descriptors are as unusual as the scan's.

    `probability` is of all descriptors together, `blocks` of each block alone; `method` says what was compared with.
    """

    probability: Annotated[float, Rule(least=0, most=1)]
    blocks: dict[str, float]
    method: str
