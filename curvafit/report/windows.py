"""The page of a scan measured in windows, its maps and its table."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from curvafit.core.records import Format
from curvafit.core.units import format_length, format_number, format_percent, power_name, unit_name
from curvafit.drawing.plot import FAMILIAR, INK, LABELS, QUIET, make_figure, scale_on
from curvafit.report.comparison import name_quantity
from curvafit.report.page import check_result_folder, start_record, write_study
from curvafit.scan.measures import QUANTITIES
from curvafit.studies.windowed import NAMES, Windows

#: `format` of the record.
FORMAT = Format("curvafit windows", 1, title="the record of a scan measured in windows")
#: What is written into the folder beside the maps.
FILES = ("windows.json", "windows.html", "windows.csv", "windows.svg", "windows.png")
#: Grey of structure whose windows are not known.
UNKNOWN = 0.88
#: Colours of clusters from 0 on: the strong ones of labels first.
COLOURS = np.vstack([LABELS[:1], LABELS[1::2], LABELS[2::2]])


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
    record = start_record(
        command, unit=windows.unit, options=windows.options, status=windows.status, notes=windows.notes,
        scan=source, kind=windows.kind, explained=windows.explained,
    )  # fmt: skip
    rows = [_format_row(windows, k) for k in range(len(NAMES))]
    clusters = range(1, 1 + int(windows.clusters.values.max()))
    page = {"title": "A scan in windows", "clusters": clusters, "rows": rows}
    drawn = {"windows": (windows_figure(windows), "The structure, coloured by clusters and by six numbers")}
    fields = (windows.clusters, *map(windows.__getitem__, NAMES))
    maps = dict(zip(files[len(FILES) :], fields, strict=True))
    told = ("scan", "command", "date", "options")
    return write_study(
        target, FORMAT, files, record, page, {"windows.csv": _rows(windows)}, figures=drawn, maps=maps, told=told
    )


def _rows(windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield a row for each window: its centre, cluster and numbers; None where a number is not known."""
    for place in np.ndindex(windows.clusters.shape):
        values, centre = windows.values[place], zip("zyx", windows.centres[place].tolist(), strict=True)
        numbers = zip(NAMES, (each if np.isfinite(each) else None for each in values.tolist()), strict=True)
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
    return {**name_quantity(*QUANTITIES[k][:3], windows.unit), "cells": cells}


# ---- the picture -----------------------------------------------------------------------------------------------------


def windows_figure(windows: Windows) -> Figure:
    """Return a figure of the clusters on the middle slices, and of familiar numbers where they are least and greatest.

    Each voxel of the structure has the colour of the nearest window, grey where this is not known. A number's two
    slices are across z, through the windows of its extremes, which are framed; its colours go from one to the other.
    """
    figure = make_figure(13.2, 13.2, layout="constrained")
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
    pairs = panels[1:].reshape(len(FAMILIAR), 2)
    familiar = [each for each in QUANTITIES if each[1] in FAMILIAR]
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
            axes.add_patch(Rectangle(corner[::-1], *edges[::-1], fill=False, edgecolor=INK, linestyle=(0, (4, 3))))
        if not ends:
            pair[0].set_title(f"{label} is not known", fontsize=9.5)
            continue
        scale_on(pair[0], 1.0, windows.unit)
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
    axes.spines[:].set_color(QUIET)
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
