"""The mask of a scan, or of a network's probabilities: the voxels' -log p and the surface's energy F_ε, lowered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from curvafit.core.checks import check_float, quoted
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.generation.problem import Evidence
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import LawLike
from curvafit.scan.grids import box_with_most_surface
from curvafit.scan.structure import check_options
from curvafit.segmentation.evidence import GreyEvidence, VolumeEvidence, load_probabilities, probability_evidence
from curvafit.segmentation.flow import BENDING, HALO, Working, WorkingGrid, bending
from curvafit.segmentation.result import Segmentation, flow_summary
from curvafit.segmentation.slices import check_spacing, load_with, require_labels
from curvafit.segmentation.tiles import LoweredVolume, Problem, cut_tiles, lower_volume
from curvafit.segmentation.trials import Task, Trial, choose_by_masks, law_of
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Box, ScanError, Volume, check_finite, lay

#: The law where none is given; `calibrate` also tries it beside those of a prior.
WILLMORE = Coefficients.willmore()
#: What a unit of F_ε of a law with a20 + a02 = 2 costs in a scan whose weight is not given, in nats. They measure grey
#: levels by their own noise, so that one number holds for all: it did best on generated textures of noise 3.
USUAL = 0.3
#: Weights that are tried on an example, in the same unit, and the first of them.
NATS, FIRST = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), 10.0
#: Least and greatest weight.
WEIGHTS = (1e-9, 1e9)
#: Longest edge in voxels of the part of an example on which laws are tried, and the fraction of the time for that.
EDGE, TRIALS = 96, 0.7
#: Fraction of the evidence for the first guess that a mask must keep, where no weight is given.
KEPT = 0.95
#: A note on classes that may be noise.
FAINT = "The classes differ by less than the noise: look at the mask. If the structure is rare, give a threshold."


def segment(
    scan: Source,
    prior: LawLike | None = None,
    *,
    weight: float | None = None,
    probabilities: bool | str = False,
    example: tuple[Source, Source] | Calibration | None = None,
    threshold: float | str = "otsu",
    dark: bool = False,
    working: Working = Working(),
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure of a scan: lower -log p(scan | mask) + λ F_ε from a first guess of the surface.

    Of grey levels under noise the first guess is smoothed, and split at a threshold. Of a network's probabilities p it
    is p > 1/2, and a voxel's evidence is logit p. A network is surer than it is right, and its errors lie side by side:
    its evidence is worth less by a factor that nobody knows. Only λ over this factor matters, and an example tells it.

    Parameters
    ----------
    scan
        Grey levels of two phases with noise, or probabilities of the inside, in [0, 1]: the path of a file, a `Volume`,
        or an array or tensor (Z, Y, X).
    prior
        `Coefficients` with lengths in the scan's unit; a preset's name, in working units of which the smallest voxel
        edge is 0.01; a `fit.json`, whose unit is converted. By default the Willmore energy, or the example's law.
    weight
        λ, in nats per unit of F_ε. For grey levels it is by default 0.6 / (a20 + a02); classes that overlap are then
        measured off the surface, and the first guess is the result where it explains the scan clearly better. Small
        bumps on a plane cost (a20 + a02) / 2 times their Willmore energy (linear terms aside, since ∫κ1κ2 = 0).
    probabilities
        Whether the values are a network's probabilities; or `"logits"`, where they are log-odds log p / (1 - p).
    example
        With probabilities, in place of a weight: those that the same network gives another volume, on which it was not
        trained, and the true mask, which is positive inside; or the `Calibration` by them. A file or an array is read
        as the scan is.
    threshold, dark
        The grey level between the phases, or `"otsu"`; whether the structure is the dark one.
    working, progress
        How the scan is worked on; what is called with a sentence and the share done.
    reading
        Options of reading a file, or the place of an array: spacing, unit, crop and the others of `curvafit.load`; and
        of probabilities `like`, the path of an image of the same voxels that says where they are (by default one that
        lies beside an NPZ file and has its name, as nnU-Net's segmentations do).

    Raises ValueError or FileNotFoundError if an argument is out of range or does not fit the scan, or the prior's unit
    cannot be converted; if there is no such `fit.json`; if probabilities are not in [0, 1], or have neither a weight
    nor an example, or both.
    """
    check_given(probabilities, weight, example, threshold, dark, reading.get("label"))
    if probabilities:
        reading["logits"] = probabilities == "logits"
        return _segment_probabilities(scan, prior, weight, example, working=working, progress=progress, reading=reading)
    volume = load(scan, **reading, lazy=True)
    volume.check_fits()
    grid = WorkingGrid.of(volume, working.epsilon, halo=HALO)
    tiles, head = cut_tiles(grid, volume.shape, working.tile), ""
    trial, notes = _weigh_law(prior, weight, volume, working)
    for tile in tiles:
        check_finite(volume.read(tile), volume.source)
    evidence = GreyEvidence.of(volume, threshold, dark, apart=weight is None)
    doubts = (FAINT,) if evidence.classes.faint and threshold == "otsu" else ()
    if missing := _missing_phase(evidence, tiles):
        raise ScanError(f"the scan shows no {missing}: every voxel is on one side")
    problem = EvidenceProblem(trial, evidence)
    lowered = lower_volume(problem, grid, tiles, working=working, progress=progress)
    if weight is None and not _explains(evidence, lowered.mask, tiles):
        trial, head = replace(trial, law=None), "no prior helps here, the first guess explains the scan better: "
        lowered = lower_volume(EvidenceProblem(trial, evidence), grid, tiles)
    return _describe(volume, lowered, trial, grid, (*notes, *doubts, f"{str(evidence.classes).capitalize()}."), head)


