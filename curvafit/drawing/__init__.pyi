from .plot import diagram_figure as diagram_figure
from .plot import surface_figure as surface_figure
from .plot import write_picture as write_picture
from .rendering import View as View
from .rendering import render as render
from .rendering import view as view
from .shapes import write_field as write_field
from .shapes import write_shape as write_shape
