"""numba's threads: their start, which leaves the process's settings unchanged, and their number."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

import torch
from numba import get_num_threads, set_num_threads


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
    """Return how many threads numba's loops may use."""
    start()
    return get_num_threads()


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """Run numba's loops on at most `threads` threads."""
    before = count_threads()
    set_num_threads(min(threads, before))
    try:
        yield
    finally:
        set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Give torch and numba one thread: sums, and so voxels, do not depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with limit_threads(1):
            yield
    finally:
        torch.set_num_threads(before)
