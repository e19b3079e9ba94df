"""A volume between known slices: filled by a network, block by block, and by F_ε where a law is better.

The network reads four known slices for each gap, and no more than `REACH` pixels around each pixel: a block with this
margin is filled as the whole would be, and a volume that fits into memory is one block. Three numbers are those of the
whole: the thickness of the structure in known slices, which sets the size of a pixel; the threshold of the probability;
and the expected Dice. All follow from sums over slices or blocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.special import expit

from curvafit.core.checks import require
from curvafit.core.runtime import Progress, check_memory, silent, sub_progress
from curvafit.generation.problem import Data, Hinge
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import LawLike
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import profile_distance
from curvafit.scan.preparation import LARGEST_BOX
from curvafit.scan.structure import add_records
from curvafit.segmentation.filler import SLOPE, TILE, Raster, Taught, fill
from curvafit.segmentation.flow import HALO, Working, WorkingGrid, choose_epsilon
from curvafit.segmentation.image import read_image
from curvafit.segmentation.known import Known, check_which, doubt_labels
from curvafit.segmentation.result import Segmentation, Uncertainty, describe_filled, flow_summary
from curvafit.segmentation.slices import (
    WHOLE,
    Slices,
    axis_first,
    check_spacing,
    load_with,
    plane_distances,
    require_labels,
)
from curvafit.segmentation.teach import tune
from curvafit.segmentation.tiles import LoweredVolume, Problem, cut_tiles, lower_volume
from curvafit.segmentation.trials import (
    PART,
    Example,
    Task,
    Trial,
    choose_by_masks,
    crop_to_surface,
    law_of,
    leave_out_slices,
)
from curvafit.segmentation.uncertainty import (
    LEAST,
    best_log_odds,
    best_threshold,
    calibration_error,
    count_probabilities,
    doubt,
    fit_weights,
    near_surface,
    probability,
    share_by_slices,
    suggest_slices,
)
from curvafit.volumes.formats.zarr import CHUNK
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Record, Run, open_run
from curvafit.volumes.volume import Box, ScanError, StoredArray, Volume, cut_boxes, digest_of, lay, round_labels

#: Stiffness of the springs on known voxels, in working units: a tenth of it gives way, ten times as much stalls.
STIFFNESS = 1e7
#: Margin of the springs: u of the optimal profile half a voxel from the surface, as known voxels next to it are.
MARGIN = math.tanh(WORKING_SPACING / 2 / (math.sqrt(2) * WORKING_EPSILON))
#: Stiffness of the springs on unknown voxels, in working units, for each nat of their log-odds: all are tried.
PULLS = (0.0, 1e4, 3e4)
#: Fewest grey levels of an image, and most voxels in which they are counted.
GREY, SAMPLED = 8, 1_000_000
#: Bytes that each voxel takes at least while a volume is filled at once.
LEAST_BYTES = 30
#: Least share of the entropy of slices held out that an image takes away: that of the structure takes half or more.
LEAST_GAIN = 0.1
UNTOLD = "The image does not tell the structure in annotated slices held out: it is left out."
#: Slices of a block by default, and voxels a side across them at most.
DEEP, WIDE = 2 * CHUNK, 4 * CHUNK
#: The pass that fills, and the fraction of the work that is done after each pass.
_FILL, _READ = "filling blocks", 0.07
_ENDS = {"looking for labels": 0.02, "reading known slices": _READ, _FILL: 0.98}


def reconstruct(
    slices: Source,
    prior: LawLike | None = None,
    *,
    every: int | slice | None = None,
    known: Sequence[int] | None = None,
    ignore: int | None = None,
    axis: int = 0,
    image: Source | None = None,
    example: Source | None = None,
    suggest: int = 0,
    working: Working = Working(),
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Fill a volume between known slices, and say how sure each voxel is.

    A network fills it that generated shapes have taught (`filler.Filler`). An example tunes the network, where that
    makes it better by more than the noise. With an image, trees learn from the known slices which grey levels are
    inside, and the network weighs what they say of the others. With a law, F_ε is lowered from there if this is better:
    it is tried out on the part of the example that did not tune, or else on every second known slice. Known slices stay
    as they are. Labels in a file with a side of more than 256 voxels, or any with a `tile`, are filled in blocks, but
    with a law, an image or `ignore`, where `store` and `workers` serve a law alone.

    Raises ValueError and FileNotFoundError as `segment`; or if known slices are fewer than two, or than a law is tried
    out on, all empty, all full or grey levels; or if an example's spacing or an image's voxels are other ones.

    Parameters
    ----------
    slices
        A mask, or labels, of the whole volume's shape, positive inside, as a path, a `Volume`, an array or a tensor;
        only the known slices count.
    prior
        A law as in `segment`, to be tried; by default none. Each law that a fit trusts is tried.
    every, known, axis
        Slices 0, `every`, 2 `every` … are known, or those of `slice(3, None, every)`, and those numbered in `known`,
        across the axis 0, 1 or 2 of the array, that is z, y or x. Before the first and beyond the last, the volume goes
        on as that slice is for half a gap, or as an image tells. By default the slices with labels are known, and where
        they are every n-th, three or more, the empty ones next to them in this rhythm.
    ignore
        The label of voxels that nobody annotated, in place of `every` and `known`: slices without it are known, two or
        more, and so is each other voxel, in slices along any axis or in parts of slices.
    image
        Grey levels of the volume, on the same voxels (the affines tell their pose); needs `curvafit[image]`. It goes
        with neither example nor law.
    example
        A mask of another volume of the same kind, known whole. A file or an array has the slices' `spacing` and `unit`.
    suggest
        Number of slices to suggest for annotation next.
    working, progress, reading
        As in `segment`.
    """
    volume = load(slices, **reading, lazy=True)
    which = {"every": every, "known": known, "ignore": ignore, "axis": axis}
    check_which(volume.shape, **which, suggest=suggest)  # type: ignore[arg-type]
    inputs = Inputs.load(volume, which, prior, image, example, working=working, reading=reading)
    with inputs.open_run(working, progress) as run:
        return fill_between(inputs, run, working, progress, suggest)


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a volume is filled from: its labels, the options `which` of its known slices, a law with notes on it, the
    network, an image and an example; and whether it is filled in blocks."""

    volume: Volume
    which: dict[str, Any]
    law: Coefficients | None
    notes: tuple[str, ...]
    taught: Taught
    image: Volume | None
    example: Volume | None
    in_blocks: bool

    @classmethod
    def load(
        cls, volume: Volume, which: dict[str, Any], prior: LawLike | None, image: Source | None,
        example: Source | None, *, working: Working, reading: dict[str, Any],
    ) -> Inputs:  # fmt: skip
        """Load the inputs, and the volume if it is filled at once; raise ScanError where inputs exclude each other."""
        choose_epsilon(volume, working.epsilon)  # refuses an ε before the work
        large = working.tile is not None or (volume.in_file and max(volume.shape) > LARGEST_BOX)
        in_blocks = large and prior is None and image is None and which["ignore"] is None
        if not in_blocks:
            check_memory(volume.shape, LEAST_BYTES, "a volume that is filled at once, not in blocks,")
            volume = volume.load()
            volume = replace(volume, array=round_labels(volume.values))
        law, notes = (None, ()) if prior is None else law_of(prior, volume)
        if image is not None and (example is not None or law is not None):
            raise ScanError("give an image, or an example or a law, but not both: nothing joins them yet")
        taught = Taught.load(working.filler, image=image is not None)
        grey = None if image is None else load_image(image, volume, reading)
        annotated = None if example is None else load_example(example, volume, reading)
        return cls(volume, which, law, notes, taught, grey, annotated, in_blocks)

    def open_run(self, working: Working, progress: Progress) -> AbstractContextManager[Run]:
        """Open the run of the blocks; a volume that is filled at once is one block in memory."""
        if not self.in_blocks or working.store is None:
            return open_run(None, None, {}, progress if self.in_blocks else silent, _ENDS)
        identity = {"labels": self.volume.digest, **self.which, "filler": self.taught.digest, "tile": working.tile}
        identity |= {"example": None if self.example is None else self.example.digest}
        crew = working.workers if self.volume.in_file else None
        return open_run(crew, working.store, identity, progress, _ENDS)


def fill_between(
    inputs: Inputs, run: Run, working: Working, progress: Progress, suggest: int = 0, larger: Known | None = None
) -> Segmentation:
    """Read the known slices, adapt the network, choose a law, fill the volume, and say how sure each voxel is. Of the
    box of a `larger` volume, shares and numbers of slices are stated of the larger one."""
    volume = inputs.volume
    known = Known.find(volume, run, **inputs.which)
    whole = larger or known
    part = math.prod(volume.shape) / math.prod(whole.volume.shape)
    slices, labels = known.read(run)
    notes = (*known.notes, *doubt_labels(labels, inputs.which["ignore"]), *inputs.notes)
    example = None if inputs.example is None else Example.of(inputs.example, known.places, known.axis)
    step = sub_progress(progress, *((_READ, _READ) if inputs.in_blocks else (0.0, 0.5)))
    taught, evidence, input_notes = _adapt(inputs, known, slices, example, step)
    notes = (*notes, *input_notes)
    engine = _Engine(taught, evidence, working.epsilon, progress)
    grid, tiles = engine.cut(slices, working.tile) if inputs.law else (None, [])
    strength = (working.stiffness, working.steps)
    trial, task, head = _try_law(engine, slices, inputs.law, example, strength, len(tiles))
    if grid is None or trial.law is None:
        filled, phase = _fill_volume(known, slices, engine, run, working.tile, inputs.in_blocks), None
        inside = flow_summary(part * filled.share)
    else:
        problem = SlicesProblem(trial, slices, engine.level(slices))
        lowered = lower_volume(problem, grid, tiles, working=working, progress=progress)
        filled, engine = _weigh_evidence(engine, trial, task, known, slices, lowered)
        phase, notes = known.turn_back(lowered.phase), (*notes, *grid.notes)
        inside = flow_summary(part * float(lowered.mask.mean()), lowered.energies, lowered.steps)
    uncertain = filled.judge(known, slices, engine, suggest)
    tested = "the example" if example else "slices left out" if trial.law else "generated shapes"
    options = {"tested": tested, "image": evidence is not None, "length": whole.volume.shape[known.axis], "part": part}
    status, doubts = describe_filled(head, inside, filled.share, uncertain, whole.places, **options)
    return Segmentation.of(
        volume, filled.mask, phase, trial.law, choose_epsilon(volume, working.epsilon), (*notes, *doubts),
        weight=None, status=status, uncertainty=uncertain, image=inputs.image,
    )  # fmt: skip


def _adapt(
    inputs: Inputs, known: Known, slices: Slices, example: Example | None, progress: Progress
) -> tuple[Taught, np.ndarray | None, tuple[str, ...]]:
    """Return the network, tuned on the example if there is one; an image's log-odds (length, Y, X); and notes."""
    taught, image = inputs.taught, inputs.image
    if image is not None:
        evidence, gain = read_image(known.turn(image.values), slices, progress)
        if gain < LEAST_GAIN:
            return Taught.load(), None, (*image.notes, UNTOLD)
        return taught, evidence, image.notes
    if example is not None:
        return tune(taught, example, progress), None, example.notes
    return taught, None, ()


