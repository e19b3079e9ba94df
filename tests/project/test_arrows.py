"""Arrows run one way, down the floors of the house. Read from the imports, wherever they stand."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "curvafit"
WINGS = ("priors", "generation", "data_synth")
#: The house from the ground up. A folder (or a file at the root) imports from floors below its own.
FLOORS = (
    ("core",), ("priors",), ("generation", "volumes", "geometry"), ("scan", "drawing"), ("inference",), ("data_synth",),
    ("segmentation",), ("studies",), ("report",), ("cli", "napari", "nnunet"), ("__main__",),
)  # fmt: skip


def test_arrows_run_one_way() -> None:
    for module, line in {
        "priors.energy": "from curvafit.generation.flow import generate", "report.page": "from ..scan import a",
        "generation.flow": "def f():\n    from curvafit import generate", "drawing.plot": "from priors import energy",
    }.items():  # fmt: skip
        assert complaints(f"curvafit.{module}", line) != []
    for path in PACKAGE.rglob("*.py"):
        module = module_name(path)
        assert module == "curvafit" or complaints(module, path.read_text(encoding="utf-8")) == []


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    files = {module_name(path): path for path in PACKAGE.rglob("*.py")}
    graph = {}
    for module, path in files.items():
        names = [name for name, _ in imports(path.read_text(encoding="utf-8"))]
        targets = {name if name in files else name.rpartition(".")[0] for name in names}
        graph[module] = targets & files.keys() - {"curvafit", module}
    graphlib.TopologicalSorter(graph).prepare()
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(graph | {"curvafit.core.checks": {"curvafit.cli.app"}}).prepare()


def complaints(module: str, text: str) -> list[str]:
    """The imports of a module that its floor does not permit; names are imported from where they are made."""
    own, found = module.split(".")[1], []
    for name, level in imports(text):
        head, *rest = name.split(".")
        if level or head in WINGS or (head == "curvafit" and not permitted(own, rest[0])):
            found.append(f"{module}: {name}")
    return found


def permitted(own: str, target: str) -> bool:
    floors = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
    return own == target or floors.get(target, len(FLOORS)) < floors[own]


def imports(text: str) -> Iterator[tuple[str, int]]:
    """Every imported name, as far as it may be a module, with its relative level, wherever in the text it stands."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from ((f"{alias.name}.*", 0) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((f"{node.module or ''}.{alias.name}", node.level) for alias in node.names)


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
