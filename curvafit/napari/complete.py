"""The widget that fills a labels layer between annotated slices, and shows where it is unsure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from magicgui.widgets import ComboBox, Container, LineEdit, PushButton, SpinBox, create_widget

from curvafit.core.runtime import Progress
from curvafit.napari.widgets import Dock, drop_layer, field_of_layer, list_layers, place_of_layer, put_layer
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.result import Segmentation
from curvafit.segmentation.uncertainty import entropy
from curvafit.volumes.volume import ScanError, Volume

_ALL, _ONE = "all labels", "the selected label"


@dataclass(frozen=True)
class Filled:
    """What was filled: the layer that was drawn, the axis across its slices, the name and the labels (Z, Y, X) of the
    layer to show, and the segmentation that they come from."""

    drawn: Any
    axis: int
    name: str
    values: np.ndarray
    segmentation: Segmentation


class Complete(Dock):
    """Fill a labels layer between annotated slices; the result is a layer of its own."""

    def __init__(self, napari_viewer: Any) -> None:
        self.annotated = create_widget(label="labels", annotation="napari.layers.Labels")
        self.image = ComboBox(label="image", choices=lambda _: list_layers(napari_viewer, "Image"), nullable=True)
        self.which = ComboBox(label="fill", choices=[_ALL, _ONE], value=_ALL)
        self.axis = ComboBox(label="across", choices=["z", "y", "x"], value="z", tooltip="The axis across the slices.")
        tooltip = "By default those with labels; or those that you name: 0,9,17, or every 8th from 0: 0::8."
        self.known = LineEdit(label="known slices", tooltip=tooltip)
        self.suggest = SpinBox(label="suggest", value=3, min=0, max=20, tooltip="Slices to annotate next.")
        self.suggestions = Container(widgets=[], layout="horizontal", labels=False)
        choices = [self.annotated, self.image, self.which, self.axis, self.known, self.suggest]
        super().__init__(napari_viewer, choices, "Fill")
        self.append(self.suggestions)

    def prepare(self) -> Callable[[Progress], Filled]:
        """Read the choices, and return the function that fills the layer; raise ScanError where that cannot be done."""
        self.suggestions.clear()
        layer, axis = self.annotated.value, "zyx".index(self.axis.value)
        field = field_of_layer(layer, "a labels layer")
        if layer.multiscale or not isinstance(layer.data, np.ndarray):
            raise ScanError(f"expected labels that can be edited, got {layer.name}, which is no NumPy array")
        field = replace(field, array=np.array(field.values))  # a copy, as the user may paint meanwhile
        label = int(layer.selected_label) if self.which.value == _ONE else None
        if label is not None and not (field.values == label).any():
            raise ScanError(f"expected slices with label {label} in {layer.name}, got none")
        known = _parse_slices(self.known.value, field.shape[axis])
        options = {
            "known": known,
            "axis": axis,
            "image": None if self.image.value is None else field_of_layer(self.image.value),
            "suggest": min(self.suggest.value, field.shape[axis] - len(known or ())),
        }
        return partial(_fill, layer, field, label, options)

    def show_result(self, result: Filled) -> str:
        """Show the labels and their uncertainty as layers, and the slices to annotate next."""
        layer, segmentation = result.drawn, result.segmentation
        if layer not in self.viewer.layers or layer.data.shape[-3:] != result.values.shape:
            return "The layer that was filled is gone."
        assert segmentation.uncertainty is not None
        doubt = entropy(segmentation.uncertainty.probability.values).astype(np.float32) / np.float32(np.log(2))
        options = {"colormap": "inferno", "blending": "additive", "contrast_limits": (0.2, 1), "opacity": 0.6}
        put_layer(self.viewer, "labels", result.values, result.name, **place_of_layer(layer))
        put_layer(self.viewer, "image", doubt, f"doubt of {layer.name}", **options, **place_of_layer(layer))
        self._mark_suggestions(result, segmentation.uncertainty.suggestions)
        self.viewer.layers.selection.active = layer
        return " ".join((f"{segmentation.status}.", *segmentation.notes))

    def _mark_suggestions(self, result: Filled, slices: Sequence[int]) -> None:
        """Frame the suggested slices in the viewer, and give each a button that goes there."""
        name = f"suggested slices of {result.drawn.name}"
        drop_layer(self.viewer, name)
        frames = [_frame(result.values.shape, result.axis, k) for k in slices]
        style = {"shape_type": "polygon", "face_color": "transparent", "edge_color": "yellow", "edge_width": 0.5}
        if frames:
            put_layer(self.viewer, "shapes", frames, name, **style, **place_of_layer(result.drawn))
        for k in slices:
            button = PushButton(text=f"slice {k}", tooltip="Go to this slice, to annotate it next.")
            button.changed.connect(partial(self._go_to, result, k))
            self.suggestions.append(button)

    def _go_to(self, result: Filled, k: int) -> None:
        """Show a slice; where nothing is drawn on it, copy what was filled there, which napari can undo as one step.

        Where slices are named as known, it is one of them from then on.
        """
        layer, axis = result.drawn, result.axis
        if layer.data.shape[-3:] != result.values.shape:
            return
        corner = np.zeros(layer.ndim)
        corner[layer.ndim - 3 + axis] = k
        dims = self.viewer.dims
        dims.set_point(dims.ndim - 3 + axis, layer.data_to_world(corner)[layer.ndim - 3 + axis])
        in_slice = np.zeros(result.values.shape, dtype=bool)
        np.moveaxis(in_slice, axis, 0)[k] = True
        in_slice = in_slice.reshape(layer.data.shape)
        if not layer.data[in_slice].any():
            indices = np.nonzero(in_slice)
            layer.data_setitem(indices, result.values.reshape(layer.data.shape)[indices])
            if self.known.value.strip():
                self.known.value = f"{self.known.value},{k}"


def _fill(layer: Any, field: Volume, label: int | None, options: dict[str, Any], progress: Progress) -> Filled:
    """Fill all labels of a layer, whose volume is `field`, or one `label`."""
    name = f"filled {layer.name}"
    if label is None:
        segmentation = reconstruct_labels(field, progress=progress, **options)
        assert segmentation.labels is not None
        return Filled(layer, options["axis"], name, segmentation.labels.values, segmentation)
    mask = replace(field, array=(field.values == label).astype(np.uint8))
    segmentation = reconstruct(mask, progress=progress, **options)
    values = np.where(segmentation.mask.values, label, 0).astype(field.values.dtype)
    return Filled(layer, options["axis"], f"{name}, label {label}", values, segmentation)


def _parse_slices(text: str, count: int) -> list[int] | None:
    """Return the slices in a text such as `0,9,17` or `0::8`; None where it is empty."""
    slices: list[int] = []
    try:
        for item in filter(None, text.replace(" ", "").split(",")):
            bounds = [int(bound) if bound else None for bound in item.split(":")]
            slices += [bounds[0]] if len(bounds) == 1 else range(count)[slice(*bounds)]  # type: ignore[list-item]
    except (ValueError, TypeError):
        raise ScanError(f"expected known slices from 0 to {count - 1}, as 0,9,17 or 0::8, got {text!r}") from None
    return sorted(set(slices)) if text.strip() else None


def _frame(shape: tuple[int, ...], axis: int, k: int) -> np.ndarray:
    """Return the corners (4, 3) of a slice."""
    a, b = (other for other in range(3) if other != axis)
    corners = np.zeros((4, 3))
    corners[:, axis] = k
    corners[[1, 2], a], corners[[2, 3], b] = shape[a] - 1, shape[b] - 1
    return corners
