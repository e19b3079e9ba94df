"""A network's probabilities and the energy F_ε of the surface: a better mask, and nothing is trained."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import SEEDS, check_float, check_int, quoted
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers
from curvafit.generation.data import Evidence
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import LawLike
from curvafit.segmentation.engine import BENDING, STEPS, WorkingGrid, bending, laws_of, likelihood
from curvafit.segmentation.evidence import VoxelEvidence, probability_evidence
from curvafit.segmentation.result import Segmentation, flow_summary
from curvafit.segmentation.segment import TRIALS, WEIGHTS, WILLMORE
from curvafit.segmentation.slices import box_with_most_surface, check_place, check_spacing, require_labels
from curvafit.segmentation.tiles import Tiling, lower_volume
from curvafit.segmentation.trials import Task, Trial, choose_by_masks
from curvafit.volumes.boxes import digest_of
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.formats.part import Box, Crop
from curvafit.volumes.read import Source, field_of, place_of

#: The plain way from probabilities to a mask.
PLAIN = "p > 1/2"
#: Weights that are tried, in nats of a unit of the Willmore energy, and the first of them.
NATS, FIRST = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), 10.0
#: Longest edge in voxels of the part of an example on which laws and weights are tried.
EDGE = 96
#: Images that may lie beside an NPZ file of the same name and say where its voxels are.
IMAGES = (".nii.gz", ".nii", ".nrrd", ".mha", ".mhd", ".tif", ".tiff")


@dataclass(frozen=True)
class Calibration:
    """What an example says of a prior for a network's probabilities.

    Attributes
    ----------
    trial
        The law and its strength in nats of a unit of the Willmore energy, or p > 1/2; and the Dice of both.
    fitted
        Whether the law is one of the prior's, rather than the Willmore energy.
    example
        The example's probabilities, whose voxels are as large as those of the maps that are refined.
    """

    trial: Trial
    fitted: bool
    example: Field

    def __str__(self) -> str:
        best = self.trial
        if best.law is None:
            return f"no prior helps here: Dice {best.plain:.3f} on the example, {best.score:.3f} with the best prior"
        name = "the prior helps" if self.fitted else "the Willmore energy helps, more than the prior"
        gain = f"{best.score:.3f} on the example, {best.plain:.3f} without, ± {best.noise:.3f}"
        return f"{name}, at {best.strength:g} nats: Dice {gain}"

    def as_dict(self) -> dict[str, Any]:
        """Return what was chosen and what it gained, for a record."""
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
    prior: LawLike,
    *,
    example: tuple[Source, Source] | Calibration | None = None,
    weight: float | None = None,
    label: int | None = None,
    epsilon: float | None = None,
    steps: int = STEPS,
    tile: int | None = None,
    store: str | os.PathLike[str] | None = None,
    workers: Workers | None = None,
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
        As in `segment`.
    example
        The same network's probabilities for another volume, on which it was not trained, and the true mask, which is
        positive inside; or the `Calibration` by them. A file or an array is read as `probabilities` is.
    weight
        λ, in nats per unit of F_ε, in place of an example: the first law is lowered, whether that helps or not.
    label
        The voxels of the example's mask that are the structure have this value.
    epsilon, steps, tile, store, workers, progress
        As in `segment`.
    reading
        Options of reading a file, or the place of an array: `like`, the path of an image of the same voxels that says
        where they are (by default one that lies beside an NPZ file and has its name, as nnU-Net's segmentations do);
        spacing, unit, channel and the others of `curvafit.load`.

    Raises
    ------
    ValueError
        If there is neither an example nor a weight, or both; if the probabilities are not within [0, 1], or the
        example's mask lies elsewhere or has no inside or outside; or as `segment`.
    FileNotFoundError
        If there is no such file.
    """
    check_judge(example, weight)
    field = load_probabilities(probabilities, **reading)
    evidence, tiling = probability_evidence(field), Tiling.of(field, epsilon, tile)
    laws, notes = laws_of(prior, field)
    said = ""
    if example is None:
        strength = check_float(weight, "a positive weight", *WEIGHTS) * bending(laws[0]) / BENDING
        trial = Trial(PLAIN, laws[0], strength, steps)
    else:
        if not isinstance(example, Calibration):
            alike = {name: value for name, value in reading.items() if name not in ("like", "crop")}
            other, truth = load_probabilities(example[0], **alike), _load_truth(example[1], label, alike)
            check_spacing(other, field, "the probabilities")
            trials, progress = sub_progress(progress, 0.0, TRIALS), sub_progress(progress, TRIALS, 1.0)
            example = calibrate(other, truth, prior, epsilon=epsilon, steps=steps, progress=trials)
        check_spacing(example.example, field, "the probabilities")
        trial, said = example.trial, f"{example}; "
    found = lower_volume(RefineProblem(evidence, trial), tiling, store=store, workers=workers, progress=progress)
    notes = (*notes, f"{evidence.note[0].upper()}{evidence.note[1:]}.", *tiling.place.notes)
    return Segmentation.of(
        field, found.mask, found.phase, notes,
        weight=None if trial.law is None else trial.strength * BENDING / bending(trial.law),
        coefficients=trial.law, epsilon=tiling.place.epsilon, status=f"{said}{flow_summary(found)}",
    )  # fmt: skip


