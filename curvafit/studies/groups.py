"""Which scans are of which subject, in which group or at which number: from folders, sequences, or a table."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import permutations
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from curvafit.core.checks import as_tuple, quoted
from curvafit.scan.measures import Measures
from curvafit.volumes.read import Source, pick_reader
from curvafit.volumes.volume import ScanError

#: A group as a caller gives it: a folder of scans, scans, or scans by subject. What is measured already is taken so.
Group = str | PathLike[str] | Sequence[Source | Measures] | Mapping[str, Sequence[Source | Measures]]
#: The fewest subjects of a group whose spread can be told.
FEWEST = 2


class Case(NamedTuple):
    """A scan, its name, the subject it is of, and its label: the name of its group, or a number."""

    source: Source | Measures
    name: str
    subject: str
    label: str | float


def list_cases(
    groups: Sequence[Group], by: str | Sequence[Any] | None, table: str | PathLike[str] | None, paired: bool
) -> tuple[list[Case], list[str]]:
    """Return the scans of a study, those of one group together, and notes on what was assumed.

    They are those of several groups; of a single sequence, with a label for each in `by`; or of a single table, with
    labels in its column `by`. Raises ValueError where labels cannot be exchanged between subjects; FileNotFoundError
    where a folder, a table, or a scan that it names is not there.
    """
    notes: list[str] = []
    if len(groups) == 1 and isinstance(groups[0], str | PathLike):
        if not isinstance(by, str | None) or table is not None:
            raise ValueError("expected a table alone, or scans with a label for each, or two groups or more")
        cases = _read_cases(Path(groups[0]), by or "group", paired)
    else:
        cases = _list_labelled(groups[0], by) if len(groups) == 1 else _list_groups(groups, by, paired, notes)
        if table is not None:
            told = _read_table(Path(table), ("scan", "subject"))
            if "group" in told[0]:
                raise ValueError(
                    f"expected the groups once, got two folders and a column group in {table}: leave one out"
                )
            rows = {row["scan"]: row["subject"] for row in told}
            cases = [case._replace(subject=_find_row(case.source, case.name, rows, Path(table))) for case in cases]
        elif not paired and not any(isinstance(group, Mapping) for group in groups):
            notes.append("Each scan counts as a subject; a table (--subjects) tells if several are of one.")
            names = Counter(subject for subject, _ in {(case.subject, case.label) for case in cases})
            if both := sum(count > 1 for count in names.values()):
                notes.append(f"The groups have {both} names in common: they count as different subjects.")
                cases = [case._replace(subject=f"{case.label}/{case.subject}") for case in cases]
    cases = _name_labels(cases, by)
    _check(cases, paired)
    return cases, notes


def _name_labels(cases: Sequence[Case], by: Any) -> list[Case]:
    """Return cases with numbers where all labels that `by` gives are; else with names, each group together."""
    found = [None if by is None else _parse(case.label) for case in cases]
    if None not in found:
        return [case._replace(label=number) for case, number in zip(cases, found, strict=True)]  # type: ignore[arg-type]
    names = [str(case.label) for case in cases]
    if any(number is not None for number in found):
        odd = quoted(names[found.index(None)])
        raise ValueError(f"expected finite numbers, or names of groups, to compare by, got {odd} beside numbers")
    order = sorted(range(len(cases)), key=lambda k: names.index(names[k]))
    return [cases[k]._replace(label=names[k]) for k in order]


def _parse(label: Any) -> float | None:
    """Return a label as a finite number; None of others."""
    try:
        number = float(label)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _check(cases: Sequence[Case], paired: bool) -> None:
    """Raise ValueError if a scan is there twice, or labels cannot be exchanged."""
    places = Counter(Path(str(case.source)).resolve() for case in cases if isinstance(case.source, str | PathLike))
    if places and (most := places.most_common(1)[0])[1] > 1:
        raise ValueError(f"expected each scan once, got {most[0]} {most[1]} times")
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
            both = ", ".join(str(label) for name, label in pairs if name == subject)
            raise ValueError(f"expected one group or number of {subject}, got {both}: --paired compares within it")


# ---- folders and sequences -------------------------------------------------------------------------------------------


def _list_labelled(scans: Any, by: Any) -> list[Case]:
    if by is None or isinstance(by, str) or isinstance(scans, Mapping):
        raise ValueError("expected two groups or more, a table, or scans with a label for each")
    labels, cases = as_tuple(by, "labels"), _gather(as_tuple(scans, "scans"), "scan ", [])
    if len(labels) != len(cases):
        raise ValueError(f"expected a label for each of {len(cases)} scans (--by), got {len(labels)}")
    return [case._replace(label=label) for case, label in zip(cases, labels, strict=True)]


def _list_groups(groups: Sequence[Group], by: Any, paired: bool, notes: list[str]) -> list[Case]:
    """Return the scans of groups; where they are paired, a scan's subject is its file's name or its place."""
    if by is not None or len(groups) < 2:
        raise ValueError("expected two groups or more, and by only with a table or with one sequence of scans")
    cases = []
    for group, name in zip(groups, _name_groups(groups), strict=True):
        listed = _gather(group, name, notes)
        if paired and not isinstance(group, str | PathLike | Mapping):
            listed = [case._replace(subject=str(k)) for k, case in enumerate(listed, 1)]
        cases += listed
    return cases


def _name_groups(groups: Sequence[Group]) -> list[str]:
    """Return the names of groups: those of their folders, or A, B, C."""
    if not all(isinstance(group, str | PathLike) for group in groups):
        return [chr(ord("A") + k) for k in range(len(groups))]
    folders = [Path(group) for group in groups]  # type: ignore[arg-type]
    for folder in folders:
        if not folder.exists():
            raise FileNotFoundError(f"no such folder: {folder}")
        if not folder.is_dir():
            raise ValueError(f"expected a folder of scans, got the file {folder}; single scans need --by")
    for one, other in permutations((folder.resolve() for folder in folders), 2):
        if one.is_relative_to(other):
            raise ValueError(f"expected folders apart from each other, got {one} and {other}")
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else list(map(str, folders))


def _gather(group: Group, name: str, notes: list[str]) -> list[Case]:
    """Return the scans of a group, each a subject unless the group says whose it is."""
    if isinstance(group, str | PathLike):
        return _list_folder(Path(group), name, notes)
    if isinstance(group, Mapping):
        pairs: list[tuple[str, Any]] = [(str(subject), scan) for subject, scans in group.items() for scan in scans]
    else:
        pairs = [(f"{name}{k}", scan) for k, scan in enumerate(group, 1)]
    cases = []
    for k, (subject, scan) in enumerate(pairs, 1):
        source = scan if isinstance(scan, str | PathLike) else getattr(scan, "source", "")  # empty of an array
        cases.append(Case(scan, Path(str(source)).name or f"{name}{k}", subject, name))
    return cases


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


def _read_cases(table: Path, by: str, paired: bool) -> list[Case]:
    """Return the scans that a table names, with their labels, each group together."""
    if table.is_dir():
        raise ValueError(f"expected two folders or more, or a table, got the folder {table} alone")
    if not table.exists():
        raise FileNotFoundError(f"no such file: {table}")
    by = by.strip().casefold()
    rows = _read_table(table, ("scan", by, *["subject"] * paired))
    cases = []
    for row in rows:
        place = table.parent / row["scan"]
        place = place if Path(str(place).partition("::")[0]).exists() else Path(row["scan"])
        if not Path(str(place).partition("::")[0]).exists():
            raise FileNotFoundError(f"no such file: {row['scan']}, which {table} names")
        cases.append(Case(str(place), place.name, row.get("subject") or row["scan"], row[by]))
    return cases


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
