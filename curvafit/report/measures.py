"""The pages of scans that are measured, and of one measured in windows: figures, maps, tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from curvafit.core.records import Format
from curvafit.core.units import format_length, format_number, format_percent, power_name, unit_name
from curvafit.drawing import plot
from curvafit.report.comparison import describe_measures, name_quantity
from curvafit.report.page import check_result_folder, start_record, write_study
from curvafit.scan.measures import QUANTITIES, Measures, Quantity
from curvafit.studies.scans import count_notes, list_rows
from curvafit.studies.windowed import NAMES, Windows

#: `format` of the record.
FORMAT = Format("curvafit measured scans", 1, title="the record of measured scans")
#: What is written into the folder.
FILES = ("measures.json", "measures.html", "measures.csv", "diagrams.svg", "diagrams.png", "numbers.svg", "numbers.png")
#: Of a scan measured in windows, `format` of the record.
WINDOWS_FORMAT = Format("curvafit windows", 1, title="the record of a scan measured in windows")
#: Of a scan measured in windows, what is written into the folder beside the maps.
WINDOWS_FILES = ("windows.json", "windows.html", "windows.csv", "windows.svg", "windows.png")
#: Grey of structure whose windows are not known.
UNKNOWN = 0.88
#: Colours of clusters from 0 on: the strong ones of labels first.
COLOURS = np.vstack([plot.LABELS[:1], plot.LABELS[1::2], plot.LABELS[2::2]])
#: Returns the folder if `write_measures` can write there, else raises ValueError; call it before the work.
check_measures = partial(check_result_folder, FORMAT, FILES)
#: The most scans whose diagrams and numbers are drawn.
MOST_DIAGRAMS, MOST_ROWS = 25, 100
#: Diagrams in a row, and panels of numbers in a row; letters of a scan's name that a panel has room for.
DIAGRAMS, PANELS, WORD = 5, 4, 22


def write_measures(
    measures: Sequence[Measures],
    directory: str | Path,
    *,
    columns: Sequence[Mapping[str, str]] | None = None,
    options: Mapping[str, Any] | None = None,
    command: str = "",
    overwrite: bool = False,
) -> Path:
    """Write the page, figures, table and record of scans into a folder, and return the page's path.

    Lengths are in the first scan's unit. A scan with compartments has a row for each of them. The files (`FILES`) are
    moved into the folder once all are whole; those of the same command are replaced, others are a ValueError without
    `overwrite`. `columns` has further columns of each scan, such as its subject; `options` and `command` are for the
    record.
    """
    if not measures:
        raise ValueError("expected at least one scan, got none")
    target = check_measures(directory, overwrite=overwrite, command=command)
    measures = [scan.convert(measures[0].unit) for scan in measures]
    columns = columns or [{}] * len(measures)
    rows = [
        (part, more)
        for each, more in zip(measures, columns, strict=True)
        for part in each.compartments.values() or (each,)
    ]
    parts, unit = [part for part, _ in rows], measures[0].unit
    names, further = name_parts(parts), list(dict.fromkeys(name for _, more in rows for name in more))
    scans = [{"scan": scan.source, "kind": scan.kind, "notes": scan.notes} for scan in measures]
    more = {"status": describe_range(parts), "scans": scans, "notes": list(count_notes(parts))}
    record = start_record(command, unit=unit, options=dict(options or {}), **more)
    page = {
        "title": f"{len(measures)} scans measured" if len(measures) > 1 else "One scan measured",
        "head": ["scan", *further, *((each, power_name(unit, measures[0][each].power)) for each in plot.FIRST_SHOWN)],
        "kinds": [""] * (1 + len(further)), "methods": describe_measures(measures),
        "rows": [
            [name, *(more.get(head, "") for head in further), *(_format_cell(part[each]) for each in plot.FIRST_SHOWN)]
            for name, (part, more) in zip(names, rows, strict=True)
        ],
        "omitted": {"diagrams": max(0, len(rows) - MOST_DIAGRAMS), "numbers": max(0, len(rows) - MOST_ROWS)},
    }  # fmt: skip
    diagrams = diagrams_figure(names[:MOST_DIAGRAMS], parts[:MOST_DIAGRAMS])
    numbers = intervals_figure(names[:MOST_ROWS], parts[:MOST_ROWS])
    drawn = {
        "diagrams": (diagrams, "The curvature diagram of each scan"),
        "numbers": (numbers, "Numbers of each scan with their intervals"),
    }
    tables = {"measures.csv": list_rows(measures, columns)}
    return write_study(target, FORMAT, FILES, record, page, tables, figures=drawn)


def _format_cell(quantity: Quantity) -> tuple[str, str]:
    half = f"± {format_number(quantity.half, 2)}" if math.isfinite(quantity.half) else ""
    return format_number(quantity.value), half


def describe_range(parts: Sequence[Measures]) -> str:
    """Return what the numbers of scans of one unit span, in some sentences."""
    sentences, names = [], name_parts(parts)
    for symbol in ("BV/TV", "Tb.Th", "Tb.Sp"):
        known = [(part[symbol], name) for name, part in zip(names, parts, strict=True)]
        known = [each for each in known if math.isfinite(each[0].value)]
        if not known:
            continue
        (least, first), (most, last) = (end(known, key=lambda each: each[0].value) for end in (min, max))
        unit = power_name(parts[0].unit, least.power)
        values = [f"{format_number(each.value)} {unit}".strip() for each in (least, most)]
        span = f"from {values[0]} ({first}) to {values[1]} ({last})" if len(known) > 1 else values[0]
        sentences.append(f"{least.name[0].upper()}{least.name[1:]} {span}.")
    return " ".join(sentences)


def name_parts(parts: Sequence[Measures]) -> list[str]:
    """Return the names of scans' files, or their paths where two have one name, with the part each is."""
    sources: dict[str, set[str]] = {}
    for each in parts:
        sources.setdefault(Path(each.source).name, set()).add(each.source)
    names = (
        file if len(sources[file := Path(each.source).name]) == 1 and file else each.source or f"array {k}"
        for k, each in enumerate(parts, 1)
    )
    return [f"{name}, {' '.join(map(str, each.part))}" if each.part else name
            for name, each in zip(names, parts, strict=True)]  # fmt: skip


