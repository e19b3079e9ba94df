"""Curvature diagrams: the area-weighted measure that a surface leaves on the (κ1, κ2) plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numba import njit
from torch import Tensor

from curvafit.core.checks import check_choice, check_positive, check_type
from curvafit.core.runtime import Pictured
from curvafit.geometry.mesh import NoSurface, Surface, areas, surface
from curvafit.priors.curvature import XI, diffuse_curvatures, jet
from curvafit.priors.grid import Grid
from curvafit.priors.profile import profile_distance

Kind = Literal["geometric", "diffuse"]

#: Triangles smaller than this, in squared voxel edges, carry no curvature (paper's program).
LEAST_TRIANGLE = 1e-4
#: Voxels that a non-periodic box loses on every side: its stencils and distances see a mirror image there.
MARGIN = 3
#: A level set is defined where the slope of the distance, 1 for a perfect profile, exceeds this.
LEAST_SLOPE = 0.1
#: Edge of the bins in the (κ1, κ2) plane, in 1 / working unit, with which diagrams are compared and stored.
BIN_WIDTH = 2.0
#: Part of the area, times (edge / bin width)², that a widened bin may hold.
TAIL_SHARE = 3e-3
#: How many times bins may double in the tails of a thinned diagram.
WIDENINGS = 5
#: Radii of curvature below this many voxels are not resolved.
LEAST_RADIUS = 1.0
#: Angles of the ideal points in the (κ1, κ2) plane: sphere (1, 1), tube (1, 0), sponge (1, -1); cavities mirror them.
_ANGLES = {"spheres": 45.0, "tubes": 0.0, "sponge": -45.0, "tubular cavities": -90.0, "bubbles": -135.0}
#: A point is flat where its radii of curvature exceed the structure's half-thickness this many times over.
_FLAT_RADII = 2.5
#: Share of flat area from which a shape is made of layers.
_LAYERS = 0.5
#: All families, in the order in which they are listed.
FAMILIES = ("spheres", "layers", "tubes", "sponge", "tubular cavities", "bubbles")


@dataclass(frozen=True, eq=False, repr=False)
class Diagram(Pictured):
    """A measure on the (κ1, κ2) plane: areas (`weights`, `(N,)`) in the grid's unit squared, at points `(N, 2)` in
    `unit`.

    `spread` is the root mean square distance of the measured points to the bins that replace them, 0 unless binned: the
    transport distance (cost ½|x - y|²) between a diagram and its binned self is at most √½ · spread. `excluded` is the
    fraction of the surface's area left out because curvature is not resolved there. `places` `(N, 3)` are positions
    (z, y, x) on the surface, in the grid's unit from the first voxel's centre; None once points were merged or read.
    """

    points: np.ndarray
    weights: np.ndarray
    unit: str = "1/working unit"
    spread: float = 0.0
    excluded: float = 0.0
    places: np.ndarray | None = None

    def __post_init__(self) -> None:
        points, weights = np.asarray(self.points, dtype=np.float64), np.asarray(self.weights, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or weights.shape != points.shape[:1]:
            raise ValueError(f"expected points (N, 2) and weights (N,), got {points.shape} and {weights.shape}")
        if not np.isfinite(points).all() or not np.isfinite(weights).all() or (weights < 0).any():
            raise ValueError("expected finite points and finite weights of at least 0, got others")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights)

    def __repr__(self) -> str:
        if not len(self.points):
            return f"Diagram(no points, in {self.unit})"
        curvatures = f"κ from {self.points.min():.4g} to {self.points.max():.4g} in {self.unit}"
        return f"Diagram({len(self.points)} points, area {self.area:.4g}, {curvatures})"

    @property
    def area(self) -> float:
        """Return the total weight."""
        return float(self.weights.sum())

    @property
    def mirrored(self) -> Diagram:
        """Return the diagram of the same surface with inside and outside exchanged: (κ1, κ2) becomes (-κ2, -κ1)."""
        return replace(self, points=-self.points[:, ::-1])

    @property
    def normalised(self) -> Diagram:
        """Return the same diagram with total weight 1."""
        if not self.area > 0:
            raise ValueError("expected a diagram with area, got an empty one")
        return replace(self, weights=self.weights / self.area)

    def mean(self) -> np.ndarray:
        """Return the area-weighted mean (κ1, κ2)."""
        return self.normalised.weights @ self.points

    def bin(self, width: float) -> Diagram:
        """Merge the points in each bin of edge `width` into their barycentre; the mean and the total weight stay."""
        if not width > 0:
            raise ValueError(f"expected a bin width above 0, got {width}")
        return self._merge(self._cells(width))

    def thin(self, width: float, share: float) -> Diagram:
        """Merge points in bins of edge `width`, widened by powers of two in the tails, where there is little area.

        Of all bins, a point takes the widest whose share of the area times (edge / width)² is at most `share`.
        """
        if not share > 0:
            raise ValueError(f"expected a share above 0, got {share}")
        fine = self.bin(width)
        shares = fine.normalised.weights
        index = fine._cells(width)
        merged = np.zeros(len(shares), dtype=bool)
        for level in range(WIDENINGS, 0, -1):
            cells = fine._cells(width * 2**level)
            light = (np.bincount(cells, shares * ~merged) * 4.0**level <= share)[cells] & ~merged
            index[light] = level * len(shares) + cells[light]  # no other level has these indices
            merged |= light
        return fine._merge(np.unique(index, return_inverse=True)[1])

    def _cells(self, width: float) -> np.ndarray:
        """Return the index of each point's bin of edge `width`: 0, 1, … over the occupied bins."""
        cells = np.floor(self.points / width).astype(np.int64)
        cells -= cells.min(0, initial=0)
        return np.unique(cells @ np.array([cells[:, 1].max(initial=0) + 1, 1]), return_inverse=True)[1]

    def _merge(self, index: np.ndarray) -> Diagram:
        """Merge the points with the same index (0, 1, …) into their barycentre."""
        weights = np.bincount(index, self.weights)
        occupied = weights > 0
        divisor = np.where(occupied, weights, 1)
        means = np.stack([np.bincount(index, self.weights * self.points[:, k]) / divisor for k in range(2)], axis=1)
        square = ((self.points - means[index]) ** 2).sum(1)
        variance = float(self.weights @ square) / self.area if self.area > 0 else 0.0
        spread = math.sqrt(self.spread**2 + variance)
        return replace(self, points=means[occupied], weights=weights[occupied], spread=spread, places=None)


