"""Lowering the energy of a volume of any size: tile by tile, with what is finished kept in a folder.

Tiles overlap by so much that a cut is not felt any more; the result does not depend on them beyond a few voxels of the
surface.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from filelock import FileLock, Timeout

from curvafit.core.checks import check_int
from curvafit.core.files import write_content
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.workers import Workers, collect_all
from curvafit.generation.checkpoint import identity
from curvafit.generation.data import Data
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import MOST
from curvafit.priors.kernels.threads import one_thread
from curvafit.segmentation.engine import HALO, Ends, WorkingGrid, lower_energy
from curvafit.volumes.field import Field
from curvafit.volumes.formats.part import Box

#: Working voxels beyond a tile that are lowered with it: at that distance the cut is not felt any more.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: Shortest edge of a tile, in working voxels.
SHORTEST = 8
#: Files of a folder: what it belongs to, the volume's arrays, and the lock of the run that uses it.
_RUN, _MASK, _PHASE, _LOCK = "run.json", "mask.npy", "phase.npy", "lock"


@dataclass(frozen=True)
class Tile:
    """A part of a volume.

    Attributes
    ----------
    number
        Its number, from 0.
    core
        The voxels that it gives.
    box
        The voxels that it is lowered on: with the overlap. In a volume that repeats they may lie around it.
    ends
        Whether the box ends where the volume does, on either side of each axis.
    """

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
        pairs = zip(self.core, self.box, strict=True)
        return tuple(slice(c.start - b.start, c.stop - b.start) for c, b in pairs)  # type: ignore[return-value]


@dataclass(frozen=True)
class Tiling:
    """A volume in tiles.

    Attributes
    ----------
    shape
        Voxels of the volume.
    place
        The grid of the whole volume.
    counts
        Number of tiles along each axis, whose sizes differ by a voxel at most.
    """

    shape: tuple[int, int, int]
    place: WorkingGrid
    counts: tuple[int, int, int]

    @classmethod
    def of(cls, frame: Field, epsilon: float | None, edge: int | None = None, *, periodic: bool = False) -> Tiling:
        """Return the tiles of a volume, of at most `edge` working voxels a side without the overlap.

        By default the volume is one tile where it has at most `WHOLE` working voxels, else tiles of `EDGE`.

        Raises
        ------
        ValueError
            If the edge is not a whole number from `SHORTEST`, or as `WorkingGrid.of`.
        """
        place = WorkingGrid.of(frame, epsilon, halo=HALO, periodic=periodic)
        if edge is None:
            edge = max(place.grid.shape) if math.prod(place.grid.shape) <= WHOLE else EDGE
        edge = check_int(edge, f"a tile of {SHORTEST} or more working voxels a side", SHORTEST, MOST)
        pairs = zip(frame.shape, place.times, strict=True)
        return cls(frame.shape, place, tuple(-(-n // max(1, edge // times)) for n, times in pairs))  # type: ignore[arg-type]

    @property
    def count(self) -> int:
        """The number of tiles."""
        return math.prod(self.counts)

    @property
    def tiles(self) -> list[Tile]:
        """The tiles, z slowest."""
        axes = (self._axis(axis) for axis in range(3))
        return [Tile(k, *zip(*edges, strict=True)) for k, edges in enumerate(product(*axes))]  # type: ignore[arg-type]

    def place_of(self, tile: Tile) -> WorkingGrid:
        """Return the grid of a tile's box."""
        return self.place if self.count == 1 else self.place.of_box(tile.shape, tile.ends)

    @property
    def voxels(self) -> list[int]:
        """The working voxels of each tile's box."""
        return [math.prod(self.place_of(tile).grid.shape) for tile in self.tiles]

    def _axis(self, axis: int) -> list[tuple[slice, slice, tuple[bool, bool]]]:
        """Return core, box and ends of the tiles along an axis."""
        n, times, count = self.shape[axis], self.place.times[axis], self.counts[axis]
        periodic, overlap = self.place.grid.periodic, -(-OVERLAP // times)
        if self.count == 1:
            return [(slice(0, n), slice(0, n), (True, True))]
        edges = [k * n // count for k in range(count + 1)]
        tiles = []
        for start, stop in pairwise(edges):
            first, last = start - overlap, stop + overlap
            ends = (first <= 0 and not periodic, last >= n and not periodic)
            box = slice(0 if ends[0] else first, n if ends[1] else last)
            tiles.append((slice(start, stop), box, ends))
        return tiles


# ---- finished tiles --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Piece:
    """What a tile gives: its number, mask and phase field on the core, and the last two energies of its flow."""

    number: int
    mask: np.ndarray
    phase: np.ndarray
    energies: tuple[float, ...]


class MemoryStore:
    """Tiles of a volume of a shape, in memory."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self._mask, self._phase = np.empty(shape, dtype=bool), np.empty(shape, dtype=np.float32)
        self._energies: dict[int, tuple[float, ...]] = {}

    def has(self, number: int) -> bool:
        return number in self._energies

    def write(self, core: Box, piece: Piece) -> None:
        self._mask[core], self._phase[core] = piece.mask, piece.phase
        self._energies[piece.number] = piece.energies

    def energies(self, number: int) -> tuple[float, ...]:
        return self._energies[number]

    def volume(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask and the phase field."""
        return self._mask, self._phase


class FolderStore:
    """Tiles of a volume in a folder that outlives a killed run; open with `open_store`.

    The arrays are files of the volume's size, which are mapped. A tile has a note, `000012.json`, which is written once
    the tile's voxels are on the disk: a killed run loses the tile it was at and nothing else.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, number: int) -> bool:
        return self._note(number).exists()

    def write(self, core: Box, piece: Piece) -> None:
        for name, values in ((_MASK, piece.mask), (_PHASE, piece.phase)):
            array = np.load(self._folder / name, mmap_mode="r+")
            array[core] = values
            array.flush()
        write_content(self._note(piece.number), json.dumps(piece.energies))

    def energies(self, number: int) -> tuple[float, ...]:
        return tuple(json.loads(self._note(number).read_bytes()))

    def volume(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask and the phase field, mapped: they are read where they are used."""
        mask, phase = (np.load(self._folder / name, mmap_mode="r") for name in (_MASK, _PHASE))
        return mask, phase

    def _note(self, number: int) -> Path:
        return self._folder / f"{number:06d}.json"


@contextmanager
def open_store(
    folder: str | PathLike[str], shape: tuple[int, int, int], run: Mapping[str, Any]
) -> Iterator[FolderStore]:
    """Open the tiles of a run, or make a folder for them.

    Parameters
    ----------
    shape
        Voxels of the volume.
    run
        What two runs that share tiles have in common; see `generation.checkpoint.identity`.

    Raises
    ------
    ValueError
        If the folder has other things or the tiles of another run, or another run uses it.
    """
    place = Path(folder)
    names = {path.name for path in place.iterdir()} if place.is_dir() else set()
    if (_RUN not in names and names - {_MASK, _PHASE, _LOCK}) or (place.exists() and not place.is_dir()):
        raise ValueError(f"expected a new folder for tiles, got {place}, which holds something else")
    place.mkdir(parents=True, exist_ok=True)
    lock = FileLock(place / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"expected tiles that no other run uses, got {place}, which is in use") from None
    try:
        _prepare(place, shape, identity(**run))
        yield FolderStore(place)
    finally:
        lock.release()


def _prepare(place: Path, shape: tuple[int, int, int], run: dict[str, str]) -> None:
    """Make the arrays of a new folder; raise ValueError where an old one is another run's."""
    if (place / _RUN).exists():
        other = json.loads((place / _RUN).read_bytes())
        names = [name for name in {**other, **run} if other.get(name) != run.get(name)]
        if names:
            parts = "; ".join(f"{name} {other.get(name)} instead of {run.get(name)}" for name in names)
            raise ValueError(f"expected tiles of this run, got some with {parts}: delete {place} to start again")
        return
    for name, kind in ((_MASK, np.bool_), (_PHASE, np.float32)):
        np.lib.format.open_memmap(place / name, mode="w+", dtype=kind, shape=shape).flush()
    write_content(place / _RUN, json.dumps(run, indent=2))


# ---- lowering --------------------------------------------------------------------------------------------------------


class Problem(Protocol):
    """What is lowered, and from where: the same voxels whatever the box."""

    @property
    def law(self) -> Coefficients | None:
        """Coefficients with lengths in the scan's unit; None for the start itself."""
        ...

    @property
    def steps(self) -> int:
        """Steps of the flow."""
        ...

    @property
    def parts(self) -> dict[str, object]:
        """What tells the problem from others, by name."""
        ...

    def terms(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Data]:
        """Return the start and the data term on a box."""
        ...

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the phase field of a start, on the scan's voxels."""
        ...

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the mask, bool (Z, Y, X), of a phase field on a box."""
        ...


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
    workers: Workers | None = None,
    progress: Progress = silent,
) -> LoweredVolume:
    """Lower a problem on each tile of a volume, and return the whole.

    Parameters
    ----------
    store
        A folder in which finished tiles stay, those of an earlier, killed run too; by default they are in memory.
    workers
        Whoever lowers the tiles, by default this process, one after another.
    """
    run = {**problem.parts, "law": problem.law, "steps": problem.steps, "tiles": tiling.counts, "place": tiling.place}
    opened = nullcontext(MemoryStore(tiling.shape)) if store is None else open_store(store, tiling.shape, run)
    with opened as finished:
        tiles = tiling.tiles
        rest = [tile for tile in tiles if not finished.has(tile.number)]
        if workers is None:
            pieces = _in_turn(problem, tiling, rest, progress)
        else:
            lower = partial(_lower_tiles, problem, tiling)
            pieces = collect_all(workers, [(lower, Path(), [tile.number]) for tile in rest])
        for count, piece in enumerate(pieces, tiling.count - len(rest) + 1):
            finished.write(tiles[piece.number].core, piece)
            progress("lowering the energy", count / tiling.count)
        energies = [finished.energies(tile.number) for tile in tiles]
        mask, phase = finished.volume()
    steps = 0 if problem.law is None else problem.steps
    return LoweredVolume(mask, phase, tuple(map(sum, zip(*energies, strict=True))), steps)


def _in_turn(problem: Problem, tiling: Tiling, tiles: Sequence[Tile], progress: Progress) -> Iterator[Piece]:
    """Lower tiles one after another."""
    total = tiling.count
    for count, tile in enumerate(tiles, total - len(tiles)):
        yield _lower_tile(problem, tiling, tile, sub_progress(progress, count / total, (count + 1) / total))


def _lower_tiles(problem: Problem, tiling: Tiling, _: Path, numbers: Sequence[int]) -> list[Piece]:
    """Lower tiles by their numbers, as workers do, each on one thread: the workers share the cores."""
    tiles = tiling.tiles
    with one_thread():
        return [_lower_tile(problem, tiling, tiles[number], silent) for number in numbers]


def _lower_tile(problem: Problem, tiling: Tiling, tile: Tile, progress: Progress) -> Piece:
    place, energies = tiling.place_of(tile), ()
    level, term = problem.terms(tile.box, place)
    if problem.law is None:
        phase = problem.plain(level, place)
    else:
        flow = lower_energy(level, problem.law, term, place, problem.steps, progress)
        phase, energies = place.to_scan(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[tile.inner])
    return Piece(tile.number, problem.mask(phase, tile.core), phase, energies)
