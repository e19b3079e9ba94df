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
#: Which way planes go.
_UP, _DOWN = 0, 1


@dataclass(frozen=True)
class Slab:
    """The planes that a process holds: its own, `first` to `last` of the box, and its neighbours' next ones.

    `own`, `below` and `above` are where they lie. The box's first and last plane lie at the ends, as they do in the
    box, whether it repeats or not: so that they are computed alike, to the last bit.
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
        below, above = np.arange(first - halo, first) % Z, np.arange(last, last + halo) % Z
        order = ("own", "above", "below") if k == 0 else ("below", "own", "above")
        order = ("above", "below", "own") if 0 < k == count - 1 else order
        held = {"below": below, "own": np.arange(first, last), "above": above}
        parts = {name: held[name] for name in order}
        ends = np.cumsum([0, *map(len, parts.values())]).tolist()
        where = {name: slice(a, b) for name, a, b in zip(parts, ends, ends[1:], strict=False)}
        slabs.append(Slab(first, last, **where, places=np.concatenate(list(parts.values()))))
    return slabs


@contextmanager
def lead() -> Iterator[None]:
    """Join the processes that `torchrun` started, as the first of them; the others end with the block.

    Raises OSError where one of them is gone.
    """
    with _join():
        yield
        _tell("end")


def serve() -> None:
    """Join the processes that `torchrun` started, and step a slab for the first of them until it ends.

    Raises OSError where one of them is gone.
    """
    with _join():
        part: _Part | None = None
        while (message := _hear())[0] != "end":
            name, arguments = message
            with _together():
                if name == "begin":
                    part = None  # of an earlier shape
                    part = _Part(*arguments)
                else:
                    getattr(part, name)(*arguments)


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
def _together() -> Iterator[None]:
    """Say in a sentence that another process is gone."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(f"a process of the flow is gone ({one_line(str(error))})") from error


def _tell(name: str, *arguments: Any) -> None:
    with _together():
        dist.broadcast_object_list([(name, arguments)], src=0)


def _hear() -> tuple[str, tuple[Any, ...]]:
    message: list[Any] = [None]
    with _together():
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
        _tell("begin", slabs, cost.grid, options)
        with _together():
            self._part = _Part(slabs, cost.grid, options, [*a, epsilon, base], start.numpy())

    def _all(self, name: str, *arguments: Any) -> Any:
        _tell(name, *arguments)
        with _together():
            return getattr(self._part, name)(*arguments)

    def step(self, rate: float | None) -> None:
        self.run([rate or 0.0])

    def run(self, rates: Sequence[float]) -> int:
        self._all("advance", list(rates), self.betas)
        return len(rates)

    def statistics(self) -> Statistics:
        return self._all("statistics")

    def field(self) -> Tensor:
        return self._all("field")

    def mass(self) -> float:
        return self._all("mass")

    def shift(self, amount: float) -> None:
        self._all("shift", amount)

    def state(self) -> dict[str, Any]:
        return self._all("state")

    def restore(self, state: dict[str, Any]) -> None:
        numbers = {name: value for name, value in state.items() if not isinstance(value, Tensor)}
        _tell("restore", numbers)
        with _together():
            self._part.restore(numbers, {name: np.asarray(state[name]) for name in _ARRAYS})


#: The arrays of a state.
_ARRAYS = ("vector", "first", "second")


class _Part(FusedStepper):
    """The slab of a process. All processes call the same method at once; the first one's gives the whole's results."""

    def __init__(
        self,
        slabs: Sequence[Slab],
        grid: Grid,
        options: dict[str, Any],
        numbers: list[Any] | None = None,
        start: np.ndarray | None = None,
    ) -> None:
        from curvafit.priors.kernels.cpu import FusedFlow
        from curvafit.priors.kernels.threads import count_threads, limit_threads

        self._slabs, self._rank = slabs, dist.get_rank()
        self._slab = slab = slabs[self._rank]
        self._shape = grid.shape
        mine: list[Any] = [None]
        dist.scatter_object_list(mine, None if numbers is None else [[*map(part.cut, numbers)] for part in slabs])
        *a, epsilon, base = mine[0]
        local = Grid((len(slab.places), *self._shape[1:]), grid.spacing, grid.boundary)
        begin, exchange = self._scatter(start), partial(_exchange, slab, self._rank, len(slabs))
        # Processes of one machine share its cores.
        with limit_threads(max(1, count_threads() // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))):
            self._flow = FusedFlow(begin, base, a, local, epsilon, own=slab.own, exchange=exchange, **options)

    def advance(self, rates: Sequence[float], betas: tuple[float, float]) -> None:
        self.betas = betas
        self.run(rates)

    def statistics(self) -> Statistics:
        energy, most, mean = self._statistics
        share = (self._slab.last - self._slab.first) / self._shape[0]
        sums, highest = torch.tensor([energy, mean * share], dtype=torch.float64), torch.tensor(most)
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
        parts = {name: self._scatter(None if arrays is None else arrays[name]) for name in _ARRAYS}
        self._flow.restore(numbers | parts)

    def _scatter(self, whole: np.ndarray | None) -> np.ndarray:
        """Send to each process its part of an array `(3, Z, Y, X)` of the first one, a component at a time."""
        part = np.empty((3, len(self._slab.places), *self._shape[1:]), np.float32)
        for k, component in enumerate(part):
            if whole is None:
                dist.recv(torch.from_numpy(component), 0)
                continue
            for rank, slab in enumerate(self._slabs[1:], 1):
                dist.send(torch.from_numpy(slab.cut(whole[k])), rank)
            component[...] = self._slab.cut(whole[k])
        return part

    def _gather(self, values: Tensor) -> Tensor | None:
        """Bring the own planes of a tensor `(…, Z, Y, X)` of all processes together in the first one."""
        own = values[..., self._slab.own, :, :]
        if self._rank:
            dist.send(own.contiguous(), 0)
            return None
        whole = torch.empty((*values.shape[:-3], *self._shape))
        whole[..., : self._slab.last, :, :] = own
        for rank, slab in enumerate(self._slabs[1:], 1):
            part = torch.empty((*values.shape[:-3], slab.last - slab.first, *values.shape[-2:]))
            dist.recv(part, rank)
            whole[..., slab.first : slab.last, :, :] = part
        return whole


def _exchange(slab: Slab, rank: int, count: int, volume: np.ndarray) -> None:
    """Fill the planes of a volume `(Z, n)` beyond a process's own with the neighbours' own."""
    planes = torch.from_numpy(volume)
    own, waiting = planes[slab.own], []
    for beyond, step, way in ((planes[slab.below], -1, _DOWN), (planes[slab.above], 1, _UP)):
        other, halo = (rank + step) % count, len(beyond)
        mine = own[:halo] if way == _DOWN else own[-halo:]
        waiting += [dist.irecv(beyond, other, tag=1 - way), dist.isend(mine, other, tag=way)]
    for transfer in waiting:
        transfer.wait()
