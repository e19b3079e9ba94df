"""Segmentation without a network: a scan's evidence, or a few known slices, and the energy F_ε of the surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from curvafit.generation import data
from curvafit.generation.flow import Flow, descend
from curvafit.pictures import Pictured
from curvafit.priors import kernels
from curvafit.priors.bounds import real, whole
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.profile import optimal_profile, phase_field
from curvafit.progress import Progress, silent
from curvafit.segmentation.evidence import cropped_map, interpolated_distance, of_intensities, of_probability
from curvafit.segmentation.working import Law, WorkingGrid, law_of
from curvafit.units import sampling
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Crop
from curvafit.volumes.source import Source, field_of

__all__ = ["STEPS", "Segmentation", "reconstruct", "segment"]

#: Default steps of Adam.
STEPS = 150
#: Cost in nats of a unit of the Willmore energy: best, or nearly, on bone and tubes from little noise to much.
NATS = 1.0
#: Stiffness of the spring on known slices, in working units: a tenth of it loses them, ten times as much stalls.
STIFFNESS = 1e6

#: Most values of known slices; more are grey levels.
LABELS = 256
#: Least and greatest weight.
WEIGHTS = (1e-9, 1e9)
#: A flow has settled where its last ten steps lower the energy by less than this share.
SETTLED = 0.001


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
        The coefficients of F_ε and ε, with lengths in the scan's unit.
    status
        A sentence: whether the flow settled, and which share of the volume is inside.
    notes
        Sentences on the evidence and on assumptions.
    """

    mask: Field
    phase: Field
    weight: float | None
    coefficients: Coefficients
    epsilon: float
    status: str
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        mask = self.mask.values
        count = f"{np.count_nonzero(mask)} inside ({100 * mask.mean():.3g} %)"
        size = sampling(self.mask.shape, self.mask.spacing, self.mask.unit)
        return f"Segmentation({size}, {count}: {self.status})"


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
    return _result(scan, u > 0, u, law, place, weight=λ, notes=notes, flow=flow)


