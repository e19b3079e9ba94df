"""What both widgets share: layers as volumes, work in a thread; and the one that measures a layer."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from magicgui.widgets import CheckBox, ComboBox, Container, FileEdit, Label, ProgressBar, PushButton, Table
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
from napari.qt.threading import create_worker
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QSizePolicy
from scipy import ndimage

from curvafit.core.runtime import Progress
from curvafit.core.units import common_unit, format_number, is_unit, power_name
from curvafit.drawing.plot import diagram_figure
from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.geometry.diagrams import Diagram, join_diagrams
from curvafit.scan.instances import measure_instances
from curvafit.scan.measures import Measures
from curvafit.scan.tiles import measure as measure_scan
from curvafit.studies.scans import check_table, write_table
from curvafit.volumes.volume import ScanError, Volume

#: Milliseconds between looks at the work's progress.
_PAUSE = 100


# ---- a layer as a volume, and a volume as a layer: values, voxel edges and their unit --------------------------------


def field_of_layer(layer: Any, kind: str = "a layer") -> Volume:
    """Return a layer as a volume: its values (of the finest level), voxel edges and unit.

    The layer must have three axes, besides any of length one before them, and no colours; else ScanError is raised. A
    rotated or sheared layer is read along its own axes. `kind` is what the message asks for where there is no layer.
    """
    if layer is None:
        raise ScanError(f"expected {kind}, got none: add one")
    if getattr(layer, "rgb", False):
        raise ScanError(f"expected grey levels or labels, got colours in the layer {layer.name}")
    data = layer.data[0] if layer.multiscale else layer.data
    if len(data.shape) < 3 or any(n != 1 for n in data.shape[:-3]):
        raise ScanError(f"expected a layer of three axes, got {layer.name} of shape {tuple(data.shape)}")
    values = np.asarray(data).reshape(data.shape[-3:])
    if faults := np.count_nonzero(~np.isfinite(values)):
        raise ScanError(f"expected finite values in the layer {layer.name}, got {faults} that are not")
    spacing, unit = _lengths(layer)
    return Volume(values, spacing, unit, source=layer.name)


def _lengths(layer: Any) -> tuple[tuple[float, float, float], str]:
    """Return voxel edges (z, y, x) and their unit, that of the last axis."""
    unit, factors = common_unit([str(unit) for unit in layer.units[-3:]])
    if not is_unit(unit):
        raise ScanError(f"expected one kind of unit of length along the axes of {layer.name}, got the unit {unit}")
    z, y, x = (abs(float(edge)) * factor for edge, factor in zip(layer.scale[-3:], factors, strict=True))
    return (z, y, x), str(unit)


def place_of_layer(layer: Any) -> dict[str, Any]:
    """Return options by which a new layer of three axes gets the position of a layer's last three axes."""
    return {
        "scale": layer.scale[-3:], "translate": layer.translate[-3:], "rotate": layer.rotate[-3:, -3:],
        "shear": layer.shear if len(layer.scale) == 3 else None, "units": layer.units[-3:],
    }  # fmt: skip


def list_layers(viewer: Any, *kinds: str) -> list[tuple[str, Any]]:
    """Return (name, layer) of the layers of kinds such as `"Image"`, the first kind first, without the images that the
    plugin added."""
    layers = [layer for kind in kinds for layer in viewer.layers if type(layer).__name__ == kind]
    layers = [layer for layer in layers if type(layer).__name__ != "Image" or "curvafit" not in layer.metadata]
    return [(layer.name, layer) for layer in layers]


def put_layer(viewer: Any, kind: str, data: Any, name: str, **options: Any) -> Any:
    """Add a layer of a kind, such as `"labels"`; it replaces one of the same name that the plugin added."""
    drop_layer(viewer, name)
    return getattr(viewer, f"add_{kind}")(data, name=name, metadata={"curvafit": name}, **options)


def drop_layer(viewer: Any, name: str) -> None:
    """Remove the layer of a name that the plugin added, if it is there."""
    for layer in list(viewer.layers):
        if layer.name == name == layer.metadata.get("curvafit"):  # renamed, it is the user's
            viewer.layers.remove(layer)


