"""Curve skeletons that keep a mask's topology, and graphs of the skeletons of crops, with radii."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path

import networkx as nx
import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import KDTree
from skimage import measure

from curvafit.core.files import write_atomically
from curvafit.geometry.topology import betti_numbers

#: A spur is shorter than a voxel plus so many radii of its other node.
SPUR = 1.0
#: A set of voxels of a 3×3×3 block is an integer with a bit for each, x fastest: `FACES` and `EIGHTEEN` are the 6 and
#: the 18 nearest to the middle, `CORNERS[k]` all neighbours of voxel k, `SIDES[k]` those by a face, within the 18.
MIDDLE = 13
_POSITIONS = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), 1)
_OFFSETS, _BITS = np.abs(_POSITIONS[:, None] - _POSITIONS), 1 << np.arange(27)
FACES = int((_OFFSETS[MIDDLE].sum(1) == 1) @ _BITS)
EIGHTEEN = int(((_OFFSETS[MIDDLE].sum(1) > 0) & (_OFFSETS[MIDDLE].sum(1) < 3)) @ _BITS)
CORNERS = ((_OFFSETS.max(2) == 1) @ _BITS) & ~(1 << MIDDLE)
SIDES = ((_OFFSETS.sum(2) == 1) @ _BITS) & EIGHTEEN


def skeleton_of(distance: np.ndarray) -> np.ndarray:
    """Return one-voxel wide curves in the middle of {distance > 0}, bool (Z, Y, X), with the mask's topology.

    The distance (Z, Y, X) is positive inside, as `labels.field_distance` gives it. The curves have as many pieces,
    tunnels and cavities as the mask; a cavity keeps a closed sheet around it. Curves run up to the faces of the box.
    """
    skeleton = (distance > 0).astype(np.uint8)
    # From the surface inwards; equals come in random order, as one along a tube would eat it from its end.
    order = np.random.default_rng(0).permutation(np.flatnonzero(skeleton))
    order = order[np.argsort(distance.ravel()[order], kind="stable")]
    fixed = np.zeros(skeleton.shape, dtype=bool)
    for axis, side in product(range(3), (0, -1)):
        face = np.moveaxis(distance, axis, 0)[side]
        pieces, count = measure.label(face > 0, return_num=True)  # type: ignore
        middles = np.array(ndimage.maximum_position(face, pieces, range(1, count + 1)), dtype=int).reshape(-1, 2)
        np.moveaxis(fixed, axis, 0)[side][tuple(middles.T)] = True
    _thin(skeleton, fixed, order.copy())
    _thin(skeleton, np.zeros_like(fixed), order[skeleton.ravel()[order] > 0])
    return skeleton.astype(bool)


@njit(cache=True)
def _thin(mask, fixed, order):  # pragma: no cover
    """Delete simple voxels from the mask, in the given order, until none is left; `fixed` voxels and ends stay."""
    nz, ny, nx = mask.shape
    changed = True
    while changed:
        changed, remaining = False, 0
        for i in order:
            z, y, x = i // (ny * nx), i // nx % ny, i % nx
            if fixed[z, y, x]:
                continue
            neighbours, count = 0, 0
            for k in range(27):
                a, b, c = z + k // 9 - 1, y + k // 3 % 3 - 1, x + k % 3 - 1
                if a < 0 or b < 0 or c < 0 or a >= nz or b >= ny or c >= nx:
                    continue
                if k != MIDDLE and mask[a, b, c]:
                    neighbours |= 1 << k
                    count += 1
            if count > 1 and _is_simple(neighbours):
                mask[z, y, x] = 0
                changed = True
            else:
                order[remaining] = i
                remaining += 1
        order = order[:remaining]  # those that another deletion may make simple


@njit(cache=True)
def _is_simple(neighbours):  # pragma: no cover
    """Return whether deleting the middle of 3×3×3 voxels keeps the topology; `neighbours` are the mask's others."""
    # This is a simple point (Bertrand and Malandain 1994): the mask around it is one 26-connected piece, and the
    # outside voxels that touch the middle by a face are in one 6-connected piece of the 18 nearest.
    outside = ~neighbours & EIGHTEEN
    one_outside = outside & FACES != 0 and _is_connected(outside, outside & FACES, SIDES)
    return one_outside and _is_connected(neighbours, neighbours, CORNERS)