def reconstruct(
    slices: Source,
    prior: Law,
    *,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    axis: int = 0,
    epsilon: float | None = None,
    steps: int = STEPS,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Fill a volume between known slices: lower F_ε from interpolated signed distances, with these slices held.

    Parameters
    ----------
    slices
        A mask, or labels, of the whole volume's shape, positive inside, as a path, a `Field`, an array or a tensor;
        only the known slices count, and they stay unchanged.
    prior, epsilon, steps, progress, reading
        As in `segment`.
    every, first
        Slices `first`, `first + every`, … along `axis` are known. The volume is extrapolated before the first known
        slice and beyond the last.
    known
        The numbers of the known slices, two or more, in place of `every` and `first`.
    axis
        The axis of the array, 0, 1 or 2, that is z, y or x.

    Raises
    ------
    ValueError
        As `segment`, or if fewer than two slices are known, or the known slices are all empty, all full, or grey
        levels.
    FileNotFoundError
        If there is no such `fit.json`.
    """
    slices = field_of(slices, **reading)
    law, notes = law_of(prior, slices)
    place = WorkingGrid.of(slices, epsilon)
    axis = whole(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    places = _places(slices.shape[axis], every, first, known)
    inside = _labels(np.moveaxis(slices.values, axis, 0)[places]) > 0
    if inside.all() or not inside.any():
        raise ScanError(
            f"expected known slices with voxels inside and outside, got {'full' if inside.all() else 'empty'} ones"
        )
    order = (axis, *(k for k in range(3) if k != axis))
    edges = [slices.spacing[k] for k in order]
    distance = np.moveaxis(interpolated_distance(inside, places, slices.shape[axis], edges), 0, axis)
    start = optimal_profile(place.finer(distance), place.epsilon)
    pull = np.zeros(slices.shape, dtype=np.float32)
    np.moveaxis(pull, axis, 0)[places] = np.where(inside, STIFFNESS, -STIFFNESS)
    spring = data.Hinge(place.spread(pull, centre=axis))
    flow = _lowered(start, law.scaled(1 / _force(law, place, start)), spring, place, steps, progress)
    u = place.back(flow.field)
    mask = u > 0
    np.moveaxis(mask, axis, 0)[places] = inside
    notes = (*notes, *_known(places, slices.shape[axis]), *place.notes)
    return _result(slices, mask, u, law, place, weight=None, notes=notes, flow=flow)


def _places(length: int, every: int | None, first: int, known: Sequence[int] | None) -> list[int]:
    if (every is None) == (known is None):
        raise ScanError("expected either every how many slices are known, or their numbers")
    numbers = [real(n, "whole numbers of slices") for n in ((every, first) if known is None else known)]
    if not all(math.isfinite(number) and number == int(number) for number in numbers):  # type: ignore[arg-type, operator]
        raise ScanError(f"expected whole numbers of slices, got {', '.join(map(str, numbers))}")
    if every is not None and (every < 1 or first < 0):
        raise ScanError(f"expected every from 1 and first from 0, got {every} and {first}")
    places = sorted({int(n) for n in (known if known is not None else range(int(first), length, int(every or 1)))})
    if len(places) < 2 or places[0] < 0 or places[-1] >= length:
        raise ScanError(f"expected two or more known slices within 0 to {length - 1}, got {places}")
    return places


def _known(places: list[int], length: int) -> tuple[str, ...]:
    """Return sentences on the number of known slices, and of slices that are extrapolated."""
    before, beyond = places[0], length - 1 - places[-1]
    outer = f"The {before} before the first and the {beyond} beyond the last are extrapolated."
    return f"{len(places)} of {length} slices are known.", *((outer,) if before or beyond else ())


def _labels(values: np.ndarray) -> np.ndarray:
    """Return the values, or raise ScanError where they are grey levels."""
    if values.dtype.kind == "f" and not np.array_equal(values, np.round(values)):
        raise ScanError("expected known slices with a mask or labels, got values that are not whole numbers")
    if values.dtype.itemsize > 1 and (count := len(np.unique(values))) > LABELS:
        raise ScanError(f"expected known slices with a mask or at most {LABELS} labels, got {count} values")
    return values


def _started(level: np.ndarray, place: WorkingGrid) -> Tensor:
    """Return the phase field of the set where a smooth volume is positive."""
    inside = place.finer(level) > 0
    if not inside.any() or inside.all():
        raise ScanError(
            f"expected a structure and background in the scan, got {'none' if inside.all() else 'one phase'}"
        )
    return phase_field(inside, place.grid, WORKING_EPSILON)


def _force(law: Coefficients, place: WorkingGrid, u: Tensor) -> float:
    """Return the root mean square of ∂F_ε/∂u over that of the Willmore energy, the scale of steps and springs."""
    sizes = []
    for each in (law.in_unit(place.unit), Coefficients.willmore()):
        _, slope = kernels.energy_gradient(u, each, place.grid, WORKING_EPSILON)
        sizes.append(float(slope.double().norm()))
    if not all(0 < size < math.inf for size in sizes):
        raise ScanError("expected coefficients with a force on the start, got none: they are 0, or there is no surface")
    return sizes[0] / sizes[1]


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


def _result(
    scan: Field,
    mask: np.ndarray,
    u: np.ndarray,
    law: Coefficients,
    place: WorkingGrid,
    *,
    weight: float | None,
    notes: tuple[str, ...],
    flow: Flow,
) -> Segmentation:
    share, energy = float(mask.mean()), flow.history.energy
    fall = (energy[-2] - energy[-1]) / max(abs(energy[-1]), 1e-30) if len(energy) > 1 else 1.0
    count, word = int(flow.history.step[-1]), "settled" if abs(fall) < SETTLED else "still moving"
    length = f"{count} step" if count == 1 else f"{count} steps"
    status = f"{word} after {length}: {100 * share:.2f} % of the volume is inside"
    if share in (0.0, 1.0):
        status = f"no surface is left after {length}: the prior is too strong for the data, lower its weight"
    whole = {"notes": (), "source": scan.source}
    return Segmentation(
        replace(scan, values=mask, **whole),
        replace(scan, values=u, **whole),
        weight,
        law,
        place.epsilon,
        status,
        (*scan.notes, *notes),
    )
