"""The figure of each result, as `.plot()` gives it (`curvafit.core.pictures`)."""

from __future__ import annotations

from typing import Any, Protocol

from matplotlib.figure import Figure

from curvafit.drawing.plot import diagram_figure, surface_figure
from curvafit.generation.result import Flow
from curvafit.geometry.diagram import Diagram


class Measured(Protocol):
    """A fit: what has the diagram of a scan, where it was measured."""

    @property
    def diagram(self) -> Diagram | None: ...


def fit_figure(fit: Measured, **options: Any) -> Figure:
    """Return a figure of the curvature diagram of a fit's scan; `options` are those of `diagram_figure`.

    Raises
    ------
    ValueError
        If the fit holds no diagram.
    """
    if fit.diagram is None:
        raise ValueError("expected a fit with a diagram to draw, got one without")
    return diagram_figure(fit.diagram, **options)


def flow_figure(flow: Flow, **options: Any) -> Figure:
    """Return a figure of a flow's surface; `options` are those of `surface_figure`.

    Raises
    ------
    ValueError
        If the field has no surface or is not finite.
    """
    return surface_figure(flow.field.numpy(), spacing=flow.grid.spacing, **options)