def _segment_probabilities(
    scan: Source, prior: LawLike | None, weight: float | None, example: tuple[Source, Source] | Calibration | None, *,
    working: Working, progress: Progress, reading: dict[str, Any],
) -> Segmentation:  # fmt: skip
    """Return the mask of a network's probabilities; the law's weight is given, or an example chooses law and weight."""
    # `label` is the example's alone, `like` and `crop` are the scan's.
    scan_reading = {name: value for name, value in reading.items() if name != "label"}
    volume = load(load_probabilities(scan, **scan_reading), lazy=True)
    volume.check_fits()
    grid = WorkingGrid.of(volume, working.epsilon, halo=HALO)
    tiles, head = cut_tiles(grid, volume.shape, working.tile), ""
    if example is None:
        trial, notes = _weigh_law(prior, weight, volume, working)
    else:
        if not isinstance(example, Calibration):
            example_reading = {name: value for name, value in reading.items() if name not in ("like", "crop")}
            trials, progress = sub_progress(progress, 0.0, TRIALS), sub_progress(progress, TRIALS, 1.0)
            example = calibrate(*example, prior, working=working, progress=trials, **example_reading)
        check_spacing(example.example, volume, "the probabilities")
        trial, notes, head = example.trial, example.notes, f"{example}; "
    likely = volume.load()
    evidence = probability_evidence(likely)
    notes = (*notes, f"Probabilities from {likely.values.min():.3g} to {likely.values.max():.3g}.")
    without_surface = trial.law is not None and _missing_phase(evidence, tiles)  # there is nothing to lower then
    problem = EvidenceProblem(replace(trial, law=None) if without_surface else trial, evidence)
    lowered = lower_volume(problem, grid, tiles, working=working, progress=progress)
    return _describe(volume, lowered, trial, grid, notes, head)


def _weigh_law(
    prior: LawLike | None, weight: float | None, volume: Volume, working: Working
) -> tuple[Trial, tuple[str, ...]]:
    """Return the law to lower with its weight, by default `USUAL`, and notes on its origin."""
    law, notes = law_of(WILLMORE if prior is None else prior, volume)
    if prior is None:
        notes = ("No prior is given: the Willmore energy is lowered.",)
    stiffness = bending(law)  # refuses a law before the work
    return Trial(law, USUAL if weight is None else weight * stiffness / BENDING, working.steps), notes


def _describe(
    volume: Volume, lowered: LoweredVolume, trial: Trial, grid: WorkingGrid, notes: tuple[str, ...], head: str
) -> Segmentation:
    """Return the result with its status, which begins with `head`."""
    return Segmentation.of(
        volume, lowered.mask, lowered.phase, trial.law, grid.epsilon, (*notes, *grid.notes),
        weight=None if trial.law is None else trial.strength * BENDING / bending(trial.law),
        status=f"{head}{flow_summary(float(lowered.mask.mean()), lowered.energies, lowered.steps)}",
    )  # fmt: skip


def check_given(
    probabilities: bool | str,
    weight: float | None,
    example: object,
    threshold: float | str,
    dark: bool,
    label: int | None = None,
) -> None:
    """Raise ScanError where options of `segment` do not go together, or are out of range."""
    check_options("image", threshold)
    if weight is not None:
        check_float(weight, "a positive weight", *WEIGHTS)
    if not probabilities:
        if example is not None:
            raise ScanError("an example goes with a network's probabilities, not with grey levels")
        return
    if probabilities not in (True, "logits"):
        raise ScanError(f"probabilities must be True, False or 'logits', got {quoted(probabilities)}")
    if threshold != "otsu" or dark:
        raise ScanError("a threshold and dark split grey levels: leave them out for probabilities")
    if (example is None) == (weight is None):
        got = "neither" if weight is None else "both"
        raise ScanError(f"give probabilities an example, on which law and weight are judged, or a weight, got {got}")
    if label is not None and example is None:
        raise ScanError("a label chooses the voxels of an example's mask: give an example, or leave the label out")


