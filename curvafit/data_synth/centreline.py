"""Curve skeletons that keep a mask's topology, and graphs of the skeletons of crops, with radii."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.morphology import skeletonize

from curvafit.core.checks import require
from curvafit.core.files import write_atomically
from curvafit.geometry.topology import betti_numbers
from curvafit.priors.grid import Grid

if TYPE_CHECKING:
    import networkx as nx

#: A spur is shorter than a voxel and so many radii of its other node.
SPUR = 1.0
#: Voxels of a 3×3×3 block have numbers along x, y, z, and sets of them are bits: `FACES` and `EIGHTEEN` are the 6 and
#: the 18 nearest to the middle; `CORNERS[k]` touch voxel k by a corner at least, `SIDES[k]` by a face within the 18.
MIDDLE = 13
_PLACES = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), 1)
_STEPS, _BITS = np.abs(_PLACES[:, None] - _PLACES), 1 << np.arange(27)
FACES = int((_STEPS[MIDDLE].sum(1) == 1) @ _BITS)
EIGHTEEN = int(((_STEPS[MIDDLE].sum(1) > 0) & (_STEPS[MIDDLE].sum(1) < 3)) @ _BITS)
CORNERS = ((_STEPS.max(2) == 1) @ _BITS) & ~(1 << MIDDLE)
SIDES = ((_STEPS.sum(2) == 1) @ _BITS) & EIGHTEEN


def skeleton_of(distance: np.ndarray, grid: Grid) -> np.ndarray:
    """Return one-voxel wide curves in the middle of {distance > 0}, bool (Z, Y, X), with the mask's topology.

    The distance (Z, Y, X) is positive inside, as `labels.field_distance` gives it. The curves have as many pieces,
    tunnels and cavities as the mask; a cavity keeps a closed sheet around it. Curves run up to the faces of a crop, and
    across those of a periodic box.
    """
    # Lee's thinning of the box, continued beyond its faces, finds the curves. They may be connected outside the box
    # alone, so the mask itself is thinned around those curves, and then once more.
    mask = distance > 0
    width = math.ceil(float(distance.max()) / min(grid.spacing)) + 2
    margin = [(min(n // 2, width),) * 2 for n in mask.shape]
    padded = np.pad(mask, margin, mode="wrap" if grid.periodic else "edge")
    inner = tuple(slice(m, m + n) for (m, _), n in zip(margin, mask.shape, strict=True))
    lines = skeletonize(padded)[inner].astype(bool)
    order = np.flatnonzero(mask)
    order = order[np.argsort(distance.ravel()[order], kind="stable")]
    skeleton = mask.astype(np.uint8)
    _thin(skeleton, lines & mask, order.copy(), grid.periodic)
    _thin(skeleton, np.zeros_like(mask), order[skeleton.ravel()[order] > 0], grid.periodic)
    return skeleton.astype(bool)


@njit(cache=True)
def _thin(mask, fixed, order, periodic):  # pragma: no cover
    """Delete simple voxels from the mask, in the given order, until none is left; `fixed` voxels and ends stay."""
    nz, ny, nx = mask.shape
    changed = True
    while changed:
        changed, kept = False, 0
        for i in order:
            z, y, x = i // (ny * nx), i // nx % ny, i % nx
            if fixed[z, y, x]:
                continue
            around, count = 0, 0
            for k in range(27):
                a, b, c = z + k // 9 - 1, y + k // 3 % 3 - 1, x + k % 3 - 1
                if a < 0 or b < 0 or c < 0 or a >= nz or b >= ny or c >= nx:
                    if not periodic:
                        continue
                    a, b, c = a % nz, b % ny, c % nx
                if k != MIDDLE and mask[a, b, c]:
                    around |= 1 << k
                    count += 1
            if count > 1 and _is_simple(around):
                mask[z, y, x] = 0
                changed = True
            else:
                order[kept] = i
                kept += 1
        order = order[:kept]


@njit(cache=True)
def _is_simple(around):  # pragma: no cover
    """Return whether deleting the middle of 3×3×3 voxels keeps the topology; `around` are the mask's other voxels."""
    # This is a simple point (Bertrand and Malandain 1994): the mask around it is one 26-connected piece, and the
    # outside voxels that touch the middle by a face are in one 6-connected piece of the 18 nearest.
    outside = ~around & EIGHTEEN
    one_outside = outside & FACES != 0 and _is_connected(outside, outside & FACES, SIDES)
    return one_outside and _is_connected(around, around, CORNERS)


@njit(cache=True)
def _is_connected(bits, wanted, touching):  # pragma: no cover
    """Return whether all `wanted` bits are in one piece of `bits`, where `touching[k]` are the neighbours of bit k."""
    piece, larger = 0, wanted & -wanted
    while larger != piece:
        piece = larger
        for k in range(27):
            if piece >> k & 1:
                larger |= touching[k] & bits
    return wanted & ~piece == 0


