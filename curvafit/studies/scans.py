"""Many scans: their subjects and groups, their measures in one unit, and tables of their numbers.

Scans, or the bodies of label images, come from folders, sequences or a table. All are read once before long work.
Numbers are written as CSV, a row for each scan and quantity.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import permutations
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from curvafit.core.checks import as_tuple, quoted
from curvafit.core.files import write_content
from curvafit.core.records import Format, can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number, plain_unit, unit_name
from curvafit.core.workers import cluster, run_jobs
from curvafit.geometry.diagrams import Diagram
from curvafit.scan.instances import OF_BODIES, measure_instances
from curvafit.scan.measures import COLUMNS, QUANTITIES, Measures, Quantity
from curvafit.scan.structure import OTSU
from curvafit.scan.tiles import measure
from curvafit.volumes.formats.meshes import SUFFIXES as MESHES
from curvafit.volumes.read import SLICED, Source, load, pick_reader
from curvafit.volumes.volume import ScanError

#: A scan as a caller gives it, and a group: a folder of scans, scans, or scans by subject; `Measures`, of a scan or of
#: the bodies of a label image, are not measured again.
Scan = Source | Measures | tuple[Measures, ...]
Group = str | PathLike[str] | Sequence[Scan] | Mapping[str, Sequence[Scan]]
#: The fewest subjects of a group whose spread can be measured.
FEWEST = 2
#: Edge of the bins to which a scan's diagram is reduced, over the inverse of the structure's thickness.
FINE = 0.1
#: Relative difference of the groups' voxel edges above which there is a note.
ALIKE_EDGES = 0.1
#: Thickness in µm from which numbers are in mm, as those of bone are written.
THICK = 10.0
#: What is done with one scan, given its progress; workers need a function that can be pickled.
Task = Callable[[Progress], Any]
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
#: Further columns in rows of a part of a scan.
OF_PARTS = ("compartment", "instance")
#: The start of a formula in a spreadsheet: a plus or minus counts unless it is a number's.
_FORMULA = re.compile(r"[=@\t\r]|[-+](?![\d.eE\s-]*$)")
#: Scans that were measured, in a folder of `measure`, so that `compare` need not measure them again.
MEASURED = "measured.npz"
MEASURED_FILE = Format("curvafit measured", 1, "measured scans", "measure them again")


class Case(NamedTuple):
    """A scan or a body, its name or its table's, its subject, its label (the name of its group, or a number), and its
    region of interest."""

    source: Source | Measures
    name: str
    subject: str
    label: str | float
    roi: Path | None = None


def list_cases(groups: Sequence[Group], by: str | Sequence[Any] | None, paired: bool) -> tuple[list[Case], list[str]]:
    """Return the scans of a study, those of one group together, and notes on what was assumed.

    They are those of several groups; of a single sequence, with a label for each in `by`; or of a single table, with
    labels in its column `by`, and regions in its column `roi`. Raises ValueError where labels cannot be exchanged
    between subjects; FileNotFoundError where a folder, a table, or a scan or region that it names is not there.
    """
    notes: list[str] = []
    if len(groups) == 1 and isinstance(groups[0], str | PathLike):
        if not isinstance(by, str | None):
            raise ValueError("expected a table alone, or scans with a label for each, or two groups or more")
        path = Path(groups[0])
        read = _read_measured if (path / MEASURED).exists() or _holds_bodies(path) else _read_cases
        cases = read(path, (by or "group").strip().casefold(), paired)
    else:
        cases = _list_labelled(groups[0], by) if len(groups) == 1 else _list_groups(groups, by, paired, notes)
        if not paired and not any(isinstance(group, Mapping) for group in groups):
            images = "Each image counts as a subject, unless its table names one (measure --subjects)."
            scans = "Each scan counts as a subject; a table of scans tells if several are of one."
            notes.append(images if is_body(cases[0].source) else scans)
            groups_of = Counter(subject for subject, _ in {(case.subject, case.label) for case in cases})
            if common := sum(count > 1 for count in groups_of.values()):
                notes.append(f"The groups have {common} names in common: they count as different subjects.")
                cases = [case._replace(subject=f"{case.label}/{case.subject}") for case in cases]
    cases = _name_labels(cases, by)
    named = Counter((case.name, is_body(case.source) or not isinstance(case.label, str)) for case in cases)
    cases = [case._replace(name=f"{case.label}/{case.name}") if named[case.name, False] > 1 else case for case in cases]
    _check_sources(cases)
    _check_labels(cases, paired)
    return cases, notes


def _name_labels(cases: Sequence[Case], by: Any) -> list[Case]:
    """Return cases with numbers as labels where `by` gives only numbers; else with names, sorted by group."""
    numbers = [None if by is None else _parse_number(case.label) for case in cases]
    if None not in numbers:
        return [case._replace(label=number) for case, number in zip(cases, numbers, strict=True)]  # type: ignore[arg-type]
    names = [str(case.label) for case in cases]
    if any(number is not None for number in numbers):
        name = quoted(names[numbers.index(None)])
        raise ValueError(f"expected finite numbers, or names of groups, to compare by, got {name} beside numbers")
    order = sorted(range(len(cases)), key=lambda k: names.index(names[k]))
    return [cases[k]._replace(label=names[k]) for k in order]


def _parse_number(label: Any) -> float | None:
    """Return a label as a finite number; None where it is none."""
    try:
        number = float(label)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _check_sources(cases: Sequence[Case]) -> None:
    """Raise ValueError if a scan or a body is listed twice, or scans come with bodies."""
    listed: Counter[tuple[object, ...]] = Counter()
    for case in cases:
        if isinstance(case.source, str | PathLike):
            listed[Path(case.source).resolve(),] += 1
        elif is_body(case.source) and case.name.endswith(".csv"):  # those of arrays may share a name
            listed[case.name, case.source.source, case.source.part] += 1
    for (path, *_), count in listed.most_common(1):
        if count > 1:
            raise ValueError(f"expected each scan once, got {path} {count} times")
    names = {("body" if is_body(case.source) else "scan"): case.name for case in cases}
    if len(names) > 1:
        raise ValueError(f"expected scans, or tables of measure --labels, got both, as {' and '.join(names.values())}")


def _check_labels(cases: Sequence[Case], paired: bool) -> None:
    """Raise ValueError if labels cannot be exchanged between enough subjects."""
    pairs = list(dict.fromkeys((case.subject, case.label) for case in cases))
    counts = Counter(label for _, label in pairs)
    groups = isinstance(pairs[0][1], str)
    if len(counts) < 2 or (not groups and len(pairs) <= FEWEST):
        expected = "two groups or more" if groups else f"more than {FEWEST} numbers that are not all the same"
        raise ValueError(f"expected {expected}, got {quoted(list(counts))}")
    name, least = counts.most_common()[-1]
    if groups and least < FEWEST:
        raise ValueError(f"expected at least {FEWEST} subjects in each group, got {least} in {name}")
    needed = len(counts) if groups else FEWEST
    for subject, count in Counter(subject for subject, _ in pairs).items():
        if paired and count < needed:
            where = "in each group" if groups else f"at {FEWEST} numbers or more"
            raise ValueError(f"expected {subject} {where}, to be paired with itself")
        if not paired and count > 1:
            labels = ", ".join(str(label) for name, label in pairs if name == subject)
            raise ValueError(f"expected one group or number of {subject}, got {labels}: --paired compares within it")


# ---- folders and sequences -------------------------------------------------------------------------------------------


def _list_labelled(scans: Any, by: Any) -> list[Case]:
    if by is None or isinstance(by, str) or isinstance(scans, Mapping):
        raise ValueError("expected two groups or more, a table, or scans with a label for each")
    labels, cases = as_tuple(by, "labels"), _list_group(as_tuple(scans, "scans"), "scan ", [])
    subjects = list(dict.fromkeys(case.subject for case in cases))
    if len(labels) != len(subjects):
        raise ValueError(f"expected a label for each of {len(subjects)} scans (--by), got {len(labels)}")
    label_of = dict(zip(subjects, labels, strict=True))
    return [case._replace(label=label_of[case.subject]) for case in cases]


def _list_groups(groups: Sequence[Group], by: Any, paired: bool, notes: list[str]) -> list[Case]:
    """Return the scans of groups; of paired ones, the subject is the file's name, or the position in a sequence."""
    if by is not None or len(groups) < 2:
        raise ValueError("expected two groups or more, and by only with a table or with one sequence of scans")
    cases = []
    for group, name in zip(groups, _name_groups(groups), strict=True):
        group_cases = _list_group(group, name, notes)
        if paired and not isinstance(group, str | PathLike | Mapping):
            places = {subject: str(k) for k, subject in enumerate(dict.fromkeys(c.subject for c in group_cases), 1)}
            group_cases = [case._replace(subject=places[case.subject]) for case in group_cases]
        cases += group_cases
    return cases


