"""Exact training labels of a generated shape."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from scipy.cluster.hierarchy import DisjointSet
from skimage.segmentation import find_boundaries, watershed
from torch import Tensor

from curvafit.geometry.centreline import skeleton_of
from curvafit.geometry.diagrams import LEAST_SLOPE, MARGIN, find_resolved
from curvafit.geometry.mesh import NoSurface
from curvafit.geometry.morphology import local_thickness
from curvafit.geometry.topology import betti_numbers
from curvafit.priors.curvature import geometric_curvatures, jet
from curvafit.priors.grid import Grid
from curvafit.priors.profile import profile_distance

#: Pieces that touch are two where the neck between them is thinner than this multiple of the thinner one's radius.
NECK = 0.5
#: Radius (voxels) of the sphere that stands for the surface where the distance of far voxels is measured.
BEND = 4.0
#: Names of all labels.
NAMES = ("mask", "distance", "skeleton", "instances", "kappa1", "kappa2", "radius", "betti")


def labels_of(
    field: Tensor | np.ndarray, grid: Grid, epsilon: float, which: Collection[str] | str = NAMES
) -> dict[str, Any]:
    """Return the labels named in `which` of a phase field `(Z, Y, X)`, positive inside: arrays of its shape by name.

    The box is a window, whatever the grid's boundary: a tube that is cut by a face ends there. A field that does not
    cross 0 is a NoSurface, a ValueError.

    mask
        bool: u > 0.
    distance
        float32, to the surface, positive inside, in spacing's unit; see `field_distance`.
    skeleton
        bool: curves with the mask's topology; see `skeleton_of`.
    instances
        int32: 0 outside, 1, 2, … in the pieces; see `instances_of`.
    kappa1, kappa2
        float32: the surface's principal curvatures κ1 ≥ κ2 in 1/spacing's unit, positive where the shape is convex, in
        voxels with one of their six neighbours on the other side of the surface. NaN elsewhere, where the grid does not
        resolve the curvature, and within `diagram.MARGIN` voxels of the faces of the box.
    radius
        float32: the radius of the largest ball inside that covers the voxel, in spacing's unit; 0 outside. Up to half a
        voxel too little on tubes and balls; see `morphology.local_thickness`.
    betti
        b0 pieces, b1 tunnels, b2 cavities; see `topology.betti_numbers`.
    """
    names = {which} if isinstance(which, str) else set(which)
    if unknown := sorted(names - set(NAMES)):
        raise ValueError(f"labels are {', '.join(NAMES)}, got {', '.join(unknown)}")
    u, grid = _check_field(field, grid, epsilon), replace(grid, boundary="replicate")
    mask = (u > 0).cpu().numpy()
    labels: dict[str, Any] = {"mask": mask}
    if names & {"distance", "skeleton", "instances", "radius"}:
        labels["distance"] = distance = field_distance(u, grid, epsilon)
        if "skeleton" in names:
            labels["skeleton"] = skeleton_of(distance)
        if "instances" in names:
            labels["instances"] = instances_of(distance)
        if "radius" in names:
            labels["radius"] = local_thickness(distance > 0, grid.spacing) / 2
    if names & {"kappa1", "kappa2"}:
        labels["kappa1"], labels["kappa2"] = _measure_curvatures(u, mask, grid, epsilon)
    if "betti" in names:
        labels["betti"] = betti_numbers(mask)
    return {name: labels[name] for name in NAMES if name in names}


def instances_of(distance: np.ndarray) -> np.ndarray:
    """Return the pieces of {distance > 0}: int32 `(Z, Y, X)`, 0 outside and 1, 2, … in the order of their first voxels.

    Pieces are 26-connected, and divided at necks: the distance's watershed has a basin around every maximum, and basins
    are joined, widest neck first, unless the neck between them is thinner than `NECK` times the thinner one's greatest
    radius. So beads on a thin tube are several, an even tube is one.
    """
    basins = watershed(-distance, mask=distance > 0, connectivity=3).astype(np.int64)
    widest = np.zeros(basins.max() + 1, dtype=np.float32)
    np.maximum.at(widest, basins.ravel(), distance.ravel())  # the greatest radius of each basin
    widest[0] = 0
    pieces = DisjointSet(range(len(widest)))
    for width, first, second in _find_necks(basins, distance):
        a, b = pieces[first], pieces[second]
        if a != b and width >= NECK * min(widest[a], widest[b]):
            pieces.merge(a, b)
            widest[pieces[a]] = max(widest[a], widest[b])
    return _number_pieces(np.array([pieces[k] for k in pieces])[basins])


def _find_necks(basins: np.ndarray, distance: np.ndarray) -> list[tuple[float, int, int]]:
    """Return the necks between basins that touch by faces, widest first: the neck's radius and both basins."""
    # Radii are negated, so that `np.unique` sorts the widest first. Where that does not join two basins, none does.
    necks = []
    for axis in range(3):
        (labels, next_labels), (radii, next_radii) = (
            (np.delete(values, -1, axis), np.delete(values, 0, axis)) for values in (basins, distance)
        )
        touch = (labels > 0) & (next_labels > 0) & (labels != next_labels)
        pair = np.sort([labels[touch], next_labels[touch]], axis=0)
        necks.append(np.stack([-np.minimum(radii[touch], next_radii[touch]), *pair], 1))
    return [(-width, int(a), int(b)) for width, a, b in np.unique(np.concatenate(necks), axis=0).tolist()]


