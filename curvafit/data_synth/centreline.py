"""Curve skeletons with the mask's own topology, in a box that ends or one that repeats; and skeletons as graphs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.morphology import skeletonize

from curvafit.core.extras import require
from curvafit.core.files import write_atomically
from curvafit.geometry.topology import betti_numbers
from curvafit.priors.grid import Grid

if TYPE_CHECKING:
    import networkx as nx

#: Weights by which voxels' places are averaged along a line, twice, so that their steps do not count.
SMOOTH = (1 / 9, 2 / 9, 3 / 9, 2 / 9, 1 / 9)
#: How often lines are moved towards the middle.
CENTRING = 2
#: Of 27 voxels, numbered along x, y, z: the middle; as bits the 6 and the 18 nearest to it, and those that touch each,
#: the middle aside, by a corner at least, or by a side and among the 18.
MIDDLE = 13
_PLACES = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), 1)
_STEPS, _BITS = np.abs(_PLACES[:, None] - _PLACES), 1 << np.arange(27)
FACES = int((_STEPS[MIDDLE].sum(1) == 1) @ _BITS)
EIGHTEEN = int(((_STEPS[MIDDLE].sum(1) > 0) & (_STEPS[MIDDLE].sum(1) < 3)) @ _BITS)
CORNERS = ((_STEPS.max(2) == 1) @ _BITS) & ~(1 << MIDDLE)
SIDES = ((_STEPS.sum(2) == 1) @ _BITS) & EIGHTEEN


# ---- skeleton --------------------------------------------------------------------------------------------------------


def skeleton_of(distance: np.ndarray, grid: Grid) -> np.ndarray:
    """Return one-voxel wide curves in the middle of {distance > 0}, bool (Z, Y, X), with its pieces, tunnels and
    cavities.

    Lee's thinning (scikit-image) of the box continued beyond its faces (periodic, or by its outermost layers, so that
    what is cut by a face is followed up to it) says where the curves go. As what is cut off with that continuation may
    hold the pieces together, the whole mask is then thinned in the box itself (a torus where it is periodic) around
    those curves: voxels go in the order of their distance where that changes no piece, tunnel or cavity. In a periodic
    box the curves so run on from face to face. A cavity keeps a closed sheet around it.

    Parameters
    ----------
    distance
        Signed distance (Z, Y, X), positive inside, as `labels.field_distance` gives it.
    """
    mask = distance > 0
    width = math.ceil(float(distance.max()) / min(grid.spacing)) + 2
    margin = [(min(n // 2, width),) * 2 for n in mask.shape]
    padded = np.pad(mask, margin, mode="wrap" if grid.periodic else "edge")
    inner = tuple(slice(m, m + n) for (m, _), n in zip(margin, mask.shape, strict=True))
    lines = skeletonize(padded)[inner].astype(bool)
    order = np.flatnonzero(mask)
    order = order[np.argsort(distance.ravel()[order], kind="stable")]
    left = mask.astype(np.uint8)
    _thin(left, lines & mask, order.copy(), grid.periodic)
    _thin(left, np.zeros_like(mask), order[left.ravel()[order] > 0], grid.periodic)
    return left.astype(bool)


@njit(cache=True)
def _thin(left, fixed, order, periodic):  # pragma: no cover
    """Take away simple voxels in the given order, again and again; ends (of one neighbour) and `fixed` ones stay."""
    nz, ny, nx = left.shape
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
                if k != MIDDLE and left[a, b, c]:
                    around |= 1 << k
                    count += 1
            if count > 1 and _is_simple(around):
                left[z, y, x] = 0
                changed = True
            else:
                order[kept] = i
                kept += 1
        order = order[:kept]


@njit(cache=True)
def _is_simple(around):  # pragma: no cover
    """Return whether deleting the middle of 3×3×3 voxels keeps the topology; `around` has the mask around it as bits.

    It does where the mask around is one 26-connected piece, and what is outside and touches the middle is one
    6-connected piece within the 18-neighbourhood (a simple point, Bertrand and Malandain 1994).
    """
    outside = ~around & EIGHTEEN
    return outside & FACES != 0 and _is_one(around, around, CORNERS) and _is_one(outside, outside & FACES, SIDES)


@njit(cache=True)
def _is_one(bits, wanted, touching):  # pragma: no cover
    """Return whether all of the `wanted` ones among the bits are in one piece."""
    piece, larger = 0, wanted & -wanted
    while larger != piece:
        piece = larger
        for k in range(27):
            if piece >> k & 1:
                larger |= touching[k] & bits
    return wanted & ~piece == 0


# ---- graph -----------------------------------------------------------------------------------------------------------


def centreline(skeleton: np.ndarray, distance: np.ndarray, grid: Grid, prune: float = 1.0) -> nx.MultiGraph:
    """Return the graph of a skeleton of one-voxel wide lines (26 neighbours), with radii.

    Voxels of three or more neighbours are junctions, touching ones a single one at their mean; voxels of one neighbour
    are ends. Lines are smoothed over some voxels, as steps from voxel to voxel would make tilted ones up to a tenth too
    long, and moved across themselves to where the distance is greatest. A free line that does not leave the ball around
    its other node by more than a voxel is a spur and is left out, shortest first; where two lines remain at a junction
    they become one. A piece that is so left with nothing is a node without edges. Neither changes the cycles.

    Parameters
    ----------
    skeleton
        bool (Z, Y, X), as `skeleton_of` gives it.
    distance
        Signed distance (Z, Y, X), positive inside. A radius is the mean over the 8 voxels around a point of their
        distance and how far they are beside the line: what it is on a round tube, whose axis misses the voxels.
    prune
        Spurs are shorter than so many radii of their other node and a voxel; 0 keeps all.

    Returns
    -------
    networkx.MultiGraph
        Nodes 0, 1, … have `position` (z, y, x), `radius`, `kind` ("end", "junction", "point" without edges, "loop" of a
        line that closes on itself) and `rings`, tunnels some voxels wide within a junction, of which no edge is made,
        nearly always 0; edges have `points` (N, 3) from the lesser node to the greater and `radii`
        (N,), both with the nodes' own, `length` and mean `radius`. All is in spacing's unit, the first voxel's centre
        at the origin. In a periodic box nodes are in the box and `points` run on beyond it.
    """
    if skeleton.shape != grid.shape or distance.shape != grid.shape:
        raise ValueError(f"arrays must have the shape {grid.shape}, got {skeleton.shape} and {distance.shape}")
    if not prune >= 0:
        raise ValueError(f"prune must be from 0, got {prune}")
    graph = _trace(np.asarray(skeleton, dtype=bool), distance, grid)
    for node in list(graph):
        _dissolve(graph, node)
    if prune > 0:
        _prune(graph, prune, np.array(grid.spacing))
    for _ in range(CENTRING):
        _centre(graph, distance, grid)
    return _finish(graph, distance, grid)


def write_graphml(graph: nx.MultiGraph, path: str | Path, unit: str = "voxel") -> Path:
    """Write a `centreline` as GraphML.

    Nodes have `z`, `y`, `x`, `radius`, `kind` and `rings`; edges `length`, `radius`, and as text `points` ("z y x" and
    a comma between two, from the lesser node to the greater) and `radii`; the graph has its `unit` of length.
    """
    nx = _networkx()
    plain = nx.MultiGraph(unit=unit)
    for node, of in graph.nodes(data=True):
        z, y, x = map(float, of["position"])
        plain.add_node(node, z=z, y=y, x=x, radius=float(of["radius"]), kind=of["kind"], rings=of["rings"])
    for one, other, of in graph.edges(data=True):
        points = ",".join(" ".join(f"{v:.7g}" for v in point) for point in of["points"])
        radii = " ".join(f"{r:.7g}" for r in of["radii"])
        plain.add_edge(one, other, length=of["length"], radius=of["radius"], points=points, radii=radii)
    return write_atomically(Path(path), lambda temporary: nx.write_graphml(plain, temporary))


def _networkx():
    return require("networkx", "synth", "a centreline")


def _trace(skeleton: np.ndarray, distance: np.ndarray, grid: Grid) -> nx.MultiGraph:
    """Return nodes with `place` (voxels) and `radius`; edges with `line` (N, 3) in voxels from `start`, unwrapped."""
    places = np.argwhere(skeleton)
    beside = _neighbours(places, grid)
    groups = [*_junctions(beside), *([i] for i, near in enumerate(beside) if len(near) < 2)]
    node = {i: k for k, members in enumerate(groups) for i in members}
    graph = _networkx().MultiGraph()
    for k, members in enumerate(groups):
        cloud = np.stack(_unwrap([places[i] for i in members], grid))
        radius = max(float(distance[tuple(places[i])]) for i in members)
        graph.add_node(k, place=cloud.mean(0), radius=radius, rings=_rings(cloud, grid))
    visited: set[int] = set()
    for i, k in list(node.items()):
        for first in beside[i]:
            if first in node and (node[first] > k):
                _join(graph, k, node[first], [places[i], places[first]], grid)
            elif first not in node and first not in visited:
                path = _walk(i, first, beside, node)
                visited.update(path[1:-1])
                _join(graph, k, node[path[-1]], [places[j] for j in path], grid)
    for i in range(len(places)):
        if i not in node and i not in visited:  # a line that closes on itself
            node[i] = len(graph)
            path = _walk(i, beside[i][0], beside, node)
            visited.update(path)
            graph.add_node(node[i], place=places[i].astype(float), radius=float(distance[tuple(places[i])]), rings=0)
            _join(graph, node[i], node[i], [places[j] for j in path], grid)
    return graph


def _neighbours(places: np.ndarray, grid: Grid) -> list[list[int]]:
    """Return the numbers of the (up to 26) voxels around each."""
    if not len(places):
        return []
    tree = KDTree(places, boxsize=grid.shape if grid.periodic else None)
    near = tree.query_ball_point(places, 1.8, return_sorted=True)
    return [[j for j in found if j != i] for i, found in enumerate(near)]


def _junctions(beside: list[list[int]]) -> Iterable[list[int]]:
    nx = _networkx()
    meeting = nx.Graph()
    crossing = [i for i, near in enumerate(beside) if len(near) > 2]
    meeting.add_nodes_from(crossing)
    meeting.add_edges_from((i, j) for i in crossing for j in beside[i] if len(beside[j]) > 2)
    return (sorted(members) for members in nx.connected_components(meeting))


def _rings(cloud: np.ndarray, grid: Grid) -> int:
    """Return the tunnels among the voxels of a junction, places (N, 3)."""
    if len(cloud) < 4:
        return 0
    low = cloud.min(0)
    size = (cloud.max(0) - low).astype(int) + 1
    around = grid.periodic and bool((2 * size > grid.shape).any())  # it may close on itself around the box
    voxels = np.zeros(grid.shape if around else size, dtype=bool)
    voxels[tuple((cloud - low).astype(int).T % np.array(voxels.shape)[:, None])] = True
    return betti_numbers(voxels, periodic=around)[1]


def _walk(start: int, first: int, beside: list[list[int]], node: dict[int, int]) -> list[int]:
    """Return the path from a node's voxel along voxels of two neighbours to the next node's."""
    path = [start, first]
    while path[-1] not in node:
        one, other = beside[path[-1]]
        path.append(other if one == path[-2] else one)
    return path


def _join(graph: nx.MultiGraph, one: int, other: int, voxels: list[np.ndarray], grid: Grid) -> None:
    """Add an edge through voxels, the first and the last of which belong to the nodes."""
    start, end = graph.nodes[one]["place"], graph.nodes[other]["place"]
    _add_edge(graph, one, other, np.stack(_unwrap([start, *voxels[1:-1], end], grid)))


def _add_edge(graph: nx.MultiGraph, one: int, other: int, line: np.ndarray) -> None:
    """Add an edge whose line goes from the lesser node to the greater."""
    graph.add_edge(min(one, other), max(one, other), line=line if one <= other else line[::-1])


def _unwrap(points: list[np.ndarray], grid: Grid) -> list[np.ndarray]:
    """Return the points with whole boxes added so that each is nearest to the one before."""
    path = [np.asarray(points[0], dtype=float)]
    for point in points[1:]:
        boxes = np.round((point - path[-1]) / grid.shape) if grid.periodic else 0
        path.append(point - np.array(grid.shape) * boxes)
    return path


def _prune(graph: nx.MultiGraph, share: float, spacing: np.ndarray) -> None:
    """Leave out spurs, shortest first, until there are none."""
    while spurs := sorted(_spurs(graph, share, spacing)):
        for _, tip, root in spurs:
            if tip in graph and root in graph and graph.degree(tip) == 1 and graph.has_edge(tip, root):
                graph.remove_node(tip)
                _dissolve(graph, root)


def _spurs(graph: nx.MultiGraph, share: float, spacing: np.ndarray) -> Iterable[tuple[float, int, int]]:
    for one, other, line in graph.edges(data="line"):
        for tip, root in ((one, other), (other, one)):
            if graph.degree(tip) == 1 and tip != root:
                radii = graph.nodes[root]["radius"], graph.nodes[tip]["radius"]
                length = float(np.linalg.norm(np.diff(_smooth(line) * spacing, axis=0), axis=1).sum())
                if length < share * radii[0] + spacing.max() and (graph.degree(root) > 1 or radii[0] >= radii[1]):
                    yield length, tip, root


def _dissolve(graph: nx.MultiGraph, node: int) -> None:
    """Make the two edges of a node one."""
    edges = list(graph.edges(node, keys=True, data="line"))
    if graph.degree(node) != 2 or len(edges) != 2 or graph.nodes[node]["rings"]:
        return
    (_, one, _, first), (_, other, _, second) = edges
    first = first if node > one else first[::-1]  # towards the node
    second = second if node < other else second[::-1]  # away from it
    line = np.concatenate([first[:-1], second + (first[-1] - second[0])])
    graph.remove_node(node)
    _add_edge(graph, one, other, line)


def _centre(graph: nx.MultiGraph, distance: np.ndarray, grid: Grid) -> None:
    """Move lines across themselves, towards the greatest distance: half of what it gains from a voxel on one side to
    one on the other is how far off a tube's middle is. Nodes move as their lines' ends do on average."""
    edges = [(min(edge[:2]), max(edge[:2]), *edge[2:]) for edge in graph.edges(keys=True, data="line")]
    if not edges:
        return
    lines = [_smooth(line) for *_, line in edges]
    along = np.concatenate([_tangents(line, grid) for line in lines])
    points = np.concatenate(lines)
    push = np.stack([_at(distance, points + e, grid) - _at(distance, points - e, grid) for e in np.eye(3)], axis=1) / 2
    push -= (push * along).sum(1, keepdims=True) * along
    moves = np.split(push / grid.spacing, np.cumsum([len(line) for line in lines])[:-1])
    ends: dict[int, list[np.ndarray]] = {node: [] for node in graph}
    for (one, other, *_), line, move in zip(edges, lines, moves, strict=True):
        line[1:-1] += move[1:-1]
        ends[one].append(move[0])
        ends[other].append(move[-1])
    mean = {node: np.mean(move, axis=0) if move else np.zeros(3) for node, move in ends.items()}
    for (one, other, key, _), line in zip(edges, lines, strict=True):
        line[0] += mean[one]
        line[-1] += mean[other]
        graph.edges[one, other, key]["line"] = line
    for node, of in graph.nodes(data=True):
        of["place"] = of["place"] + mean[node]


def _tangents(line: np.ndarray, grid: Grid) -> np.ndarray:
    """Return unit vectors along a line (N, 3) in voxels, in the spacing's unit."""
    along = np.gradient(line, axis=0) * grid.spacing
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def _radii(distance: np.ndarray, line: np.ndarray, grid: Grid) -> np.ndarray:
    """Return radii (N,) at the points of a line (N, 3) in voxels."""
    low, along, radii = np.floor(line).astype(int), _tangents(line, grid), np.zeros(len(line))
    for corner in product((0, 1), repeat=3):
        voxel = low + corner
        weight = np.prod(np.where(corner, line - low, 1 - line + low), axis=1)
        beside = (voxel - line) * grid.spacing
        beside -= (beside * along).sum(1, keepdims=True) * along
        there = voxel % grid.shape if grid.periodic else np.clip(voxel, 0, np.array(grid.shape) - 1)
        radii += weight * (distance[tuple(there.T)] + np.linalg.norm(beside, axis=1))
    return np.maximum(radii, 0)


