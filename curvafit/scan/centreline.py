"""The centreline of a scan's structure: branches with length, tortuosity and radius, their densities, and files."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from curvafit.core.files import write_content
from curvafit.core.units import convert_length
from curvafit.geometry.centreline import centreline, skeleton_of, write_graphml
from curvafit.geometry.morphology import smooth_surface
from curvafit.geometry.topology import betti_numbers
from curvafit.scan.measures import LEAST, Blocks, Formula, Measures, Quantity, combine, errors, find_quantity
from curvafit.volumes.volume import ScanError

#: Most voxels of a scan, which is traced as a whole.
MOST = 400**3
#: Ends nearer to a face, in voxels, are cut by the window.
FACE = 2.0
#: A radius is the mean distance to so many triangles, the nearest ones; that of one is a tenth of a voxel too small.
TRIANGLES = 16
#: What is summed over blocks: volume, length, ∫ radius, half of the ends of branches; length and distance between the
#: ends of branches that do not close on themselves; branch points and free ends.
SUMS = ("volume", "length", "∫r", "branches", "open", "distance", "branch points", "ends")
#: Name, symbol and power of each density and mean, and how it comes from sums.
QUANTITIES: tuple[Formula, ...] = (
    ("length density", "L.D", -2, lambda s: s["length"] / s["volume"]),
    ("branch point density", "J.D", -3, lambda s: s["branch points"] / s["volume"]),
    ("end density", "E.D", -3, lambda s: s["ends"] / s["volume"]),
    ("branch length", "Br.L", 1, lambda s: s["length"] / s["branches"]),
    ("tortuosity", "Br.T", 0, lambda s: s["open"] / s["distance"]),
    ("radius", "Br.R", 1, lambda s: s["∫r"] / s["length"]),
)
#: Nodes of a kind that are counted.
KINDS = {"junction": "branch points", "end": "ends"}


@dataclass(frozen=True, eq=False)
class Centreline:
    """The centreline of a structure, with lengths in `unit`.

    Attributes
    ----------
    graph
        Nodes with `position` (z, y, x) from the first voxel's centre, `radius`, `kind` ("end", "junction", "point",
        "loop") and `cut`, whether the window cuts there; edges with `points` (N, 3), `radii` (N,), `length`, `radius`.
    quantities
        Densities and means (`QUANTITIES`) with 95 % intervals, and counts of the window.
    margin
        Voxels along z, y, x from the window's faces that densities and means leave out: the median radius, since the
        axis of a tube that grazes a face lies outside.
    """

    source: str
    unit: str
    graph: nx.MultiGraph
    quantities: tuple[Quantity, ...]
    margin: tuple[int, int, int]

    def __getitem__(self, name: str) -> Quantity:
        """Return the quantity of a name or a symbol; raise KeyError where there is none."""
        return find_quantity(self.quantities, name)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each branch: its nodes and their kinds, length, distance of its ends, tortuosity, radii."""
        rows, nodes = [], self.graph.nodes
        for k, (one, other, data) in enumerate(self.graph.edges(data=True), 1):
            ends = [nodes[node] for node in (one, other)]
            distance = float(np.linalg.norm(data["points"][-1] - data["points"][0]))
            cells = {"branch": k, "node": one, "other node": other, "kinds": "-".join(end["kind"] for end in ends)}
            cells |= {"cut": any(end["cut"] for end in ends), "length": data["length"], "distance": distance}
            cells |= {"tortuosity": data["length"] / distance if distance else None, "mean radius": data["radius"]}
            rows.append(cells | {"least radius": float(data["radii"].min()), "unit": self.unit})
        return rows

    def write_graphml(self, path: str | Path) -> Path:
        """Write GraphML, with the attributes of the graph."""
        return write_graphml(self.graph, path, self.unit)

    def write_swc(self, path: str | Path) -> Path:
        """Write SWC, a forest: the branch that closes a loop ends in a copy of the point where it meets the others."""
        lines = [f"# curvafit centreline, lengths in {self.unit}", "# id type x y z radius parent"]
        ids = dict[int, int]()

        def add(point: np.ndarray, radius: float, parent: int) -> int:
            number = len(lines) - 1
            lines.append(f"{number} 0 {' '.join(f'{v:.6g}' for v in (*point[::-1], radius))} {parent}")
            return number

        for piece in sorted(map(sorted, nx.connected_components(self.graph))):
            root = self.graph.nodes[piece[0]]
            ids[piece[0]] = add(root["position"], root["radius"], -1)
            for one, other, key in nx.edge_bfs(self.graph, piece[0]):
                data, parent = self.graph.edges[one, other, key], ids[one]
                forward = slice(1, None) if one <= other else slice(-2, None, -1)
                for point, radius in zip(data["points"][forward], data["radii"][forward], strict=True):
                    parent = add(point, radius, parent)
                ids.setdefault(other, parent)
        return write_content(Path(path), ("\n".join(lines) + "\n").encode())