@dataclass(frozen=True, eq=False)
class EvidenceProblem(Problem):
    """-log p(data | mask) + λ F_ε, to be lowered from the evidence's first guess, which is the result without a law.
    The trial's strength is λ, in nats per unit of F_ε if a20 + a02 = 2."""

    evidence: VolumeEvidence

    @property
    def inputs(self) -> dict[str, object]:
        return {"evidence": self.evidence.digest, "nats": self.trial.strength}

    def terms(self, box: Box, grid: WorkingGrid) -> tuple[np.ndarray, Evidence]:
        evidence, nats = self.evidence.of_box(box), self.trial.strength or 1.0  # 0 where there is no law
        return evidence.level, Evidence(grid.spread(evidence.ratio) / (nats * grid.grid.voxel_volume))


def _explains(evidence: VolumeEvidence, mask: np.ndarray, tiles: Sequence[Box]) -> bool:
    """Return whether a mask keeps nearly all the evidence that the first guess has for its rarer phase. A mask that
    lost thin structures, or pores, does not."""
    kept, guessed, voxels = np.zeros((3, 2))  # of the structure and the background
    for tile in tiles:
        part = evidence.of_box(tile)
        for sums, inside in ((kept, mask[tile] > 0), (guessed, part.level > 0)):
            sums += [part.ratio[inside].sum(dtype=np.float64), -part.ratio[~inside].sum(dtype=np.float64)]
        voxels += [np.count_nonzero(part.level > 0), np.count_nonzero(part.level <= 0)]
    rarer = int(voxels.argmin())
    return bool(kept[rarer] >= KEPT * guessed[rarer] and 0 < mask.mean() < 1)


def _missing_phase(evidence: VolumeEvidence, tiles: Sequence[Box]) -> str:
    """Return the name of the phase that the first guess lacks, or "" where it has both."""
    structure, background = False, False
    for tile in tiles:
        inside = evidence.of_box(tile).level > 0
        structure, background = structure or bool(inside.any()), background or not inside.all()
        if structure and background:  # the remaining tiles need not be read
            return ""
    return "background" if structure else "structure"


@dataclass(frozen=True)
class Calibration:
    """The law and weight that an example chose for a network's probabilities.

    `trial` has the law, or none where p > 1/2 is better; its strength, in nats per unit of F_ε; and the Dice with it
    and without. `fitted` says whether the law is one of the prior's, rather than the Willmore energy. `example` holds
    the example's probabilities, whose voxel size later ones must have; `notes` are on the origin of the prior.
    """

    trial: Trial
    fitted: bool
    example: Volume
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


def calibrate(
    probabilities: Source,
    mask: Source,
    prior: LawLike | None = None,
    *,
    label: int | None = None,
    working: Working = Working(),
    progress: Progress = silent,
    **reading: Any,
) -> Calibration:
    """Choose the law and weight that bring a network's probabilities nearest to a true mask, for `segment`.

    The law of a prior and the Willmore energy are tried at weights over decades, on the part of 96³ voxels that holds
    most of the surface. Where none has a better Dice than p > 1/2 beyond the noise, the choice is p > 1/2.

    `label` is the value of the structure in the mask. See `segment` for the other parameters, and for errors.
    """
    field = load_probabilities(probabilities, **reading)
    truth = load_with(mask, reading, label=label)
    truth, place_notes = lay(truth, field, "the mask", "the probabilities", exact=True)
    inside = require_labels(truth.values, "the example") > 0
    if inside.all() or not inside.any():
        state = "full" if inside.all() else "empty"
        raise ScanError(f"the example must have voxels inside and outside, but is {state}")
    if prior is None:
        from curvafit.inference.inference import infer  # takes long to import

        prior = infer(truth, kind="mask", growth=None, progress=progress)
    law, notes = law_of(prior, field)
    tried = (law,) if law == WILLMORE else (law, WILLMORE)
    for candidate in tried:
        bending(candidate)  # refuses a law before the work
    probability_evidence(field)  # refuses values outside [0, 1] beyond the part, too
    box = box_with_most_surface(inside, EDGE)
    part = replace(field, array=field.values[box])
    grid = WorkingGrid.of(part, working.epsilon, halo=HALO)
    tiles = cut_tiles(grid, part.shape)
    count, expected = 0, 2 * len(tried) + 3  # an estimate: each law at two strengths, and a few more

    def fill(evidence: VolumeEvidence, trial: Trial) -> np.ndarray:
        nonlocal count
        count += 1
        progress("trying the prior out", min(count / expected, 1.0))
        try:
            return lower_volume(EvidenceProblem(trial, evidence), grid, tiles).mask
        except ScanError:  # the energy does not stay finite: the trial scores as an empty mask
            return np.zeros(part.shape, dtype=bool)

    task = Task(probability_evidence(part), inside[box], range(part.shape[0]))
    first = [Trial(candidate, FIRST, working.steps) for candidate in tried]  # a trial's strength is the weight, in nats
    best = choose_by_masks(task, first, fill, NATS)
    return Calibration(best, best.law == law, field, (*notes, *truth.notes, *place_notes))