def _name_groups(groups: Sequence[Group]) -> list[str]:
    """Return the names of groups: those of their folders or tables, or A, B, C."""
    if not all(isinstance(group, str | PathLike) for group in groups):
        return [chr(ord("A") + k) for k in range(len(groups))]
    folders = [Path(group) for group in groups]  # type: ignore[arg-type]
    for folder in folders:
        if not folder.exists():
            raise FileNotFoundError(f"no such folder: {folder}")
        if not folder.is_dir() and not _holds_bodies(folder):
            raise ValueError(f"expected a folder of scans, got the file {folder}; single scans need --by")
    for folder, other in permutations((folder.resolve() for folder in folders), 2):
        if folder.is_relative_to(other):
            raise ValueError(f"expected folders apart from each other, got {folder} and {other}")
    names = [folder.resolve().name.removesuffix(".csv") for folder in folders]
    return names if len(set(names)) == len(names) else list(map(str, folders))


def _list_group(group: Group, name: str, notes: list[str]) -> list[Case]:
    """Return the scans of a group; each is a subject of its own unless the group is a mapping by subject."""
    if isinstance(group, str | PathLike):
        return _list_folder(Path(group), name, notes)
    if isinstance(group, Mapping):
        pairs: list[tuple[str, Any]] = [(str(subject), scan) for subject, scans in group.items() for scan in scans]
    else:
        pairs = [(f"{name}{k}", scan) for k, scan in enumerate(group, 1)]
        if any(is_body(scan) for scan in group):
            raise ValueError("expected bodies by subject, as in {'mouse 1': measure_instances(labels)}, got some alone")
    cases = []
    for k, (subject, scan) in enumerate(pairs, 1):
        for part in scan if isinstance(scan, tuple) else (scan,):
            source = part if isinstance(part, str | PathLike) else getattr(part, "source", "")  # empty of an array
            cases += _open_table(Case(part, Path(str(source)).name or f"{name}{k}", subject, name), True)
    return cases