def _try_law(
    engine: _Engine, slices: Slices, law: Coefficients | None, example: Example | None,
    strength: tuple[float | None, int], tiles: int,
) -> tuple[Trial, Task[Slices] | None, str]:  # fmt: skip
    """Return the trial to run, with the law if it is better than the network alone; the task that it was tried on, or
    else the example's; and the beginning of the status. `strength` is the stiffness and the steps: with a given
    stiffness the law is not tried. Of a volume of several `tiles`, it is tried in a box."""
    (stiffness, steps), untried = strength, None if example is None else example.task
    if law is None:
        return Trial(), untried, engine.taught.status
    if stiffness is not None:
        return Trial(law, stiffness, steps), untried, "the law is lowered from the network's volume"
    part = slices if tiles == 1 else crop_to_surface(slices, PART)[0]
    task = leave_out_slices(part) if example is None else example.part
    if task is None:
        raise ScanError(
            "to try the prior out, give three or more known slices with voxels inside and outside, an example or a "
            f"stiffness, got {len(part.places)} slices"
        )
    trials = [Trial(law, STIFFNESS, steps, pull) for pull in PULLS]

    def fill_part(part: Slices, trial: Trial) -> np.ndarray:
        return (engine.level(part) if trial.law is None else engine.lower(part, trial)) > 0

    best = choose_by_masks(task, trials, fill_part)
    score, plain = f"{best.score:.3f}", f"{best.plain:.3f}"
    where = "left out" if example is None else "of the example"
    head = f"no law helps here: Dice {plain} on slices {where} by the network alone, {score} with a law"
    if best.law is not None:
        head = f"a law helps: Dice {score} on slices {where}, {plain} by the network alone"
    return best, task, head


