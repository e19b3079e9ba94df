"""Loops over chunks on numba's threads, or on none, and the number of threads that they take."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

import torch
from numba import get_num_threads, njit, set_num_threads
from numba.core.cpu import CPUTargetOptions
from numba.core.options import TargetOptions
from numba.np.ufunc import threading_layer

from curvafit.core.runtime import is_forked

# numba has this flag, which its parallel loops set, but no option for it: arrays among the arguments do not overlap.
CPUTargetOptions.noalias = TargetOptions.Mapping("noalias")  # type: ignore[attr-defined]
# numba's decorators have no types that a checker can read.
_njit: Any = njit
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
#: In a thread of `map_threads`, the event `left` says that nobody waits for its result.
_LOCAL = threading.local()
#: Held where numba's threads serve one caller at a time.
_ONE_CALLER = threading.Lock()


class Kernel:
    """A loop over chunks, compiled on demand in two forms: parallel on numba's threads, and serial without them.

    A call for one thread takes the serial form, and so does every call in a forked process, as numba's threads do not
    survive a fork. Arrays among the arguments must not overlap.
    """

    def __init__(self, function: Callable[..., None], **options: Any) -> None:
        copy = FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__)
        copy.__qualname__ = f"{function.__qualname__}_alone"  # numba's cache distinguishes functions by this name
        self._parallel = _njit(parallel=True, **options)(function)
        self._serial = _njit(noalias=True, **options)(copy)

    def __call__(self, threads: int, *arguments: Any) -> None:
        """Run the loop on at most `threads` threads; KeyboardInterrupt where `map_threads` was left."""
        left = getattr(_LOCAL, "left", None)
        if left is not None and left.is_set():
            raise KeyboardInterrupt
        threads = min(threads, count_threads()) if threads > 1 else 1
        if threads == 1:
            self._serial(*arguments)
            return
        with _ONE_CALLER if threading_layer() == "workqueue" else nullcontext(), limit_threads(threads):
            self._parallel(*arguments)

    def is_compiled(self) -> bool:
        """Return whether either form is compiled: in this process, or in numba's cache as far as file names say."""
        compiled = self._parallel.signatures or self._serial.signatures
        folder, name = Path(self._parallel.stats.cache_path), self._parallel.py_func.__qualname__
        return bool(compiled) or any(folder.glob(f"*.{name}*.nbi"))


@cache
def start() -> None:
    """Start numba's threads, once in a process, as its first parallel loop would do too.

    With OpenMP the start changes settings of the calling thread that torch's loops follow too: the number of threads,
    and whether parallel loops nest. So a short-lived thread makes the call. The start also fixes the start method of
    `multiprocessing`, which a program may want to choose later; it is reset here.
    """
    start_method = multiprocessing.get_start_method(allow_none=True)
    with ThreadPoolExecutor(1, "curvafit-start") as short_lived:
        short_lived.submit(get_num_threads).result()
    multiprocessing.set_start_method(start_method, force=True)


def count_threads() -> int:
    """Return how many threads our loops may take: no more than torch or numba may, and one in a forked process."""
    torch_threads = torch.get_num_threads()
    if torch_threads == 1 or is_forked():
        return 1
    start()
    return min(torch_threads, get_num_threads())


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """Run numba's loops on at most `threads` threads."""
    if is_forked():
        yield
        return
    start()
    before = get_num_threads()
    set_num_threads(min(threads, before))
    try:
        yield
    finally:
        set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and our loops to one thread, so that sums, and with them fields, do not depend on the machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def map_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Yield the results of a function of each item, in order, computed side by side on one thread each.

    Flows of small boxes are faster so than one after another on all threads, which wait for each other several times a
    step. Where the caller leaves before the end, work that has begun ends at its next loop.
    """
    threads, before, left = count_threads(), torch.get_num_threads(), threading.Event()

    def begin() -> None:
        torch.set_num_threads(1)
        _LOCAL.left = left

    if threads == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(threads, initializer=begin)
    try:
        yield from pool.map(function, items)
    finally:
        left.set()
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(before)  # the pool's threads have set the number of those to come as well
