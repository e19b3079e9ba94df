"""Lowering the energy of a volume of any size: tile by tile, with what is finished kept in a store."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from curvafit.core.runtime import Progress, part, silent
from curvafit.generation.data import Data
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.engine import completed
from curvafit.segmentation.tile_store import MemoryStore, Piece, folder_store
from curvafit.segmentation.tiles import Tile, Tiling
from curvafit.segmentation.working import WorkingGrid
from curvafit.volumes.formats.part import Box

__all__ = ["Lowered", "Problem", "Workers", "lowered"]

_LOWERING = "lowering the energy"


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

    def given(self, box: Box, place: WorkingGrid) -> tuple[np.ndarray, Data]:
        """Return the start and the data term on a box."""
        ...

    def plain(self, level: np.ndarray, place: WorkingGrid) -> np.ndarray:
        """Return the phase field of a start, on the scan's voxels."""
        ...

    def mask(self, phase: np.ndarray, box: Box) -> np.ndarray:
        """Return the mask, bool (Z, Y, X), of a phase field on a box."""
        ...


@dataclass(frozen=True, eq=False)
class Lowered:
    """A volume's mask (Z, Y, X), bool, and phase field, float32, the last two energies of its flow, and its steps."""

    mask: np.ndarray
    phase: np.ndarray
    energies: tuple[float, ...]
    steps: int


class Workers(Protocol):
    """Whoever lowers tiles, several at once: `curvafit.data_synth.atlas.workers`."""

    @property
    def places(self) -> int:
        """Return how many tiles may be asked for at once."""
        ...

    def submit(self, make: Callable[[Path, Sequence[int]], list[Any]], path: Path, indices: Sequence[int]) -> None:
        """Ask for tiles by their numbers."""
        ...

    def done(self) -> list[Any]:
        """Wait for some of what was asked for, and return the pieces."""
        ...


def lowered(
    problem: Problem,
    tiling: Tiling,
    *,
    store: str | PathLike[str] | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> Lowered:
    """Lower a problem on each tile of a volume, and return the whole.

    Parameters
    ----------
    store
        A folder in which finished tiles stay, those of an earlier, killed run too; by default they are in memory.
    workers
        Whoever lowers the tiles, by default this process, one after another.

    Raises
    ------
    ScanError
        As `engine.completed`.
    ValueError
        If the store has the tiles of another problem, or another run uses it.
    """
    run = {**problem.parts, "law": problem.law, "steps": problem.steps, "tiles": tiling.counts, "place": tiling.place}
    pieces = nullcontext(MemoryStore(tiling.shape)) if store is None else folder_store(store, tiling.shape, run)
    with pieces as stored:
        tiles = tiling.tiles
        rest = [tile for tile in tiles if not stored.has(tile.number)]
        made = _in_turn(problem, tiling, rest, progress) if workers is None else _by(workers, problem, tiling, rest)
        for count, piece in enumerate(made, tiling.count - len(rest) + 1):
            stored.write(tiles[piece.number].core, piece)
            progress(_LOWERING, count / tiling.count)
        energies = [stored.energies(tile.number) for tile in tiles]
        mask, phase = stored.volume()
    return Lowered(mask, phase, tuple(map(sum, zip(*energies, strict=True))), problem.steps)


def _in_turn(problem: Problem, tiling: Tiling, tiles: Sequence[Tile], progress: Progress) -> Iterator[Piece]:
    """Lower tiles one after another."""
    total = tiling.count
    for count, tile in enumerate(tiles, total - len(tiles)):
        yield _piece(problem, tiling, tile, part(progress, count / total, (count + 1) / total))


def _by(workers: Workers, problem: Problem, tiling: Tiling, tiles: Sequence[Tile]) -> Iterator[Piece]:
    """Lower tiles by workers, in any order."""
    waiting, asked = list(tiles), 0
    while waiting or asked:
        while waiting and asked < workers.places:
            workers.submit(partial(_pieces, problem, tiling), Path(), [waiting.pop(0).number])
            asked += 1
        pieces = workers.done()
        asked -= len(pieces)
        yield from pieces


def _pieces(problem: Problem, tiling: Tiling, _: Path, numbers: Sequence[int]) -> list[Piece]:
    """Lower tiles by their numbers, as workers do."""
    tiles = tiling.tiles
    return [_piece(problem, tiling, tiles[number], silent) for number in numbers]


def _piece(problem: Problem, tiling: Tiling, tile: Tile, progress: Progress) -> Piece:
    """Lower a tile."""
    place, energies = tiling.place_of(tile), ()
    level, term = problem.given(tile.box, place)
    if problem.law is None:
        phase = problem.plain(level, place)
    else:
        flow = completed(level, problem.law, term, place, problem.steps, progress)
        phase, energies = place.back(flow.field), tuple(map(float, flow.history.energy[-2:]))
    phase = np.ascontiguousarray(phase[tile.inner])
    return Piece(tile.number, problem.mask(phase, tile.core), phase, energies)
