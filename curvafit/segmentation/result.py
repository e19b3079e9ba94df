"""The result of a segmentation, and how its flow ended in words."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from curvafit.core.pictures import Pictured
from curvafit.core.units import sampling
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.lowering import Lowered
from curvafit.volumes.field import Field

__all__ = ["Segmentation", "Uncertainty", "ending", "filled", "result_of"]

#: A flow has settled where its last ten steps lower the energy by less than this share.
SETTLED = 0.001


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What several runs say of a volume between known slices.

    Attributes
    ----------
    probability
        The probability of the inside, float32, with the scan's grid, spacing, unit and affine; 0 or 1 on known slices.
    seeds
        The seed of each run.
    calibration_error
        By how much shares inside differ from probabilities, on average, within 3 voxels of the surface, on the slices
        that the probabilities were calibrated on.
    suggestions
        Numbers of the slices to annotate next, the most telling first.
    """

    probability: Field
    seeds: tuple[int, ...]
    calibration_error: float
    suggestions: tuple[int, ...]


@dataclass(frozen=True, repr=False, eq=False)
class Segmentation(Pictured):
    """A mask, with its phase field, its energy and its status.

    Attributes
    ----------
    mask, phase
        The mask, bool, and the phase field u, float32, with the scan's grid, spacing, unit and affine.
    weight
        λ, in nats per unit of F_ε; None for a reconstruction from known slices.
    coefficients, epsilon
        The coefficients of F_ε and ε, with lengths in the scan's unit; no coefficients where no prior helps.
    status
        A sentence: what a prior gained, whether the flow settled, and which share of the volume is inside.
    notes
        Sentences on the evidence and on assumptions.
    uncertainty
        The probability of the inside, and what to annotate next, of a reconstruction with several runs.
    labels
        Of several structures, which one is at each voxel, 0 where there is none: whole numbers.
    """

    mask: Field
    phase: Field
    weight: float | None
    coefficients: Coefficients | None
    epsilon: float
    status: str
    notes: tuple[str, ...]
    uncertainty: Uncertainty | None = None
    labels: Field | None = None

    @property
    def probability(self) -> Field | None:
        """The probability of the inside, of a reconstruction with several runs."""
        return None if self.uncertainty is None else self.uncertainty.probability

    def __repr__(self) -> str:
        mask = self.mask.values
        count = f"{np.count_nonzero(mask)} inside ({100 * mask.mean():.3g} %)"
        size = sampling(self.mask.shape, self.mask.spacing, self.mask.unit)
        return f"Segmentation({size}, {count}: {self.status})"


def ending(found: Lowered) -> str:
    """Return whether a flow settled, and which share of the volume is inside, as a sentence."""
    share, energy = float(found.mask.mean()), found.energies
    fall = (energy[0] - energy[-1]) / max(abs(energy[-1]), 1e-30) if len(energy) > 1 else 1.0
    count, word = found.steps, "settled" if abs(fall) < SETTLED else "still moving"
    length = f"{count} step" if count == 1 else f"{count} steps"
    if share in (0.0, 1.0):
        return f"no surface is left after {length}: the prior is too strong for the data, lower its weight"
    return f"{word} after {length}: {filled(found.mask)}"


def filled(mask: np.ndarray) -> str:
    """Return which share of the volume is inside, as a sentence."""
    return f"{100 * float(mask.mean()):.2f} % of the volume is inside"


def result_of(
    scan: Field,
    mask: np.ndarray,
    u: np.ndarray,
    *,
    weight: float | None,
    law: Coefficients | None,
    epsilon: float,
    status: str,
    notes: tuple[str, ...],
    uncertainty: Uncertainty | None = None,
) -> Segmentation:
    """Return the segmentation of a scan from its arrays (Z, Y, X)."""
    fields = [replace(scan, values=values, source=scan.source, notes=()) for values in (mask, u)]
    return Segmentation(fields[0], fields[1], weight, law, epsilon, status, (*scan.notes, *notes), uncertainty)
