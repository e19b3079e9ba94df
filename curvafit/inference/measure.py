"""The curvature diagram of a prepared scan, of a large one piece by piece."""

from __future__ import annotations

import contextlib
import itertools
import math

import numpy as np
from scipy import ndimage

from curvafit.geometry.diagram import MARGIN, Diagram, diagram
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.prepare import LARGEST_WINDOW, Prepared
from curvafit.priors.grid import WORKING_EPSILON, Grid


def scan_diagram(prepared: Prepared) -> Diagram:
    """Return the geometric curvature diagram of a prepared scan; of a large one tile by tile, each cell in one tile."""
    grid = prepared.grid
    cuts = [[slice(None)] if grid.periodic else _tiles(n) for n in grid.shape]
    parts: list[Diagram] = []
    for tile in itertools.product(*cuts):
        with contextlib.suppress(NoSurface):
            parts.append(_tile_diagram(prepared, tile))
    if not parts:
        raise ValueError("expected a surface inside the scan, got none away from its borders")
    points, weights = (np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "weights"))
    lost = sum(part.excluded * part.area for part in parts) / weights.sum()
    return Diagram(points, weights, excluded=float(lost))


def _tiles(n: int) -> list[slice]:
    """Return stretches of at most a window's length; their interiors (`MARGIN` voxels in) share end planes alone."""
    count = math.ceil((n - 2 * MARGIN) / (LARGEST_WINDOW - 2 * MARGIN))
    ends = np.linspace(MARGIN, n - 1 - MARGIN, count + 1).astype(int)
    return [slice(a - MARGIN, b + MARGIN + 1) for a, b in itertools.pairwise(ends)]


def _tile_diagram(prepared: Prepared, tile: tuple[slice, ...]) -> Diagram:
    phase = np.ascontiguousarray(prepared.phase[tile])
    z, y, x = phase.shape
    grid = Grid((z, y, x), prepared.grid.spacing, prepared.grid.boundary)
    where = None if prepared.roi is None else ndimage.binary_erosion(prepared.roi, iterations=MARGIN)[tile]
    return diagram(phase, grid, WORKING_EPSILON, where=where)
