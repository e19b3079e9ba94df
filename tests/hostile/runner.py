"""Run cases, some at once, each in a folder of its own; count what went wrong by class."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import multiprocessing
import os
import shlex
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .case import COLUMNS, Case, Fault, Place, dice
from .catalogue import all_cases, quick_part
from .judge import judged
from .larder import fill

#: Libraries that commands need, imported once.
_HEAVY = (
    "numpy torch zarr nibabel h5py tifffile SimpleITK nrrd mrcfile pydicom numba scipy.ndimage skimage.filters yaml "
    "matplotlib.figure matplotlib.image matplotlib.backends.backend_agg trimesh"
)
_HEADS = {
    "tracebacks": "tracebacks",
    "lost": "files lost",
    "torn": "half-written",
    "misread": "read as data",
    "hung": "hung",
    "wrong": "wrong exit",
}


def run_suite(options: argparse.Namespace) -> int:
    """Everything that the options ask for; 1 where a case went wrong."""
    cases = _chosen(options)
    if options.list:
        print(*(case.id for case in cases), sep="\n")
        return 0
    since = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="hostile-")).resolve()
    folder.chmod(0o755)
    os.environ["CURVAFIT_CACHE"] = str(folder / "cache")
    try:
        _import_all()
        fill(folder / "larder")
        print(f"{len(cases)} cases; inputs made in {time.monotonic() - since:.0f} s", flush=True)
        found = _run_all(cases, folder, options)
    finally:
        if options.case is None:
            shutil.rmtree(folder, ignore_errors=True)
    faults = {case.id: found.get(case.id, [Fault("tracebacks", "the case itself did not end")]) for case in cases}
    _print_table(cases, faults, time.monotonic() - since)
    if options.case is not None:
        _show(cases[0], folder, faults[cases[0].id])
    if options.report:
        _write_report(Path(options.report), cases, faults, options)
    return int(any(faults.values()))


def _chosen(options: argparse.Namespace) -> list[Case]:
    cases = all_cases(options.seed)
    if options.case:
        cases = [case for case in cases if case.id == options.case]
    if options.only:
        cases = [case for case in cases if case.id.startswith(options.only)]
    if options.quick:
        cases = quick_part(cases, options.seed)
    if not cases:
        raise SystemExit("expected the name of a case or a class, got one that there is not; --list shows them")
    return cases


def _import_all() -> None:
    """What children would import otherwise, each for itself."""
    import curvafit

    for name in _HEAVY.split():
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for name in dir(curvafit):
        with contextlib.suppress(Exception):
            getattr(curvafit, name)
    importlib.import_module("curvafit.cli.app")
    for path in sorted(Path(curvafit.__file__).parent.glob("**/*.py")):
        parts = path.relative_to(Path(curvafit.__file__).parent).with_suffix("").parts
        if parts[0] not in ("nnunet", "napari") and not parts[-1].startswith("__") and "cuda" not in parts[-1]:
            with contextlib.suppress(Exception):
                importlib.import_module(".".join(("curvafit", *parts)))


def _run_all(cases: Sequence[Case], folder: Path, options: argparse.Namespace) -> dict[str, list[Fault]]:
    """Some processes, each of which takes the next case until there is none."""
    turn, sheets = multiprocessing.get_context("fork").Value("l", 0), []
    children = []
    for k in range(max(1, min(options.jobs, len(cases)))):
        sheets.append(folder / f"results-{k}.jsonl")
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            with contextlib.suppress(BaseException):
                _take_turns(cases, folder, options, turn, sheets[-1])
            os._exit(0)
        children.append(pid)
    try:
        for pid in children:
            os.waitpid(pid, 0)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    rows = [json.loads(line) for sheet in sheets if sheet.exists() for line in sheet.read_text().splitlines()]
    slow = sorted(((row["seconds"], row["id"]) for row in rows), reverse=True)[:5]
    print("slowest:", ", ".join(f"{name} {seconds:.0f} s" for seconds, name in slow), flush=True)
    return {row["id"]: [Fault(*pair) for pair in row["faults"]] for row in rows}


def _take_turns(cases: Sequence[Case], folder: Path, options: argparse.Namespace, turn: Any, sheet: Path) -> None:
    with sheet.open("w", encoding="utf-8", buffering=1) as stream:
        while True:
            with turn.get_lock():
                mine, turn.value = turn.value, turn.value + 1
            if mine >= len(cases):
                return
            since = time.monotonic()
            found = played(cases[mine], folder, mine, options)
            row = {"id": cases[mine].id, "seconds": time.monotonic() - since, "faults": found}
            stream.write(json.dumps(row) + "\n")


def played(case: Case, folder: Path, number: int, options: argparse.Namespace) -> list[Fault]:
    """One case in a new folder, which goes afterwards."""
    place = Place(folder / f"case-{number}", folder / "larder", dice(options.seed, case.id))
    place.here.mkdir(parents=True)
    place.root.chmod(0o755)
    try:
        case.setup(place)
        return judged(case, place)
    except Exception:  # a mistake of the suite's is told as one
        return [Fault("wrong", "THE SUITE: " + traceback.format_exc()[-600:])]
    finally:
        if options.case is None:
            shutil.rmtree(place.root, ignore_errors=True)


def _print_table(cases: Sequence[Case], faults: dict[str, list[Fault]], seconds: float) -> None:
    kinds = list(dict.fromkeys(case.kind for case in cases))
    counts = {kind: Counter() for kind in kinds}
    for case in cases:
        counts[case.kind]["cases"] += 1
        counts[case.kind].update({fault.column for fault in faults[case.id]})
    width = max(map(len, [*kinds, "all"])) + 2
    print(f"{'class':{width}}{'cases':>7}" + "".join(f"{_HEADS[name]:>14}" for name in COLUMNS))
    total: Counter[str] = sum(counts.values(), Counter())
    for kind, count in [*counts.items(), ("all", total)]:
        print(f"{kind:{width}}{count['cases']:>7}" + "".join(f"{count[name]:>14}" for name in COLUMNS))
    wrong = sum(bool(each) for each in faults.values())
    for name, each in faults.items():
        for column, text in each:
            print(f"{name}: {_HEADS[column]}: {' '.join(text.split())[:600]}")
    print(f"{len(cases)} cases, {wrong} went wrong, {seconds:.0f} s", flush=True)


def _write_report(path: Path, cases: Sequence[Case], faults: dict[str, list[Fault]], options: Any) -> None:
    again = ["python", "-m", "tests.hostile", "--seed", str(options.seed), "--case"]
    rows = [
        {
            "id": case.id,
            "class": case.kind,
            "faults": [fault._asdict() for fault in faults[case.id]],
            "command": shlex.join(["curvafit", *case.command]) if case.command else "curvafit.load",
            "again": shlex.join([*again, case.id]),
        }
        for case in cases
        if faults[case.id]
    ]
    path.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def _show(case: Case, folder: Path, faults: list[Fault]) -> None:
    """All that is known of one case."""
    print(f"\n{case.id}: {shlex.join(['curvafit', *case.command])[:2000]}\nplayed in {folder / 'case-0' / 'here'}")
    for said in sorted((folder / "case-0").glob("said*/*")):
        if said.is_file() and said.stat().st_size and said.name in ("stdout", "stderr"):
            print(f"--- {said.parent.name}/{said.name}\n{said.read_text(errors='replace')[-4000:]}")
    for column, text in faults:
        print(f"!!! {_HEADS[column]}: {text}")
