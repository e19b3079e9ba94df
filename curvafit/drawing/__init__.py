"""Pictures of fields, surfaces and diagrams, and shapes written as files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.drawing.plot import diagram_figure, slice_figure, surface_figure, write_picture
    from curvafit.drawing.render import View, render, view
    from curvafit.drawing.shapes import write_field, write_shape

__all__ = [
    "View",
    "diagram_figure",
    "render",
    "slice_figure",
    "surface_figure",
    "view",
    "write_field",
    "write_picture",
    "write_shape",
]

_HOMES = {
    "View": "curvafit.drawing.render",
    "diagram_figure": "curvafit.drawing.plot",
    "render": "curvafit.drawing.render",
    "slice_figure": "curvafit.drawing.plot",
    "surface_figure": "curvafit.drawing.plot",
    "view": "curvafit.drawing.render",
    "write_field": "curvafit.drawing.shapes",
    "write_picture": "curvafit.drawing.plot",
    "write_shape": "curvafit.drawing.shapes",
}

offer(__name__, _HOMES)
