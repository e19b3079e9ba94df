"""The pages of scans that are measured, and of one measured in windows: figures, maps, tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.core.records import Format
from curvafit.core.units import convert_length, format_length, format_number, power_name, unit_name
from curvafit.drawing import plot
from curvafit.report.comparison import describe_measures, name_quantity
from curvafit.report.page import (
    MOST_OUTLINES,
    check_result_folder,
    name_parts,
    outlines_figure,
    shorten,
    start_record,
    write_study,
)
from curvafit.scan.measures import QUANTITIES, Measures, list_quantities
from curvafit.studies.comparison import FAMILIAR
from curvafit.studies.scans import MEASURED, count_notes, list_rows, list_wide, write_measured
from curvafit.studies.windowed import NAMES, Windows

if TYPE_CHECKING:
    from curvafit.scan.centreline import Centreline

#: `format` of the record.
FORMAT = Format("curvafit measured scans", 1, title="the record of measured scans")
#: What is written into the folder.
FILES = ("measures.json", "measures.html", "measures.csv", "wide.csv", MEASURED)
FILES += ("diagrams.svg", "diagrams.png", "numbers.svg", "numbers.png", "outlines.svg", "outlines.png")
#: Maps of one scan; its centreline.
FILES += ("structure.nii.gz", "thickness.nii.gz")
FILES += ("branches.csv", "centreline.csv", "centreline.graphml", "centreline.swc", "centreline.svg", "centreline.png")
#: Of a scan measured in windows, `format` of the record.
WINDOWS_FORMAT = Format("curvafit windows", 1, title="the record of a scan measured in windows")
#: Of a scan measured in windows, what is written into the folder; maps are Zarr stores if the scan is one, else NIfTI.
WINDOWS_FILES = ("windows.json", "windows.html", "windows.csv", "windows.svg", "windows.png")
WINDOWS_FILES += ("outlines.svg", "outlines.png")
MAPS = {suffix: [f"{name.replace(' ', '_')}{suffix}" for name in NAMES] for suffix in (".nii.gz", ".ome.zarr")}
WINDOWS_FILES += (*MAPS[".nii.gz"], *MAPS[".ome.zarr"])
#: Returns the folder if `write_measures` can write there, else raises ValueError; call it before the work.
check_measures = partial(check_result_folder, FORMAT, FILES)
#: The same for `write_windows`.
check_windows = partial(check_result_folder, WINDOWS_FORMAT, WINDOWS_FILES)
#: The most scans whose diagrams and numbers are drawn.
MOST_DIAGRAMS, MOST_ROWS = 25, 100
#: Diagrams in a row, and panels of numbers in a row.
DIAGRAMS, PANELS = 5, 4


def write_measures(
    measures: Sequence[Measures],
    directory: str | Path,
    *,
    columns: Sequence[Mapping[str, str]] | None = None,
    options: Mapping[str, Any] | None = None,
    centreline: Centreline | None = None,
    maps: bool = True,
    command: str = "",
    overwrite: bool = False,
) -> Path:
    """Write the page, figures, tables and record of scans into a folder, and return the page's path.

    Lengths are in the first scan's unit. A scan with compartments has a row for each of them. The files are moved into
    the folder once all are whole; those of the same `command` (the command line, in the record) are replaced, others
    are a ValueError without `overwrite`. `columns` has further columns of each scan, such as its subject; `centreline`
    is the first scan's, whose `maps` are written if it has some; `options` are for the record.
    """
    if not measures:
        raise ValueError("expected at least one scan, got none")
    target = check_measures(directory, overwrite=overwrite, command=command)
    measures = [scan.convert(measures[0].unit) for scan in measures]
    columns = columns or [{}] * len(measures)
    unit, symbols = measures[0].unit, [each[1] for each in QUANTITIES if each[1] in (*FAMILIAR, *plot.FIRST_SHOWN)]
    titles = list(dict.fromkeys(title for row in columns for title in row))
    # A scan without compartments has itself as the only one.
    compartments = [list(scan.compartments.values()) or [scan] for scan in measures]
    parts = [part for of_scan in compartments for part in of_scan]
    names, own = name_parts(parts), [row for row, of_scan in zip(columns, compartments, strict=True) for _ in of_scan]
    rows = [
        [name, *(row.get(title, "") for title in titles), *(part[symbol].format(unit)[:2] for symbol in symbols)]
        for name, row, part in zip(names, own, parts, strict=True)
    ]
    scans = [{"scan": scan.source, "kind": scan.kind, "notes": scan.notes} for scan in measures]
    facts = {"scans": scans, "notes": list(count_notes(parts))}
    record = start_record(command, unit=unit, options=dict(options or {}), **facts)
    page = {
        "title": f"{len(measures)} scans measured" if len(measures) > 1 else "One scan measured",
        "head": ["scan", *titles, *((symbol, power_name(unit, measures[0][symbol].power)) for symbol in symbols)],
        "kinds": [""] * (1 + len(titles)), "methods": describe_measures(measures), "rows": rows,
        "omitted": {"diagrams": max(0, len(rows) - MOST_DIAGRAMS), "numbers": max(0, len(rows) - MOST_ROWS),
                    "outlines": max(0, len(measures) - MOST_OUTLINES)},
    }  # fmt: skip
    diagrams = diagrams_figure(names[:MOST_DIAGRAMS], parts[:MOST_DIAGRAMS])
    intervals = intervals_figure(names[:MOST_ROWS], parts[:MOST_ROWS]) if len(parts) > 1 else None
    outlines = outlines_figure(name_parts(measures), [scan.outline for scan in measures], unit)
    figures = {
        "outlines": (outlines, "Three slices of each scan, and the outline of its structure"),
        "centreline": (centreline and centreline_figure(measures[0], centreline), "The centreline, from three sides"),
        "diagrams": (diagrams, "The curvature diagram of each scan"),
        "numbers": (intervals, "Numbers of each scan with their intervals"),
    }
    lines = centreline.quantities if centreline else ()
    # A count is whole, and has neither an interval nor a unit.
    texts = [(f"{line.value:.0f}", "", "") if line.symbol.startswith("N.") else line.format(unit) for line in lines]
    page["branches"] = [(line.name, line.symbol, *text) for line, text in zip(lines, texts, strict=True)]
    tables = {"measures.csv": list_rows(measures, columns), "wide.csv": list_wide(measures, columns)}
    volumes = {f"{name}.nii.gz": volume for name, volume in measures[0].maps.items() if maps}
    more: dict[str, Callable[[Path], object]] = {MEASURED: partial(write_measured, measures, columns)}
    if centreline is not None:
        tables["branches.csv"] = centreline.rows()
        tables["centreline.csv"] = list_quantities(centreline.source, unit, centreline.quantities)
        more |= {"centreline.swc": centreline.write_swc, "centreline.graphml": centreline.write_graphml}
    return write_study(target, FORMAT, FILES, record, page, tables, figures=figures, maps=volumes, more=more)


# ---- figures ---------------------------------------------------------------------------------------------------------


def centreline_figure(measures: Measures, centreline: Centreline) -> Figure | None:
    """Return a figure of a centreline from three sides, coloured by radius; None where it has no branch."""
    volume, unit = measures.maps["structure"], measures.unit
    spacing = np.multiply(volume.spacing, convert_length(1.0, volume.unit, unit))
    if not (edges := [data for *_, data in centreline.graph.edges(data=True)]):
        return None
    pieces = np.concatenate([np.stack([each["points"][:-1], each["points"][1:]], 1) for each in edges])
    radii = np.concatenate([each["radii"][1:] for each in edges])
    order = np.argsort(radii)  # the thickest on top
    figure = plot.make_figure(9.0, 3.2, layout="constrained")
    panels = figure.subplots(1, 3)
    for axis, axes in enumerate(panels):
        down, across = (k for k in range(3) if k != axis)
        height, width = (volume.shape[k] * spacing[k] for k in (down, across))
        ends = (-spacing[across] / 2, width - spacing[across] / 2, height - spacing[down] / 2, -spacing[down] / 2)
        depth = volume.values.mean(axis)
        axes.imshow(depth, cmap="Greys", extent=ends, vmin=0, vmax=2 * depth.max(), interpolation="nearest")
        lines = LineCollection(list(pieces[order][:, :, [across, down]]), array=radii[order], linewidths=1.2)
        drawn = axes.add_collection(lines, autolim=False)
        axes.set_title(f"along {'zyx'[axis]}", fontsize=9)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_color(plot.QUIET)
    plot.scale_on(panels[0], 1.0, unit)
    bar = figure.colorbar(drawn, ax=list(panels), label=f"radius ({unit_name(unit, 2)})", shrink=0.85)
    bar.ax.tick_params(labelsize=8, length=2)
    return figure


def measures_figure(measures: Measures) -> Figure:
    """Return a figure of the curvature diagram of a scan, or of each of its compartments."""
    parts = list(measures.compartments.values()) or [measures]
    return diagrams_figure(name_parts(parts), parts)


def diagrams_figure(names: Sequence[str], measures: Sequence[Measures]) -> Figure:
    """Return a figure of the curvature diagrams of scans of one unit, all on the same axes."""
    limits = plot.shared_limits([scan.diagram for scan in measures if scan.diagram.area > 0])
    columns, rows = min(DIAGRAMS, len(names)), math.ceil(len(names) / DIAGRAMS)
    figure = plot.make_figure(2.6 * columns, 2.7 * rows, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    for axes, name, scan in zip(panels, shorten(names), measures, strict=False):
        axes.set_title(plot.plain(name), fontsize=9)
        if not scan.diagram.area > 0:
            axes.text(0.5, 0.5, "no surface", ha="center", transform=axes.transAxes, color=plot.QUIET)
            axes.set(xticks=[], yticks=[])
            continue
        plot.diagram_on(axes, scan.diagram, limits=limits)
        axes.tick_params(labelsize=7)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(8)
    return figure


def intervals_figure(names: Sequence[str], measures: Sequence[Measures]) -> Figure:
    """Return a figure of the numbers `FIRST_SHOWN` of scans of one unit, a row for each scan, with 95 % intervals."""
    rows = math.ceil(len(plot.FIRST_SHOWN) / PANELS)
    figure = plot.make_figure(3.0 * PANELS, rows * (0.9 + 0.19 * max(len(names), 4)), layout="constrained")
    panels = figure.subplots(rows, PANELS, sharey=True)
    heights = range(len(names), 0, -1)  # the first scan on top
    for axes, symbol in zip(panels.ravel(), plot.FIRST_SHOWN, strict=True):
        quantities = [scan[symbol] for scan in measures]
        values = np.array([quantity.value for quantity in quantities])
        halves = np.nan_to_num([quantity.half for quantity in quantities])
        low, high = values - halves, values + halves
        low = low if symbol in plot.SIGNED else np.maximum(0.0, low)
        axes.hlines(heights, low, high, color=plot.FIRST, alpha=0.4, linewidth=1.6)
        axes.plot(values, heights, "o", color=plot.FIRST, markersize=4, markeredgewidth=0)
        unit = power_name(measures[0].unit, quantities[0].power)
        axes.set_title(symbol + (f" ({unit})" if unit else ""), fontsize=10)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(axis="y", color="#E5E7EB", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(plot.QUIET)
    panels[0, 0].set_yticks(heights, [plot.plain(name) for name in shorten(names)])
    panels[0, 0].set_ylim(0.4, len(names) + 0.6)
    return figure


# ---- a scan in windows -----------------------------------------------------------------------------------------------


def write_windows(windows: Windows, directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write the page, maps, figure, table and record of windows into a folder, and return the page's path.

    What is replaced, and `command`, are as in `write_measures`.
    """
    source = windows.grid.source
    target = check_windows(directory, [source] if source else [], overwrite, command)
    record = start_record(
        command, unit=windows.unit, options=windows.options, status=windows.status, notes=windows.notes,
        scan=source, kind=windows.kind,
    )  # fmt: skip
    rows = [_format_row(windows, k) for k in range(len(NAMES))]
    page = {"title": "A scan in windows", "head": ["", "", "least", "median", "greatest"], "rows": rows}
    outlines = outlines_figure([Path(source).name], [windows.outline], windows.unit)
    figures = {
        "outlines": (outlines, "Three slices of the scan, and the outline of its structure"),
        "windows": (windows_figure(windows), "Maps of six numbers, on three slices"),
    }
    names = MAPS[".ome.zarr" if ".zarr" in source.lower() else ".nii.gz"]
    maps = dict(zip(names, map(windows.__getitem__, NAMES), strict=True))
    tables = {"windows.csv": _rows(windows)}
    return write_study(target, WINDOWS_FORMAT, WINDOWS_FILES, record, page, tables, figures=figures, maps=maps)


