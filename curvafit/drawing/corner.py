"""Draws of several parameters, two by two, and numbers beside the bands in which they should lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.drawing.plot import CONTOUR, DENSITY, INK, QUIET

#: The colour of draws.
_DRAWN = "#2B6FA8"
#: Width in inches of one square of a corner plot.
_SQUARE = 1.25


def corner_figure(
    draws: np.ndarray, names: Sequence[str], limits: Sequence[tuple[float, float]], marks: Mapping[str, np.ndarray]
) -> Figure:
    """Return a corner plot of draws `(n, d)`: histograms of each parameter on the diagonal, pairs below it.

    `limits` are the axes of the parameters, the prior's box; `marks` are points `(d,)` to mark, by name, at most three.
    """
    d = draws.shape[1]
    figure = Figure(figsize=(_SQUARE * d + 0.7, _SQUARE * d + 0.6), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(d, d, left=0.09, right=0.985, bottom=0.085, top=0.985, wspace=0.09, hspace=0.09)
    for row in range(d):
        for column in range(row + 1):
            axes = figure.add_subplot(grid[row, column])
            axes.set_xlim(limits[column])
            if row == column:
                axes.hist(draws[:, row], bins=np.linspace(*limits[row], 31).tolist(), color=_DRAWN, linewidth=0)
                axes.set_yticks([])
            else:
                axes.set_ylim(limits[row])
                axes.scatter(
                    draws[:, column], draws[:, row], s=3, color=_DRAWN, alpha=0.35, linewidth=0, rasterized=True
                )
            _mark(axes, marks, column, None if row == column else row)
            _label(axes, names, row, column, last=row == d - 1)
    handles, labels = figure.axes[1].get_legend_handles_labels() if d > 1 else ([], [])
    if handles:
        figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.98, 0.98), frameon=False, fontsize=11)
    return figure


def _mark(axes: Axes, marks: Mapping[str, np.ndarray], column: int, row: int | None) -> None:
    """Draw the marked points: a line in a histogram, a symbol in a pair."""
    styles = zip(marks.items(), ((CONTOUR, "o"), (INK, "x"), (QUIET, "+")), strict=False)
    for (name, point), (colour, symbol) in styles:
        if row is None:
            axes.axvline(point[column], color=colour, linewidth=1.6)
        else:
            axes.plot(point[column], point[row], symbol, color=colour, markersize=6, markeredgewidth=1.8, label=name)


def _label(axes: Axes, names: Sequence[str], row: int, column: int, *, last: bool) -> None:
    """Write ticks and names at the left and the bottom of the whole alone."""
    axes.spines[:].set_color(QUIET)
    axes.tick_params(length=2, labelsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(2, prune="both"))
    if row != column:
        axes.yaxis.set_major_locator(MaxNLocator(2, prune="both"))
    if last:
        axes.set_xlabel(names[column], fontsize=11)
    else:
        axes.set_xticklabels([])
    if column == 0 and row > 0:
        axes.set_ylabel(names[row], fontsize=11)
    elif row != column:
        axes.set_yticklabels([])


def bands_figure(blocks: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Return a picture of blocks of numbers, each the scan's `(k,)` on the band of simulated ones `(n, k)`.

    The bands hold 50 and 90 % of the simulated numbers; a block of one number is a dot on a bar. Each block has its own
    scale.
    """
    columns = 3
    rows = -(-len(blocks) // columns)
    figure = Figure(figsize=(10.0, 1.95 * rows), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for place, (name, (own, others)) in enumerate(blocks.items(), 1):
        axes = figure.add_subplot(rows, columns, place)
        at = np.arange(len(own))
        for share, shade in ((90, DENSITY(0.12)), (50, DENSITY(0.35))):
            low, high = np.percentile(others, (50 - share / 2, 50 + share / 2), axis=0)
            if len(own) > 3:
                axes.fill_between(at, low, high, color=shade, linewidth=0)
            else:
                axes.vlines(at, low, high, color=shade, linewidth=14)
        axes.plot(at, own, "-" if len(own) > 3 else "o", color=CONTOUR, linewidth=1.8, markersize=6)
        axes.set_title(name, fontsize=10)
        axes.set_xlim(-0.5, len(own) - 0.5)
        axes.set_xticks([])
        axes.tick_params(length=2, labelsize=8)
        axes.spines[:].set_color(QUIET)
    return figure
