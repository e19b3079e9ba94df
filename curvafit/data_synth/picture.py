"""A picture of a training set: middle slices of some of its cases with the labels' outlines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from curvafit.core.records import parse_json
from curvafit.data_synth.layouts import LAYOUTS
from curvafit.data_synth.sets import RECORDS, case_name, cases_of, read_order
from curvafit.drawing.plot import CONTOUR, write_picture
from curvafit.priors.fit_schema import violation
from curvafit.volumes.read import read_values

#: Cases in the picture, and in a row of it.
SHOWN, ROW = 8, 4

_SPACING = {"type": "number", "exclusiveMinimum": 0, "description": "a positive number"}
#: What the picture takes from a case's record, in the words of `priors.fit_schema`.
_SCHEMA = {
    "type": "object",
    "required": ["imaging", "source"],
    "properties": {
        "imaging": {
            "type": "object",
            "required": ["spacing"],
            "properties": {
                "spacing": {"type": "array", "minItems": 3, "items": _SPACING, "description": "a list of three numbers"}
            },
            "description": "an object",
        },
        "source": {
            "type": "object",
            "required": ["name"],
            "properties": {"name": {"type": "string", "description": "a text"}},
            "description": "an object",
        },
    },
    "description": "an object",
}


def write_preview(folder: str | Path) -> Path:
    """Write `preview.png` of a set into its folder: of the first cases the slice with most of the structure, with and
    without the label's outline."""
    folder = Path(folder)
    layout = LAYOUTS[read_order(folder).layout]
    names = [case_name(index) for index in cases_of(folder)[:SHOWN]]
    columns, rows = min(ROW, len(names)), -(-len(names) // ROW)
    figure = Figure(figsize=(2.4 * columns, 5.0 * rows + 0.3), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_2d(figure.subplots(2 * rows, columns, squeeze=False))
    for each in axes.flat:
        each.set_axis_off()
    for k, name in enumerate(names):
        image, label = (read_values(folder / part.format(case=name)) for part in (layout.image, layout.label))
        record = _record(folder / RECORDS / f"{name}.json")
        row, column = 2 * (k // ROW), k % ROW
        shown = int(np.argmax((label > 0).sum((1, 2))))
        low, high = np.percentile(image[shown], (0.5, 99.5))
        _, h, w = record["imaging"]["spacing"][:3]
        for axis in (axes[row, column], axes[row + 1, column]):
            axis.imshow(image[shown], cmap="gray", vmin=low, vmax=max(high, low + 1e-6), aspect=h / w)
        if 0 < label[shown].sum() < label[shown].size:
            axes[row + 1, column].contour(label[shown], [0.5], colors=CONTOUR, linewidths=0.8)
        axes[row, column].set_title(f"{name}\n{record['source']['name']}"[:60], fontsize=8)
    return write_picture(figure, folder / "preview.png")


def _record(path: Path) -> dict[str, Any]:
    """Return the record of a case."""
    record = parse_json(path.read_bytes(), "a case's record", path)
    if wrong := violation(record, _SCHEMA):
        raise ValueError(f"expected a case's record with {wrong} in {path}")
    return record
