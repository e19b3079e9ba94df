"""Descriptors of a window of a texture: blocks of numbers that are comparable for a phase field, a mask and a crop.

Nothing is assumed beyond a window that is not periodic. Means are taken over the window; lengths that its faces cut
short count as longer than their visible part (Kaplan & Meier 1958; for distances in a window Baddeley & Gill 1997), so
that the blocks of a crop estimate those of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from curvafit.core.checks import check_type
from curvafit.geometry.diagrams import diagram
from curvafit.geometry.distances import sliced_embedding
from curvafit.geometry.mesh import NoSurface, area_vectors, surface
from curvafit.geometry.topology import euler_shares
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field, signed_distance

#: Levels of the quantiles of lengths.
LEVELS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
#: Radii of the two-point function; the longest distance to the surface, and the longest chord, that count; in voxels.
RADII = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0)
DEPTH, LONGEST = 20.0, 40.0
#: Edge of the bins of curvature, in 1 / (100 voxels): binning moves an embedding by 0.06, seeds move it by 0.6 or more.
_CURVATURE_BIN = 0.5
#: Bins to a voxel in which distances to the surface are counted.
_FINE = 8


@dataclass(frozen=True, eq=False)
class Descriptors:
    """Blocks of float64 numbers, lengths in the grid's unit.

    Attributes
    ----------
    curvature
        `(288,)`: `sliced_embedding` of the geometric curvature diagram, 1 / length.
    fraction
        `(1,)`: part of the window inside.
    densities
        `(3,)`: area, integral of the mean curvature (κ1 + κ2) / 2, and Euler number of the inside, per volume.
    chords, gaps
        `(11,)` each: quantiles (`LEVELS`), up to 40 voxels, of the chords inside and outside, along all three axes.
    depths, clearances
        `(11,)` each: quantiles of the distance to the surface of the points inside and outside.
    correlation
        `(12,)`: two-point correlation at `RADII` voxels, over all directions: 1 at radius 0, 0 far away.
    fabric
        `(3,)`: eigenvalues of ∫ n⊗n dA / area (Minkowski tensor W₁⁰²), in decreasing order, a third each where the
        surface has no direction.
    """

    curvature: np.ndarray
    fraction: np.ndarray
    densities: np.ndarray
    chords: np.ndarray
    gaps: np.ndarray
    depths: np.ndarray
    clearances: np.ndarray
    correlation: np.ndarray
    fabric: np.ndarray

    def vector(self) -> np.ndarray:
        """Return all blocks, one after the other, `(351,)`."""
        return np.concatenate([getattr(self, name) for name in BLOCKS])


_NAMES = [field.name for field in fields(Descriptors)]
#: Lengths of the blocks, in their order.
BLOCKS = dict(zip(_NAMES, (288, 1, 3, *[len(LEVELS)] * 4, len(RADII), 3), strict=True))


def descriptors(shape: np.ndarray | Tensor, grid: Grid, epsilon: float = WORKING_EPSILON) -> Descriptors:
    """Measure a phase field `(Z, Y, X)`, positive inside, or a bool mask, whose phase field is made as by `infer`.

    Voxels are cubic, and ε is in the grid's unit. Where the grid is not periodic, the shape is a window of something
    larger. Raises ValueError if voxels are not cubic, and `NoSurface`, one too, if there is no surface whose curvature
    the grid resolves.
    """
    check_type(grid, Grid, "a Grid")
    check_type(shape, (np.ndarray, Tensor), f"a field or a mask of shape {grid.shape}")
    voxel = grid.spacing[0]
    if max(grid.spacing) > (1 + 1e-6) * min(grid.spacing):
        raise ValueError(f"expected cubic voxels, got {grid.spacing}")
    values = torch.as_tensor(shape)
    inside = values if values.dtype == torch.bool else values > 0
    mask = inside.numpy(force=True)
    if mask.all() or not mask.any():
        raise NoSurface("expected a shape with an inside and an outside, got one of them only")
    phase = phase_field(inside, grid, epsilon) if values.dtype == torch.bool else values
    measured = diagram(phase, grid, epsilon)
    mesh = surface(phase, grid)
    normals = area_vectors(mesh)
    area = np.linalg.norm(normals, axis=1)
    valid = area > 0
    tensor = (normals[valid] / area[valid, None]).T @ normals[valid] / area.sum()
    # The volume of the cells of marching cubes; those of a window lie between its outermost voxels' centres.
    cells = grid.volume if grid.periodic else grid.voxel_volume * float(np.prod([n - 1 for n in grid.shape]))
    density, euler = area.sum() / cells, int(euler_shares(mask, periodic=grid.periodic).sum(dtype=np.int64))
    chords, gaps = (voxel * _chord_quantiles(phase, grid.periodic) for phase in (mask, ~mask))
    depths, clearances = (voxel * quantiles for quantiles in _depth_quantiles(inside, grid))
    return Descriptors(
        curvature=sliced_embedding(measured.bin(_CURVATURE_BIN / (100 * voxel))),
        fraction=np.array([mask.mean()]),
        densities=np.array([density, density * measured.mean().mean(), euler / cells]),
        chords=chords,
        gaps=gaps,
        depths=depths,
        clearances=clearances,
        correlation=_correlation(mask, grid.periodic),
        fabric=np.linalg.eigvalsh(tensor)[::-1],
    )


def _chord_quantiles(phase: np.ndarray, periodic: bool) -> np.ndarray:
    """Return quantiles, in voxels and at most `LONGEST`, of the lengths of the runs of a phase along the three axes."""
    # In a window a run counts once for each end that is visible: with its length where both are, else as longer than
    # its visible part.
    longest = max(phase.shape)
    events, runs = np.zeros((2, longest + 1))
    for axis in range(3):
        lines = np.moveaxis(phase, axis, -1).reshape(-1, phase.shape[axis])
        for ordered in (lines,) if periodic else (lines, lines[:, ::-1]):
            lengths, complete = _find_runs(ordered, periodic)
            events += np.bincount(lengths[complete], minlength=longest + 1)
            runs += np.bincount(lengths, minlength=longest + 1)
    quantiles = np.interp(LEVELS, _estimate_shares(events, runs), np.arange(longest + 1) + 0.5)
    return np.minimum(quantiles, LONGEST)


def _find_runs(lines: np.ndarray, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths of the runs of True that begin within lines `(N, n)`, and whether their ends are visible."""
    n = lines.shape[1]
    begins = lines & ~np.roll(lines, 1, axis=1)
    if periodic:  # a run may continue into the next period
        lines = np.concatenate([lines, lines], axis=1)
    else:
        begins[:, 0] = False
    ends = np.where(lines, lines.shape[1], np.arange(lines.shape[1], dtype=np.int32))
    next_end = np.minimum.accumulate(ends[:, ::-1], axis=1)[:, ::-1]  # the first False at or after each voxel
    rows, starts = np.nonzero(begins)
    stops = next_end[rows, starts]
    return stops - starts, np.full(len(starts), True) if periodic else stops < n