def join_diagrams(diagrams: Sequence[Diagram]) -> Diagram:
    """Return the diagram of several surfaces together, in the unit of the first."""
    points = np.concatenate([diagram.points for diagram in diagrams])
    weights = np.concatenate([diagram.weights for diagram in diagrams])
    excluded = sum(diagram.excluded * diagram.area for diagram in diagrams) / weights.sum() if weights.any() else 0.0
    places = [diagram.places for diagram in diagrams if diagram.places is not None]
    joined = np.concatenate(places) if len(places) == len(diagrams) else None
    return Diagram(points, weights, diagrams[0].unit, excluded=float(excluded), places=joined)


def diagram(
    u: np.ndarray | Tensor,
    grid: Grid,
    epsilon: float,
    *,
    curvature: Kind = "geometric",
    margin: int | None = None,
    where: np.ndarray | None = None,
) -> Diagram:
    """Measure the curvature diagram of {u = 0}, Σ area[c] δ_(κ1, κ2)[c] over the cells c of its mesh (paper, eq. 25).

    Curvatures of the voxels around a triangle are interpolated linearly at its barycentre. Geometric curvatures are
    those of the level sets of √2 ε artanh(u), which are the level sets of u: finite differences of this approximate
    distance are far more accurate than those of u. Diffuse curvatures, to reproduce the paper, are those of u itself.
    The field `(Z, Y, X)` is finite and positive inside. Raises NoSurface, a ValueError, where there is no surface.

    Parameters
    ----------
    margin
        Voxels left out along every side of a box that is not periodic; `MARGIN` by default. 0 measures up to the
        outermost centres, right where the mirror image beyond them is real.
    where
        bool `(Z, Y, X)`: only triangles whose nearest voxel is True count.
    """
    check_choice(curvature, ("geometric", "diffuse"), "curvature 'geometric' or 'diffuse'")
    check_type(grid, Grid, "a Grid")
    check_type(u, (np.ndarray, Tensor), f"a field of shape {grid.shape}")
    epsilon = check_positive(epsilon, "a positive epsilon")
    if where is not None and np.shape(where) != grid.shape:
        raise ValueError(f"expected a mask of shape {grid.shape}, got {np.shape(where)}")
    values = torch.as_tensor(u)
    values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
    mesh = _inner_surface(values, grid, margin)
    weights, centres = areas(mesh), mesh.barycentres / np.array(grid.spacing)
    counted = weights >= LEAST_TRIANGLE * grid.voxel_volume ** (2 / 3)
    if where is not None:
        counted &= np.asarray(where, dtype=bool)[tuple((np.rint(centres).astype(int) % grid.shape).T)]
    if not counted.any():
        raise NoSurface("expected a surface in the part that counts, got none")
    weights, centres = weights[counted], centres[counted]
    points, kept = _interpolate_curvatures(values, grid, epsilon, curvature, centres)
    if not kept.any():
        raise NoSurface("expected a surface whose curvature the grid resolves, got none")
    excluded = 1 - float(weights[kept].sum() / weights.sum())
    places = centres[kept] * np.array(grid.spacing)
    return Diagram(points[kept], weights[kept], excluded=excluded, places=places)


