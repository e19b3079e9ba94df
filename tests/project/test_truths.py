"""No truth test goes without notice: each that `tests/truths.txt` lists is there."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_truth_test_is_there() -> None:
    lines = (ROOT / "tests" / "truths.txt").read_text(encoding="utf-8").splitlines()
    listed: dict[str, set[str]] = {}
    for line in lines:
        if line.startswith("tests/"):
            file = listed.setdefault(line, set())
        elif line.startswith("    "):
            file.add(line.split()[0])
    assert sum(map(len, listed.values())) > 800
    missing = {name: tests - functions(ROOT / name) for name, tests in listed.items()}
    assert {name: tests for name, tests in missing.items() if tests} == {}


def functions(path: Path) -> set[str]:
    """The names of all functions in a file of tests."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
