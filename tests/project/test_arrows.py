"""Arrows run one way, down the floors of the house. Read from the imports, wherever they stand."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "curvafit"
WINGS = ("priors", "generation", "data_synth")
#: The house from the ground up. A folder (or a file at the root) imports from floors below its own.
FLOORS = (
    ("core",),
    ("priors",),
    ("generation", "volumes", "geometry"),
    ("scan", "drawing"),
    ("inference",),
    ("data_synth",),
    ("segmentation",),
    ("studies",),
    ("report",),
    ("cli", "napari", "nnunet"),
    ("__main__",),
)


def test_arrows_run_one_way() -> None:
    assert list(wrong_arrows(PACKAGE)) == []


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    assert find_cycle(module_graph(PACKAGE)) is None


@pytest.mark.parametrize(
    ("file", "line", "complaint"),
    [
        ("priors/energy.py", "from curvafit.generation.flow import generate", "priors may not import generation"),
        ("priors/energy.py", "import curvafit.volumes.write", "priors may not import volumes"),
        ("generation/flow.py", "from curvafit.geometry.diagram import diagram", "generation may not import geometry"),
        (
            "generation/flow.py",
            "def f():\n    from curvafit import x",
            "curvafit.generation.flow imports bare curvafit",
        ),
        ("geometry/mesh.py", "from curvafit.inference.fit import Fit", "geometry may not import inference"),
        ("inference/fit.py", "import curvafit.data_synth.atlas as i", "inference may not import data_synth"),
        ("data_synth/atlas.py", "import curvafit", "curvafit.data_synth.atlas imports bare curvafit"),
        ("data_synth/atlas.py", "from ..generation import flow", "curvafit.data_synth.atlas imports relatively"),
        ("report/page.py", "from curvafit.cli.app import main", "report may not import cli"),
        ("drawing/plot.py", "from priors import energy", "curvafit.drawing.plot imports through the link priors"),
    ],
)
def test_an_arrow_that_runs_back_is_found(tmp_path: Path, file: str, line: str, complaint: str) -> None:
    path = tmp_path / "curvafit" / file
    path.parent.mkdir(parents=True)
    path.write_text(line + "\n", encoding="utf-8")
    assert list(wrong_arrows(tmp_path / "curvafit")) == [complaint]


def test_a_circle_is_found(tmp_path: Path) -> None:
    for name, other in [("a", "b"), ("b", "c"), ("c", "a"), ("d", "a")]:
        (tmp_path / f"{name}.py").write_text(f"from {tmp_path.name}.{other} import x\n", encoding="utf-8")
    cycle = find_cycle(module_graph(tmp_path))
    assert cycle is not None
    assert {name.rpartition(".")[2] for name in cycle} == {"a", "b", "c"}


def wrong_arrows(package: Path) -> Iterator[str]:
    for path in sorted(package.rglob("*.py")):
        module = module_name(path, package)
        if module == "curvafit":
            continue
        part = module.split(".")[1]
        for target, level in imports(path):
            head, *rest = target.split(".")
            if level:
                yield f"{module} imports relatively"
            elif head in WINGS:
                yield f"{module} imports through the link {head}"
            elif head == "curvafit" and not rest:
                yield f"{module} imports bare curvafit"
            elif head == "curvafit" and not permitted(part, rest[0]):
                yield f"{part} may not import {rest[0]}"


def permitted(part: str, target: str) -> bool:
    return part == target or floor_of(target) < floor_of(part)


def floor_of(part: str) -> int:
    return next(floor for floor, rooms in enumerate(FLOORS) if part in rooms)


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Every imported module of a file with its relative level, wherever in the file it stands."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, 0) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "", node.level


def module_graph(package: Path) -> dict[str, set[str]]:
    """Each module with those it imports; `from a import b` is an arrow to `a`, or to `a.b` where that is a file."""
    files = {module_name(path, package): path for path in package.rglob("*.py")}
    files.pop(package.name, None)
    graph: dict[str, set[str]] = {}
    for module, path in files.items():
        targets = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                full = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= (full & files.keys()) or {node.module or ""}
        graph[module] = targets & files.keys()
    return graph


def find_cycle(graph: dict[str, set[str]]) -> list[str] | None:
    done: set[str] = set()

    def visit(node: str, trail: list[str]) -> list[str] | None:
        if node in trail:
            return trail[trail.index(node) :]
        if node in done:
            return None
        for target in sorted(graph[node]):
            found = visit(target, [*trail, node])
            if found:
                return found
        done.add(node)
        return None

    return next((found for node in sorted(graph) if (found := visit(node, []))), None)


def module_name(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
