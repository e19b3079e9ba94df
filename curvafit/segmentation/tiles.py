"""Lowering the energy of a volume of any size: tile by tile, with finished tiles kept in a folder.

Tiles overlap so far that a cut is not felt in their cores: tiling moves the result by a few voxels of the surface at
most.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Cluster
from curvafit.generation.loop import identity
from curvafit.generation.problem import Data
from curvafit.segmentation.flow import WorkingGrid, lower_energy
from curvafit.segmentation.trials import Trial
from curvafit.volumes.run import Record, open_run
from curvafit.volumes.volume import Box, within

#: Working voxels beyond a tile that are lowered with it: at that distance the cut is not felt any more.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: The name of the pass.
_LOWER = "lowering the energy"


def cut_tiles(place: WorkingGrid, shape: Sequence[int], edge: int | None = None) -> list[Box]:
    """Cut a volume of a shape into tiles of at most `edge` working voxels a side, which differ by a voxel at most.

    By default the volume is one tile up to `WHOLE` working voxels, else tiles of `EDGE`.
    """
    whole = max(place.grid.shape) if math.prod(place.grid.shape) <= WHOLE else EDGE
    edge = edge or whole
    counts = [-(-n // max(1, edge // times)) for n, times in zip(shape, place.times, strict=True)]
    ends = ([k * n // count for k in range(count + 1)] for n, count in zip(shape, counts, strict=True))
    axes = ([slice(*pair) for pair in pairwise(axis)] for axis in ends)
    return [(z, y, x) for z, y, x in product(*axes)]


def surround(tile: Box, place: WorkingGrid, shape: Sequence[int]) -> tuple[Box, WorkingGrid]:
    """Return the box in which the energy of a tile is lowered, and its working grid, in a volume of a shape on `place`.

    The box is the tile with its overlap; in a periodic volume it may go beyond the ends.
    """
    if all(edge.stop - edge.start == n for edge, n in zip(tile, shape, strict=True)):
        return tile, place
    box, ends = [], []
    for edge, n, times in zip(tile, shape, place.times, strict=True):
        first, last = edge.start - -(-OVERLAP // times), edge.stop + -(-OVERLAP // times)
        before, beyond = first <= 0 and not place.grid.periodic, last >= n and not place.grid.periodic
        box.append(slice(0 if before else first, n if beyond else last))
        ends.append((before, beyond))
    z, y, x = box
    return (z, y, x), place.of_box([edge.stop - edge.start for edge in box], tuple(ends))


@dataclass(frozen=True, eq=False)
class Problem(ABC):
    """An energy to lower, and the start; any box of the volume sees the same data. The trial's law has lengths in the
    scan's unit; without a law the start is the result."""

    trial: Trial

    @property
    @abstractmethod
    def inputs(self) -> dict[str, object]:
        """The inputs besides law and steps, by name: tiles of other inputs are another run's."""

    @abstractmethod
    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Data]:
        """Return the level of the start (Z, Y, X), positive inside, and the data term, on a box."""

    @abstractmethod
    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the phase field on the scan's voxels where no law is lowered: that of the start's level."""

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the mask, bool (Z, Y, X), of a phase field on a box."""
        return phase > 0


@dataclass(frozen=True, eq=False)
class LoweredVolume:
    """A volume's mask (Z, Y, X), bool, and phase field, float32, the last two energies of its flow, and its steps: none
    where nothing was lowered."""

    mask: np.ndarray
    phase: np.ndarray
    energies: tuple[float, ...]
    steps: int


def lower_volume(
    problem: Problem,
    place: WorkingGrid,
    tiles: Sequence[Box],
    *,
    store: str | PathLike[str] | None = None,
    workers: Cluster | int | None = None,
    progress: Progress = silent,
) -> LoweredVolume:
    """Lower a problem on each tile of a volume (`cut_tiles`), and return the whole; several tiles may have a `store`,
    where finished ones stay, those of an earlier, killed run too, and workers."""
    trial, shape = problem.trial, tuple(edge.stop for edge in tiles[-1])
    folder, workers = (None, None) if len(tiles) == 1 else (None if store is None else Path(store), workers)
    counts = tuple(len({tile[axis].start for tile in tiles}) for axis in range(3))
    parts: dict[str, Any] = {"law": trial.law, "steps": trial.steps, "tiles": counts, "place": place}
    same = {} if folder is None else identity(**problem.inputs, **parts)  # digests take a while
    with open_run(workers, folder, same, progress, {_LOWER: 1.0}) as run:
        mask, phase = run.open("mask", np.bool_, shape), run.open("phase", np.float32, shape)

        def keep(number: int, record: Record) -> Record:
            mask[tiles[number]], phase[tiles[number]] = record["mask"], record["phase"]
            return {"energies": record["energies"]}

        lower = partial(_lower_tile, problem, place, tiles, progress if run.alone else silent)
        records = run(_LOWER, lower, len(tiles), keep=keep)
        energies = np.sum([record["energies"] for record in records], axis=0)
    return LoweredVolume(mask.values, phase.values, tuple(energies.tolist()), 0 if trial.law is None else trial.steps)


def _lower_tile(problem: Problem, whole: WorkingGrid, tiles: Sequence[Box], progress: Progress, number: int) -> Record:
    """Return mask and phase field on a tile, and the last two energies of its flow."""
    tile, trial, energies = tiles[number], problem.trial, ()
    box, place = surround(tile, whole, [edge.stop for edge in tiles[-1]])
    level, term = problem.terms(box, place)
    if trial.law is None:
        phase = problem.plain(level, place)
    else:
        step = sub_progress(progress, number / len(tiles), (number + 1) / len(tiles))
        flow = lower_energy(level, trial.law, term, place, trial.steps, step)
        phase, energies = place.to_scan(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[within(tile, box)])
    return {"mask": problem.mask(phase, tile), "phase": phase, "energies": np.array(energies, dtype=np.float64)}
