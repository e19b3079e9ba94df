"""Pieces, tunnels and cavities of a mask, in a box that is a window or periodic."""

from __future__ import annotations

from itertools import chain, combinations, product

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from skimage import measure

#: Whether a part of a window begins, and ends, with it, along z, y and x.
Ends = tuple[tuple[bool, bool], ...]


def components(mask: np.ndarray, *, periodic: bool = False, connectivity: int = 26) -> tuple[np.ndarray, int]:
    """Return the connected pieces as labels, int32 (Z, Y, X), 0 outside and 1, 2, … in the pieces, and their count.

    Voxels touch by corners (`connectivity` 26) or by faces (6); in a periodic box also across its faces.
    """
    labels, count = _label_pieces(mask, corners=connectivity == 26)
    if periodic and count:
        pairs = _find_seams(labels, connectivity == 26)[:, :2] - 1
        merged = connected_components(_graph(pairs, count), directed=False)[1]
        labels = number_pieces(np.concatenate([[0], merged + 1])[labels])
        count = int(labels.max())
    return labels, count


def number_pieces(labels: np.ndarray) -> np.ndarray:
    """Renumber pieces 1, 2, … in the order of their first voxels, int32; 0 stays."""
    first_voxels = np.full(labels.max() + 1, labels.size)
    np.minimum.at(first_voxels, labels.ravel(), np.arange(labels.size))
    first_voxels[0] = -1
    return np.argsort(np.argsort(first_voxels)).astype(np.int32)[labels]


def euler_number(mask: np.ndarray, *, periodic: bool = False) -> int:
    """Return χ of the union of the closed voxels (26-connected); a periodic box's is that on the torus."""
    if not periodic:
        return int(measure.euler_number(mask, connectivity=3))
    return int(euler_shares(mask, periodic=True).sum(dtype=np.int64))


def euler_shares(mask: np.ndarray, *, periodic: bool = False) -> np.ndarray:
    """Return what each voxel adds to χ of the union of the closed voxels (26-connected), int8 of the mask's shape.

    In three dimensions a voxel counts itself (-1) and those of its low faces (1 each), low edges (-1 each) and low
    corner (1) that belong to the union. In a window the first layers count nothing: their neighbours are unknown. Sums
    over boxes are shares of χ.
    """
    total = np.zeros(mask.shape, dtype=np.int8)
    for axes in chain.from_iterable(combinations(range(mask.ndim), k) for k in range(mask.ndim + 1)):
        cells = mask  # voxels, or their low faces, edges or corners across `axes`
        for axis in axes:
            cells = cells | np.roll(cells, 1, axis)
        total += ((-1) ** (mask.ndim - len(axes)) * cells.astype(np.int8)).astype(np.int8)
    if not periodic:
        for axis in range(mask.ndim):
            total[(slice(None),) * axis + (0,)] = 0
    return total


def euler_of_window(mask: np.ndarray, ends: Ends = ((True, True),) * 3) -> float:
    """Return what a window of a larger structure adds to χ, on average over windows.

    From χ of the structure in the window, half of χ of each outer layer is subtracted, a quarter of that of each outer
    row added, and an eighth of each corner subtracted (Odgaard & Gundersen 1993; BoneJ's Δχ). On average a window of n
    voxels a side then has the share of (n - 1)³ voxels, and a structure that touches no face has its own χ.

    For a box of a window, `ends` say along which axes it begins, and ends, with the window; where it does not begin
    with it, its first layer belongs to the box before. The sum over boxes is the window's.
    """
    padded, total = np.pad(mask, [(int(first), int(last)) for first, last in ends]), 0.0
    for layers in product((None, 0, 1), repeat=3):
        if all(layer is None or end[layer] for layer, end in zip(layers, ends, strict=True)):
            # All of an axis, or its first or last layer, which are at 1 and -2 after padding.
            outer = padded[tuple({None: slice(None), 0: 1, 1: -2}[layer] for layer in layers)]
            total += (-0.5) ** (3 - outer.ndim) * int(euler_shares(outer).sum(dtype=np.int64))
    return total


def betti_numbers(mask: np.ndarray, *, periodic: bool = False) -> tuple[int, int, int]:
    """Return b0 pieces (26-connected), b1 tunnels, b2 cavities (6-connected).

    Beyond a box that is not periodic all is outside: a hollow that opens to a face is no cavity. A periodic box is a
    torus: a tube that goes around it is a tunnel, and b2 = (pieces of the outside) - 1 + 3 - (directions in which the
    outside goes around), by Alexander duality. b1 = b0 + b2 - χ.
    """
    inside = np.asarray(mask, dtype=bool)
    if not inside.any():
        return 0, 0, 0
    if periodic and inside.all():
        return 1, 3, 3
    pieces = components(inside, periodic=periodic)[1]
    if periodic:
        cavities = components(~inside, periodic=True, connectivity=6)[1] - 1 + 3 - _count_directions(~inside)
    else:
        cavities = components(~np.pad(inside, 1), connectivity=6)[1] - 1
    return pieces, pieces + cavities - euler_number(inside, periodic=periodic), cavities


def _label_pieces(mask: np.ndarray, corners: bool) -> tuple[np.ndarray, int]:
    """Return the pieces within the box, and how many."""
    labels = np.empty(mask.shape, dtype=np.int32)
    ndimage.label(mask, ndimage.generate_binary_structure(3, 3 if corners else 1), output=labels)
    return labels, int(labels.max(initial=0))


def _find_seams(labels: np.ndarray, corners: bool) -> np.ndarray:
    """Return which labels touch across the faces of a periodic box: unique rows (last layer's, first layer's, axis)."""
    rows = [np.empty((0, 3), dtype=np.int64)]
    for axis in range(3):
        last, first = np.take(labels, -1, axis), np.take(labels, 0, axis)
        for shift in product((-1, 0, 1), repeat=2) if corners else [(0, 0)]:
            moved = np.roll(first, shift, (0, 1))
            touch = (last > 0) & (moved > 0)
            pairs = np.unique(np.stack([last[touch], moved[touch]], axis=1), axis=0)
            rows.append(np.insert(pairs, 2, axis, axis=1))
    return np.unique(np.concatenate(rows), axis=0).astype(np.int64)


def _graph(pairs: np.ndarray, count: int) -> coo_array:
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def _count_directions(mask: np.ndarray) -> int:
    """Return the number of independent directions in which a 6-connected phase goes around the torus."""
    # Seams of a spanning tree put each piece within the box into a period (z, y, x); a seam that disagrees is a loop.
    labels, count = _label_pieces(mask, corners=False)
    seams = _find_seams(labels, False)
    low, high, steps = seams[:, 0] - 1, seams[:, 1] - 1, np.eye(3, dtype=np.int64)[seams[:, 2]]
    graph = _graph(seams[:, :2] - 1, count).tocsr()
    step_between = {}
    for i, j, step in zip(low, high, steps, strict=True):
        step_between[i, j], step_between[j, i] = step, -step
    periods, visited = np.zeros((count, 3), dtype=np.int64), np.zeros(count, dtype=bool)
    for root in range(count):
        if not visited[root]:
            order, parents = breadth_first_order(graph, root, directed=False)
            visited[order] = True
            for node in order[1:]:
                periods[node] = periods[parents[node]] + step_between[parents[node], node]
    loops = periods[low] + steps - periods[high]
    return int(np.linalg.matrix_rank(loops)) if len(loops) else 0
