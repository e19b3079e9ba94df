"""From a scan's grid and unit to those a flow runs in, and back; and a prior in the scan's unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.bounds import LONGEST, SHORTEST, instance, real
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import Law, texture_of
from curvafit.priors.loss import RESOLVED, upsampling
from curvafit.priors.refined import refined
from curvafit.units import METRES
from curvafit.volumes.scan import Field, ScanError

__all__ = ["Law", "WorkingGrid", "law_of"]


def law_of(prior: Law, scan: Field) -> tuple[Coefficients, tuple[str, ...]]:
    """Coefficients with lengths in the scan's unit, and sentences on where they are from.

    Raises
    ------
    ValueError
        If there is no preset of that name, or the units of a `fit.json` and the scan cannot be compared.
    FileNotFoundError
        If there is no such file.
    """
    instance(scan, Field, "a scan as Field")
    texture = texture_of(prior)
    if texture.prior is None:
        said = f"The {texture.origin}, at a working voxel of one scan voxel."
        return texture.in_unit(scan.unit, min(scan.spacing)), (said,) if texture.working else ()
    try:
        law = texture.in_unit(scan.unit, min(scan.spacing))
    except ValueError as reason:
        mend = ": give --spacing and --unit" if texture.unit in METRES else ""
        raise ScanError(f"{reason}{mend}") from None
    moved = f"The prior's lengths, in {texture.unit}, are taken to {scan.unit}."
    return law, () if texture.unit == scan.unit else (moved,)


@dataclass(frozen=True)
class WorkingGrid:
    """Where a flow runs: working units, and axes refined until ε spans two voxels.

    Attributes
    ----------
    grid
        Working units; the boundary replicates.
    times
        How many parts a scan voxel has along each axis.
    unit, epsilon
        A working length of 1, and ε, in the scan's unit.
    """

    grid: Grid
    times: tuple[int, int, int]
    unit: float
    epsilon: float

    @classmethod
    def of(cls, scan: Field, epsilon: float | None) -> WorkingGrid:
        """The place for a scan; ε is twice the smallest voxel edge if not given.

        Raises
        ------
        ScanError
            If ε is not positive or the scan is too small.
        """
        said = f"a positive epsilon in {scan.unit}"
        ε = RESOLVED * min(scan.spacing) if epsilon is None else real(epsilon, said, SHORTEST, LONGEST)
        if min(scan.shape) < 4:
            raise ScanError(f"expected at least 4 voxels along each axis, got {scan.shape}")
        times, unit = upsampling(scan.spacing, ε), ε / WORKING_EPSILON
        shape = tuple(n * t for n, t in zip(scan.shape, times, strict=True))
        spacing = tuple(h / t / unit for h, t in zip(scan.spacing, times, strict=True))
        return cls(Grid(shape, spacing, "replicate"), times, unit, ε)  # type: ignore[arg-type]

    @property
    def notes(self) -> tuple[str, ...]:
        """Which axes are refined, in a sentence."""
        if max(self.times) == 1:
            return ()
        axes = ", ".join(f"{axis} {n}-fold" for axis, n in zip("zyx", self.times, strict=True) if n > 1)
        return (f"ε spans fewer than 2 voxels on some axes: the flow ran on a grid refined {axes}.",)

    def finer(self, values: np.ndarray) -> Tensor:
        """A smooth volume on the flow's grid."""
        u = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
        for axis, n in enumerate(self.times):
            u = refined(u, axis, n)
        return u

    def spread(self, values: np.ndarray, centre: int | None = None) -> Tensor:
        """What voxels say, shared among their parts; along the axis `centre` by the middle one or two alone."""
        u = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
        for axis, n in enumerate(self.times):
            share = torch.full((n,), 1 / n)
            if axis == centre:
                share = (torch.arange(n) - (n - 1) / 2).abs().lt(1).float()
            u = u.unsqueeze(axis + 1) * share.reshape(-1, *(1,) * (2 - axis))
            u = u.flatten(axis, axis + 1)
        return u

    def back(self, u: Tensor) -> np.ndarray:
        """The mean of each scan voxel's parts."""
        for axis, n in enumerate(self.times):
            u = u.unflatten(axis, (-1, n)).mean(axis + 1)
        return u.numpy()
