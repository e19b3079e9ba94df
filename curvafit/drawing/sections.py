"""The three middle slices of a volume, with a mask's outline where there is one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from curvafit.drawing.plot import CONTOUR
from curvafit.volumes.field import Field

#: Shares of the voxels that are drawn black and white, in percent.
TAILS = (0.5, 99.5)
#: Most voxels along an axis of which these shares are taken.
THIN = 256


def field_figure(field: Field) -> Figure:
    """Return a figure of a field's middle slices.

    Raises
    ------
    ValueError
        If the field has no voxels, or a value is not finite.
    """
    return section_figure([(field.values, None)], field.spacing)


def section_figure(
    rows: Sequence[tuple[np.ndarray, np.ndarray | None]],
    spacing: Sequence[float],
    places: Sequence[int] | None = None,
) -> Figure:
    """Return a figure of slices across z, y and x.

    Parameters
    ----------
    rows
        Values (Z, Y, X) for each row of pictures, and the mask that is outlined over them, or None.
    spacing
        Voxel edges (z, y, x).
    places
        Number of the slice across each axis; by default the middle one.

    Raises
    ------
    ValueError
        If there are no voxels, or a value is not finite.
    """
    figure = Figure(figsize=(7.2, 2.5 * len(rows)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 3, squeeze=False)
    places = [n // 2 for n in rows[0][0].shape] if places is None else places
    for row, (values, mask) in zip(axes, rows, strict=True):
        if not values.size or (values.dtype.kind == "f" and not np.isfinite(values).all()):
            raise ValueError("expected a volume of finite values to draw, got one with others or none")
        thinned = values[tuple(slice(None, None, -(-n // THIN)) for n in values.shape)]
        low, high = np.percentile(thinned.astype(np.float32), TAILS)
        for axis in range(3):
            plane = np.take(values, places[axis], axis)
            outline = None if mask is None else np.take(mask, places[axis], axis)
            edges = [spacing[other] for other in range(3) if other != axis]
            _section_on(row[axis], plane, outline, (low, high), edges[0] / edges[1])
    for axis, name in enumerate("zyx"):
        rows_name, columns_name = (other for other in "zyx" if other != name)
        axes[0, axis].set_title(f"{name} = {places[axis]}", fontsize=9)
        axes[-1, axis].set_xlabel(columns_name)
        axes[-1, axis].set_ylabel(rows_name, rotation=0, labelpad=6)
    return figure


def _section_on(
    axes, plane: np.ndarray, outline: np.ndarray | None, levels: tuple[float, float], aspect: float
) -> None:
    """Draw a slice."""
    low, high = levels
    plane, high = plane.astype(np.float32), max(high, low + 1e-6)
    axes.imshow(plane, cmap="gray", vmin=low, vmax=high, aspect=aspect, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    if outline is not None and outline.any() and not outline.all() and min(outline.shape) > 1:
        axes.contour(outline, [0.5], colors=CONTOUR, linewidths=1.0)