def centreline(skeleton: np.ndarray, distance: np.ndarray, spacing: Sequence[float]) -> nx.MultiGraph:
    """Return the graph of a crop's skeleton of one-voxel wide lines (26 neighbours), with radii.

    Voxels with three or more neighbours are junctions, and those that touch are one, at their mean; voxels with one
    neighbour are ends. Lines are smoothed, since steps between voxels would make tilted ones up to a tenth too long,
    and moved across themselves to the greatest distance. Spurs, free lines that hardly leave the ball around their
    other node (`SPUR`), are removed, shortest first, and two lines that remain at a junction become one. Cycles stay.

    The skeleton, bool (Z, Y, X), is that of `skeleton_of` for a crop; the distance (Z, Y, X) is positive inside; the
    spacing is the edges of a voxel (z, y, x).

    Nodes 0, 1, … have `position` (z, y, x), `radius`, `kind` ("end", "junction", "point" without edges, "loop" of a
    line that closes on itself) and `rings`, the number of tunnels within a junction, nearly always 0. Edges have
    `points` (N, 3) from the lesser node to the greater and `radii` (N,), both with the nodes' own, `length` and mean
    `radius`. Lengths are in spacing's unit; the first voxel's centre is the origin.
    """
    if skeleton.shape != distance.shape:
        raise ValueError(f"skeleton and distance must have one shape, got {skeleton.shape} and {distance.shape}")
    steps = np.asarray(spacing, dtype=float)
    graph = _trace(np.asarray(skeleton, dtype=bool), distance)
    for node in list(graph):
        _dissolve(graph, node)
    _prune(graph, steps)
    for _ in range(2):
        _move_to_axis(graph, distance, steps)
    _finish(graph, distance, steps)
    return require("networkx", "synth", "a centreline").convert_node_labels_to_integers(graph, ordering="sorted")


def write_graphml(graph: nx.MultiGraph, path: str | Path, unit: str = "voxel") -> Path:
    """Write a `centreline` as GraphML, with its `unit` of length.

    Nodes have `z`, `y`, `x`, `radius`, `kind` and `rings`; edges `length`, `radius`, and as texts `points` ("z y x",
    with commas between points) and `radii`.
    """
    nx = require("networkx", "synth", "a centreline")
    plain = nx.MultiGraph(unit=unit)
    for node, of in graph.nodes(data=True):
        z, y, x = map(float, of["position"])
        plain.add_node(node, z=z, y=y, x=x, radius=float(of["radius"]), kind=of["kind"], rings=of["rings"])
    for one, other, of in graph.edges(data=True):
        points = ",".join(" ".join(f"{v:.7g}" for v in point) for point in of["points"])
        radii = " ".join(f"{r:.7g}" for r in of["radii"])
        plain.add_edge(one, other, length=of["length"], radius=of["radius"], points=points, radii=radii)
    return write_atomically(Path(path), lambda temporary: nx.write_graphml(plain, temporary))


def _trace(skeleton: np.ndarray, distance: np.ndarray) -> nx.MultiGraph:
    """Return nodes with `place` (voxels), `radius` and `rings`, and edges with the `line` (N, 3) of their voxels."""
    nx = require("networkx", "synth", "a centreline")
    places, voxels, graph = np.argwhere(skeleton), nx.Graph(), nx.MultiGraph()
    voxels.add_nodes_from(range(len(places)))
    voxels.add_edges_from(KDTree(places).query_pairs(1.8) if len(places) else ())
    crossing = voxels.subgraph(i for i, degree in voxels.degree if degree > 2)
    groups = sorted(map(sorted, nx.connected_components(crossing)))
    groups += [[i] for i, degree in voxels.degree if degree < 2]
    # A line that closes on itself has neither junction nor end: its first voxel is its node.
    groups += [[min(piece)] for piece in nx.connected_components(voxels) if all(voxels.degree(i) == 2 for i in piece)]
    node = {i: k for k, members in enumerate(groups) for i in members}
    for k, members in enumerate(groups):
        cloud = places[members]
        block = np.zeros(np.ptp(cloud, axis=0) + 1, dtype=bool)
        block[tuple((cloud - cloud.min(0)).T)] = True
        rings = betti_numbers(block)[1] if len(cloud) > 3 else 0
        graph.add_node(k, place=cloud.mean(0), radius=float(distance[tuple(cloud.T)].max()), rings=rings)
    visited: set[int] = set()
    for i, k in node.items():
        for first in sorted(voxels[i]):
            if first in visited or (first in node and node[first] <= k):
                continue
            path = [i, first]
            while path[-1] not in node:  # a voxel on a line has one other neighbour
                path.append(next(j for j in voxels[path[-1]] if j != path[-2]))
            visited.update(path[1:-1])
            ends = [graph.nodes[node[j]]["place"] for j in (i, path[-1])]
            _add_edge(graph, k, node[path[-1]], np.stack([ends[0], *places[path[1:-1]], ends[1]]))
    return graph


def _add_edge(graph: nx.MultiGraph, one: int, other: int, line: np.ndarray) -> None:
    """Add an edge whose line goes from the lesser node to the greater."""
    graph.add_edge(min(one, other), max(one, other), line=line if one <= other else line[::-1])