def _list_folder(folder: Path, group: str, notes: list[str]) -> list[Case]:
    """Return the scans in a folder: files, and folders of slices or Zarr stores, that `curvafit.load` reads; and the
    bodies of its tables. A table may stand for a folder."""
    cases, skipped = [], []
    for path in sorted(folder.iterdir()) if folder.is_dir() else [folder]:
        if path.name.startswith("."):
            continue
        try:
            if not _holds_bodies(path):
                pick_reader(path)
        except ScanError:
            skipped.append(path.name)
        else:
            # a table that is a group of its own names no subject
            cases.append(Case(str(path), path.name, path.name.partition(".")[0] if folder.is_dir() else "", group))
    # A surface beside volumes is likely to be that of one of them.
    meshes = [case for case in cases if case.name.lower().endswith(MESHES)]
    if len(meshes) < len(cases):
        skipped += [case.name for case in meshes]
        cases = [case for case in cases if case not in meshes]
    if not cases:
        raise ValueError(f"expected scans in the folder {folder}, got none that can be read{SLICED}")
    if skipped:
        notes.append(f"{len(skipped)} other files in {folder.name} were left aside: {', '.join(skipped[:3])}.")
    # A scan is named by its stem, such as that of a subject, unless another file shares it.
    stems = Counter(case.subject for case in cases)
    named = (case if stems[case.subject] == 1 else case._replace(subject=case.name) for case in cases)
    return [opened for case in named for opened in _open_table(case, False)]


# ---- bodies, measured before -----------------------------------------------------------------------------------------


def is_body(scan: object) -> TypeGuard[Measures]:
    """Return whether a scan is one of the bodies of a label image."""
    return isinstance(scan, Measures) and scan.part is not None and scan.part[0] == "instance"


