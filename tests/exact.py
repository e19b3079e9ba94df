"""Shapes that are known exactly: signed distance, curvatures, area, ∫p dA; and the exact jets of their profiles.

Points are `(..., 3)` float64 tensors in (z, y, x); distances are positive inside. Each distance function is exact away
from its skeleton, and the curvatures at a point are those of the parallel surface through it. Integrals are the six
∫κ1², ∫κ1κ2, ∫κ2², ∫κ1, ∫κ2, ∫1 over the parallel surface at `offset` inside.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.curvature import Jet, jet
from curvafit.priors.energies import energy_terms
from curvafit.priors.grid import Grid
from curvafit.priors.profile import SIGMA, optimal_profile
from curvafit.priors.stencils import HESSIAN_AXES

MONOMIALS = ("κ1²", "κ1κ2", "κ2²", "κ1", "κ2", "1")


@dataclass(frozen=True)
class Plane:
    """A half-space {n·p < n·through}; integrals per unit of area."""

    normal: tuple[float, float, float]
    through: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor) -> Tensor:
        n = _vector(self.normal) / math.hypot(*self.normal)
        return (_vector(self.through) - points) @ n

    def curvatures(self, points: Tensor) -> tuple[Tensor, Tensor]:
        zero = torch.zeros_like(points[..., 0])
        return zero, zero

    def integrals(self, offset: float = 0.0) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, 1.0])


@dataclass(frozen=True)
class Sphere:
    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor) -> Tensor:
        return self.radius - torch.linalg.vector_norm(points - _vector(self.centre), dim=-1)

    def curvatures(self, points: Tensor) -> tuple[Tensor, Tensor]:
        κ = 1 / (self.radius - self.distance(points))
        return κ, κ

    def integrals(self, offset: float = 0.0) -> np.ndarray:
        r = self.radius - offset
        return 4 * math.pi * np.array([1, 1, 1, r, r, r**2])


@dataclass(frozen=True)
class Cylinder:
    """An infinite circular cylinder; integrals per unit of length."""

    radius: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor) -> Tensor:
        t = _vector(self.axis) / math.hypot(*self.axis)
        p = points - _vector(self.centre)
        return self.radius - torch.linalg.vector_norm(p - (p @ t)[..., None] * t, dim=-1)

    def curvatures(self, points: Tensor) -> tuple[Tensor, Tensor]:
        κ = 1 / (self.radius - self.distance(points))
        return κ, torch.zeros_like(κ)

    def integrals(self, offset: float = 0.0) -> np.ndarray:
        r = self.radius - offset
        return 2 * math.pi * np.array([1 / r, 0, 0, 1, 0, r])


@dataclass(frozen=True)
class Torus:
    """A tube of radius `minor` around the circle of radius `major` in the plane z = centre's z."""

    major: float
    minor: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor) -> Tensor:
        p = points - _vector(self.centre)
        ρ = torch.linalg.vector_norm(p[..., 1:], dim=-1)
        return self.minor - torch.hypot(ρ - self.major, p[..., 0])

    def curvatures(self, points: Tensor) -> tuple[Tensor, Tensor]:
        p = points - _vector(self.centre)
        ρ = torch.linalg.vector_norm(p[..., 1:], dim=-1)
        r = torch.hypot(ρ - self.major, p[..., 0])
        return 1 / r, (ρ - self.major) / (r * ρ)

    def integrals(self, offset: float = 0.0) -> np.ndarray:
        R, r = self.major, self.minor - offset
        bend = R / r * (R / math.sqrt(R**2 - r**2) - 1)
        return 4 * math.pi**2 * np.array([R / r, 0, bend, R, 0, R * r])


#: Solids with a smooth boundary, whose curvatures and integrals are known.
Shape = Plane | Sphere | Cylinder | Torus


