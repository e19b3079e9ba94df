"""Pictures of fields, surfaces and diagrams, and shapes written as files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.drawing.plot import diagram_figure as diagram_figure
    from curvafit.drawing.plot import slice_figure as slice_figure
    from curvafit.drawing.plot import surface_figure as surface_figure
    from curvafit.drawing.plot import write_picture as write_picture
    from curvafit.drawing.render import View as View
    from curvafit.drawing.render import render as render
    from curvafit.drawing.render import view as view
    from curvafit.drawing.shapes import write_field as write_field
    from curvafit.drawing.shapes import write_shape as write_shape

attach_lazy_names(__name__)