def _holds_bodies(path: Path) -> bool:
    """Return whether a file is a table of bodies, as `measure --labels` writes it."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return {"scan", "instance", "symbol"} <= set(re.split("[,;\t]", file.readline().strip().casefold()))


def _open_table(case: Case, stated: bool) -> list[Case]:
    """Return a case for each body, if a case is a table of bodies; else the case itself.

    The subject is the case's own if it is `stated`; else that in the table's column; else the image, where the table
    has several or the case has no subject.
    """
    if not (isinstance(case.source, str | PathLike) and _holds_bodies(Path(case.source))):
        return [case]
    if case.roi:
        raise ValueError(f"expected a region for scans alone, got one for the table of bodies {case.name}")
    path, bodies = Path(case.source).resolve(), _read_bodies(Path(case.source))
    images = {body.source: Path(body.source).name.partition(".")[0] for body, _ in bodies}
    if len(set(images.values())) < len(images):
        images = {image: image for image in images}
    if case.subject:
        names = (case.subject if len(images) == 1 else f"{case.subject}/{name}" for name in images.values())
        images = dict(zip(images, names, strict=True))
    return [
        case._replace(
            source=body, name=str(path), subject=case.subject if stated else row.get("subject") or images[body.source]
        )
        for body, row in bodies
    ]


def _read_bodies(path: Path) -> list[tuple[Measures, dict[str, str]]]:
    """Return the bodies in a table of `measure --labels`, each with the row of its further columns."""
    rows: dict[tuple[str, str], dict[str, dict[str, str]]] = {}
    try:
        for row in _read_table(path, ("scan", "instance", "symbol")):
            by_symbol = rows.setdefault((row["scan"], row["instance"]), {})
            if by_symbol.setdefault(row["symbol"], row) is not row:
                raise ValueError(f"instance {row['instance']} of {row['scan']} is there twice")
        return [(_read_body(by_symbol), next(iter(by_symbol.values()))) for by_symbol in rows.values()]
    except ValueError as fault:
        raise ValueError(f"expected a table of bodies, as measure --labels writes it: {fault} ({path})") from None


def _read_body(rows: Mapping[str, Mapping[str, str]]) -> Measures:
    """Return a body's measures from its rows by symbol; raise ValueError where one is missing, or in another unit."""
    first, unit, quantities = next(iter(rows.values())), rows.get("Tb.Th", {}).get("unit", ""), []
    for name, symbol, power, _ in OF_BODIES:
        expected = plain_unit(unit, power)
        if rows.get(symbol, {}).get("unit") != expected:
            raise ValueError(f"a body has no {symbol} {expected and f'in {expected}'}".rstrip())
        quantities.append(Quantity(name, symbol, float(rows[symbol]["value"] or "nan"), math.nan, power))
    empty = Diagram(np.zeros((0, 2)), np.zeros(0), f"1/{unit}")
    part = ("instance", int(float(first["instance"])))
    nowhere = math.nan, math.nan, math.nan
    return Measures(first["scan"], unit, "mask", tuple(quantities), nowhere, empty, (1, 1, 1), (), part)


# ---- tables that name scans ------------------------------------------------------------------------------------------


def _read_cases(table: Path, by: str, paired: bool) -> list[Case]:
    """Return the scans that a table names, with their labels from its column `by`."""
    if table.is_dir():
        raise ValueError(f"expected two folders or more, or a table, got the folder {table} alone")
    if not table.exists():
        raise FileNotFoundError(f"no such file: {table}")
    cases = []
    for row in _read_table(table, ("scan", by, *["subject"] * paired)):
        path = _find_beside(table, row["scan"])
        region = _find_beside(table, row["roi"]) if row.get("roi") else None
        case = Case(str(path), path.name, row.get("subject") or row["scan"], row[by], region)
        cases += _open_table(case, bool(row.get("subject")))
    return cases


def _find_beside(table: Path, name: str) -> Path:
    """Return a file that a table names, sought beside the table, or else in the working folder."""
    for path in (table.parent / name, Path(name)):
        if Path(str(path).partition("::")[0]).exists():  # what follows :: names a part of the file
            return path
    raise FileNotFoundError(f"no such file: {name}, which {table} names")


