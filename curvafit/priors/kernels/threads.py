"""numba's threads: started without a trace, and how many of them a loop gets."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

from numba import get_num_threads, set_num_threads


@cache
def start() -> None:
    """Start numba's threads, which its first parallel loop would do too, once in a process.

    With OpenMP that sets the number of threads of the thread that starts them to the number of cores, and lets parallel
    loops nest; torch's loops go by the same settings. So a thread does it that ends with it. It also settles how
    `multiprocessing` starts processes, which a program may choose once, and later than here: that is left open again.
    """
    chosen = multiprocessing.get_start_method(allow_none=True)
    with ThreadPoolExecutor(1, "curvafit-start") as elsewhere:
        elsewhere.submit(get_num_threads).result()
    multiprocessing.set_start_method(chosen, force=True)


def allowed() -> int:
    """How many threads numba's loops may take."""
    start()
    return get_num_threads()


@contextmanager
def limited(threads: int) -> Iterator[None]:
    """Run numba's loops on so many threads at most."""
    before = allowed()
    set_num_threads(min(threads, before))
    try:
        yield
    finally:
        set_num_threads(before)