@njit(cache=True)
def _is_connected(bits, wanted, touching):  # pragma: no cover
    """Return whether all `wanted` bits are in one piece of `bits`, where `touching[k]` are the neighbours of bit k."""
    piece, grown = 0, wanted & -wanted  # begins with the lowest bit of `wanted`
    while grown != piece:
        piece = grown
        for k in range(27):
            if piece >> k & 1:
                grown |= touching[k] & bits
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
    line that closes on itself) and `rings`, the number of tunnels within a node, or of loops shorter than a voxel,
    nearly always 0. Edges have `points` (N, 3) from the lesser node to the greater and `radii` (N,), both with the
    nodes' own, `length` and mean `radius`. Lengths are in spacing's unit; the first voxel's centre is the origin.
    """
    if skeleton.shape != distance.shape:
        raise ValueError(f"skeleton and distance must have one shape, got {skeleton.shape} and {distance.shape}")
    steps = np.asarray(spacing, dtype=float)
    graph = _trace(np.asarray(skeleton, dtype=bool), distance)
    for node in list(graph):
        _dissolve(graph, node)
    while spurs := sorted(_find_spurs(graph, steps)):
        for _, tip, root in spurs:  # an earlier removal may have changed the graph
            if tip in graph and root in graph and graph.degree(tip) == 1 and graph.has_edge(tip, root):
                graph.remove_node(tip)
                _dissolve(graph, root)
    for _ in range(2):
        _move_to_axis(graph, distance, steps)
    _finish(graph, distance, steps)
    return nx.convert_node_labels_to_integers(graph, ordering="sorted")  # type: ignore


def write_graphml(graph: nx.MultiGraph, path: str | Path, unit: str = "voxel") -> Path:
    """Write a `centreline` as GraphML, with its `unit` of length.

    Nodes have `z`, `y`, `x`, `radius`, `kind`, `rings` and, of a scan, `cut`; edges `length`, `radius`, and as texts
    `points` ("z y x", with commas between points) and `radii`.
    """
    plain = nx.MultiGraph(unit=unit)
    for node, data in graph.nodes(data=True):
        z, y, x = map(float, data["position"])
        facts = {name: data[name] for name in ("kind", "rings", "cut") if name in data}
        plain.add_node(node, z=z, y=y, x=x, radius=float(data["radius"]), **facts)
    for one, other, data in graph.edges(data=True):
        points = ",".join(" ".join(f"{v:.7g}" for v in point) for point in data["points"])
        radii = " ".join(f"{r:.7g}" for r in data["radii"])
        plain.add_edge(one, other, length=data["length"], radius=data["radius"], points=points, radii=radii)
    return write_atomically(Path(path), lambda temporary: nx.write_graphml(plain, temporary))


def _trace(skeleton: np.ndarray, distance: np.ndarray) -> nx.MultiGraph:
    """Return a graph: nodes have `centre` (in voxels), `radius` and `rings`, and edges the `line` (N, 3) of voxels."""
    positions, voxels, graph = np.argwhere(skeleton), nx.Graph(), nx.MultiGraph()
    voxels.add_nodes_from(range(len(positions)))
    voxels.add_edges_from(KDTree(positions).query_pairs(1.8) if len(positions) else ())  # 26 neighbours, up to √3 away
    crossing = voxels.subgraph(i for i, degree in voxels.degree if degree > 2)
    groups = sorted(map(sorted, nx.connected_components(crossing)))
    groups += [[i] for i, degree in voxels.degree if degree < 2]
    # A line that closes on itself has neither junction nor end: its first voxel is its node.
    groups += [[min(piece)] for piece in nx.connected_components(voxels) if all(voxels.degree(i) == 2 for i in piece)]
    node_of = {i: node for node, members in enumerate(groups) for i in members}
    for node, members in enumerate(groups):
        cluster = positions[members]
        block = np.zeros(np.ptp(cluster, axis=0) + 1, dtype=bool)
        block[tuple((cluster - cluster.min(0)).T)] = True
        rings = betti_numbers(block)[1] if len(cluster) > 3 else 0
        graph.add_node(node, centre=cluster.mean(0), radius=float(distance[tuple(cluster.T)].max()), rings=rings)
    visited: set[int] = set()
    for i, node in node_of.items():
        for neighbour in sorted(voxels[i]):
            # Each line is followed once, and nodes that touch are joined once, from the lesser one.
            if neighbour in visited or (neighbour in node_of and node_of[neighbour] <= node):
                continue
            path = [i, neighbour]
            while path[-1] not in node_of:  # a voxel on a line has one other neighbour
                path.append(next(j for j in voxels[path[-1]] if j != path[-2]))
            visited.update(path[1:-1])
            ends = [graph.nodes[node_of[j]]["centre"] for j in (i, path[-1])]
            _add_edge(graph, node, node_of[path[-1]], np.stack([ends[0], *positions[path[1:-1]], ends[1]]))
    return graph


def _add_edge(graph: nx.MultiGraph, one: int, other: int, line: np.ndarray) -> None:
    """Add an edge whose line goes from the lesser node to the greater."""
    graph.add_edge(min(one, other), max(one, other), line=line if one <= other else line[::-1])


def _find_spurs(graph: nx.MultiGraph, steps: np.ndarray) -> list[tuple[float, int, int]]:
    """Return the length, free node and other node of all spurs."""
    spurs = []
    for one, other, line in graph.edges(data="line"):
        for tip, root in ((one, other), (other, one)):
            if graph.degree(tip) == 1 and tip != root:
                root_radius, tip_radius = graph.nodes[root]["radius"], graph.nodes[tip]["radius"]
                length = float(np.linalg.norm(np.diff(_smooth(line) * steps, axis=0), axis=1).sum())
                # Of a line with two free ends, only the thinner one can be a tip.
                if (graph.degree(root) > 1 or root_radius >= tip_radius) and length < SPUR * root_radius + steps.max():
                    spurs.append((length, tip, root))
    return spurs


def _dissolve(graph: nx.MultiGraph, node: int) -> None:
    """Replace a node with two edges, and no rings, by one edge."""
    edges = list(graph.edges(node, data="line"))
    if graph.degree(node) != 2 or len(edges) != 2 or graph.nodes[node]["rings"]:
        return
    (_, one, first), (_, other, second) = edges
    first = first if node > one else first[::-1]  # towards the node; lines run from the lower to the higher one
    second = second if node < other else second[::-1]  # away from it
    graph.remove_node(node)
    _add_edge(graph, one, other, np.concatenate([first[:-1], second]))


def _move_to_axis(graph: nx.MultiGraph, distance: np.ndarray, steps: np.ndarray) -> None:
    """Move each line sideways to the middle of its tube, and each node by the mean move of its lines' ends."""
    sample = partial(ndimage.map_coordinates, distance, order=1, mode="nearest")
    moves: dict[int, list[np.ndarray]] = defaultdict(list)
    for one, other, data in graph.edges(data=True):
        line = data["line"] = _smooth(data["line"]).copy()
        tangents = _tangents(line, steps)
        # Half the difference of the distances one voxel to either side is how far a point is off the axis.
        shifts = np.stack([sample((line + e).T) - sample((line - e).T) for e in np.eye(3)], 1) / 2
        shifts -= (shifts * tangents).sum(1, keepdims=True) * tangents
        line += shifts / steps
        moves[min(one, other)].append(shifts[0] / steps)
        moves[max(one, other)].append(shifts[-1] / steps)
    for node, ends in moves.items():
        graph.nodes[node]["centre"] = graph.nodes[node]["centre"] + np.mean(ends, axis=0)
    for one, other, data in graph.edges(data=True):
        data["line"][0], data["line"][-1] = (graph.nodes[node]["centre"] for node in sorted((one, other)))


