"""Closed triangle meshes (STL, PLY, OBJ, OFF), read with trimesh of the extra `[io]`, as masks of what they enclose."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numba import njit

from curvafit.core.checks import require
from curvafit.core.runtime import memory
from curvafit.core.units import convert_length, is_unit
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import LPS_TO_RAS, ScanError, Stated
from curvafit.volumes.volume import positive_triple

SUFFIXES = (".stl", ".ply", ".obj", ".off")
#: Voxels along the longest side of a mesh where no edge is given, and the share of that side that is background around
#: the mesh: next to a volume's faces there is no curvature.
DIVISIONS, AROUND = 128, 0.25
#: The remark of `geometry.mesh.write_surface`; 3D Slicer's says where x and y point. Bytes in which both stand.
_OWN = re.compile(r"curvafit surface, lengths in (\w+)(?:, (\d+) x (\d+) x (\d+) voxels of ([\d.e+-]+))?")
_SLICER, _REMARKS = "SPACE=LPS", 1000
#: Bytes that a voxel takes while it is made.
_VOXEL = 4


def read_mesh(
    path: Path, *, spacing: Sequence[float] | float | None = None, unit: str | None = None, **_: object
) -> Stated:
    """Read the voxels whose centres a mesh winds round, as a mask; where bodies overlap, it is their union.

    Voxels have the edges `spacing`, or else those that a surface of `generate` states, or there are `DIVISIONS` along
    the longest side. No other mesh states a unit.
    """
    triangles = _read_triangles(path)
    coherent = _check_closed(triangles, path)
    with path.open("rb") as file:
        remark = file.read(_REMARKS).decode("latin-1")
    own = _OWN.search(remark)
    own_unit = None if own is None else own[1]
    box, edge, notes = _choose_box(triangles, own)
    edges, in_voxels = np.full(3, edge), unit is None and own_unit is None  # as in all files without a unit
    if spacing is not None:
        edges, in_voxels, notes = _convert_edges(spacing, unit, own_unit), False, notes[:1]
    if not coherent:
        notes += ("Its triangles face both ways: a voxel is inside where an odd number of them lie to one side of it.",)
    mask, first = _fill(triangles, box, edges, coherent, path)
    affine = base.affine_of(np.diag(edges[::-1]), first[::-1])
    affine[:3] /= edge if in_voxels else 1.0
    affine = LPS_TO_RAS @ affine if _SLICER in remark else affine
    return Stated(mask, "zyx", None if in_voxels else edges.tolist(), (own_unit,) * 3, None, affine, notes=notes)


def _read_triangles(path: Path) -> np.ndarray:
    """Return the corners (F, 3, 3) of a mesh's triangles, each z, y, x, one copy for each triangle."""
    trimesh = require("trimesh", "io", "reading meshes")
    try:
        triangles = trimesh.load_mesh(path, process=False, skip_materials=True).triangles
    except ImportError as reason:  # of a package that guesses at the encoding of what is no UTF-8
        raise base.Damaged("it is neither text nor binary as its header says") from reason
    if not triangles.size or not 0 < np.ptp(triangles) < math.inf:
        raise base.Damaged("it has no triangles, or corners that are no numbers")
    return np.asarray(triangles, np.float64)[..., ::-1]


def _check_closed(triangles: np.ndarray, path: Path) -> bool:
    """Return whether each edge of a mesh is passed as often one way as the other, so that triangles (F, 3, 3) all face
    outwards, or all inwards; raise ScanError where one belongs to an odd number of them."""
    points = triangles.reshape(-1, 3)
    order = np.lexsort(points.T)
    corners = np.zeros(len(points), np.int64)  # of points in one place the number is one
    corners[order[1:]] = np.cumsum((np.diff(points[order], axis=0) != 0).any(axis=1))
    ends = corners.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    way = np.sign(ends[:, 1] - ends[:, 0])
    edges, index = np.unique(ends.min(1) * len(points) + ends.max(1), return_inverse=True)
    if open_edges := np.count_nonzero(np.bincount(index, np.abs(way)) % 2):
        holes = f"{open_edges} of its {len(edges)} edges are the border of a hole"
        raise ScanError(f"{path} is no closed surface: {holes}, which a program for meshes can close")
    return not np.bincount(index, way).any()


