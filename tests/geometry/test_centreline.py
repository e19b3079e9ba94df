"""Centreline graphs of shapes whose axes are known, and their files."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import torch
from exact import Sphere, Torus, Tubes, centres, helix, optimal_profile
from scipy import ndimage

from curvafit.data_synth.labels import labels_of
from curvafit.geometry.centreline import centreline, skeleton_of, write_graphml
from curvafit.geometry.topology import betti_numbers
from curvafit.priors.grid import Grid

pytestmark = pytest.mark.slow

CUBES, FLAT = (1.0, 1.0, 1.0), (1.5, 1.0, 0.75)
MIDDLE = (24.2, 23.8, 24.1)
Y = [(24.2, 23.8, 24.1), (24.2, 23.8, 6.0), (24.2, 36.0, 38.0), (24.2, 11.0, 38.0)]
SPIRAL = helix(11.0, 15.0, 2.0, (9.0, 24.2, 23.9))


def cube(spacing: tuple[float, float, float], boundary: str = "replicate") -> Grid:
    """48 units of length along each axis."""
    z, y, x = (round(48 / h) for h in spacing)
    return Grid((z, y, x), spacing, boundary)  # type: ignore[arg-type]


def graph_of(distance: torch.Tensor, box: Grid) -> nx.MultiGraph:
    found = labels_of(optimal_profile(distance, 2.0), box, 2.0, ("skeleton", "distance"))
    return centreline(found["skeleton"], found["distance"], box.spacing)


def kinds(graph: nx.MultiGraph) -> Counter[str]:
    return Counter(kind for _, kind in graph.nodes(data="kind"))


def total(graph: nx.MultiGraph) -> float:
    return sum(length for *_, length in graph.edges(data="length"))


def cycle_rank(graph: nx.MultiGraph) -> int:
    """Independent cycles of edges, with the rings within junctions: the b1 of the skeleton, hence of its mask."""
    edges = graph.number_of_edges() - graph.number_of_nodes() + nx.number_connected_components(graph)
    return edges + sum(graph.nodes[node]["rings"] for node in graph)


BRANCHES = Tubes(4.0, tuple(np.array([Y[0], end]) for end in Y[1:]))
TUBE = np.array([(14.2, 10.0, 8.0), (34.0, 38.0, 40.0)])
#: Shapes, the kinds of their nodes, their cycles, and their length.
SHAPES: dict[str, tuple[Any, dict[str, int], int, float]] = {
    "tube": (Tubes(4.0, (TUBE,)), {"end": 2}, 0, math.dist(*TUBE)),
    "helix": (Tubes(3.0, (SPIRAL,)), {"end": 2}, 0, 2 * math.hypot(2 * math.pi * 11, 15)),
    "torus": (Torus(14.0, 4.0, MIDDLE), {"loop": 1}, 1, 2 * math.pi * 14),
    "junction": (BRANCHES, {"end": 3, "junction": 1}, 0, sum(math.dist(Y[0], end) for end in Y[1:])),
    "ball": (Sphere(9.0, MIDDLE), {"point": 1}, 0, 0.0),
}


@pytest.mark.parametrize("spacing", [CUBES, FLAT])
@pytest.mark.parametrize("name", SHAPES)
def test_nodes_lengths_radii_and_places(name: str, spacing: tuple[float, float, float]) -> None:
    """Lengths to 4 % and what an end may be short or long of its ball's centre; mean
    radii to a fifth of a voxel, points to half of one."""
    shape, expected, cycles, length = SHAPES[name]
    box = cube(spacing)
    graph = graph_of(shape.distance(centres(box)), box)
    assert kinds(graph) == expected and cycle_rank(graph) == cycles
    assert nx.number_connected_components(graph) == 1
    ends = kinds(graph)["end"]
    assert abs(total(graph) - length) <= 0.04 * length + ends * 2.5
    for *_, of in graph.edges(data=True):
        points, radii = of["points"], of["radii"]
        assert len(points) == len(radii) and of["length"] > 0
        radius = shape.radius if isinstance(shape, Tubes) else shape.minor
        middle = slice(4, -4) if name != "torus" else slice(None)
        assert abs(of["radius"] - radius) < 0.2 * max(spacing)
        assert np.abs(radii[middle] - radius).max() < 0.4 * max(spacing)
        # `centres` counts from the box's corner, graphs from the first voxel's centre
        off = shape.distance(torch.from_numpy(points + np.array(spacing) / 2)).numpy()
        assert (radius - off)[middle].max() < 0.5 * max(spacing)


def test_a_crop_s_tube_goes_from_face_to_face() -> None:
    box = Grid((32, 32, 40), 1.0, "replicate")  # type: ignore[arg-type]
    distance = Tubes(5.0, (np.array([(16.2, 15.8, -40.0), (16.2, 15.8, 80.0)]),)).distance(centres(box))
    graph = graph_of(distance, box)
    assert kinds(graph) == {"end": 2} and total(graph) == pytest.approx(39, abs=0.5)
    assert sorted(round(of["position"][2]) for _, of in graph.nodes(data=True)) == [0, 39]


@pytest.mark.parametrize(
    "noise", [None, (0, 1.8, 0.8), (1, 1.0, 0.5), (2, 1.2, -0.1), (3, 3.0, 0.0)], ids=["labyrinth", *"0123"]
)
def test_cycles_are_the_tunnels(labyrinth, noise: tuple[int, float, float] | None) -> None:
    """Of a labyrinth without cavities and of random masks, however dense; with the rings within junctions; the pieces
    are the pieces."""
    field, box = labyrinth[0], Grid((32, 32, 32), boundary="replicate")
    if noise is not None:
        seed, width, level = noise
        box = Grid((21, 24, 29), FLAT, "replicate")
        smooth = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(box.shape), width, mode="wrap")
        field = torch.from_numpy(smooth / smooth.std() - level)
    found = labels_of(field, box, 0.02 if noise is None else 1.0, ("skeleton", "distance", "betti"))
    graph = centreline(found["skeleton"], found["distance"], box.spacing)
    assert betti_numbers(found["skeleton"]) == found["betti"] and found["betti"][1] > 0
    assert (nx.number_connected_components(graph), cycle_rank(graph)) == found["betti"][:2]
    loops = [length for *_, length in nx.selfloop_edges(graph, data="length")]
    assert all(length >= max(box.spacing) for length in loops)  # shorter ones are no branches


def test_a_rough_surface_does_not_sprout() -> None:
    """A rough wall of a tube (deviation a voxel) makes spurs, which pruning takes away; the tube stays in one."""
    box = Grid((40, 40, 64), 1.0, "replicate")  # type: ignore[arg-type]
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal(box.shape), 1.5)
    distance = Tubes(6.0, (np.array([(20.2, 19.8, -30.0), (20.2, 19.8, 94.0)]),)).distance(centres(box))
    rough = distance + torch.from_numpy(noise / noise.std())
    skeleton = labels_of(optimal_profile(rough, 2.0), box, 2.0, "skeleton")["skeleton"]
    neighbours = ndimage.convolve(skeleton.astype(int), np.ones((3, 3, 3), dtype=int), mode="constant") - 1
    assert (neighbours[skeleton] > 2).sum() > 1  # the wall does make spurs
    graph = graph_of(rough, box)
    assert kinds(graph) == {"end": 2} and 63 < total(graph) < 75


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("radius", [1.3, 2.2, 4.0])
def test_a_tube_of_an_even_width_stays(radius: float, axis: int) -> None:
    """Along an axis, thinning in the order of voxels eats it from its end (scikit-image's `skeletonize` deletes it)."""
    shape = tuple(64 if k == axis else 24 for k in range(3))
    line = np.array([np.insert([12.0, 12.0], axis, end) for end in (12.0, 52.0)])
    box = Grid(shape, 1.0, "replicate")  # type: ignore[arg-type]
    mask = Tubes(radius, (line,)).distance(centres(box)).numpy() > 0
    distance = ndimage.distance_transform_edt(mask)
    graph = centreline(skeleton_of(distance), distance, (1.0, 1.0, 1.0))
    assert kinds(graph) == {"end": 2} and total(graph) == pytest.approx(40, abs=4)


def test_graphml_reads_back(tmp_path: Path) -> None:
    box = cube(FLAT)
    graph = graph_of(SHAPES["junction"][0].distance(centres(box)), box)
    path = write_graphml(graph, tmp_path / "y.graphml", "um")
    read = nx.read_graphml(path, node_type=int, force_multigraph=True)
    assert read.graph["unit"] == "um" and nx.utils.graphs_equal(nx.Graph(read.edges()), nx.Graph(graph.edges()))
    for node, of in graph.nodes(data=True):
        assert [read.nodes[node][k] for k in "zyx"] == pytest.approx(of["position"])
        assert (read.nodes[node]["kind"], read.nodes[node]["radius"]) == (of["kind"], pytest.approx(of["radius"]))
    for one, other, of in read.edges(data=True):
        points = np.array([[float(v) for v in point.split()] for point in of["points"].split(",")])
        kept = graph.edges[one, other, 0]
        assert points == pytest.approx(kept["points"], rel=1e-6) and of["length"] == pytest.approx(kept["length"])
        assert points[0] == pytest.approx(graph.nodes[min(one, other)]["position"], rel=1e-6)
        assert len(of["radii"].split()) == len(points)
    assert not list(tmp_path.glob(".*"))
