"""A skeleton as a graph: nodes where lines end or meet, edges with their polylines, lengths and radii."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import networkx as nx
import numpy as np
from scipy import ndimage

from curvafit.geometry.topology import betti_numbers
from curvafit.priors.grid import Grid

#: Weights by which voxels' places are averaged along a line, twice, so that their steps do not count.
SMOOTH = (1 / 9, 2 / 9, 3 / 9, 2 / 9, 1 / 9)
#: How often lines are moved towards the middle.
CENTRING = 2


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

    Raises
    ------
    ValueError
        If the arrays do not have the grid's shape or the share is negative.
    """
    if skeleton.shape != grid.shape or distance.shape != grid.shape:
        raise ValueError(f"expected arrays of shape {grid.shape}, got {skeleton.shape} and {distance.shape}")
    if not prune >= 0:
        raise ValueError(f"expected a share of the radius of at least 0, got {prune}")
    graph = _traced(np.asarray(skeleton, dtype=bool), distance, grid)
    for node in list(graph):
        _dissolve(graph, node)
    if prune > 0:
        _prune(graph, prune, np.array(grid.spacing))
    for _ in range(CENTRING):
        _centre(graph, distance, grid)
    return _finished(graph, distance, grid)


def cycle_rank(graph: nx.MultiGraph) -> int:
    """Return independent cycles of edges, with the rings within junctions: the b1 of the skeleton, hence of its
    mask."""
    edges = graph.number_of_edges() - graph.number_of_nodes() + nx.number_connected_components(graph)
    return edges + sum(graph.nodes[node]["rings"] for node in graph)


def _traced(skeleton: np.ndarray, distance: np.ndarray, grid: Grid) -> nx.MultiGraph:
    """Return nodes with `place` (voxels) and `radius`; edges with `line` (N, 3) in voxels from `start`, unwrapped."""
    places = np.argwhere(skeleton)
    number = np.full(skeleton.shape, -1, dtype=np.int64)
    number[skeleton] = np.arange(len(places))
    beside = _neighbours(places, number, grid)
    groups = list(_junctions(beside)) + [[i] for i, near in enumerate(beside) if len(near) < 2]
    node = {i: k for k, members in enumerate(groups) for i in members}
    graph = nx.MultiGraph()
    for k, members in enumerate(groups):
        cloud = np.stack(_unwrapped([places[i] for i in members], grid))
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


def _neighbours(places: np.ndarray, number: np.ndarray, grid: Grid) -> list[list[int]]:
    """Return the numbers of the voxels around each."""
    beside: list[list[int]] = [[] for _ in places]
    for step in product((-1, 0, 1), repeat=3):
        if step == (0, 0, 0):
            continue
        there = places + step
        valid = np.ones(len(there), dtype=bool) if grid.periodic else ((there >= 0) & (there < grid.shape)).all(1)
        found = number[tuple((there[valid] % grid.shape).T)]
        for i, j in zip(np.flatnonzero(valid)[found >= 0], found[found >= 0], strict=True):
            beside[int(i)].append(int(j))
    return beside


def _junctions(beside: list[list[int]]) -> Iterable[list[int]]:
    meeting = nx.Graph()
    crossing = [i for i, near in enumerate(beside) if len(near) > 2]
    meeting.add_nodes_from(crossing)
    meeting.add_edges_from((i, j) for i in crossing for j in beside[i] if len(beside[j]) > 2)
    return (sorted(each) for each in nx.connected_components(meeting))


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
    line = np.stack(_unwrapped([start, *voxels[1:-1], end], grid))
    if one > other:
        one, other, line = other, one, line[::-1]
    graph.add_edge(one, other, line=line)


def _unwrapped(points: list[np.ndarray], grid: Grid) -> list[np.ndarray]:
    """Return the points with whole boxes added so that each is nearest to the one before."""
    if not grid.periodic:
        return [np.asarray(point, dtype=float) for point in points]
    size, out = np.array(grid.shape), [np.asarray(points[0], dtype=float)]
    for point in points[1:]:
        out.append(point - size * np.round((point - out[-1]) / size))
    return out


def _prune(graph: nx.MultiGraph, share: float, spacing: np.ndarray) -> None:
    """Leave out spurs, shortest first, until there are none."""
    changed = True
    while changed:
        spurs = sorted(_spurs(graph, share, spacing))
        changed = bool(spurs)
        for _, tip, root in spurs:
            if tip in graph and root in graph and graph.degree(tip) == 1 and graph.has_edge(tip, root):
                graph.remove_node(tip)
                _dissolve(graph, root)


def _spurs(graph: nx.MultiGraph, share: float, spacing: np.ndarray) -> Iterable[tuple[float, int, int]]:
    for one, other, line in graph.edges(data="line"):
        for tip, root in ((one, other), (other, one)):
            if graph.degree(tip) == 1 and tip != root:
                radii = graph.nodes[root]["radius"], graph.nodes[tip]["radius"]
                length = _length(_smoothed(line) * spacing)
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
    if one > other:
        one, other, line = other, one, line[::-1]
    graph.add_edge(one, other, line=line)