def _tangents(line: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return unit tangents, in physical space, of a line (N, 3) in voxels."""
    tangents = np.gradient(line, axis=0) * steps
    return tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)


def _measure_radii(distance: np.ndarray, line: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return radii (N,) at the points of a line (N, 3) in voxels: the mean over the 8 voxels around a point."""
    floor, tangents = np.floor(line).astype(int), _tangents(line, steps)
    radii = np.zeros(len(line))
    for corner in product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, line - floor, 1 - line + floor), axis=1)
        offsets = (floor + corner - line) * steps
        offsets -= (offsets * tangents).sum(1, keepdims=True) * tangents
        voxels = np.clip(floor + corner, 0, np.array(distance.shape) - 1)
        # The axis of a tube misses the voxels, whose distance is too small by how far they are off the line.
        radii += weight * (distance[tuple(voxels.T)] + np.linalg.norm(offsets, axis=1))
    return np.maximum(radii, 0)


def _finish(graph: nx.MultiGraph, distance: np.ndarray, steps: np.ndarray) -> None:
    """Replace the attributes of nodes and edges by those that `centreline` documents, lengths in spacing's unit."""
    for *ends, key, data in list(graph.edges(keys=True, data=True)):
        line = _smooth(data.pop("line"))
        points, radii = line * steps, _measure_radii(distance, line, steps)
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if ends[0] == ends[1] and lengths.sum() < steps.max():  # around a hole of a voxel: it is no branch
            graph.remove_edge(ends[0], ends[1], key)
            graph.nodes[ends[0]]["rings"] += 1
            continue
        mean = np.average((radii[1:] + radii[:-1]) / 2, weights=lengths) if lengths.sum() else radii.mean()
        data |= {"points": points, "radii": radii, "length": float(lengths.sum()), "radius": float(mean)}
        for node, radius in zip(sorted(ends), (radii[0], radii[-1]), strict=True):
            graph.nodes[node]["radius"] = max(graph.nodes[node]["radius"], float(radius))
    for node, data in graph.nodes(data=True):
        kind_by_degree = ("point", "end", "loop" if graph.has_edge(node, node) else "junction", "junction")
        data |= {"position": data.pop("centre") * steps, "kind": kind_by_degree[min(graph.degree(node), 3)]}


def _smooth(line: np.ndarray) -> np.ndarray:
    """Return the line after two moving averages; it is continued by point reflection, so that its ends stay."""
    for _ in range(2 if len(line) > 2 else 0):
        padded = np.pad(line, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
        line = ndimage.convolve1d(padded, (1 / 9, 2 / 9, 3 / 9, 2 / 9, 1 / 9), axis=0)[2:-2]
    return line