def _choose_box(triangles: np.ndarray, own: re.Match[str] | None) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Return the box (2, 3) of a mesh's volume, and the edge of its voxels where none is given; and a note on each.

    A surface of `generate` states both: its caps lie in the faces of the box, and are no surface there.
    """
    ends = np.stack([triangles.min((0, 1)), triangles.max((0, 1))])
    if own is not None and own[5]:
        edge = float(own[5])
        box = edge * (np.array([[0, 0, 0], own.groups()[1:4]], np.float64) - 0.5)
        if np.abs(np.clip(ends, *box) - ends).max() < edge / 100:
            return box, edge, ()
    side = float(np.ptp(ends, axis=0).max())
    edge = float(f"{side / DIVISIONS:.3g}")
    note = f"A mesh: its inside is the structure, and BV/TV that of a box {AROUND:g} of its longest side around it."
    size = f"A voxel is {edge:g} of the mesh's lengths, 1/{DIVISIONS} of its longest side: --spacing sets it."
    return ends + AROUND * side * np.array([[-1], [1]]), edge, (note, size)


def _convert_edges(spacing: Sequence[float] | float, unit: str | None, own_unit: str | None) -> np.ndarray:
    """Return voxel edges (z, y, x) in the unit that a mesh names; where it names none, lengths are in the caller's."""
    converts = unit is not None and own_unit is not None and is_unit(unit) and "voxel" not in (unit, own_unit)
    return np.array(positive_triple(spacing)) * (convert_length(1.0, unit, own_unit) if converts else 1.0)


def _fill(
    triangles: np.ndarray, box: np.ndarray, edges: np.ndarray, coherent: bool, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask (Z, Y, X) of the voxels inside a mesh, and the first voxel's centre, of voxels that fill a box.

    Along each row of voxels in x, the triangles that it passes are counted: +1 or -1 by the way they face. Each edge
    is crossed, or is not, in the same way for all its triangles, so that no row leaks.
    """
    shape = np.rint(np.diff(box, axis=0)[0] / edges)
    if shape.min() < 2:
        raise ScanError(f"{path} is no more than a voxel wide: give a smaller --spacing")
    if _VOXEL * (size := math.prod(shape.tolist())) > memory():
        raise ScanError(f"{path} takes {size:.3g} voxels, which do not fit into memory: give a larger --spacing")
    first = edges * np.round(box.mean(0) / edges - (shape - 1) / 2, 6)
    turns = np.zeros(shape.astype(np.int64), np.int16)
    _count_crossings((triangles - first) / edges, turns)
    np.cumsum(turns, axis=2, dtype=np.int16, out=turns)
    return ((turns if coherent else turns % 2) != 0).view(np.uint8), first


@njit(cache=True, nogil=True)
def _count_crossings(triangles, turns):  # pragma: no cover
    """Add +1 or -1 at the first voxel of each row behind each of the triangles (F, 3, 3) that the row passes.

    At a plane z an edge counts if one end is above z and the other is not; then y runs from one of the triangle's two
    points in the plane to the other, the first included.
    """
    planes, rows, columns = turns.shape
    y, x = np.empty(2), np.empty(2)
    for k in range(len(triangles)):
        corners = triangles[k]
        heights = corners[:, 0]
        for plane in range(max(math.ceil(heights.min()), 0), min(math.ceil(heights.max()), planes)):
            for a in range(3):
                b = (a + 1) % 3
                rises = heights[a] <= plane
                if rises != (heights[b] <= plane):
                    low, high = (a, b) if rises else (b, a)  # the same numbers, whichever way the edge is passed
                    share = (plane - heights[low]) / (heights[high] - heights[low])
                    side = 0 if rises else 1
                    y[side] = corners[low, 1] + share * (corners[high, 1] - corners[low, 1])
                    x[side] = corners[low, 2] + share * (corners[high, 2] - corners[low, 2])
            way = 1 if y[0] < y[1] else -1
            for row in range(max(math.ceil(y.min()), 0), min(math.ceil(y.max()), rows)):
                behind = math.ceil(x[0] + (row - y[0]) / (y[1] - y[0]) * (x[1] - x[0]))
                if behind < columns:
                    turns[plane, row, max(behind, 0)] += way