def write_measured(measures: Sequence[Measures], columns: Sequence[Mapping[str, str]], path: Path) -> Path:
    """Write scans that were measured, with further columns such as their subject, for `compare`."""
    scans = [{name: getattr(scan, name) for name in ("source", "unit", "kind", "blocks", "notes")} for scan in measures]
    arrays = {"directions": np.array([scan.direction for scan in measures])}
    arrays["numbers"] = np.array([[(each.value, each.half) for each in scan.quantities] for scan in measures])
    for k, scan in enumerate(measures):
        arrays |= {f"points{k}": scan.diagram.points, f"weights{k}": scan.diagram.weights}
    return MEASURED_FILE.write(path, {"scans": scans, "columns": list(map(dict, columns))}, arrays)


def _read_measured(path: Path, by: str, paired: bool) -> list[Case]:
    """Return the scans in a folder of `measure`, or the bodies in a table of it, with labels and subjects from columns
    that it was given."""
    is_folder, cases = path.is_dir(), []
    for scan, row in MEASURED_FILE.read(path / MEASURED, _build_measures) if is_folder else _read_bodies(path):
        if not row.get(by) or (paired and not row.get("subject")):
            needed = f"{by} and subject" if paired else by
            raise ValueError(f"expected scans measured with --subjects, and its column {needed}, got {path}")
        name = Path(scan.source).name if is_folder else str(path)
        cases.append(Case(scan, name, row.get("subject") or scan.source, row[by]))
    return cases


