"""The flow on a scan's working grid: data and F_ε lowered together, over hundreds of steps, from a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from curvafit.core.checks import check_float, check_int, check_positive
from curvafit.core.runtime import Progress, silent
from curvafit.core.units import unit_name
from curvafit.core.workers import Cluster
from curvafit.generation.flow import WORKING_BLUR, Flow, descend
from curvafit.generation.problem import Data
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import MOST, WORKING_EPSILON, Grid
from curvafit.priors.loss import RESOLVED, choose_refinement
from curvafit.priors.profile import phase_field
from curvafit.priors.stencils import refine_axis
from curvafit.volumes.volume import ScanError, Volume

#: Default steps of Adam.
STEPS = 400
#: Shortest edge of a tile, in working voxels.
SMALLEST = 8
#: Least and greatest stiffness of springs.
STIFFEST = (1e-9, 1e12)
#: Voxels of the grid around a volume: far enough for the border's right angles not to reach it.
HALO = 6
#: a20 + a02 of the law in a flow, on which the steps of Adam depend; the Willmore energy has it.
BENDING = 2.0
#: Whether there is a halo before and beyond the voxels, along each axis.
Ends = tuple[tuple[bool, bool], tuple[bool, bool], tuple[bool, bool]]


@dataclass(frozen=True)
class Working:
    """How a volume is worked on: settings of `segment` and `reconstruct` whose defaults suit nearly always.

    Raises ValueError where one is out of range.

    Attributes
    ----------
    epsilon
        ε in the scan's unit; by default twice the smallest voxel edge. Thinner structures do not survive.
    steps
        Steps of Adam.
    stiffness
        Stiffness of the springs on known voxels, in working units: `reconstruct` lowers the first law with it, and
        tries nothing out.
    filler
        Weights of the network that fills, of `examples/teach.py`, for an image those of `--images`; by default the
        packaged ones.
    tile
        The energy is lowered on overlapping tiles of at most this many working voxels a side, which bounds the memory;
        the result depends on the tiles by a few voxels of the surface at most. By default a volume is one tile up to
        256³ working voxels; larger ones have tiles of 192³. A network fills blocks of so many voxels a side.
    store
        A folder for finished tiles or blocks, with which the same call goes on after a kill, and whose mapped files the
        result's arrays are.
    workers
        Processes that share the tiles, or workers such as `curvafit.core.workers.cluster`.
    """

    epsilon: float | None = None
    steps: int = STEPS
    stiffness: float | None = None
    filler: str | Path | None = None
    tile: int | None = None
    store: str | PathLike[str] | None = None
    workers: Cluster | int | None = None

    def __post_init__(self) -> None:
        if self.stiffness is not None:
            object.__setattr__(self, "stiffness", check_float(self.stiffness, "a positive stiffness", *STIFFEST))
        if self.tile is not None:
            form = f"a tile of {SMALLEST} or more working voxels a side"
            object.__setattr__(self, "tile", check_int(self.tile, form, SMALLEST, MOST))


def lower_energy(
    level: np.ndarray, law: Coefficients, data: Data, grid: WorkingGrid, steps: int, progress: Progress = silent
) -> Flow:
    """Lower D(u) + F_ε(u), with u = k ∗ v, by Adam under a cooling schedule, from the set where the `level` (Z, Y, X),
    smooth and on the scan's voxels, is positive. The `law` has lengths in the scan's unit, and is scaled to a20 + a02 =
    2; the `data` term D is on the working grid, in units of its F_ε. Raises `ScanError` if a20 + a02 is not positive,
    or the energy does not stay finite."""
    flow = descend(
        initial_field(level, grid),
        law.scale(BENDING / bending(law)).in_unit(grid.unit),
        grid.grid,
        data=data,
        method="adam",
        steps=steps,
        blur=WORKING_BLUR,
        callbacks=[lambda step, total, _: progress("lowering the energy", step / total)],
    )
    if not flow.finite:
        raise ScanError(f"the energy did not stay finite ({flow.status}): lower the weight")
    return flow


def initial_field(level: np.ndarray, grid: WorkingGrid) -> Tensor:
    """Return the phase field, on the working grid, of the set where a smooth `level` (Z, Y, X) is positive: constant 1
    or -1 where that is everywhere or nowhere, as in a tile far from the surface."""
    inside = grid.to_grid(level) > 0
    if inside.all() or not inside.any():
        return 2 * inside.float() - 1
    return phase_field(inside, grid.grid, WORKING_EPSILON)


def bending(law: Coefficients) -> float:
    """Return a20 + a02, or raise ScanError where it is not positive. Bumps on a plane cost (a20 + a02) / 2 times their
    Willmore energy."""
    stiffness = float(law.a20 + law.a02)
    if stiffness <= 0:
        raise ScanError(f"a20 + a02 must be positive, got {stiffness:g}: surfaces would crumple")
    return stiffness


def choose_epsilon(scan: Volume, epsilon: float | None) -> float:
    """Return ε, by default twice the smallest voxel edge; raise ValueError where it is not positive."""
    if epsilon is None:
        return RESOLVED * min(scan.spacing)
    return check_positive(epsilon, f"a positive epsilon in {unit_name(scan.unit)}")


@dataclass(frozen=True)
class WorkingGrid:
    """The grid of a flow, in working units: a scan's voxels, split by `times` along each axis for ε to span two, and a
    halo without data. The `grid` includes the `halo` voxels on each side marked in `ends`; its boundary replicates.
    `unit` is the working length 1, and `epsilon` ε, both in the scan's unit."""

    grid: Grid
    times: tuple[int, int, int]
    unit: float
    epsilon: float
    halo: int = 0
    ends: Ends = ((True, True), (True, True), (True, True))

    @classmethod
    def of(cls, scan: Volume, epsilon: float | None, *, halo: int = 0) -> WorkingGrid:
        """Return the working grid of a scan, for the ε of `choose_epsilon`. Raises `ValueError` if ε is not positive or
        the scan is too small."""
        ε = choose_epsilon(scan, epsilon)
        if min(scan.shape) < 4:
            raise ScanError(f"the volume must have at least 4 voxels along each axis, got {scan.shape}")
        times, unit = choose_refinement(scan.spacing, ε), ε / WORKING_EPSILON
        shape = tuple(n * t + 2 * halo for n, t in zip(scan.shape, times, strict=True))
        spacing = tuple(h / t / unit for h, t in zip(scan.spacing, times, strict=True))
        grid = Grid(shape, spacing, "replicate")  # type: ignore[arg-type]
        return cls(grid, times, unit, ε, halo)  # type: ignore[arg-type]

    def of_box(self, shape: Sequence[int], ends: Ends) -> WorkingGrid:
        """Return the grid of a box of `shape` scan voxels, with a halo on the sides marked in `ends`."""
        axes = zip(shape, self.times, ends, strict=True)
        size = tuple(n * times + self.halo * sum(sides) for n, times, sides in axes)
        return replace(self, grid=Grid(size, self.grid.spacing, "replicate"), ends=ends)  # type: ignore[arg-type]

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence on the refined axes, where there are any."""
        if max(self.times) == 1:
            return ()
        axes = ", ".join(f"{axis} {n}-fold" for axis, n in zip("zyx", self.times, strict=True) if n > 1)
        return (f"ε spans fewer than 2 voxels on some axes: the flow ran on a grid refined {axes}.",)

    def to_grid(self, values: np.ndarray) -> Tensor:
        """Interpolate a smooth volume of the scan (Z, Y, X) to the grid, and repeat its border in the halo."""
        u = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
        for axis, n in enumerate(self.times):
            u = refine_axis(u, axis, n)
        return pad(u[None, None], self._sides, mode="replicate")[0, 0]

    def spread(self, values: np.ndarray, centre: int | None = None) -> Tensor:
        """Divide the evidence of each scan voxel (Z, Y, X) equally among its parts; the halo gets none. Along the axis
        `centre` the middle part, or the middle two, get all of it each."""
        u = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
        for axis, n in enumerate(self.times):
            weights = torch.full((n,), 1 / n)
            if axis == centre:
                weights = (torch.arange(n) - (n - 1) / 2).abs().lt(1).float()
            u = u.unsqueeze(axis + 1) * weights.reshape(-1, *(1,) * (2 - axis))
            u = u.flatten(axis, axis + 1)
        return pad(u, self._sides)

    def to_scan(self, u: Tensor) -> np.ndarray:
        """Drop the halo, and average the parts of each scan voxel: (Z, Y, X)."""
        for axis, (before, beyond) in enumerate(self.ends):
            u = u.narrow(axis, self.halo * before, u.shape[axis] - self.halo * (before + beyond))
        for axis, n in enumerate(self.times):
            u = u.unflatten(axis, (-1, n)).mean(axis + 1)
        return u.numpy()

    @property
    def _sides(self) -> tuple[int, ...]:
        """The voxels of the halo on each side, the last axis first, as torch pads."""
        return tuple(self.halo * side for sides in reversed(self.ends) for side in sides)
