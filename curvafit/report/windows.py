"""The page of a scan measured in windows, its maps and its table."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.units import format_number, format_percent
from curvafit.drawing.windows import windows_figure
from curvafit.inference.table import PARAMETERS
from curvafit.report.comparison import name_quantity
from curvafit.report.page import check_result_folder, picture_of, record_study, render_template, write_study
from curvafit.studies.tables import format_csv
from curvafit.studies.windows import NAMES, Windows

#: `format` of the record.
FORMAT = Format("curvafit windows", 1, title="the record of a scan measured in windows")
#: What is written into the folder beside the maps.
FILES = ("windows.json", "windows.html", "windows.csv", "windows.svg", "windows.png")
#: Symbols of the combinations of a law's parameters, by which their maps and columns are named.
COMBINATIONS = tuple(f"L{k}" for k in range(1, 1 + len(PARAMETERS)))


def list_files(source: str | Path) -> tuple[str, ...]:
    """Return the names of all files: the maps of a Zarr store are Zarr stores, of any other scan NIfTI.

    The last are the maps of combinations, which are written with laws only.
    """
    suffix = ".ome.zarr" if ".zarr" in str(source).lower() else ".nii.gz"
    return (*FILES, *(f"{name.replace(' ', '_')}{suffix}" for name in ("clusters", *NAMES, *COMBINATIONS)))


def check_windows(directory: str | Path, source: str | Path = "", overwrite: bool = False, command: str = "") -> Path:
    """Return the folder if `write_windows` can write there, else raise ValueError; call it before the work."""
    return check_result_folder(FORMAT, list_files(source), directory, [source] if source else [], overwrite, command)


def write_windows(windows: Windows, directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write the page, maps, figure, table and record of windows into a folder, and return the page's path.

    The files are moved into the folder once all are whole. Those of the same command are replaced; others are a
    ValueError without `overwrite`. `command` is what the record calls the command line.
    """
    source, laws = windows.clusters.source, bool(windows.options["laws"])
    target, files = check_windows(directory, source, overwrite, command), list_files(source)
    record = record_study(windows, command, files if laws else files[: -len(COMBINATIONS)])
    record |= {"scan": source, "kind": windows.kind, "explained": windows.explained}
    figure = windows_figure(windows)
    picture = picture_of(figure, "The structure, coloured by clusters and by six numbers")
    page = render_template(
        "windows.html",
        version=record["curvafit"],
        title="A scan in windows",
        status=windows.status,
        picture=picture,
        clusters=range(1, 1 + int(windows.clusters.values.max())),
        rows=[_format_row(windows, k) for k in range(len(windows.quantities))],
        laws=laws,
        notes=windows.notes,
        provenance=[(name, record[name]) for name in ("scan", "command", "date", "options") if record[name]],
    )
    texts = {"windows.html": page, "windows.csv": format_csv(list(_rows(windows)))}
    fields = (windows.clusters, *(windows[symbol] for _, symbol, _ in windows.quantities))
    maps = dict(zip(files[len(FILES) :], fields, strict=False))
    return write_study(target, FORMAT, files, record, texts, {"windows": (figure, picture)}, maps)


def _rows(windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield a row for each window: its centre, cluster and numbers; None where a number is not known."""
    for place in np.ndindex(windows.clusters.shape):
        values, centre = windows.values[place], zip("zyx", windows.centres[place].tolist(), strict=True)
        names = (symbol if symbol in COMBINATIONS else name for name, symbol, _ in windows.quantities)
        numbers = zip(names, (each if np.isfinite(each) else None for each in values.tolist()), strict=True)
        yield {**dict(centre), "unit": windows.unit, "cluster": int(windows.clusters.values[place]), **dict(numbers)}


def _format_row(windows: Windows, k: int) -> dict[str, Any]:
    """Return a row of the page's table: a number's name, range, cluster means, and share of variance between these."""
    values = windows.values[..., k]
    labels = np.where(np.isfinite(values), windows.clusters.values, 0)
    parts = [values[labels == label] for label in range(1, 1 + int(windows.clusters.values.max()))]
    means = [float(part.mean()) if len(part) else np.nan for part in parts]
    total = float(np.var(values[labels > 0]) * np.count_nonzero(labels)) if labels.any() else 0.0
    ends = np.nanpercentile(values, (0, 50, 100)) if np.isfinite(values).any() else [np.nan] * 3
    between = format_percent(1 - sum(part.var() * len(part) for part in parts if len(part)) / total) if total else "–"
    cells = (*(format_number(float(each)) for each in (*ends, *means)), between)
    return {**name_quantity(*windows.quantities[k], windows.unit), "cells": cells}