def _build_measures(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[tuple[Measures, dict[str, str]]]:
    """Return the scans of `write_measured`, each with its further columns."""
    scans = []
    for k, (scan, columns) in enumerate(zip(header["scans"], header["columns"], strict=True)):
        pairs = zip(QUANTITIES, arrays["numbers"][k].tolist(), strict=True)
        quantities = tuple(Quantity(*names[:2], value, half, names[2]) for names, (value, half) in pairs)
        diagram = Diagram(arrays[f"points{k}"], arrays[f"weights{k}"], f"1/{scan['unit']}")
        facts = scan["source"], scan["unit"], scan["kind"], quantities, tuple(arrays["directions"][k].tolist())
        scans.append((Measures(*facts, diagram, tuple(scan["blocks"]), tuple(scan["notes"])), columns))  # type: ignore[arg-type]
    return scans


def read_columns(table: str | PathLike[str], scans: Sequence[str]) -> list[dict[str, str]]:
    """Return, for each scan, its row of a table without the column `scan`: such as its subject, group and time.

    Raises ValueError where a scan has no row, or a column has the name of one in a table of measures; FileNotFoundError
    where there is no table.
    """
    path = Path(table)
    if not path.exists():
        raise FileNotFoundError(f"no such file: {path}")
    rows = {row["scan"]: row for row in _read_table(path, ("scan",))}
    if clashes := sorted({name for row in rows.values() for name in row} & {*COLUMNS, *OF_PARTS} - {"scan"}):
        raise ValueError(f"expected columns in {path} that a table of measures has not, got {', '.join(clashes)}")
    scan_rows = [_find_row(scan, Path(scan.partition("::")[0]).name, rows, path) for scan in scans]
    return [{name: value for name, value in row.items() if name != "scan"} for row in scan_rows]


def _find_row(source: object, name: str, rows: Mapping[str, Any], table: Path) -> Any:
    """Return the row of a scan, which the table names by its file's name, or by a path from here or from the table."""
    path = Path(str(source)).resolve()
    for listed, row in rows.items():
        if listed == name or path in (Path(listed).resolve(), (table.parent / listed).resolve()):
            return row
    raise ValueError(f"expected a row for each scan in {table}, got none for {name}")


def _read_table(table: Path, needed: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file, split at commas, semicolons or tabs, with the columns' names in small letters."""
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"expected a table in UTF-8, got {table}") from None
    head = lines[0] if lines else ""
    reader = csv.DictReader(lines, delimiter=max(",;\t", key=head.count))
    reader.fieldnames = [name.strip().casefold() for name in reader.fieldnames or ()]
    if missing := [name for name in needed if name not in reader.fieldnames]:
        raise ValueError(f"expected the columns {' and '.join(needed)} in {table}, got none named {missing[0]}")
    rows = [{name: (value or "").strip() for name, value in row.items() if isinstance(name, str)} for row in reader]
    rows = [row for row in rows if any(row.values())]
    if not rows or any(not row[name] for row in rows for name in needed):
        raise ValueError(f"expected {' and '.join(needed)} in each row of {table}, got a row without")
    return rows


# ---- measurement -----------------------------------------------------------------------------------------------------


def measure_scans(
    cases: Sequence[Case], options: dict[str, Any], reading: dict[str, Any], workers: int, progress: Progress
) -> tuple[list[Measures], list[str]]:
    """Measure scans with `options` of `measure`; return their measures, in one unit (`to_one_unit`), and notes.

    All are read before the first is measured. Raises ValueError, with the scan's name, as `measure`; and where only
    some scans have a physical unit.
    """
    notes = _check_scans(cases, reading, sub_progress(progress, 0.0, 0.05))
    settings = options | reading
    measured: dict[int, Any] = {k: (case.source,) for k, case in enumerate(cases) if isinstance(case.source, Measures)}
    tasks: dict[int, Task] = {
        k: partial(_measure_one, case.source, case.name, False, {**settings, "roi": case.roi})  # no labels
        for k, case in enumerate(cases)
        if k not in measured
    }
    measured |= _share_out(tasks, [case.name for case in cases], workers, sub_progress(progress, 0.05, 1.0))
    measures: list[Measures] = [measured[k][0] for k in range(len(cases))]
    pairs = zip(cases, measures, strict=True)
    if flat := next((case.name for case, scan in pairs if not is_body(scan) and not scan.diagram.area), None):
        raise ValueError(f"{flat}: expected a scan with curvature, got one too thin for it: measure has its numbers")
    units = {scan.unit for scan in measures}
    measures = to_one_unit(measures, reading.get("unit"))
    unit = measures[0].unit
    if len(units) > 1:
        notes.append(f"Lengths in {', '.join(map(unit_name, sorted(units)))} were converted to {unit_name(unit)}.")
    return measures, notes


def to_one_unit(measures: Sequence[Measures], unit: str | None = None) -> list[Measures]:
    """Return scans in the first one's unit; in mm, as bone is measured, where that is µm, the first scan's structure is
    `THICK` or thicker, and no `unit` was asked for. Raises ValueError where only some are in a physical unit."""
    first = measures[0]
    bone = unit is None and first.unit == "um" and first["thickness"].value >= THICK and not is_body(first)
    return [scan.convert("mm" if bone else first.unit) for scan in measures]


def measure_each(
    scans: Sequence[str],
    *,
    labels: bool = False,
    store: Path | None = None,
    workers: int = 0,
    progress: Progress = silent,
    **options: Any,
) -> list[tuple[Measures, ...]]:
    """Measure scans in this process or by several; with `labels` the instances of label images.

    `options` and errors are those of `measure`, or of `measure_instances`. Workers share the scans, or the tiles of a
    single one, which the folder `store` keeps. Diagrams of several scans are binned finely, to take little memory.
    """
    several = len(scans) > 1
    options |= {"workers": 0 if several else workers}
    tasks: dict[int, Task] = {}
    for k, scan in enumerate(scans):
        tiles = {} if labels or store is None else {"store": store / f"{k:04d}"}
        tasks[k] = partial(_measure_one, scan, scan if several else "", labels, options | tiles)
    measured = _share_out(tasks, scans, workers if several else 0, progress)
    results = [measured[k] for k in tasks]
    if labels or any(scan.unit == "voxel" for (scan,) in results):
        return results
    return [(scan,) for scan in to_one_unit([scan for (scan,) in results], options.get("unit"))]


def _measure_one(
    scan: Any, name: str, labels: bool, options: dict[str, Any], progress: Progress
) -> tuple[Measures, ...]:
    """Measure a scan, or its instances; a scan with a `name` is one of several, so its diagram is binned finely."""
    with _name_errors(name):
        if labels:
            return measure_instances(scan, progress=progress, **options)
        whole = measure(scan, progress=progress, **options)
    return (_bin_diagrams(replace(whole, source=whole.source or name)) if name else whole,)


def _share_out(tasks: Mapping[int, Task], names: Sequence[str], workers: int, progress: Progress) -> dict[int, Any]:
    """Run the tasks of scans, by index in `names`, in this process or by several; return the results by index."""
    count, results = len(names), {}
    with cluster(workers) as pool:
        stages = {k: sub_progress(progress, k / count, (k + 1) / count) for k in tasks}
        reports = {
            k: silent if workers else lambda text, share, k=k: stages[k](f"{names[k]}: {text}", share) for k in tasks
        }
        for k, result in run_jobs(_run_task, ((k, tasks[k], reports[k]) for k in tasks), pool):
            results[k] = result
            progress(f"{len(results)} of {count} scans done", len(results) / count)
    return results


def _run_task(job: tuple[int, Task, Progress]) -> tuple[int, Any]:
    k, task, progress = job
    return k, task(progress)


def _bin_diagrams(measures: Measures) -> Measures:
    width = FINE / measures["thickness"].value
    binned = {label: replace(part, diagram=part.diagram.bin(width)) for label, part in measures.compartments.items()}
    return replace(measures, diagram=measures.diagram.bin(width), compartments=binned)


def describe_groups(measures: Sequence[Measures], cases: Sequence[Case]) -> Iterator[str]:
    """Yield notes on masks among the images of a group, and on the thresholds of groups."""
    thresholds: dict[str, list[float]] = {}
    for group, own in _list_members(cases).items():
        kinds = Counter(measures[k].kind for k in own)
        if kinds["image"] and kinds["mask"]:
            counts = " and ".join(f"{kinds[kind]} {kind}{'s' * (kinds[kind] > 1)}" for kind in ("image", "mask"))
            names = ", ".join(cases[k].name for k in own if measures[k].kind == "mask")
            yield f"{group} has {counts} ({names}): is the mask a scan of its own?"
        if levels := [float(level) for k in own for note in measures[k].notes for level in OTSU.findall(note)]:
            thresholds[group] = [min(levels), max(levels)]
    if thresholds:
        texts = (f"{group} {' to '.join(map(format_number, sorted(set(own))))}" for group, own in thresholds.items())
        apart = any(one[1] < other[0] for one, other in permutations(thresholds.values(), 2))
        advice = ": they do not overlap; try one --threshold for all" * apart
        yield f"Otsu's thresholds: {', '.join(texts)}{advice}."


def _list_members(cases: Sequence[Case]) -> dict[str, list[int]]:
    """Return the indices of the scans of each group; of a study by a number those of all."""
    members: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        members.setdefault(case.label if isinstance(case.label, str) else "the study", []).append(k)
    return members


def gather_notes(measures: Sequence[Measures], cases: Sequence[Case]) -> Iterator[str]:
    """Yield the scans' notes, each after the scans that have it; notes of one group that differ in numbers only are
    one, so that groups whose numbers differ, such as thresholds, are told apart."""
    scans_of: dict[str, list[int]] = {}
    for own in _list_members(cases).values():
        for scans, note in merge_notes([measures[k] for k in own]):
            scans_of.setdefault(note, []).extend(own[k] for k in scans)
    for note, scans in scans_of.items():
        first, others = cases[scans[0]].name, len(scans) - 1
        some = f"{first} and {others} more" if others else first
        yield f"{some if len(scans) < len(cases) else f'All {len(cases)} scans'}: {note}"


def merge_notes(measures: Sequence[Measures]) -> Iterator[tuple[list[int], str]]:
    """Yield the scans' notes, each after the indices of the scans that have it: `([0, 1], "Split at 78 to 84.")`.

    Notes that differ in numbers only are one, with the range of each number.
    """
    by_wording: dict[str, list[tuple[int, str]]] = {}
    for k, scan in enumerate(measures):
        for note in scan.notes:
            by_wording.setdefault(_NUMBER.sub("#", note), []).append((k, note))
    for notes in by_wording.values():
        columns = zip(*(_NUMBER.findall(note) for _, note in notes), strict=True)
        ends = ((min(column, key=float), max(column, key=float)) for column in columns)
        ranges = iter([low if float(low) == float(high) else f"{low} to {high}" for low, high in ends])
        # The first note, with each of its numbers replaced by that number's range.
        yield sorted({k for k, _ in notes}), _NUMBER.sub(lambda _, ranges=ranges: next(ranges), notes[0][1])


def count_notes(measures: Sequence[Measures]) -> Iterator[str]:
    """Yield the notes of scans, or of parts of scans (`merge_notes`), with the number that has it if not all."""
    for scans, note in merge_notes(measures):
        yield note if len(scans) == len(measures) else f"Of {len(scans)} of {len(measures)} scans: {note}"


def _check_scans(cases: Sequence[Case], reading: dict[str, Any], progress: Progress) -> list[str]:
    """Read all scans once, so that errors come before long work; return notes."""
    units: dict[str, str] = {}
    edges: dict[str | float, list[float]] = {}
    for k, case in enumerate(cases):
        progress(f"{case.name}: reading", k / len(cases))
        if isinstance(case.source, Measures):
            units.setdefault(case.source.unit, case.name)
            continue
        with _name_errors(case.name):
            field = load(case.source, **reading)
        units.setdefault(field.unit, case.name)
        edges.setdefault(case.label, []).append(float(np.prod(field.spacing) ** (1 / 3)))
    if len(units) > 1 and "voxel" in units:
        other = next(name for name in units if name != "voxel")
        remedy = "measure the labels again" if is_body(cases[0].source) else "say it"
        raise ValueError(
            f"expected a physical spacing in all scans or in none, got none in {units['voxel']} and {other} in "
            f"{units[other]}: {remedy} with --spacing and --unit"
        )
    notes = ["Lengths are counted in voxels: compare only scans of one voxel size."] if "voxel" in units else []
    medians = [float(np.median(edge)) for edge in edges.values()]
    if medians and len(units) == 1 and min(medians) < (1 - ALIKE_EDGES) * max(medians):
        ends = " and ".join(format_number(end) for end in (min(medians), max(medians)))
        notes.append(f"Voxels differ, {ends} {unit_name(next(iter(units)))}: so does what they resolve.")
    return notes


def check_units(scans: Sequence[str], progress: Progress = silent, **reading: Any) -> None:
    """Raise ValueError where only some scans have a physical unit; where a format allows, no voxels are read."""
    _check_scans([Case(scan, scan, "", "") for scan in scans], {**reading, "lazy": True}, progress)


@contextmanager
def _name_errors(name: str) -> Iterator[None]:
    """Add a scan's name to the message of a ValueError."""
    try:
        yield
    except ValueError as error:
        raise error if name in str(error) else ScanError(f"{name}: {error}") from None


# ---- tables of numbers -----------------------------------------------------------------------------------------------


def check_table(path: str | PathLike[str], inputs: Sequence[str | Path] = (), overwrite: bool = False) -> Path:
    """Return the path of a table that may be written, else raise ValueError."""
    target = Path(path)
    if target.suffix.lower() != ".csv":
        raise ValueError(f"the name of a table must end in .csv, and a folder's has no suffix, got {target}")
    return can_write(target, partial(has_mark, mark=",".join(COLUMNS)), inputs=inputs, overwrite=overwrite)


def write_table(
    measures: Sequence[Measures],
    path: str | PathLike[str],
    *,
    columns: Sequence[Mapping[str, str]] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a table of scans as `.csv`, and return its path; errors are `check_table`'s.

    A scan with compartments has the rows of each of them. `columns` has further ones of each scan, such as its subject.
    """
    target = check_table(path, overwrite=overwrite)
    return write_content(target, format_csv(list_rows(measures, columns or [{}] * len(measures))))


def list_rows(measures: Sequence[Measures], columns: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Return the rows of scans, or of their compartments, all with the same columns; `columns` has further ones."""
    rows = []
    for scan, more in zip(measures, columns, strict=True):
        rows += [row for part in (scan.compartments.values() or (scan,)) for row in part.rows(**more)]
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def list_wide(measures: Sequence[Measures], columns: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each scan of one unit, or for each of its compartments, and a column for each number."""
    wide = []
    for scan, more in zip(measures, columns, strict=True):
        for part in scan.compartments.values() or (scan,):
            numbers = {f"{row['symbol']} ({row['unit']})".removesuffix(" ()"): row["value"] for row in part.rows()}
            wide.append({"scan": scan.source} | dict([part.part] if part.part else []) | dict(more) | numbers)
    return wide


def format_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows of the same columns as CSV; None is an empty cell.

    A text that a spreadsheet would run as a formula, such as a scan's name, begins with an apostrophe.
    """
    text = io.StringIO(newline="")
    cells = (rows[0], *(row.values() for row in rows))
    csv.writer(text).writerows(
        [f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell for cell in row] for row in cells
    )
    return text.getvalue()