def _at(values: np.ndarray, points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the values at points `(N, 3)` in voxels, interpolated linearly."""
    return ndimage.map_coordinates(values, points.T, order=1, mode="grid-wrap" if grid.periodic else "nearest")


def _finish(traced: nx.MultiGraph, distance: np.ndarray, grid: Grid) -> nx.MultiGraph:
    """Return the graph with its nodes numbered anew, in the spacing's unit."""
    spacing, graph = np.array(grid.spacing), _networkx().MultiGraph()
    number = {node: k for k, node in enumerate(sorted(traced))}
    for node, k in number.items():
        place, degree = traced.nodes[node]["place"], traced.degree(node)
        kind = ("point", "end", "loop" if traced.has_edge(node, node) else "junction", "junction")[min(degree, 3)]
        home = (place % grid.shape if grid.periodic else place) * spacing
        graph.add_node(k, position=home, kind=kind, **{of: traced.nodes[node][of] for of in ("radius", "rings")})
    for ends_of_edge in traced.edges(data="line"):
        (one, other), line = sorted(ends_of_edge[:2]), _smooth(ends_of_edge[2])
        points = line * spacing
        points = points - points[0] + graph.nodes[number[one]]["position"]
        radii, steps = _radii(distance, line, grid), np.linalg.norm(np.diff(points, axis=0), axis=1)
        mean = float(np.average((radii[1:] + radii[:-1]) / 2, weights=steps)) if steps.sum() else float(radii.mean())
        graph.add_edge(number[one], number[other], points=points, radii=radii, length=float(steps.sum()), radius=mean)
        for node, radius in ((number[one], radii[0]), (number[other], radii[-1])):
            graph.nodes[node]["radius"] = max(graph.nodes[node]["radius"], float(radius))
    return graph


def _smooth(line: np.ndarray) -> np.ndarray:
    """Return the line averaged twice along itself; its ends stay, as it is continued through them."""
    for _ in range(2):
        before, after = 2 * line[0] - line[2:0:-1], 2 * line[-1] - line[-2:-4:-1]
        if len(before) < 2 or len(after) < 2:
            break
        longer = np.concatenate([before, line, after])
        line = sum(w * longer[k : k + len(line)] for k, w in enumerate(SMOOTH))  # type: ignore[assignment]
    return line