def _rows(windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield a row for each window: its centre and quantities; None where a value is not known."""
    for index in np.ndindex(windows.grid.shape):
        centre = dict(zip("zyx", windows.centres[index].tolist(), strict=True))
        values = (value if np.isfinite(value) else None for value in windows.values[index].tolist())
        yield {**centre, "unit": windows.unit} | dict(zip(NAMES, values, strict=True))


def _format_row(windows: Windows, k: int) -> list[str]:
    """Return the page's table row of quantity k: name, symbol and unit, least, median and greatest."""
    values = windows.values[..., k]
    percentiles = np.nanpercentile(values, (0, 50, 100)) if np.isfinite(values).any() else [np.nan] * 3
    return [*name_quantity(*QUANTITIES[k][:3], windows.unit), *(format_number(float(value)) for value in percentiles)]


def windows_figure(windows: Windows) -> Figure:
    """Return a figure of the maps of familiar numbers, each on the middle slices of windows across z, y and x."""
    familiar = [quantity for quantity in QUANTITIES if quantity[1] in plot.FAMILIAR]
    figure = plot.make_figure(8.4, 2.6 * len(familiar), layout="constrained")
    rows = figure.subplots(len(familiar), 3)
    middle = tuple(n // 2 for n in windows.grid.shape)
    for axes, name, place in zip(rows[0], "zyx", windows.centres[middle], strict=True):
        axes.set_title(f"{name} = {format_length(place, windows.unit)}", fontsize=9)
    for row, (name, symbol, power, _) in zip(rows, familiar, strict=True):
        values = windows[name].values
        known = values[np.isfinite(values)]
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        for axis, axes in enumerate(row):
            down, across = np.delete(windows.grid.spacing, axis)
            plane, colours = values.take(middle[axis], axis), {"vmin": low, "vmax": high, "cmap": "viridis"}
            picture = axes.imshow(plane, aspect=down / across, interpolation="nearest", **colours)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_color(plot.QUIET)
        label = f"{symbol} ({power_name(windows.unit, power)})" if power else symbol
        bar = figure.colorbar(picture, ax=list(row), label=label, ticks=MaxNLocator(5), shrink=0.85)
        bar.ax.tick_params(labelsize=8, length=2)
    plot.scale_on(rows[-1, 0], windows.grid.spacing[2], windows.unit)
    return figure
