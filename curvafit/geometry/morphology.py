"""The familiar numbers of a porous or branching structure: volume fraction, thickness, spacing, connectivity, surface.

Thickness and spacing are the mean diameters of the largest balls that fit (Hildebrand & Rüegsegger 1997): each voxel of
the phase takes the largest ball, centred in the phase and inside it, that covers the voxel. Balls come from the exact
Euclidean distance transform; a ball that sticks out of a larger painted one by less than half a voxel or 5 % of its
radius is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy import ndimage

from curvafit.core.schema import Rule
from curvafit.geometry.balls import border_distance, paint_balls, paint_coarse_balls
from curvafit.geometry.mesh import Surface, areas, march
from curvafit.geometry.topology import euler_number, euler_of_window

#: Voxels that the Gaussian reaches which smooths a mask's stairs.
SOFTENED = 3
#: The fraction of a mask's slope with which it continues beyond a window's faces. Windows of 16³ voxels of Gaussian
#: level sets then have the area of the whole to 0.5 %; without a slope 1.5 % less.
SLOPE = 0.6
#: How far a periodic box is continued before distances are taken, in voxels: at first, and where balls are wider.
_WRAPPED = (16, 32)

Length = Annotated[float, Rule(least=0, unknown=True)]


@dataclass(frozen=True)
class Morphometry:
    """Numbers in powers of `unit`; thickness and spacing are ball diameters, NaN where a phase is missing."""

    volume_fraction: Annotated[float, Rule(least=0, most=1, unknown=True)]
    thickness_mean: Length
    thickness_std: Length
    spacing_mean: Length
    connectivity_density: Annotated[float, Rule(unknown=True)]
    euler: int
    surface_to_volume: Length
    unit: str


def morphometry(
    mask: np.ndarray, spacing: float | tuple[float, float, float] = 1.0, unit: str = "voxel", *, periodic: bool = False
) -> Morphometry:
    """Measure volume fraction (BV/TV), thickness (Tb.Th), spacing (Tb.Sp), Euler number, connectivity density, BS/BV.

    The mask is bool (Z, Y, X), neither empty nor full (else ValueError); the spacing is voxel edges (z, y, x) in
    `unit`, or one for all. A box that is not periodic is a window: balls may reach out of it, its faces are no surface,
    and its Euler number is its share of the whole's (`topology.euler_of_window`).

    Of the result, `euler` is 26-connected, and a window's share rounded; `surface_to_volume` is the area by marching
    cubes (`border_weights`) over the structure's volume, in 1/unit; `connectivity_density` is (1 - χ) over the box's
    volume, or over that between the centres of a window's outer voxels, in 1/unit³.
    """
    mask = np.asarray(mask, dtype=bool)
    edges = (spacing, spacing, spacing) if isinstance(spacing, (int, float)) else spacing
    if mask.ndim != 3:
        raise ValueError(f"expected a 3D mask, got an array of shape {mask.shape}")
    filled = int(mask.sum())
    if filled in (0, mask.size):
        raise ValueError(f"expected a mask with voxels inside and outside, got {filled} of {mask.size} inside")
    voxel = math.prod(edges)
    thickness = local_thickness(mask, edges, periodic=periodic)[mask]
    gap = local_thickness(~mask, edges, periodic=periodic)[~mask]
    mesh = smooth_surface(mask, edges, periodic=periodic)
    weights = 1.0 if periodic else border_weights(mesh.barycentres / np.array(edges), mask.shape)
    euler, connectivity = measure_connectivity(mask, edges, periodic=periodic)
    return Morphometry(
        volume_fraction=filled / mask.size,
        thickness_mean=float(thickness.mean(dtype=np.float64)),
        thickness_std=float(thickness.std(dtype=np.float64)),
        spacing_mean=float(gap.mean(dtype=np.float64)),
        connectivity_density=connectivity,
        euler=round(euler),
        surface_to_volume=float((areas(mesh) * weights).sum()) / (filled * voxel),
        unit=unit,
    )


def measure_connectivity(
    mask: np.ndarray, spacing: tuple[float, float, float], *, periodic: bool = False
) -> tuple[float, float]:
    """Return χ and the connectivity density of a mask (see `morphometry`)."""
    euler = float(euler_number(mask, periodic=True)) if periodic else euler_of_window(mask)
    return euler, connectivity_density(euler, mask.shape, spacing, periodic=periodic)


def connectivity_density(euler: float, shape: Sequence[int], spacing: Sequence[float], *, periodic: bool) -> float:
    """Return 1 - χ over the volume of a box in which χ is counted (see `morphometry`)."""
    sampled = math.prod(shape if periodic else (max(n - 1, 1) for n in shape))
    return (1 - euler) / (sampled * math.prod(spacing))


def local_thickness(
    mask: np.ndarray,
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    periodic: bool = False,
    largest: float = 24.0,
) -> np.ndarray:
    """Return the diameter of the largest ball inside `mask` that covers each voxel: 0 outside, infinite in a full mask.

    The result is float32 (Z, Y, X), in spacing's unit. Diameters are 2·EDT, EDT being the distance to the nearest outer
    voxel's centre: half a voxel too much on plates (on average over their positions), up to a voxel too little on tubes
    and balls, whose axes miss the grid; for the same reason a ball covers voxels up to half a voxel beyond its rim.
    Where balls are wider than `largest` voxels in radius, all are painted on a grid coarser by a whole factor, with an
    error below 1/`largest` of their size. In a periodic box balls continue across its faces, up to 32 voxels in radius;
    in any other they may reach out of it.
    """
    mask = np.asarray(mask, dtype=bool)
    if not mask.any() or mask.all():
        return np.where(mask, np.float32(np.inf), np.float32(0))
    edge = float(min(spacing))
    for width in _WRAPPED if periodic else (0,):  # the second margin is tried where balls are wider than the first
        margin = [min(n // 2, width) for n in mask.shape]
        inner = tuple(slice(m, m + n) for m, n in zip(margin, mask.shape, strict=True))
        radius = border_distance(np.pad(mask, [(m, m) for m in margin], mode="wrap"), spacing)
        if radius[inner].max() < width * edge:
            break
    factor = math.ceil(float(radius[inner].max()) / edge / largest)
    if factor == 1:
        return 2 * paint_balls(radius[inner], spacing, periodic=periodic)
    return 2 * paint_coarse_balls(radius, spacing, factor)[inner]


def smooth_surface(mask: np.ndarray, spacing: tuple[float, float, float], *, periodic: bool = False) -> Surface:
    """Return the mask's surface by marching cubes after a Gaussian of 0.7 voxels, so that its stairs do not count.

    On balls and tubes the area is within 4 % at a radius of 5 voxels and 2 % at 9; less blur counts stairs, more
    shrinks what is small. Vertices are (z, y, x) from the first voxel's centre, in spacing's unit.
    """
    soft = soften(mask, periodic)
    if not soft.min() < 0.5 < soft.max():
        soft = mask.astype(np.float32)
    return march(np.pad(soft, (0, 1), mode="wrap") if periodic else soft, spacing, 0.5)


def soften(mask: np.ndarray, periodic: bool = False) -> np.ndarray:
    """Smooth a mask by the Gaussian of `smooth_surface`, which reaches `SOFTENED` voxels; return float32.

    Beyond a window's faces the mask continues with a fraction of its slope there (`SLOPE`): else the surface would meet
    the faces at right angles.
    """
    mask = mask.astype(np.float32)
    if periodic:
        return ndimage.gaussian_filter(mask, 0.7, mode="wrap")
    padded, inner = np.pad(mask, SOFTENED), tuple(slice(SOFTENED, SOFTENED + n) for n in mask.shape)
    low, high = slice(SOFTENED), slice(-SOFTENED, None)
    for axis in range(3):
        values, margins = np.moveaxis(mask, axis, 0), np.moveaxis(padded, axis, 0)
        for margin, end in ((low, values[: SOFTENED + 1]), (high, values[-SOFTENED - 1 :])):
            flat = np.pad(end, SOFTENED, "edge")[margin]
            sloped = np.pad(end, SOFTENED, "reflect", reflect_type="odd")[margin]
            margins[margin] = flat + SLOPE * (sloped - flat)
    return np.ascontiguousarray(ndimage.gaussian_filter(padded, 0.7)[inner])


def border_weights(positions: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the weights `(M,)` of triangles at positions `(M, 3)`, in voxels from the first centre of a window.

    A mesh ends at the centres of the outer voxels. Triangles between those and the next ones also stand for the half
    voxel beyond: so the area is that of all voxels, on average over windows.
    """
    weights = np.ones(len(positions))
    for position, n in zip(positions.T, shape, strict=True):
        weights *= 1 + 0.5 * (position < 1) + 0.5 * (position > n - 2)
    return weights
