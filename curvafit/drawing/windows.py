"""The picture of a scan measured in windows: the structure on slices, in the colours of its clusters and numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from curvafit.core.units import power_name
from curvafit.drawing.plot import LABELS, TAILS, THIN, make_figure
from curvafit.drawing.render import QUIET

#: Panels in a row; grey of structure whose windows are not known.
COLUMNS, UNKNOWN = 5, 0.88
#: Colours of clusters from 0 on: the strong ones of labels first.
COLOURS = np.vstack([LABELS[:1], LABELS[1::2], LABELS[2::2]])


def windows_figure(windows: Any) -> Figure:
    """Return a figure of the clusters on the middle slices across z, y and x, and of each number across z.

    Each voxel of the structure has the colour of the nearest window, grey where this is not known.
    """
    quantities = windows.quantities
    rows = -(-(3 + len(quantities)) // COLUMNS)
    figure = make_figure(13.2, 3.1 * rows, layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes in panels[3 + len(quantities) :]:
        axes.set_axis_off()
    for axis, axes in enumerate(panels[:3]):
        plane = _colour_structure(windows, windows.clusters.values, axis)
        shown = COLOURS[np.where(np.isfinite(plane), plane, 0).astype(int)]
        shown[~np.isfinite(plane) | (plane == 0)] = 0
        _section_on(axes, windows, shown, axis)
        axes.set_title(f"clusters, across {'zyx'[axis]}", fontsize=9.5)
    for axes, (name, symbol, power), k in zip(panels[3:], quantities, range(len(quantities)), strict=False):
        values = windows.values[..., k]
        low, high = np.nanpercentile(values, TAILS) if np.isfinite(values).any() else (0, 1)
        plane = _colour_structure(windows, values, 0)
        picture = _section_on(axes, windows, plane, 0, vmin=low, vmax=max(high, low + 1e-12), cmap="viridis")
        unit = power_name(windows.unit, power)
        axes.set_title(f"{symbol if power or symbol != name else name}{f' ({unit})' if unit else ''}", fontsize=9.5)
        bar = figure.colorbar(picture, ax=axes, orientation="horizontal", ticks=MaxNLocator(3), pad=0.02, shrink=0.9)
        bar.ax.tick_params(labelsize=7.5, length=2)
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _section_on(axes: Axes, windows: Any, plane: np.ndarray, axis: int, **colours: Any) -> Any:
    """Draw a slice over the structure in grey, and return its picture."""
    edges = np.delete(np.array(windows.clusters.spacing) / windows.stride, axis)
    mask = windows.sections[axis][_thin(windows.sections[axis])]
    axes.imshow(np.where(mask, UNKNOWN, 1.0), cmap="gray", vmin=0, vmax=1, aspect=edges[0] / edges[1])
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(QUIET)
    return axes.imshow(plane, aspect=edges[0] / edges[1], interpolation="nearest", **colours)


def _colour_structure(windows: Any, values: np.ndarray, axis: int) -> np.ndarray:
    """Return each voxel's value on the middle slice across an axis, the nearest window's; NaN off the structure."""
    across_z, across_y, _ = windows.sections
    shape = (*across_y.shape[:1], *across_z.shape)
    nearest = [
        np.clip((np.arange(n) - (edge - step) // 2) // step, 0, count - 1)
        for n, edge, step, count in zip(shape, windows.size, windows.stride, values.shape, strict=True)
    ]
    rows, columns = (places for k, places in enumerate(nearest) if k != axis)
    plane = values.take(nearest[axis][shape[axis] // 2], axis)[np.ix_(rows, columns)]
    mask = windows.sections[axis]
    return np.where(mask, plane, np.nan)[_thin(mask)]


def _thin(mask: np.ndarray) -> tuple[slice, ...]:
    """Return the slices that leave at most `THIN` pixels along each axis."""
    return tuple(slice(None, None, -(-n // THIN)) for n in mask.shape)
