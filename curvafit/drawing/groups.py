"""Pictures of scans that are compared: their curvature diagrams with the differences, and each number by its label."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from curvafit.core.units import format_number, power_name
from curvafit.drawing.plot import FAMILIAR, INK, diagram_on, frame_diagram, make_figure
from curvafit.drawing.rendering import QUIET

#: Colours of groups, which begin again after the last, and of what is more in the first two (Okabe & Ito 2008).
GROUPS = FIRST, SECOND, *_ = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
MORE = LinearSegmentedColormap.from_list("more", [FIRST, "#8CC0E0", "#FFFFFF", "#F0B48A", SECOND])
#: Symbols of numbers that are shown first and larger, and of those that can be negative.
FIRST_SHOWN, SIGNED = (*FAMILIAR, "H", "K"), ("χ", "Conn.D", "H", "K", "κ1", "κ2")
#: Larger and smaller panels of numbers in a row.
LARGE, SMALL = 4, 7
#: Share of each curvature's area that a diagram's axis holds at the least.
SHOWN = 0.995
#: Letters of groups' names that a panel has room for, and diagrams that a row has.
WORDS, ROW = 28, 4


def comparison_figure(comparison: Any) -> Figure:
    """Return a figure of the mean curvature diagrams of groups, or halves of numbers, and their differences.

    Of two the second less the first, of more each less the mean of all, by a number from the least to the greatest. The
    outline holds the bins that differ significantly among all.
    """
    c, names, edges = comparison, [plain(name) for name in comparison.parts], comparison.edges
    limits, unit, window = (edges[0], edges[-1]), c.unit, shown_window(c.diagrams)
    one = len(c.differences) == 1
    columns = 3 if one else min(len(names), ROW)
    rows = 1 if one else 2 * math.ceil(len(names) / columns)
    figure = make_figure(13.2, 3.6 * rows * 3 / max(columns, 3), layout="constrained")
    for k, (name, diagram) in enumerate(zip(names, c.diagrams, strict=True)):
        axes = figure.add_subplot(rows, columns, k + 1)
        picture = diagram_on(axes, diagram, limits=limits, unit=unit, window=window)
        axes.set_title(f"{name}, {c.counts[k]} subjects", fontsize=11, color=GROUPS[k % len(GROUPS)])
        _bar_on(axes, picture, format=FuncFormatter(lambda share, _: f"{100 * share:g}"))
    p = f"p = {format_number(c.p, 2)}"
    titles = [f"{names[1]} less {names[0]}, {p}"] if c.groups else [f"from the least to the most, {p}"]
    titles = [f"{name} less all, {p}" for name in names] if len(names) > 2 else titles
    shown = 100 * c.differences
    most = max(float(np.abs(shown).max()), 1e-9)
    for k, (title, difference) in enumerate(zip(titles, shown, strict=True)):
        axes = figure.add_subplot(rows, columns, k + (3 if one else rows // 2 * columns + 1))
        picture = axes.pcolormesh(
            edges, edges, difference, cmap=MORE, norm=Normalize(-most, most), rasterized=True, zorder=0.5
        )
        frame_diagram(axes, limits, unit, window)
        _outline_on(axes, edges, c.significant)
        axes.set_title(title, fontsize=11)
        _bar_on(axes, picture, ticks=MaxNLocator(4, symmetric=True))
    return figure


def _bar_on(axes: Axes, picture: QuadMesh, **options: Any) -> None:
    bar = axes.figure.colorbar(picture, ax=axes, shrink=0.7, pad=0.02, **options)
    bar.set_label("% of the surface a bin", fontsize=8)
    bar.ax.tick_params(labelsize=8, length=2)
    bar.outline.set_linewidth(0.5)


def shown_window(diagrams: Sequence[Any]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the intervals of κ1 and of κ2 that hold 0 and `SHOWN` of each diagram's area, with a margin."""
    ends = np.zeros((2, 2))
    for diagram in diagrams:
        for bounds, kappa in zip(ends, np.asarray(diagram.points).T, strict=True):
            tails = [(1 - SHOWN) / 2, (1 + SHOWN) / 2]
            low, high = np.quantile(kappa, tails, weights=diagram.weights, method="inverted_cdf")
            bounds[:] = min(bounds[0], low), max(bounds[1], high)
    low, high = ends.T + 0.08 * np.ptp(ends) * np.array([[-1], [1]])
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _outline_on(axes: Axes, edges: np.ndarray, inside: np.ndarray) -> None:
    """Draw the border of a set of bins, bool (rows, columns), along the bins' edges."""
    lines = []
    for turned, where in ((False, inside), (True, inside.T)):
        rows, columns = np.nonzero(np.diff(np.pad(where, ((1, 1), (0, 0))).astype(int), axis=0))
        ends = np.stack([edges[columns], edges[columns + 1]], axis=1)
        level = np.repeat(edges[rows][:, None], 2, axis=1)
        lines.append(np.stack([level, ends] if turned else [ends, level], axis=-1))
    axes.add_collection(LineCollection(list(np.concatenate(lines)), colors=INK, linewidths=1.2, zorder=3.5))


