"""Which scans are in which group, and of which subject: from folders, from sequences, or from a table."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple

from curvafit.core.checks import as_tuple, quoted
from curvafit.scan.measure import Measures
from curvafit.volumes.field import ScanError
from curvafit.volumes.read import Source, pick_reader

#: A group as a caller gives it: a folder of scans, scans, or scans by subject. What is measured already is taken so.
Group = str | PathLike[str] | Sequence[Source | Measures] | Mapping[str, Sequence[Source | Measures]]
#: The fewest subjects of a group whose spread can be told.
FEWEST = 2


class Case(NamedTuple):
    """A scan, its name, the subject it is of, and its group."""

    source: Source | Measures
    name: str
    subject: str
    group: str


def list_cases(
    first: Group | None, second: Group | None, table: str | PathLike[str] | None
) -> tuple[list[Case], list[str]]:
    """Return the scans of two groups, those of the first group first, and notes on what was assumed.

    Raises ValueError where there are not two groups of at least two subjects each, or one shares a scan or a subject
    with the other; FileNotFoundError where a folder, the table, or a scan that the table names is not there.
    """
    notes: list[str] = []
    if first is None and second is None and table is not None:
        cases = _read_groups(Path(table))
    elif first is None or second is None:
        raise ValueError("expected two groups, or a table with the columns scan and group")
    else:
        names = _name_groups(first, second)
        rows = None if table is None else _read_subjects(Path(table))
        cases = [
            case for group, name in zip((first, second), names, strict=True) for case in _gather(group, name, notes)
        ]
        if rows is not None:
            file = Path(fspath(table or ""))
            cases = [case._replace(subject=_find_row(case.source, case.name, rows, file)) for case in cases]
        elif not any(isinstance(group, Mapping) for group in (first, second)):
            notes.append("Each scan counts as a subject; a table (--subjects) tells if several are of one.")
            both = set.intersection(*({case.subject for case in cases if case.group == name} for name in names))
            notes += [f"The groups have {len(both)} names in common: they count as different subjects."] if both else []
            cases = [case._replace(subject=f"{case.group}/{case.subject}") for case in cases] if both else cases
    _check(cases)
    return cases, notes


def list_series(scans: Sequence[Source | Measures]) -> list[Case]:
    """Return the scans of a series, each a group of its own."""
    return [case._replace(group=case.subject) for case in _gather(as_tuple(scans, "scans"), "scan ", [])]


def _check(cases: Sequence[Case]) -> None:
    """Raise ValueError if a group has too few subjects, or both have one subject or one scan."""
    places = Counter(Path(str(case.source)).resolve() for case in cases if isinstance(case.source, str | PathLike))
    if places and (most := places.most_common(1)[0])[1] > 1:
        raise ValueError(f"expected each scan once, got {most[0]} {most[1]} times")
    subjects = {
        name: {case.subject for case in cases if case.group == name}
        for name in dict.fromkeys(case.group for case in cases)
    }
    for name, there in subjects.items():
        if len(there) < FEWEST:
            raise ValueError(f"expected at least {FEWEST} subjects in each group, got {len(there)} in {name}")
    if both := set.intersection(*subjects.values()):
        raise ValueError(f"expected groups of different subjects, got {quoted(min(both))} in both")


# ---- folders and sequences -------------------------------------------------------------------------------------------


def _name_groups(first: Group, second: Group) -> tuple[str, str]:
    """Return the names of two groups: those of their folders, or A and B."""
    if not all(isinstance(group, str | PathLike) for group in (first, second)):
        return "A", "B"
    folders = [Path(group) for group in (first, second)]  # type: ignore[arg-type]
    for folder in folders:
        if not folder.exists():
            raise FileNotFoundError(f"no such folder: {folder}")
        if not folder.is_dir():
            raise ValueError(f"expected a folder of scans, got the file {folder}")
    one, other = (folder.resolve() for folder in folders)
    if one == other or one.is_relative_to(other) or other.is_relative_to(one):
        raise ValueError(f"expected two folders apart from each other, got {folders[0]} and {folders[1]}")
    names = (one.name, other.name)
    return names if names[0] != names[1] else (str(folders[0]), str(folders[1]))


def _gather(group: Group, name: str, notes: list[str]) -> list[Case]:
    """Return the scans of a group, each a subject unless the group says whose it is."""
    if isinstance(group, str | PathLike):
        return _list_folder(Path(group), name, notes)
    if isinstance(group, Mapping):
        pairs: list[tuple[str, Any]] = [(str(subject), scan) for subject, scans in group.items() for scan in scans]
    else:
        pairs = [(f"{name}{k}", scan) for k, scan in enumerate(group, 1)]
    return [Case(scan, _name_scan(scan) or f"{name}{k}", subject, name) for k, (subject, scan) in enumerate(pairs, 1)]


def _name_scan(scan: Any) -> str:
    """Return the name of a scan's file; an empty one for an array."""
    source = scan if isinstance(scan, str | PathLike) else getattr(scan, "source", "")
    return Path(str(source)).name


