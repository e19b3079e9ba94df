"""A network's probabilities and the energy F_ε of the surface: a better mask without training."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from curvafit.core.checks import SEEDS, check_float, check_int, quoted
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation.data import Evidence
from curvafit.priors.law import LawLike
from curvafit.scan.grids import box_with_most_surface
from curvafit.segmentation.engine import (
    BENDING,
    STEPS,
    WorkingGrid,
    add_willmore,
    bending,
    infer_law,
    laws_of,
    likelihood,
)
from curvafit.segmentation.evidence import VoxelEvidence, probability_evidence
from curvafit.segmentation.result import Segmentation, flow_summary
from curvafit.segmentation.segment import TRIALS, WEIGHTS
from curvafit.segmentation.slices import check_spacing, require_labels
from curvafit.segmentation.tiles import Problem, Tiling, lower_volume
from curvafit.segmentation.trials import Task, Trial, choose_by_masks
from curvafit.volumes.boxes import digest_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box, Crop
from curvafit.volumes.place import lay
from curvafit.volumes.read import Source, field_of, place_of

#: Weights that are tried, in nats of a unit of F_ε, and the first of them.
NATS, FIRST = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), 10.0
#: Longest edge in voxels of the part of an example on which laws and weights are tried.
EDGE = 96
#: Endings of an image beside an NPZ file of the same name, which says where the voxels are.
IMAGES = (".nii.gz", ".nii", ".nrrd", ".mha", ".mhd", ".tif", ".tiff")


@dataclass(frozen=True)
class Calibration:
    """The law and weight that an example chose for a network's probabilities.

    Attributes
    ----------
    trial
        The law and its strength in nats of a unit of F_ε, or p > 1/2; and the Dice of both.
    fitted
        Whether the law is one of the prior's, rather than the Willmore energy.
    example
        The example's probabilities; maps to refine must have the same voxel size.
    notes
        Sentences on the origin of the prior.
    """

    trial: Trial
    fitted: bool
    example: Field
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        best = self.trial
        if best.law is None:
            return f"no prior helps here: Dice {best.plain:.3f} on the example, {best.score:.3f} with the best prior"
        name = "the prior helps" if self.fitted else "the Willmore energy helps, more than the prior"
        gain = f"{best.score:.3f} on the example, {best.plain:.3f} without, ± {best.noise:.3f}"
        return f"{name}, at {best.strength:g} nats: Dice {gain}"

    def as_dict(self) -> dict[str, Any]:
        """Return the choice and its gain, for a record."""
        best = self.trial
        return {
            "law": None if best.law is None else "prior" if self.fitted else "Willmore",
            "nats": None if best.law is None else best.strength,
            "dice": best.score,
            "dice_without": best.plain,
            "noise": best.noise,
        }


def refine(
    probabilities: Source,
    prior: LawLike | None = None,
    *,
    example: tuple[Source, Source] | Calibration | None = None,
    weight: float | None = None,
    label: int | None = None,
    epsilon: float | None = None,
    steps: int = STEPS,
    tile: int | None = None,
    store: str | os.PathLike[str] | None = None,
    workers: Workers | int | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure in a network's probabilities p: lower Σ r over the outside + λ F_ε from p > 1/2, r = logit p.

    A network is surer than it is right, and its errors lie side by side: the evidence of a voxel is worth τ logit p,
    with a τ that is not known. Only λ / τ matters, and an example tells it: the laws that a fit trusts and the Willmore
    energy are tried there at weights over decades, and where none is better than p > 1/2 beyond the noise, the mask is
    p > 1/2. Where p > 1/2 has no surface, it stays as it is.

    Parameters
    ----------
    probabilities
        The probability of the inside, in [0, 1]: the path of a file, a `Field`, or an array or tensor (Z, Y, X).
    prior
        As in `segment`, by default the law that `infer` finds of the example's mask.
    example
        The same network's probabilities for another volume, on which it was not trained, and the true mask, which is
        positive inside; or the `Calibration` by them. A file or an array is read as `probabilities` is.
    weight
        λ, in nats per unit of F_ε, in place of an example: the first law is lowered, whether that helps or not.
    label
        The value of the structure's voxels in the example's mask.
    epsilon, steps, tile, store, workers, progress
        As in `segment`.
    reading
        Options of reading a file, or the place of an array: `logits`, whether the values are log-odds log p / (1 - p)
        in place of probabilities; `like`, the path of an image of the same voxels that says
        where they are (by default one that lies beside an NPZ file and has its name, as nnU-Net's segmentations do);
        spacing, unit, channel and the others of `curvafit.load`.

    Raises
    ------
    ValueError, FileNotFoundError
        If there is neither an example nor a weight, or both; if the probabilities are not within [0, 1], or the
        example's mask lies elsewhere or has no inside or outside; or as `segment`.
    """
    check_judge(example, weight)
    field = load_probabilities(probabilities, **reading)
    evidence = probability_evidence(field)
    tiling = Tiling.of(field, epsilon, tile)
    gain = ""
    if example is None:
        laws, notes = laws_of(infer_law(None) if prior is None else prior, field)
        strength = check_float(weight, "a positive weight", *WEIGHTS) * bending(laws[0]) / BENDING
        trial = Trial(laws[0], strength, steps)
    else:
        if not isinstance(example, Calibration):
            other, truth = _load_example_beside(field, example, label, reading)
            trials, progress = sub_progress(progress, 0.0, TRIALS), sub_progress(progress, TRIALS, 1.0)
            example = calibrate(other, truth, prior, epsilon=epsilon, steps=steps, progress=trials)
        check_spacing(example.example, field, "the probabilities")
        trial, notes, gain = example.trial, example.notes, f"{example}; "
    found = lower_volume(_pose(evidence, trial), tiling, store=store, workers=workers, progress=progress)
    spread = f"Probabilities from {field.values.min():.3g} to {field.values.max():.3g}."
    return Segmentation.of(
        field, found.mask, found.phase, trial.law, tiling.place.epsilon, (*notes, spread, *tiling.place.notes),
        weight=None if trial.law is None else trial.strength * BENDING / bending(trial.law),
        status=f"{gain}{flow_summary(found)}",
    )  # fmt: skip


