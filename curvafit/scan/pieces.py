"""Finding something in the pieces of a volume, by workers; what was found may stay in a folder that outlives a kill."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from curvafit.core.files import remove, write_content
from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import ThisProcess, Workers, collect_all, join_workers
from curvafit.priors.kernels.threads import one_thread
from curvafit.volumes.volume import ScanError

#: Arrays and numbers that were found in a piece of a volume, by name.
Found = Mapping[str, Any]
#: The file in a run's folder that says whose it is.
RUN = "run.json"


class Finder:
    """Finds something in the pieces of a volume, by workers of one thread each, and keeps it in a folder, if there is
    one; `ends` has the share that is done after a pass, by the pass's name: the others take a fiftieth each."""

    def __init__(self, crew: Workers, folder: Path | None, progress: Progress, ends: Mapping[str, float]) -> None:
        self.processes = 1 if isinstance(crew, ThisProcess) else max(1, crew.places // 2)
        self._crew, self._folder, self._progress, self._ends = crew, folder, progress, ends
        self._share = 0.0

    def __call__(self, name: str, find: Any, count: int, shown: str = "") -> Iterator[Found]:
        """Return what is found in each piece, in their order; the progress says the name, or what is `shown`."""
        found = {} if self._folder is None else _read_found(self._folder, name, count)
        rest = [number for number in range(count) if number not in found]
        start = self._share
        self._share = stop = max(start, min(self._ends.get(name, start + 0.02), 1.0))
        make = partial(_find, find, not isinstance(self._crew, ThisProcess))
        requests = [(make, Path(), [number]) for number in rest]
        self._progress(shown or name, start)
        for done, (number, each) in enumerate(collect_all(self._crew, requests), count - len(rest) + 1):
            found[number] = each
            if self._folder is not None:
                _write_found(self._folder, name, number, each)
            self._progress(shown or name, start + (stop - start) * done / count)
        return iter([found[number] for number in range(count)])


def _find(find: Any, alone: bool, _: Path, numbers: Sequence[int]) -> list[tuple[int, Found]]:
    """Find something in pieces by their numbers; on one thread where workers share the cores."""
    with one_thread() if alone else nullcontext():
        return [(number, find(number)) for number in numbers]


def _file_of(folder: Path, name: str, number: int) -> Path:
    return folder / f"{name.replace(' ', '-').replace(chr(39), '')}-{number:06d}.npz"


def _read_found(folder: Path, name: str, count: int) -> dict[int, Found]:
    """Return what earlier runs found, by number of the piece."""
    found = {}
    for number in range(count):
        path = _file_of(folder, name, number)
        if path.exists():
            with np.load(path, allow_pickle=False) as arrays:
                found[number] = dict(arrays)
    return found


def _write_found(folder: Path, name: str, number: int, found: Mapping[str, np.ndarray]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **found)
    write_content(_file_of(folder, name, number), buffer.getvalue())


@contextmanager
def open_finder(
    workers: Workers | int | None,
    store: str | PathLike[str] | None,
    run: Mapping[str, Any],
    progress: Progress = silent,
    ends: Mapping[str, float] | None = None,
) -> Iterator[Finder]:
    """Start workers, or a number of processes, open the folder of a run, if there is one, and return what finds."""
    same = {name: str(each) for name, each in run.items()}
    with join_workers(workers) as joined, nullcontext() if store is None else open_store(store, same) as folder:
        yield Finder(joined or ThisProcess(), folder, progress, ends or {})


@contextmanager
def open_store(folder: str | PathLike[str], run: Mapping[str, str]) -> Iterator[Path]:
    """Open the folder of a run, which is removed where a ScanError is raised; ValueError if it holds another run's."""
    try:
        with lock_store(folder) as (place, other):
            if other not in (None, run):
                changed = ", ".join(sorted(name for name in run if other.get(name) != run[name]))
                raise ValueError(f"the tiles in {place} are another run's, which differs in {changed}: delete them")
            write_content(place / RUN, json.dumps(run, indent=2))
            yield place
    except ScanError:  # of a scan that cannot be measured nothing is of use
        remove(Path(folder))
        raise


@contextmanager
def lock_store(folder: str | PathLike[str], own: Sequence[str] = ()) -> Iterator[tuple[Path, Any]]:
    """Make the folder of a run, if there is none, and lock it; return it, and what it says of its run, if anything.

    Raises ValueError if the folder holds other things than a run's, and its `own` files, or is in use.
    """
    place = Path(folder)
    names = {path.name for path in place.iterdir()} if place.is_dir() else set()
    if (RUN not in names and names - {"lock", *own}) or (place.exists() and not place.is_dir()):
        raise ValueError(f"tiles need a new folder, but {place} holds something else")
    place.mkdir(parents=True, exist_ok=True)
    lock = FileLock(place / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"the tiles in {place} are in use by another run") from None
    try:
        yield place, json.loads((place / RUN).read_bytes()) if (place / RUN).exists() else None
    finally:
        lock.release()
