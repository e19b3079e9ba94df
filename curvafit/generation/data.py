"""What a flow is told of the field beside F_ε: which side of the surface a voxel is likely to be on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from curvafit.priors.bounds import quoted
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float


class Data(Protocol):
    """A term D(u) that is lowered together with F_ε."""

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """D(u), a sum over voxels times the voxel's volume, and its gradient with respect to every voxel."""
        ...

    def to(self, device: torch.device | str, /) -> Data:
        """The same on a device."""
        ...


@dataclass(frozen=True, eq=False)
class _OfVoxels:
    """What has a number r a voxel."""

    ratio: Float[Tensor, "z y x"]

    def __post_init__(self) -> None:
        if not isinstance(self.ratio, Tensor):
            raise ValueError(f"expected finite evidence (Z, Y, X), got {quoted(self.ratio)}")
        if self.ratio.dim() != 3 or not self.ratio.numel() or not bool(torch.isfinite(self.ratio).all()):
            got = f"one of shape {tuple(self.ratio.shape)} or not finite"
            raise ValueError(f"expected finite evidence (Z, Y, X), got {got}")

    def to(self, device: torch.device | str, /) -> Self:
        """The same on a device."""
        return type(self)(self.ratio.to(device))


@dataclass(frozen=True, eq=False)
class Evidence(_OfVoxels):
    """D(u) = V Σ r (½ - q(u)), q(u) = (3u - u³) / 4 on [-1, 1] and ±½ beyond.

    r is what a voxel says for the inside (positive) or the outside, V the voxel's volume. Where u is ±1 this is the
    cost of the mask u > 0, up to a constant. It is C¹ and acts on the interface alone: q'(±1) = 0, so that noise, whose
    sign changes from voxel to voxel, does not pull the phases to grey values between.

    Parameters
    ----------
    ratio
        r, `(Z, Y, X)`, finite; 0 where nothing is known.

    Raises
    ------
    ValueError
        If it is not a finite 3D tensor.
    """

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """D(u) and its gradient."""
        r, v = self.ratio.to(u.dtype), u.clamp(-1, 1)
        v2 = v * v
        value = float((r * (0.5 - v * (3 - v2) / 4)).sum(dtype=torch.float64)) * grid.voxel_volume
        return value, r * (v2 - 1) * (0.75 * grid.voxel_volume)


@dataclass(frozen=True, eq=False)
class Hinge(_OfVoxels):
    """D(u) = V Σ |r| (1 - sign(r) u)₊² / 4: holds u at ±1 or beyond on the side that r says.

    For voxels that are known: no force where they are right, a spring where they are not; wrong by 2 costs |r|.

    Parameters
    ----------
    ratio
        r, `(Z, Y, X)`, finite; 0 where nothing is known.

    Raises
    ------
    ValueError
        If it is not a finite 3D tensor.
    """

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """D(u) and its gradient."""
        r = self.ratio.to(u.dtype)
        short, size = (1 - r.sign() * u).clamp_min(0), r.abs()
        value = float((size * short * short).sum(dtype=torch.float64)) * grid.voxel_volume / 4
        return value, r * short * (-0.5 * grid.voxel_volume)