@dataclass(frozen=True, eq=False)
class _Engine:
    """Fills slices by the network, and by laws that start from its result; each result is computed once."""

    taught: Taught
    evidence: np.ndarray | None
    epsilon: float | None
    progress: Progress
    filled: dict[Slices, tuple[Raster, np.ndarray]] = field(default_factory=dict)
    lowered: dict[tuple[Any, ...], np.ndarray] = field(default_factory=dict)

    def logits(self, slices: Slices) -> np.ndarray:
        """Return the network's log-odds of the inside (Z, Y, X)."""
        return self._fill(slices)[1]

    def thresholded(self, slices: Slices) -> np.ndarray:
        """Return which slices are cut at the best threshold, not at 1/2: those between known ones; all by an image."""
        return slices.between | (self.evidence is not None)

    def level(self, slices: Slices) -> np.ndarray:
        """Return log-odds less those of the threshold (Z, Y, X), times the edge of a voxel: about a signed distance. In
        known slices, whose log-odds are constant, they follow from the distance from the outline."""
        raster, logits = self._fill(slices)
        distances = plane_distances(slices.inside, slices.spacing[1:], slices.gap * slices.spacing[0])
        level = logits.copy()
        level[list(slices.places)] = (SLOPE / raster.pixel) * distances.astype(np.float32)
        threshold = best_log_odds(logits[slices.between]) if slices.between.any() else 0.0
        level = level - np.where(self.thresholded(slices), threshold, 0)[:, None, None]
        return (min(slices.spacing[1:]) * level).astype(np.float32)

    def lower(self, slices: Slices, trial: Trial) -> np.ndarray:
        """Return the phase field (Z, Y, X) of a trial's law; its scores, which are set later, do not matter."""
        key = (slices, trial.law, trial.strength, trial.steps, trial.pull)
        if key not in self.lowered:
            step: Progress = lambda _, fraction: self.progress("trying the law out", fraction)  # noqa: E731
            problem = SlicesProblem(trial, slices, self.level(slices))
            self.lowered[key] = lower_volume(problem, *self.cut(slices), progress=step).phase
        return self.lowered[key]

    def cut(self, slices: Slices, edge: int | None = None) -> tuple[WorkingGrid, list[Box]]:
        """Return the working grid on which a law is lowered, and the tiles."""
        grid = WorkingGrid.of(slices.frame, self.epsilon, halo=HALO)
        return grid, cut_tiles(grid, slices.shape, edge)

    def _fill(self, slices: Slices) -> tuple[Raster, np.ndarray]:
        """Return the network's pixels and its log-odds (Z, Y, X), computed once."""
        if slices not in self.filled:
            raster, step = Raster.of(slices), sub_progress(self.progress, 0.5, 1.0)
            logits = fill(slices, self.taught, raster=raster, evidence=self.evidence, progress=step)
            self.filled[slices] = raster, logits
        return self.filled[slices]


