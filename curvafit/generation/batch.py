"""Batches of shapes over laws, masses and seeds: one after another or, in plain torch, together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from curvafit.core.checks import as_tuple, check_choice, check_int
from curvafit.core.runtime import EAGER, check_memory, device_memory
from curvafit.generation.cost import Cost
from curvafit.generation.flow import BACKENDS, WORKING_BLUR, Backend, check_device, choose_base, generate
from curvafit.generation.forms import DivergenceForm, white_noise
from curvafit.generation.loop import FlowOptions, run
from curvafit.generation.result import Flow
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.stepper import TorchStepper
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import LawLike, read_laws

#: The most shapes that a device makes together by default.
MOST_TOGETHER = 64


def generate_batch(
    laws: LawLike | Sequence[LawLike],
    masses: float | Tensor | Sequence[float | Tensor] | None = None,
    grid: Grid | int | tuple[int, int, int] = 100,
    *,
    seeds: int | Sequence[int] = 0,
    schedule: str | Schedule = "fast",
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    reject_early: bool = False,
    together: int | None = None,
    backend: Backend = "auto",
    device: torch.device | str = "cpu",
) -> Iterator[Flow]:
    """Make shapes as `generate` does, and yield each flow when it is done, in order.

    Parameters
    ----------
    laws, masses, seeds
        A law, a mass and a seed for all shapes, or sequences of one length with one for each shape. None takes the
        laws' masses. A mass that is a tensor varies in space, for all shapes.
    together
        Number of shapes that advance in the same steps, where there is no fused step; None takes as many as fit into
        half of the device's memory, at most 64, and one on a processor.

    The other arguments are those of `generate`, for all shapes. Raises ValueError at once if the sequences differ in
    length, otherwise as `generate` does, when the shape is made.
    """
    jobs, plan = _list_jobs(laws, masses, seeds), named_schedule(schedule)
    grid = grid if isinstance(grid, Grid) else Grid(grid)  # type: ignore[arg-type]
    options = {"schedule": plan, "epsilon": epsilon, "blur": blur, "reject_early": reject_early}
    options |= {"backend": backend, "device": device}
    backends = [name for name in BACKENDS if name != "slabs"]  # which are of one shape
    check_choice(backend, backends, f"a backend among {', '.join(backends)}")
    check_device(device)
    size = 1
    if backend in ("torch", "compiled") or not kernels.has_kernel(device):
        size = _count_fitting(grid, device) if together is None else together
    if check_int(size, "at least one shape at a time", 1, 10**6) == 1:
        return (generate(law, mass, grid, seed=seed, **options) for law, mass, seed in jobs)
    groups = [jobs[first : first + size] for first in range(0, len(jobs), size)]
    return (flow for group in groups for flow in _generate_together(group, grid, options))


def _count_fitting(grid: Grid, device: torch.device | str) -> int:
    """Return how many shapes fit into half of a device's memory; one on a processor, where threads share a shape."""
    if torch.device(device).type == "cpu":
        return 1
    return max(1, min(MOST_TOGETHER, device_memory(device) // (2 * EAGER * math.prod(grid.shape))))


def _list_jobs(laws, masses, seeds) -> list[tuple[Coefficients, float | Tensor | None, int]]:
    """Return coefficients, mass and seed of each shape."""
    columns = [
        read_laws(laws),
        [masses] if masses is None or isinstance(masses, (Real, Tensor)) else as_tuple(masses, "masses"),
        [seeds] if isinstance(seeds, Real) else as_tuple(seeds, "seeds"),
    ]
    lengths = {len(column) for column in columns} - {1}
    if len(lengths) > 1 or 0 in lengths:
        counts = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"laws, masses and seeds must be of one length, or one for all, got {counts}")
    count = max(lengths, default=1)
    rows = zip(*([*column] * (count // len(column)) for column in columns), strict=True)
    return [(law.coefficients, law.mass if mass is None else mass, seed) for law, mass, seed in rows]


def _generate_together(jobs: list[tuple], grid: Grid, options: dict[str, Any]) -> list[Flow]:
    """Make shapes in the same steps."""
    plan, device, blur = options["schedule"], options["device"], options["blur"]
    check_memory((len(jobs), *grid.shape), EAGER, "a batch", device)
    laws, masses, seeds = zip(*jobs, strict=True)
    costs = [Cost(law, grid, options["epsilon"], None, blur) for law in laws]
    bases = [DivergenceForm.of(grid, blur, choose_base(mass, None, grid)).base for mass in masses]
    stepper = TorchStepper(
        torch.stack([white_noise(grid, seed) for seed in seeds]),
        DivergenceForm(grid, costs[0].blur, _stack(bases)),
        Coefficients(*map(_stack, zip(*laws, strict=True))),
        costs[0].epsilon,
        plan.betas_at(0),
        None,
        device,
        compiled=options["backend"] == "compiled",
        count=len(jobs),
    )
    return run(stepper, [FlowOptions(cost, plan, reject_early=options["reject_early"]) for cost in costs], seeds)


def _stack(values: Sequence[float | Tensor]) -> Tensor:
    """Return one number or field `(Z, Y, X)` for each shape, as `(count, 1, 1, 1)` or `(count, Z, Y, X)`."""
    fields = torch.broadcast_tensors(*(torch.as_tensor(value, dtype=torch.float32) for value in values))
    stack = torch.stack(fields)
    return stack.reshape(len(fields), *(1,) * (4 - stack.dim()), *stack.shape[1:])
