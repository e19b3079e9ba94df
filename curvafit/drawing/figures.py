"""The figure of each result, as `.plot()` gives it (`curvafit.pictures`)."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from curvafit.drawing.plot import surface_figure
from curvafit.generation.result import Flow


def flow_figure(flow: Flow, **options: Any) -> Figure:
    """Return a figure of a flow's surface; `options` are those of `surface_figure`.

    Raises
    ------
    ValueError
        If the field has no surface or is not finite.
    """
    return surface_figure(flow.field.numpy(), spacing=flow.grid.spacing, **options)
