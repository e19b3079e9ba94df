"""The widget that fills a labels layer between annotated slices, and shows where it is unsure."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from magicgui.widgets import ComboBox, Container, LineEdit, PushButton, SpinBox, create_widget

from curvafit.core.runtime import Progress
from curvafit.napari.dock import Dock
from curvafit.napari.layers import field_of_layer, place_of_layer, put_layer
from curvafit.segmentation.reconstruct import reconstruct, reconstruct_labels
from curvafit.segmentation.result import Segmentation
from curvafit.segmentation.uncertainty import entropy
from curvafit.volumes.field import ScanError

_ALL, _ONE = "all labels", "the selected label"


class _Filled(NamedTuple):
    """A filled layer: its labels after, and what was found."""

    layer: Any
    axis: int
    values: np.ndarray
    found: Segmentation


class Complete(Dock):
    """Fill a labels layer between annotated slices; it can be undone."""

    def __init__(self, napari_viewer: Any) -> None:
        self.annotated = create_widget(label="labels", annotation="napari.layers.Labels")
        self.image = create_widget(label="image", annotation="napari.layers.Image", options={"nullable": True})
        self.which = ComboBox(label="fill", choices=[_ALL, _ONE], value=_ALL)
        self.axis = ComboBox(label="across", choices=["z", "y", "x"], value="z", tooltip="The axis across the slices.")
        self.known = LineEdit(
            label="known slices",
            tooltip="Those with labels, where this is empty; or 0,9,17; or every 8th from 0: 0::8.",
        )
        self.suggest = SpinBox(label="suggest", value=3, min=0, max=20, tooltip="Slices to annotate next.")
        self.suggestions = Container(widgets=[], layout="horizontal", labels=False)
        choices = [self.annotated, self.image, self.which, self.axis, self.known, self.suggest]
        super().__init__(napari_viewer, choices, "Fill")
        self.append(self.suggestions)

    def prepare(self) -> Callable[[Progress], _Filled]:
        """Read the layers and what is known of them."""
        layer, axis = self.annotated.value, "zyx".index(self.axis.value)
        field = field_of_layer(layer)
        values = np.array(field.values)
        numbers = [int(layer.selected_label)] if self.which.value == _ONE else np.unique(values[values != 0]).tolist()
        shown = np.moveaxis(np.isin(values, numbers), axis, 0)
        known = _parse_slices(self.known.value, len(shown)) or np.flatnonzero(shown.any((1, 2))).tolist()
        image = None if self.image.value is None else field_of_layer(self.image.value)
        options = {"known": known, "axis": axis, "image": image}
        if len(numbers) > 1:
            return partial(self._fill_several, layer, field, numbers, options)
        if not numbers or not shown.any():
            what = "labels" if self.which.value == _ALL else f"voxels of label {numbers[0]}"
            raise ScanError(f"expected slices with {what} in {layer.name}, got none")
        inside = np.where(values == numbers[0], np.uint8(1), np.uint8(0))
        suggest = min(self.suggest.value, len(shown) - len(known))
        return partial(self._fill_one, layer, field, values, numbers[0], inside, options | {"suggest": suggest})

    @staticmethod
    def _fill_several(
        layer: Any, field: Any, numbers: list[int], options: dict[str, Any], progress: Progress
    ) -> _Filled:
        found = reconstruct_labels(field, chosen=numbers, progress=progress, **options)
        assert found.labels is not None
        return _Filled(layer, options["axis"], found.labels.values, found)

    @staticmethod
    def _fill_one(
        layer: Any, field: Any, values: np.ndarray, number: int, inside: np.ndarray, options: dict[str, Any],
        progress: Progress,
    ) -> _Filled:  # fmt: skip
        """Fill one label; it takes no voxel of another."""
        from dataclasses import replace

        found = reconstruct(replace(field, values=inside), progress=progress, **options)
        free = (values == 0) | (values == number)
        return _Filled(layer, options["axis"], np.where(free, number * found.mask.values, values), found)

    def show_result(self, result: _Filled) -> str:
        """Write the labels, as one step to undo, the doubt as a layer, and the slices to annotate next."""
        layer, found = result.layer, result.found
        write_labels(layer, result.values)
        assert found.uncertainty is not None
        doubt = entropy(found.uncertainty.probability.values).astype(np.float32) / np.float32(np.log(2))
        options = {"colormap": "inferno", "blending": "additive", "contrast_limits": (0.2, 1), "opacity": 0.6}
        put_layer(self.viewer, "image", doubt, f"doubt of {layer.name}", **options, **place_of_layer(layer))
        self._mark_suggestions(layer, result.axis, found.uncertainty.suggestions)
        self.viewer.layers.selection.active = layer
        return f"{found.status} (undo: Ctrl+Z in the labels layer)."

    def _mark_suggestions(self, layer: Any, axis: int, slices: tuple[int, ...]) -> None:
        """Frame the suggested slices in the viewer, and give each a button that goes there."""
        name = f"suggested slices of {layer.name}"
        self.suggestions.clear()
        frames = [_frame(layer.data.shape[-3:], axis, k) for k in slices]
        style = {"face_color": "transparent", "edge_color": "yellow", "edge_width": 0.5}
        if frames:
            put_layer(self.viewer, "shapes", frames, name, shape_type="polygon", **style, **place_of_layer(layer))
        for k in slices:
            button = PushButton(text=f"slice {k}", tooltip="Go to this slice, to annotate it next.")
            button.changed.connect(partial(self._go_to, layer, axis, k))
            self.suggestions.append(button)

    def _go_to(self, layer: Any, axis: int, k: int) -> None:
        corner = np.zeros(layer.ndim)
        corner[layer.ndim - 3 + axis] = k
        place = layer.data_to_world(corner)
        dims = self.viewer.dims
        dims.set_point(dims.ndim - 3 + axis, place[layer.ndim - 3 + axis])


def write_labels(layer: Any, values: np.ndarray) -> None:
    """Write values (Z, Y, X) into a labels layer, as one step that napari can undo."""
    if layer.multiscale or not isinstance(layer.data, np.ndarray):
        raise ScanError(f"expected labels in memory, which can be edited, got {layer.name} in a file")
    new = values.astype(layer.data.dtype).reshape(layer.data.shape)
    where = np.nonzero(new != layer.data)
    if len(where[0]):
        layer.data_setitem(where, new[where])


def _parse_slices(text: str, count: int) -> list[int]:
    """Return the numbers of slices in a text such as `0,9,17` or `0::8`."""
    found: list[int] = []
    try:
        for part in filter(None, text.replace(" ", "").split(",")):
            edges = [int(each) if each else None for each in part.split(":")]
            found += [edges[0]] if len(edges) == 1 else range(count)[slice(*edges)]  # type: ignore[list-item]
    except (ValueError, TypeError):
        raise ScanError(f"expected known slices as 0,9,17 or 0::8, got {text!r}") from None
    if any(not 0 <= k < count for k in found):
        raise ScanError(f"expected known slices from 0 to {count - 1}, got {text!r}")
    return sorted(set(found))


def _frame(shape: tuple[int, ...], axis: int, k: int) -> np.ndarray:
    """Return the corners (4, 3) of a slice."""
    (a, b), corners = [axis_ for axis_ in range(3) if axis_ != axis], np.zeros((4, 3))
    corners[:, axis] = k
    corners[[1, 2], a], corners[[2, 3], b] = shape[a] - 1, shape[b] - 1
    return corners
