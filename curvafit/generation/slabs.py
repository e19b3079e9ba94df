"""One shape over several processes: each steps a slab of the box, and gets what lies next to it from its neighbours.

The first process runs the flow; the others `serve` it until it ends. A step sends two arrays of `kernels.cpu.halo`
planes to each neighbour: div A, blurred in planes, and the energy's gradient. Everything else is computed where it is
needed, twice at the seams. So each voxel is the same, bit for bit, as in one process; sums over the box differ by the
order in which they are added.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from curvafit.core.runtime import one_line
from curvafit.generation.problem import Cost, DivergenceForm
from curvafit.generation.stepper import ADAM_EPS, FusedStepper, Statistics, Stepper
from curvafit.priors import kernels
from curvafit.priors.grid import Grid

#: How long a process waits for another one: the first may write a large checkpoint meanwhile.
PATIENCE = timedelta(hours=1)
#: The directions in which planes are sent, as tags of the messages.
_UP, _DOWN = 0, 1


@dataclass(frozen=True)
class Slab:
    """The planes that a process holds: its own, `first` to `last` - 1 of the box, and its neighbours' next ones.

    `places` are the planes' indices in the box, and `own`, `below` and `above` slices of them. The box's first and last
    planes are first and last here too, even if the box repeats, so that they are computed as in one process, to the
    last bit.
    """

    first: int
    last: int
    own: slice
    below: slice
    above: slice
    places: np.ndarray

    def cut(self, values: Any) -> Any:
        """Return the part of an array `(…, Z, Y, X)` that the process holds; a number as it is."""
        return values if np.ndim(values) == 0 else np.take(values, self.places, axis=-3)


def divide(grid: Grid, count: int, halo: int) -> list[Slab]:
    """Divide a box into slabs along z; raise ValueError where one would be thinner than a halo."""
    Z, slabs = grid.shape[0], []
    if Z // count < halo:
        raise ValueError(f"expected at least {halo} planes along z for each of {count} processes, got {Z} in all")
    for k in range(count):
        first, last = Z * k // count, Z * (k + 1) // count
        planes = {"below": np.arange(first - halo, first) % Z}
        planes |= {"own": np.arange(first, last), "above": np.arange(last, last + halo) % Z}
        order = ("own", "above", "below") if k == 0 else ("below", "own", "above")
        order = ("above", "below", "own") if 0 < k == count - 1 else order
        bounds = np.cumsum([0, *(len(planes[name]) for name in order)]).tolist()
        slices = {name: slice(*pair) for name, pair in zip(order, pairwise(bounds), strict=True)}
        slabs.append(Slab(first, last, **slices, places=np.concatenate([planes[name] for name in order])))
    return slabs


@contextmanager
def lead() -> Iterator[None]:
    """Join the processes that `torchrun` started, as the first of them; the others end with the block.

    Raises OSError where one of them is gone.
    """
    with _join():
        yield
        _broadcast("end")


def serve() -> None:
    """Join the processes that `torchrun` started, and step a slab for the first of them until it ends.

    Raises OSError where one of them is gone.
    """
    with _join():
        local: _LocalStepper | None = None
        while (message := _receive())[0] != "end":
            name, arguments = message
            with _report_lost_process():
                if name == "begin":
                    local = None  # frees an earlier shape's memory first
                    local = _LocalStepper(*arguments)
                else:
                    getattr(local, name)(*arguments)


def count_processes() -> tuple[int, int]:
    """Return the number of this process, from 0, and how many `torchrun` started; 0 and 1 without it."""
    return int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))


@contextmanager
def _join() -> Iterator[None]:
    try:
        dist.init_process_group("gloo", timeout=PATIENCE)
    except (ValueError, RuntimeError) as error:
        raise OSError(f"the other processes are not there: start them with torchrun ({one_line(str(error))})") from None
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def _report_lost_process() -> Iterator[None]:
    """Raise OSError, with a sentence, where an exchange fails because another process is gone."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(f"a process of the flow is gone ({one_line(str(error))})") from error


def _broadcast(name: str, *arguments: Any) -> None:
    """Send all other processes the name of a method of their `_LocalStepper`, or "begin" or "end", and arguments."""
    with _report_lost_process():
        dist.broadcast_object_list([(name, arguments)], src=0)


def _receive() -> tuple[str, tuple[Any, ...]]:
    message: list[Any] = [None]
    with _report_lost_process():
        dist.broadcast_object_list(message, src=0)
    return message[0]


class SlabStepper(Stepper):
    """One shape on the processors of several processes (`lead`); as `FusedStepper`, which goes on from its states."""

    def __init__(self, start: Tensor, form: DivergenceForm, cost: Cost, betas: tuple[float, float]) -> None:
        base = form.base.numpy() if isinstance(form.base, Tensor) else form.base
        a, epsilon, Q = kernels.to_numpy_cost(cost.coefficients, cost.grid, cost.epsilon, cost.orientation)
        from curvafit.priors.kernels import cpu

        slabs = divide(cost.grid, dist.get_world_size(), cpu.halo(cost.grid, cost.blur))
        self.betas, options = betas, {"width": cost.blur, "betas": betas, "adam_eps": ADAM_EPS, "orientation": Q}
        _broadcast("begin", slabs, cost.grid, options)
        with _report_lost_process():
            self._local = _LocalStepper(slabs, cost.grid, options, [*a, epsilon, base], start.numpy())

    def _call_all(self, name: str, *arguments: Any) -> Any:
        """Call a method of the `_LocalStepper` of every process; return this process's result."""
        _broadcast(name, *arguments)
        with _report_lost_process():
            return getattr(self._local, name)(*arguments)

    def step(self, rate: float | None) -> None:
        self.run([rate or 0.0])

    def run(self, rates: Sequence[float]) -> int:
        self._call_all("advance", list(rates), self.betas)
        return len(rates)

    def statistics(self) -> Statistics:
        return self._call_all("statistics")

    def field(self) -> Tensor:
        return self._call_all("field")

    def mass(self) -> float:
        return self._call_all("mass")

    def shift(self, amount: float) -> None:
        self._call_all("shift", amount)

    def state(self) -> dict[str, Any]:
        return self._call_all("state")

    def restore(self, state: dict[str, Any]) -> None:
        numbers = {name: value for name, value in state.items() if not isinstance(value, Tensor)}
        _broadcast("restore", numbers)
        with _report_lost_process():
            self._local.restore(numbers, {name: np.asarray(state[name]) for name in _ARRAYS})