def calibrate(
    probabilities: Source,
    mask: Source,
    prior: LawLike | None = None,
    *,
    label: int | None = None,
    epsilon: float | None = None,
    steps: int = STEPS,
    progress: Progress = silent,
    **reading: Any,
) -> Calibration:
    """Choose the law and weight that bring a network's probabilities nearest to a true mask, for `refine`.

    A part of 96³ voxels that holds most of the surface is judged by Dice. See `refine` for the parameters and errors.
    """
    field, truth, inside = _load_example(probabilities, mask, label, reading)
    if inside.all() or not inside.any():
        state = "full" if inside.all() else "empty"
        raise ScanError(f"the example must have voxels inside and outside, but is {state}")
    laws, notes = laws_of(infer_law(truth, progress) if prior is None else prior, field)
    tried = add_willmore(laws)
    for law in tried:
        bending(law)  # refuses a law before the work
    probability_evidence(field)  # refuses values outside [0, 1] beyond the part, too
    where = box_with_most_surface(inside, EDGE)
    part = replace(field, values=field.values[where])
    tiling = Tiling.of(part, epsilon)
    count, expected = 0, 2 * len(tried) + 3

    def fill(evidence: VoxelEvidence, trial: Trial) -> np.ndarray:
        nonlocal count
        count += 1
        progress("trying the prior out", min(count / expected, 1.0))
        try:
            return lower_volume(_pose(evidence, trial), tiling).mask
        except ScanError:  # the energy does not stay finite
            return np.zeros(part.shape, dtype=bool)

    task = Task(probability_evidence(part), inside[where], range(part.shape[0]))
    best = choose_by_masks(task, [Trial(law, FIRST, steps) for law in tried], fill, NATS)
    return Calibration(best, best.law in laws, field, notes + truth.notes)


class Refine:
    """A callable that refines one class of a network's probabilities, for MONAI's `Compose` after the softmax.

    Parameters
    ----------
    prior, weight, epsilon, steps
        As in `refine`, whose errors it raises.
    example
        Probabilities and true mask (Z, Y, X) of another volume, which are tried out now; or a `Calibration`.
    channel
        The class, counted from 0.
    spacing, unit
        Voxel edges along the tensor's three axes, or one for all, and their unit; by default one voxel.
    """

    def __init__(
        self,
        prior: LawLike | None = None,
        *,
        weight: float | None = None,
        example: tuple[Source, Source] | Calibration | None = None,
        channel: int = 1,
        spacing: Sequence[float] | float | None = None,
        unit: str | None = None,
        epsilon: float | None = None,
        steps: int = STEPS,
    ) -> None:
        check_judge(example, weight)
        self.channel = check_int(channel, "a channel that is a whole number from 0", 0, SEEDS)
        self.place = {"spacing": spacing, "unit": unit}
        if prior is None and not isinstance(example, Calibration):
            raise ScanError("give a law, or a calibration")
        if isinstance(example, tuple):
            example = calibrate(*example, prior, epsilon=epsilon, steps=steps, **self.place)
        self.prior, self.example = prior, example
        self.options = {"weight": weight, "epsilon": epsilon, "steps": steps}

    def __call__(self, probabilities: Tensor) -> Tensor:
        """Return the mask (1, Z, Y, X) of probabilities (C, Z, Y, X), 0 and 1, of their type and on their device.

        Raises `ValueError` if the probabilities are not a tensor of four axes with such a channel, or as `refine`.
        """
        if not isinstance(probabilities, Tensor) or probabilities.ndim != 4:
            got = tuple(probabilities.shape) if isinstance(probabilities, Tensor) else quoted(probabilities)
            raise ScanError(f"probabilities must be a tensor (C, Z, Y, X), got {got}")
        if self.channel >= len(probabilities):
            raise ScanError(f"the channel must be from 0 to {len(probabilities) - 1}, got {self.channel}")
        field = field_of(probabilities[self.channel].as_subclass(Tensor), **self.place)
        found = refine(field, self.prior, example=self.example, **self.options)
        mask = torch.zeros_like(probabilities[:1])
        mask[0] = torch.from_numpy(found.mask.values)
        return mask


