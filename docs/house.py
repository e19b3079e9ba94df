"""Draw the house: rooms on floors, and the imports between them, measured from the code.

    python docs/house.py                      # docs/house.webp, of this tree
    python docs/house.py --tree ../old -o before.png

A room is a folder of `curvafit/`, or a file beside the folders. A room stands one floor above the highest room that it
imports; faces (`__init__.py`) count for their own folder only. Prints the numbers of modules, rooms, floors and arrows,
and every arrow that runs back up or stays on a floor, of which there should be none.
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from pathlib import Path

import networkx as nx
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parent.parent
HOUSE, INK, ROOM, ARROW = "curvafit", "#20303c", "#dfe9f2", "#8fa3b3"
#: Sizes in the drawing's unit: a room's height, the gap between floors, a letter's width, the gap between rooms.
HEIGHT, STOREY, LETTER, GAP = 1.0, 1.9, 0.155, 0.45


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=Path, default=ROOT, help="a checkout that holds curvafit/")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "house.webp")
    options = parser.parse_args()
    package = options.tree / HOUSE
    lines, arrows = rooms(package), imports(package)
    graph = nx.DiGraph()
    graph.add_nodes_from(lines)
    graph.add_edges_from(arrows)
    circles = [group for group in nx.strongly_connected_components(graph) if len(group) > 1]
    floors = floors_of(graph)
    modules = sum(1 for _ in package.rglob("*.py"))
    print(f"{modules} modules, {len(lines)} rooms, {max(floors.values()) + 1} floors, {len(arrows)} arrows,", end=" ")
    print(f"{sum(floors[a] <= floors[b] for a, b in arrows)} of them up or level, {len(circles)} circles")
    picture(lines, arrows, floors).savefig(options.output, dpi=110, pil_kwargs={"lossless": True})
    print(options.output)


def room_of(path: Path, package: Path) -> str:
    """Return the room that a file belongs to: its folder, or itself beside the folders."""
    parts = path.relative_to(package).with_suffix("").parts
    return parts[0]


def rooms(package: Path) -> Counter[str]:
    """Return the lines of each room; the package's own face is none."""
    lines: Counter[str] = Counter()
    for path in package.rglob("*.py"):
        if (room := room_of(path, package)) != "__init__":
            lines[room] += len(path.read_text(encoding="utf-8").splitlines())
    return lines


def imports(package: Path) -> Counter[tuple[str, str]]:
    """Return how many modules of one room import modules of another; imports for the type checker alone count too."""
    arrows: Counter[tuple[str, str]] = Counter()
    for path in package.rglob("*.py"):
        room, targets = room_of(path, package), set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            targets |= {name.split(".")[1] for name in names if name.startswith(f"{HOUSE}.")}
        arrows.update((room, target) for target in targets - {room} if room != "__init__")
    return arrows


def floors_of(graph: nx.DiGraph) -> dict[str, int]:
    """Return each room's floor: the longest way down from it; rooms in a circle share one."""
    whole = nx.condensation(graph)
    depth: dict[int, int] = {}
    for part in reversed(list(nx.topological_sort(whole))):
        depth[part] = 1 + max((depth[below] for below in whole.successors(part)), default=-1)
    return {room: depth[part] for room, part in whole.graph["mapping"].items()}


def picture(lines: Counter[str], arrows: Counter[tuple[str, str]], floors: dict[str, int]) -> Figure:
    """Draw rooms as boxes, floor above floor, and the arrows that no longer way implies."""
    size = {room: max(len(room), len(f"{n} lines")) * LETTER + 0.5 for room, n in lines.items()}
    storeys = [sorted((room for room in lines if floors[room] == k), key=lambda r: -lines[r])
               for k in range(max(floors.values()) + 1)]  # fmt: skip
    widest = max(sum(size[room] + GAP for room in storey) for storey in storeys)
    figure = Figure(figsize=(max(7.0, widest * 0.62), (len(storeys) * STOREY + 0.4) * 0.5))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-widest / 2 - 0.3, widest / 2 + 0.3), ylim=(-0.4, len(storeys) * STOREY))
    axes.set_axis_off()
    middle = {}
    for k, storey in enumerate(storeys):
        left = -sum(size[room] + GAP for room in storey) / 2 + GAP / 2
        for room in storey:
            box = FancyBboxPatch((left, k * STOREY), size[room], HEIGHT, boxstyle="round,pad=0,rounding_size=0.12")
            box.set(facecolor=ROOM, edgecolor=INK, linewidth=1.0, zorder=2)
            axes.add_patch(box)
            middle[room] = left + size[room] / 2
            axes.text(middle[room], k * STOREY + 0.64, room, ha="center", va="center", fontsize=10, color=INK, zorder=3)
            axes.text(middle[room], k * STOREY + 0.28, f"{lines[room]} lines", ha="center", va="center", fontsize=7.5,
                      color=INK, alpha=0.7, zorder=3)  # fmt: skip
            left += size[room] + GAP
    direct = nx.transitive_reduction(nx.DiGraph(list(arrows))).edges if nx.is_directed_acyclic_graph(
        nx.DiGraph(list(arrows))) else arrows  # fmt: skip
    for a, b in direct:
        start, end = (middle[a], floors[a] * STOREY), (middle[b], floors[b] * STOREY + HEIGHT)
        axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=9, color=ARROW, linewidth=1.1,
                                       shrinkA=0, shrinkB=1, zorder=1))  # fmt: skip
    return figure


if __name__ == "__main__":
    main()