# ---- blocks ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Filled:
    """A volume's probabilities (`likely`) and mask in its own axes, and sums over its blocks by name (`look_at`)."""

    likely: Any
    mask: Any
    sums: dict[str, Any]

    @classmethod
    def of(cls, known: Known, slices: Slices, likely: np.ndarray, mask: np.ndarray) -> _Filled:
        """Return the result that consists of probabilities and a mask (length, Y, X) in memory."""
        sums = dict(look_at(likely, slices, WHOLE))
        likely = sums.pop("likely")
        return cls(known.turn_back(likely), known.turn_back(mask), sums | _compare(likely, mask, slices.between))

    @property
    def share(self) -> float:
        """The mask's fraction of the volume."""
        return float(self.sums["inside"] / math.prod(self.mask.shape))

    def judge(self, known: Known, slices: Slices, engine: _Engine, suggest: int) -> Uncertainty:
        """Return how sure the volume is, and which slices to annotate next."""
        sums, whole = self.sums, engine.evidence is not None
        dice = float(2 * sums["both"] / max(sums["count"] + sums["sum"], 1e-9)) if slices.between.any() else 1.0
        entropies = sums["along 0"] * slices.between, sums["along 1"], sums["along 2"]
        order = axis_first((0, 1, 2), known.axis)  # the volume's axes in the order of the sums
        return Uncertainty(
            replace(known.volume, array=self.likely, notes=()),
            engine.taught.error,
            suggest_slices(sums["along 0"], slices.places, suggest),
            dice,
            known_share=share_by_slices(slices.areas, slices.places, slices.length, whole=whole),
            mean_probability=float(sums["total"]) / math.prod(slices.shape),
            entropies=tuple(entropies[order.index(axis)] for axis in range(3)),
        )


