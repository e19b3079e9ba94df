"""The problem of a flow: the functional that it lowers, the data term of that, and the forms of its unknowns."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
from torch import Tensor

from curvafit.core.checks import check_float, check_seed, check_type, quoted
from curvafit.core.runtime import FIELD, check_memory
from curvafit.priors.coefficients import NAMES, Coefficients, check_strengths
from curvafit.priors.energies import check_orientation
from curvafit.priors.grid import Float, Grid
from curvafit.priors.kernels import gaussian_blur
from curvafit.priors.stencils import divergence, gradient

#: The smallest ε, in voxels: two are published; below a tenth no voxel lies on the interface.
FINEST = 0.1
#: Bounds of a voxel's edge: float32 holds the squares of second differences, and ξ = 1e-6 (`curvature.XI`) is small
#: beside the inverse of an edge.
VOXEL_EDGES = (1e-8, 1e5)
#: Width of the published start's interval, 40 Δx at Δx = 0.01.
AMPLITUDE = 0.4


@dataclass(frozen=True)
class Cost:
    """The functional that a flow lowers, and the blur of the field; see `generate` for the parameters.

    Raises ValueError if a length is outside the bounds in which float32 can follow the flow, a coefficient or the
    orientation is over `STRONGEST` with lengths in units of ε, or a tensor does not broadcast with the voxels.
    """

    coefficients: Coefficients
    grid: Grid
    epsilon: float
    orientation: Tensor | None
    blur: float
    data: Data | None = None

    def __post_init__(self) -> None:
        for name, kind in (("coefficients", Coefficients), ("grid", Grid)):
            check_type(getattr(self, name), kind, f"{name} as {kind.__name__}")
        self._check_lengths()
        self._check_tensors()
        check_strengths(self.coefficients, self.epsilon, self.orientation)

    @property
    def fused(self) -> bool:
        """Whether the cost is F_ε of six numbers alone, which fused steppers take."""
        varies = any(isinstance(value, Tensor) and value.dim() > 0 for value in self.coefficients)
        return not varies and self.orientation is None and self.data is None

    def _check_lengths(self) -> None:
        """Convert ε and the blur to numbers; raise ValueError where they or the voxels' edges are out of range."""
        edges, box = self.grid.spacing, self.grid.longest
        if not VOXEL_EDGES[0] <= min(edges) <= max(edges) <= VOXEL_EDGES[1]:
            raise ValueError(f"a flow needs voxel edges from {VOXEL_EDGES[0]:g} to {VOXEL_EDGES[1]:g}, got {edges}")
        expected = "epsilon > 0 and blur >= 0 in the spacing's unit"
        object.__setattr__(self, "epsilon", check_float(self.epsilon, expected, math.ulp(0)))
        object.__setattr__(self, "blur", check_float(self.blur, expected, 0))
        if not FINEST * min(edges) <= self.epsilon <= box:
            least = f"{FINEST:g} of a voxel ({FINEST * min(edges):.3g})"
            raise ValueError(f"epsilon must be from {least} to the box's side ({box:.3g}), got {self.epsilon:g}")
        if self.blur > box:
            raise ValueError(f"the blur must be at most the box's side ({box:.3g}), got {self.blur:g}")

    def _check_tensors(self) -> None:
        """Raise ValueError where a tensor does not broadcast with the voxels, or data or orientation do not fit."""
        for name, value in zip(NAMES, self.coefficients, strict=True):
            if isinstance(value, Tensor):
                check_shape(name, value, self.grid)
        if self.data is not None and not callable(getattr(self.data, "slope", None)):
            raise ValueError(f"data must have a method slope, as generation.Evidence has, got {quoted(self.data)}")
        for name, value in getattr(self.data, "__dict__", {}).items():
            if isinstance(value, Tensor):
                check_shape(f"the data's {name}", value, self.grid)
        if self.orientation is not None:
            check_orientation(self.orientation)
            check_shape("the orientation", self.orientation[0, 0], self.grid)


def check_shape(name: str, value: Tensor, grid: Grid) -> None:
    """Raise ValueError where a tensor does not broadcast with the voxels."""
    try:
        broadcasts = torch.broadcast_shapes(value.shape, grid.shape) == grid.shape
    except RuntimeError:
        broadcasts = False
    if not broadcasts:
        raise ValueError(f"{name} must broadcast with the voxels {grid.shape}, got the shape {tuple(value.shape)}")


# ---- data terms ------------------------------------------------------------------------------------------------------


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
        shortfall = (self.margin - r.sign() * u).clamp_min(0)
        force = r * shortfall
        value = float((force.abs() * shortfall).sum(dtype=torch.float64)) * grid.voxel_volume / 4
        return value, force * (-0.5 * grid.voxel_volume)


# ---- forms and their start ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DivergenceForm:
    """u = k ∗ (div A + base), whose mass is the base's for every A (paper, eq. 24 and Algorithm 1).

    The descent of A is the H⁻¹ flow ∂u/∂t = Δ ∂F_ε/∂u (eq. 2): ∂F_ε/∂A = -∇ ∂F_ε/∂u moves u by the divergence of that.
    `width` is the standard deviation of k in spacing's unit; `base` is k ∗ base: the mass m₀, or a blurred field.
    """

    grid: Grid
    width: float
    base: float | Tensor

    @classmethod
    def of(cls, grid: Grid, width: float, base: float | Float[Tensor, "z y x"]) -> DivergenceForm:
        """Return the form u = k ∗ (div A + base) for a base that is not blurred yet."""
        return cls(grid, width, gaussian_blur(base, grid, width) if isinstance(base, Tensor) else float(base))

    def field(self, vector: Float[Tensor, "3 z y x"]) -> Float[Tensor, "z y x"]:
        """Return u for A."""
        return gaussian_blur(divergence(vector, self.grid), self.grid, self.width) + self.base

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
        """Return -∇(k ∗ slope), as the blur is its own adjoint and div = -∇ᵀ."""
        return -gradient(gaussian_blur(slope, self.grid, self.width), self.grid)


@dataclass(frozen=True)
class DirectForm:
    """u = k ∗ v, whose mass may change (paper, Algorithm 2; L² flow); see `descend` on its blur."""

    grid: Grid
    width: float

    def field(self, values: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return u for v."""
        return gaussian_blur(values, self.grid, self.width)

    def pullback(self, slope: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return k ∗ slope."""
        return gaussian_blur(slope, self.grid, self.width)


Form = DivergenceForm | DirectForm


def white_noise(grid: Grid, seed: int) -> Float[torch.Tensor, "3 z y x"]:
    """Return A₀, independent and uniform on [0, `AMPLITUDE`) in every voxel and component; float32, on the processor.

    The same seed and shape give the same numbers. In a box with walls the mean is subtracted: a constant A has no
    divergence in a periodic box, but has a flux through walls. Raises ValueError if the seed is not a whole number from
    0, or the box does not fit into memory.
    """
    check_type(grid, Grid, "a Grid")
    generator = torch.Generator().manual_seed(check_seed(seed))
    check_memory((*grid.shape, 3), FIELD, "a box")
    noise = torch.rand((3, *grid.shape), generator=generator, dtype=torch.float32).mul_(AMPLITUDE)
    return noise if grid.periodic else noise.sub_(AMPLITUDE / 2)
