"""The page of many scans that are measured, its figures and its table, and a paragraph on the methods."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.core.records import Format
from curvafit.core.units import format_number, power_name
from curvafit.drawing.groups import FIRST, FIRST_SHOWN, SIGNED, plain, shown_window
from curvafit.drawing.plot import QUIET, diagram_on, make_figure
from curvafit.report.comparison import describe_measures, say_kinds
from curvafit.report.page import check_result_folder, start_record, write_study
from curvafit.scan.measures import Measures
from curvafit.studies.scans import count_notes, list_rows

#: `format` of the record.
FORMAT = Format("curvafit measured scans", 1, title="the record of measured scans")
#: What is written into the folder.
FILES = ("measures.json", "measures.html", "measures.csv", "diagrams.svg", "diagrams.png", "numbers.svg", "numbers.png")
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
    measures = [each.convert(measures[0].unit) for each in measures]
    told = columns or [{}] * len(measures)
    rows = [
        (part, more)
        for each, more in zip(measures, told, strict=True)
        for part in each.compartments.values() or (each,)
    ]
    parts = [part for part, _ in rows]
    names, heads = name_parts(parts), list(dict.fromkeys(name for _, more in rows for name in more))
    scans, unit = [{"scan": each.source, "kind": each.kind, "notes": each.notes} for each in measures], measures[0].unit
    more = {"status": describe_range(parts), "scans": scans, "notes": list(count_notes(parts))}
    record = start_record(command, unit=unit, options=dict(options or {}), **more)
    count = f"{len(measures)} scans were" if len(measures) > 1 else "A scan was"
    methods = [
        f"{count} measured with curvafit {version('curvafit')}; {say_kinds(measures)}.",
        "Intervals are 95 %, by a jackknife over blocks of one period of the structure: they tell how well a scan "
        "shows the mean of the structure that it was cut from.",
        *describe_measures(measures),
    ]
    cells = []
    for name, (part, more) in zip(names, rows, strict=True):
        pairs = [(each.value, each.half) for each in (part[symbol] for symbol in FIRST_SHOWN)]
        pairs = [(format_number(x), f"± {format_number(half, 2)}" if math.isfinite(half) else "") for x, half in pairs]
        cells.append({"name": name, "told": [more.get(head, "") for head in heads], "cells": pairs})
    page = {
        "title": f"{len(measures)} scans measured" if len(measures) > 1 else "One scan measured",
        "symbols": [(symbol, power_name(unit, measures[0][symbol].power)) for symbol in FIRST_SHOWN],
        "left": {"diagrams": max(0, len(rows) - MOST_DIAGRAMS), "numbers": max(0, len(rows) - MOST_ROWS)},
        "heads": heads, "rows": cells, "methods": " ".join(methods),
    }  # fmt: skip
    diagrams = diagrams_figure(names[:MOST_DIAGRAMS], parts[:MOST_DIAGRAMS])
    numbers = intervals_figure(names[:MOST_ROWS], parts[:MOST_ROWS])
    drawn = {
        "diagrams": (diagrams, "The curvature diagram of each scan"),
        "numbers": (numbers, "Numbers of each scan with their intervals"),
    }
    return write_study(target, FORMAT, FILES, record, page, {"measures.csv": list_rows(measures, told)}, figures=drawn)


def describe_range(parts: Sequence[Measures]) -> str:
    """Return what the numbers of scans of one unit span, in some sentences."""
    said, names = [], name_parts(parts)
    for symbol in ("BV/TV", "Tb.Th", "Tb.Sp"):
        known = [(part[symbol], name) for name, part in zip(names, parts, strict=True)]
        known = [each for each in known if math.isfinite(each[0].value)]
        if not known:
            continue
        (least, first), (most, last) = (end(known, key=lambda each: each[0].value) for end in (min, max))
        unit = power_name(parts[0].unit, least.power)
        values = [f"{format_number(each.value)} {unit}".strip() for each in (least, most)]
        span = f"from {values[0]} ({first}) to {values[1]} ({last})" if len(known) > 1 else values[0]
        said.append(f"{least.name[0].upper()}{least.name[1:]} {span}.")
    return " ".join(said)


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
    known = [each.diagram for each in measures if each.diagram.area > 0]
    across, up = shown_window(known) if known else ((0.0, 1.0), (0.0, 1.0))
    columns, rows = min(DIAGRAMS, len(names)), -(-len(names) // DIAGRAMS)
    ratio = min(1.6, (up[1] - up[0]) / (across[1] - across[0]))
    figure = make_figure(2.6 * columns, (2.1 * ratio + 0.6) * rows, layout="constrained")
    panels, words = figure.subplots(rows, columns, squeeze=False).ravel(), shorten(names)
    for k, axes in enumerate(panels):
        if k >= len(names):
            axes.set_axis_off()
            continue
        axes.set_title(plain(words[k]), fontsize=9)
        if not measures[k].diagram.area > 0:
            axes.text(0.5, 0.5, "no surface", ha="center", transform=axes.transAxes, color=QUIET)
            axes.set(xticks=[], yticks=[])
            continue
        limits = min(across[0], up[0]), max(across[1], up[1])
        diagram_on(axes, measures[k].diagram, limits=limits, unit=measures[k].unit, window=(across, up))
        axes.tick_params(labelsize=7)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(8)
    return figure


def intervals_figure(names: Sequence[str], measures: Sequence[Measures]) -> Figure:
    """Return a figure of eight numbers of scans of one unit, a row for each scan, with 95 % intervals."""
    rows = -(-len(FIRST_SHOWN) // PANELS)
    figure = make_figure(12.0, rows * (0.9 + 0.19 * max(len(names), 4)), layout="constrained")
    panels = figure.subplots(rows, PANELS, sharey=True)
    places = range(len(names), 0, -1)
    for axes, symbol in zip(panels.ravel(), FIRST_SHOWN, strict=True):
        found = [each[symbol] for each in measures]
        values = np.array([each.value for each in found])
        halves = np.nan_to_num([each.half for each in found])
        low, high = values - halves, values + halves
        low = low if symbol in SIGNED else np.maximum(0.0, low)
        axes.hlines(places, low, high, color=FIRST, alpha=0.4, linewidth=1.6)
        axes.plot(values, places, "o", color=FIRST, markersize=4, markeredgewidth=0)
        unit = power_name(measures[0].unit, found[0].power)
        axes.set_title(symbol + (f" ({unit})" if unit else ""), fontsize=10)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(axis="y", color="#E5E7EB", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(QUIET)
    panels[0, 0].set_yticks(places, [plain(name) for name in shorten(names)])
    panels[0, 0].set_ylim(0.4, len(names) + 0.6)
    return figure


def shorten(names: Sequence[str]) -> list[str]:
    """Return names that a panel has room for: of a long one its end, with a number where two would be alike."""
    short = [name if len(name) <= WORD else f"…{name[1 - WORD :]}" for name in names]
    return [name if short.count(name) == 1 else f"{k} {name}" for k, name in enumerate(short, 1)]
