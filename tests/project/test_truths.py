"""No truth test goes without notice: each that `tests/truths.txt` lists is there."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_truth_test_is_there() -> None:
    missing, there, count = [], set(), 0
    for line in (ROOT / "tests" / "truths.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("tests/"):
            tree = ast.parse((ROOT / line).read_text(encoding="utf-8"))
            there = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        elif line.startswith("    "):
            count += 1
            missing += [] if line.split()[0] in there else [line]
    assert missing == [] and count > 700
