"""Pictures of two groups that are compared: their curvature diagrams with the difference, and each number's strip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from curvafit.drawing.render import QUIET

#: Colours of the first group and the second, and of what is more in either (Okabe & Ito 2008).
FIRST, SECOND = "#0072B2", "#D55E00"
MORE = LinearSegmentedColormap.from_list("more", [FIRST, "#8CC0E0", "#FFFFFF", "#F0B48A", SECOND])
#: Symbols of numbers that are shown first and larger, and of those that can be negative.
FIRST_SHOWN, SIGNED = (*FAMILIAR, "H", "K"), ("χ", "Conn.D", "H", "K", "κ1", "κ2")
#: Larger and smaller panels of numbers in a row.
LARGE, SMALL = 4, 7
#: Share of each curvature's area that a diagram's axis holds at the least.
SHOWN = 0.995
#: Letters of a group's name that a panel has room for.
WORD = 14


def comparison_figure(comparison: Any) -> Figure:
    """Return a figure of both groups' mean curvature diagrams, and of the second less the first, with the test's p.

    The outline holds the bins that differ significantly among all.
    """
    edges, (a, b) = comparison.edges, map(plain, comparison.groups)
    limits, unit, window = (edges[0], edges[-1]), comparison.unit, shown_window(comparison.diagrams)
    figure = make_figure(13.2, 3.6, layout="constrained")
    panels = figure.subplots(1, 3)
    for k, (axes, name, diagram) in enumerate(zip(panels, (a, b), comparison.diagrams, strict=False)):
        picture = diagram_on(axes, diagram, limits=limits, unit=unit, window=window)
        axes.set_title(f"{name}, {comparison.counts[k]} subjects", fontsize=11, color=(FIRST, SECOND)[k])
        _bar_on(axes, picture, format=FuncFormatter(lambda share, _: f"{100 * share:g}"))
    axes = panels[2]
    shown = 100 * comparison.difference
    most = max(float(np.abs(shown).max()), 1e-9)
    picture = axes.pcolormesh(edges, edges, shown, cmap=MORE, norm=Normalize(-most, most), rasterized=True, zorder=0.5)
    frame_diagram(axes, limits, unit, window)
    _outline_on(axes, edges, comparison.significant)
    axes.set_title(f"{b} less {a}, p = {format_number(comparison.p, 2)}", fontsize=11)
    _bar_on(axes, picture, ticks=MaxNLocator(4, symmetric=True))
    return figure


def _bar_on(axes: Axes, picture: QuadMesh, **options: Any) -> None:
    """Draw a colour bar of the surface in each bin beside a diagram."""
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
    """Return a figure of strips, one for each quantity: subjects by group, with the 95 % intervals of their scans.

    A long line is a group's mean. The names of quantities that differ significantly among all are bold.
    """
    figure, panels = number_panels(
        comparison.numbers,
        comparison.unit,
        comparison.level,
        lambda number: (
            f"g = {format_number(number.effect, 2)}, p = {format_number(number.p, 2)}"
            f"\nfamily-wise p = {format_number(number.family, 2)}"
        ),
    )
    second = np.array([group == comparison.groups[1] for group, _ in comparison.subjects])
    for k, (axes, number) in enumerate(zip(panels, comparison.numbers, strict=True)):
        for side, colour in ((0, FIRST), (1, SECOND)):
            values, halves = (table[second == bool(side), k] for table in (comparison.values, comparison.halves))
            places = side + np.linspace(-0.18, 0.18, len(values))
            low = values - halves
            low = low if number.symbol in SIGNED else np.maximum(low, 0)
            axes.vlines(places, low, values + halves, color=colour, alpha=0.35, linewidth=1.4)
            axes.plot(places, values, "o", color=colour, markersize=4, markeredgewidth=0)
            axes.hlines(number.means[side], side - 0.32, side + 0.32, color=INK, linewidth=1.4)
        names = zip(comparison.groups, comparison.counts, strict=True)
        axes.set_xticks([0, 1], [f"{plain(name[:WORD])}\nn = {count}" for name, count in names], fontsize=8)
        axes.set_xlim(-0.6, 1.6)
        keep_sign(axes, number.symbol)
    marks = [
        Line2D([], [], color=QUIET, marker="o", linestyle="", markersize=4, label="a subject"),
        Line2D([], [], color=QUIET, linewidth=1.4, label="95 % interval of the subject's own scans"),
        Line2D([], [], color=INK, linewidth=1.4, label="mean of the group"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def keep_sign(axes: Axes, symbol: str) -> None:
    """Let the axis of a number that is never negative begin at 0 at the lowest."""
    if symbol not in SIGNED and axes.get_ylim()[0] < 0:
        axes.set_ylim(bottom=0)


def number_panels(
    numbers: Sequence[Any], unit: str, level: float, label: Callable[[Any], str]
) -> tuple[Figure, list[Axes]]:
    """Return a figure and a panel for each quantity, its symbol and label above it; the familiar ones first and larger.

    The symbol is bold where the quantity's family-wise p is at most `level`.
    """
    ranks = {symbol: k for k, symbol in enumerate(FIRST_SHOWN)}
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
        name = power_name(unit, number.power)
        axes.set_title(
            number.symbol + (f" ({name})" if name else ""),
            fontsize=11 if place < first else 9.5,
            fontweight="bold" if number.family <= level else "normal",
            pad=6 + 10 * (1 + label(number).count("\n")),
        )
        axes.annotate(
            label(number), (0.5, 1), (0, 3), "axes fraction", "offset points", ha="center", va="bottom", fontsize=7.5
        )
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(QUIET)
        panels[k] = axes
    return figure, [panels[k] for k in range(len(numbers))]


def plain(name: str) -> str:
    """Return a name that matplotlib does not take for a formula."""
    return name.replace("$", "\\$")
