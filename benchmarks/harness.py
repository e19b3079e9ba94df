"""What all benchmarks share: cases that a killed run keeps, intervals, timing in turns, tables.

A case is one unit of work (one shape by one way, one training), and its file is small JSON: values, seed, commit, hash
of the sources, processor, threads, seconds, date. Case files lie in an ignored folder; those of a run that took more
than ten minutes in all are moved to `benchmarks/results/`, to be committed. A case that is there is not computed again,
so that a killed run goes on. A case is stale if the code that it used has changed since: the benchmark says so and
still takes it, unless it is run with `--fresh`. `--quick` runs the smallest case, in a folder of its own, to see that
the code runs; its figures are never recorded.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
CACHE = ROOT / ".cache" / "benchmarks"
#: Seconds of a run above which its cases are committed.
LONG = 600.0
#: Modules whose changes make no case stale.
FRAME = ("benchmarks.harness", "benchmarks.claims", "benchmarks.__main__")

Values = dict[str, Any]
#: Shared files that this process has made.
_RENEWED: set[Path] = set()


class Figure(NamedTuple):
    """A number that a benchmark states, with its 95 % interval where it has one."""

    value: float
    low: float | None = None
    high: float | None = None


# ---- cases -----------------------------------------------------------------------------------------------------------


class Cases:
    """The cases of a topic (a module of `benchmarks`); none is begun when so many seconds are over."""

    def __init__(self, topic: str, *, quick: bool = False, fresh: bool = False, seconds: float = np.inf) -> None:
        self.topic, self.quick, self.fresh = topic, quick, fresh
        self.folder = CACHE / "quick" / topic if quick else CACHE / topic
        self.folder.mkdir(parents=True, exist_ok=True)
        self.end = time.monotonic() + seconds
        self.used: dict[str, Values] = {}
        self.left: list[str] = []
        self.stale: list[str] = []

    def all(self, jobs: Mapping[str, Callable[[], Values]], seed: int | None = None) -> dict[str, Values]:
        """Return the values of the cases by name, in order; without those that the time did not reach."""
        found: dict[str, Values] = {}
        for name, make in jobs.items():
            record = self._read(name)
            if record is None and time.monotonic() > self.end:
                self.left.append(name)
                continue
            if record is None:
                record = self._make(name, make, seed)
                said = ", ".join(f"{key} {_short(value)}" for key, value in record["values"].items())
                print(f"  {name}: {said[:160]} ({record['seconds']:.0f} s)", flush=True)
            self.used[name] = record
            found[name] = record["values"]
        return found

    def of(self, topic: str) -> Cases:
        """Return the cases of another topic, whose arrays and texts are shared."""
        return Cases(topic, quick=self.quick, fresh=self.fresh)

    def array(self, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
        """Return an array that cases share, such as a grown mask, from its file in the ignored folder."""
        path = self._kept(f"{name}.npz", lambda path: np.savez_compressed(path, value=make()))
        with np.load(path) as kept:
            return kept["value"]

    def text(self, name: str, make: Callable[[], str]) -> Path:
        """Return the file in the ignored folder of a text that cases share, such as a fit."""
        return self._kept(name, lambda path: path.write_text(make(), encoding="utf-8"))

    def _kept(self, name: str, write: Callable[[Path], object]) -> Path:
        path = self.folder / name
        if not path.exists() or (self.fresh and path not in _RENEWED):
            write_whole(path, write)
            _RENEWED.add(path)
        return path

    @property
    def seconds(self) -> float:
        """What the cases took when they were computed."""
        return sum(record["seconds"] for record in self.used.values())

    def close(self) -> None:
        """Move the cases of a long run to the committed folder, and say what is stale and what is left to do."""
        if not self.quick and self.seconds > LONG:
            for name in self.used:
                if (path := self._cached(name)).exists():
                    target = self._committed(name)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(target)
        if self.stale:
            print(f"{len(self.stale)} of {len(self.used)} cases are stale, of older code (--fresh computes them again)")
        if self.left:
            print(f"{len(self.left)} cases left: run the same command again")

    def _read(self, name: str) -> Values | None:
        for path in (self._cached(name), self._committed(name)):
            if path.exists() and not (self.quick and path == self._committed(name)):
                record = json.loads(path.read_text(encoding="utf-8"))
                if record["sources"] == sources_hash(f"benchmarks.{self.topic}"):
                    return record
                if not self.fresh:
                    self.stale.append(name)
                    return record
        return None

    def _make(self, name: str, make: Callable[[], Values], seed: int | None) -> Values:
        begun = time.perf_counter()
        values = make()
        record = {"topic": self.topic, "name": name, "values": values, "seed": seed}
        record |= provenance(self.topic) | {"seconds": round(time.perf_counter() - begun, 2)}
        text = json.dumps(record, ensure_ascii=False) + "\n"
        write_whole(self._cached(name), lambda temporary: temporary.write_text(text, encoding="utf-8"))
        return record

    def _cached(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def _committed(self, name: str) -> Path:
        return RESULTS / self.topic / f"{name}.json"


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name, and give it its own when it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".partial-{path.name}")
    write(temporary)
    temporary.replace(path)


def run_python(*words: object, python: str | Path = sys.executable, **environment: str) -> str:
    """Return what Python, or another one, prints in a process of its own; if it fails, end with its errors."""
    command, more = [str(python), *map(str, words)], os.environ | environment
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=more)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# ---- what a figure holds for -----------------------------------------------------------------------------------------


def provenance(topic: str) -> Values:
    """Return commit, hash of the sources, processor, threads and date of a figure that is measured now."""
    import torch

    return {
        "commit": commit(),
        "sources": sources_hash(f"benchmarks.{topic}"),
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


@lru_cache
def commit() -> str:
    """Return the short name of the commit, with + where files differ from it."""
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=7", "--dirty=+"]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


@lru_cache
def processor() -> str:
    """Return the processor's name, its family (which tells the generation of an EPYC) and its vectors."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return "unknown"
    name, family = (re.search(rf"{key}\s*: (.*)", text) for key in ("model name", "cpu family"))
    vectors = "AVX-512" if "avx512f" in text else "AVX2" if "avx2" in text else "no AVX2"
    zen = {"25": " (Zen 3 or 4)", "26": " (Zen 5)"}.get(family[1] if family else "", "")
    return f"{name[1] if name else 'unknown'}{zen}, {vectors}"