def _centre(graph: nx.MultiGraph, distance: np.ndarray, grid: Grid) -> None:
    """Move lines across themselves, towards the greatest distance: half of what it gains from a voxel on one side to
    one on the other is how far off a tube's middle is. Nodes move as their lines' ends do on average."""
    edges = list(graph.edges(keys=True, data="line"))
    if not edges:
        return
    spacing = np.array(grid.spacing)
    lines = [_smoothed(line) for *_, line in edges]
    along = np.concatenate([np.gradient(line, axis=0) for line in lines]) * spacing
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    points = np.concatenate(lines)
    push = np.stack([_at(distance, points + e, grid) - _at(distance, points - e, grid) for e in np.eye(3)], axis=1) / 2
    push -= (push * along).sum(1, keepdims=True) * along
    moved = np.split(push / spacing, np.cumsum([len(line) for line in lines])[:-1])
    ends: dict[int, list[np.ndarray]] = {node: [] for node in graph}
    for (one, other, *_), line, by in zip(edges, lines, moved, strict=True):
        line[1:-1] += by[1:-1]
        first, last = (one, other) if one < other else (other, one)
        ends[first].append(by[0])
        ends[last].append(by[-1])
    mean = {node: np.mean(by, axis=0) if by else np.zeros(3) for node, by in ends.items()}
    for (one, other, key, _), line in zip(edges, lines, strict=True):
        line[0] += mean[min(one, other)]
        line[-1] += mean[max(one, other)]
        graph.edges[one, other, key]["line"] = line
    for node, of in graph.nodes(data=True):
        of["place"] = of["place"] + mean[node]


def _radii(distance: np.ndarray, line: np.ndarray, grid: Grid) -> np.ndarray:
    """Return radii (N,) at the points of a line (N, 3) in voxels."""
    spacing, low = np.array(grid.spacing), np.floor(line).astype(int)
    along = np.gradient(line, axis=0) * spacing
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    radii = np.zeros(len(line))
    for corner in product((0, 1), repeat=3):
        voxel = low + corner
        weight = np.prod(np.where(corner, line - low, 1 - line + low), axis=1)
        beside = (voxel - line) * spacing
        beside -= (beside * along).sum(1, keepdims=True) * along
        there = voxel % grid.shape if grid.periodic else np.clip(voxel, 0, np.array(grid.shape) - 1)
        radii += weight * (distance[tuple(there.T)] + np.linalg.norm(beside, axis=1))
    return np.maximum(radii, 0)


def _at(values: np.ndarray, points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the values at points `(N, 3)` in voxels, interpolated linearly."""
    return ndimage.map_coordinates(values, points.T, order=1, mode="grid-wrap" if grid.periodic else "nearest")


def _finished(traced: nx.MultiGraph, distance: np.ndarray, grid: Grid) -> nx.MultiGraph:
    """Return the graph with its nodes numbered anew, in the spacing's unit."""
    spacing, graph = np.array(grid.spacing), nx.MultiGraph()
    number = {node: k for k, node in enumerate(sorted(traced))}
    for node, k in number.items():
        place, degree = traced.nodes[node]["place"], traced.degree(node)
        kind = ("point", "end", "loop" if traced.has_edge(node, node) else "junction", "junction")[min(degree, 3)]
        home = (place % grid.shape if grid.periodic else place) * spacing
        graph.add_node(k, position=home, kind=kind, **{of: traced.nodes[node][of] for of in ("radius", "rings")})
    for one, other, line in traced.edges(data="line"):
        if one > other:
            one, other = other, one
        smooth = _smoothed(line)
        points = smooth * spacing
        points = points - points[0] + graph.nodes[number[one]]["position"]
        radii = _radii(distance, smooth, grid)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        mean = float(np.average((radii[1:] + radii[:-1]) / 2, weights=steps)) if steps.sum() else float(radii.mean())
        graph.add_edge(number[one], number[other], points=points, radii=radii, length=float(steps.sum()), radius=mean)
        for node, radius in ((number[one], radii[0]), (number[other], radii[-1])):
            graph.nodes[node]["radius"] = max(graph.nodes[node]["radius"], float(radius))
    return graph


def _smoothed(line: np.ndarray) -> np.ndarray:
    """Return the line averaged twice along itself; its ends stay, as it is continued through them."""
    for _ in range(2):
        before, after = 2 * line[0] - line[2:0:-1], 2 * line[-1] - line[-2:-4:-1]
        if len(before) < 2 or len(after) < 2:
            break
        longer = np.concatenate([before, line, after])
        line = sum(w * longer[k : k + len(line)] for k, w in enumerate(SMOOTH))  # type: ignore[assignment]
    return line


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