# ---- figures ---------------------------------------------------------------------------------------------------------


def measures_figure(measures: Measures) -> Figure:
    """Return a figure of the curvature diagram of a scan, or of each of its compartments."""
    parts = list(measures.compartments.values()) or [measures]
    return diagrams_figure(name_parts(parts), parts)


def diagrams_figure(names: Sequence[str], measures: Sequence[Measures]) -> Figure:
    """Return a figure of the curvature diagrams of scans of one unit, on axes that all share; of some none is known."""
    known = [scan.diagram for scan in measures if scan.diagram.area > 0]
    across, up = plot.shown_window(known) if known else ((0.0, 1.0), (0.0, 1.0))
    columns, rows = min(DIAGRAMS, len(names)), -(-len(names) // DIAGRAMS)
    ratio = min(1.6, (up[1] - up[0]) / (across[1] - across[0]))
    figure = plot.make_figure(2.6 * columns, (2.1 * ratio + 0.6) * rows, layout="constrained")
    panels, words = figure.subplots(rows, columns, squeeze=False).ravel(), shorten(names)
    for k, axes in enumerate(panels):
        if k >= len(names):
            axes.set_axis_off()
            continue
        axes.set_title(plot.plain(words[k]), fontsize=9)
        if not measures[k].diagram.area > 0:
            axes.text(0.5, 0.5, "no surface", ha="center", transform=axes.transAxes, color=plot.QUIET)
            axes.set(xticks=[], yticks=[])
            continue
        limits = min(across[0], up[0]), max(across[1], up[1])
        plot.diagram_on(axes, measures[k].diagram, limits=limits, unit=measures[k].unit, window=(across, up))
        axes.tick_params(labelsize=7)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(8)
    return figure


def intervals_figure(names: Sequence[str], measures: Sequence[Measures]) -> Figure:
    """Return a figure of eight numbers of scans of one unit, a row for each scan, with 95 % intervals."""
    rows = -(-len(plot.FIRST_SHOWN) // PANELS)
    figure = plot.make_figure(12.0, rows * (0.9 + 0.19 * max(len(names), 4)), layout="constrained")
    panels = figure.subplots(rows, PANELS, sharey=True)
    places = range(len(names), 0, -1)
    for axes, symbol in zip(panels.ravel(), plot.FIRST_SHOWN, strict=True):
        found = [scan[symbol] for scan in measures]
        values = np.array([each.value for each in found])
        halves = np.nan_to_num([each.half for each in found])
        low, high = values - halves, values + halves
        low = low if symbol in plot.SIGNED else np.maximum(0.0, low)
        axes.hlines(places, low, high, color=plot.FIRST, alpha=0.4, linewidth=1.6)
        axes.plot(values, places, "o", color=plot.FIRST, markersize=4, markeredgewidth=0)
        unit = power_name(measures[0].unit, found[0].power)
        axes.set_title(symbol + (f" ({unit})" if unit else ""), fontsize=10)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(axis="y", color="#E5E7EB", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(plot.QUIET)
    panels[0, 0].set_yticks(places, [plot.plain(name) for name in shorten(names)])
    panels[0, 0].set_ylim(0.4, len(names) + 0.6)
    return figure


def shorten(names: Sequence[str]) -> list[str]:
    """Return names that a panel has room for: of a long one its end, with a number where two would be alike."""
    short = [name if len(name) <= WORD else f"…{name[1 - WORD :]}" for name in names]
    return [name if short.count(name) == 1 else f"{k} {name}" for k, name in enumerate(short, 1)]


# ---- a scan in windows -----------------------------------------------------------------------------------------------


def list_files(source: str | Path) -> tuple[str, ...]:
    """Return the names of all files: the maps of a Zarr store are Zarr stores, of any other scan NIfTI."""
    suffix = ".ome.zarr" if ".zarr" in str(source).lower() else ".nii.gz"
    return (*WINDOWS_FILES, *(f"{name.replace(' ', '_')}{suffix}" for name in ("clusters", *NAMES)))


def check_windows(directory: str | Path, source: str | Path = "", overwrite: bool = False, command: str = "") -> Path:
    """Return the folder if `write_windows` can write there, else raise ValueError; call it before the work."""
    inputs = [source] if source else []
    return check_result_folder(WINDOWS_FORMAT, list_files(source), directory, inputs, overwrite, command)


def write_windows(windows: Windows, directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write the page, maps, figure, table and record of windows into a folder, and return the page's path.

    The files are moved into the folder once all are whole. Those of the same command are replaced; others are a
    ValueError without `overwrite`. `command` is what the record calls the command line.
    """
    source = windows.clusters.source
    target, files = check_windows(directory, source, overwrite, command), list_files(source)
    record = start_record(
        command, unit=windows.unit, options=windows.options, status=windows.status, notes=windows.notes,
        scan=source, kind=windows.kind, explained=windows.explained,
    )  # fmt: skip
    rows = [_format_row(windows, k) for k in range(len(NAMES))]
    clusters = (f"cluster {k}" for k in range(1, 1 + int(windows.clusters.values.max())))
    head = ["", "", "least", "median", "most", *clusters, "between"]
    page = {"title": "A scan in windows", "head": head, "rows": rows}
    drawn = {"windows": (windows_figure(windows), "The structure, coloured by clusters and by six numbers")}
    fields = (windows.clusters, *map(windows.__getitem__, NAMES))
    maps = dict(zip(files[len(WINDOWS_FILES) :], fields, strict=True))
    shown = ("scan", "command", "date", "options")
    tables = {"windows.csv": _rows(windows)}
    return write_study(target, WINDOWS_FORMAT, files, record, page, tables, figures=drawn, maps=maps, shown=shown)


def _rows(windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield a row for each window: its centre, cluster and numbers; None where a number is not known."""
    for place in np.ndindex(windows.clusters.shape):
        values, centre = windows.values[place], zip("zyx", windows.centres[place].tolist(), strict=True)
        numbers = zip(NAMES, (each if np.isfinite(each) else None for each in values.tolist()), strict=True)
        yield {**dict(centre), "unit": windows.unit, "cluster": int(windows.clusters.values[place]), **dict(numbers)}


def _format_row(windows: Windows, k: int) -> list[str]:
    """Return a row of the page's table: a number's name, range, cluster means, and share of variance between these."""
    values = windows.values[..., k]
    labels = np.where(np.isfinite(values), windows.clusters.values, 0)
    parts = [values[labels == label] for label in range(1, 1 + int(windows.clusters.values.max()))]
    means = [float(part.mean()) if len(part) else np.nan for part in parts]
    total = float(np.var(values[labels > 0]) * np.count_nonzero(labels)) if labels.any() else 0.0
    ends = np.nanpercentile(values, (0, 50, 100)) if np.isfinite(values).any() else [np.nan] * 3
    between = format_percent(1 - sum(part.var() * len(part) for part in parts if len(part)) / total) if total else "–"
    numbers = (format_number(float(each)) for each in (*ends, *means))
    return [*name_quantity(*QUANTITIES[k][:3], windows.unit), *numbers, between]


def windows_figure(windows: Windows) -> Figure:
    """Return a figure of the clusters on the middle slices, and of familiar numbers where they are least and greatest.

    Each voxel of the structure has the colour of the nearest window, grey where this is not known. A number's two
    slices are across z, through the windows of its extremes, which are framed; its colours go from one to the other.
    """
    figure = plot.make_figure(13.2, 13.2, layout="constrained")
    panels = figure.subplots(4, 4)
    structure = windows.structure
    for axis, axes in enumerate(panels[0, :3]):
        place = structure.shape[axis] // 2
        plane = _colour_structure(windows, windows.clusters.values, axis, place)
        shown = COLOURS[np.where(np.isfinite(plane), plane, 0).astype(int)]
        shown[~np.isfinite(plane) | (plane == 0)] = 0
        _section_on(axes, windows, shown, axis, place)
        axes.set_title(f"clusters, {_position(windows, axis, place)}", fontsize=9.5)
    _legend_on(panels[0, 3], windows)
    pairs = panels[1:].reshape(len(plot.FAMILIAR), 2)
    familiar = [each for each in QUANTITIES if each[1] in plot.FAMILIAR]
    for pair, (name, symbol, power, _) in zip(pairs, familiar, strict=True):
        values = windows[name].values
        label = f"{symbol} ({power_name(windows.unit, power)})" if power else symbol
        ends = windows.extremes(name)
        for axes, word, window in zip(pair, ("least", "greatest"), ends, strict=False):
            low, high = (values[end] for end in ends)
            place = _fullest_slice(windows, window)
            plane = _colour_structure(windows, values, 0, place)
            picture = _section_on(axes, windows, plane, 0, place, vmin=low, vmax=max(high, low + 1e-12), cmap="viridis")
            extreme = format_number(values[window] + 0.0)  # of -0 as well
            axes.set_title(f"{word} {symbol}: {extreme}, {_position(windows, 0, place)}", fontsize=9.5)
            axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
            edges = (np.array(windows.size) * windows.clusters.spacing / windows.stride)[1:]
            corner = windows.centres[window][1:] - edges / 2
            axes.add_patch(Rectangle(corner[::-1], *edges[::-1], fill=False, edgecolor=plot.INK, linestyle=(0, (4, 3))))
        if not ends:
            pair[0].set_title(f"{label} is not known", fontsize=9.5)
            continue
        plot.scale_on(pair[0], 1.0, windows.unit)
        bar = figure.colorbar(picture, ax=list(pair), label=label, ticks=MaxNLocator(5), pad=0.02, shrink=0.85)
        bar.ax.tick_params(labelsize=8, length=2)
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _position(windows: Windows, axis: int, place: int) -> str:
    """Return where a slice lies, in the scan's unit."""
    where = place * windows.structure.spacing[axis]
    return f"{'zyx'[axis]} = {format_number(where)} {unit_name(windows.unit, 2)}"


def _legend_on(axes: Axes, windows: Windows) -> None:
    """Write which colour is which cluster, with its number of windows and its thickness."""
    labels, thickness = windows.clusters.values, windows["thickness"].values
    marks = [Patch(color=str(UNKNOWN), label=f"not known: {(labels == 0).sum()} of {labels.size}")] * bool(
        (labels == 0).any()
    )
    for k in range(1, 1 + int(labels.max())):
        mean = format_length(float(thickness[labels == k].mean()), windows.unit)
        marks.append(Patch(color=COLOURS[k], label=f"{k}: {(labels == k).sum()} windows, {mean} thick"))
    axes.set_axis_off()
    axes.legend(handles=marks, title="cluster", loc="center left", frameon=False, fontsize=9.5, alignment="left")


def _section_on(axes: Axes, windows: Windows, plane: np.ndarray, axis: int, place: int, **colours: Any) -> Any:
    """Draw a slice over the structure in grey, with positions in the scan's unit, and return its picture."""
    mask, (down, across) = windows.structure.values.take(place, axis), np.delete(windows.structure.spacing, axis)
    rows, columns = mask.shape
    extent = (-across / 2, (columns - 0.5) * across, (rows - 0.5) * down, -down / 2)
    axes.imshow(np.where(mask, UNKNOWN, 1.0), cmap="gray", vmin=0, vmax=1, extent=extent)
    axes.locator_params(nbins=4)
    axes.tick_params(length=2, labelsize=8)
    axes.spines[:].set_color(plot.QUIET)
    named = [f"{name} ({unit_name(windows.unit, 2)})" for k, name in enumerate("zyx") if k != axis]
    axes.set_ylabel(named[0], fontsize=8)
    axes.set_xlabel(named[1], fontsize=8)
    return axes.imshow(plane, extent=extent, interpolation="nearest", **colours)


def _nearest(windows: Windows, axis: int) -> np.ndarray:
    """Return for each plane of voxels across an axis the number of the nearest windows along it."""
    count, step = windows.clusters.shape[axis], windows.clusters.spacing[axis]
    places = np.arange(windows.structure.shape[axis]) * windows.structure.spacing[axis]
    return np.clip(np.rint((places - windows.centres[0, 0, 0, axis]) / step).astype(int), 0, count - 1)


def _fullest_slice(windows: Windows, window: tuple[int, ...]) -> int:
    """Return the number of the slice across z that has most structure in a window's colour."""
    near = [_nearest(windows, axis) == k for axis, k in enumerate(window)]
    inside = windows.structure.values[np.ix_(*near)].sum((1, 2))
    return int(np.flatnonzero(near[0])[inside.argmax()])


def _colour_structure(windows: Windows, values: np.ndarray, axis: int, place: int) -> np.ndarray:
    """Return each voxel's value on a slice across an axis, the nearest window's; NaN off the structure."""
    nearest = [_nearest(windows, k) for k in range(3)]
    rows, columns = (places for k, places in enumerate(nearest) if k != axis)
    plane = values.take(nearest[axis][place], axis)[np.ix_(rows, columns)]
    return np.where(windows.structure.values.take(place, axis), plane, np.nan)
