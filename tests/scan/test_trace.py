"""The centreline of a scan: exact tubes, what the window cuts, units, files, refusals."""

import csv
import math
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from calling import call, done, refused
from exact import Sphere, Torus, Tubes, centres

from curvafit.priors.grid import Grid
from curvafit.scan import centreline
from curvafit.scan.centreline import Centreline, trace
from curvafit.scan.tiles import measure
from curvafit.volumes.volume import ScanError, Volume
from curvafit.volumes.write import save

pytestmark = pytest.mark.slow

CUBES, FLAT = (1.0, 1.0, 1.0), (1.5, 1.0, 0.75)
FAR, STEPS = 90.0, (9.1, 32.1, 55.1)
#: A cubic lattice that all faces of a window of 64 cut: a point is 23 from the next.
LATTICE = Tubes(3.4, tuple(np.array([np.insert([a, b], axis, end) for end in (-FAR, FAR)])
                           for axis in range(3) for a in STEPS for b in STEPS))  # fmt: skip
TREE = Tubes(3.4, tuple(np.array(line) for line in (
    [(8.2, 32.1, 31.8), (26.0, 32.1, 31.8)], [(26.0, 32.1, 31.8), (40.0, 12.0, 31.8)],
    [(26.0, 32.1, 31.8), (40.0, 52.0, 31.8)], [(40.0, 12.0, 31.8), (54.0, 12.0, 14.0)],
    [(40.0, 12.0, 31.8), (54.0, 12.0, 50.0)],
)))  # fmt: skip
TORUS = Torus(20.0, 3.4, (32.2, 31.8, 32.1))


def scan_of(shape: Tubes | Torus | Sphere, spacing: tuple[float, float, float] = CUBES, unit: str = "um") -> Volume:
    z, y, x = (round(64 / h) for h in spacing)
    inside = shape.distance(centres(Grid((z, y, x), spacing, "replicate"))) > 0
    return Volume(inside.numpy().astype(np.uint8), spacing, unit)


def traced(scan: Volume) -> Centreline:
    return trace(measure(scan, kind="mask", maps=True).convert(scan.unit))


@pytest.mark.parametrize("spacing", [CUBES, FLAT])
def test_a_lattice_that_the_window_cuts(spacing: tuple[float, float, float]) -> None:
    """Lengths to 2 %, loops exactly, radii to half a voxel; what is cut is no end, and counts as half a branch."""
    found = traced(scan_of(LATTICE, spacing))
    edges = [(round(64 / h) - 2 * m) * h for h, m in zip(spacing, found.margin, strict=True)]
    assert [m * h >= 3.4 for m, h in zip(found.margin, spacing, strict=True)] == [True] * 3
    length = 9 * sum(edges)
    assert found["length density"].value == pytest.approx(length / math.prod(edges), rel=0.02)
    assert (found["N.loops"].value, found["N.pieces"].value, found["N.ends"].value) == (28, 1, 0)
    assert found["N.branch points"].value == 27 and found["N.branches"].value == 54 + 54
    assert found["branch length"].value == pytest.approx(length / (27 * 3), rel=0.02)
    assert found["tortuosity"].value == pytest.approx(1, abs=0.02)
    radii = np.concatenate([data["radii"] for *_, data in found.graph.edges(data=True)])
    assert np.median(radii) == pytest.approx(3.4, abs=0.5)
    assert sum(data["cut"] for _, data in found.graph.nodes(data=True)) == 54


def test_a_window_of_eight_periods_has_intervals() -> None:
    steps = (8.1, 20.1, 32.1, 44.1, 56.1)
    lines = (np.insert([[a, b], [a, b]], axis, (-FAR, FAR), axis=1) for axis in range(3) for a in steps for b in steps)
    found = traced(scan_of(Tubes(2.5, tuple(lines))))
    for symbol in ("L.D", "J.D", "Br.L", "Br.T", "Br.R"):
        assert 0 <= found[symbol].half < 0.3 * found[symbol].value, symbol
    assert math.isnan(found["N.loops"].half)


def test_a_tube_that_grazes_the_window_is_left_out() -> None:
    """Its axis is outside: what lies on the face is no line of the structure."""
    grazing = np.array([(-2.0, -FAR, 32.0), (-2.0, FAR, 32.0)])
    through = np.array([(32.0, -FAR, 32.0), (32.0, FAR, 32.0)])
    found = traced(scan_of(Tubes(5.0, (grazing, through))))
    assert sum(row["length"] for row in found.rows()) == pytest.approx(61, abs=1)
    assert (found["N.branches"].value, found["N.pieces"].value) == (1, 2)