def find_resolved(slope: Any, kappa1: Any, kappa2: Any, grid: Grid) -> Any:
    """Return, as bool, the voxels where the level set is defined and no radius of curvature is below a voxel.

    `slope`, a tensor or an array, is the norm of the gradient of `profile_distance`, 1 for a perfect profile.
    """
    sharpest = 1 / (LEAST_RADIUS * max(grid.spacing))
    return (slope > LEAST_SLOPE) & (abs(kappa1) < sharpest) & (abs(kappa2) < sharpest)


def _inner_surface(values: Tensor, grid: Grid, margin: int | None) -> Surface:
    """Return the surface without `margin` voxels along the faces of a box that is not periodic, in its coordinates."""
    m = 0 if grid.periodic else MARGIN if margin is None else margin
    if m == 0:
        return surface(values, grid)
    nz, ny, nx = (n - 2 * m for n in grid.shape)
    if min(nz, ny, nx) < 4:
        raise ValueError(f"expected a box of at least {2 * m + 4} voxels along each axis, got {grid.shape}")
    inner = surface(values[(slice(m, -m),) * 3], Grid((nz, ny, nx), grid.spacing, grid.boundary))
    return Surface(inner.vertices + m * np.array(grid.spacing), inner.faces)


def _interpolate_curvatures(
    values: Tensor, grid: Grid, epsilon: float, curvature: Kind, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate κ1, κ2 linearly at `centres` `(M, 3)`, in voxels, from the resolved voxels around each, if there are
    any; return curvatures `(M, 2)` and whether there are."""
    values, numbers = values.detach().cpu(), np.zeros(grid.shape, np.int32)
    _mark_corners(centres, grid.periodic, numbers)
    voxels = np.flatnonzero(numbers)
    numbers.ravel()[voxels] = np.arange(len(voxels))
    distance = profile_distance(values, epsilon)
    if curvature == "geometric":
        κ1, κ2, slope = measure_levels(distance.contiguous().numpy(), grid.spacing, grid.periodic, voxels)
    else:
        slopes = jet(distance, grid).gradient.square().sum(-4).sqrt()
        fields = (*diffuse_curvatures(jet(values, grid), epsilon)[:2], slopes)
        κ1, κ2, slope = (field.flatten().numpy()[voxels] for field in fields)
    return _interpolate(centres, grid.periodic, numbers, κ1, κ2, find_resolved(slope, κ1, κ2, grid))


@njit(cache=True, nogil=True)
def _mark_corners(centres, periodic, marks):  # pragma: no cover
    """Set the marks of the voxels around places to 1."""
    for centre in centres:
        for corner in range(8):
            z, y, x, _ = _find_corner(centre, corner, marks.shape, periodic)
            marks[z, y, x] = 1


@njit(cache=True, nogil=True)
def _interpolate(centres, periodic, numbers, κ1, κ2, resolved):  # pragma: no cover
    """Interpolate at places between the resolved of the voxels around each, which have numbers."""
    curvatures, known = np.zeros((len(centres), 2)), np.zeros(len(centres), np.bool_)
    for k in range(len(centres)):
        total = 0.0
        for corner in range(8):
            z, y, x, share = _find_corner(centres[k], corner, numbers.shape, periodic)
            voxel = numbers[z, y, x]
            if resolved[voxel] and share > 0:
                total += share
                curvatures[k, 0] += share * κ1[voxel]
                curvatures[k, 1] += share * κ2[voxel]
        known[k] = total > 0
        if total > 0:
            curvatures[k] /= total
    return curvatures, known


@njit(cache=True, inline="always")
def _find_corner(place, corner, shape, periodic):  # pragma: no cover
    """Return one of the eight voxels (z, y, x) around a place, and its weight in a linear interpolation."""
    below = np.floor(place[0]), np.floor(place[1]), np.floor(place[2])
    upper = corner >> 2, corner >> 1 & 1, corner & 1
    share = 1.0
    for axis in range(3):
        part = place[axis] - below[axis]
        share *= part if upper[axis] else 1 - part
    z = _continue(int(below[0]) + upper[0], shape[0], periodic)
    y = _continue(int(below[1]) + upper[1], shape[1], periodic)
    return z, y, _continue(int(below[2]) + upper[2], shape[2], periodic), share


@njit(cache=True, inline="always")
def _continue(k, n, periodic):  # pragma: no cover
    """Return the voxel 0 … n - 1 that a voxel up to one beyond them is a copy, or the mirror image, of."""
    if 0 <= k < n:
        return k
    return k % n if periodic else min(max(k, 0), n - 1)


@njit(cache=True, nogil=True)
def measure_levels(u, spacing, periodic, voxels):  # pragma: no cover
    """Return κ1 and κ2 as `priors.curvature.geometric_curvatures` has them, and |∇u|, at voxels, flat indices."""
    (nz, ny, nx), (hz, hy, hx) = u.shape, spacing
    κ1, κ2, slope = np.empty(len(voxels)), np.empty(len(voxels)), np.empty(len(voxels))
    for k in range(len(voxels)):
        z, y, x = voxels[k] // nx // ny, voxels[k] // nx % ny, voxels[k] % nx
        a, A = _continue(z - 1, nz, periodic), _continue(z + 1, nz, periodic)
        b, B = _continue(y - 1, ny, periodic), _continue(y + 1, ny, periodic)
        c, C = _continue(x - 1, nx, periodic), _continue(x + 1, nx, periodic)
        twice = 2.0 * u[z, y, x]
        gz, zz = (u[A, y, x] - u[a, y, x]) / (2 * hz), (u[A, y, x] - twice + u[a, y, x]) / hz**2
        gy, yy = (u[z, B, x] - u[z, b, x]) / (2 * hy), (u[z, B, x] - twice + u[z, b, x]) / hy**2
        gx, xx = (u[z, y, C] - u[z, y, c]) / (2 * hx), (u[z, y, C] - twice + u[z, y, c]) / hx**2
        zy = ((u[A, B, x] - u[A, b, x]) - (u[a, B, x] - u[a, b, x])) / (4 * hz * hy)
        zx = ((u[A, y, C] - u[A, y, c]) - (u[a, y, C] - u[a, y, c])) / (4 * hz * hx)
        yx = ((u[z, B, C] - u[z, B, c]) - (u[z, b, C] - u[z, b, c])) / (4 * hy * hx)
        square = gz * gz + gy * gy + gx * gx
        length2 = square + XI * XI
        normal = gz * (gz * zz + 2 * (gy * zy + gx * zx)) + gy * (gy * yy + 2 * gx * yx) + gx * gx * xx
        adjugate = gz * gz * (yy * xx - yx * yx) + gy * gy * (zz * xx - zx * zx) + gx * gx * (zz * yy - zy * zy)
        adjugate += 2 * gz * (gy * (zx * yx - zy * xx) + gx * (zy * yx - zx * yy)) + 2 * gy * gx * (zy * zx - zz * yx)
        H = -(zz + yy + xx - normal / length2) / math.sqrt(length2)
        root = math.sqrt(max(H * H - 4 * adjugate / length2**2, 0.0))
        κ1[k], κ2[k], slope[k] = (H + root) / 2, (H - root) / 2, math.sqrt(square)
    return κ1, κ2, slope


def family_shares(diagram: Diagram, radius: float) -> dict[str, float]:
    """Return the share of area of each family by name: flat area is layers, other area has the nearest ideal point.

    Points are compared by direction (Koenderink's shape index); `radius` is the half-thickness in the diagram's unit.
    """
    areas = np.bincount(families(diagram.points, radius), diagram.weights, minlength=len(FAMILIES))
    shares = dict(zip(FAMILIES, map(float, areas / areas.sum()), strict=True))
    return {"layers": shares.pop("layers")} | shares


def families(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the index in `FAMILIES` of the family of each point (κ1, κ2), `(N, 2)`; see `family_shares`."""
    kappa1, kappa2 = points.T
    flat = np.hypot(kappa1, kappa2) * radius * _FLAT_RADII < 1
    angle = np.degrees(np.arctan2(kappa2, kappa1))
    angle = np.where(angle > 45 + 1e-9, angle - 360, angle)  # κ1 ≥ κ2: angles go from -135 to 45
    ideal = np.array(list(_ANGLES.values()))[::-1]
    nearest = np.searchsorted((ideal[1:] + ideal[:-1]) / 2, angle, side="right")
    indices = np.array([FAMILIES.index(name) for name in _ANGLES])[::-1]
    return np.where(flat, FAMILIES.index("layers"), indices[nearest])


def family_of(diagram: Diagram, radius: float) -> str:
    """Return the family's name: the largest share, or layers where at least half the area is flat."""
    shares = family_shares(diagram, radius)
    return "layers" if shares["layers"] >= _LAYERS else max(_ANGLES, key=lambda name: shares[name])
