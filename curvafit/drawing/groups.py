"""Pictures of two groups that are compared: their curvature diagrams with the difference, and each number's strip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.core.units import format_number, power_name
from curvafit.drawing.plot import INK, diagram_on, frame_diagram, make_figure
from curvafit.drawing.render import QUIET

#: Colours of the first group and the second, and of what is more in either (Okabe & Ito 2008).
FIRST, SECOND = "#0072B2", "#D55E00"
MORE = LinearSegmentedColormap.from_list("more", [FIRST, "#8CC0E0", "#FFFFFF", "#F0B48A", SECOND])
#: Panels of numbers in a row.
COLUMNS = 6
#: Letters of a group's name that a panel has room for.
WORD = 14


def comparison_figure(comparison: Any) -> Figure:
    """Return a figure of both groups' mean curvature diagrams, and of the second less the first.

    The outline holds the bins that differ significantly among all.
    """
    edges, (a, b) = comparison.edges, map(plain, comparison.groups)
    limits, unit = (edges[0], edges[-1]), comparison.unit
    figure = make_figure(13.2, 4.5)
    for k, (name, diagram) in enumerate(zip((a, b), comparison.diagrams, strict=True)):
        axes = figure.add_axes((0.05 + 0.325 * k, 0.12, 0.27, 0.79))
        diagram_on(axes, diagram, limits=limits, unit=unit)
        subjects = f"{comparison.counts[k]} subjects"
        axes.set_title(f"{name}, {subjects}", fontsize=11, color=(FIRST, SECOND)[k])
    axes = figure.add_axes((0.70, 0.12, 0.27, 0.79))
    shown = 100 * comparison.difference
    most = max(float(np.abs(shown).max()), 1e-9)
    picture = axes.pcolormesh(edges, edges, shown, cmap=MORE, norm=Normalize(-most, most), rasterized=True, zorder=0.5)
    frame_diagram(axes, limits, unit)
    _outline_on(axes, edges, comparison.significant)
    axes.set_title(f"{b} less {a}", fontsize=11)
    inset = axes.inset_axes((0.06, 0.93, 0.42, 0.03))
    bar = figure.colorbar(picture, cax=inset, orientation="horizontal", ticks=MaxNLocator(3, symmetric=True))
    bar.ax.tick_params(labelsize=8, length=2)
    bar.outline.set_linewidth(0.5)  # type: ignore[union-attr]
    axes.text(0.06, 0.855, "% of the surface a bin", transform=axes.transAxes, fontsize=8, va="top")
    return figure


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
    """Return a figure of strips, one for each quantity: subjects by group, with the 95 % of their scans' own errors.

    A long line is a group's mean. The names of quantities that differ significantly among all are bold.
    """
    figure, panels = number_panels(
        comparison.numbers,
        comparison.unit,
        comparison.level,
        lambda number: f"g = {format_number(number.effect, 2)}, p = {format_number(number.p, 2)}",
    )
    second = np.array([group == comparison.groups[1] for group, _ in comparison.subjects])
    for k, (axes, number) in enumerate(zip(panels, comparison.numbers, strict=True)):
        for side, colour in ((0, FIRST), (1, SECOND)):
            values, errors = (table[second == bool(side), k] for table in (comparison.values, comparison.errors))
            places = side + np.linspace(-0.18, 0.18, len(values))
            axes.vlines(places, values - 1.96 * errors, values + 1.96 * errors, color=colour, alpha=0.35, linewidth=1.4)
            axes.plot(places, values, "o", color=colour, markersize=4, markeredgewidth=0)
            axes.hlines(number.means[side], side - 0.32, side + 0.32, color=INK, linewidth=1.4)
        axes.set_xticks([0, 1], [plain(name)[:WORD] for name in comparison.groups], fontsize=8)
        axes.set_xlim(-0.6, 1.6)
    return figure


def number_panels(
    numbers: Sequence[Any], unit: str, level: float, label: Callable[[Any], str]
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each quantity, its symbol above and its label below.

    The symbol is bold where the quantity's family-wise p is at most `level`.
    """
    rows = -(-len(numbers) // COLUMNS)
    figure = make_figure(13.2, 2.5 * rows, layout="constrained")
    panels = list(figure.subplots(rows, COLUMNS, squeeze=False).ravel())
    for axes in panels[len(numbers) :]:
        axes.set_axis_off()
    for axes, number in zip(panels, numbers, strict=False):
        name = power_name(unit, number.power)
        axes.set_title(
            number.symbol + (f" ({name})" if name else ""),
            fontsize=9.5,
            fontweight="bold" if number.family <= level else "normal",
        )
        axes.set_xlabel(label(number), fontsize=8)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(QUIET)
    return figure, panels[: len(numbers)]


def plain(name: str) -> str:
    """Return a name that matplotlib does not take for a formula."""
    return name.replace("$", "\\$")
