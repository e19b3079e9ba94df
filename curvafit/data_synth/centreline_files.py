"""Centreline graphs on disk: GraphML, whole, and SWC, whose trees leave a gap in every loop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import networkx as nx
import numpy as np

from curvafit.core.files import write_atomically, write_content
from curvafit.core.units import METRES

#: SWC's type of what is neither soma, axon nor dendrite.
UNDEFINED = 0


def write_graphml(graph: nx.MultiGraph, path: str | Path, unit: str = "voxel") -> Path:
    """Write a `centreline` as GraphML.

    Nodes have `z`, `y`, `x`, `radius`, `kind` and `rings`; edges `length`, `radius`, and as text `points` ("z y x" and
    a comma between two, from the lesser node to the greater) and `radii`; the graph has its `unit` of length.

    Raises
    ------
    ValueError
        If the name does not end in .graphml.
    """
    target = _named(path, ".graphml")
    plain = nx.MultiGraph(unit=unit)
    for node, of in graph.nodes(data=True):
        z, y, x = map(float, of["position"])
        plain.add_node(node, z=z, y=y, x=x, radius=float(of["radius"]), kind=of["kind"], rings=of["rings"])
    for one, other, of in graph.edges(data=True):
        points = ",".join(" ".join(f"{v:.7g}" for v in point) for point in of["points"])
        radii = " ".join(f"{r:.7g}" for r in of["radii"])
        plain.add_edge(one, other, length=of["length"], radius=of["radius"], points=points, radii=radii)
    return write_atomically(target, lambda temporary: nx.write_graphml(plain, temporary))


def write_swc(graph: nx.MultiGraph, path: str | Path, unit: str) -> Path:
    """Write a `centreline` as SWC: a line a point, `id type x y z radius parent`, in micrometres, type 0 (undefined).

    Each piece is a tree from its widest end (or widest node); parents come before their children, a root's is -1. SWC
    holds no loops: of each, the thinnest edge is cut off from one of its nodes, and a comment names the two points that
    the cut parts. Pieces of a periodic box are laid out beyond it. The origin is the first voxel's centre.

    Parameters
    ----------
    unit
        Of the graph's lengths: nm, um, mm or m.

    Raises
    ------
    ValueError
        If the name does not end in .swc or the unit is another.
    """
    target = _named(path, ".swc")
    if unit not in METRES:
        raise ValueError(f"expected a unit of {', '.join(METRES)}, as SWC is in micrometres, got {unit!r}")
    rows: list[tuple[np.ndarray, float, int]] = []
    cuts: list[tuple[int, int]] = []
    for piece in nx.connected_components(graph):
        _lay_out(graph.subgraph(piece), rows, cuts)
    factor = METRES[unit] / METRES["um"]
    lines = ["# curvafit centreline: id type x y z radius parent, in micrometres"]
    lines += [f"# loop cut between points {end} and {node}" for end, node in cuts]
    for k, (place, radius, parent) in enumerate(rows, start=1):
        numbers = " ".join(f"{v * factor:.7g}" for v in (*place[::-1], radius))
        lines.append(f"{k} {UNDEFINED} {numbers} {parent}")
    return write_content(target, "\n".join(lines) + "\n")


def _lay_out(piece: nx.MultiGraph, rows: list[tuple[np.ndarray, float, int]], cuts: list[tuple[int, int]]) -> None:
    """Append a piece's points (place, radius, parent's id) and the pairs of ids that its cuts part."""
    root = max(piece, key=lambda node: (piece.nodes[node]["kind"] == "end", piece.nodes[node]["radius"]))
    rows.append((piece.nodes[root]["position"], piece.nodes[root]["radius"], -1))
    known = {root: len(rows)}
    for one, other, points, radii, kept in _edges_from(piece, root):
        parent = known[one]
        points = points + (rows[parent - 1][0] - points[0])
        for place, radius in zip(points[1:-1], radii[1:-1], strict=True):
            rows.append((place, float(radius), parent))
            parent = len(rows)
        if kept:
            rows.append((points[-1], piece.nodes[other]["radius"], parent))
            known[other] = len(rows)
        else:
            cuts.append((parent, known[other]))


def _edges_from(piece: nx.MultiGraph, root: int) -> Iterator[tuple[int, int, np.ndarray, np.ndarray, bool]]:
    """Yield edges with their points from the first node to the second: those of a tree of the widest from its root
    outwards, then those that are cut."""
    kept = {(*sorted(edge[:2]), edge[2]) for edge in nx.maximum_spanning_edges(piece, weight="radius", data=False)}
    tree = nx.Graph([(one, other, {"key": key}) for one, other, key in kept])
    tree.add_node(root)
    ordered = [(one, other, tree[one][other]["key"], True) for one, other in nx.bfs_edges(tree, root)]
    cut = [
        (one, other, key, False)
        for one, other, key in piece.edges(keys=True)
        if (*sorted((one, other)), key) not in kept
    ]
    for one, other, key, whole in ordered + cut:
        of = piece.edges[one, other, key]
        turn = slice(None, None, -1) if one > other else slice(None)
        yield one, other, of["points"][turn], of["radii"][turn], whole


def _named(path: str | Path, suffix: str) -> Path:
    target = Path(path)
    if target.suffix.lower() != suffix:
        raise ValueError(f"expected a name ending in {suffix}, got {target.name!r}")
    return target