#: The arrays of a state.
_ARRAYS = ("vector", "first", "second")


class _LocalStepper(FusedStepper):
    """The stepper of this process's slab; all processes call the same method at once, and the first gets the results.

    Only the first process has `numbers`, the coefficients, ε and the base, and `start`, A of the whole box.
    """

    def __init__(
        self, slabs: Sequence[Slab], grid: Grid, options: dict[str, Any], numbers: list[Any] | None = None,
        start: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        from curvafit.priors.kernels.cpu import FusedFlow
        from curvafit.priors.kernels.threads import count_threads, limit_threads

        self._slabs, self._rank = slabs, dist.get_rank()
        self._slab = slab = slabs[self._rank]
        self._shape = grid.shape
        received: list[Any] = [None]
        dist.scatter_object_list(received, None if numbers is None else [[*map(s.cut, numbers)] for s in slabs])
        *a, epsilon, base = received[0]
        local_grid = Grid((len(slab.places), *self._shape[1:]), grid.spacing, grid.boundary)
        start, exchange = self._scatter(start), partial(_exchange, slab, self._rank, len(slabs))
        # Processes of one machine share its cores.
        with limit_threads(max(1, count_threads() // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))):
            self._flow = FusedFlow(start, base, a, local_grid, epsilon, own=slab.own, exchange=exchange, **options)

    def advance(self, rates: Sequence[float], betas: tuple[float, float]) -> None:
        self.betas = betas
        self.run(rates)

    def statistics(self) -> Statistics:
        energy, local_highest, mean = self._statistics
        fraction = (self._slab.last - self._slab.first) / self._shape[0]
        sums, highest = torch.tensor([energy, mean * fraction], dtype=torch.float64), torch.tensor(local_highest)
        dist.all_reduce(sums)
        dist.all_reduce(highest, dist.ReduceOp.MAX)
        return Statistics(float(sums[0]), float(highest), float(sums[1]))

    def mass(self) -> float:
        total = torch.tensor(self._flow.field[self._slab.own].sum(dtype=np.float64))
        dist.all_reduce(total)
        return float(total) / math.prod(self._shape)

    def field(self) -> Any:
        return self._gather(torch.from_numpy(self._flow.field))

    def state(self) -> dict[str, Any]:
        return {name: self._gather(v) if isinstance(v, Tensor) else v for name, v in super().state().items()}

    def restore(self, numbers: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> None:
        local_arrays = {name: self._scatter(None if arrays is None else arrays[name]) for name in _ARRAYS}
        self._flow.restore(numbers | local_arrays)

    def _scatter(self, whole: np.ndarray | None) -> np.ndarray:
        """Return this process's planes of the first one's array `(3, Z, Y, X)`, sent one component at a time."""
        local = np.empty((3, len(self._slab.places), *self._shape[1:]), np.float32)
        for k, component in enumerate(local):
            if whole is None:
                dist.recv(torch.from_numpy(component), 0)
                continue
            for rank, slab in enumerate(self._slabs[1:], 1):
                dist.send(torch.from_numpy(slab.cut(whole[k])), rank)
            component[...] = self._slab.cut(whole[k])
        return local

    def _gather(self, values: Tensor) -> Tensor | None:
        """Collect all processes' own planes in the first one, as a tensor `(…, Z, Y, X)`; return None in the others."""
        own = values[..., self._slab.own, :, :]
        if self._rank:
            dist.send(own.contiguous(), 0)
            return None
        whole = torch.empty((*values.shape[:-3], *self._shape))
        whole[..., : self._slab.last, :, :] = own
        for rank, slab in enumerate(self._slabs[1:], 1):
            planes = torch.empty((*values.shape[:-3], slab.last - slab.first, *values.shape[-2:]))
            dist.recv(planes, rank)
            whole[..., slab.first : slab.last, :, :] = planes
        return whole


def _exchange(slab: Slab, rank: int, count: int, volume: np.ndarray) -> None:
    """Fill the planes of a volume `(Z, n)` that neighbouring processes own, and send them the planes next to theirs."""
    planes = torch.from_numpy(volume)
    own, transfers = planes[slab.own], []
    for halo, step, direction in ((planes[slab.below], -1, _DOWN), (planes[slab.above], 1, _UP)):
        neighbour, width = (rank + step) % count, len(halo)
        edge = own[:width] if direction == _DOWN else own[-width:]
        # What comes from there goes the other way; of two processes, each is the other's neighbour in both directions.
        transfers += [dist.irecv(halo, neighbour, tag=1 - direction), dist.isend(edge, neighbour, tag=direction)]
    for transfer in transfers:
        transfer.wait()
