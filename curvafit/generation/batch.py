"""Batches of shapes over laws, masses and seeds: one after another or, on an NVIDIA device, together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from numbers import Real
from typing import Any, NamedTuple

import torch
from torch import Tensor

from curvafit.core.checks import as_tuple, check_choice, check_int
from curvafit.generation.cost import Cost
from curvafit.generation.flow import WORKING_BLUR, Backend, generate
from curvafit.generation.fused import CudaStepper
from curvafit.generation.initial import white_noise
from curvafit.generation.loop import Orders, run
from curvafit.generation.memory import DEVICE, check_memory
from curvafit.generation.parametrization import DivergenceForm
from curvafit.generation.result import Flow
from curvafit.generation.schedule import Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.setup import base_of, kind_of
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import Law, textures_of
from curvafit.priors.shapes import Float

#: Shapes that a device makes together by default.
TOGETHER = 64


def generate_batch(
    laws: Law | Sequence[Law],
    masses: float | Tensor | Sequence[float | Tensor] | None = None,
    grid: Grid | int | tuple[int, int, int] = 100,
    *,
    seeds: int | Sequence[int] = 0,
    schedule: str | Schedule = "fast",
    epsilon: float | Tensor = WORKING_EPSILON,
    blur: float = WORKING_BLUR,
    orientation: Float[Tensor, "3 3"] | None = None,
    snapshots: Sequence[int] = (),
    reject_early: bool = False,
    together: int = TOGETHER,
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
        How many shapes an NVIDIA device makes at once; each takes some 70 bytes for each voxel. A processor makes one
        shape at a time.

    The other arguments are those of `generate`, for all shapes.

    Raises
    ------
    ValueError
        At once if the sequences differ in length; otherwise as `generate` does, when the shape is made.
    """
    together = check_int(together, "at least one shape at a time", 1, 10**6)
    jobs, plan = _jobs(laws, masses, seeds), named_schedule(schedule)
    grid = grid if isinstance(grid, Grid) else Grid(grid)  # type: ignore[arg-type]
    options = {
        "schedule": plan, "epsilon": epsilon, "blur": blur, "orientation": orientation,
        "snapshots": snapshots, "reject_early": reject_early, "backend": backend, "device": device,
    }  # fmt: skip
    check_choice(backend, ("auto", "torch", "fused"), "a backend 'auto', 'torch' or 'fused'")
    if kind_of(device) == "cuda" and backend != "torch" and kernels.fused(device):
        groups = [jobs[first : first + together] for first in range(0, len(jobs), together)]
        return (flow for group in groups for flow in _joint_flows(group, grid, options))
    return (generate(job.coefficients, job.mass, grid, seed=job.seed, **options) for job in jobs)


class _Job(NamedTuple):
    """Parameters of one shape."""

    coefficients: Coefficients
    mass: float | Tensor | None
    seed: int


def _jobs(laws, masses, seeds) -> list[_Job]:
    """Return one job for each shape."""
    columns = [
        textures_of(laws),
        [masses] if masses is None or isinstance(masses, (Real, Tensor)) else as_tuple(masses, "masses"),
        [seeds] if isinstance(seeds, Real) else as_tuple(seeds, "seeds"),
    ]
    lengths = {len(column) for column in columns} - {1}
    if len(lengths) > 1 or 0 in lengths:
        counts = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"expected laws, masses and seeds of one length, or one for all, got {counts}")
    count = max(lengths, default=1)
    rows = zip(*([*column] * (count // len(column)) for column in columns), strict=True)
    return [_Job(law.coefficients, law.mass if mass is None else mass, seed) for law, mass, seed in rows]


def _joint_flows(jobs: list[_Job], grid: Grid, options: dict[str, Any]) -> list[Flow]:
    """Make shapes together, in the same steps of a device."""
    plan = options["schedule"]
    check_memory((len(jobs), *grid.shape), DEVICE, "a batch", options["device"])
    costs = [Cost(job.coefficients, grid, options["epsilon"], options["orientation"], options["blur"]) for job in jobs]
    forms = [
        DivergenceForm.of(grid, options["blur"], base_of(job.mass, None, grid), kernels.gaussian_blur) for job in jobs
    ]
    starts = [white_noise(grid, job.seed) for job in jobs]
    coefficients = [job.coefficients for job in jobs]
    bases = [form.base for form in forms]
    stepper = CudaStepper(starts, bases, costs[0], coefficients, plan.betas, None, options["device"])
    shared = {name: options[name] for name in ("snapshots", "reject_early")}
    return run(stepper, [Orders(cost, plan, **shared) for cost in costs], [job.seed for job in jobs])
