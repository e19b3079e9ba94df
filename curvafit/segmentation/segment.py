"""Segmentation without a network: a scan's evidence and the energy F_ε of the surface."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from curvafit.core.checks import check_float
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation.data import Evidence
from curvafit.priors.law import LawLike
from curvafit.scan.grids import count_faces
from curvafit.scan.structure import check_options
from curvafit.segmentation.engine import (
    BENDING,
    STEPS,
    WorkingGrid,
    add_willmore,
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
from curvafit.segmentation.tiles import Problem, Tiling, lower_volume
from curvafit.segmentation.trials import Trial, choose_by_voxels
from curvafit.volumes.boxes import Boxes, boxes_of, check_finite, check_fits, subsample
from curvafit.volumes.field import ScanError
from curvafit.volumes.formats.part import Box, Crop
from curvafit.volumes.read import Source

#: A note on classes that may be noise.
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
    workers: Workers | int | None = None,
    crop: Crop | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure of a scan: lower -log p(scan | mask) + λ F_ε from a smoothed, thresholded start.

    Held-out voxels decide on the law and its weight: the laws that a fit trusts and the Willmore energy are tried, and
    where none predicts the grey levels of these voxels better than the start does, the start is the result. A network's
    probabilities are for `refine`: neighbouring ones are correlated, so that none can be held out.

    Parameters
    ----------
    scan
        Grey levels of two phases with noise: the path of a file, a `Field`, or an array or tensor (Z, Y, X).
    prior
        `Coefficients` with lengths in the scan's unit; or a preset's name, in working units of which the smallest voxel
        edge is 0.01; or the path of a `fit.json`, whose unit is converted.
    weight
        λ, in nats per unit of F_ε, of the prior's own law, of a fit its best one; then nothing is tried out. Small
        bumps on a plane cost (a20 + a02) / 2 times their Willmore energy (linear terms aside, since ∫κ1κ2 = 0).
    threshold, dark
        The grey level between the phases, or `"otsu"`; whether the structure is the dark one.
    epsilon
        ε in the scan's unit; by default twice the smallest voxel edge. Thinner structures do not survive.
    steps
        Steps of Adam.
    tile
        The energy is lowered on overlapping tiles of at most this many working voxels a side, which bounds the memory;
        the result depends on the tiles by a few voxels of the surface at most. By default the scan is one tile up to
        256³ working voxels; larger ones have tiles of 192³.
    store, workers
        Where there are several tiles: a folder for finished ones, with which the same call goes on after a kill, and
        whose mapped files the result's arrays are; and the number of processes that lower tiles, or workers such as
        `curvafit.core.workers.cluster`.
    crop
        A box of voxels: see `curvafit.load`.
    progress
        Called with a sentence and the share done.
    reading
        Options of reading a file, or the place of an array: spacing, unit and the others of `curvafit.load`.

    Raises
    ------
    ValueError, FileNotFoundError
        If an argument is out of range or does not fit the scan, or the prior's unit cannot be converted; if there is no
        such `fit.json`.
    """
    boxes = boxes_of(scan, crop=crop, **reading)
    check_fits(boxes)
    frame = boxes.frame
    laws, notes = laws_of(prior, frame)
    tiling = Tiling.of(frame, epsilon, tile)
    if weight is not None:
        weight = check_float(weight, "a positive weight", *WEIGHTS)
    check_options("image", threshold)
    check_finite(boxes)
    sample, blocks = subsample(boxes)
    levels, bounds = grey_levels(sample, threshold), grey_bounds(sample.values.astype(np.float32), threshold)
    classes = estimate_classes(levels, sample, threshold, dark)
    _check_phases(_GreyEvidence(boxes, bounds, classes), tiling)
    gain, stiffness = "", bending(laws[0])
    if weight is not None:
        trial = Trial(laws[0], stiffness / BENDING * weight, steps)
    else:
        inside = grey_evidence(levels, sample, classes).level > 0
        block = max(blocks, key=lambda block: int(count_faces(inside[block]).sum()))
        trials, progress = sub_progress(progress, 0.0, TRIALS), sub_progress(progress, TRIALS, 1.0)
        trial, classes = choose_by_voxels(
            levels[block], sample.crop(block), classes, add_willmore(laws),
            epsilon=epsilon, steps=steps, remeasure=threshold == "otsu" and classes.faint, progress=trials,
        )  # fmt: skip
        gain = f"{_describe_gain(trial, trial.law in laws)}; "
    if classes.faint and threshold == "otsu" and (weight is not None or trial.law is None):
        notes = (*notes, FAINT)
    problem = ScanProblem(trial, _GreyEvidence(boxes, bounds, classes))
    found = lower_volume(problem, tiling, store=store, workers=workers, progress=progress)
    if weight is None and trial.law is not None:
        weight = trial.strength * BENDING / bending(trial.law)
    notes = (*notes, f"{str(classes).capitalize()}.", *tiling.place.notes)
    return Segmentation.of(
        frame, found.mask, found.phase, trial.law, tiling.place.epsilon, notes,
        weight=weight, status=f"{gain}{flow_summary(found)}",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _GreyEvidence:
    """The evidence of a box of grey levels, clipped to bounds, with known classes."""

    boxes: Boxes
    bounds: tuple[float, float]
    classes: Classes

    def __call__(self, box: Box) -> VoxelEvidence:
        values = self.boxes.part(box).astype(np.float32).clip(*self.bounds)
        return grey_evidence(values, self.boxes.frame, self.classes)


@dataclass(frozen=True, eq=False)
class ScanProblem(Problem):
    """A scan's evidence, and a law whose strength is in nats of a unit of F_ε."""

    evidence: _GreyEvidence

    @property
    def inputs(self) -> dict[str, object]:
        evidence = self.evidence
        return {"scan": evidence.boxes.digest, "evidence": str(evidence.classes), "nats": self.trial.strength}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Evidence]:
        evidence = self.evidence(box)
        return evidence.level, likelihood(evidence, self.trial.strength, place)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        return place.to_scan(initial_field(level, place))


def _check_phases(evidence: _GreyEvidence, tiling: Tiling) -> None:
    """Raise ScanError where the first guess has one phase only; stop at the first tiles that have both."""
    seen: set[bool] = set()
    for tile in tiling.tiles:
        inside = evidence(tile.core).level > 0
        seen |= {bool(inside.any()), bool(inside.all())}
        if len(seen) == 2:
            return
    raise ScanError(f"the scan shows no {'background' if True in seen else 'structure'}: every voxel is on one side")


def _describe_gain(trial: Trial, fitted: bool) -> str:
    """Say which law was chosen, and what it gains, as the beginning of a sentence."""
    share = f"{100 * trial.score:+.2g} ± {100 * trial.noise:.2g} % of the voxels left out are on their side"
    if trial.law is None:
        return f"no prior helps here: with the best {share}"
    law = "the prior helps" if fitted else "the Willmore energy helps, more than the prior"
    return f"{law}, at {trial.strength:g} nats: {share}"
