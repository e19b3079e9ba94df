"""Lowering the energy of a volume of any size: tile by tile, with finished tiles kept in a folder.

Tiles overlap so far that a cut is not felt in their cores: tiling moves the result by a few voxels of the surface at
most.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import check_int
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Cluster
from curvafit.generation.checkpoint import identity
from curvafit.generation.data import Data
from curvafit.priors.grid import MOST
from curvafit.segmentation.flow import HALO, Ends, WorkingGrid, lower_energy
from curvafit.segmentation.trials import Trial
from curvafit.volumes.boxes import Box, within
from curvafit.volumes.run import Record, open_run
from curvafit.volumes.volume import Volume

#: Working voxels beyond a tile that are lowered with it: at that distance the cut is not felt any more.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: Shortest edge of a tile, in working voxels.
SHORTEST = 8
#: The name of the pass.
_LOWER = "lowering the energy"


@dataclass(frozen=True)
class Tile:
    """A part of a volume: its number, its core, whose result it gives, and the box in which the energy is lowered. The
    box is the core with its overlap; in a periodic volume it may go beyond the ends. `ends` says of either side of each
    axis whether the box ends where the volume does."""

    number: int
    core: Box
    box: Box
    ends: Ends

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the box."""
        return tuple(edge.stop - edge.start for edge in self.box)  # type: ignore[return-value]

    @property
    def inner(self) -> Box:
        """The core within the box."""
        return within(self.core, self.box)


def check_edge(edge: int | None) -> int | None:
    """Return the edge of a tile in working voxels, if one is given; raise ValueError unless it is from `SHORTEST`."""
    form = f"a tile of {SHORTEST} or more working voxels a side"
    return None if edge is None else check_int(edge, form, SHORTEST, MOST)


@dataclass(frozen=True)
class Tiling:
    """A volume of `shape` voxels in tiles: `counts` along each axis, whose sizes differ by a voxel at most. `place` is
    the working grid of the whole volume."""

    shape: tuple[int, int, int]
    place: WorkingGrid
    counts: tuple[int, int, int]

    @classmethod
    def of(cls, frame: Volume, epsilon: float | None, edge: int | None = None, *, periodic: bool = False) -> Tiling:
        """Cut a volume into tiles of at most `edge` working voxels a side without the overlap.

        By default the volume is one tile up to `WHOLE` working voxels, else tiles of `EDGE`. Raises `ValueError` as
        `WorkingGrid.of`, or if the edge is not a whole number from `SHORTEST`.
        """
        place = WorkingGrid.of(frame, epsilon, halo=HALO, periodic=periodic)
        whole = max(place.grid.shape) if math.prod(place.grid.shape) <= WHOLE else EDGE
        edge = check_edge(whole if edge is None else edge) or whole
        pairs = zip(frame.shape, place.times, strict=True)
        return cls(frame.shape, place, tuple(-(-n // max(1, edge // times)) for n, times in pairs))  # type: ignore[arg-type]

    @property
    def count(self) -> int:
        """The number of tiles."""
        return math.prod(self.counts)

    @property
    def tiles(self) -> list[Tile]:
        """The tiles, z slowest."""
        axes = (self._cut_axis(axis) for axis in range(3))
        return [Tile(k, *zip(*edges, strict=True)) for k, edges in enumerate(product(*axes))]  # type: ignore[arg-type]

    def place_of(self, tile: Tile) -> WorkingGrid:
        """Return the working grid of a tile's box."""
        return self.place if self.count == 1 else self.place.of_box(tile.shape, tile.ends)

    def _cut_axis(self, axis: int) -> list[tuple[slice, slice, tuple[bool, bool]]]:
        """Return core, box and ends of the tiles along an axis."""
        n, times, count = self.shape[axis], self.place.times[axis], self.counts[axis]
        periodic, overlap = self.place.grid.periodic, -(-OVERLAP // times)
        if self.count == 1:
            return [(slice(0, n), slice(0, n), (True, True))]
        tiles = []
        for start, stop in pairwise(k * n // count for k in range(count + 1)):
            first, last = start - overlap, stop + overlap
            ends = (first <= 0 and not periodic, last >= n and not periodic)
            box = slice(0 if ends[0] else first, n if ends[1] else last)
            tiles.append((slice(start, stop), box, ends))
        return tiles


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
    tiling: Tiling,
    *,
    store: str | PathLike[str] | None = None,
    workers: Cluster | int | None = None,
    progress: Progress = silent,
) -> LoweredVolume:
    """Lower a problem on each tile of a volume, and return the whole; several tiles may have a `store`, where finished
    ones stay, those of an earlier, killed run too, and workers."""
    trial, tiles = problem.trial, tiling.tiles
    folder, workers = (None, None) if tiling.count == 1 else (None if store is None else Path(store), workers)
    parts: dict[str, Any] = {"law": trial.law, "steps": trial.steps, "tiles": tiling.counts, "place": tiling.place}
    same = {} if folder is None else identity(**problem.inputs, **parts)  # digests take a while
    with open_run(workers, folder, same, progress, {_LOWER: 1.0}) as run:
        mask, phase = run.open("mask", np.bool_, tiling.shape), run.open("phase", np.float32, tiling.shape)

        def keep(number: int, record: Record) -> Record:
            core = tiles[number].core
            mask[core], phase[core] = record["mask"], record["phase"]
            return {"energies": record["energies"]}

        lower = partial(_lower_tile, problem, tiling, progress if run.alone else silent)
        records = run(_LOWER, lower, tiling.count, keep=keep)
        energies = np.sum([record["energies"] for record in records], axis=0)
    return LoweredVolume(mask.values, phase.values, tuple(energies.tolist()), 0 if trial.law is None else trial.steps)


def _lower_tile(problem: Problem, tiling: Tiling, progress: Progress, number: int) -> Record:
    """Return mask and phase field on a tile's core, and the last two energies of its flow."""
    tile, trial, energies = tiling.tiles[number], problem.trial, ()
    place = tiling.place_of(tile)
    level, term = problem.terms(tile.box, place)
    if trial.law is None:
        phase = problem.plain(level, place)
    else:
        step = sub_progress(progress, number / tiling.count, (number + 1) / tiling.count)
        flow = lower_energy(level, trial.law, term, place, trial.steps, step)
        phase, energies = place.to_scan(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[tile.inner])
    return {"mask": problem.mask(phase, tile.core), "phase": phase, "energies": np.array(energies, dtype=np.float64)}
