"""The options of the workers that make draws and cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from curvafit.cli.console import kept, stages
from curvafit.cli.forecast import FLOW, say_forecast

if TYPE_CHECKING:
    from collections.abc import Sequence

    from curvafit.core.runtime import Progress
    from curvafit.core.workers import Workers

WorkersOption = Annotated[
    int | None,
    typer.Option(help="Worker processes on this machine; by default one per core, 0 for this process alone."),
]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Address of a running dask scheduler, tcp://HOST:PORT, instead of --workers.")
]
DashboardOption = Annotated[
    int | None,
    typer.Option(help="Port of dask's dashboard on 127.0.0.1, for workers on this machine; by default none."),
]


class Crew(NamedTuple):
    """The workers that the options ask for."""

    workers: int | None
    scheduler: str | None
    dashboard: int | None

    def check(self, shape: Sequence[int] | None = None) -> None:
        """Raise ValueError where the options contradict each other, or a shape does not fit into memory."""
        from curvafit.core.workers import check_workers
        from curvafit.generation.memory import FLOW, check_memory

        check_workers(self.workers, self.scheduler)
        if shape is not None and self.scheduler is None:
            check_memory(shape, FLOW, "a shape")

    def say_forecast(self, name: str, shape: Sequence[int], steps: float) -> None:
        """Print the forecast of flows that workers on this machine share; a scheduler's machines are unknown."""
        from curvafit.core.workers import processes
        from curvafit.priors.kernels.threads import one_thread

        if self.scheduler is None:
            with one_thread():
                say_forecast(name, shape, steps, FLOW, what="voxels a shape", workers=processes(self.workers))

    @contextmanager
    def at_work(self, again: Callable[[], str] = lambda: "the same command") -> Iterator[tuple[Workers, Progress]]:
        """Start the workers and their progress bar; `again` returns the command that resumes after an interrupt."""
        from curvafit.core.workers import cluster

        with kept(again), stages() as progress:
            progress("starting workers", 0.0)
            with cluster(*self) as workers:
                yield workers, progress
