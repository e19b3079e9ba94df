"""The curvature diagram of a prepared scan, of a large one piece by piece, and its descriptors."""

from __future__ import annotations

import contextlib
import itertools
import math

import numpy as np
from scipy import ndimage

from curvafit.geometry.descriptors import Descriptors, descriptors
from curvafit.geometry.diagram import MARGIN, Diagram, SurfaceCurvatures, surface_curvatures
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.stationarity import is_rounded
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.scan.prepare import LARGEST_WINDOW, Prepared

#: Least edge, in working voxels, of a cube whose descriptors are measured.
SMALLEST_CUBE = 24


def scan_diagram(prepared: Prepared) -> Diagram:
    """Return the geometric curvature diagram of a prepared scan."""
    curvatures = scan_curvatures(prepared)
    return Diagram(curvatures.points, curvatures.areas, excluded=curvatures.excluded)


def scan_curvatures(prepared: Prepared) -> SurfaceCurvatures:
    """Return the geometric curvatures of a prepared scan's surface; of a large one tile by tile, each cell in one tile.

    Centres are in working units from the centre of the grid's first voxel.
    """
    grid = prepared.grid
    cuts = [[slice(None)] if grid.periodic else _tiles(n) for n in grid.shape]
    parts: list[SurfaceCurvatures] = []
    for tile in itertools.product(*cuts):
        with contextlib.suppress(NoSurface):
            parts.append(_tile_curvatures(prepared, tile))
    if not parts:
        raise ValueError("expected a surface inside the scan, got none away from its borders")
    centres, points, areas = (np.concatenate(each) for each in zip(*(part[:3] for part in parts), strict=True))
    lost = sum(part.excluded * float(part.areas.sum()) for part in parts) / areas.sum()
    return SurfaceCurvatures(centres, points, areas, float(lost))


def _tiles(n: int) -> list[slice]:
    """Return stretches of at most a window's length; their interiors (`MARGIN` voxels in) share end planes alone."""
    count = math.ceil((n - 2 * MARGIN) / (LARGEST_WINDOW - 2 * MARGIN))
    ends = np.linspace(MARGIN, n - 1 - MARGIN, count + 1).astype(int)
    return [slice(a - MARGIN, b + MARGIN + 1) for a, b in itertools.pairwise(ends)]


def _tile_curvatures(prepared: Prepared, tile: tuple[slice, ...]) -> SurfaceCurvatures:
    phase = np.ascontiguousarray(prepared.phase[tile])
    z, y, x = phase.shape
    grid = Grid((z, y, x), prepared.grid.spacing, prepared.grid.boundary)
    where = None if prepared.roi is None else ndimage.binary_erosion(prepared.roi, iterations=MARGIN)[tile]
    found = surface_curvatures(phase, grid, WORKING_EPSILON, where=where)
    corner = np.array([edge.start or 0 for edge in tile]) * np.array(grid.spacing)
    return found._replace(centres=found.centres + corner)


def scan_descriptors(prepared: Prepared) -> tuple[Descriptors, str] | None:
    """Measure a scan's descriptors, and name the kind of view that it is (`inference.views`).

    They are those of the main window, or of the largest cube within the region of interest. None where that cube is
    smaller than `SMALLEST_CUBE` voxels, or shows no surface.
    """
    where = prepared.windows[0] if prepared.roi is None else _largest_cube(prepared.roi)
    if where is None:
        return None
    mask, grid = np.ascontiguousarray(prepared.mask[where]), prepared.part(where)
    view = _view(prepared, grid)
    try:
        return descriptors(prepared.phase if view == "field" else mask, grid), view
    except NoSurface:
        return None


def _view(prepared: Prepared, grid: Grid) -> str:
    """Return what a posterior takes a window for: a field of a part is read as its mask is, a clean image as a mask."""
    if prepared.imaging is not None and prepared.imaging.degraded:
        return "scan"
    if grid.periodic:
        return "field" if prepared.kind == "field" and not is_rounded(prepared.phase) else "mask"
    return "crop" if prepared.scale == (1.0, 1.0, 1.0) else "resampled"


def _largest_cube(region: np.ndarray) -> tuple[slice, slice, slice] | None:
    """Return the largest cube within a region, of at most a window's edge; None where it is too small."""
    inside = np.asarray(ndimage.distance_transform_cdt(np.pad(region, 1), metric="chessboard"))[1:-1, 1:-1, 1:-1]
    reach = min(int(inside.max()), LARGEST_WINDOW // 2) - 1
    if 2 * reach + 1 < SMALLEST_CUBE:
        return None
    z, y, x = (int(i) for i in np.unravel_index(int(inside.argmax()), inside.shape))
    return slice(z - reach, z + reach + 1), slice(y - reach, y + reach + 1), slice(x - reach, x + reach + 1)
