"""Finished tiles of a volume, in memory or in a folder that outlives a killed run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from curvafit.core.files import write_content
from curvafit.generation.checkpoint import identity
from curvafit.volumes.formats.part import Box

__all__ = ["FolderStore", "MemoryStore", "Piece", "folder_store"]

#: Files of a folder: what it belongs to, the volume's arrays, and the lock of the run that uses it.
_RUN, _MASK, _PHASE, _LOCK = "run.json", "mask.npy", "phase.npy", "lock"


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
        """Return whether a tile is there."""
        return number in self._energies

    def write(self, core: Box, piece: Piece) -> None:
        """Add a tile."""
        self._mask[core], self._phase[core] = piece.mask, piece.phase
        self._energies[piece.number] = piece.energies

    def energies(self, number: int) -> tuple[float, ...]:
        """Return the last two energies of a tile's flow."""
        return self._energies[number]

    def volume(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask and the phase field."""
        return self._mask, self._phase


class FolderStore:
    """Tiles of a volume in a folder; open with `folder_store`.

    The arrays are files of the volume's size, which are mapped. A tile has a note, `000012.json`, which is written once
    the tile's voxels are on the disk: a killed run loses the tile it was at and nothing else.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, number: int) -> bool:
        """Return whether a tile is there."""
        return self._note(number).exists()

    def write(self, core: Box, piece: Piece) -> None:
        """Add a tile."""
        for name, values in ((_MASK, piece.mask), (_PHASE, piece.phase)):
            array = np.load(self._folder / name, mmap_mode="r+")
            array[core] = values
            array.flush()
        write_content(self._note(piece.number), json.dumps(piece.energies))

    def energies(self, number: int) -> tuple[float, ...]:
        """Return the last two energies of a tile's flow."""
        return tuple(json.loads(self._note(number).read_bytes()))

    def volume(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask and the phase field, mapped: they are read where they are used."""
        mask, phase = (np.load(self._folder / name, mmap_mode="r") for name in (_MASK, _PHASE))
        return mask, phase

    def _note(self, number: int) -> Path:
        return self._folder / f"{number:06d}.json"


@contextmanager
def folder_store(
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
    there = {path.name for path in place.iterdir()} if place.is_dir() else set()
    if (_RUN not in there and there - {_MASK, _PHASE, _LOCK}) or (place.exists() and not place.is_dir()):
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