@dataclass(frozen=True, eq=False)
class RefineProblem(Problem):
    """The evidence of probabilities, and a law whose strength is in nats of a unit of F_ε."""

    evidence: VoxelEvidence

    @property
    def inputs(self) -> dict[str, object]:
        return {"probabilities": digest_of(self.evidence.ratio), "nats": self.trial.strength}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Evidence]:
        evidence = VoxelEvidence(self.evidence.ratio[box], self.evidence.level[box])
        return evidence.level, likelihood(evidence, self.trial.strength or 1.0, place)  # p > 1/2 has no strength

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        return 2 * level  # the level is p - 1/2


def _pose(evidence: VoxelEvidence, trial: Trial) -> RefineProblem:
    """Return the problem of a trial; where p > 1/2 has no surface, nothing is lowered."""
    inside = evidence.level > 0
    return RefineProblem(replace(trial, law=None) if inside.all() or not inside.any() else trial, evidence)


def check_judge(example: object, weight: float | None) -> None:
    """Raise ScanError unless there is either an example or a weight."""
    if (example is None) == (weight is None):
        got = "neither" if weight is None else "both"
        raise ScanError(f"give either an example, on which law and weight are judged, or a weight, got {got}")


def load_probabilities(
    source: Source,
    *,
    like: str | os.PathLike[str] | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    crop: Crop | None = None,
    logits: bool = False,
    **reading: Any,
) -> Field:
    """Load a network's probabilities at the place of `like`, an image of the same voxels, where there is one.

    See `refine` for the parameters. Raises `ScanError` if the image has another shape, or both an image and a spacing
    or unit are given.
    """
    stated = spacing is not None or unit is not None
    if like is not None and stated:
        raise ScanError("give either an image that says where the voxels are, or a spacing and unit, got both")
    image = find_image(source) if like is None and not stated else like
    if image is None:
        return _to_probabilities(field_of(source, spacing=spacing, unit=unit, crop=crop, **reading), logits)
    place = place_of(image)
    field = field_of(source, spacing=place.spacing, unit=place.unit, **reading)
    if field.shape != place.shape:
        raise ScanError(f"the probabilities must have the shape {place.shape} of {image}, got {field.shape}")
    field = replace(field, affine=place.affine, notes=(*field.notes, f"The voxels are those of {image}."))
    return _to_probabilities(field if crop is None else field.crop(crop), logits)


def _to_probabilities(field: Field, logits: bool) -> Field:
    """Return a field of probabilities, of one of log-odds if it is that."""
    return replace(field, values=expit(field.values.astype(np.float32))) if logits else field


def find_image(source: Source) -> Path | None:
    """Return the image beside an NPZ file that has its name; None where there is none, or for another source."""
    if not isinstance(source, str | os.PathLike) or not os.fspath(source).lower().endswith(".npz"):
        return None
    stem = os.fspath(source)[: -len(".npz")]
    return next((Path(stem + suffix) for suffix in IMAGES if Path(stem + suffix).is_file()), None)


def _load_example_beside(
    field: Field, example: tuple[Source, Source], label: int | None, reading: dict[str, Any]
) -> tuple[Field, Field]:
    """Load an example of probabilities, with voxels as large as those of `field`, and its true mask."""
    alike = {name: value for name, value in reading.items() if name not in ("like", "crop")}
    chances, truth, _ = _load_example(*example, label, alike)
    check_spacing(chances, field, "the probabilities")
    return chances, truth


def _load_example(
    probabilities: Source, mask: Source, label: int | None, reading: dict[str, Any]
) -> tuple[Field, Field, np.ndarray]:
    """Load probabilities and the true mask, of their spacing and unit, and return where that is inside, too."""
    field = load_probabilities(probabilities, **reading)
    placed = {} if isinstance(mask, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
    truth = field_of(mask, label=label, **placed)
    truth, laid = lay(truth, field, "the mask", "the probabilities", exact=True)
    truth = replace(truth, notes=truth.notes + laid)
    return field, truth, require_labels(truth.values, "the example") > 0