def _fill_volume(known: Known, slices: Slices, engine: _Engine, run: Run, tile: int | None, in_blocks: bool) -> _Filled:
    """Fill a volume by the network alone, at once or in blocks. The threshold of the mask follows from the
    probabilities of all blocks, so that a second pass makes the mask."""
    shape, raster = known.volume.shape, Raster.of(slices) if in_blocks else None
    cores = cut_boxes(slices.shape, slices.shape if raster is None else _choose_edges(raster, tile))
    likely, mask = run.open("probability", np.float32, shape), run.open("mask", np.uint8, shape)

    def keep(number: int, record: Record) -> Record:
        likely[known.turn_box(cores[number])] = np.moveaxis(record["likely"], 0, known.axis)
        return {name: value for name, value in record.items() if name != "likely"}

    def fill_all(_: int) -> Record:
        return look_at(expit(engine.logits(slices)), slices, cores[0], whole=engine.evidence is not None)

    if raster is None:
        records = run(_FILL, fill_all, 1, keep=keep)
    else:
        sides = " x ".join(str(edge.stop - edge.start) for edge in cores[0])
        message = f"{len(cores)} blocks of {sides} voxels."
        records = run(_FILL, partial(fill_block, slices, engine.taught, raster, cores), len(cores), message, keep)
    sums = add_records(_pad_entropies(record, core, slices.shape) for core, record in zip(cores, records, strict=True))
    compared: list[Record] = []
    threshold = max(best_threshold(sums["counts"]), LEAST) if slices.between.any() else 0.5
    thresholds = np.where(engine.thresholded(slices), threshold, 0.5).astype(np.float32)[:, None, None]
    for core in cores:
        box = known.turn_box(core)
        block = np.moveaxis(likely[box], known.axis, 0)
        inside = block > thresholds[core[0]]
        mask[box] = np.moveaxis(inside, 0, known.axis)
        compared.append(_compare(block, inside, slices.between[core[0]]))
    return _Filled(_voxels(likely.stored), _voxels(mask.stored, label=1), sums | add_records(compared))


