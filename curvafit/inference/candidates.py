"""Laws that may have made a scan, what grew from each, and the verdict: which of them is believable, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Annotated

import numpy as np

from curvafit.core.schema import Rule
from curvafit.core.units import format_number
from curvafit.generation.flow import Flow, generate
from curvafit.generation.schedule import LEARNED, Schedule
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import one_to_many
from curvafit.geometry.morphology import Morphometry, morphometry
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.scan.measures import scan_diagram
from curvafit.scan.preparation import Prepared, thinner_thickness

#: Greatest absolute mass: the mean of the field of a rare structure may lie a little beyond ±1.
RARE = 1 - 1e-6
#: Where a law comes from, as people read it.
TITLES = {
    "posterior": "middle of the posterior",
    "optimum": "best fit of the descriptors",
    "stationarity": "refined by stationarity",
    "match": "nearest match",
}
#: Edges, in voxels, of the boxes in which twins grow.
EDGES = (32, 100)
#: The probability below which a law is not believed to have made a scan.
UNBELIEVABLE = 0.05
#: What a verdict begins with: a law is believed, it is not, it is not known, or nothing grew to tell.
SUPPORTED, UNBELIEVED, UNDECIDED, UNTESTED = "Supported", "No believable twin", "Undecided", "Not tested"
#: Why a scan has no p.
UNASKED = "It has no p: its descriptors cannot be measured, or its image is noisier than any that is tested."
#: What a scan without a law has still.
LAWLESS = "Measures and comparisons need no law (curvafit measure, compare)."
#: Familiar numbers in which twins may differ from the scan, and the relative difference of all twins that is named.
FAMILIAR = {"thickness": "thickness_mean", "spacing": "spacing_mean", "connectivity": "connectivity_density"}
NEAR = 0.15


@dataclass(frozen=True)
class Growth:
    """Which shapes of each law that is read of a scan are grown, to be compared with it.

    Attributes
    ----------
    twins
        How many shapes of the best law; of each other one.
    schedule
        Steps of each shape.
    """

    twins: int = 3
    schedule: Schedule | str = LEARNED


NotNegative = Annotated[float, Rule(least=0)]
#: Standard deviations by coefficient, and of the mass.
Deviations = dict[str, NotNegative]


@dataclass(frozen=True)
class Candidate:
    """A law that may have made a scan, in working units, and what grew from it.

    Once twins of the nearest match are grown, its mass is theirs, with which they fill the scan's volume fraction.

    Attributes
    ----------
    name
        Where the law comes from: a key of `TITLES`.
    uncertainty
        Standard deviations by coefficient, and of the mass where it has one; empty where they are not known.
    thickness
        Thickness, in their own voxels, of the law's shapes: of its twins once they are grown. None where it is not
        known, or the law is in a phase field's own voxels.
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
    thickness: Annotated[float | None, Rule(above=0)] = None
    distance: Annotated[float | None, Rule(least=0)] = None
    seed_noise: Annotated[float | None, Rule(least=0)] = None
    twins: tuple[Morphometry, ...] = ()
    status: str = ""

    def compare(self, scan: Diagram, twins: Sequence[Twin]) -> Candidate:
        """Return the candidate with its twins' figures, and their distances from the scan's diagram and each other."""
        diagrams = [twin.diagram for twin in twins if twin.diagram is not None]
        if not diagrams:
            return replace(self, status=f"{self.status} No shape grew: {twins[0].reason}.".strip())
        distance = float(one_to_many(scan, diagrams).mean())
        between = [one_to_many(diagram, diagrams[k + 1 :]) for k, diagram in enumerate(diagrams[:-1])]
        noise = float(np.concatenate(between).mean()) if between else None
        morphometries = tuple(twin.morphometry for twin in twins if twin.morphometry is not None)
        mass = self.mass
        if self.name == "match":
            mass = float(np.clip(np.mean([twin.mass for twin in twins if twin.phase is not None]), -RARE, RARE))
        thickness = float(np.mean([thinner_thickness(twin.phase > 0) for twin in twins if twin.phase is not None]))
        compared = {"distance": distance, "seed_noise": noise, "twins": morphometries}
        return replace(self, mass=mass, thickness=thickness, **compared)


