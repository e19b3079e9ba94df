"""Pictures of many scans side by side: the curvature diagram of each, and each number with its interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.core.units import power_name
from curvafit.drawing.groups import FIRST, FIRST_SHOWN, SIGNED, plain, shown_window
from curvafit.drawing.plot import QUIET, diagram_on, make_figure

#: Diagrams in a row, and panels of numbers in a row.
DIAGRAMS, PANELS = 5, 4
#: Letters of a scan's name that a panel has room for.
WORD = 22


def diagrams_figure(names: Sequence[str], measures: Sequence[Any]) -> Figure:
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


def intervals_figure(names: Sequence[str], measures: Sequence[Any]) -> Figure:
    """Return a figure of eight numbers of scans of one unit, a row for each scan, with 95 % intervals."""
    rows = -(-len(FIRST_SHOWN) // PANELS)
    figure = make_figure(12.0, rows * (0.9 + 0.19 * max(len(names), 4)), layout="constrained")
    panels = figure.subplots(rows, PANELS, sharey=True)
    places = range(len(names), 0, -1)
    for axes, symbol in zip(panels.ravel(), FIRST_SHOWN, strict=True):
        found = [each[symbol] for each in measures]
        values, halves = [each.value for each in found], [each.half for each in found]
        low = [v - h if math.isfinite(h) else v for v, h in zip(values, halves, strict=True)]
        low = low if symbol in SIGNED else [max(0.0, each) for each in low]
        high = [v + h if math.isfinite(h) else v for v, h in zip(values, halves, strict=True)]
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
    """Return names that a panel has room for: without what all begin and end with, where one is too long.

    What is still too long keeps its beginning and its end, and a number where two would be alike.
    """
    if max(map(len, names), default=0) <= WORD:
        return list(names)
    if len(names) > 1:
        start, stop = _count_alike(names), _count_alike([name[::-1] for name in names])
        names = [name[start : max(len(name) - stop, start)] or name for name in names]
    short = [name if len(name) <= WORD else f"{name[: WORD // 2 - 1]}…{name[-WORD // 2 :]}" for name in names]
    return [name if short.count(name) == 1 else f"{k} {name}" for k, name in enumerate(short, 1)]


def _count_alike(names: Sequence[str]) -> int:
    """Return how many signs names begin with alike, up to the last one between words."""
    least = min(map(len, names))
    alike = next((k for k in range(least) if len({name[k] for name in names}) > 1), least)
    return next((k for k in range(alike, 0, -1) if names[0][k - 1] in "/_-. ,"), 0)
