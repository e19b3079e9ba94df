"""Lowering the energy of a volume of any size: tile by tile, with finished tiles kept in a folder.

Tiles overlap so far that their cores hardly change: tiling moves the result by a few voxels of the surface at most.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import numpy as np

from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.generation.loop import identity
from curvafit.generation.problem import Data
from curvafit.segmentation.flow import Working, WorkingGrid, lower_energy
from curvafit.segmentation.trials import Trial
from curvafit.volumes.run import Record, open_run
from curvafit.volumes.volume import Box, grow, within

#: Working voxels beyond a tile that are lowered with it: the cut at this distance does not change the tile.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: The name of the pass.
_LOWER = "lowering the energy"


def cut_tiles(grid: WorkingGrid, shape: Sequence[int], edge: int | None = None) -> list[Box]:
    """Cut a volume of a shape into tiles of at most `edge` working voxels a side, which differ by a voxel at most. By
    default the volume is one tile up to `WHOLE` working voxels, else tiles of `EDGE`."""
    edge = edge or (max(grid.grid.shape) if math.prod(grid.grid.shape) <= WHOLE else EDGE)
    axes = []
    for n, times in zip(shape, grid.times, strict=True):
        count = -(-n // max(1, edge // times))  # rounded up
        axes.append([slice(*ends) for ends in pairwise(k * n // count for k in range(count + 1))])
    return [(z, y, x) for z, y, x in product(*axes)]


def surround(tile: Box, grid: WorkingGrid, shape: Sequence[int]) -> tuple[Box, WorkingGrid]:
    """Return the box in which the energy of a tile is lowered, and its working grid, in a volume of `shape` voxels of
    `grid.times` working voxels each. The box is the tile with its overlap."""
    box = grow(tile, [-(-OVERLAP // times) for times in grid.times], shape)  # in voxels, rounded up
    z, y, x = ((edge.start == 0, edge.stop == n) for edge, n in zip(box, shape, strict=True))
    return box, grid.of_box([edge.stop - edge.start for edge in box], (z, y, x))


@dataclass(frozen=True, eq=False)
class Problem(ABC):
    """An energy to lower and the start, on any box of a volume. The trial's law has lengths in the scan's unit; without
    a law the start is the result."""

    trial: Trial

    @property
    @abstractmethod
    def inputs(self) -> dict[str, object]:
        """The inputs besides law and steps, by name: a store with tiles of other inputs is of another run."""

    @abstractmethod
    def terms(self, box: Box, grid: WorkingGrid) -> tuple[np.ndarray, Data]:
        """Return the level of the start (Z, Y, X), positive inside, and the data term, on a box."""

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the mask, bool (Z, Y, X), of a phase field on a box."""
        return phase > 0


@dataclass(frozen=True, eq=False)
class LoweredVolume:
    """A volume's mask (Z, Y, X), bool, and phase field, float32; the last two energies of its flow, and its steps: none
    where no law was lowered."""

    mask: np.ndarray
    phase: np.ndarray
    energies: tuple[float, ...]
    steps: int


def lower_volume(
    problem: Problem,
    grid: WorkingGrid,
    tiles: Sequence[Box],
    *,
    working: Working = Working(),
    progress: Progress = silent,
) -> LoweredVolume:
    """Lower a problem on each tile of a volume (`cut_tiles`), and return the whole. Of several tiles, finished ones are
    kept in the store of `working`, from which a killed run goes on, and its workers share them."""
    trial, shape = problem.trial, tuple(edge.stop for edge in tiles[-1])  # the last tile ends with the volume
    store, workers = (None, None) if len(tiles) == 1 else (working.store, working.workers)
    settings = {}
    if store is not None:  # digests take a while
        counts = tuple(len({tile[axis].start for tile in tiles}) for axis in range(3))
        settings = identity(**problem.inputs, law=trial.law, steps=trial.steps, tiles=counts, place=grid)
    with open_run(workers, store, settings, progress, {_LOWER: 1.0}) as run:
        mask, phase = run.open("mask", np.bool_, shape), run.open("phase", np.float32, shape)

        def keep(number: int, record: Record) -> Record:
            mask[tiles[number]], phase[tiles[number]] = record["mask"], record["phase"]
            return {"energies": record["energies"]}

        lower = partial(_lower_tile, problem, grid, tiles, progress if run.alone else silent)
        records = run(_LOWER, lower, len(tiles), keep=keep)
        energies = np.sum([record["energies"] for record in records], axis=0)
    return LoweredVolume(mask.values, phase.values, tuple(energies.tolist()), 0 if trial.law is None else trial.steps)


def _lower_tile(problem: Problem, whole: WorkingGrid, tiles: Sequence[Box], progress: Progress, number: int) -> Record:
    """Return the mask and the phase field of a tile, and the last two energies of its flow."""
    tile, trial, energies = tiles[number], problem.trial, ()
    box, grid = surround(tile, whole, [edge.stop for edge in tiles[-1]])
    level, data = problem.terms(box, grid)
    if trial.law is None:
        phase = np.clip(2 * level, -1, 1)  # levels are p - 1/2, or grey levels off the middle, over the contrast
    else:
        step = sub_progress(progress, number / len(tiles), (number + 1) / len(tiles))
        flow = lower_energy(level, trial.law, data, grid, trial.steps, step)
        phase, energies = grid.to_scan(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[within(tile, box)])
    return {"mask": problem.mask(phase, tile), "phase": phase, "energies": np.array(energies, dtype=np.float64)}
