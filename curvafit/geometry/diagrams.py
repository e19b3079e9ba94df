"""Curvature diagrams: the area-weighted measure that a surface leaves on the (κ1, κ2) plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import map_coordinates
from torch import Tensor

from curvafit.core.checks import LONGEST, SHORTEST, check_choice, check_float, check_type
from curvafit.core.runtime import Pictured
from curvafit.geometry.mesh import NoSurface, Surface, areas, surface
from curvafit.priors.curvature import diffuse_curvatures, geometric_curvatures, jet
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
#: Where the search for a half-thickness ends.
_DEEPEST = 6.0
#: Points whose area is followed inwards together.
_TOGETHER = 4096


@dataclass(frozen=True, eq=False, repr=False)
class Diagram(Pictured):
    """A measure on the (κ1, κ2) plane: areas (`weights`, `(N,)`) in the grid's unit squared, at points `(N, 2)` in
    `unit`.

    `spread` is the root mean square distance of the measured points to the ones that stand for them, 0 unless binned:
    the transport distance (cost ½|x - y|²) between a diagram and its binned self is at most √½ · spread. `excluded` is
    the part of the surface's area left out because curvature is not resolved there. `places` `(N, 3)` are (z, y, x) on
    the surface of each point, in the grid's unit from the first voxel's centre; None once points were merged or read.
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
        low, high = self.points.min(), self.points.max()
        return (
            f"Diagram({len(self.points)} points, area {self.area:.4g}, κ from {low:.4g} to {high:.4g} in {self.unit})"
        )

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
        """Return bins of edge `width`, each replaced by its barycentre: means and total weight are kept exactly."""
        if not width > 0:
            raise ValueError(f"expected a bin width above 0, got {width}")
        return self._merge(self._cells(width))

    def thin(self, width: float, share: float) -> Diagram:
        """Return bins of edge `width` where the area is, and wider ones, by powers of two, in the tails.

        A bin is the widest whose part of the area times (edge / width)² is at most `share`.
        """
        if not share > 0:
            raise ValueError(f"expected a share above 0, got {share}")
        fine = self.bin(width)
        parts = fine.normalised.weights
        index = fine._cells(width)
        merged = np.zeros(len(parts), dtype=bool)
        for level in range(WIDENINGS, 0, -1):
            cells = fine._cells(width * 2**level)
            light = (np.bincount(cells, parts * ~merged) * 4.0**level <= share)[cells] & ~merged
            index[light] = level * len(parts) + cells[light]
            merged |= light
        return fine._merge(np.unique(index, return_inverse=True)[1])

    def _cells(self, width: float) -> np.ndarray:
        """Return the number of the square of edge `width` that each point is in: 0, 1, … over the occupied ones."""
        cells = np.floor(self.points / width).astype(np.int64)
        cells -= cells.min(0, initial=0)
        return np.unique(cells @ np.array([cells[:, 1].max(initial=0) + 1, 1]), return_inverse=True)[1]

    def _merge(self, index: np.ndarray) -> Diagram:
        """Return the points with the same index (0, 1, …) replaced by their barycentre."""
        weights = np.bincount(index, self.weights)
        heavy = weights > 0
        safe = np.where(heavy, weights, 1)
        means = np.stack([np.bincount(index, self.weights * self.points[:, k]) / safe for k in range(2)], axis=1)
        square = ((self.points - means[index]) ** 2).sum(1)
        added = float(self.weights @ square) / self.area if self.area > 0 else 0.0
        spread = math.sqrt(self.spread**2 + added)
        return replace(self, points=means[heavy], weights=weights[heavy], spread=spread, places=None)


def join_diagrams(parts: Sequence[Diagram]) -> Diagram:
    """Return the diagram of several surfaces together, in the unit of the first."""
    points, weights = (np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "weights"))
    lost = sum(part.excluded * part.area for part in parts) / weights.sum() if weights.any() else 0.0
    known = [part.places for part in parts if part.places is not None]
    places = np.concatenate(known) if len(known) == len(parts) else None
    return Diagram(points, weights, parts[0].unit, excluded=float(lost), places=places)


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

    Curvatures of the voxels around a triangle are interpolated linearly at its barycentre. The geometric ones are those
    of the level sets of √2 ε artanh(u), which are u's own: differences of that near-distance err far less than
    differences of tanh. The diffuse ones, to reproduce the paper, are of u itself. The field `(Z, Y, X)` is finite and
    positive inside. Where there is no surface, in the box or in `where`, NoSurface is raised, a ValueError.

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
    epsilon = check_float(epsilon, "a positive epsilon", SHORTEST, LONGEST)
    if where is not None and np.shape(where) != grid.shape:
        raise ValueError(f"expected a mask of shape {grid.shape}, got {np.shape(where)}")
    values = torch.as_tensor(u)
    values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
    mesh = _inner_surface(values, grid, margin)
    kappa1, kappa2, resolved = _voxel_curvatures(values, grid, epsilon, curvature)
    weights, centres = areas(mesh), mesh.barycentres / np.array(grid.spacing)
    counted = weights >= LEAST_TRIANGLE * grid.voxel_volume ** (2 / 3)
    if where is not None:
        counted &= np.asarray(where, dtype=bool)[tuple((np.rint(centres).astype(int) % grid.shape).T)]
    if not counted.any():
        raise NoSurface("expected a surface in the part that counts, got none")
    weights, centres = weights[counted], centres[counted]
    points, known = _interpolate((kappa1, kappa2), resolved, centres, grid.periodic)
    if not known.any():
        raise NoSurface("expected a surface whose curvature the grid resolves, got none")
    excluded = 1 - float(weights[known].sum() / weights.sum())
    places = centres[known] * np.array(grid.spacing)
    return Diagram(points[known], weights[known], excluded=excluded, places=places)