def best_candidate(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate whose twins are nearest to the scan; None where nothing grew.

    Stationarity reads a phase field's law off its equation. It is the best one where its twins are farther by no more
    than the distance between two twins of the nearest.
    """
    grown = [(candidate.distance, candidate) for candidate in candidates if candidate.distance is not None]
    if not grown:
        return None
    # Twins of one law differ by the noise of their starts, so that a smaller distance within that noise says nothing;
    # then the law that follows from the field's own equation is the one to believe.
    least, nearest = min(grown, key=itemgetter(0))
    limit = least + (nearest.seed_noise or 0.0)
    return next((law for distance, law in grown if law.name == "stationarity" and distance <= limit), nearest)


def seed_noise_of(candidates: Sequence[Candidate]) -> float | None:
    """Return the distance between two twins of the best candidate; of another one where it has fewer than two."""
    best = best_candidate(candidates)
    if best is not None and best.seed_noise is not None:
        return best.seed_noise
    return next((candidate.seed_noise for candidate in candidates if candidate.seed_noise is not None), None)


@dataclass(frozen=True, eq=False)
class Twin:
    """A shape grown from a law, or the reason why none grew.

    `phase` and `mass` are the shape's own; `diagram` and `morphometry` are measured of it as the scan would show it,
    with its blur and noise.
    """

    phase: np.ndarray | None
    mass: float
    diagram: Diagram | None
    morphometry: Morphometry | None
    reason: str = ""


def twin(law: Candidate, prepared: Prepared, seed: int, schedule: Schedule | str = LEARNED) -> Twin:
    """Grow a shape of a law in a box as many thicknesses long as the scan's main window, within `EDGES`.

    A match to a mask or an image has another mass than the scan: its shape is grown at the structure's volume fraction
    (`Prepared.true_volume_fraction`), or at the law's own mass where nothing grows at that.
    """
    ratio = 1.0 if law.thickness is None else law.thickness / prepared.thickness
    z, y, x = (int(np.clip(ratio * (edge.stop - edge.start), *EDGES)) for edge in prepared.window)
    grid = Grid((z, y, x), prepared.grid.spacing, "periodic")
    options = {"schedule": schedule, "seed": seed, "reject_early": True}
    if law.name == "match" and prepared.kind != "field":
        fraction = prepared.true_volume_fraction
        flow = generate(law.coefficients, law.mass, grid, volume_fraction=fraction, **options)
        if (grown := _measure_twin(flow, prepared, seed)).phase is not None:
            return grown
    return _measure_twin(generate(law.coefficients, law.mass, grid, **options), prepared, seed)


def _measure_twin(flow: Flow, prepared: Prepared, seed: int) -> Twin:
    """Measure the shape that a flow ended with as the scan would show it; without a shape, return the reason."""
    if not flow.viability.viable:
        return Twin(None, flow.mass, None, None, flow.viability.reason)
    field = flow.field.numpy()
    try:
        seen = prepared.scan_alike(field, seed)
        curvature = scan_diagram(seen)
    except ValueError as error:
        return Twin(None, flow.mass, None, None, str(error))
    figures = morphometry(seen.mask, seen.working_voxel, seen.unit, periodic=seen.grid.periodic)
    return Twin(field, flow.mass, curvature, figures)


@dataclass(frozen=True)
class Misfit:
    """How unusual a scan is among shapes of laws from which neither emulator nor discriminant has learnt.

    Attributes
    ----------
    probability
        The p of both tests together (`join_tests`).
    unexplained
        The fraction of shapes of which the emulator's best parameters leave as much unexplained.
    discriminant
        The fraction of shapes that look as much like textures of no law; None where the posterior cannot say.
    grain
        The step in which the probability comes: what it was ranked among is finite.
    """

    probability: Annotated[float, Rule(least=0, most=1)]
    unexplained: Annotated[float, Rule(least=0, most=1)]
    discriminant: Annotated[float | None, Rule(least=0, most=1)] = None
    grain: Annotated[float, Rule(least=0, most=1)] = 0.0

    @property
    def rating(self) -> str:
        """What a verdict begins with; a probability nearer to `UNBELIEVABLE` than its grain is `UNDECIDED`."""
        if self.probability < UNBELIEVABLE:
            return UNBELIEVED
        return SUPPORTED if self.probability >= UNBELIEVABLE + self.grain else UNDECIDED

    def __str__(self) -> str:
        """Whether the scan looks like a shape of the model, in a sentence, and what to use if not."""
        p = format_number(self.probability, 2)
        if self.rating == SUPPORTED:
            return f"The scan looks as shapes of laws do (p = {p})."
        if self.rating == UNDECIDED:
            return f"p = {p} is too near to {UNBELIEVABLE:g} for a test that knows it in steps of {self.grain:.2g}."
        # Either is one of two joined tests, so that its probability is doubled here as it is there.
        unlike = self.discriminant is not None and join_tests(1.0, self.discriminant) < UNBELIEVABLE
        reason = "it looks more like textures that no law makes" if unlike else "no law explains its numbers"
        return f"The scan does not look as shapes of laws do (p = {p}): {reason}. {LAWLESS}"


def join_tests(*probabilities: float) -> float:
    """Return the probability of several tests together: the least times their number, at most 1 (Bonferroni)."""
    return min(1.0, len(probabilities) * min(probabilities))


# ---- the verdict -----------------------------------------------------------------------------------------------------


def verdict(
    candidates: Sequence[Candidate], misfit: Misfit | None, scan: Morphometry, *, grown: bool = True
) -> tuple[str | None, str]:
    """Return the name of the best supported law of a scan, and the verdict on it; no name where nothing grew.

    The misfit alone decides whether a law is believable; one that is not is still named, as the nearest there is.
    `grown` says whether shapes were.
    """
    reason = UNASKED if misfit is None else str(misfit)
    if not grown:
        law = f"{UNTESTED} ({TITLES[candidates[0].name]}): no shape was grown (--test grows some)."
        return candidates[0].name, _join(law, reason)
    best = best_candidate(candidates)
    if best is None or best.distance is None:
        return None, _join("No law: nothing grew from any candidate.", candidates[0].status)
    noise = seed_noise_of(candidates)
    distances = f"its twins lie {best.distance:.1f} from the scan's curvature diagram"
    distances += f", {noise:.1f} from each other." if noise else "."
    rating = UNDECIDED if misfit is None else misfit.rating
    differences = ", ".join(find_differences(scan, best.twins))
    ratios = f"Twins over scan: {differences}." if differences else ""
    return best.name, _join(f"{rating} ({TITLES[best.name]}): {distances}", reason, ratios, best.status)


def _join(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


def find_differences(scan: Morphometry, twins: Sequence[Morphometry]) -> list[str]:
    """Describe the familiar numbers that are greater, or smaller, in all twins than in the scan, by over `NEAR`.

    Connectivities are counts of bodies and tunnels: by chance two counts differ by up to twice the root of their sum.
    """
    differences = []
    for label, name in FAMILIAR.items():
        scan_value = getattr(scan, name)
        ratios = np.array([getattr(twin, name) / scan_value for twin in twins] if scan_value else [])
        count = abs(1 - scan.euler) if name == "connectivity_density" else math.inf
        tolerance = np.maximum(NEAR, 2 * np.sqrt((1 + np.abs(ratios)) / max(count, 1)))
        if len(ratios) and ((ratios > 1 + tolerance).all() or (ratios < 1 - tolerance).all()):
            ratio = float(ratios.mean())
            differences.append(f"{label} of the other sign" if ratio < 0 else f"{label} {format_number(ratio, 2)}")
    return differences