# ---- work in a thread, with progress, a button that stops it, and a sentence at the end ------------------------------


class Stopped(Exception):
    """The user stopped the work."""


class Dock(Container):
    """A widget with a job: `prepare` reads the choices and returns a function, which runs in a thread; `show_result`
    gets what that returns. Below the choices are the buttons, the progress and a sentence."""

    def __init__(self, viewer: Any, choices: list[Any], verb: str) -> None:
        self.viewer = viewer
        self.run_button, self.stop_button = PushButton(text=verb), PushButton(text="Stop", enabled=False)
        self.progress, self.status = ProgressBar(value=0, max=100, visible=False), Label(value="")
        buttons = Container(widgets=[self.run_button, self.stop_button], layout="horizontal", labels=False)
        super().__init__(widgets=[*choices, buttons, self.progress, self.status])
        self.status.native.setWordWrap(True)
        self.status.native.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.MinimumExpanding)
        self.run_button.changed.connect(self.run)
        self.stop_button.changed.connect(self.stop)
        self._stopping, self.worker = threading.Event(), None
        self._latest = ("", 0.0)  # sentence and share done, which the thread writes and the timer shows
        self._timer = QTimer(self.native)
        self._timer.setInterval(_PAUSE)
        self._timer.timeout.connect(self._show_progress)
        self.native.destroyed.connect(self._stopping.set)

    @abstractmethod
    def prepare(self) -> Callable[[Progress], Any]:
        """Return the function that does the chosen work; raise ValueError where a choice is invalid."""

    @abstractmethod
    def show_result(self, result: Any) -> str:
        """Show the result of the work, and return a sentence on it."""

    def run(self) -> None:
        """Begin the work, or say why not."""
        try:
            work = self.prepare()
        except (ValueError, ImportError) as reason:
            self.say(f"{reason}.")
            return
        self._stopping.clear()
        self._latest = ("beginning", 0.0)
        self.run_button.enabled, self.stop_button.enabled = False, True
        self.progress.visible = True
        self._show_progress()
        self._timer.start()
        connect = {"returned": self._end, "errored": self._fail, "finished": self._finish}
        self.worker = create_worker(work, self._note_progress, _connect=connect, _ignore_errors=True)

    def stop(self) -> None:
        """Stop the work at its next step."""
        self._stopping.set()
        self.say("Stopping.")

    def say(self, text: str) -> None:
        """Show a sentence."""
        self.status.value = self.status.tooltip = text[:1].upper() + text[1:]

    def _note_progress(self, text: str, share: float) -> None:
        """Note how far the work is; called in its thread, which it ends where the user stopped it."""
        if self._stopping.is_set():
            raise Stopped
        self._latest = (text, share)

    def _show_progress(self) -> None:
        text, share = self._latest
        self.progress.value = round(100 * share)
        if not self._stopping.is_set():
            self.say(f"{text} …")

    def _end(self, result: Any) -> None:
        self._timer.stop()
        try:
            self.say("Stopped." if self._stopping.is_set() else self.show_result(result))
        except (ValueError, OSError) as reason:
            self.say(f"{reason}.")

    def _fail(self, error: Exception) -> None:
        self._timer.stop()
        if isinstance(error, Stopped):
            self.say("Stopped.")
        elif isinstance(error, (ValueError, ImportError, MemoryError)):
            self.say(f"{error}.")
        else:
            self.say(f"{type(error).__name__}: {error}.")
            raise error

    def _finish(self) -> None:
        self._timer.stop()
        self.run_button.enabled, self.stop_button.enabled = True, False
        self.progress.visible = False


# ---- measuring: a table, by label where there are several, and the curvature diagram ---------------------------------


