"""Many scans: read once before long work, measured in this process or by several, in one unit."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number
from curvafit.core.workers import cluster, run_jobs
from curvafit.scan.instances import measure_instances
from curvafit.scan.measures import Measures
from curvafit.scan.tiles import measure
from curvafit.studies.groups import Case
from curvafit.volumes.read import load
from curvafit.volumes.volume import ScanError

#: Edge of the bins of a scan's diagram as it is kept, over the inverse of the structure's thickness.
FINE = 0.1
#: Voxel edges of groups that differ by more than this part deserve a note.
ALIKE_EDGES = 0.1
#: What is done with one scan, given its progress; a function that has a module's name.
Task = Callable[[Progress], Any]
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def measure_scans(
    cases: Sequence[Case], options: dict[str, Any], reading: dict[str, Any], workers: int, progress: Progress
) -> tuple[list[Measures], list[str]]:
    """Measure scans with `options` of `measure`; return their measures, in the first scan's unit, and notes.

    All are read before the first is measured. Raises ValueError, with the scan's name, as `measure`; and where only
    some scans have a physical unit.
    """
    unit, notes = _check_scans(cases, reading, sub_progress(progress, 0.0, 0.05))
    how = options | reading
    found: dict[int, Any] = {k: (case.source,) for k, case in enumerate(cases) if isinstance(case.source, Measures)}
    tasks: dict[int, Task] = {
        k: partial(_measure_one, case.source, case.name, False, how) for k, case in enumerate(cases) if k not in found
    }
    found |= share_out(tasks, [case.name for case in cases], workers, sub_progress(progress, 0.05, 1.0))
    measures: list[Measures] = [found[k][0] for k in range(len(cases))]
    if flat := [case.name for case, each in zip(cases, measures, strict=True) if not each.diagram.area > 0]:
        raise ValueError(
            f"{flat[0]}: expected a scan with curvature, got a stack too thin for it: measure has its numbers"
        )
    units = {each.unit for each in measures}
    notes += [] if len(units) == 1 else [f"Lengths in {', '.join(sorted(units))} were converted to {unit}."]
    return [each.convert(unit) for each in measures], notes


def measure_each(
    scans: Sequence[str],
    *,
    labels: bool = False,
    store: Path | None = None,
    workers: int = 0,
    progress: Progress = silent,
    **options: Any,
) -> list[tuple[Measures, ...]]:
    """Measure scans, each by itself, in this process or by several; with `labels` the instances of label images.

    `options` are those of `measure`, or of `measure_instances`. Workers share the scans, or the tiles of a single one;
    finished tiles lie in the folder `store`. Diagrams of several scans are binned finely, so that many take little
    memory. Raises ValueError as those do.
    """
    several = len(scans) > 1
    options |= {"workers": 0 if several else workers}
    tasks: dict[int, Task] = {}
    for k, scan in enumerate(scans):
        tiles = {} if labels or store is None else {"store": store / f"{k:04d}"}
        tasks[k] = partial(_measure_one, scan, scan if several else "", labels, options | tiles)
    found = share_out(tasks, scans, workers if several else 0, progress)
    return [found[k] for k in tasks]


def _measure_one(
    scan: Any, name: str, labels: bool, options: dict[str, Any], progress: Progress
) -> tuple[Measures, ...]:
    """Measure a scan, or its instances; one that is named is among several, and its diagram is binned finely."""
    with name_errors(name):
        if labels:
            return measure_instances(scan, progress=progress, **options)
        whole = measure(scan, progress=progress, **options)
    return (_bin_diagrams(replace(whole, source=whole.source or name)) if name else whole,)


def share_out(tasks: Mapping[int, Task], names: Sequence[str], workers: int, progress: Progress) -> dict[int, Any]:
    """Do the tasks of scans, by their numbers among `names`, in this process or by several; return what they return."""
    count, found = len(names), {}
    with cluster(workers) as crew:
        parts = {k: sub_progress(progress, k / count, (k + 1) / count) for k in tasks}
        tell = {
            k: silent if workers else lambda text, share, k=k: parts[k](f"{names[k]}: {text}", share) for k in tasks
        }
        for k, result in run_jobs(_do, ((k, tasks[k], tell[k]) for k in tasks), crew):
            found[k] = result
            progress(f"{len(found)} of {count} scans done", len(found) / count)
    return found


def _do(job: tuple[int, Task, Progress]) -> tuple[int, Any]:
    number, task, progress = job
    return number, task(progress)


def _bin_diagrams(measures: Measures) -> Measures:
    width = FINE / measures["thickness"].value
    fine = {label: replace(each, diagram=each.diagram.bin(width)) for label, each in measures.compartments.items()}
    return replace(measures, diagram=measures.diagram.bin(width), compartments=fine)


def gather_notes(measures: Sequence[Measures], cases: Sequence[Case]) -> Iterator[str]:
    """Yield the scans' notes, with whose they are; those that differ in numbers only are one."""
    for scans, note in merge_notes(measures):
        first, more = cases[scans[0]].name, len(scans) - 1
        who = f"{first} and {more} more" if more else first
        yield f"{who if len(scans) < len(cases) else f'All {len(cases)} scans'}: {note}"


