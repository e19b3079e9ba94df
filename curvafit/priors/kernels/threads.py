"""Loops over chunks on numba's threads, or on none, and the number of threads that they take."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

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
#: Held where numba's threads serve one caller at a time.
_ONE_CALLER = threading.Lock()


class Kernel:
    """Run a loop over chunks on numba's threads, or on none of them: two forms of one function, compiled on demand.

    A call for one thread takes the serial form, and so does every call in a forked process, as numba's threads do not
    survive a fork. Arrays among the arguments must not overlap.
    """

    def __init__(self, function: Callable[..., None], **options: Any) -> None:
        alone = FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__)
        alone.__qualname__ = f"{function.__qualname__}_alone"  # numba's cache tells functions apart by this name
        self._together = _njit(parallel=True, **options)(function)
        self._alone = _njit(noalias=True, **options)(alone)

    def __call__(self, threads: int, *arguments: Any) -> None:
        """Run the loop on at most `threads` threads."""
        threads = min(threads, count_threads()) if threads > 1 else 1
        if threads == 1:
            self._alone(*arguments)
            return
        with _ONE_CALLER if threading_layer() == "workqueue" else nullcontext(), limit_threads(threads):
            self._together(*arguments)

    def is_compiled(self) -> bool:
        """Return whether a form of the loop was compiled, in this process or, as far as file names say, before it."""
        made = self._together.signatures or self._alone.signatures
        folder, name = Path(self._together.stats.cache_path), self._together.py_func.__qualname__
        return bool(made) or any(folder.glob(f"*.{name}*.nbi"))


@cache
def start() -> None:
    """Start numba's threads, which its first parallel loop would do too, once in a process.

    With OpenMP the start changes settings of the thread that makes it, which torch's loops follow: the number of
    threads, and whether parallel loops nest. So a thread that ends at once makes it. The start also fixes the start
    method of `multiprocessing`, which a program may want to choose later; it is reset here.
    """
    chosen = multiprocessing.get_start_method(allow_none=True)
    with ThreadPoolExecutor(1, "curvafit-start") as elsewhere:
        elsewhere.submit(get_num_threads).result()
    multiprocessing.set_start_method(chosen, force=True)


def count_threads() -> int:
    """Return how many threads our loops may take: no more than torch or numba may, and one in a forked process."""
    most = torch.get_num_threads()
    if most == 1 or is_forked():
        return 1
    start()
    return min(most, get_num_threads())


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
    """Give torch and our loops one thread: sums, and so voxels, do not depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
