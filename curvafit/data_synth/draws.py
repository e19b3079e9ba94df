"""Making draws: what a worker does with some indices of a store."""

from __future__ import annotations

import importlib.metadata
import math
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numba
import torch
from llvmlite import binding

from curvafit.data_synth.design import Design, Draw
from curvafit.data_synth.store import Record, Settings, Store, open_store
from curvafit.generation.batch import generate_batch
from curvafit.generation.result import Flow
from curvafit.generation.schedule import Schedule
from curvafit.priors.grid import Grid
from curvafit.priors.kernels import threads


def make(path: str | Path, indices: Sequence[int]) -> list[Record]:
    """Make the draws of a store that are not there yet, write each as soon as it is done, and return all records.

    An NVIDIA device makes them together, a processor one after another and each on one thread, so that a field depends
    on nothing but its store's settings, its index and the machine's kind.

    Raises
    ------
    OSError
        If the store can't be read or written.
    """
    store = open_store(path)
    try:
        return _made(store, indices)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or str(store.path)) from error


def _made(store: Store, indices: Sequence[int]) -> list[Record]:
    missing = [index for index in indices if not store.has(index)]
    began = time.perf_counter()
    for index, (draw, flow) in zip(missing, flows(store.settings, missing), strict=True):
        seconds, began = time.perf_counter() - began, time.perf_counter()
        record = _record(index, draw, flow, seconds)
        store.write(record, flow.field.cpu().numpy().astype("float32") if record.viability.viable else None)
    return [store.record(index) for index in indices]


def flows(settings: Settings, indices: Sequence[int]) -> Iterator[tuple[Draw, Flow]]:
    """Yield parameters and flow of each of a store's draws, in order."""
    if not indices:
        return
    design = Design.from_dict(settings.design)
    draws = [design.draw(settings.seed, index) for index in indices]
    made = generate_batch(
        [draw.coefficients for draw in draws],
        [draw.mass for draw in draws],
        Grid(settings.shape, settings.spacing),
        seeds=[draw.seed for draw in draws],
        schedule=Schedule(**settings.schedule),
        epsilon=settings.epsilon,
        blur=settings.blur,
        reject_early=True,
        device=device(),
    )
    with one_thread():
        yield from zip(draws, made, strict=True)


def device() -> str:
    """Return the device on which this process makes draws."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def versions() -> dict[str, str]:
    """Return the versions that a generated field's bits depend on: Python, libraries, processor."""
    names = ("curvafit", "torch", "numpy", "numba")
    chip = torch.cuda.get_device_name() if device() == "cuda" else binding.get_host_cpu_name()
    return {"python": platform.python_version(), "processor": chip} | {name: _version(name) for name in names}


def _record(index: int, draw: Draw, flow: Flow, seconds: float) -> Record:
    return Record(
        index=index,
        coefficients=draw.coefficients,
        mass=draw.mass,
        seed=draw.seed,
        steps=int(flow.history.step[-1]) if len(flow.history.step) else 0,
        viability=flow.viability,
        energy=float(flow.history.energy[-1]) if len(flow.history.energy) else math.nan,
        status=flow.status,
        versions=versions(),
        seconds=seconds,
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Give torch and numba one thread: sums, and so voxels, do not depend on the number of threads."""
    before = torch.get_num_threads(), threads.allowed()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