class Measure(Dock):
    """Measure a labels layer, by label, or an image; the table can be saved."""

    def __init__(self, napari_viewer: Any) -> None:
        self.layer = ComboBox(label="layer", choices=lambda _: list_layers(napari_viewer, "Labels", "Image"))
        self.dark = CheckBox(text="dark", tooltip="Of an image: the structure is darker than what is around it.")
        self.file = FileEdit(label="save as", mode="w", filter="*.csv", nullable=True)
        super().__init__(napari_viewer, [self.layer, self.dark, self.file], "Measure")
        self.table, self.canvas = Table(), None
        self.append(self.table)
        self.table.native.setMinimumHeight(160)
        self.measures: tuple[Measures, ...] = ()

    def prepare(self) -> Callable[[Progress], tuple[Measures, ...]]:
        """Read the layer, check the file, and return the function that measures."""
        layer, path = self.layer.value, self._path
        self.table.value = {"data": [], "columns": []}
        self._draw(None)
        field = field_of_layer(layer)
        if path is not None:
            check_table(path)
        if type(layer).__name__ == "Image":
            options = {"dark": self.dark.value}
            return lambda progress: (measure_scan(field, progress=progress, **options),)
        labels = np.unique(field.values[field.values != 0])
        slices = np.flatnonzero((field.values != 0).any((1, 2)))
        if len(labels) == 0 or (len(slices) > 1 and np.diff(slices).min() > 1):
            expected = "labels" if len(labels) == 0 else "labels on neighbouring slices: complete the layer first"
            raise ValueError(f"expected {expected}, got none in {layer.name}")
        if len(labels) > 1:
            return lambda progress: measure_instances(field, progress=progress)
        return lambda progress: (measure_scan(field, progress=progress, kind="mask"),)

    def show_result(self, result: tuple[Measures, ...]) -> str:
        """Fill the table, draw the diagram, write the file, and let napari show a label's numbers beneath the mouse."""
        self.measures, layer = result, self.layer.value
        first = result[0]
        units = [(quantity.symbol, power_name(first.unit, quantity.power)) for quantity in first.quantities]
        names = [f"{symbol} ({unit})" if unit else symbol for symbol, unit in units]
        values = [[quantity.value for quantity in measures.quantities] for measures in result]
        labels = [measures.part[1] for measures in result if measures.part]
        if labels:
            cells = [[format_number(value, 4) for value in row] for row in values]
            self.table.value = {"data": cells, "columns": names, "index": list(map(str, labels))}
        else:
            cells = [list(quantity.format(first.unit)[:2]) for quantity in first.quantities]
            self.table.value = {"data": cells, "columns": ["value", "95 %"], "index": names}
        self.table.native.resizeColumnsToContents()
        self._draw(join_diagrams([measures.diagram for measures in result]))
        if labels and type(layer).__name__ == "Labels":
            import pandas

            layer.features = pandas.DataFrame(values, columns=names).assign(index=labels)
        if self._path is None:
            reasons = [note for note in first.notes if note.startswith("No intervals")]
            return f"{len(result)} labels measured." if labels else " ".join(["Measured.", *reasons[:1]])
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
            self.canvas = FigureCanvasQTAgg(diagram_figure(diagram))
            self.canvas.setMinimumHeight(280)
            # As wide as the dock is: its own width would widen the window.
            self.canvas.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
            self.native.layout().addWidget(self.canvas)


# ---- the plugin's sample: tubes in noise, of which every 8th slice is annotated --------------------------------------


def annotated_tubes() -> list[tuple[Any, dict[str, Any], str]]:
    """Return layers: an image of grown tubes in noise, every 8th slice of them as labels, and all of them, hidden."""
    tubes = generate("tubes", grid=(65, 80, 80), seed=0, schedule=schedule("fast", 400)).field.numpy() > 0
    noise = np.random.default_rng(0).standard_normal(tubes.shape)
    image = (100 + 60 * ndimage.gaussian_filter(tubes.astype(np.float32), 1.0) + 12 * noise).clip(0, 255)
    annotated = np.zeros(tubes.shape, np.uint8)
    annotated[::8] = tubes[::8]
    scale = {"scale": (0.5, 0.5, 0.5), "units": ("micrometer",) * 3}
    return [
        (image.astype(np.uint8), {"name": "tubes", **scale}, "image"),
        (annotated, {"name": "every 8th slice", **scale}, "labels"),
        (tubes.astype(np.uint8), {"name": "all of them", "visible": False, **scale}, "labels"),
    ]