def _number_pieces(labels: np.ndarray) -> np.ndarray:
    """Renumber pieces 1, 2, … in the order of their first voxels, int32; 0 stays."""
    first_voxels = np.full(labels.max() + 1, labels.size)
    np.minimum.at(first_voxels, labels.ravel(), np.arange(labels.size))
    first_voxels[0] = -1
    return np.argsort(np.argsort(first_voxels)).astype(np.int32)[labels]


def _measure_curvatures(u: Tensor, mask: np.ndarray, grid: Grid, epsilon: float) -> tuple[np.ndarray, np.ndarray]:
    """Return κ1, κ2 of {u = 0} in the voxels that touch it, NaN elsewhere."""
    # A voxel's centre lies on a level set at distance d from the surface; along the normal κ becomes κ / (1 + κ d).
    distance = jet(profile_distance(u, epsilon), grid)
    slope = distance.gradient.square().sum(-4).sqrt()
    d = distance.value / slope.clamp_min(LEAST_SLOPE)
    κ1, κ2 = (κ / (1 + κ * d) for κ in geometric_curvatures(distance)[:2])
    touching, inner = np.zeros_like(mask), (slice(MARGIN, -MARGIN),) * 3
    touching[inner] = find_boundaries(mask)[inner]  # by a face
    valid = find_resolved(slope, κ1, κ2, grid) & torch.from_numpy(touching)
    return torch.where(valid, κ1, torch.nan).float().numpy(), torch.where(valid, κ2, torch.nan).float().numpy()


def _check_field(field: Tensor | np.ndarray, grid: Grid, epsilon: float) -> Tensor:
    u = torch.as_tensor(field).detach().cpu()
    if tuple(u.shape) != grid.shape:
        raise ValueError(f"the field must have the shape {grid.shape}, got {tuple(u.shape)}")
    if not u.is_floating_point() or not bool(torch.isfinite(u).all()):
        raise ValueError(f"the field must hold finite floating-point numbers, got {u.dtype} or numbers that are not")
    if not epsilon > 0:
        raise ValueError(f"epsilon must be positive, got {epsilon}")
    if not float(u.min()) <= 0 < float(u.max()):
        raise NoSurface(f"the field does not cross 0: its values go from {float(u.min()):g} to {float(u.max()):g}")
    return u.float()


def field_distance(field: Tensor, grid: Grid, epsilon: float) -> np.ndarray:
    """Return the distance of every voxel's centre to {u = 0}, positive inside, float32 (Z, Y, X) in spacing's unit.

    Within one and a half voxels of the surface it is √2 ε artanh(u) over the slope of that, for a profile of any width.
    Less than a voxel from the surface it is right to 0.02 voxels where the radius of curvature is 5 voxels, to 0.08
    where it is 3. Every voxel with one of six neighbours on the other side gives a point of the surface and its normal.
    A voxel further away takes the point of the nearest such voxel, as if the surface there were a sphere of radius
    `BEND`: right to 0.04 voxels on average, 0.4 at worst. A crop has no surface beyond its faces.
    """
    profile = profile_distance(field.detach().cpu().float(), epsilon).numpy()
    edges = np.array(grid.spacing, dtype=np.float32)
    crossing, normal = _find_crossings(profile, edges)
    slope = np.stack([np.gradient(profile, h, axis=axis) for axis, h in enumerate(grid.spacing)], axis=-1)
    steepness = np.linalg.norm(slope, axis=-1)
    resolved = steepness > LEAST_SLOPE
    touching = np.isfinite(crossing)
    known = touching & resolved
    normal[known] = slope[known] / steepness[known, None]
    length = np.minimum(crossing, np.where(resolved, np.abs(profile) / np.where(resolved, steepness, 1), np.inf))
    distance = np.where(profile > 0, length, -length)
    # Away from the surface the profile is trusted where its slope is not far from 1, which a distance has.
    far = ~touching & ((steepness <= 0.5) | (length > 1.5 * edges.max()))
    nearest = ndimage.distance_transform_edt(~touching, edges, return_distances=False, return_indices=True)[:, far].T  # type: ignore[index]
    # The distance is the offset's part along the normal and the sagitta of a sphere of radius `BEND` across it.
    foot = tuple(nearest.T)
    offset = (nearest - np.argwhere(far)) * edges - distance[foot][:, None] * normal[foot]
    square = np.square(offset).sum(1)
    along = np.abs((offset * normal[foot]).sum(1))
    sagitta = np.maximum(square - along**2, 0) / (2 * (np.sqrt(square) + BEND * edges.max()))
    distance[far] = np.where(profile[far] > 0, along + sagitta, -along - sagitta)
    return distance


def _find_crossings(profile: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest way along an axis from each voxel to the surface, infinite where none of six neighbours is on
    the other side, and that axis as a normal inwards (Z, Y, X, 3), 0 there."""
    shortest, normal = np.full(profile.shape, np.inf, np.float32), np.zeros((*profile.shape, 3), np.float32)
    for axis in range(3):
        lower = np.argwhere(np.diff(profile > 0, axis=axis))  # the first voxel of each pair that the surface divides
        upper = lower + np.eye(3, dtype=int)[axis]
        for voxels, neighbours, step in ((upper, lower, -1), (lower, upper, 1)):
            value = profile[tuple(voxels.T)]
            length = edges[axis] * np.abs(value) / np.abs(value - profile[tuple(neighbours.T)])
            nearer = length < shortest[tuple(voxels.T)]
            index = tuple(voxels[nearer].T)
            shortest[index], normal[index] = length[nearer], 0
            normal[(*index, axis)] = np.where(value[nearer] > 0, -step, step)
    return shortest, normal