def _depth_quantiles(inside: Tensor, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return quantiles, in voxels, of the distances of the voxels inside, and outside, to the surface."""
    # A distance beyond `DEPTH`, or beyond the window's nearest face, counts as longer than that. Quantiles are read at
    # whole voxels, since distances between voxels come in steps.
    voxels = Grid(grid.shape, (1.0, 1.0, 1.0), grid.boundary)
    distance = signed_distance(inside, voxels, limit=DEPTH + 1).numpy(force=True)
    limit = np.full(grid.shape, DEPTH) if grid.periodic else _distance_to_faces(grid.shape)
    lengths = np.arange(1, int(DEPTH) + 2)
    quantiles = []
    for phase in (distance > 0, distance < 0):
        depths, limits = np.abs(distance[phase]), limit[phase]
        bins = (_FINE * np.minimum(depths, limits)).astype(int)
        events, counts = (np.bincount(b, minlength=_FINE * len(lengths)) for b in (bins[depths <= limits], bins))
        quantiles.append(np.interp(LEVELS, _estimate_shares(events, counts)[_FINE - 1 :: _FINE], lengths))
    return quantiles[0], quantiles[1]


@lru_cache(maxsize=4)
def _distance_to_faces(shape: tuple[int, int, int]) -> np.ndarray:
    axes = np.ix_(*(np.minimum(np.arange(n), np.arange(n)[::-1]) + 0.5 for n in shape))
    return np.minimum(np.minimum.reduce(np.broadcast_arrays(*axes)), DEPTH)


def _estimate_shares(events: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the share of lengths up to each bin (Kaplan & Meier): of `counts` in the bins, `events` are complete."""
    at_risk = np.cumsum(counts[::-1])[::-1]
    return 1 - np.cumprod(1 - events / np.maximum(at_risk, 1))


def _correlation(mask: np.ndarray, periodic: bool) -> np.ndarray:
    """Return the correlation of a mask at `RADII`: its autocovariance over its variance, averaged over directions."""
    fraction = mask.mean()
    size: tuple[int, ...] = mask.shape
    if not periodic:  # zeros around the window keep its opposite faces apart
        size = tuple(next_fast_len(n + int(RADII[-1]) + 2, True) or n for n in mask.shape)
    spectrum = np.fft.rfftn(mask - fraction, size, (0, 1, 2))
    products = np.fft.irfftn(np.abs(spectrum) ** 2, size, (0, 1, 2))
    pairs = mask.size if periodic else _window_pairs(mask.shape, size)
    shells, counts, radii = _shells(size)
    means = np.bincount(shells, (products / pairs).ravel())[: len(radii)] / counts
    return np.interp(RADII, radii, means / (fraction * (1 - fraction)))


@lru_cache(maxsize=4)
def _window_pairs(shape: tuple[int, ...], size: tuple[int, ...]) -> np.ndarray:
    """Return the number of pairs of a window's voxels for each offset of a Fourier transform of a size."""
    axes = [np.maximum(n - np.minimum(np.arange(s), s - np.arange(s)), 1) for n, s in zip(shape, size, strict=True)]
    return axes[0][:, None, None] * axes[1][:, None] * axes[2]


@lru_cache(maxsize=4)
def _shells(size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the index of each offset's shell, a voxel wide, and the counts and mean radii of shells up to `RADII`."""
    axes = [np.minimum(np.arange(s), s - np.arange(s)) for s in size]
    distance = np.sqrt(axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2.0).ravel()
    shells = np.rint(distance).astype(int)
    counts = np.bincount(shells)
    radii = np.bincount(shells, distance) / counts
    last = int(RADII[-1]) + 2
    return shells, counts[:last], radii[:last]