def numbers_figure(comparison: Any) -> Figure:
    """Return a figure of each quantity: subjects by group or over the number, with the 95 % intervals of their scans.

    A long line is a group's mean, or the fitted one; a thin line joins a subject's own where they are paired. The names
    of quantities that differ significantly among all are bold.
    """
    c = comparison
    figure, panels = _panels(c)
    joined = [] if c.blocks is None else [np.flatnonzero(c.blocks == block) for block in np.unique(c.blocks)]
    places = np.array(c.labels, dtype=float)
    for group, count in enumerate(c.counts if c.groups and not joined else ()):
        places[c.sides == group] += np.linspace(-0.18, 0.18, count)
    for k, (axes, number) in enumerate(zip(panels, c.numbers, strict=True)):
        values, halves = c.values[:, k], c.halves[:, k]
        low = values - halves if number.symbol in SIGNED else np.maximum(values - halves, 0)
        for own in joined:
            own = own[np.argsort(places[own])]
            axes.plot(places[own], values[own], color=QUIET, linewidth=0.8, zorder=1)
        for group, colour in zip(range(len(c.counts)) if c.groups else (None,), itertools.cycle(GROUPS)):
            own = slice(None) if group is None else c.sides == group
            axes.vlines(places[own], low[own], (values + halves)[own], color=colour, alpha=0.35, linewidth=1.4)
            axes.plot(places[own], values[own], "o", color=colour, markersize=4, markeredgewidth=0)
        for group, mean in enumerate(number.means):
            axes.hlines(mean, group - 0.32, group + 0.32, color=INK, linewidth=1.4)
        if c.groups:
            letters = WORDS // len(c.groups)
            names = [f"{plain(name[:letters])}\nn = {n}" for name, n in zip(c.groups, c.counts, strict=True)]
            axes.set_xticks(range(len(names)), names, fontsize=8)
            axes.set_xlim(-0.6, len(names) - 0.4)
        else:
            ends = np.array([places.min(), places.max()])
            axes.plot(ends, values.mean() + number.difference * (ends - places.mean()), color=INK, linewidth=1.4)
            axes.set_xlabel(plain(c.by), fontsize=8)
        if number.symbol not in SIGNED and axes.get_ylim()[0] < 0:
            axes.set_ylim(bottom=0)
    marks = [
        Line2D([], [], color=QUIET, marker="o", linestyle="", markersize=4, label="a subject"),
        Line2D([], [], color=QUIET, linewidth=1.4, label="95 % interval of the subject's own scans"),
        Line2D([], [], color=INK, linewidth=1.4, label="mean of the group" if c.groups else "slope"),
        *[Line2D([], [], color=QUIET, linewidth=0.8, label="of one subject")] * bool(joined),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), frameon=False, fontsize=9)
    return figure


def _panels(comparison: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure and a panel for each quantity, its symbol and tests above it; the familiar first and larger."""
    numbers, ranks = comparison.numbers, {symbol: k for k, symbol in enumerate(FIRST_SHOWN)}
    order = sorted(range(len(numbers)), key=lambda k: ranks.get(numbers[k].symbol, len(ranks)))
    first = sum(number.symbol in ranks for number in numbers)
    large, small = -(-first // LARGE), -(-(len(numbers) - first) // SMALL)
    figure = make_figure(13.2, 3.1 * large + 2.5 * small, layout="constrained")
    parts = figure.add_gridspec(2, 1, height_ratios=(max(3.1 * large, 0.01), max(2.5 * small, 0.01)))
    grids = parts[0].subgridspec(max(large, 1), LARGE), parts[1].subgridspec(max(small, 1), SMALL)
    panels: dict[int, Axes] = {}
    for place, k in enumerate(order):
        grid, columns, here = (grids[0], LARGE, place) if place < first else (grids[1], SMALL, place - first)
        axes, number = figure.add_subplot(grid[divmod(here, columns)]), numbers[k]
        name = power_name(comparison.unit, number.power)
        label = f"{comparison.effect} = {format_number(number.effect, 2)}, p = {format_number(number.p, 2)}"
        axes.set_title(
            number.symbol + (f" ({name})" if name else ""),
            fontsize=11 if place < first else 9.5,
            fontweight="bold" if number.family <= comparison.level else "normal",
            pad=26,
        )
        label += f"\nfamily-wise p = {format_number(number.family, 2)}"
        axes.annotate(label, (0.5, 1), (0, 3), "axes fraction", "offset points", ha="center", va="bottom", fontsize=7.5)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(QUIET)
        panels[k] = axes
    return figure, [panels[k] for k in range(len(numbers))]


def plain(name: str) -> str:
    """Return a name that matplotlib does not take for a formula."""
    return name.replace("$", "\\$")