def fill_block(slices: Slices, taught: Taught, raster: Raster, cores: Sequence[Box], number: int) -> Record:
    """Fill a block by the network, and return its record (`look_at`)."""
    return look_at(expit(fill(slices, taught, cores[number], raster=raster)), slices, cores[number])


def look_at(likely: np.ndarray, slices: Slices, core: Box, *, whole: bool = False) -> Record:
    """Return the record of a block's probabilities (Z, Y, X): themselves, `likely`, float32, 0 or 1 in known voxels;
    their histogram, `counts`, and `sum` between known slices; their `total` over filled slices, or over the `whole`;
    and the entropies of the slices across axis k, `along k`."""
    rows = core[0]
    counts = count_probabilities(likely[slices.between[rows]])  # of marked voxels too, as for `_Engine.level`
    likely = slices.keep_known(likely.astype(np.float32), core)
    across, down, right = (np.zeros(n) for n in likely.shape)
    for row, entropies in enumerate(map(doubt, likely)):
        across[row], down[:], right[:] = entropies.sum(), down + entropies.sum(1), right + entropies.sum(0)
    filled = likely if whole else likely[~slices.unfilled[rows]]
    sums = {"sum": likely[slices.between[rows]].sum(dtype=np.float64), "total": filled.sum(dtype=np.float64)}
    return {"likely": likely, "counts": counts, **sums, "along 0": across, "along 1": down, "along 2": right}


def _compare(likely: np.ndarray, mask: np.ndarray, between: np.ndarray) -> dict[str, Any]:
    """Return the voxels `inside` a mask; and in slices between known ones, their `count` and the sum of their
    probabilities, which is the overlap with the truth to expect, `both`."""
    inside = mask[between]
    both = likely[between][inside].sum(dtype=np.float64)
    return {"inside": np.count_nonzero(mask), "count": np.count_nonzero(inside), "both": both}


def _pad_entropies(record: Record, core: Box, shape: Sequence[int]) -> Record:
    """Return a block's record with entropies for all slices of the volume, 0 beyond the block, so that they add up."""
    padded = dict(record)
    for axis, n in enumerate(shape):
        padded[f"along {axis}"] = np.zeros(n)
        padded[f"along {axis}"][core[axis]] = record[f"along {axis}"]
    return padded


