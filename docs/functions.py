"""Functions of the package: how long they are, how many parameters they have, and some of them to read.

`python docs/functions.py` prints the 90th percentile and the most of the lines of a function, docstring and all, and
the most parameters of one; kernels, which numba compiles, are left out of the last two. `--draw 60` prints so many
functions of eight lines or more, drawn by the last commit that changed the package: to be read as a stranger would.
"""

from __future__ import annotations

import argparse
import ast
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np

PACKAGE = Path(__file__).resolve().parents[1] / "curvafit"
#: The fewest lines of a function that is drawn.
SHORTEST = 8


def functions() -> Iterator[tuple[Path, ast.FunctionDef]]:
    """Yield every function and method, with its file."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def length(function: ast.FunctionDef) -> int:
    """Return the lines of a function without its decorators."""
    return (function.end_lineno or 0) - function.lineno + 1


def parameters(function: ast.FunctionDef) -> int:
    """Return how many parameters a function has, `self` and `**options` aside."""
    own = [each.arg for each in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len(own) - (own[:1] in (["self"], ["cls"]))


def main() -> None:
    """Print the numbers, or functions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", type=int, default=0)
    options, every = parser.parse_args(), list(functions())
    if options.draw:
        last = ("git", "log", "-1", "--format=%H", "--", PACKAGE.name)
        seed = subprocess.run(last, cwd=PACKAGE.parent, capture_output=True, text=True, check=True).stdout.strip()
        long = [(path, node) for path, node in every if length(node) >= SHORTEST]
        for number, (path, node) in enumerate(random.Random(seed).sample(long, options.draw), 1):
            lines = path.read_text("utf-8").split("\n")
            print(f"## {number}. {path.relative_to(PACKAGE.parent)}: {node.name}\n")
            print("\n".join(lines[node.lineno - 1 : node.end_lineno]), end="\n\n")
        return
    plain = [(path, node) for path, node in every if "kernels" not in path.parts]
    print(f"{len(every)} functions, 90th percentile {np.quantile([length(node) for _, node in every], 0.9):.0f} lines")
    for name, measure in (("lines", length), ("parameters", parameters)):
        path, node = max(plain, key=lambda each: measure(each[1]))
        print(f"most {name}: {measure(node)}, {path.relative_to(PACKAGE)} {node.name}")


if __name__ == "__main__":
    main()