def find_resolved(slope: Tensor, kappa1: Tensor, kappa2: Tensor, grid: Grid) -> Tensor:
    """Return where the grid resolves curvatures, as bool: the level set is defined, and no radius is under a voxel.

    `slope` is that of the distance that the profile gives (`profile_distance`), 1 for a perfect profile.
    """
    sharpest = 1 / (LEAST_RADIUS * max(grid.spacing))
    return (slope > LEAST_SLOPE) & (kappa1.abs() < sharpest) & (kappa2.abs() < sharpest)


def _inner_surface(values: Tensor, grid: Grid, margin: int | None) -> Surface:
    """Return the surface in the whole box's coordinates, without a margin along the sides that are not periodic."""
    m = 0 if grid.periodic else MARGIN if margin is None else margin
    if m == 0:
        return surface(values, grid)
    nz, ny, nx = (n - 2 * m for n in grid.shape)
    if min(nz, ny, nx) < 4:
        raise ValueError(f"expected a box of at least {2 * m + 4} voxels along each axis, got {grid.shape}")
    inner = surface(values[(slice(m, -m),) * 3], Grid((nz, ny, nx), grid.spacing, grid.boundary))
    return Surface(inner.vertices + m * np.array(grid.spacing), inner.faces)


def _voxel_curvatures(values: Tensor, grid: Grid, epsilon: float, curvature: str) -> tuple[np.ndarray, ...]:
    """Return κ1, κ2 of every voxel (0 where not resolved) and whether they are resolved, as 1 or 0."""
    distance = jet(profile_distance(values, epsilon), grid)
    if curvature == "geometric":
        κ1, κ2, _, _ = geometric_curvatures(distance)
    else:
        κ1, κ2, _, _ = diffuse_curvatures(jet(values, grid), epsilon)
    slope = distance.gradient.square().sum(-4).sqrt()
    known = find_resolved(slope, κ1, κ2, grid)
    parts = (torch.where(known, κ1, 0.0), torch.where(known, κ2, 0.0), known.to(values.dtype))
    return tuple(part.detach().cpu().numpy() for part in parts)


def _interpolate(
    fields: tuple[np.ndarray, ...], resolved: np.ndarray, centres: np.ndarray, periodic: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return values `(N, 2)` at `centres` `(N, 3)` (in voxels) from the resolved voxels around, and where any are. The
    fields are 0 elsewhere: their sums over the sum of resolved voxels are means."""
    *sums, total = (
        map_coordinates(values, centres.T, np.float64, order=1, mode="grid-wrap" if periodic else "nearest")
        for values in (*fields, resolved)
    )
    return np.stack(sums, axis=1) / np.where(total > 0, total, 1)[:, None], total > 0


def family_shares(diagram: Diagram, radius: float) -> dict[str, float]:
    """Return the share of area nearest in direction to each family's ideal point, and the flat share (`layers`).

    Directions after Koenderink's shape index; `radius` is the structure's half-thickness in the diagram's unit.
    """
    areas = np.bincount(families(diagram.points, radius), diagram.weights, minlength=len(FAMILIES))
    shares = dict(zip(FAMILIES, map(float, areas / areas.sum()), strict=True))
    return {"layers": shares.pop("layers")} | shares


def families(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the family, as its number in `FAMILIES`, of each point (κ1, κ2), (N, 2); see `family_shares`."""
    kappa1, kappa2 = points.T
    flat = np.hypot(kappa1, kappa2) * radius * _FLAT_RADII < 1
    angle = np.degrees(np.arctan2(kappa2, kappa1))
    angle = np.where(angle > 45 + 1e-9, angle - 360, angle)
    nearest = np.abs(angle[:, None] - np.array(list(_ANGLES.values()))).argmin(1)
    numbers = np.array([FAMILIES.index(name) for name in _ANGLES])
    return np.where(flat, FAMILIES.index("layers"), numbers[nearest])


def family_of(diagram: Diagram, radius: float) -> str:
    """Return the family's name: the largest share, or layers where at least half the area is flat."""
    return leading_family(family_shares(diagram, radius))


def leading_family(shares: dict[str, float]) -> str:
    """Return the family with the largest share of area, or layers where they hold at least half."""
    if shares["layers"] >= _LAYERS:
        return "layers"
    return max(_ANGLES, key=lambda name: shares[name])


def half_thickness(diagram: Diagram, volume: float) -> float:
    """Return the half-thickness of what a surface bounds, from its volume and its diagram alone, in the diagram's unit.

    It is the depth at which the inner parallel surfaces have swept the volume: an element of area dA has
    (1 - κ1 t)(1 - κ2 t) dA at depth t, and nothing beyond its centres of curvature (Steiner's formula). Exact for
    plates, cylinders and balls; at most `_DEEPEST` times volume / area, where a ball's is 3.
    """
    depths = np.linspace(0, _DEEPEST * volume / diagram.area, 601)
    left = np.zeros_like(depths)  # of the area, by depth
    for start in range(0, len(diagram.points), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        shrunk = np.clip(1 - diagram.points[part, :, None] * depths, 0, None)
        left += diagram.weights[part] @ shrunk.prod(axis=1)
    swept = cumulative_trapezoid(left, depths, initial=0)
    return float(depths[np.searchsorted(swept, min(volume, swept[-1]) * (1 - 1e-9))])
