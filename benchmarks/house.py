"""Lines and modules of the package, of the tests and of the benchmarks."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.harness import ROOT, Cases, Figure, show


def options(parser: argparse.ArgumentParser) -> None:
    del parser


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    package = _files("curvafit")
    figures = {
        "house.lines": _lines(package),
        "house.modules": sum(path.name != "__init__.py" for path in package),
        "house.test_lines": _lines(_files("tests")),
        "house.benchmark_lines": _lines(_files("benchmarks")),
    }
    show(["what", "count"], list(figures.items()))
    return {name: Figure(float(value)) for name, value in figures.items()}


def _files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def _lines(paths: list[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)
