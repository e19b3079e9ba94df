"""Signed distance of a phase field: by its own profile at the surface, by a Euclidean transform away from it."""

from __future__ import annotations

import numpy as np
from numba import njit
from torch import Tensor

from curvafit.geometry.diagram import LEAST_SLOPE
from curvafit.geometry.mesh import NoSurface
from curvafit.priors.grid import Grid
from curvafit.priors.profile import profile_distance

#: Slope of the profile's distance (1 for a perfect one) from which that is taken off the surface too. Curvature and
#: normals ask for less, `LEAST_SLOPE`: they hang on the level set's direction and not on how far away it is.
STEEP = 0.5
#: Radius (voxels) with which surfaces are taken to curve away from points far off.
BEND = 4.0


def field_distance(field: Tensor, grid: Grid, epsilon: float) -> np.ndarray:
    """Return the distance of every voxel's centre to {u = 0}, positive inside, float32 (Z, Y, X) in spacing's unit.

    Within one and a half voxels of the surface it is the profile's √2 ε artanh(u) over its slope, however wide the
    profile: right to 0.02 voxels at less than a voxel from it where its radius of curvature is 5 voxels, to 0.08 where
    it is 3. Voxels with a neighbour (of six) on the other side so give a point of the surface and its normal each.
    Those further away take the point of the nearest such voxel (Euclidean transform, exact on anisotropic and periodic
    grids) and measure along its normal, corrected for how far they are beside it: right to 0.04 voxels on average,
    0.4 at worst. A box that is not periodic knows no surface beyond its faces.

    Raises
    ------
    NoSurface
        A `ValueError`: if the field is not positive in some voxels and not in others.
    """
    inside = field > 0
    if not bool(inside.any()) or bool(inside.all()):
        raise NoSurface("expected a field that is positive in some voxels and not in others, got one phase only")
    near = profile_distance(field.detach().cpu().float(), epsilon).contiguous().numpy()
    edges = np.array(grid.spacing, dtype=np.float32)
    shell, feet, distance = _at_surface(near, edges, grid.periodic)
    squared = np.where(shell, np.float32(0), np.float32(np.inf))
    seed = np.where(shell, np.arange(near.size, dtype=np.int32).reshape(near.shape), np.int32(-1))
    for axis in (2, 1, 0):
        rows = (np.ascontiguousarray(np.moveaxis(each, axis, -1)) for each in (squared, seed))
        squared, seed = (np.moveaxis(each, -1, axis) for each in _along(*rows, edges[axis], grid.periodic))
    _away(distance, near, np.ascontiguousarray(seed), feet, edges, grid.periodic)
    return distance


@njit(cache=True)
def _at_surface(near, edges, periodic):  # pragma: no cover
    """Return the voxels that touch the other side; their offsets to the surface and its normals (…, 6); the distance of
    all voxels within one of it, NaN elsewhere."""
    shape, widest = near.shape, edges.max()
    shell = np.zeros(shape, dtype=np.bool_)
    feet = np.zeros((*shape, 6), dtype=np.float32)
    distance = np.full(shape, np.nan, dtype=np.float32)
    slope, at = np.zeros(3, dtype=np.float32), np.zeros(3, dtype=np.int64)
    for z, y, x in np.ndindex(shape):
        here = near[z, y, x]
        least, side, way = np.float32(np.inf), -1, 0
        for axis in range(3):
            total, values = np.float32(0), 0
            for step in (-1, 1):
                at[0], at[1], at[2] = z, y, x
                at[axis] += step
                if at[axis] < 0 or at[axis] >= shape[axis]:
                    if not periodic:
                        continue
                    at[axis] %= shape[axis]
                other = near[at[0], at[1], at[2]]
                values += 1
                total += step * (other - here)
                if (other > 0) != (here > 0):
                    along = edges[axis] * abs(here) / (abs(here) + abs(other))
                    if along < least:
                        least, side, way = along, axis, step
            slope[axis] = total / (values * edges[axis])
        steep = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
        sign = 1 if here > 0 else -1
        if side < 0:
            if steep > STEEP and abs(here) <= 1.5 * steep * widest:
                distance[z, y, x] = here / steep
            continue
        shell[z, y, x] = True
        length = min(least, abs(here) / steep) if steep > LEAST_SLOPE else least
        feet[z, y, x, 3 + side] = -sign * way
        if steep > LEAST_SLOPE:
            feet[z, y, x, 3:] = slope / steep
        feet[z, y, x, :3] = -sign * length * feet[z, y, x, 3:]
        distance[z, y, x] = sign * length
    return shell, feet, distance


@njit(cache=True)
def _along(squared, seed, edge, periodic):  # pragma: no cover
    """Take one axis (the last) of the squared distance and of the nearest seed: lower envelope of parabolas
    (Felzenszwalb and Huttenlocher 2012); a periodic row is taken from half a row before it to half a row after it."""
    rows, columns, n = squared.shape
    before = n // 2 if periodic else 0
    count = n + 2 * before
    out, who = np.empty_like(squared), np.empty_like(seed)
    row, centre, until = np.empty(count, np.float32), np.empty(count, np.int64), np.empty(count, np.float32)
    per_square, half = np.float32(1) / (edge * edge), np.float32(0.5)
    for a, b in np.ndindex((rows, columns)):
        row[before : before + n] = squared[a, b] * per_square
        row[:before] = row[n : n + before]
        row[before + n :] = row[before : 2 * before]
        last = -1
        for q in range(count):
            value = row[q]
            if value == np.inf:
                continue
            start = np.float32(-np.inf)
            while last >= 0:
                p = centre[last]
                start = half * ((value - row[p]) / np.float32(q - p) + np.float32(q + p))
                if start > until[last]:
                    break
                last -= 1
                start = np.float32(-np.inf)
            last += 1
            centre[last], until[last] = q, start
        k = 0
        for q in range(before, before + n):
            while k < last and until[k + 1] < q:
                k += 1
            p = centre[k]
            out[a, b, q - before] = (row[p] + np.float32((q - p) * (q - p))) * edge * edge if last >= 0 else np.inf
            who[a, b, q - before] = seed[a, b, (p - before) % n] if last >= 0 else -1
    return out, who


@njit(cache=True)
def _away(distance, near, seed, feet, edges, periodic):  # pragma: no cover
    """Fill in the distance where it is NaN: a along the seed's normal, and t beside it: a + t² / 2(a + `BEND`)."""
    nz, ny, nx = near.shape
    bend = np.float32(BEND * edges.max())
    for z, y, x in np.ndindex(near.shape):
        if not np.isnan(distance[z, y, x]):
            continue
        i = seed[z, y, x]
        sz, sy, sx = i // (ny * nx), i // nx % ny, i % nx
        dz, dy, dx = sz - z, sy - y, sx - x
        if periodic:
            dz, dy, dx = dz - nz * round(dz / nz), dy - ny * round(dy / ny), dx - nx * round(dx / nx)
        f = feet[sz, sy, sx]
        az, ay, ax = dz * edges[0] + f[0], dy * edges[1] + f[1], dx * edges[2] + f[2]
        square = az * az + ay * ay + ax * ax
        along = abs(az * f[3] + ay * f[4] + ax * f[5])
        length = along + max(square - along * along, np.float32(0)) / (2 * (np.sqrt(square) + bend))
        distance[z, y, x] = length if near[z, y, x] > 0 else -length