@pytest.mark.parametrize("spacing", [CUBES, FLAT])
def test_a_torus_is_one_branch_that_closes(spacing: tuple[float, float, float]) -> None:
    found = traced(scan_of(TORUS, spacing))
    (row,) = found.rows()
    assert (found["N.loops"].value, found["N.ends"].value, row["kinds"]) == (1, 0, "loop-loop")
    assert row["length"] == pytest.approx(2 * math.pi * 20, rel=0.02) and row["tortuosity"] is None
    assert row["mean radius"] == pytest.approx(3.4, abs=0.5 * min(spacing))
    assert math.isnan(found["tortuosity"].value)


def test_a_tree_has_ends_and_no_loop() -> None:
    """Lengths to 2 % and half a voxel at each end, which a ball closes."""
    found = traced(scan_of(TREE))
    length = sum(math.dist(a, b) for a, b in TREE.lines)
    assert sum(row["length"] for row in found.rows()) == pytest.approx(length, abs=0.02 * length + 4 * 0.5)
    assert [found[f"N.{name}"].value for name in ("branches", "branch points", "ends", "loops")] == [5, 2, 4, 0]
    assert not any(row["cut"] for row in found.rows())
    assert all(row["least radius"] <= row["mean radius"] < 4.4 for row in found.rows())


def test_a_ball_has_a_point() -> None:
    found = traced(scan_of(Sphere(9.0, (32.2, 31.8, 32.1))))
    assert not found.rows() and found["N.pieces"].value == 1 and found["length density"].value == 0


def test_lengths_follow_the_unit() -> None:
    scan = scan_of(TREE)
    found = traced(scan)
    measures = measure(scan, kind="mask", maps=True)
    small = trace(measures.convert("nm"))
    assert small["branch length"].value == pytest.approx(1e3 * found["branch length"].value)
    assert small["radius"].value == pytest.approx(1e3 * found["radius"].value)
    assert small["length density"].value == pytest.approx(1e-6 * found["length density"].value)


def test_what_cannot_be_traced_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    scan = scan_of(TREE)
    with pytest.raises(ValueError, match="with its maps"):
        trace(measure(scan, kind="mask"))
    monkeypatch.setattr(centreline, "MOST", 64**3 - 1)
    with pytest.raises(ScanError, match="crop the scan"):
        trace(measure(scan, kind="mask", maps=True))


def read_swc(path: Path) -> nx.DiGraph:
    graph = nx.DiGraph()
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        number, _, x, y, z, radius, parent = line.split()
        graph.add_node(int(number), point=np.array([float(z), float(y), float(x)]), radius=float(radius))
        if int(parent) > 0:
            assert int(parent) < int(number)  # as readers of SWC expect
            graph.add_edge(int(parent), int(number))
    return graph


@pytest.mark.parametrize("shape", [TREE, TORUS, LATTICE], ids=["tree", "torus", "lattice"])
def test_swc_is_a_tree_of_the_same_length(shape: Tubes | Torus, tmp_path: Path) -> None:
    found = traced(scan_of(shape))
    graph = read_swc(found.write_swc(tmp_path / "line.swc"))
    assert nx.is_forest(graph) and nx.number_weakly_connected_components(graph) == 1
    length = sum(np.linalg.norm(graph.nodes[a]["point"] - graph.nodes[b]["point"]) for a, b in graph.edges)
    assert length == pytest.approx(sum(row["length"] for row in found.rows()), rel=1e-4)
    tips, others = ([of["point"] for node, of in graph.nodes(data=True) if (graph.out_degree(node) == 0) == tip]
                    for tip in (True, False))  # fmt: skip
    copies = sum(any(np.allclose(tip, other, atol=1e-4) for other in others) for tip in tips)
    assert copies == found["N.loops"].value  # each loop is opened where a branch meets the others


def test_the_command_writes_page_table_and_files(tmp_path: Path) -> None:
    scan = save(scan_of(LATTICE), tmp_path / "tubes.nii.gz")
    done("measure", scan, "--graph", "-o", tmp_path / "out")
    page = (tmp_path / "out" / "measures.html").read_text(encoding="utf-8")
    assert "The centreline" in page and "branch point density" in page
    with (tmp_path / "out" / "branches.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 108 and {row["unit"] for row in rows} == {"um"}
    graph = nx.read_graphml(tmp_path / "out" / "centreline.graphml", node_type=int, force_multigraph=True)
    assert graph.number_of_edges() == 108 and graph.graph["unit"] == "um"
    assert (tmp_path / "out" / "centreline.svg").exists() and not (tmp_path / "out" / "structure.nii.gz").exists()
    for words in ([scan, scan], [scan, "--windows", "16"], [scan, "--roi", scan], [scan, "--periodic"]):
        refused(call("measure", *words, "--graph", "-o", tmp_path / "other"), "--graph", progress=True)
    refused(call("measure", scan, "--graph"), "--graph", progress=True)