@dataclass(frozen=True)
class Tubes:
    """Balls of `radius` along polylines `(N, 3)` (z, y, x); inside, the distance is exact where one line is near."""

    radius: float
    lines: tuple[np.ndarray, ...]

    def distance(self, points: Tensor) -> Tensor:
        nearest = torch.full(points.shape[:-1], math.inf, dtype=torch.float64)
        for line in self.lines:
            corners = torch.as_tensor(line, dtype=torch.float64)
            for a, b in itertools.pairwise(corners):
                part = ((points - a) @ (b - a) / (b - a).square().sum().clamp_min(1e-30)).clamp(0, 1)
                nearest = torch.minimum(nearest, (points - a - part[..., None] * (b - a)).norm(dim=-1))
        return self.radius - nearest


def helix(
    radius: float, pitch: float, turns: float, start: tuple[float, float, float], corners: int = 60
) -> np.ndarray:
    """Corners `(corners + 1, 3)` of a helix around the line along z through `start`; a turn is √((2πr)² + p²) long."""
    t = np.linspace(0, turns, corners + 1)
    return np.stack(
        [start[0] + pitch * t, start[1] + radius * np.sin(2 * np.pi * t), start[2] + radius * np.cos(2 * np.pi * t)], 1
    )


@dataclass(frozen=True)
class Gyroid:
    """The level function sin x cos y + sin y cos z + sin z cos x of period `period`: not a distance; genus 5 a cell."""

    period: float
    #: ∫K dA = 2πχ of one cubic cell, χ = -8.
    total_curvature: float = -16 * math.pi

    def level(self, points: Tensor) -> Tensor:
        z, y, x = (2 * math.pi / self.period * points).unbind(-1)
        return x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()

    def distance(self, points: Tensor) -> Tensor:
        """The level over its slope: the distance to first order, and of its sign everywhere."""
        z, y, x = (2 * math.pi / self.period * points).unbind(-1)
        slope = torch.stack(
            [z.cos() * x.cos() - y.sin() * z.sin(), y.cos() * z.cos() - x.sin() * y.sin(),
             x.cos() * y.cos() - z.sin() * x.sin()]
        )  # fmt: skip
        return self.period / (2 * math.pi) * self.level(points) / torch.linalg.vector_norm(slope, dim=0)