@lru_cache
def sources_hash(module: str) -> str:
    """Return the hash of the code of a module and of all that it imports from the package or from other benchmarks.

    Comments, docstrings and the layout do not count.
    """
    found = hashlib.sha256()
    for name in sorted(reached(module)):
        found.update(name.encode() + _code(name).encode())
    return found.hexdigest()[:16]


def reached(module: str) -> set[str]:
    """Return the names of a module and of all modules of ours that it imports, directly or not."""
    found, waiting = set[str](), [module]
    while waiting:
        name = waiting.pop()
        if name not in found and name not in FRAME:
            found.add(name)
            waiting += _imports(name)
    return found


@lru_cache
def _path(module: str) -> Path | None:
    if module.partition(".")[0] not in ("curvafit", "benchmarks"):
        return None
    base = ROOT.joinpath(*module.split("."))
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@lru_cache
def _tree(module: str) -> ast.Module:
    path = _path(module)
    assert path is not None, module
    return ast.parse(path.read_text(encoding="utf-8"))


@lru_cache
def _code(module: str) -> str:
    tree = ast.parse(ast.unparse(_tree(module)))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if (
            isinstance(body, list)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
        ):
            body[0].value = ast.Constant(None)
    return ast.dump(tree)


@lru_cache
def _imports(module: str) -> list[str]:
    """Return the modules that a module imports; a name that a package only passes on counts as its module's."""
    found: list[str] = []
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if _path(alias.name)]
        elif isinstance(node, ast.ImportFrom) and node.module and _path(node.module):
            found += [_home(node.module, alias.name) for alias in node.names]
    return found


@lru_cache
def _home(module: str, name: str) -> str:
    if _path(f"{module}.{name}"):
        return f"{module}.{name}"
    path = _path(module)
    if path is not None and path.name == "__init__.py":
        for node in ast.walk(_tree(module)):
            if not (isinstance(node, ast.ImportFrom) and node.module and _path(node.module)):
                continue
            if any(name == (alias.asname or alias.name) for alias in node.names):
                return _home(node.module, name)
    return module


# ---- statistics and time ---------------------------------------------------------------------------------------------


def bootstrap(
    values: Sequence[float] | np.ndarray, statistic: Callable[..., Any] = np.median, *, draws: int = 4000
) -> Figure:
    """Return a statistic of values `(n, …)` with the 95 % interval of the bootstrap over the first axis."""
    rows, random = np.asarray(values, dtype=float), np.random.default_rng(0)
    if len(rows) < 2:
        return Figure(float(statistic(rows, axis=0)))
    drawn = [statistic(rows[random.integers(len(rows), size=len(rows))], axis=0) for _ in range(draws)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Figure(float(statistic(rows, axis=0)), float(low), float(high))


def paired_ratio(after: Sequence[float], before: Sequence[float]) -> Figure:
    """Return the median of the ratios of pairs, after over before, with its interval."""
    return bootstrap(np.asarray(after) / np.asarray(before))


def in_turns(
    actions: Mapping[str, Callable[[], object]], rounds: int, *, warm: int = 1, before: int = 0
) -> dict[str, np.ndarray]:
    """Return the seconds `(rounds,)` of each action; they take turns, so that a busy machine slows all.

    The first `warm` turns do not count, nor do `before` calls ahead of each that does.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(rounds + warm):
        for name, action in actions.items():
            for _ in range(before):
                action()
            begun = time.perf_counter()
            action()
            if turn >= warm:
                times[name].append(time.perf_counter() - begun)
    return {name: np.array(taken) for name, taken in times.items()}


def scores(mask: np.ndarray, truth: np.ndarray) -> Values:
    """Return Dice, and the sum of the Betti numbers' errors."""
    from curvafit.geometry.topology import betti_numbers
    from curvafit.segmentation.trials import dice

    pairs = zip(betti_numbers(mask), betti_numbers(truth), strict=True)
    return {"dice": dice(mask, truth), "betti": float(sum(abs(a - b) for a, b in pairs))}


def best(masks: Iterator[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """Return the mask with the largest Dice: the best setting in hindsight."""
    from curvafit.segmentation.trials import dice

    return max(masks, key=lambda mask: dice(mask, truth))


# ---- tables ----------------------------------------------------------------------------------------------------------


def show(columns: Sequence[str], rows: Sequence[Sequence[object]], title: str = "") -> None:
    """Print a table; numbers with three decimals, unless they are texts already."""
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(row[k]) for row in [list(columns), *cells]) for k in range(len(columns))]
    print(f"\n{title}" if title else "")
    for row in [list(columns), *cells]:
        first, *others = (f"{cell:{'<' if not k else '>'}{widths[k]}}" for k, cell in enumerate(row))
        print("  ".join([first, *others]), flush=True)


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in lines)


def _cell(value: object) -> str:
    if isinstance(value, Figure):
        span = "" if value.low is None else f" ({value.low:.3g} to {value.high:.3g})"
        return f"{value.value:.4g}{span}"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