def trace(measures: Measures) -> Centreline:
    """Trace the centreline of a scan that was measured with `maps`, by thinning that keeps its topology.

    Lengths are in the measures' unit; radii are distances to the smoothed surface. Raises ValueError without maps, of
    part of a scan, or of more than `MOST` voxels.
    """
    volume = measures.maps.get("structure")
    if volume is None or measures.compartments:
        raise ValueError("expected a whole scan that was measured with its maps")
    mask, scale = volume.values > 0, convert_length(1.0, volume.unit, measures.unit)
    if mask.size > MOST:
        raise ScanError(f"expected at most {MOST:,} voxels, since a centreline is traced as a whole: crop the scan")
    edges = (scale * volume.spacing[0], scale * volume.spacing[1], scale * volume.spacing[2])
    spacing = np.array(edges)
    distance = np.asarray(ndimage.distance_transform_edt(mask, edges)).astype(np.float32)
    skeleton = skeleton_of(distance)
    # Near the lines, where radii are read, distances are to the surface and not to the voxels outside.
    near = np.argwhere(ndimage.binary_dilation(skeleton, np.ones((3, 3, 3)), 2))
    triangles = KDTree(smooth_surface(mask, edges).barycentres)
    inside = np.where(mask[tuple(near.T)], 1, -1)
    distance[tuple(near.T)] = inside * triangles.query(near * spacing, TRIANGLES)[0].mean(1)
    # Of a tube that grazes a face there is a line on the face: what lies there is taken away.
    graph = centreline(np.pad(skeleton[1:-1, 1:-1, 1:-1], 1), distance, edges)
    last, radii = np.array(mask.shape) - 1, [data["radius"] for *_, data in graph.edges(data=True)]
    for _, data in graph.nodes(data=True):
        place = data["position"] / spacing
        data["cut"] = data["kind"] in ("end", "point") and bool(((place < FACE) | (place > last - FACE)).any())
    graph.remove_nodes_from([node for node, data in graph.nodes(data=True) if data["cut"] and data["kind"] == "point"])
    pieces, loops, _ = betti_numbers(mask)
    nodes = Counter(KINDS.get(data["kind"]) for _, data in graph.nodes(data=True) if not data["cut"])
    counts = {"branches": graph.number_of_edges()} | {name: nodes[name] for name in KINDS.values()}
    counts |= {"loops": loops, "pieces": pieces}
    numbers = (Quantity(name, f"N.{name}", float(value), math.nan, 0) for name, value in counts.items())
    margin = np.minimum(np.ceil(np.median(radii or edges) / spacing), last // 4).astype(int)
    quantities = _summarise(graph, last + 1 - 2 * margin, margin, spacing, measures)
    return Centreline(measures.source, measures.unit, graph, (*quantities, *numbers), tuple(margin.tolist()))


def _summarise(
    graph: nx.MultiGraph, shape: np.ndarray, margin: np.ndarray, spacing: np.ndarray, measures: Measures
) -> tuple[Quantity, ...]:
    """Return densities and means within a margin of the faces, with the intervals of blocks of a period."""
    blocks = Blocks.divide(shape.tolist(), spacing.tolist(), measures["Tb.Th"].value + measures["Tb.Sp"].value)
    table = np.zeros((blocks.count, len(SUMS)))
    table[:, 0] = math.prod(spacing) * blocks.sums(np.ones(shape, bool))

    def count(name: str, places: np.ndarray, values: Any) -> None:
        voxels, weights = np.atleast_2d(places) / spacing - margin, np.atleast_1d(values)
        inside = ((voxels > -0.5) & (voxels < shape - 0.5)).all(1)
        table[:, SUMS.index(name)] += blocks.gather(voxels[inside], weights[inside, None])[:, 0]

    for *_, data in graph.edges(data=True):
        points, radii = data["points"], data["radii"]
        lengths, middles = np.linalg.norm(np.diff(points, axis=0), axis=1), (points[1:] + points[:-1]) / 2
        count("length", middles, lengths)
        count("∫r", middles, lengths * (radii[1:] + radii[:-1]) / 2)
        if distance := float(np.linalg.norm(points[-1] - points[0])):
            count("open", points[len(points) // 2], data["length"])
            count("distance", points[len(points) // 2], distance)
    for node, data in graph.nodes(data=True):
        if data["cut"]:
            continue
        count("branches", data["position"], graph.degree(node) / 2)
        if data["kind"] in KINDS:
            count(KINDS[data["kind"]], data["position"], 1.0)
    figures = partial(combine, names=SUMS, quantities=QUANTITIES)
    halves = errors(table, blocks, figures) if blocks.count >= LEAST else np.full(len(QUANTITIES), np.nan)
    found = zip(QUANTITIES, figures(table.sum(0)), halves, strict=True)
    return tuple(Quantity(*names[:2], float(value), float(half), names[2]) for names, value, half in found)
