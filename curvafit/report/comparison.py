"""The page of scans that are compared, its tables and figures, and a paragraph on the methods."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from curvafit.core.records import Format
from curvafit.core.units import format_number, format_percent, plain_unit, power_name
from curvafit.drawing import plot
from curvafit.report.page import (
    MOST_OUTLINES,
    Chosen,
    check_result_folder,
    outlines_figure,
    render,
    start_record,
    write_study,
)
from curvafit.scan.measures import Measures
from curvafit.studies.comparison import LEVEL, Comparison, Number, join_names
from curvafit.studies.scans import list_wide, merge_notes

#: `format` of a comparison's record.
FORMAT = Format("curvafit comparison", 1, title="the record of a comparison")
#: What a comparison writes into its folder.
FILES = ("compare.json", "compare.html", "measures.csv", "wide.csv", "subjects.csv", "numbers.csv")
_PICTURES = ("difference", "numbers", "all_numbers", "outlines")
FILES += tuple(f"{name}.{kind}" for name in _PICTURES for kind in ("svg", "png"))
#: Colours of what is less and of what is more.
MORE = LinearSegmentedColormap.from_list("more", [plot.FIRST, "#8CC0E0", "#FFFFFF", "#F0B48A", plot.SECOND])
#: Symbols of the familiar numbers of bodies; the most bodies of a subject that have a point in a figure, and the
#: percentiles of all that its axis spans.
OF_BODIES, POINTS, SPAN = ("V", "S", "Ψ", "E"), 300, (5, 95)
#: Letters of groups' names that a panel has room for, and diagrams or panels in a row.
WORDS, ROW = 28, 4
#: Returns the folder if `write_comparison` can write there, else raises ValueError; call it before the work.
check_comparison = partial(check_result_folder, FORMAT, FILES)


def write_comparison(
    comparison: Comparison,
    directory: str | Path,
    *,
    command: str = "",
    overwrite: bool = False,
) -> Path:
    """Write the page, figures, tables and record of a comparison into a folder, and return the page's path.

    What is replaced, and `command`, are as in `write_measures`.
    """
    target = check_comparison(directory, overwrite=overwrite, command=command)
    c = comparison
    label, change = ("group", "difference") if c.groups else ("number", "slope")
    record = start_record(command, unit=c.unit, options=c.options, status=c.status, notes=c.notes)
    scans = [
        {"scan": scan.source, "subject": case.subject, label: case.label, "kind": scan.kind, "notes": list(scan.notes)}
        | ({} if case.roi is None else {"roi": str(case.roi)})
        | ({"table": case.name} if c.of_bodies else {})
        for scan, case in zip(c.measures, c.cases, strict=True)
    ]
    record["scans"] = list({str(scan): scan for scan in scans}.values()) if c.of_bodies else scans
    page = {
        "title": c.verdict, "scans": "; ".join(_count_scans(c)) + ".", "groups": c.groups, "effect": c.effect,
        "head": ["", "", *c.groups, change, c.effect, "95 %", "p", "family-wise", "known error"],
        "rows": [_format_row(number, c) for number in c.numbers], "level": f"{LEVEL:.2g}",
        "methods": describe_methods(c), "count": c.count, "of_bodies": c.of_bodies,
        "omitted": max(0, len(c.measures) - MOST_OUTLINES),
    }  # fmt: skip
    names = [f"{case.label if c.groups else f'{c.by} {case.label:g}'} · {Path(case.name).name}" for case in c.cases]
    outlines = outlines_figure(names, [scan.outline for scan in c.measures], c.unit)
    figures = {
        "difference": (None if c.of_bodies else comparison_figure(c), "Mean curvature diagrams and their difference"),
        "numbers": (numbers_figure(c, _choose_shown(c)), f"Familiar numbers, and those that differ, by {c.by}"),
        "all_numbers": (numbers_figure(c, [number.symbol for number in c.numbers]), f"Each number by {c.by}"),
        "outlines": (outlines, "Three slices of each scan, and the outline of its structure"),
    }
    columns = [{"subject": case.subject, label: case.label} for case in c.cases]
    tables: dict[str, Any] = {"wide.csv": list_wide(c.measures, columns), "subjects.csv": _list_subjects(c, label)}
    tables["numbers.csv"] = _test_rows(c)
    if not c.of_bodies:  # the tables of bodies stand
        pairs = zip(c.measures, columns, strict=True)
        tables["measures.csv"] = (row for scan, more in pairs for row in scan.rows(**more))
    return write_study(target, FORMAT, FILES, record, page, tables, figures=figures)


def describe_methods(comparison: Comparison) -> str:
    """Return a paragraph, for a paper, on what was done."""
    return describe_measures(comparison.measures, c=comparison, scans=join_names(_count_scans(comparison)))


def describe_measures(measures: Sequence[Measures], **values: Any) -> str:
    """Return a paragraph, for a paper, on what was done to scans, how their numbers are made, and what to cite.

    It is `templates/methods.txt`, filled with `values`.
    """
    how = {"mask": "masks were taken as they are", "field": "phase fields were split at 0"}
    how["image"] = "grey levels were smoothed by one voxel and split at a threshold"
    kinds = join_names([how[kind] for kind in dict.fromkeys(scan.kind for scan in measures)])
    sampled = [replace(scan, notes=scan.notes[:1]) for scan in measures]  # the first note states the voxels
    sampling = "; ".join(note.rstrip(".") for _, note in merge_notes(sampled))
    text = render("methods.txt", measures=measures, kinds=kinds, sampling=sampling, **values)
    return re.sub("[ \n]+", " ", text).replace(" ;", ";").replace(" .", ".").strip()


def _count_scans(comparison: Comparison) -> list[str]:
    """Return the name of each group, or half of the numbers, with the counts of its scans and subjects."""
    scans = np.bincount(comparison.sides[comparison.owners])
    things = "bodies" if comparison.of_bodies else "scans"
    return [
        f"{name} ({subjects} subjects{f', {scans[side]} {things}' if scans[side] > subjects else ''})"
        for side, (name, subjects) in enumerate(zip(comparison.parts, comparison.counts, strict=True))
    ]


def _format_row(number: Number, comparison: Comparison) -> list[str]:
    """Return a number's row of the page's table; it stands out where its family-wise p is significant."""
    means = [
        f"{format_number(mean)} ± {format_number(sd, 2)}"
        for mean, sd in zip(number.means, number.deviations, strict=True)
    ]
    interval = "–" if math.isnan(number.low) else f"{format_number(number.low, 2)} to {format_number(number.high, 2)}"
    p, family = format_number(number.p, 2), format_number(number.family, 2)
    difference, effect = format_number(number.difference), format_number(number.effect, 2)
    if number.family <= LEVEL:
        difference, effect, family = map(Chosen, (difference, effect, family))
    known = "–" if math.isnan(number.known) else "all" if number.known >= 1 else format_percent(number.known)
    titles = name_quantity(number.name, number.symbol, number.power, comparison.unit)
    return [*titles, *means, difference, effect, interval, p, family, known]


def name_quantity(name: str, symbol: str, power: int, unit: str) -> tuple[str, str]:
    """Return the name of a quantity, and its symbol and unit, as a table has them."""
    parts = ("" if symbol in name else symbol, power_name(unit, power))
    return name[0].upper() + name[1:], ", ".join(part for part in parts if part)


def _choose_shown(comparison: Comparison) -> list[str]:
    """Return the symbols of the number named beforehand, the familiar numbers, and then those that differ."""
    primary = [comparison.primary.symbol] if comparison.primary else []
    symbols = dict.fromkeys((*primary, *OF_BODIES, *plot.FIRST_SHOWN, *(each.symbol for each in comparison.found)))
    return [symbol for symbol in symbols if symbol in {number.symbol for number in comparison.numbers}]


# ---- tables ------------------------------------------------------------------------------------------------------


def _list_subjects(comparison: Comparison, label: str) -> Iterator[dict[str, Any]]:
    """Yield each subject with its label, the number of its scans or bodies, and its values; None where not known."""
    c, things = comparison, "bodies" if comparison.of_bodies else "scans"
    units = (plain_unit(c.unit, number.power) for number in c.numbers)
    names = [f"{n.symbol} ({unit})".removesuffix(" ()") for n, unit in zip(c.numbers, units, strict=True)]
    for (group, subject), count, values in zip(c.subjects, np.bincount(c.owners), c.values.tolist(), strict=True):
        row = {"subject": subject, label: group, things: int(count)}
        yield row | {name: v if math.isfinite(v) else None for name, v in zip(names, values, strict=True)}


def _test_rows(comparison: Comparison) -> Iterator[dict[str, Any]]:
    """Yield the row of the diagrams' test, then one for each number's; None where there is no value."""
    c, count = comparison, len(comparison.groups)
    suffixes = [*ascii_lowercase, *range(27, 1 + count)][:count]  # of groups: a, b, … z, 27, 28, …
    columns = ["quantity", "symbol", "unit", *(f"mean_{k}" for k in suffixes), *(f"sd_{k}" for k in suffixes)]
    effect = {"g": "g", "η": "eta", "r": "r"}[c.effect]
    columns += ["slope" if c.effect == "r" else "difference", effect, f"{effect}_low", f"{effect}_high"]
    columns += ["p", "p_family", "known_error"]
    diagrams: dict[str, Any] = {"quantity": "curvature diagram", "p": c.p}
    if c.groups:
        diagrams |= {"symbol": "E", "unit": plain_unit(c.unit, -1), "difference": c.statistic}
    else:
        diagrams |= {"symbol": "R", "unit": "", "r": c.statistic}
    if not c.of_bodies:
        yield dict.fromkeys(columns) | diagrams
    for number in c.numbers:
        cells = (number.name, number.symbol, plain_unit(c.unit, number.power), *number.means, *number.deviations)
        cells += (number.difference, number.effect, number.low, number.high, number.p, number.family, number.known)
        finite = (None if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in cells)
        yield dict(zip(columns, finite, strict=True))


# ---- figures ---------------------------------------------------------------------------------------------------------


def comparison_figure(comparison: Comparison) -> Figure:
    """Return a figure of the mean curvature diagrams of groups, or halves of numbers, and their differences.

    A difference is the second of two groups less the first; each of more groups less the mean of all; or the change
    from the least number to the greatest. Of bodies, which have no diagram here, it is the figure of familiar numbers.
    """
    if comparison.of_bodies:
        return numbers_figure(comparison, _choose_shown(comparison))
    c, names, edges = comparison, [plot.plain(name) for name in comparison.parts], comparison.edges
    limits = edges[0], edges[-1]
    single = len(c.differences) == 1  # in one row with the two diagrams; else differences lie in rows of their own
    columns = 3 if single else min(len(names), ROW)
    rows = 1 if single else 2 * math.ceil(len(names) / columns)
    figure = plot.make_figure(13.2, 3.6 * rows * 3 / max(columns, 3), layout="constrained")
    for k, (name, diagram) in enumerate(zip(names, c.diagrams, strict=True)):
        axes = figure.add_subplot(rows, columns, k + 1)
        picture = plot.diagram_on(axes, diagram, limits=limits)
        axes.set_title(f"{name}, {c.counts[k]} subjects", fontsize=11, color=plot.GROUPS[k % len(plot.GROUPS)])
        _bar_on(axes, picture, format=FuncFormatter(lambda share, _: f"{100 * share:g}"))
    titles = [f"{names[1]} less {names[0]}"] if c.groups else ["from the least to the most"]
    titles = [f"{name} less all" for name in names] if len(names) > 2 else titles
    percents = 100 * c.differences
    greatest = max(float(np.abs(percents).max()), 1e-9)
    colours: dict[str, Any] = {"cmap": MORE, "norm": Normalize(-greatest, greatest)}
    for k, (title, difference) in enumerate(zip(titles, percents, strict=True)):
        axes = figure.add_subplot(rows, columns, k + (3 if single else rows // 2 * columns + 1))
        picture = axes.pcolormesh(edges, edges, difference, rasterized=True, zorder=0.5, **colours)
        plot.frame_diagram(axes, limits, c.unit)
        axes.set_title(f"{title}, p = {format_number(c.p, 2)}", fontsize=11)
        _bar_on(axes, picture, ticks=MaxNLocator(4, symmetric=True))
    return figure


def _bar_on(axes: Axes, picture: QuadMesh, **options: Any) -> None:
    bar = axes.figure.colorbar(picture, ax=axes, shrink=0.7, pad=0.02, **options)
    bar.set_label("% of the surface a bin", fontsize=8)
    bar.ax.tick_params(labelsize=8, length=2)
    bar.outline.set_linewidth(0.5)


def numbers_figure(comparison: Comparison, symbols: Sequence[str]) -> Figure:
    """Return a figure of quantities: subjects by group or over the number, with the 95 % intervals of their scans; and
    bodies, as small points beside their subject's.

    A long line is a group's mean, or the regression line; a thin line joins the values of one subject in paired groups.
    The names of quantities that differ significantly, all tested, are bold.
    """
    c = comparison
    figure, panels = _draw_panels(c, symbols)
    pairs = [] if c.blocks is None else [np.flatnonzero(c.blocks == block) for block in np.unique(c.blocks)]
    x = np.array(c.labels, dtype=float)
    for group, count in enumerate(c.counts if c.groups and not pairs else ()):
        x[c.sides == group] += np.linspace(-0.18, 0.18, count)  # side by side, so that intervals do not overlap
    members = [c.sides == group for group in range(len(c.counts))] if c.groups else [np.ones(len(x), dtype=bool)]
    for k, axes in panels.items():
        number = c.numbers[k]
        values, halves = c.values[:, k], c.halves[:, k]
        low, high = values - halves, values + halves
        low = low if number.symbol in plot.SIGNED else np.maximum(low, 0)
        for pair in pairs:
            pair = pair[np.argsort(x[pair])]
            axes.plot(x[pair], values[pair], color=plot.QUIET, linewidth=0.8, zorder=1)
        if c.of_bodies:
            _draw_bodies(axes, c, k, x)
        for inside, colour in zip(members, itertools.cycle(plot.GROUPS)):
            axes.vlines(x[inside], low[inside], high[inside], color=colour, alpha=0.35, linewidth=1.4)
            axes.plot(x[inside], values[inside], "o", color=colour, markersize=4, markeredgewidth=0)
        for group, mean in enumerate(number.means):
            axes.hlines(mean, group - 0.32, group + 0.32, color=plot.INK, linewidth=1.4)
        if c.groups:
            letters = WORDS // len(c.groups)
            names = [f"{plot.plain(name[:letters])}\nn = {n}" for name, n in zip(c.groups, c.counts, strict=True)]
            axes.set_xticks(range(len(names)), names, fontsize=8)
            axes.set_xlim(-0.6, len(names) - 0.4)
        else:
            ends = np.array([x.min(), x.max()])
            axes.plot(ends, values.mean() + number.difference * (ends - x.mean()), color=plot.INK, linewidth=1.4)
            axes.set_xlabel(plot.plain(c.by), fontsize=8)
        if number.symbol not in plot.SIGNED and axes.get_ylim()[0] < 0:
            axes.set_ylim(bottom=0)
    _draw_legend(figure, c)
    return figure


def _draw_legend(figure: Figure, c: Comparison) -> None:
    own = f"95 % interval of the subject's own {'bodies' if c.of_bodies else 'scans'}"
    own += ", where known" * bool(np.isnan(c.halves).any())
    handles = [
        Line2D([], [], linestyle="", label=f"bold: family-wise p ≤ {LEVEL:.2g}"),
        Line2D([], [], color=plot.QUIET, marker="o", linestyle="", markersize=4, label="a subject"),
        Line2D([], [], color=plot.QUIET, linewidth=1.4, label=own),
        Line2D([], [], color=plot.INK, linewidth=1.4, label="mean of the group" if c.groups else "slope"),
    ]
    if c.of_bodies:
        handles.append(Line2D([], [], color=plot.QUIET, marker=".", linestyle="", markersize=3, label="a body"))
    if c.blocks is not None:
        handles.append(Line2D([], [], color=plot.QUIET, linewidth=0.8, label="of one subject"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)


def _draw_bodies(axes: Axes, comparison: Comparison, number: int, x: np.ndarray) -> None:
    """Draw the values of bodies about the positions of their subjects (S,), and let the axis span most of them."""
    c, owners, random = comparison, comparison.owners, np.random.default_rng(0)
    values = np.array([body.quantities[number].value for body in c.measures])
    known = np.isfinite(values)
    width = 0.36 / max(c.counts) / 3 if c.groups else np.ptp(x) / 60
    for k, place in enumerate(x):
        own = random.permutation(np.flatnonzero(known & (owners == k)))[:POINTS]
        shifted = place + width * random.uniform(-1, 1, len(own))
        colour = plot.GROUPS[int(c.sides[k]) % len(plot.GROUPS)] if c.groups else plot.GROUPS[0]
        style = {"color": colour, "alpha": 0.25, "markersize": 2.5, "markeredgewidth": 0, "zorder": 0.8}
        axes.plot(shifted, values[own], ".", rasterized=True, **style)
    if known.any():
        reach = np.nan_to_num(c.halves[:, number])
        ends = c.values[:, number] - reach, c.values[:, number] + reach, np.percentile(values[known], SPAN)
        low, high = np.nanmin(np.concatenate(ends)), np.nanmax(np.concatenate(ends))
        margin = 0.08 * (high - low) or 0.05 * abs(high) or 1.0
        axes.set_ylim(low - margin, high + margin)


def _draw_panels(comparison: Comparison, symbols: Sequence[str]) -> tuple[Figure, dict[int, Axes]]:
    """Return a figure and its panel for each number by its index, in the order of their symbols, with the tests."""
    numbers = comparison.numbers
    index = {number.symbol: k for k, number in enumerate(numbers)}
    order = [index[symbol] for symbol in symbols]
    rows = math.ceil(len(order) / ROW)
    figure = plot.make_figure(3.3 * ROW, 3.1 * rows + 0.4, layout="constrained")
    panels = {k: figure.add_subplot(rows, ROW, place) for place, k in enumerate(order, 1)}
    for k, axes in panels.items():
        number, unit = numbers[k], power_name(comparison.unit, numbers[k].power)
        weight = "bold" if number.family <= LEVEL else "normal"
        axes.set_title(number.symbol + (f" ({unit})" if unit else ""), fontsize=11, fontweight=weight, pad=26)
        label = f"{comparison.effect} = {format_number(number.effect, 2)}, p = {format_number(number.p, 2)}"
        named = "named beforehand; " * (number is comparison.primary)
        label += f"\n{named}family-wise p = {format_number(number.family, 2)}"
        axes.annotate(label, (0.5, 1), (0, 3), "axes fraction", "offset points", ha="center", va="bottom", fontsize=7.5)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(plot.QUIET)
    return figure, panels
