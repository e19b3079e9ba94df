"""Jobs run by this process, or by the workers of a dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from curvafit.core.checks import check_int, require

if TYPE_CHECKING:
    from distributed import Client

#: Where workers on this machine listen.
LOOPBACK = "127.0.0.1"
#: Seconds that a scheduler has to answer.
PATIENCE = 10
#: A worker's environment, which this process gets too. Dask has the C library give memory back at once: arrays of a
#: megabyte are then mapped anew each time, and measuring shapes takes nearly four times as long. From eight
#: megabytes on, as tiles have them, they are given back.
_ENVIRONMENT = {
    "DASK_LOGGING__DISTRIBUTED": "critical",
    "MALLOC_TRIM_THRESHOLD_": 1 << 26,
    "MALLOC_MMAP_THRESHOLD_": 1 << 23,
}
#: What a worker on this machine runs first: Ctrl-C in the terminal is for the main process, which ends its workers.
_IGNORE_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"


class Cluster:
    """The workers of a dask cluster, which must see folders under the same names.

    `submit` hands out a job, `collect` waits for any job and returns its result. `places` is the number of jobs that
    may be handed out at once. A job whose worker dies goes to another.
    """

    def __init__(self, client: Client) -> None:
        from distributed import as_completed

        if not client.nthreads():
            raise OSError(f"the scheduler at {client.scheduler.address} has no workers")  # type: ignore
        self._client = client
        self._futures = as_completed()

    @property
    def places(self) -> int:
        """Return two jobs for each thread there is now; at least one, since workers may still come."""
        return max(1, 2 * sum(self._client.nthreads().values()))  # type: ignore

    def submit(self, function: Callable[[Any], Any], job: Any) -> None:
        self._futures.add(self._client.submit(function, job, pure=False))

    def collect(self) -> Any:
        from distributed import KilledWorker

        finished = next(self._futures)
        try:
            return finished.result()
        except KilledWorker as error:
            raise OSError(f"a part of the work killed several workers: {error}") from error


def run_jobs(function: Callable[[Any], Any], jobs: Iterable[Any], workers: Cluster | None = None) -> Iterator[Any]:
    """Yield `function(job)` for each job, in the order in which they finish; by default this process runs them in turn.

    At most `workers.places` jobs are handed out at once. Workers must be able to import the function by its name.
    """
    if workers is None:
        yield from map(function, jobs)
        return
    remaining, running = iter(jobs), 0
    while True:
        while running < workers.places and (job := next(remaining, None)) is not None:
            workers.submit(function, job)
            running += 1
        if not running:
            return
        yield workers.collect()
        running -= 1


def check_workers(count: int | None, scheduler: str | None) -> None:
    """Raise ValueError if the number of workers is out of range, or is given with a scheduler, which has its own."""
    if count is not None:
        check_int(count, "a number of workers from 0", 0, 1024)
        if scheduler is not None:
            raise ValueError(f"give either a number of workers or a scheduler, got {count} and {scheduler}")


@contextmanager
def cluster(count: int | None = None, scheduler: str | None = None) -> Iterator[Cluster | None]:
    """Start `count` workers on this machine, or take those of a dask scheduler; end them with the block.

    Raises ImportError if dask.distributed is needed and not installed, and OSError if there is no scheduler at the
    address, it has no workers, or it ends.

    Parameters
    ----------
    count
        Processes on this machine, which talk over the loopback alone; by default one for each core that this process
        may use. With 0 the block gets None: this process does the work.
    scheduler
        Address of a scheduler, whose workers are used.
    """
    check_workers(count, scheduler)
    if count == 0 and scheduler is None:
        yield None
        return
    require("distributed", "synth", "work by several processes")
    with _connect(scheduler) if scheduler is not None else _start(count) as client:
        yield Cluster(client)


def join_workers(workers: Cluster | int | None) -> AbstractContextManager[Cluster | None]:
    """Return a context with the given workers, or with that many new processes on this machine; None stays None."""
    return cluster(workers) if isinstance(workers, int) else nullcontext(workers)


@contextmanager
def _start(count: int | None) -> Iterator[Client]:
    """Start workers on this machine."""
    import dask.config
    import distributed
    from dask.system import CPU_COUNT

    environment = {f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in _ENVIRONMENT.items()}
    with (
        dask.config.set(environment),
        distributed.LocalCluster(
            n_workers=CPU_COUNT if count is None else count,
            threads_per_worker=1,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,
            silence_logs=logging.ERROR,
            preload=_IGNORE_INTERRUPTS,
        ) as local_cluster,
        distributed.Client(local_cluster) as client,
    ):
        yield client


@contextmanager
def _connect(address: str) -> Iterator[Client]:
    """Connect to a scheduler."""
    import distributed
    from distributed.comm.core import CommClosedError

    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise OSError(f"found no dask scheduler at {address} within {PATIENCE} s") from error
    with client:
        try:
            yield client
        except (CommClosedError, CancelledError) as error:
            raise OSError(f"the dask scheduler at {address} is gone: {error}") from error