def calibrate(
    probabilities: Source,
    mask: Source,
    prior: LawLike,
    *,
    label: int | None = None,
    epsilon: float | None = None,
    steps: int = STEPS,
    progress: Progress = silent,
    **reading: Any,
) -> Calibration:
    """Return the law and weight that bring a network's probabilities nearest to a true mask, for `refine`.

    A part of 96³ voxels that holds most of the surface is judged by Dice. See `refine` for the parameters and errors.
    """
    field, truth = load_probabilities(probabilities, **reading), _load_truth(mask, label, reading)
    check_place(truth, field)
    inside = require_labels(truth.values, "an example") > 0
    if inside.all() or not inside.any():
        state = "a full" if inside.all() else "an empty"
        raise ScanError(f"expected an example with voxels inside and outside, got {state} mask")
    laws, _ = laws_of(prior, field)
    tried = (*laws, *({WILLMORE} - set(laws)))
    for law in laws:
        bending(law)
    probability_evidence(field)
    where = box_with_most_surface(inside, (EDGE, EDGE, EDGE))
    box = replace(field, values=field.values[where])
    tiling = Tiling.of(box, epsilon)
    count, expected = 0, 2 * len(tried) + 3

    def fill(evidence: VoxelEvidence, trial: Trial) -> np.ndarray:
        nonlocal count
        count += 1
        progress("trying the prior out", min(count / expected, 1.0))
        try:
            return lower_volume(RefineProblem(evidence, trial), tiling).mask
        except ScanError:  # the energy does not stay finite
            return np.zeros(box.shape, dtype=bool)

    task = Task(probability_evidence(box), inside[where], range(box.shape[0]))
    best = choose_by_masks(task, lambda way: [Trial(way, law, FIRST, steps) for law in tried], fill, (PLAIN,), NATS)
    return Calibration(best, best.law in laws, field)


class Refine:
    """A callable that refines one class of a network's probabilities, for MONAI's `Compose` after the softmax.

    Parameters
    ----------
    prior, weight, epsilon, steps
        As in `refine`.
    example
        Probabilities and true mask (Z, Y, X) of another volume, which are tried out now; or a `Calibration`.
    channel
        The class, counted from 0.
    spacing, unit
        Voxel edges along the tensor's three axes, or one for all, and their unit.

    Raises
    ------
    ValueError
        As `refine`.
    """

    def __init__(
        self,
        prior: LawLike,
        *,
        weight: float | None = None,
        example: tuple[Source, Source] | Calibration | None = None,
        channel: int = 1,
        spacing: Sequence[float] | float = 1.0,
        unit: str = "voxel",
        epsilon: float | None = None,
        steps: int = STEPS,
    ) -> None:
        check_judge(example, weight)
        self.channel = check_int(channel, "a channel that is a whole number from 0", 0, SEEDS)
        self.place = {"spacing": spacing, "unit": unit}
        if isinstance(example, tuple):
            example = calibrate(*example, prior, epsilon=epsilon, steps=steps, **self.place)
        self.prior, self.example = prior, example
        self.options = {"weight": weight, "epsilon": epsilon, "steps": steps}

    def __call__(self, probabilities: Tensor) -> Tensor:
        """Return the mask (1, Z, Y, X) of probabilities (C, Z, Y, X), 0 and 1, of their type and on their device.

        Raises
        ------
        ValueError
            If the probabilities are not a tensor of four axes with such a channel, or as `refine`.
        """
        if not isinstance(probabilities, Tensor) or probabilities.ndim != 4:
            got = tuple(probabilities.shape) if isinstance(probabilities, Tensor) else quoted(probabilities)
            raise ScanError(f"expected probabilities (C, Z, Y, X) as a tensor, got {got}")
        if self.channel >= len(probabilities):
            raise ScanError(f"expected a channel from 0 to {len(probabilities) - 1}, got {self.channel}")
        field = field_of(probabilities[self.channel].as_subclass(Tensor), **self.place)
        found = refine(field, self.prior, example=self.example, **self.options)
        mask = torch.zeros_like(probabilities[:1])
        mask[0] = torch.from_numpy(found.mask.values)
        return mask


