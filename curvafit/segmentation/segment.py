"""Segmentation without a network: a scan's evidence and the energy F_ε of the surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from curvafit.generation import data
from curvafit.generation.flow import Flow, descend
from curvafit.priors.bounds import real
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.profile import phase_field
from curvafit.progress import Progress, silent
from curvafit.segmentation.evidence import cropped_map, of_intensities, of_probability
from curvafit.segmentation.result import Segmentation, ending, result_of
from curvafit.segmentation.working import Law, WorkingGrid, law_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Crop
from curvafit.volumes.source import Source, field_of

__all__ = ["STEPS", "segment"]

#: Default steps of Adam.
STEPS = 150
#: Cost in nats of a unit of the Willmore energy: best, or nearly, on bone and tubes from little noise to much.
NATS = 1.0
#: Least and greatest weight.
WEIGHTS = (1e-9, 1e9)


def segment(
    scan: Source,
    prior: Law,
    *,
    probability: Source | None = None,
    weight: float | None = None,
    threshold: float | str = "otsu",
    dark: bool = False,
    epsilon: float | None = None,
    steps: int = STEPS,
    crop: Crop | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure of a scan: lower -log p(scan | mask) + λ F_ε from a smoothed, thresholded start.

    Parameters
    ----------
    scan
        Grey levels of two phases with noise: the path of a file, a `Field`, or an array or tensor (Z, Y, X).
    prior
        `Coefficients` with lengths in the scan's unit; or a preset's name, in working units of which the smallest voxel
        edge is 0.01; or the path of a `fit.json`, whose unit is converted.
    probability
        The probability of the inside, in [0, 1], in place of grey levels, `threshold` and `dark`: a volume of the
        scan's shape, at the scan's place where both files state one. A file's map has the scan's `spacing` and `unit`.
    weight
        λ, in nats per unit of F_ε; by default 2 / (a20 + a02). Small bumps on a plane cost (a20 + a02) / 2 times their
        Willmore energy (linear terms aside, since ∫κ1κ2 = 0): with the default, every prior counts as strongly as the
        Willmore energy, and the data count by their noise.
    threshold, dark
        The grey level between the phases, or `"otsu"`; whether the structure is the dark one.
    epsilon
        ε in the scan's unit; by default twice the smallest voxel edge. Thinner structures do not survive.
    steps
        Steps of Adam.
    crop
        A box of voxels, of the scan and of the probability map: see `curvafit.load`.
    progress
        Called with a sentence and the share done.
    reading
        Options of reading a file, or the place of an array: spacing, unit and the others of `curvafit.load`.

    Raises
    ------
    ValueError
        If an argument is out of range or does not fit the scan, or the prior's unit cannot be converted.
    FileNotFoundError
        If there is no such `fit.json`.
    """
    scan = field_of(scan, crop=crop, **reading)
    law, notes = law_of(prior, scan)
    place = WorkingGrid.of(scan, epsilon)
    weight = None if weight is None else real(weight, "a positive weight", *WEIGHTS)
    if not (isinstance(threshold, str) and threshold == "otsu"):
        real(threshold, "a threshold that is a number or 'otsu'")
    if probability is None:
        evidence = of_intensities(scan, threshold, dark)
    elif dark or threshold != "otsu":
        raise ScanError("expected neither a threshold nor dark with a probability map, which says what is inside")
    else:
        placed = {} if isinstance(probability, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
        evidence = of_probability(cropped_map(field_of(probability, **placed), crop), scan)
    start = _started(evidence.level, place)
    stiffness = float(law.a20 + law.a02) / 2
    if stiffness <= 0:
        raise ScanError(f"expected coefficients with a20 + a02 > 0, got {2 * stiffness:g}: surfaces would crumple")
    λ = NATS / stiffness if weight is None else float(weight)
    ratio = place.spread(evidence.ratio) / (λ * stiffness * place.grid.voxel_volume)
    flow = _lowered(start, law.scaled(1 / stiffness), data.Evidence(ratio), place, steps, progress)
    notes = (*notes, f"{evidence.note[0].upper()}{evidence.note[1:]}.", *place.notes)
    u = place.back(flow.field)
    return result_of(scan, u > 0, u, weight=λ, law=law, epsilon=place.epsilon, status=ending(flow, u > 0), notes=notes)


def _started(level: np.ndarray, place: WorkingGrid) -> Tensor:
    """Return the phase field of the set where a smooth volume is positive."""
    inside = place.finer(level) > 0
    if not inside.any() or inside.all():
        raise ScanError(
            f"expected a structure and background in the scan, got {'none' if inside.all() else 'one phase'}"
        )
    return phase_field(inside, place.grid, WORKING_EPSILON)


def _lowered(
    start: Tensor, law: Coefficients, term: data.Data, place: WorkingGrid, steps: int, progress: Progress
) -> Flow:
    def watch(step: int, total: int, state: object) -> None:
        progress("lowering the energy", step / total)

    flow = descend(
        start,
        law.in_unit(place.unit),
        place.grid,
        data=term,
        optimiser="adam",
        steps=steps,
        blur=0.0,
        callbacks=[watch],
    )
    if not flow.finite:
        raise ScanError(f"expected an energy that stays finite, got a flow that {flow.status}: lower the weight")
    return flow