def merge_notes(measures: Sequence[Measures]) -> Iterator[tuple[list[int], str]]:
    """Yield the scans' notes, each after the numbers of the scans that have it: `([0, 1], "Split at 78–84.")`.

    Notes that differ in numbers only are one, with the range of each number.
    """
    alike: dict[str, list[tuple[int, str]]] = {}
    for k, scan in enumerate(measures):
        for note in scan.notes:
            alike.setdefault(_NUMBER.sub("#", note), []).append((k, note))
    for found in alike.values():
        columns = zip(*(_NUMBER.findall(note) for _, note in found), strict=True)
        ends = ((min(column, key=float), max(column, key=float)) for column in columns)
        ranges = iter([low if float(low) == float(high) else f"{low}–{high}" for low, high in ends])
        yield sorted({k for k, _ in found}), _NUMBER.sub(lambda _, ranges=ranges: next(ranges), found[0][1])


def count_notes(measures: Sequence[Measures]) -> Iterator[str]:
    """Yield the notes of scans, or of parts of scans (`merge_notes`), each with how many have it, unless all have."""
    for scans, note in merge_notes(measures):
        yield note if len(scans) == len(measures) else f"Of {len(scans)} of {len(measures)} scans: {note}"


def _check_scans(cases: Sequence[Case], reading: dict[str, Any], progress: Progress) -> tuple[str, list[str]]:
    """Read all scans once, so that what is wrong is said before long work; return their unit, and notes."""
    units: dict[str, str] = {}
    edges: dict[str | float, list[float]] = {}
    for k, case in enumerate(cases):
        progress(f"{case.name}: reading", k / len(cases))
        if isinstance(case.source, Measures):
            units.setdefault(case.source.unit, case.name)
            continue
        with name_errors(case.name):
            field = load(case.source, **reading)
        units.setdefault(field.unit, case.name)
        edges.setdefault(case.label, []).append(float(np.prod(field.spacing) ** (1 / 3)))
    if len(units) > 1 and "voxel" in units:
        other = next(name for name in units if name != "voxel")
        raise ValueError(
            f"expected a physical spacing in all scans or in none, got none in {units['voxel']} and {other} in "
            f"{units[other]}: say it with --spacing and --unit"
        )
    notes = ["Lengths are counted in voxels: compare only scans of one voxel size."] if "voxel" in units else []
    medians = [float(np.median(each)) for each in edges.values()]
    if medians and len(units) == 1 and min(medians) < (1 - ALIKE_EDGES) * max(medians):
        ends = " and ".join(format_number(end) for end in (min(medians), max(medians)))
        notes.append(f"Voxels differ, {ends} {next(iter(units))}: so does what they resolve.")
    return next(iter(units)), notes


def check_units(scans: Sequence[str], progress: Progress = silent, **reading: Any) -> None:
    """Raise ValueError where only some scans have a physical unit; of files that can be read in boxes no voxel is."""
    _check_scans([Case(scan, scan, "", "") for scan in scans], {**reading, "lazy": True}, progress)


@contextmanager
def name_errors(name: str) -> Iterator[None]:
    """Add a scan's name to what is wrong with it."""
    try:
        yield
    except ValueError as error:
        raise error if name in str(error) else ScanError(f"{name}: {error}") from None
