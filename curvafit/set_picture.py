"""A picture of a training set: middle slices of some of its cases with the labels' outlines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from curvafit.data_synth.layouts import LAYOUTS
from curvafit.data_synth.sets import RECORDS, case_name, cases_of, read_order
from curvafit.plot import CONTOUR, write_picture
from curvafit.priors.json_text import parse_json
from curvafit.scan import read_values

#: Cases in the picture, and in a row of it.
SHOWN, ROW = 8, 4


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
        record = parse_json((folder / RECORDS / f"{name}.json").read_bytes(), "a case's record", name)
        row, column = 2 * (k // ROW), k % ROW
        shown = int(np.argmax((label > 0).sum((1, 2))))
        low, high = np.percentile(image[shown], (0.5, 99.5))
        _, h, w = record["imaging"]["spacing"]
        for axis in (axes[row, column], axes[row + 1, column]):
            axis.imshow(image[shown], cmap="gray", vmin=low, vmax=max(high, low + 1e-6), aspect=h / w)
        if 0 < label[shown].sum() < label[shown].size:
            axes[row + 1, column].contour(label[shown], [0.5], colors=CONTOUR, linewidths=0.8)
        axes[row, column].set_title(f"{name}\n{record['source']['name']}"[:60], fontsize=8)
    return write_picture(figure, folder / "preview.png")