def _choose_edges(raster: Raster, tile: int | None) -> tuple[int, ...]:
    """Return the edges of blocks: `tile`, or as many voxels as the network fills at once."""
    if tile is not None:
        return (tile,) * 3
    # Whole chunks of a store: no two blocks write to the same one.
    return (DEEP, *(min(max(int(TILE / scale) // CHUNK, 1) * CHUNK, WIDE) for scale in raster.scale))


def _voxels(stored: Any, label: int | None = None) -> Any:
    """Return an array that a `Volume` can read: one in memory as it is, a stored one lazily; or the mask of a label."""
    z, y, x = (slice(0, n) for n in stored.shape)
    if isinstance(stored, np.ndarray):
        return stored if label is None else stored == label
    return StoredArray(stored, (z, y, x), (0, 1, 2), label)


# ---- a law -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SlicesProblem(Problem):
    """A law lowered between known slices, with a trial whose strength is the stiffness of springs on known voxels. The
    start is `level` (length, Y, X), positive inside: log-odds less a threshold's, times the edge of a voxel."""

    slices: Slices
    level: np.ndarray

    @property
    def inputs(self) -> dict[str, object]:
        slices, trial = self.slices, self.trial
        geometry = {"places": slices.places, "spacing": slices.spacing}
        springs = {"strength": trial.strength, "pull": trial.pull}
        return {"slices": digest_of(slices.inside), **geometry, "start": digest_of(self.level), **springs}

    def terms(self, box: Box, grid: WorkingGrid) -> tuple[np.ndarray, Data]:
        """Return the level on a box, and the springs of its voxels: on known ones the trial's strength; on others
        between known slices its pull times their log-odds, which are the level over the edge of a voxel."""
        slices, trial, level = self.slices, self.trial, self.level[box]
        positions, inside = slices.known(box)
        between = slices.between[box[0], None, None]
        stiffness = np.where(between, trial.pull / min(slices.spacing[1:]) * level, 0).astype(np.float32)
        stiffness[positions] = np.where(inside, trial.strength, -trial.strength)
        if slices.marks is not None:
            marks = slices.marks[box]
            stiffness = np.where(marks == 0, stiffness, trial.strength * marks).astype(np.float32)
        return level, Hinge(grid.spread(stiffness, centre=0), MARGIN)

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the voxels where the phase field is positive, and the known ones as they are."""
        return self.slices.keep_known(phase > 0, box)


def _weigh_evidence(
    engine: _Engine, trial: Trial, task: Task[Slices] | None, known: Known, slices: Slices, lowered: LoweredVolume
) -> tuple[_Filled, _Engine]:
    """Return the volume that a law filled, and the engine with the calibration error of its probabilities. These are
    logistic in the network's log-odds and the depth below the law's surface, with weights fitted to the task; without a
    task they are the network's."""

    def evidence(slices: Slices, phase: np.ndarray, rows: list[int]) -> np.ndarray:
        depth = profile_distance(torch.from_numpy(phase[rows]), float(RESOLVED)).numpy()
        return np.stack([engine.logits(slices)[rows].ravel(), depth.ravel()], axis=-1)

    mask = slices.keep_known(lowered.mask & ~slices.unfilled[:, None, None])
    if task is None:
        return _Filled.of(known, slices, expit(engine.logits(slices)), mask), engine
    rows, phase = list(task.places), engine.lower(task.given, trial)
    task_evidence = evidence(task.given, phase, rows)
    weights = fit_weights(task_evidence, task.truth.ravel())
    predicted, near = probability(task_evidence, weights).reshape(task.truth.shape), near_surface(phase > 0)[rows]
    error = calibration_error(predicted[near], task.truth[near])
    likely = probability(evidence(slices, lowered.phase, list(range(slices.length))), weights).reshape(slices.shape)
    likely[slices.unfilled] = np.minimum(likely[slices.unfilled], 0.5)
    return _Filled.of(known, slices, likely, mask), replace(engine, taught=replace(engine.taught, error=error))


def load_image(image: Source, volume: Volume, reading: dict[str, Any]) -> Volume:
    """Load the image of a volume of slices, on the same voxels; raise ScanError where it has no grey levels."""
    require("sklearn.ensemble", "image", "reading an image")
    grey, notes = lay(load_with(image, reading, "crop"), volume, "the image", "the slices", exact=True)
    stride = -(-grey.values.size // SAMPLED)  # rounded up
    if (count := len(np.unique(grey.values.ravel()[::stride]))) < GREY:
        raise ScanError(f"the image must have grey levels, but has {count} values: is it a mask?")
    return replace(grey, notes=notes)


def load_example(example: Source, volume: Volume, reading: dict[str, Any]) -> Volume:
    """Load an example, read with the spacing and unit of the slices' `volume`; raise ScanError where it differs."""
    mask = load_with(example, reading)
    check_spacing(mask, volume, "the slices")
    require_labels(mask.values, "the example")
    return mask