def _prune(graph: nx.MultiGraph, steps: np.ndarray) -> None:
    while spurs := sorted(_find_spurs(graph, steps)):
        for _, tip, root in spurs:
            if tip in graph and root in graph and graph.degree(tip) == 1 and graph.has_edge(tip, root):
                graph.remove_node(tip)
                _dissolve(graph, root)


def _find_spurs(graph: nx.MultiGraph, steps: np.ndarray) -> list[tuple[float, int, int]]:
    """Return the length, free node and other node of all spurs."""
    spurs = []
    for one, other, line in graph.edges(data="line"):
        for tip, root in ((one, other), (other, one)):
            if graph.degree(tip) == 1 and tip != root:
                radii = graph.nodes[root]["radius"], graph.nodes[tip]["radius"]
                length = float(np.linalg.norm(np.diff(_smooth(line) * steps, axis=0), axis=1).sum())
                if length < SPUR * radii[0] + steps.max() and (graph.degree(root) > 1 or radii[0] >= radii[1]):
                    spurs.append((length, tip, root))
    return spurs


def _dissolve(graph: nx.MultiGraph, node: int) -> None:
    """Replace a node with two edges, and no rings, by one edge."""
    edges = list(graph.edges(node, data="line"))
    if graph.degree(node) != 2 or len(edges) != 2 or graph.nodes[node]["rings"]:
        return
    (_, one, first), (_, other, second) = edges
    first = first if node > one else first[::-1]  # towards the node
    second = second if node < other else second[::-1]  # away from it
    graph.remove_node(node)
    _add_edge(graph, one, other, np.concatenate([first[:-1], second]))


def _move_to_axis(graph: nx.MultiGraph, distance: np.ndarray, steps: np.ndarray) -> None:
    """Move each line sideways to the middle of its tube, and each node by the mean move of its lines' ends."""
    at = partial(ndimage.map_coordinates, distance, order=1, mode="nearest")
    moves: dict[int, list[np.ndarray]] = defaultdict(list)
    for one, other, of in graph.edges(data=True):
        line = of["line"] = _smooth(of["line"]).copy()
        along = _tangents(line, steps)
        # Half the difference of the distances one voxel to either side is how far a point is off the axis.
        push = np.stack([at((line + e).T) - at((line - e).T) for e in np.eye(3)], 1) / 2
        push -= (push * along).sum(1, keepdims=True) * along
        line += push / steps
        moves[min(one, other)].append(push[0] / steps)
        moves[max(one, other)].append(push[-1] / steps)
    for node, ends in moves.items():
        graph.nodes[node]["place"] = graph.nodes[node]["place"] + np.mean(ends, axis=0)
    for one, other, of in graph.edges(data=True):
        of["line"][0], of["line"][-1] = (graph.nodes[node]["place"] for node in sorted((one, other)))


def _tangents(line: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return unit tangents, in physical space, of a line (N, 3) in voxels."""
    along = np.gradient(line, axis=0) * steps
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def _measure_radii(distance: np.ndarray, line: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return radii (N,) at the points of a line (N, 3) in voxels: the mean over the 8 voxels around a point."""
    low, along, radii = np.floor(line).astype(int), _tangents(line, steps), np.zeros(len(line))
    for corner in product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, line - low, 1 - line + low), axis=1)
        off = (low + corner - line) * steps
        off -= (off * along).sum(1, keepdims=True) * along
        voxel = np.clip(low + corner, 0, np.array(distance.shape) - 1)
        # The axis of a tube misses the voxels, whose distance is too small by how far they are off the line.
        radii += weight * (distance[tuple(voxel.T)] + np.linalg.norm(off, axis=1))
    return np.maximum(radii, 0)


def _finish(graph: nx.MultiGraph, distance: np.ndarray, steps: np.ndarray) -> None:
    """Give nodes and edges what `centreline` promises of them, with lengths in spacing's unit."""
    for node, of in graph.nodes(data=True):
        kinds = ("point", "end", "loop" if graph.has_edge(node, node) else "junction", "junction")
        of |= {"position": of.pop("place") * steps, "kind": kinds[min(graph.degree(node), 3)]}
    for *ends, of in graph.edges(data=True):
        line = _smooth(of.pop("line"))
        points, radii = line * steps, _measure_radii(distance, line, steps)
        pieces = np.linalg.norm(np.diff(points, axis=0), axis=1)
        mean = float(np.average((radii[1:] + radii[:-1]) / 2, weights=pieces)) if pieces.sum() else float(radii.mean())
        of |= {"points": points, "radii": radii, "length": float(pieces.sum()), "radius": mean}
        for node, radius in zip(sorted(ends), (radii[0], radii[-1]), strict=True):
            graph.nodes[node]["radius"] = max(graph.nodes[node]["radius"], float(radius))


def _smooth(line: np.ndarray) -> np.ndarray:
    """Return the line after two moving averages; it is continued as a point reflection, so that its ends stay."""
    for _ in range(2 if len(line) > 2 else 0):
        longer = np.pad(line, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
        line = ndimage.convolve1d(longer, (1 / 9, 2 / 9, 3 / 9, 2 / 9, 1 / 9), axis=0)[2:-2]
    return line