def _list_folder(folder: Path, group: str, notes: list[str]) -> list[Case]:
    """Return the scans in a folder: files, and folders of slices or Zarr stores, that `curvafit.load` reads."""
    cases, aside = [], []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        try:
            pick_reader(path)
        except ScanError:
            aside.append(path.name)
        else:
            cases.append(Case(str(path), path.name, path.name.partition(".")[0], group))
    if not cases:
        raise ValueError(f"expected scans in the folder {folder}, got none that can be read")
    if aside:
        notes.append(f"{len(aside)} other files in {folder.name} were left aside: {', '.join(aside[:3])}.")
    stems = Counter(case.subject for case in cases)
    return [case if stems[case.subject] == 1 else case._replace(subject=case.name) for case in cases]


# ---- tables ----------------------------------------------------------------------------------------------------------


def _read_groups(table: Path) -> list[Case]:
    """Return the scans that a table names, with their groups."""
    rows = _read_table(table, ("scan", "group"))
    groups = list(dict.fromkeys(row["group"] for row in rows))
    if len(groups) != 2:
        raise ValueError(f"expected two groups in {table}, got {len(groups)}: {quoted(groups)}")
    cases = []
    for row in sorted(rows, key=lambda row: groups.index(row["group"])):
        place = table.parent / row["scan"]
        place = place if Path(str(place).partition("::")[0]).exists() else Path(row["scan"])
        if not Path(str(place).partition("::")[0]).exists():
            raise FileNotFoundError(f"no such file: {row['scan']}, which {table} names")
        cases.append(Case(str(place), place.name, row.get("subject") or row["scan"], row["group"]))
    return cases


def _read_subjects(table: Path) -> dict[str, str]:
    """Return the subject of each scan that a table names."""
    rows = _read_table(table, ("scan", "subject"))
    if "group" in rows[0]:
        raise ValueError(f"expected the groups once, got two folders and a column group in {table}: leave one out")
    return {row["scan"]: row["subject"] for row in rows}


def read_columns(table: str | PathLike[str], scans: Sequence[str], taken: Sequence[str] = ()) -> list[dict[str, str]]:
    """Return what a table says of each scan: its columns but `scan`, such as subject, group and time.

    Raises ValueError where a scan has no row, or a column's name is `taken`; FileNotFoundError where there is no table.
    """
    place = Path(table)
    if not place.exists():
        raise FileNotFoundError(f"no such file: {place}")
    rows = {row["scan"]: row for row in _read_table(place, ("scan",))}
    if both := sorted({name for row in rows.values() for name in row} & set(taken) - {"scan"}):
        raise ValueError(f"expected columns in {place} that a table of measures has not, got {', '.join(both)}")
    found = (_find_row(scan, Path(scan.partition("::")[0]).name, rows, place) for scan in scans)
    return [{name: value for name, value in row.items() if name != "scan"} for row in found]


def _find_row(source: object, name: str, rows: Mapping[str, Any], table: Path) -> Any:
    """Return the row of a scan, which the table names by its path or by the name of its file."""
    place = Path(str(source))
    for said, row in rows.items():
        if said == name or place.resolve() in (Path(said).resolve(), (table.parent / said).resolve()):
            return row
    raise ValueError(f"expected a row for each scan in {table}, got none for {name}")


def _read_table(table: Path, needed: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file between commas, semicolons or tabs, with the columns' names in small letters."""
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
