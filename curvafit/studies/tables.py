"""Tidy tables of what scans measure: a row for each scan and quantity, as CSV, JSON or Parquet."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from curvafit.core.checks import require
from curvafit.core.files import write_atomically, write_content
from curvafit.core.records import Format, can_write, has_mark
from curvafit.scan.measures import COLUMNS, Measures

#: Suffixes of the files that are written.
SUFFIXES = (".csv", ".json", ".parquet")
#: Columns that rows of a part of a scan have besides.
OF_PARTS = ("compartment", "instance")
#: The start of a formula: a sign but for that of numbers.
_FORMULA = re.compile(r"[=@\t\r]|[-+](?![\d.eE\s-]*$)")
#: `format` of a JSON table.
FORMAT = Format("curvafit measures 1", title="a table of measures")


def check_table(path: str | PathLike[str], inputs: Sequence[str | Path] = (), overwrite: bool = False) -> Path:
    """Return the path of a table that may be written, else raise ValueError; ImportError for Parquet without pandas."""
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"the name of a table must end in {', '.join(SUFFIXES)}, and a folder's has no suffix, got {target}"
        )
    if target.suffix.lower() == ".parquet":
        _pandas()
    return can_write(target, _ours, inputs=inputs, overwrite=overwrite)


def write_table(
    measures: Sequence[Measures],
    path: str | PathLike[str],
    *,
    columns: Sequence[Mapping[str, str]] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a table of scans as `.csv`, `.json` or `.parquet`, and return its path; errors are `check_table`'s.

    A scan with compartments has the rows of each of them. `columns` has further ones of each scan, such as its subject.
    """
    target = check_table(path, overwrite=overwrite)
    rows = list_rows(measures, columns or [{}] * len(measures))
    if target.suffix.lower() == ".parquet":
        frame = _pandas().DataFrame(rows)
        return write_atomically(target, lambda temporary: frame.to_parquet(temporary, index=False))
    if target.suffix.lower() == ".json":
        scans = [
            {"scan": each.source, "kind": each.kind, "blocks": each.blocks, "notes": each.notes}
            | dict([each.part] if each.part else [])
            for each in measures
        ]
        return FORMAT.write(target, {"scans": scans, "rows": rows})
    return write_content(target, format_csv(rows))


def list_rows(measures: Sequence[Measures], columns: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Return the rows of scans, or of their compartments, all with the same columns; `columns` has further ones."""
    rows = []
    for each, more in zip(measures, columns, strict=True):
        rows += [row for part in (each.compartments.values() or (each,)) for row in part.rows(**more)]
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


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


def _ours(target: Path) -> bool:
    """Return whether a file is a table of this program."""
    if target.suffix.lower() == ".csv":
        return has_mark(target, ",".join(COLUMNS))
    return target.suffix.lower() == ".json" and FORMAT.owns(target)


def _pandas() -> Any:
    require("pyarrow", "tables", "a Parquet table")
    return require("pandas", "tables", "a Parquet table")
