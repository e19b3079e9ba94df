"""The widget that measures a layer: a table, by label where there are several, and the curvature diagram."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from magicgui.widgets import CheckBox, ComboBox, FileEdit, Table
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
from qtpy.QtWidgets import QSizePolicy

from curvafit.core.runtime import Progress
from curvafit.core.units import format_number, power_name
from curvafit.drawing.plot import diagram_figure
from curvafit.geometry.diagrams import Diagram
from curvafit.napari.dock import Dock
from curvafit.napari.layers import field_of_layer, list_layers
from curvafit.scan.instances import measure_instances
from curvafit.scan.measures import Measures
from curvafit.scan.tiles import measure as measure_scan
from curvafit.studies.scans import check_table, write_table


class Measure(Dock):
    """Measure a labels layer, by label, or an image; the table can be saved."""

    def __init__(self, napari_viewer: Any) -> None:
        self.layer = ComboBox(label="layer", choices=lambda _: list_layers(napari_viewer, "Labels", "Image"))
        self.dark = CheckBox(text="dark", tooltip="Of an image: the structure is darker than what is around it.")
        self.file = FileEdit(label="save as", mode="w", filter="*.csv *.json *.parquet", nullable=True)
        super().__init__(napari_viewer, [self.layer, self.dark, self.file], "Measure")
        self.table, self.canvas = Table(), None
        self.append(self.table)
        self.table.native.setMinimumHeight(160)
        self.measures: tuple[Measures, ...] = ()

    def prepare(self) -> Callable[[Progress], tuple[Measures, ...]]:
        """Read the layer, and check the file."""
        layer, path = self.layer.value, self._path
        self.table.value = {"data": [], "columns": []}
        self._draw(None)
        field = field_of_layer(layer)
        if path is not None:
            check_table(path)
        if type(layer).__name__ == "Image":
            return partial(_measure_one, field, {"dark": self.dark.value})
        numbers = np.unique(field.values[field.values != 0])
        places = np.flatnonzero((field.values != 0).any((1, 2)))
        if len(numbers) == 0 or (len(places) > 1 and np.diff(places).min() > 1):
            what = "labels" if len(numbers) == 0 else "labels on neighbouring slices: complete the layer first"
            raise ValueError(f"expected {what}, got none in {layer.name}")
        if len(numbers) > 1:
            return lambda progress: measure_instances(field, progress=progress)
        return partial(_measure_one, field, {"kind": "mask"})

    def show_result(self, result: tuple[Measures, ...]) -> str:
        """Fill the table, draw the diagram, write the file, and let napari show a label's numbers beneath the mouse."""
        self.measures, first, layer = result, result[0], self.layer.value
        several = first.part is not None
        powers = [power_name(first.unit, each.power) for each in first.quantities]
        pairs = zip(first.quantities, powers, strict=True)
        names = [f"{each.symbol} ({power})" if power else each.symbol for each, power in pairs]
        if several:
            labels = [each.part[1] for each in result if each.part]
            cells = [[format_number(q.value, 4) for q in each.quantities] for each in result]
            self.table.value = {"data": cells, "columns": names, "index": list(map(str, labels))}
        else:
            cells = [[format_number(q.value, 4), f"± {format_number(q.half, 2)}"] for q in first.quantities]
            self.table.value = {"data": cells, "columns": ["value", "95 %"], "index": names}
        self.table.native.resizeColumnsToContents()
        self._draw(_join([each.diagram for each in result]))
        if several and type(layer).__name__ == "Labels":
            import pandas

            values = [[q.value for q in each.quantities] for each in result]
            layer.features = pandas.DataFrame(values, columns=names).assign(index=labels)
        if self._path is None:
            why = [note for each in result for note in each.notes if note.startswith("No intervals")]
            return f"{len(result)} labels measured." if several else " ".join(["Measured.", *why[:1]])
        return f"{write_table(result, self._path)} written."

    @property
    def _path(self) -> Path | None:
        chosen = self.file.value
        return None if chosen is None or str(chosen) in ("", ".") else Path(chosen)

    def _draw(self, diagram: Diagram | None) -> None:
        """Show a curvature diagram below the table, or none."""
        if self.canvas is not None:
            self.native.layout().removeWidget(self.canvas)
            self.canvas.deleteLater()
            self.canvas = None
        if diagram is not None and len(diagram.points):
            figure = diagram_figure(diagram)
            figure.set_layout_engine("tight")
            self.canvas = FigureCanvasQTAgg(figure)
            self.canvas.setMinimumHeight(280)
            # As wide as the dock is: its own width would widen the window.
            self.canvas.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
            self.native.layout().addWidget(self.canvas)


def _measure_one(field: Any, options: dict[str, Any], progress: Progress) -> tuple[Measures, ...]:
    return (measure_scan(field, progress=progress, **options),)


def _join(diagrams: Sequence[Diagram]) -> Diagram:
    """Return the diagram of several surfaces together."""
    total = sum(float(each.weights.sum()) for each in diagrams)
    lost = sum(each.excluded * float(each.weights.sum()) for each in diagrams) / total if total else math.nan
    points, weights = (np.concatenate([getattr(each, name) for each in diagrams]) for name in ("points", "weights"))
    return Diagram(points, weights, diagrams[0].unit, excluded=lost if total else 0.0)