@dataclass(frozen=True, eq=False)
class RefineProblem:
    """The evidence of probabilities, and a trial; where they have no surface, they stay. See `tiles.Problem`."""

    evidence: VoxelEvidence
    trial: Trial

    @property
    def law(self) -> Coefficients | None:
        inside = self.evidence.level > 0
        return None if inside.all() or not inside.any() else self.trial.law

    @property
    def steps(self) -> int:
        return self.trial.steps

    @property
    def parts(self) -> dict[str, object]:
        return {"probabilities": digest_of(self.evidence.ratio), "nats": self.trial.strength}

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Evidence]:
        evidence = replace(self.evidence, ratio=self.evidence.ratio[box], level=self.evidence.level[box])
        nats = FIRST if self.law is None else self.trial.strength  # a start alone has no weight
        return evidence.level, likelihood(evidence, nats, place)

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        return 2 * level  # the level is p - 1/2

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        return phase > 0


def check_judge(example: object, weight: float | None) -> None:
    """Raise ScanError unless there is either an example or a weight."""
    if (example is None) == (weight is None):
        got = "neither" if weight is None else "both"
        raise ScanError(f"expected either an example, on which law and weight are judged, or a weight, got {got}")


def load_probabilities(
    source: Source,
    *,
    like: str | os.PathLike[str] | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    crop: Crop | None = None,
    **reading: Any,
) -> Field:
    """Return a network's probabilities at their place: that of an image of the same voxels, where there is one.

    See `refine` for the parameters.

    Raises
    ------
    ScanError
        If the image has another shape, or both an image and a spacing or unit are given.
    FileNotFoundError
        If there is no such file.
    """
    stated = spacing is not None or unit is not None
    if like is not None and stated:
        raise ScanError("expected either an image that says where the voxels are, or a spacing and unit, got both")
    image = find_image(source) if like is None and not stated else like
    if image is None:
        return field_of(source, spacing=spacing, unit=unit, crop=crop, **reading)
    place = place_of(image)
    field = field_of(source, spacing=place.spacing, unit=place.unit, **reading)
    if field.shape != place.shape:
        raise ScanError(f"expected probabilities with the shape {place.shape} of {image}, got {field.shape}")
    field = replace(field, affine=place.affine, notes=(*field.notes, f"The voxels are those of {image}."))
    return field if crop is None else field.crop(crop)


def find_image(source: Source) -> Path | None:
    """Return the image beside an NPZ file that has its name, None where there is none or the source is another."""
    if not isinstance(source, str | os.PathLike) or not os.fspath(source).lower().endswith(".npz"):
        return None
    stem = os.fspath(source)[: -len(".npz")]
    return next((Path(stem + suffix) for suffix in IMAGES if Path(stem + suffix).is_file()), None)


def _load_truth(mask: Source, label: int | None, reading: dict[str, Any]) -> Field:
    """Return an example's mask, read with the spacing and unit of its probabilities."""
    placed = {} if isinstance(mask, Field) else {name: reading.get(name) for name in ("spacing", "unit")}
    return field_of(mask, label=label, **placed)
