"""Passes over the blocks of a volume, by workers. Records may stay in a folder, so that a killed run goes on."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from curvafit.core.files import remove, write_content
from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Cluster, join_workers, run_jobs
from curvafit.priors.kernels.threads import one_thread
from curvafit.volumes.formats.base import ScanError
from curvafit.volumes.read import FileArray

#: Arrays and numbers of a block of a volume, by name.
Record = Mapping[str, Any]
#: The file in a run's folder with the settings of the run that it belongs to.
_RUN = "run.json"


class Run:
    """Runs passes over the blocks of a volume: a pass is a function of a block's number, whose record is kept.

    Parameters
    ----------
    crew
        Who does it, by default this process; each of several workers has one thread.
    folder
        Where records stay, so that a killed run goes on; None for none.
    progress
        Called after each block.
    ends
        The share of the work that is done after a pass, by its name; other passes take a fiftieth each.
    """

    def __init__(
        self,
        crew: Cluster | None = None,
        folder: Path | None = None,
        progress: Progress = silent,
        ends: Mapping[str, float] | None = None,
    ) -> None:
        self.alone = crew is None
        self.processes = 1 if crew is None else max(1, crew.places // 2)
        self._crew, self._folder, self._progress, self._ends = crew, folder, progress, ends or {}
        self._share = 0.0

    def __call__(
        self,
        name: str,
        function: Callable[[int], Record],
        count: int,
        shown: str = "",
        keep: Callable[[int, Record], Record] = lambda _, record: record,
    ) -> list[Record]:
        """Return the records `function(number)` of blocks 0 to `count` - 1, in this order.

        The progress shows the pass's name, or `shown`. In this process `keep` is called with each new record, to store
        its voxels, and returns the record that is kept.
        """
        records = {} if self._folder is None else _read_records(self._folder, name, count)
        missing = [number for number in range(count) if number not in records]
        start = self._share
        self._share = stop = max(start, min(self._ends.get(name, start + 0.02), 1.0))
        self._progress(shown or name, start)
        compute = partial(_compute_record, function, not self.alone)
        for done, (number, record) in enumerate(run_jobs(compute, missing, self._crew), count - len(missing) + 1):
            records[number] = keep(number, record)
            if self._folder is not None:
                buffer = io.BytesIO()
                np.savez(buffer, allow_pickle=False, **records[number])
                write_content(_file_of(self._folder, name, number), buffer.getvalue())
            self._progress(shown or name, start + (stop - start) * done / count)
        return [records[number] for number in range(count)]

    def open(self, name: str, dtype: Any, shape: tuple[int, ...]) -> RunArray:
        """Return an array that blocks fill, in memory or in a mapped file where records stay."""
        return RunArray(None if self._folder is None else self._folder / f"{name}.npy", dtype, shape)


class RunArray:
    """An array that a run fills box by box: in memory, or in a file that is mapped for each box alone."""

    def __init__(self, path: Path | None, dtype: Any, shape: tuple[int, ...]) -> None:
        self._path, self.shape = path, shape
        if path is None:
            self._array = np.empty(shape, dtype)
        elif not path.exists():
            temporary = path.with_name(f"{path.name}.new")
            np.lib.format.open_memmap(temporary, mode="w+", dtype=dtype, shape=shape).flush()
            os.replace(temporary, path)

    def __setitem__(self, box: Any, values: np.ndarray) -> None:
        array = self._array if self._path is None else np.load(self._path, mmap_mode="r+")
        array[box] = values
        if isinstance(array, np.memmap):
            array.flush()

    def __getitem__(self, box: Any) -> np.ndarray:
        return self.values[box]

    @property
    def values(self) -> np.ndarray:
        """The array, or the mapped file, which is not to be written to."""
        return self._array if self._path is None else np.load(self._path, mmap_mode="r")

    @property
    def stored(self) -> Any:
        """The array, or what reads boxes of it from the file, in any process."""
        return self._array if self._path is None else FileArray(self._path, {}, self.values)


def _compute_record(function: Callable[[int], Record], one_threaded: bool, number: int) -> tuple[int, Record]:
    with one_thread() if one_threaded else nullcontext():
        return number, function(number)


def _file_of(folder: Path, name: str, number: int) -> Path:
    return folder / f"{name.replace(' ', '-').replace(chr(39), '')}-{number:06d}.npz"


def _read_records(folder: Path, name: str, count: int) -> dict[int, Record]:
    """Return the records of a pass that earlier runs stored, by number of the block."""
    records = {}
    for number in range(count):
        path = _file_of(folder, name, number)
        if path.exists():
            with np.load(path, allow_pickle=False) as arrays:
                records[number] = dict(arrays)
    return records


@contextmanager
def open_run(
    workers: Cluster | int | None,
    store: str | PathLike[str] | None,
    same: Mapping[str, Any],
    progress: Progress = silent,
    ends: Mapping[str, float] | None = None,
) -> Iterator[Run]:
    """Return a context with a run on workers, or on a number of new processes, whose records stay in a folder `store`.

    `same` are settings that runs must have in common to share records; `ends` are the shares of the work, as in `Run`.
    Raises ValueError where the folder holds something else or another run's records, or is in use. If a ScanError is
    raised within, the folder is removed: a scan that cannot be used has no use for its records.
    """
    settings = {name: str(value) for name, value in {**same, "curvafit": version("curvafit")}.items()}
    locked = nullcontext() if store is None else _lock_folder(Path(store), settings)
    with join_workers(workers) as crew, locked as folder:
        yield Run(crew, folder, progress, ends)


@contextmanager
def _lock_folder(folder: Path, settings: Mapping[str, str]) -> Iterator[Path]:
    """Lock the folder of a run, made if it is missing; raise ValueError if it is not one of a run with `settings`."""
    # What begins with a dot is a file that a killed run was writing.
    names = {path.name for path in folder.iterdir() if path.name[0] != "."} if folder.is_dir() else set()
    if (_RUN not in names and names - {"lock"}) or (folder.exists() and not folder.is_dir()):
        raise ValueError(f"tiles need a new folder, but {folder} holds something else")
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"the tiles in {folder} are in use by another run") from None
    try:
        stored = json.loads((folder / _RUN).read_bytes()) if (folder / _RUN).exists() else settings
        if changed := [name for name in sorted({**stored, **settings}) if stored.get(name) != settings.get(name)]:
            listed = ", ".join(changed)
            raise ValueError(f"the tiles in {folder} are another run's, which differs in {listed}: delete them")
        write_content(folder / _RUN, json.dumps(settings, indent=2))
        yield folder
    except ScanError:
        remove(folder)
        raise
    finally:
        lock.release()
