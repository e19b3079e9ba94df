"""Segmentation without a network: a scan's evidence and the energy F_ε of the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from curvafit.core.checks import check_float
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation.data import Evidence
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import LawLike
from curvafit.segmentation.engine import (
    BENDING,
    STEPS,
    WorkingGrid,
    bending,
    initial_field,
    laws_of,
    likelihood,
)
from curvafit.segmentation.evidence import (
    Classes,
    VoxelEvidence,
    estimate_classes,
    grey_bounds,
    grey_evidence,
    grey_levels,
)
from curvafit.segmentation.result import Segmentation, flow_summary
from curvafit.segmentation.tiles import Tiling, lower_volume
from curvafit.segmentation.trials import Trial, choose_by_voxels, fullest_block
from curvafit.volumes.boxes import Boxes, boxes_of, check_finite, subsample
from curvafit.volumes.field import ScanError
from curvafit.volumes.formats.part import Box, Crop
from curvafit.volumes.read import Source

#: A law that is tried beside the prior's.
WILLMORE = Coefficients.willmore()
#: What is said of classes that may be noise.
FAINT = "The classes differ by less than the noise, as where the structure is rare: better give a threshold."
#: Share of the time that trying laws out takes.
TRIALS = 0.7
#: Least and greatest weight.
WEIGHTS = (1e-9, 1e9)


def segment(
    scan: Source | Boxes,
    prior: LawLike,
    *,
    weight: float | None = None,
    threshold: float | str = "otsu",
    dark: bool = False,
    epsilon: float | None = None,
    steps: int = STEPS,
    tile: int | None = None,
    store: str | PathLike[str] | None = None,
    workers: Workers | None = None,
    crop: Crop | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure of a scan: lower -log p(scan | mask) + λ F_ε from a smoothed, thresholded start.

    Which law is lowered, and with which weight, is decided by grey levels that are left out: those that a fit trusts
    and the Willmore energy are tried, and where none tells them better than the start does, the start is the answer.
    A network's probabilities are for `refine`: none of them can be left out, since neighbouring ones are correlated.

    Parameters
    ----------
    scan
        Grey levels of two phases with noise: the path of a file, a `Field`, or an array or tensor (Z, Y, X).
    prior
        `Coefficients` with lengths in the scan's unit; or a preset's name, in working units of which the smallest voxel
        edge is 0.01; or the path of a `fit.json`, whose unit is converted.
    weight
        λ, in nats per unit of F_ε, for the first law; by default it is chosen, with the law, by voxels left out. Small
        bumps on a plane cost (a20 + a02) / 2 times their Willmore energy (linear terms aside, since ∫κ1κ2 = 0).
    threshold, dark
        The grey level between the phases, or `"otsu"`; whether the structure is the dark one.
    epsilon
        ε in the scan's unit; by default twice the smallest voxel edge. Thinner structures do not survive.
    steps
        Steps of Adam.
    tile
        The energy is lowered on tiles of at most so many working voxels a side, with overlap: memory is bounded, and
        the result does not depend on the tiles beyond a few voxels of the surface. By default the scan is one tile up
        to 256³ working voxels; larger ones have tiles of 192³.
    store, workers
        A folder in which finished tiles stay: the same call goes on with them after a kill, and the result's arrays are
        mapped files there. Whoever lowers the tiles, such as `curvafit.core.workers.cluster`.
    crop
        A box of voxels: see `curvafit.load`.
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
    boxes = boxes_of(scan, crop=crop, **reading)
    frame = boxes.frame
    laws, notes = laws_of(prior, frame)
    tiling = Tiling.of(frame, epsilon, tile)
    if weight is not None:
        weight = check_float(weight, "a positive weight", *WEIGHTS)
    if not (isinstance(threshold, str) and threshold == "otsu"):
        check_float(threshold, "a threshold that is a number or 'otsu'")
    check_finite(boxes)
    sample, blocks = subsample(boxes)
    values, bounds = grey_levels(sample, threshold), grey_bounds(sample.values.astype(np.float32), threshold)
    classes = estimate_classes(values, sample, threshold, dark)
    _check_phases(_Grey(boxes, bounds, classes), tiling)
    law, nats = laws[0], bending(laws[0]) / BENDING * (weight or 0.0)
    chosen: Trial | None = None
    if weight is None:
        block = fullest_block(values, sample, classes, blocks)
        overlap = threshold == "otsu" and classes.faint
        trials, progress = sub_progress(progress, 0.0, TRIALS), sub_progress(progress, TRIALS, 1.0)
        chosen, classes = choose_by_voxels(
            values[block], sample.crop(block), classes, (*laws, *({WILLMORE} - set(laws))),
            epsilon=epsilon, steps=steps, remeasure=overlap, progress=trials,
        )  # fmt: skip
        law, nats = chosen.law, chosen.strength
    if classes.faint and threshold == "otsu" and (chosen is None or chosen.law is None):
        notes = (*notes, FAINT)
    said = str(classes)
    notes = (*notes, f"{said[0].upper()}{said[1:]}.", *tiling.place.notes)
    problem = ScanProblem(_Grey(boxes, bounds, classes), law, nats, steps)
    found = lower_volume(problem, tiling, store=store, workers=workers, progress=progress)
    status = flow_summary(found)
    return Segmentation.of(
        frame, found.mask, found.phase, notes,
        weight=weight if weight is not None or law is None else nats * BENDING / bending(law),
        coefficients=law, epsilon=tiling.place.epsilon,
        status=status if chosen is None else f"{_gain(chosen, laws)}; {status}",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Grey:
    """The evidence of grey levels, cut at bounds, with known classes."""

    boxes: Boxes
    bounds: tuple[float, float]
    classes: Classes

    def __call__(self, box: Box) -> VoxelEvidence:
        values = self.boxes.part(box).astype(np.float32).clip(*self.bounds)
        return grey_evidence(values, self.boxes.frame, self.classes)


@dataclass(frozen=True, eq=False)
class ScanProblem:
    """A scan's evidence, and a law with its weight; see `tiles.Problem`."""

    evidence: _Grey
    law: Coefficients | None
    nats: float
    steps: int

    @property
    def parts(self) -> dict[str, object]:
        evidence = self.evidence
        return {"scan": evidence.boxes.digest, "evidence": str(evidence.classes), "nats": self.nats}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Evidence]:
        evidence = self.evidence(box)
        return evidence.level, likelihood(evidence, self.nats, place)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        return place.to_scan(initial_field(level, place))

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        return phase > 0


def _check_phases(evidence: _Grey, tiling: Tiling) -> None:
    """Raise ScanError where the first guess has one phase only; tiles are looked at until there are both."""
    seen: set[bool] = set()
    for tile in tiling.tiles:
        inside = evidence(tile.core).level > 0
        seen |= {bool(inside.any()), bool(inside.all())}
        if len(seen) == 2:
            return
    raise ScanError(
        f"expected a structure and background in the scan, got {'no background' if True in seen else 'none'}"
    )


def _gain(chosen: Trial, laws: Sequence[Coefficients]) -> str:
    """Return what was chosen and what it gains, as the beginning of a sentence."""
    share = f"{100 * chosen.score:+.2g} ± {100 * chosen.noise:.2g} % of the voxels left out are on their side"
    if chosen.law is None:
        return f"no prior helps here: with the best {share}"
    law = "the prior helps" if chosen.law in laws else "the Willmore energy helps, more than the prior"
    return f"{law}, at {chosen.strength:g} nats: {share}"
