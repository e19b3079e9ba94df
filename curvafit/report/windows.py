"""The page of a scan measured in windows, its maps and its table."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.units import format_number, format_percent, power_name
from curvafit.drawing.plot import png, svg
from curvafit.drawing.windows import windows_figure
from curvafit.report.page import Picture, check_result_folder, fill_folder, render_template
from curvafit.studies.tables import format_csv
from curvafit.studies.windows import NAMES, Windows
from curvafit.volumes.write import save

#: `format` of the record.
FORMAT = Format("curvafit windows", 1, title="the record of a scan measured in windows")
#: What is written into the folder beside the maps.
FILES = ("windows.json", "windows.html", "windows.csv", "windows.svg", "windows.png")


def list_files(source: str | Path) -> tuple[str, ...]:
    """Return the names of all files: the maps of a Zarr store are Zarr stores, of any other scan NIfTI."""
    suffix = ".ome.zarr" if ".zarr" in str(source).lower() else ".nii.gz"
    return (*FILES, *(f"{name.replace(' ', '_')}{suffix}" for name in ("clusters", *NAMES)))


def check_windows(directory: str | Path, source: str | Path = "", overwrite: bool = False, command: str = "") -> Path:
    """Return the folder if `write_windows` can write there, else raise ValueError; call it before the work."""
    return check_result_folder(FORMAT, list_files(source), directory, [source] if source else [], overwrite, command)


def write_windows(windows: Windows, directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write the page, maps, figure, table and record of windows into a folder, and return the page's path.

    The files are moved into the folder once all are whole. Those of the same command are replaced; others are a
    ValueError without `overwrite`. `command` is what the record calls the command line.
    """
    source = windows.clusters.source
    target, files = check_windows(directory, source, overwrite, command), list_files(source)
    record = {
        "curvafit": version("curvafit"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "scan": source,
        "kind": windows.kind,
        "unit": windows.unit,
        "options": json.loads(json.dumps(windows.options, default=str)),
        "status": windows.status,
        "explained": windows.explained,
        "notes": list(windows.notes),
        "files": list(files),
    }
    figure = windows_figure(windows)
    picture = png(figure)
    with fill_folder(target, files) as work:
        for name, each in zip(files[len(FILES) :], (windows.clusters, *map(windows.__getitem__, NAMES)), strict=True):
            save(each, work / name, kind=FORMAT.name)
        (work / "windows.png").write_bytes(picture)
        (work / "windows.svg").write_bytes(svg(figure))
        (work / "windows.csv").write_text(format_csv(list(_rows(windows))), encoding="utf-8", newline="")
        page = render_template(
            "windows.html",
            **record,
            version=record["curvafit"],
            title="A scan in windows",
            picture=Picture(
                b64encode(picture).decode("ascii"), "The structure, coloured by clusters and by six numbers"
            ),
            clusters=range(1, 1 + int(windows.clusters.values.max())),
            rows=[_format_row(windows, k) for k in range(len(NAMES))],
        )
        (work / "windows.html").write_text(page, encoding="utf-8")
        FORMAT.write(work / "windows.json", record)
    return target / "windows.html"


def _rows(windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield a row for each window: its centre, cluster and numbers; None where a number is not known."""
    for place in np.ndindex(windows.clusters.shape):
        values, centre = windows.values[place], zip("zyx", windows.centres[place].tolist(), strict=True)
        numbers = zip(NAMES, (each if np.isfinite(each) else None for each in values.tolist()), strict=True)
        yield {**dict(centre), "unit": windows.unit, "cluster": int(windows.clusters.values[place]), **dict(numbers)}


def _format_row(windows: Windows, k: int) -> tuple[str, ...]:
    """Return a row of the page's table: a number's name, range, cluster means, and share of variance between these."""
    name, symbol, power = windows.quantities[k]
    labels, values = windows.clusters.values, windows.values[..., k]
    parts = [values[labels == label] for label in range(1, 1 + int(labels.max()))]
    total = float(np.var(values[labels > 0]) * np.count_nonzero(labels)) if parts else 0.0
    ends = np.nanpercentile(values, (0, 50, 100)) if np.isfinite(values).any() else [np.nan] * 3
    return (
        name[0].upper() + name[1:],
        ", ".join(part for part in (symbol if symbol not in name else "", power_name(windows.unit, power)) if part),
        *(format_number(float(each)) for each in (*ends, *(part.mean() for part in parts))),
        format_percent(1 - sum(part.var() * len(part) for part in parts) / total) if total > 0 else "–",
    )