def centres(grid: Grid, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """Voxel centres `(Z, Y, X, 3)`; the box's lower corner, not the first centre, lies at `origin`."""
    axes = [
        o + h * (torch.arange(n, dtype=torch.float64) + 0.5)
        for n, h, o in zip(grid.shape, grid.spacing, origin, strict=True)
    ]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


def profile(shape: Shape, points: Tensor, epsilon: float) -> Tensor:
    """tanh(d / √2 ε) at the points."""
    return optimal_profile(shape.distance(points), epsilon)


def exact_jet(function: Callable[[Tensor], Tensor], points: Tensor) -> Jet:
    """A function with its exact gradient and Hessian at points `(Z, Y, X, 3)`, by automatic differentiation."""
    p = points.detach().clone().requires_grad_(True)
    value = function(p)
    (slope,) = torch.autograd.grad(value.sum(), p, create_graph=True)
    slope = slope + 0 * p  # a plane's slope does not depend on p, and has to say so
    rows = [torch.autograd.grad(slope[..., k].sum(), p, retain_graph=True)[0] for k in range(3)]
    hessian = torch.stack([rows[i][..., j] for i, j in HESSIAN_AXES])
    return Jet(value.detach(), slope.detach().movedim(-1, 0), hessian)


def shape_operator_curvatures(jet: Jet) -> tuple[Tensor, Tensor]:
    """κ1 ≥ κ2 as the two eigenvalues of -P (Hess u) P / |∇u| on the tangent plane, by an eigenvalue solver."""
    g = jet.gradient.movedim(-4, -1)
    h = torch.empty(*g.shape, 3, dtype=g.dtype)
    for component, (i, j) in zip(jet.hessian.unbind(-4), HESSIAN_AXES, strict=True):
        h[..., i, j] = h[..., j, i] = component
    slope = torch.linalg.vector_norm(g, dim=-1)
    n = g / slope[..., None]
    P = torch.eye(3, dtype=g.dtype) - n[..., :, None] * n[..., None, :]
    found = torch.linalg.eigvalsh(-(P @ h @ P) / slope[..., None, None])
    # The normal's eigenvalue is 0: of the three, the one nearest to 0 is dropped.
    drop = found.abs().argmin(-1, keepdim=True)
    keep = torch.ones_like(found, dtype=torch.bool).scatter(-1, drop, False)
    κ2, κ1 = found[keep].reshape(*found.shape[:-1], 2).unbind(-1)
    return κ1, κ2


def diffuse_integrals(shape: Shape, epsilon: float, reach: float, nodes: int = 400) -> np.ndarray:
    """The six terms of F_ε / σ for the exact profile, up to |d| = `reach`: ∫ √(2W(t)) ∫_{u = t} κ^α dA dt by Gauss."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    d = reach * x
    density = reach * w / (2 * epsilon) * np.cosh(d / (math.sqrt(2) * epsilon)) ** -4
    return sum(part * shape.integrals(at) for part, at in zip(density, d, strict=True)) / SIGMA


def recovery_profile(distance: Tensor, epsilon: float) -> Tensor:
    """The profile γ_ε of the paper's recovery sequence (Appendix): tanh, then a parabolic arc, then ±1."""
    ε, s = epsilon, distance.abs()
    b, c = recovery_ends(ε)
    arc = 1 - (s - c) ** 2 / (1 + ε**2) ** 3
    ends = torch.where(s < c, arc, torch.ones_like(s))
    return torch.sign(distance) * torch.where(s < b, torch.tanh(s / (math.sqrt(2) * ε)), ends)


def recovery_ends(epsilon: float) -> tuple[float, float]:
    """Where the arc of `recovery_profile` begins and ends."""
    begins = math.sqrt(2) * epsilon * abs(math.log(epsilon))
    return begins, begins + math.sqrt(2) * (epsilon + epsilon**3)


def recovery_integrals(shape: "Torus", epsilon: float, nodes: int = 60, around: int = 48) -> np.ndarray:
    """The six terms of F_ε / σ of the recovery sequence's field on a torus, by exact jets at Gauss points."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    b, c = recovery_ends(epsilon)
    pieces = [(low, high) for end in (1, -1) for low, high in sorted(((0, end * b), (end * b, end * c)))]
    d = np.concatenate([(high + low + (high - low) * x) / 2 for low, high in map(sorted, pieces)])
    weights = np.concatenate([abs(high - low) * w / 2 for low, high in pieces])
    angle = 2 * math.pi * np.arange(around) / around
    minor = (shape.minor - d)[:, None]
    wide = shape.major + minor * np.cos(angle)
    points = np.stack([minor * np.sin(angle), np.zeros_like(wide), wide], -1)
    area = torch.from_numpy(weights[:, None] * (2 * math.pi) ** 2 / around * wide * minor)
    field = exact_jet(lambda p: recovery_profile(shape.distance(p), epsilon), torch.from_numpy(points)[None])
    return (energy_terms(field, epsilon)[..., 0, :, :] * area).sum((-2, -1)).numpy() / SIGMA


def grid_integrals(shape: Torus, epsilon: float, h: float) -> np.ndarray:
    """The six terms of F_ε / σ of a torus's profile on a grid of spacing h: an octant, mirrored."""
    tall, wide = (math.ceil((r + 6 * epsilon) / h) for r in (shape.minor, shape.major + shape.minor))
    total = np.zeros(6)
    for start in range(0, tall, 8):  # some planes at a time, with one more on every side to difference with
        grid = Grid((min(8, tall - start) + 2, wide + 2, wide + 2), (h, h, h), "replicate")
        field = jet(profile(shape, centres(grid, ((start - 1) * h, -h, -h)), epsilon), grid)
        inside = Jet(*(part[..., 1:-1, 1:-1, 1:-1] for part in field))
        total += energy_terms(inside, epsilon).sum((-3, -2, -1)).numpy()
    return 8 * h**3 / SIGMA * total


def _vector(values: tuple[float, float, float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
