"""Lowering the energy of a volume of any size: tile by tile, with finished tiles kept in a folder.

Tiles overlap so far that a cut is not felt in their cores: tiling moves the result by a few voxels of the surface at
most.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import check_int
from curvafit.core.files import write_content
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers, collect_all, join_workers
from curvafit.generation.checkpoint import identity
from curvafit.generation.data import Data
from curvafit.priors.grid import MOST
from curvafit.priors.kernels.threads import one_thread
from curvafit.scan.pieces import RUN, lock_store
from curvafit.segmentation.flow import HALO, Ends, WorkingGrid, lower_energy
from curvafit.segmentation.trials import Trial
from curvafit.volumes.boxes import Box, within
from curvafit.volumes.volume import Volume

#: Working voxels beyond a tile that are lowered with it: at that distance the cut is not felt any more.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: Shortest edge of a tile, in working voxels.
SHORTEST = 8
#: Files of a folder besides the run's: the volume's arrays.
_MASK, _PHASE = "mask.npy", "phase.npy"


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
class Piece:
    """The result of a tile: its number, mask and phase field on the core, and the last two energies of its flow."""

    number: int
    mask: np.ndarray
    phase: np.ndarray
    energies: tuple[float, ...]


class TileStore:
    """The finished tiles of a volume: in memory, or in mapped files of a folder that outlives a killed run. There each
    tile has a note, `000012.json`, which is written once the tile's voxels are on the disk."""

    def __init__(self, shape: tuple[int, int, int], folder: Path | None = None) -> None:
        self._folder, self.energies = folder, dict[int, tuple[float, ...]]()
        if folder is None:
            self.mask, self.phase = np.empty(shape, dtype=bool), np.empty(shape, dtype=np.float32)
        else:
            self.mask, self.phase = (np.load(folder / name, mmap_mode="r+") for name in (_MASK, _PHASE))
            notes = folder.glob("[0-9]*.json")
            self.energies = {int(note.stem): tuple(json.loads(note.read_bytes())) for note in notes}

    def write(self, core: Box, piece: Piece) -> None:
        """Keep the result of a tile."""
        self.mask[core], self.phase[core] = piece.mask, piece.phase
        if self._folder is not None:
            self.mask.flush()  # type: ignore[attr-defined]
            self.phase.flush()  # type: ignore[attr-defined]
            write_content(self._folder / f"{piece.number:06d}.json", json.dumps(piece.energies))
        self.energies[piece.number] = piece.energies


@contextmanager
def open_store(folder: str | PathLike[str], shape: tuple[int, int, int], run: Mapping[str, Any]) -> Iterator[TileStore]:
    """Open the folder of the tiles of a volume of a shape, or make it, and lock it; `run` holds what runs must have in
    common to share tiles. Raises `ValueError` if it holds other things or the tiles of another run, or is in use."""
    mine = identity(**run)
    with lock_store(folder, (_MASK, _PHASE)) as (place, other):
        if other is None:
            for name, kind in ((_MASK, np.bool_), (_PHASE, np.float32)):
                np.lib.format.open_memmap(place / name, mode="w+", dtype=kind, shape=shape).flush()
            write_content(place / RUN, json.dumps(mine, indent=2))
        elif names := [name for name in {**other, **mine} if other.get(name) != mine.get(name)]:
            parts = "; ".join(f"{name} {other.get(name)} instead of {mine.get(name)}" for name in names)
            raise ValueError(f"the tiles in {place} are another run's, with {parts}: delete them to start again")
        yield TileStore(shape, place)


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
    workers: Workers | int | None = None,
    progress: Progress = silent,
) -> LoweredVolume:
    """Lower a problem on each tile of a volume, and return the whole; several tiles may have a `store`, where finished
    ones stay, those of an earlier, killed run too, and workers."""
    trial = problem.trial
    run = {**problem.inputs, "law": trial.law, "steps": trial.steps, "tiles": tiling.counts, "place": tiling.place}
    folder = store if tiling.count > 1 else None
    opened = nullcontext(TileStore(tiling.shape)) if folder is None else open_store(folder, tiling.shape, run)
    with join_workers(workers if tiling.count > 1 else None) as crew, opened as finished:
        tiles = tiling.tiles
        rest = [tile for tile in tiles if tile.number not in finished.energies]
        total, done = tiling.count, tiling.count - len(rest)
        if crew is None:
            steps = (sub_progress(progress, k / total, (k + 1) / total) for k in range(done, total))
            pieces = (_lower_tile(problem, tiling, *each) for each in zip(rest, steps, strict=True))
        else:
            lower = partial(_lower_tiles, problem, tiling)
            pieces = collect_all(crew, [(lower, Path(), [tile.number]) for tile in rest])
        for count, piece in enumerate(pieces, done + 1):
            finished.write(tiles[piece.number].core, piece)
            progress("lowering the energy", count / total)
    if folder is not None:  # what is done with the result must not change the tiles
        finished.mask.flags.writeable = finished.phase.flags.writeable = False
    energies = [finished.energies[tile.number] for tile in tiles]
    flowed = 0 if trial.law is None else trial.steps
    return LoweredVolume(finished.mask, finished.phase, tuple(map(sum, zip(*energies, strict=True))), flowed)


def _lower_tiles(problem: Problem, tiling: Tiling, _: Path, numbers: Sequence[int]) -> list[Piece]:
    """Lower tiles by their numbers, as a worker does, on one thread: the workers share the cores."""
    with one_thread():
        return [_lower_tile(problem, tiling, tiling.tiles[number], silent) for number in numbers]


def _lower_tile(problem: Problem, tiling: Tiling, tile: Tile, progress: Progress) -> Piece:
    place, trial, energies = tiling.place_of(tile), problem.trial, ()
    level, term = problem.terms(tile.box, place)
    if trial.law is None:
        phase = problem.plain(level, place)
    else:
        flow = lower_energy(level, trial.law, term, place, trial.steps, progress)
        phase, energies = place.to_scan(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[tile.inner])
    return Piece(tile.number, problem.mask(phase, tile.core), phase, energies)
