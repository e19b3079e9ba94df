"""Pictures of results, drawn by functions in rooms above those of the results.

`_FIGURES` in `curvafit/__init__.py` names the function of each type. The first picture imports the function, so that
the rooms below import neither matplotlib nor the room that draws.
"""

from __future__ import annotations

import base64
import io
import sys
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Pixels along the width of a picture in a notebook's cell.
SMALL = 320


class Pictured:
    """A result with a picture: `.plot()` returns a figure, and a notebook shows a small one."""

    def plot(self, **options: Any) -> Figure:
        """Return a matplotlib `Figure`; the options are those of the function that draws this type.

        Raises ValueError if there is nothing to draw: no surface, or a field that is not finite.
        """
        figures = sys.modules[__name__.partition(".")[0]]._FIGURES
        place = next(figures[each.__name__] for each in type(self).__mro__ if each.__name__ in figures)
        module, _, function = place.partition(":")
        return getattr(import_module(module), function)(self, **options)

    def _repr_html_(self) -> str:
        """Return one line and, where there is something to draw, a small picture."""
        line = f"<code>{escape(repr(self))}</code>"
        try:
            figure = self.plot()
        except ValueError:
            return line
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=2 * SMALL / figure.get_figwidth())
        content = base64.b64encode(buffer.getvalue()).decode("ascii")
        return f'{line}<br><img src="data:image/png;base64,{content}" width="{SMALL}" alt="">'
