"""What all benchmarks share: cases that a killed run keeps, intervals, timing in turns, scores, tables.

A case is one unit of work (one shape by one way, one training), and one line of `benchmarks/results/TOPIC.jsonl`:
values, seed, commit, processor, threads, seconds, date. Lines are appended as cases end, so that a killed run loses
only the case it was at; the last line of a name counts. A case that is there is not computed again, unless it is of
another commit and `--fresh` was asked for. Lines of figures (`claims`) stand in the same file. `--quick` runs the
smallest case, in an ignored folder, to see that the code runs; its figures are never recorded.
"""

from __future__ import annotations

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
#: What sentinels gave.
SENTINEL = RESULTS / "sentinel.jsonl"

Values = dict[str, Any]
#: Shared files that this process has made.
_RENEWED: set[Path] = set()


class Figure(NamedTuple):
    """A number that a benchmark states, with its 95 % interval where it has one."""

    value: float
    low: float | None = None
    high: float | None = None


# ---- lines of results ------------------------------------------------------------------------------------------------


def all_lines(path: Path, kind: str) -> Iterator[Values]:
    """Yield the lines of a kind (`case`, `figure`, `sentinel`) but for one that a killed run cut short."""
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if kind in line:
            yield line


def read_lines(path: Path, kind: str) -> dict[str, Values]:
    """Return the last line of each name of a kind."""
    return {line[kind]: line for line in all_lines(path, kind)}


def append_lines(path: Path, lines: Sequence[Values]) -> None:
    """Append lines; one that a killed run cut short ends first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cut = path.exists() and path.stat().st_size > 0 and not path.read_bytes().endswith(b"\n")
    with path.open("a", encoding="utf-8") as file:
        file.write("\n" * cut + "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines))


# ---- cases -----------------------------------------------------------------------------------------------------------


class Cases:
    """The cases of a topic (a module of `benchmarks`); none is begun when so many seconds are over."""

    def __init__(self, topic: str, *, quick: bool = False, fresh: bool = False, seconds: float = np.inf) -> None:
        self.topic, self.quick, self.fresh = topic, quick, fresh
        self.folder = CACHE / "quick" / topic if quick else CACHE / topic
        self.folder.mkdir(parents=True, exist_ok=True)
        self.path = self.folder / "cases.jsonl" if quick else RESULTS / f"{topic}.jsonl"
        self.end = time.monotonic() + seconds
        lines = {} if quick else read_lines(self.path, "case")
        self.kept = {name: line for name, line in lines.items() if not fresh or line["commit"] == commit()}
        self.left: list[str] = []

    def all(self, jobs: Mapping[str, Callable[[], Values]], seed: int | None = None) -> dict[str, Values]:
        """Return the values of the cases by name, in order; without those that the time did not reach."""
        for name, make in jobs.items():
            if name in self.kept:
                continue
            if time.monotonic() > self.end:
                self.left.append(name)
                continue
            begun = time.perf_counter()
            line = {"case": name, "values": make(), "seed": seed} | provenance()
            line["seconds"] = round(time.perf_counter() - begun, 2)
            append_lines(self.path, [line])
            self.kept[name] = line
            shown = ", ".join(f"{key} {_short(value)}" for key, value in line["values"].items())
            print(f"  {name}: {shown[:160]} ({line['seconds']:.0f} s)", flush=True)
        return {name: self.kept[name]["values"] for name in jobs if name in self.kept}

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

    def close(self) -> None:
        """Say what is left to do."""
        if self.left:
            print(f"{len(self.left)} cases left: run the same command again")


def data(*parts: str) -> Path:
    """Return a path in the folder of outside files."""
    if "CURVAFIT_DATA" not in os.environ:
        raise SystemExit("set CURVAFIT_DATA to the folder that holds gallery/ and scans/")
    return Path(os.environ["CURVAFIT_DATA"]).joinpath(*parts)


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


def provenance() -> Values:
    """Return commit, processor, threads and date of a figure that is measured now."""
    import torch

    date = datetime.now(UTC).strftime("%Y-%m-%d")
    return {"commit": commit(), "processor": processor(), "threads": torch.get_num_threads(), "date": date}


@lru_cache
def commit() -> str:
    """Return the short name of the commit, with + where files other than results differ from it."""
    git = ("git", "-C", str(ROOT))
    name = subprocess.run([*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", ".", ":!benchmarks/results"], check=False)
    return name.stdout.strip() + "+" * (changed.returncode == 1) or "unknown"


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


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


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
