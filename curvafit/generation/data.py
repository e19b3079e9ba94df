"""Data terms of a flow: the side of the surface on which each voxel is likely to be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
from torch import Tensor

from curvafit.core.checks import check_float, check_type
from curvafit.priors.grid import Float, Grid


class Data(Protocol):
    """A term D(u) that is lowered together with F_ε."""

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """Return D(u), a sum over voxels times the voxel's volume, and its gradient with respect to every voxel."""
        ...

    def to(self, device: torch.device | str, /) -> Data:
        """Return the same term on a device."""
        ...


@dataclass(frozen=True, eq=False)
class _VoxelTerm:
    """A data term with one number r for each voxel."""

    ratio: Float[Tensor, "z y x"]

    def __post_init__(self) -> None:
        check_type(self.ratio, Tensor, "evidence as a tensor (Z, Y, X)")
        if self.ratio.dim() != 3 or not self.ratio.numel() or not bool(torch.isfinite(self.ratio).all()):
            raise ValueError(f"evidence must be finite, of shape (Z, Y, X), got the shape {tuple(self.ratio.shape)}")

    def to(self, device: torch.device | str, /) -> Self:
        """Return the same term on a device."""
        return replace(self, ratio=self.ratio.to(device))


@dataclass(frozen=True, eq=False)
class Evidence(_VoxelTerm):
    """D(u) = V Σ r (½ - q(u)), q(u) = (3u - u³) / 4 on [-1, 1] and ±½ beyond.

    r is a voxel's evidence for the inside (where positive) or for the outside, and V is the voxel's volume. Where u is
    ±1, D is the cost of the mask u > 0, up to a constant. D is C¹ and acts on the interface alone: q'(±1) = 0, so that
    noise, whose sign changes from voxel to voxel, does not pull the phases to values between ±1. The `ratio` r,
    `(Z, Y, X)`, is finite (else ValueError), and 0 where nothing is known.
    """

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """Return D(u) and the gradient of D."""
        r, v = self.ratio.to(u.dtype), u.clamp(-1, 1)
        v2 = v * v
        value = float((r * (0.5 - v * (3 - v2) / 4)).sum(dtype=torch.float64)) * grid.voxel_volume
        return value, r * (v2 - 1) * (0.75 * grid.voxel_volume)


@dataclass(frozen=True, eq=False)
class Hinge(_VoxelTerm):
    """D(u) = V Σ |r| (m - sign(r) u)₊² / 4, which holds u at ±m or beyond on the side of r's sign.

    The term is for voxels whose side is known: there is no force where u is at least m on that side, and a spring where
    it is not. At m = 1 the wrong phase, off by 2, costs |r| V, but a profile that crosses known voxels is squeezed; it
    is free where m is the profile's value in a voxel next to the surface (`priors.profile.optimal_profile`). The ratio
    r is as in `Evidence`; the margin m is from 0 to 1.
    """

    margin: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "margin", check_float(self.margin, "a margin from 0 to 1", 0, 1))

    def slope(self, u: Float[Tensor, "z y x"], grid: Grid, /) -> tuple[float, Float[Tensor, "z y x"]]:
        """Return D(u) and the gradient of D."""
        r = self.ratio.to(u.dtype)
        short = (self.margin - r.sign() * u).clamp_min(0)
        pull = r * short
        value = float((pull.abs() * short).sum(dtype=torch.float64)) * grid.voxel_volume / 4
        return value, pull * (-0.5 * grid.voxel_volume)
